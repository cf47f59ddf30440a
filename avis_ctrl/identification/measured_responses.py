"""Measured responses with their scatter, and those of the start and of the identified model, for figures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.checks import places
from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.identification import model_error
from avis_ctrl.identification.campaign_fit import SETTINGS as FIT
from avis_ctrl.identification.response import FLOOR, ResponseModel
from avis_ctrl.identification.response_error import kept_axes
from avis_ctrl.measurement.campaign import Campaign, Portion
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.best_linear import best_linear_approximation
from avis_ctrl.rigs.rigid_body import COORDINATES


@dataclass(frozen=True)
class OverlaySettings:
    """points : maximum number of frequencies in a figure; more are not visible, and each costs a local fit."""

    points: int = 400


SETTINGS = OverlaySettings()


@dataclass(frozen=True, eq=False)
class MeasuredOverlay:
    """A measured response from each driven input to each output, to be drawn with a model's response.

    Attributes
    ----------
    frequency_Hz : (n,). inputs, outputs : names. unit : of an entry.
    measured : (n, n_y, n_u) complex.
    measured_std : (n, n_y, n_u) standard deviation of real part, imaginary part and, if it is small, magnitude of the
        measured entry: root of E|error|^2 / 2.
    method : how the response was measured, in words.
    """

    frequency_Hz: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    unit: str
    measured: np.ndarray
    measured_std: np.ndarray
    method: str


@dataclass(frozen=True, eq=False)
class ResponseOverlay(MeasuredOverlay):
    """A measured response with those of the start and the identified model. If the drives were not excited separately,
    the inputs are forces along coordinates.

    Attributes
    ----------
    start, model : (n, n_y, n_u) complex.
    """

    start: np.ndarray
    model: np.ndarray

    @property
    def inside(self) -> float:
        """Fraction of the measured entries within two standard deviations (95 % of a circular normal error) of the
        model; a bias of the measured response counts against it too."""
        # P(|e|^2 < r s^2) = 1 - exp(-r/2) for real and imaginary variance s^2.
        return float(np.mean(np.abs(self.measured - self.model) ** 2 < -2 * np.log(0.05) * self.measured_std**2))


def overlay(measured: FrequencyResponse, model: ResponseModel, start: ResponseModel) -> ResponseOverlay:
    """Arrays for figures at the response's own frequencies, on the lines where it is known.

    Raises
    ------
    InputError : inputs or outputs that the model does not have; no coordinate along which the response is known.
    """
    V = np.eye(len(model.inputs))[:, places(measured.inputs, model.inputs, "the model's inputs are", "inputs")]
    if not np.any(np.all(measured.spanned(np.eye(len(measured.inputs))), axis=1)):
        measured, V = _along_coordinates(measured, model)
    else:
        measured = measured.at(np.all(measured.spanned(np.eye(len(measured.inputs))), axis=1))
    rows = places(model.sensors.names, measured.outputs, "the response has", "outputs")
    U = np.broadcast_to(V.astype(complex), (len(measured.omega), *V.shape))
    return ResponseOverlay(
        measured.frequency_Hz,
        measured.inputs,
        model.sensors.names,
        f"{measured.output_unit} per {measured.input_unit}",
        measured.value[:, rows],
        measured.standard_deviation[:, rows] / np.sqrt(2),
        measured.method,
        start.driven(measured.omega, U, False).Y,
        model.driven(measured.omega, U, False).Y,
    )


def _along_coordinates(measured: FrequencyResponse, model: ResponseModel) -> tuple[FrequencyResponse, np.ndarray]:
    """The response to forces along the coordinates (of rotations at the edge) and to the floor, as far as the inputs
    span them; and these as combinations of the model's inputs (n_u + 3, k)."""
    columns, names = [], []
    for axis in COORDINATES:
        try:
            volts, _ = kept_axes(model.rig, (axis,), model.actuators, model.sensors.names)
        except InputError:
            continue
        columns.append(np.concatenate([volts[:, 0], np.zeros(len(FLOOR))]))
        names.append(f"force on {axis}")
    for k, name in enumerate(FLOOR):
        columns.append(np.eye(len(model.inputs))[len(model.actuators) + k])
        names.append(name)
    V = np.array(columns).T
    place = [model.inputs.index(name) for name in measured.inputs]
    absent = [k for k in range(len(V)) if k not in place]
    known = np.median(measured.spanned(V[place]), axis=0) >= 0.5
    known &= ~np.any(V[absent], axis=0)
    chosen = [name for name, one in zip(names, known, strict=True) if one]
    unit = "N" + (f";{measured.input_unit.partition(';')[2]}" if any(name in FLOOR for name in chosen) else "")
    return measured.along(V[place][:, known], tuple(chosen), unit), V[:, known]


def measured_response(
    data: Campaign | FrequencyResponse, band_Hz: tuple[float, float], model: ResponseModel
) -> FrequencyResponse:
    """The given response; for records their best linear approximation if possible, otherwise a local polynomial
    estimate.

    The latter estimates what the model leaves unexplained and adds the model's response: applied to the records
    themselves, it would round off the resonances, the more so the wider its windows have to be.

    Raises
    ------
    InputError, ComputationError : records that allow neither.
    """
    if isinstance(data, FrequencyResponse):
        return thinned(data.between(*band_Hz))
    try:
        return thinned(best_linear_approximation(data, band_Hz=band_Hz))
    except AvisError:
        # Not periodic, several levels, or different lines for different inputs: the local model can handle all of
        # these.
        driven = [r.header for r in data.records if r.header.excitation not in ("rest", "sine")]
        step = data.sample_rate_Hz / min((header.samples for header in driven), default=2)
        low, high = np.ceil(band_Hz[0] / step - 1e-9) * step, np.floor(band_Hz[1] / step + 1e-9) * step
        if not 0 < low < high:
            raise InputError("expected a band with lines of every record", field="band_Hz", value=band_Hz) from None
        points = min(SETTINGS.points, round((high - low) / step) + 1)
        grid = np.clip(np.geomspace(low, high, points), low, high)
        return model_error.measured_response(_wholes(data), model, band_Hz, FIT.longest_piece, grid)


def _wholes(data: Campaign) -> Campaign:
    """Whole records instead of their parts, which do not all start at rest as a prediction does."""
    wholes = {record.header.name: record.whole if isinstance(record, Portion) else record for record in data.records}
    return replace(data, records=tuple(wholes.values()))


def thinned(response: FrequencyResponse) -> FrequencyResponse:
    """Few enough lines for a figure, evenly spaced in logarithm."""
    f = response.frequency_Hz
    if f.size <= SETTINGS.points:
        return response
    wanted = np.geomspace(f[0], f[-1], SETTINGS.points)
    return response.at(np.unique(np.clip(np.searchsorted(f, wanted), 0, f.size - 1)))
