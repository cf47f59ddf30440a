"""Errors of predictions relative to a measured campaign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from avis_ctrl.measurement.campaign import Campaign, Record


@dataclass(frozen=True)
class PredictionErrors:
    """Relative errors of one record by predicted quantity (y, y_baseline, y_updated).

    They are the r.m.s. error over the r.m.s. of the measured y, both about their means, and the root mean square over
    the channels.

    noise : the same for signals that no prediction from u can contain: the differences between the periods of a
        periodic record after the first one, or else the signals of the campaign's records at rest. None if the floor
        was measured, or if there are neither two such periods nor a record at rest.
    """

    record: str
    relative: dict[str, float]
    noise: float | None = None


def prediction_errors(predicted: Path, campaign: Campaign) -> Iterator[PredictionErrors]:
    """Errors of every record of a campaign with nonzero signals on all channels, from a file of its predictions."""
    rest = [one for one in campaign.records if one.header.excitation == "rest" and not one.header.floor_names]
    variances = [np.var(one.load().y, axis=0) for one in rest]
    with h5py.File(predicted, "r") as file:
        for source in campaign.records:
            record = source.load()
            y = record.y - record.y.mean(axis=0)
            size = np.sqrt(np.mean(y**2, axis=0))
            group = file[f"records/{source.header.name}"]
            if np.all(size > 0):
                yield PredictionErrors(
                    source.header.name,
                    {name: _relative(data[()] - y, size) for name, data in group.items()},
                    _noise(record, size, variances),
                )


def _relative(error: np.ndarray, size: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.var(error, axis=0) / size**2)))


def _noise(record: Record, size: np.ndarray, at_rest: Sequence[np.ndarray]) -> float | None:
    """at_rest : variances of the sensor signals, one array for each record at rest."""
    if record.floor is not None:  # the response to a measured floor is predicted
        return None
    period, count = record.header.period_samples, record.header.periods - 1
    if period and count >= 2:
        y = record.y[period : (count + 1) * period].reshape(count, period, -1)
        spread = (y - y.mean(axis=0)).reshape(-1, y.shape[2])
        # Subtracting the mean removes 1/count of the noise power.
        return _relative(spread, size) * float(np.sqrt(count / (count - 1)))
    return float(np.sqrt(np.mean(np.mean(at_rest, axis=0) / size**2))) if at_rest else None


def compared(errors: Sequence[PredictionErrors]) -> str:
    """A remark on the errors of two models; empty for one model, or if the updated model is better."""
    names = ("y_baseline", "y_updated")
    pairs = np.array([[one.relative[name] for name in names] for one in errors if set(names) <= set(one.relative)])
    if not len(pairs):
        return ""
    if np.array_equal(pairs[:, 0], pairs[:, 1]):
        return "both models give the same predictions: no named effect influences them"
    before, after = np.sqrt(np.mean(pairs**2, axis=0))
    if after <= before:
        return ""
    return (
        f"the updated model has a larger error than the baseline ({100 * after:.3g} % instead of "
        f"{100 * before:.3g} %): this campaign is from a different table, or from one without the named effects"
    )
