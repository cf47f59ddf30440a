"""What the faults beyond the library have in common: never named, and known to first order in closed form."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from avis_ctrl.gap.effects.base import Effect, EffectParameter, Table, Values
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.score import Part, Score
from avis_ctrl.gap.starting_values import Seed


class UnnamedFault(Effect):
    """One that is never named. words : for a sentence, with {place}, {into} and {source} of a pair, and values."""

    outside = True
    looks_like = "not in the library"
    words: str

    def said(self, place: str, values: Values) -> str:
        into, _, source = place.partition("/")
        return self.words.format(place=place, into=into, source=source, **values)


class FirstOrder(UnnamedFault):
    """One of which `first_order` (k, n, n_y, m) is known: y by each linear parameter, on the lines of a block."""

    @abstractmethod
    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        """(k, n, n_y, m)."""

    def seeds(self, score: Score, place: str) -> list[Seed]:
        found = []
        starts = self.starts(score.model, place)
        for point in starts:
            took = score.reduction(score.directions([self.first_order(part, place, point) for part in score.parts]))
            values = self._begin(score.model, place, point, took.coefficients)
            found.append(Seed(tuple(float(v) for v in values), took.chi2, took.rank, len(starts)))
        return sorted(found, key=lambda seed: -seed.chi2)

    def _begin(self, model: Table, place: str, point: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        parameters, values = self.parameters(model, place), np.array(point, float)
        linear = [j for j, one in enumerate(parameters) if one.linear]
        for j, c in zip(linear, coefficients, strict=True):
            values[j] = np.clip(parameters[j].none + c, parameters[j].low, parameters[j].high)
        return values


class Late(FirstOrder):
    """exp(-s T)/(1 + s tau) of one channel. To first order both are one; nothing is earlier than it was sent."""

    words = "a lag or a delay of {place} alone"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        what = "motor" if place in model.actuators else "sensor"
        return (EffectParameter("delay_s", "s", f"delay of this {what} beside the others", 0.0, 0.0, 0.1, 1e-3),
                EffectParameter("time_constant_s", "s", f"first-order lag of this {what} alone", 0.0, 0.0, 0.3, 1e-3))

    def factor(self, s: np.ndarray, values: Values) -> np.ndarray:
        return np.exp(-s * values["delay_s"]) / (1 + s * values["time_constant_s"])

    def seeds(self, score: Score, place: str) -> list[Seed]:
        return [seed for seed in super().seeds(score, place) if any(seed.values)]

    def _begin(self, model: Table, place: str, point: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        return np.full(2, max(float(np.sum(coefficients)), 0.0) / 2)


def motion(part: Part) -> RecordMotion:
    return part.model.motion[part.block.name]


def by_volts(part: Part) -> np.ndarray:
    """(n, n_y, n_u) y by the volts of each motor."""
    kept = part.__dict__.get("by_volts")
    if kept is None:
        kept = part.response.left @ (part.made.T * part.made.volts[:, None, :])
        part.__dict__["by_volts"] = kept
    return kept


def pairs(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{a}/{b}" for a in names for b in names if a != b)


def at(every: np.ndarray, names: tuple[str, ...], place: str) -> np.ndarray:
    """(n, channels) of a place alone; all where it is none of the channels."""
    return every * (np.array(names) == place) if place in names else every
