"""Common base of the faults outside the library; they are never named."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import Effect, EffectParameter, Table, Values
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.starting_values import Seed
from avis_ctrl.gap.table_model import active


class UnnamedFault(Effect):
    """A fault that is never named. words : for a sentence, with {place}, {into} and {source} of a pair, and values."""

    outside = True
    looks_like = "not in the library"
    words: str

    def described(self, place: str, values: Values) -> str:
        into, _, source = place.partition("/")
        return self.words.format(place=place, into=into, source=source, **values)


class Late(UnnamedFault):
    """exp(-s T)/(1 + s tau) of one channel."""

    words = "a lag or a delay of {place} alone"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        what = "motor" if place in model.actuators else "sensor"
        return (
            EffectParameter("delay_s", "s", f"delay of this {what} beside the others", 0.0, 0.0, 0.1, 1e-3),
            EffectParameter("time_constant_s", "s", f"first-order lag of this {what} alone", 0.0, 0.0, 0.3, 1e-3),
        )

    def factor(self, s: np.ndarray, values: Values) -> np.ndarray:
        return np.exp(-s * values["delay_s"]) / (1 + s * values["time_constant_s"])

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Half of the total lateness each, because delay and lag are equal to first order. It cannot be negative."""
        took = score.reduction(score.of_effect(active(self, score.model, place))[:1])
        half = float(took.coefficients[0]) / 2
        return [Seed((half, half), took.chi2, took.rank)] if half > 0 else []


def pairs(names: tuple[str, ...]) -> tuple[str, ...]:
    """All ordered pairs of channels, as "into/source"."""
    return tuple(f"{a}/{b}" for a in names for b in names if a != b)
