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
class StartSettings:
    """Of the search for starting values.

    places_m : lowest and highest place along x, y, z, from the geometric centre [m], and number of places: over and
        around a table.
    halvings : how often the step between places is halved about the best: to some 2 cm.
    polar, around : rows and columns of a half-sphere of directions, about 16 degrees apart.
    surge_Hz : lowest and highest frequency of a resonance inside the mounts [Hz], and number of those searched.
    least_surge_damping : damping ratio with which the fit of such a resonance begins at least [1]: from a narrow one
        at the wrong frequency no fit finds the right one.
    peak_step, peak_reach : steps of the logarithm of frequency in which the residual's power is averaged [1], and steps
        on either side whose median it is compared with.
    peak_height : power over that median from which a step is a peak [1].
    peaks_apart : logarithm of the ratio of two peaks' frequencies, at least [1]: some half widths.
    most_peaks : peaks that are searched, the highest first.
    attached_Hz : lowest and highest frequency of a sprung mass [Hz], and number of those searched: from the lowest
        resonance of a suspension to the end of the band of most records.
    dampings : damping ratios at which a sprung mass, or one inside the mounts, is searched [1]: one narrow, one broad
        resonance.
    peak_dampings : the same at the peaks of the residual [1], whose frequency is known better.
    followed_places : places at which three frequencies are searched on a finer grid, the best first.
    narrowest : least damping ratio for which the frequency grid of a sprung mass is made [1]; a smaller one would need
        more frequencies than a search can afford.
    stiff_Hz : frequency of a sprung mass along an axis in which it shows no resonance [Hz]: above the band.
    mode_Hz : lowest and highest frequency of a mode of the payload [Hz], and number of those searched.
    modes_apart : logarithm of the ratio of two modes' frequencies, at least [1]: some half widths.
    smallest_shape : prior standard deviation, at least, of a mode shape where no channel shows it [1/sqrt(kg)].
    """

    places_m: tuple[tuple[float, float, int], ...] = ((-0.6, 0.6, 7), (-0.5, 0.5, 6), (-0.3, 0.4, 4))
    halvings: int = 3
    polar: int = 6
    around: int = 18
    surge_Hz: tuple[float, float, int] = (8.0, 150.0, 28)
    least_surge_damping: float = 0.05
    peak_step: float = 0.02
    peak_reach: int = 10
    peak_height: float = 1.5
    peaks_apart: float = 0.06
    most_peaks: int = 5
    attached_Hz: tuple[float, float, int] = (1.2, 90.0, 28)
    dampings: tuple[float, ...] = (0.03, 0.15)
    peak_dampings: tuple[float, ...] = (0.01, 0.05)
    followed_places: int = 6
    narrowest: float = 0.02
    stiff_Hz: float = 150.0
    mode_Hz: tuple[float, float, int] = (7.0, 140.0, 22)
    modes_apart: float = 0.08
    smallest_shape: float = 1e-3


SETTINGS = StartSettings()


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
    """An effect that searches its starting values by a method of its own."""

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Where refits may begin, the most promising first."""


@runtime_checkable
class HasRicherLaws(Protocol):
    """An effect with laws that begin best where a simpler one was fitted: a second mode, a mass along three axes; or
    with other local minima near the one that was found."""

    def richer(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """Places (with their law) and values where a fit with a richer law may begin; score : of the fit with `one`."""


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
