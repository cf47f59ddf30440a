"""Measured frequency responses beside those of the re-identified and of the updated model, for figures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.campaign_fit import driven_inputs, excited_band
from avis_ctrl.identification.overlays import measured_response
from avis_ctrl.measurement.campaign import Campaign

# Levels within this factor are one; what depends on amplitude is not averaged over them.
SAME_LEVEL = 1.25


@dataclass(frozen=True, eq=False)
class GapOverlay:
    """From each driven input to each output.

    Attributes
    ----------
    frequency_Hz : (n,). inputs, outputs : names. unit : of an entry.
    measured, baseline, updated : (n, n_y, n_u) complex. updated is of the model without those of its effects that
        depend on amplitude or time, for they have no frequency response.
    measured_std : (n, n_y, n_u) of real part, imaginary part and, where it is small, magnitude.
    records : that the measured response is from. method : how, in words. left_out : effects that `updated` lacks.
    """

    frequency_Hz: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    unit: str
    measured: np.ndarray
    measured_std: np.ndarray
    baseline: np.ndarray
    updated: np.ndarray
    records: tuple[str, ...]
    method: str
    left_out: tuple[str, ...] = ()


@lru_cache(maxsize=1)  # asked for by each format of the report
def gap_overlay(campaign: Campaign, baseline: TableModel, updated: TableModel) -> GapOverlay | str:
    """The overlay of the records of the level that most of them have (of all where these are too few), or a sentence
    why there is none."""
    refused = "no record drives the actuators"
    with threadpool_limits(1):
        for records in selections(campaign):
            try:
                return _overlay(records, baseline, updated)
            except AvisError as error:
                refused = str(error)
    return f"No frequency response could be measured for figures: {refused}"


def selections(campaign: Campaign) -> list[Campaign]:
    """The driven records of the level that most of them have, the higher one where several have as many; then all."""
    driven = sorted((r for r in campaign.records if driven_inputs(r)), key=lambda r: -r.header.level_V)
    if not driven:
        return []
    groups = [[r for r in driven if top.header.level_V / SAME_LEVEL <= r.header.level_V <= top.header.level_V
               and r.header.excitation == top.header.excitation] for top in driven]
    most = max(groups, key=len)
    names = [tuple(sorted(r.header.name for r in group)) for group in ([most, driven] if len(most) < len(driven)
                                                                       else [driven])]
    return [campaign.only(one) for one in names]


def _overlay(records: Campaign, baseline: TableModel, updated: TableModel) -> GapOverlay:
    measured = measured_response(records, excited_band(records), baseline.base)
    if missing := [name for name in measured.inputs if name not in baseline.inputs]:
        raise InputError(f"the model's inputs are {', '.join(baseline.inputs)}", field="inputs", value=missing)
    columns = [baseline.inputs.index(name) for name in measured.inputs]
    rows = [measured.outputs.index(name) for name in baseline.sensors.names]
    U = np.broadcast_to(np.eye(len(baseline.inputs), dtype=complex)[:, columns],
                        (len(measured.omega), len(baseline.inputs), len(columns)))
    before, after = (model.driven(measured.omega, U, False).Y for model in (baseline, updated))
    return GapOverlay(measured.frequency_Hz, tuple(measured.inputs), baseline.sensors.names,
                      f"{measured.output_unit} per {measured.input_unit}", measured.value[:, rows],
                      measured.standard_deviation[:, rows] / np.sqrt(2), before, after,
                      tuple(r.header.name for r in records.records), measured.method,
                      tuple(one.effect.name for one in updated.effects if one.effect.nonlinear))
