"""From samples to spectra: selection of channels and records, and discrete Fourier transforms in a band.

Transforms are scaled by 1/sqrt(N), so that white noise has the same variance on every line for any length N of the
record. A one-sided power spectral density is then 2/f_s times the mean square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import fft

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordSource, ranges

Band = tuple[float, float]


@dataclass(frozen=True)
class Channels:
    """The inputs and outputs of an estimate.

    inputs : names, floor after actuators; floor : whether the floor velocity is an input.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    floor: bool
    input_unit: str
    output_unit: str

    def labels(self, inputs: tuple[str, ...]) -> dict[str, Any]:
        """Names and units of a `FrequencyResponse` from some of the inputs."""
        units = {"input_unit": self.input_unit, "output_unit": self.output_unit}
        return {"inputs": inputs, "outputs": self.outputs, **units}

    def of(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """Samples of the inputs (samples, n_u) and of the outputs (samples, n_y)."""
        return np.hstack([record.u, record.floor]) if self.floor and record.floor is not None else record.u, record.y


def channels(records: Sequence[RecordSource], floor: bool | None) -> Channels:
    """Inputs and outputs of an estimate.

    Parameters
    ----------
    records : the records used.
    floor : whether to use the floor velocity as inputs; by default if every record measured it.

    Raises
    ------
    InputError : a record without floor channels although they are requested, different floor channels.
    """
    first = records[0].header
    lacking = [record.header.name for record in records if not record.header.floor_names]
    if floor and lacking:
        raise InputError("the floor is requested as an input but was not measured", field=f"record {lacking[0]}: floor")
    use = not lacking if floor is None else floor
    for record in records:
        if use and record.header.floor_names != first.floor_names:
            raise record.header.error("floor_names", f"expected {first.floor_names} as in record {first.name}")
    inputs = (*first.u_names, *first.floor_names) if use else first.u_names
    unit = f"{first.u_unit}; floor {first.floor_unit}" if use else first.u_unit
    return Channels(inputs, first.y_names, use, unit, first.y_unit)


def taking_part(campaign: Campaign, floor: bool | None) -> tuple[RecordSource, ...]:
    """Records with information on the response: never stepped sines; records with u = 0 only if the floor is an input.

    Raises
    ------
    InputError : no record remains.
    """
    moving = [r for r in campaign.records if r.header.excitation != "sine"]
    driven = tuple(r for r in moving if r.header.excitation in ("multisine", "noise"))
    quiet_count = floor is not False and bool(moving) and all(r.header.floor_names for r in moving)
    chosen = tuple(moving) if quiet_count else driven
    if not chosen:
        found = [r.header.excitation for r in campaign.records]
        words = "expected at least one record with multisine or noise excitation, or with measured floor motion"
        raise InputError(words, field="records", value=found)
    return chosen


def checked_band(band_Hz: Band | None, sample_rate_Hz: float) -> Band:
    """A band within 0 .. f_s/2; the full range by default."""
    low, high = (0.0, sample_rate_Hz / 2) if band_Hz is None else band_Hz
    if not 0 <= low < high <= sample_rate_Hz / 2:
        words = f"expected 0 <= low < high <= {sample_rate_Hz / 2:g} Hz, half the sample rate"
        raise InputError(words, field="band_Hz", value=band_Hz)
    return low, high


def lines(samples: int, sample_rate_Hz: float, band_Hz: Band) -> slice:
    """Lines inside a band of a transform of `samples` samples, without line 0 (sensor offsets)."""
    step = sample_rate_Hz / samples
    first = max(1, int(np.ceil(band_Hz[0] / step - 1e-9)))
    last = min((samples - 1) // 2, int(np.floor(band_Hz[1] / step + 1e-9)))
    return slice(first, last + 1)


def transform(x: np.ndarray, keep: slice) -> np.ndarray:
    """Selected lines of the transform along the first axis, divided by sqrt(N)."""
    return fft.rfft(x, axis=0)[keep] / np.sqrt(x.shape[0])


def equal_pieces(record: RecordSource, longest: int | None) -> list[tuple[int, int]]:
    """(start, stop) of pieces of nearly equal length, in whole periods; the whole record if longest is None.

    A short last piece would have a coarse resolution; it is left out if it is shorter than half the others.
    """
    samples, period = record.header.samples, record.header.period_samples
    if longest is None or samples <= longest:
        return [(0, samples)]
    share = -(-samples // -(-samples // longest))
    if period:
        share = max(share // period, 1) * period
    return [(start, stop) for start, stop in ranges(samples, share) if 2 * (stop - start) >= share]
