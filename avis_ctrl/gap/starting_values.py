"""Where the fit of an effect begins, and by how much it promises to lower the sum of squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy import stats

from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.table_model import ActiveEffect


@dataclass(frozen=True)
class Seed:
    """Where a refit may begin: values of all parameters, and by how much chi2 falls there to first order.

    directions : along how many the data could have made it fall. looks : at how many frequencies, or other values of
    what shapes the effect, the best was sought. seen : the fall by which its significance is judged, where that is not
    chi2 (on fewer data).
    """

    values: tuple[float, ...]
    chi2: float
    directions: int
    looks: int = 1
    seen: float | None = None

    @property
    def p_value(self) -> float:
        """Probability of as large a fall by noise alone."""
        fall = self.chi2 if self.seen is None else self.seen
        return min(1.0, self.looks * float(stats.chi2.sf(fall, self.directions)))


@runtime_checkable
class FindsItsStart(Protocol):
    """An effect that looks for its starting values in a way of its own."""

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Where refits may begin, the most promising first."""


def seeds(effect: Effect, score: Score, place: str) -> list[Seed]:
    """Where refits of an effect may begin, the most promising first.

    By default the score test at every point of `Effect.starts`; the linear parameters are as large as it says, within
    what physics allows.
    """
    if isinstance(effect, FindsItsStart):
        return effect.seeds(score, place)
    parameters, found = effect.parameters(score.model, place), []
    linear = [j for j, one in enumerate(parameters) if one.linear]
    starts = effect.starts(score.model, place)
    for point in starts:
        begun = ActiveEffect(effect, place, parameters, tuple(float(v) for v in point))
        A = score.of_effect(begun)
        if not linear:
            # It acts at full strength or not at all.
            fall = float(2 * A[0] @ score.e - A[0] @ A[0])
            if fall > 0:
                found.append(Seed(begun.values, fall, len(parameters), len(starts)))
            continue
        took = score.reduction(A)
        values = list(begun.values)
        for c, j in zip(took.coefficients, linear, strict=False):
            one = parameters[j]
            values[j] = float(np.clip(one.none + c, one.low, one.high))
        wrong = any(values[j] == parameters[j].none for j in linear) and len(linear) == 1
        if not wrong:
            found.append(Seed(tuple(values), took.chi2, took.rank, len(starts)))
    return sorted(found, key=lambda seed: -seed.chi2)
