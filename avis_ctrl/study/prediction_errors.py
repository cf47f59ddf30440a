"""How far predictions are from what a campaign measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from avis_ctrl.measurement.campaign import Campaign


@dataclass(frozen=True)
class PredictionErrors:
    """Errors of one record by the predicted quantity (y, y_baseline, y_updated): r.m.s. of the error over that of the
    measured y, both about their means, root mean square over the channels."""

    record: str
    relative: dict[str, float]


def prediction_errors(predicted: Path, campaign: Campaign) -> Iterator[PredictionErrors]:
    """Of every record of a campaign that measured something, from a file of predictions of it."""
    with h5py.File(predicted, "r") as file:
        for source in campaign.records:
            y = source.load().y
            y = y - y.mean(axis=0)
            size = np.sqrt(np.mean(y ** 2, axis=0))
            group = file[f"records/{source.header.name}"]
            if np.all(size > 0):
                yield PredictionErrors(source.header.name, {name: _relative(data[()], y, size)
                                                            for name, data in group.items()})


def _relative(made: np.ndarray, y: np.ndarray, size: np.ndarray) -> float:
    error = made - made.mean(axis=0) - y
    return float(np.sqrt(np.mean(np.mean(error ** 2, axis=0) / size ** 2)))


def compared(errors: Sequence[PredictionErrors]) -> str:
    """What the errors of two models say of them; empty where there is one model, or the updated one is better."""
    pairs = np.array([(one.relative["y_baseline"], one.relative["y_updated"]) for one in errors
                      if {"y_baseline", "y_updated"} <= set(one.relative)])
    if not len(pairs):
        return ""
    if np.array_equal(pairs[:, 0], pairs[:, 1]):
        return "both models are the same here: nothing that predictions show was named"
    before, after = np.sqrt(np.mean(pairs ** 2, axis=0))
    return (f"the updated model is further off than the baseline ({100 * after:.3g} % against {100 * before:.3g} %): "
            "this campaign is of another table, or of one without the named effects") if after > before else ""
