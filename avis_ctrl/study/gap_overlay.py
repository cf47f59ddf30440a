"""Measured frequency responses with those of the re-identified and of the updated model, for figures."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import cast

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.checks import places
from avis_ctrl.errors import AvisError, ComputationError, InputError
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.motion_estimate import clock_of
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.campaign_fit import SETTINGS as FIT
from avis_ctrl.identification.campaign_fit import driven_inputs, excited_band
from avis_ctrl.identification.measured_responses import SETTINGS as OVERLAY
from avis_ctrl.identification.measured_responses import MeasuredOverlay, thinned
from avis_ctrl.identification.model_error import SETTINGS as MODEL_ERROR
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.best_linear import best_linear_approximation
from avis_ctrl.measurement.frequency_response.local_polynomial import local_polynomial

# Start of the name of a method that adds a measured residual to the response of a model.
BESIDE = "response of the model plus its residual: "


@dataclass(frozen=True, eq=False)
class GapOverlay(MeasuredOverlay):
    """A measured response with those of the re-identified and of the updated model.

    Attributes
    ----------
    baseline, updated : (n, n_y, n_u) complex. Effects that depend on amplitude or time have no frequency response. With
        such effects `updated` is estimated like `measured`, from records that the model simulates.
    records : used for the measured response.
    simulated : effects for which `updated` was estimated from a simulation. left_out : effects that `updated` lacks.
    """

    baseline: np.ndarray
    updated: np.ndarray
    records: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    simulated: tuple[str, ...] = ()


@lru_cache(maxsize=1)  # called for each format of the report
def gap_overlay(campaign: Campaign, baseline: TableModel, updated: TableModel) -> GapOverlay | str:
    """Overlay of the records of the most common level, or of all records if these are too few.

    Returns a sentence with the reason if no response can be measured.
    """
    refused = "no record drives the actuators"
    clock = clock_of(campaign)
    with threadpool_limits(1):
        for records in selections(campaign):
            try:
                return _overlay(records, baseline, updated, clock)
            except AvisError as error:
                refused = str(error)
    return f"No frequency response could be measured for figures: {refused}"


def selections(campaign: Campaign) -> list[Campaign]:
    """The driven records of the most common level and excitation (highest level in a tie), then all driven records."""
    driven = sorted((r.header for r in campaign.records if driven_inputs(r)), key=lambda h: -h.level_V)
    if not driven:
        return []

    def alike(top: RecordHeader) -> list[RecordHeader]:
        low, high = top.level_V / FIT.same_level, top.level_V
        return [h for h in driven if low <= h.level_V <= high and h.excitation == top.excitation]

    most = max(map(alike, driven), key=len)
    groups = [most, driven] if len(most) < len(driven) else [driven]
    return [campaign.only(tuple(sorted(h.name for h in group))) for group in groups]


def _overlay(records: Campaign, baseline: TableModel, updated: TableModel, clock: tuple[float, float]) -> GapOverlay:
    linear = updated.linear
    loaded = replace(records, records=tuple(one.load() for one in records.records))
    beside = None if (measured := _best_linear(loaded)) else _less(loaded, _simulated(loaded, linear, clock))
    if measured is None:
        assert beside is not None
        measured = _regressed_on_grid(beside)
    places(measured.inputs, baseline.inputs, "the model's inputs are", "inputs")
    rows = [measured.outputs.index(name) for name in baseline.sensors.names]
    before, after = (_response(model, measured) for model in (baseline, linear))
    value = measured.value[:, rows] + (after if measured.method.startswith(BESIDE) else 0.0)
    named = tuple(
        one.effect.name for one in updated.effects if one.effect.nonlinear and not isinstance(one.effect, LargeMotion)
    )
    left_out = named
    if named:
        with suppress(AvisError):
            after, left_out = _with_nonlinear(loaded, beside, updated, measured, after, clock), ()
    return GapOverlay(
        measured.frequency_Hz,
        tuple(measured.inputs),
        baseline.sensors.names,
        f"{measured.output_unit} per {measured.input_unit}",
        value,
        measured.standard_deviation[:, rows] / np.sqrt(2),
        measured.method,
        before,
        after,
        tuple(r.header.name for r in records.records),
        left_out,
        () if left_out else named,
    )


def _with_nonlinear(
    records: Campaign,
    beside: Campaign | None,
    updated: TableModel,
    measured: FrequencyResponse,
    linear: np.ndarray,
    clock: tuple[float, float],
) -> np.ndarray:
    """(n, n_y, n_u) response estimated by the method of `measured` from records that the complete model simulates."""
    made = _simulated(records, updated, clock)
    rows = [measured.outputs.index(name) for name in updated.sensors.names]
    if beside is not None:
        # y_model - y_linear = (y - y_linear) - (y - y_model)
        left = _less(beside, _less(records, made))
        return linear + _regressed(left, excited_band(records), measured.frequency_Hz).value[:, rows]
    left = _less(records, _less(records, made))
    found = best_linear_approximation(left, band_Hz=excited_band(records))
    return found.at(np.searchsorted(found.frequency_Hz, measured.frequency_Hz)).value[:, rows]


def _response(model: TableModel, like: FrequencyResponse) -> np.ndarray:
    """(n, n_y, n_u) response of a model to the inputs of a measured response."""
    columns = [model.inputs.index(name) for name in like.inputs]
    U = np.broadcast_to(
        np.eye(len(model.inputs), dtype=complex)[:, columns], (len(like.omega), len(model.inputs), len(columns))
    )
    return model.driven(like.omega, U, False).Y


def _best_linear(records: Campaign) -> FrequencyResponse | None:
    """Best linear approximation, thinned for a figure; None if the records do not allow it."""
    try:
        return thinned(best_linear_approximation(records, band_Hz=excited_band(records)))
    except AvisError:
        return None


def _regressed_on_grid(beside: Campaign) -> FrequencyResponse:
    """Regression of a model's residual on the inputs; regression of the records would flatten the resonances."""
    band_Hz, step = excited_band(beside), 1 / min(one.header.duration_s for one in beside.records)
    low, high = np.ceil(band_Hz[0] / step - 1e-9) * step, np.floor(band_Hz[1] / step + 1e-9) * step
    if not 0 < low < high:
        raise InputError("expected a band with lines of every record", field="band_Hz", value=band_Hz)
    grid = np.clip(np.geomspace(low, high, min(OVERLAY.points, round((high - low) / step) + 1)), low, high)
    found = _regressed(beside, band_Hz, grid)
    return replace(found, method=f"{BESIDE}{found.method}")


def _simulated(records: Campaign, model: TableModel, clock: tuple[float, float]) -> Campaign:
    """The records with y replaced by a simulation of the model, from rest at their start."""
    made = []
    for record in cast(tuple[Record, ...], records.records):
        h = record.header
        outputs = places(model.sensors.names, h.y_names, "the record has", f"record {h.name}: y names")
        u = record.u[:, places(model.actuators, h.u_names, "the record has", f"record {h.name}: u names")]
        y = np.zeros_like(record.y)
        y[:, outputs] = simulate(model, u, record.floor, h.sample_rate_Hz, start_s=h.start_s, campaign_s=clock).y
        made.append(replace(record, y=y))
    return replace(records, records=tuple(made))


def _less(records: Campaign, others: Campaign) -> Campaign:
    """The records with the y of the others subtracted."""
    pairs = zip(cast(tuple[Record, ...], records.records), cast(tuple[Record, ...], others.records), strict=True)
    return replace(records, records=tuple(replace(one, y=one.y - other.y) for one, other in pairs))


def _regressed(left: Campaign, band_Hz: tuple[float, float], grid: np.ndarray) -> FrequencyResponse:
    """Local polynomial regression. The windows grow until the inputs can be separated in each of them."""
    for half_width in MODEL_ERROR.half_widths[:-1]:
        try:
            return local_polynomial(left, band_Hz=band_Hz, frequency_Hz=grid, half_width=half_width)
        except ComputationError:
            continue
    return local_polynomial(left, band_Hz=band_Hz, frequency_Hz=grid, half_width=MODEL_ERROR.half_widths[-1])
