"""Starting values of the fit of an effect, and the predicted reduction of the sum of squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy import stats

from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.table_model import ActiveEffect


@dataclass(frozen=True)
class StartSettings:
    """Settings of the search for starting values.

    places_m : lowest and highest place along x, y, z, from the geometric centre [m], and number of places: over and
        around a table.
    halvings : how often the step between places is halved around the best one: down to about 2 cm.
    polar, around : rows and columns of a hemisphere of directions, about 16 degrees apart.
    surge_Hz : lowest and highest frequency of a resonance inside the mounts [Hz], and number of frequencies searched.
    least_surge_damping : minimum damping ratio from which the fit of such a resonance starts [1]: a fit that starts
        with a narrow resonance at the wrong frequency does not converge to the right one.
    peak_step, peak_reach : step of the logarithm of frequency over which the residual's power is averaged [1], and
        number of steps on either side for the median with which it is compared.
    peak_height : power over that median from which a step is a peak [1].
    peaks_apart : minimum logarithm of the ratio of two peaks' frequencies [1]: some half widths.
    most_peaks : maximum number of peaks searched, the highest first.
    attached_Hz : lowest and highest frequency of a sprung mass [Hz], and number of frequencies searched: from the
        lowest resonance of a suspension to the end of the band of most records.
    dampings : damping ratios searched for a sprung mass, or a mass inside the mounts [1]: a narrow and a broad
        resonance.
    peak_dampings : the same at the peaks of the residual [1], whose frequency is known better.
    followed_places : number of places at which three frequencies are searched on a finer grid, the best first.
    turned_places : number of these places at which rotated axes are searched.
    axes_damping : damping ratio of the search of three frequencies [1].
    turned_rad : largest rotation of the axes [rad], and number of rotations about each axis searched: any three
        orthogonal axes are within this rotation of some permutation of x, y and z.
    narrowest : minimum damping ratio for the frequency grid of a sprung mass, or of a chassis around a fit [1]; a
        smaller one would need more frequencies than a search can afford.
    stiff_Hz : frequency of a sprung mass along an axis in which it shows no resonance [Hz]: above the band.
    mode_Hz : lowest and highest frequency of a mode of the payload [Hz], and number of frequencies searched.
    modes_apart : minimum logarithm of the ratio of two modes' frequencies [1]: some half widths.
    smallest_shape : minimum prior standard deviation of a mode shape where no channel shows it [1/sqrt(kg)].

    Of a chassis, whose coordinates are x, y, z, rx, ry and rz:

    chassis_own_Hz : lowest and highest resonance frequency [Hz] of a single coordinate, and number of frequencies
        searched; below the lowest, the suspension modes dominate.
    chassis_damping : damping ratio of that search [1]: large enough that the grid misses no resonance.
    chassis_least_gain : reduction of chi-square with one more coordinate over that without it, below which that
        coordinate counts as stiff [1].
    chassis_stiff_Hz : frequency of a coordinate in which no resonance was found [Hz]: near the end of the band.
    chassis_fixed_Hz : frequency of a coordinate that shall not move [Hz]: far above the band, within the parameter's
        range.
    chassis_mass_ratio : ratio of the masses of two coordinates, up to which both can belong to one chassis [1].
    chassis_radius_m : smallest and largest radius of gyration [m] at which a fit starts.
    chassis_heights_m : height of the mass over the table's centre, and of the springs over the mass [m], at which a fit
        starts.
    chassis_lines : lines of a record for the search around a fit: fewer than the fit's, because it gives only starting
        values.
    chassis_followed_groups : number of groups of coordinates whose new frequencies are fitted, the most promising
        first.
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
    turned_places: int = 2
    axes_damping: float = 0.05
    turned_rad: tuple[float, int] = (1.1, 9)
    narrowest: float = 0.02
    stiff_Hz: float = 150.0
    mode_Hz: tuple[float, float, int] = (7.0, 140.0, 22)
    modes_apart: float = 0.08
    smallest_shape: float = 1e-3
    chassis_own_Hz: tuple[float, float, int] = (7.0, 90.0, 26)
    chassis_damping: float = 0.06
    chassis_least_gain: float = 1.05
    chassis_stiff_Hz: float = 90.0
    chassis_fixed_Hz: float = 250.0
    chassis_mass_ratio: float = 3.0
    chassis_radius_m: tuple[float, float] = (0.1, 3.0)
    chassis_heights_m: tuple[float, float] = (-0.3, 0.0)
    chassis_lines: int = 200
    chassis_followed_groups: int = 2


SETTINGS = StartSettings()


@dataclass(frozen=True)
class Seed:
    """Starting point of a fit: values of all parameters, and the reduction of chi2 there to first order.

    directions : number of directions along which the data could have reduced it. trials : number of frequencies, or
        other shape values, among which the best was selected.
    """

    values: tuple[float, ...]
    chi2: float
    directions: int
    trials: int = 1

    @property
    def p_value(self) -> float:
        """Probability of as large a reduction by noise alone."""
        return min(1.0, self.trials * float(stats.chi2.sf(self.chi2, self.directions)))


@runtime_checkable
class FindsItsStart(Protocol):
    """An effect with its own search for starting values."""

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Starting points of fits, the most promising first."""


@runtime_checkable
class HasExtendedModels(Protocol):
    """An effect with richer laws that start best from the fit of a simpler one (a second mode, a mass along three
    axes), or with other local minima near the one that was found."""

    def extended_models(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """Places (with their law) and values from which a fit with a richer law may start; score : of the fit with
        `one`."""


def seeds(effect: Effect, score: Score, places: Sequence[str]) -> list[list[Seed]]:
    """Starting points of fits of an effect at each place, the most promising first.

    By default, the score test is computed at every point of `Effect.starts`; it gives the linear parameters, limited to
    their physical bounds.
    """
    if isinstance(effect, FindsItsStart):
        return [effect.seeds(score, place) for place in places]
    begun = []
    for place in places:
        parameters, starts = effect.parameters(score.model, place), effect.starts(score.model, place)
        begun.append([ActiveEffect(effect, place, parameters, tuple(float(v) for v in point)) for point in starts])
    directions = iter(score.of_effects([one for own in begun for one in own]))
    return [_ranked(score, [(one, next(directions)) for one in own]) for own in begun]


def _ranked(score: Score, begun: Sequence[tuple[ActiveEffect, np.ndarray]]) -> list[Seed]:
    """Seeds from the starting points of an effect at one place with their directions, the most promising first."""
    found = []
    for one, A in begun:
        linear = [j for j, parameter in enumerate(one.parameters) if parameter.linear]
        if not linear:
            # The effect acts at full strength or not at all.
            reduction = float(2 * A[0] @ score.e - A[0] @ A[0])
            if reduction > 0:
                found.append(Seed(one.values, reduction, len(one.parameters), len(begun)))
            continue
        took = score.reduction(A)
        values = list(one.values)
        for c, j in zip(took.coefficients, linear, strict=False):
            parameter = one.parameters[j]
            values[j] = float(np.clip(parameter.none + c, parameter.low, parameter.high))
        wrong = any(values[j] == one.parameters[j].none for j in linear) and len(linear) == 1
        if not wrong:
            found.append(Seed(tuple(values), took.chi2, took.rank, len(begun)))
    return sorted(found, key=lambda seed: -seed.chi2)
