"""The response that an identified model does not explain, measured on the records themselves.

The sensor readings minus the model's prediction are regressed on the inputs (model error modelling; Ljung, Model
validation and model error modelling, 1999). Near a sharp resonance this is far better than comparing two responses: the
prediction contains the resonance and the transient of the start, so that the remainder is small and smooth over
frequency, as the local polynomial requires.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from avis_ctrl.checks import places
from avis_ctrl.errors import ComputationError
from avis_ctrl.identification.excited_space import excited_space
from avis_ctrl.identification.predictor import Predictor, model_inputs
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, Record, RecordSource
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.local_polynomial import local_polynomial


@dataclass(frozen=True)
class ModelErrorSettings:
    """half_widths : lines to each side of a window, tried in this order; None for the minimum that the degrees of
    freedom allow. Each is about half as wide again as the one before, so that the window is hardly
    wider than the inputs need to be separated."""

    half_widths: tuple[int | None, ...] = (None, 16, 24, 36)


SETTINGS = ModelErrorSettings()


class Unexplained(RecordSource):
    """A record with the model's prediction, from rest at the record's start, subtracted from y.

    Pieces in order cost one run; a piece out of order restarts the prediction. The last loaded piece is cached: local
    models of several widths load every record again.
    """

    def __init__(self, record: RecordSource, model: ResponseModel):
        self.record, self.model, self.header = record, model, record.header
        h = record.header
        self.columns = places(model.sensors.names, h.y_names, "the record has", f"record {h.name}: y names")
        model.require_rate(h)
        self.predictor, self.at = Predictor(model, large_motion=True), 0
        self.last: tuple[int, int, Record] | None = None

    def load(self, start: int = 0, stop: int | None = None) -> Record:
        stop = self.header.samples if stop is None else stop
        if self.last is None or self.last[:2] != (start, stop):
            self.last = start, stop, self._predicted(start, stop)
        return self.last[2]

    def _predicted(self, start: int, stop: int) -> Record:
        if start < self.at:
            self.predictor, self.at = Predictor(self.model, large_motion=True), 0
        piece = self.record.load(self.at, stop)
        read = self.predictor.read(*model_inputs(self.model, piece))
        y, before, self.at = piece.y.copy(), start - self.at, stop
        y[:, self.columns] -= read
        return replace(piece, y=y).load(before)


def unexplained(campaign: Campaign, model: ResponseModel) -> Campaign:
    """The campaign with the model's prediction subtracted. Raises InputError for channels that are not the model's."""
    return replace(campaign, records=tuple(Unexplained(record, model) for record in campaign.records))


def measured_response(
    campaign: Campaign,
    model: ResponseModel,
    band_Hz: tuple[float, float],
    longest_piece: int | None = None,
    frequency_Hz: np.ndarray | None = None,
) -> FrequencyResponse:
    """Frequency response measured in the records: the model's, plus what it leaves unexplained.

    Windows of the local polynomial grow until the inputs can be separated in each: with zippered lines each input has
    only some of the lines. The unexplained part is smooth, as wide windows require. Inputs that no window separates,
    such as drives that are played together along six axes, give a singular Gram matrix: the response is known along the
    directions that they span.

    Raises InputError as `unexplained` and `local_polynomial` do.
    """
    left = _local(unexplained(campaign, model), band_Hz, longest_piece, frequency_Hz)
    response = model.response(left.omega)[:, :, [model.inputs.index(name) for name in left.inputs]]
    rows = [left.outputs.index(name) for name in model.sensors.names]
    value = left.value.copy()
    value[:, rows] += response
    return replace(left, value=value, method=f"response of the model plus its residual: {left.method}")


def _local(
    campaign: Campaign, band_Hz: tuple[float, float], longest_piece: int | None, frequency_Hz: np.ndarray | None
) -> FrequencyResponse:
    # Directions that the records do not excite at all are missing in windows of any width.
    widths = SETTINGS.half_widths if excited_space(campaign, band_Hz).full else SETTINGS.half_widths[:1]
    local = partial(local_polynomial, campaign, band_Hz=band_Hz, frequency_Hz=frequency_Hz, longest_piece=longest_piece)
    for half_width in widths:
        try:
            return local(half_width=half_width)
        except ComputationError:
            continue
    return local(half_width=widths[-1], partial=True)
