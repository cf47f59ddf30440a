"""Bounds of the loop with the emitted numbers (those of controller.json): mu, worst-case transmissibility, stability.

The design's uncertain plant stays in continuous time, with a rational controller K_s in its loop. Two more uncertain
blocks cover what the emitted controller does differently; their size is computed in `sampled_response`:

    force = K_s seen + W_a Delta_a [K_s; k I] seen     |W_a| >= |M|, R - K_s exp(-j omega tau) = M [K_s; k I]
    seen  = G force + W_E Delta_E force                |W_E| >= |E|, the images of the sample rate

"seen" are the velocities of the axes that the controller computes from its sensors. The error of the controller is
relative to the controller, direction by direction. The singular values of a multi-axis controller may differ by a
factor of a hundred or more: an error that is small compared with the largest of them, but allowed in all directions,
can exceed the smallest. k bounds the error in directions in which the controller has little gain.

This set contains everything that the rounded, sampled and held controller does to frequencies below half the sample
rate. The bounds of `mu_peak` and `worst_case_gain` for the set are therefore bounds for the code. K_s is the design's
own controller; any other function would be valid, with another W_a. A change of any number in controller.json changes
W_a and every bound.

Stability of the sampled loop: for no member of the set does det(I - L) vanish between frequency 0 and half the sample
rate. Its argument therefore changes as that of the continuous loop with K_s, which is stable, provided that the loop
gain is below 1 from half the rate on, so that both arguments end at zero (Nyquist; all parts are stable by themselves).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.export.intervals import log_slopes
from avis_ctrl.export.realisation import balanced
from avis_ctrl.export.sampled_response import SampledAxes
from avis_ctrl.lti.connect import connect, summing_junction
from avis_ctrl.lti.magnitude_fit import covering_fits
from avis_ctrl.lti.rational import Rational
from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.robust.mu_peak import MuPeak, mu_peak, stability_bound, worst_case_gain
from avis_ctrl.study.analysis import SETTINGS as ANALYSIS
from avis_ctrl.study.workers import each
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull
from avis_ctrl.uncertainty.generalized_plant import GeneralizedPlant


@dataclass(frozen=True)
class CoverSettings:
    """Settings of the filters that cover the two errors.

    lowest : start of the logarithmic intervals, as a fraction of half the sample rate; below it the errors are
        constant, and the intervals are at most as wide as the first logarithmic one.
    intervals : number of logarithmic intervals over which the errors are bounded; each is 0.4 % wide.
    remainder, divisions : an interval in which Taylor's remainder exceeds `harmless` and this fraction of the error is
        divided, into at most this many parts. This happens near the controller's own modes.
    fitted : one of this many intervals is used in the fit; the filter is then raised to cover all of them.
    beyond, points_beyond : the filter must not rise up to this multiple of half the sample rate, at this many points.
    excess_dB : allowed excess of a filter over the error; the order is no higher than this requires.
    harmless, harmless_images : fraction of the controller, and of the largest gain of the table, below which the errors
        need no close fit. The smallest gain of the table may be a thousandth of the largest.
    least, least_of_all : gain below which the controller's error is measured absolutely, as a fraction of its gain at
        half the sample rate, and at least as a fraction of its largest gain. The error is largest at half the rate,
        where this gain should add little to it. At low frequencies, where a controller may have no gain, a small
        rounding error remains.
    most : highest order of a filter; a slow controller pole together with the hold at half the rate requires it.
    first_points : number of frequencies, from half the sample rate on, at which the loop gain is computed first.
    points, few_points : number of frequencies with an upper bound of the worst-case gain, in addition to those of the
        highest gains: `points` if its curve is wanted, `few_points` otherwise.
    """

    lowest: float = 1e-7
    intervals: int = 4000
    remainder: float = 0.1
    divisions: int = 32
    fitted: int = 20
    beyond: float = 30.0
    points_beyond: int = 15
    excess_dB: float = 2.0
    harmless: float = 3e-4
    harmless_images: float = 1e-5
    least: float = 0.1
    least_of_all: float = 1e-6
    most: int = 6
    first_points: int = 6
    points: int = 40
    few_points: int = 0


@dataclass(frozen=True, eq=False)
class Grid:
    """Intervals |omega - centre| <= half that cover 0 to half the sample rate [rad/s], (n,) each."""

    centre: np.ndarray
    half: np.ndarray

    @staticmethod
    def of(half_rate: float, settings: CoverSettings) -> Grid:
        """Intervals of equal ratio, and equal ones below the lowest of them."""
        above = np.geomspace(settings.lowest, 1.0, settings.intervals + 1)
        below = np.linspace(0.0, above[0], int(np.ceil(above[0] / (above[1] - above[0]))) + 1)
        ends = np.concatenate([below[:-1], above]) * half_rate
        return Grid((ends[1:] + ends[:-1]) / 2, (ends[1:] - ends[:-1]) / 2)

    def divided(self, parts: np.ndarray) -> Grid:
        """Divide each interval into this number (n,) of equal parts."""
        within = np.arange(np.sum(parts)) - np.repeat(np.cumsum(parts) - parts, parts)
        half, start = np.repeat(self.half / parts, parts), np.repeat(self.centre - self.half, parts)
        return Grid(start + (2 * within + 1) * half, half)


@dataclass(frozen=True, eq=False)
class Errors:
    """The controller in the proof, and filters that cover the differences of the emitted controller.

    K : continuous, from seen velocities to forces. W_a : covers the error relative to [K; least I], least in N s/m.
    W_E : covers the images of the sample rate [m/(N s)].
    """

    K: StateSpace
    least: float
    W_a: Rational
    W_E: Rational

    def closed(
        self, plant: GeneralizedPlant, W_v: Rational | None = None, W_f: Rational | None = None
    ) -> tuple[StateSpace, BlockStructure]:
        """The loop closed with K; the blocks of the two errors follow those of the plant.

        W_v, W_f : for additional outputs W_v force, and inputs whose product with W_f is added to what is seen.
        """
        P, blocks, n = plant.P, plant.blocks, plant.nmeas
        force, seen = [f"{name} applied" for name in plant.u], [f"{name} alone" for name in plant.y]
        parts = {
            "plant": P.renamed(dict(zip(plant.u, force, strict=True)), dict(zip(plant.y, seen, strict=True))),
            "K": self.K.renamed(plant.y, plant.u),
        }
        for k in range(n):
            terms = [seen[k], f"w_E{k}"]
            if W_f is not None and W_v is not None:
                terms.append(f"folded {k}")
                parts[f"W_f {k}"] = W_f.system(f"floor above {k}", f"folded {k}")
                parts[f"W_v {k}"] = W_v.system(force[k], f"velocity above {k}")
            parts[f"seen {k}"] = summing_junction(plant.y[k], terms)
            parts[f"force {k}"] = summing_junction(force[k], [plant.u[k], f"error {k}"])
            parts[f"W_a {k}"] = self.W_a.system(f"w_a{k}", f"error {k}")
            parts[f"least {k}"] = gain([[self.least]], [plant.y[k]], [f"z_a{k}"])
            parts[f"W_E {k}"] = self.W_E.system(force[k], f"z_E{k}")
        w = [f"w_{kind}{k}" for kind in "aE" for k in range(n)]
        z = [*plant.u, *(f"z_{kind}{k}" for kind in "aE" for k in range(n))]
        above = range(n if W_f is not None else 0)
        closed = connect(
            parts,
            [*P.inputs[: blocks.n_w], *w, *plant.w, *(f"floor above {k}" for k in above)],
            [*P.outputs[: blocks.n_z], *z, *plant.z, *(f"velocity above {k}" for k in above)],
        )
        return closed, BlockStructure(
            (
                *blocks.blocks,
                ComplexFull(n, 2 * n, "sampled controller"),
                ComplexFull(n, n, "images of the sample rate"),
            )
        )


@dataclass(frozen=True, eq=False)
class Bounds:
    """Upper bounds of the loop that runs the emitted numbers.

    mu : robust performance of the weighted channels. peak, band : worst-case transmissibility (largest singular value)
    up to half the sample rate and in the design's band.
    all_times : worst-case r.m.s. gain from the floor velocity up to half the sample rate to the payload velocity at all
    times, also between the samples. above : the same from the floor velocity between half the rate and 8.5 times the
    rate, which the samples show at other frequencies. Both are inf if not proved.
    gain_above : largest bound of the loop gain at `CoverSettings.intervals` frequencies from half the sample rate to
    `beyond` times this frequency; the proof of stability requires less than 1 from half the rate on.
    """

    mu: MuPeak
    peak: MuPeak
    band: MuPeak
    all_times: float
    above: float
    gain_above: float


class StabilityNotProvedError(ComputationError):
    """The proof of stability failed. reason : why, in words."""

    def __init__(self, reason: str):
        super().__init__("the loop of the exported controller is not proved stable", measured=reason)
        self.reason = reason


def gain_above_in_words(gain: float) -> str:
    """The largest bound of the loop gain from half the sample rate on, for a message."""
    return f"the bound of the loop gain from half the sample rate on is {gain:.3g}"


def bounds(axes: SampledAxes, only_stable: bool = False, settings: CoverSettings = CoverSettings()) -> Bounds:
    """Bounds of the loop with the emitted numbers; first the conditions of the stability proof, the cheapest first.

    Parameters
    ----------
    only_stable : stop as soon as that proof cannot succeed.

    Raises
    ------
    StabilityNotProvedError : only with `only_stable`.
    ComputationError : a nominal closed loop that is unstable with the design's controller, or a gain without a bound.
    """
    folder, design = axes.folder, axes.folder.design
    plant, K = folder.plant, folder.controller(axes.controller.name)
    K = balanced(K)
    grid = Grid.of(axes.half_rate, settings)
    gains = _gain(K, grid.centre)
    least = max(settings.least * float(gains[-1]), settings.least_of_all * float(np.max(gains)))
    W_a = _cover(
        grid, _controller_error(axes, K, least, grid, settings), np.full(grid.centre.size, settings.harmless), settings
    )
    # Bounds of the table between frequencies take minutes if it has many blocks; at a few frequencies, seconds.
    if only_stable and not (at_least := _gain_above_at_least(axes, K, least, W_a, settings)) < 1 + ANALYSIS.slack:
        raise StabilityNotProvedError(
            "the bound of the loop gain from half the sample rate on is at least "
            f"{at_least:.3g}; the proof needs less than 1"
        )
    table = plant.synthesis.P.select(plant.synthesis.y, plant.synthesis.u)
    W_E = _cover(
        grid, axes.folding(grid.centre, grid.half), settings.harmless_images * _gain(table, grid.centre), settings
    )
    errors = Errors(K, least, W_a, W_E)
    gain_above = _gain_above(axes, errors, settings)
    if only_stable and not gain_above < 1:
        raise StabilityNotProvedError(gain_above_in_words(gain_above))
    below = (0.0, axes.half_rate)
    performance, blocks = errors.closed(plant.synthesis)
    motion, _ = errors.closed(plant.full.restricted(plant.floor_velocities, plant.velocities))
    if not performance.is_stable():
        raise ComputationError(
            "the closed loop of the design's controller is unstable with the nominal plant",
            cause="files of different designs in one folder",
            next_step="run avis design again",
        )
    whole = blocks.with_performance(len(plant.synthesis.w), len(plant.synthesis.z))
    low, high = (2 * np.pi * f for f in design.transmissibility.band_Hz)
    # One proof of robust stability serves all gains: the additional channels do not change the loop of the blocks.
    robust = stability_bound(motion.select(range(blocks.n_z), range(blocks.n_w)), blocks)
    if only_stable and (largest := float(np.max(robust.upper_curve, initial=robust.lower))) >= 1 + ANALYSIS.slack:
        raise StabilityNotProvedError(
            "mu of the uncertainty together with the sampling errors is at least "
            f"{robust.lower:.4g} and bounded by {largest:.4g} only; the proof needs less "
            "than 1"
        )

    def worst(system: StateSpace, band: tuple[float, float] = below, points: int = settings.few_points) -> MuPeak:
        return worst_case_gain(system, blocks, band=band, slack=ANALYSIS.slack, robust=robust, points=points)

    in_band = low, min(high, axes.half_rate)
    from_below, from_above = _between_samples(axes, errors, grid, settings)
    mu, peak, band, *between = each(
        lambda one: one(),
        [
            lambda: mu_peak(performance, whole, band=below, slack=ANALYSIS.slack),
            lambda: worst(motion, points=settings.points),
            lambda: worst(motion, in_band),
            lambda: worst(from_below),
            lambda: worst(from_above),
        ],
    )
    all_times, above = (one.upper if one.guaranteed else np.inf for one in between)
    return Bounds(mu, peak, band, all_times, above + axes.passive_above(), gain_above)


def _controller_error(
    axes: SampledAxes, K: StateSpace, least: float, grid: Grid, settings: CoverSettings
) -> np.ndarray:
    """(n,) bound of the emitted controller's error relative to [K; least I], over each interval."""
    error, remainder = axes.controller_error(K, least, grid.centre, grid.half)
    allowed = np.maximum(settings.harmless, settings.remainder * (error - remainder))
    parts = np.clip(np.ceil(np.sqrt(remainder / allowed)), 1, settings.divisions).astype(int)
    again = np.flatnonzero(parts > 1)
    if again.size:
        finer = Grid(grid.centre[again], grid.half[again]).divided(parts[again])
        bound, _ = axes.controller_error(K, least, finer.centre, finer.half)
        error[again] = np.maximum.reduceat(bound, np.cumsum(parts[again]) - parts[again])
    return error


def _gain_above(axes: SampledAxes, errors: Errors, settings: CoverSettings) -> float:
    """Largest bound of the loop gain, both errors included, at `intervals` frequencies from half the sample rate on. It
    is not proved between and beyond them (docs/export.md)."""
    omega = np.geomspace(1.0, settings.beyond, settings.intervals) * axes.half_rate
    size = _emitted_gain(errors.K, errors.least, errors.W_a, omega)
    table = axes.force_to_seen(omega)
    table[0] += errors.W_E.magnitude(omega[:1])[0]  # the images belong to half the rate itself
    return float(np.max(size * table))


def _gain_above_at_least(
    axes: SampledAxes, K: StateSpace, least: float, W_a: Rational, settings: CoverSettings
) -> float:
    """A lower bound of `_gain_above`, up to the accuracy of the optimised bounds: at some of its frequencies, and with
    only the nearest image at half the rate."""
    omega = np.geomspace(1.0, settings.beyond, settings.intervals) * axes.half_rate
    omega = omega[:: (settings.intervals - 1) // (settings.first_points - 1)]
    table = axes.force_to_seen_at(omega)
    table[0] *= 2
    return float(np.max(_emitted_gain(K, least, W_a, omega) * table))


def _emitted_gain(K: StateSpace, least: float, W_a: Rational, omega: np.ndarray) -> np.ndarray:
    """(n_omega,) bound of the gain of the emitted controller."""
    size = _gain(K, omega)
    return size + W_a.magnitude(omega) * np.hypot(size, least)


def _between_samples(
    axes: SampledAxes, errors: Errors, grid: Grid, settings: CoverSettings
) -> tuple[StateSpace, StateSpace]:
    """The lifted loops from the floor up to half the sample rate, and from the floor above it, to all payload motion.

    The held forces move the payload above half the rate by at most W_v times their r.m.s. Floor motion there acts on
    the samples like a seen velocity of at most W_f times its r.m.s.; in addition, the payload follows it as without
    control.
    """
    plant = axes.folder.plant
    part = plant.full.restricted(plant.floor_velocities, plant.velocities)
    held, folded = axes.held_images(grid.centre, grid.half), axes.folded_floor(grid.centre, grid.half)
    W_v = _cover(grid, held, settings.harmless_images * np.full(held.size, np.max(held)), settings)
    W_f = _cover(grid, folded, settings.harmless_images * np.full(folded.size, np.max(folded)), settings)
    motion, blocks = errors.closed(part, W_v, W_f)
    n_w, n_d = blocks.n_w, len(part.w)
    first, second = (
        motion.select(None, [*range(n_w), *inputs])
        for inputs in (range(n_w, n_w + n_d), range(n_w + n_d, motion.ninputs))
    )
    return first, second


def _gain(system: StateSpace, omega: np.ndarray) -> np.ndarray:
    """(n_omega,) largest singular values."""
    return np.linalg.norm(system.frequency_response(omega), ord=2, axis=(1, 2))


def _cover(grid: Grid, error: np.ndarray, harmless: np.ndarray, settings: CoverSettings) -> Rational:
    """A filter with |W| >= error over all intervals, of the lowest order that is close to it where it matters."""
    lower = np.maximum(error, np.finfo(float).tiny)
    upper = np.maximum(lower, harmless)
    # Corners may lie a factor `reach` outside the fitted frequencies; the lowest is still far above the width of the
    # first intervals.
    reach = 10.0
    every = slice(int(np.searchsorted(grid.centre, settings.lowest * grid.centre[-1])), None, settings.fitted)
    # Above half the rate there is no error to cover. The filter must not rise there, because it still enters the proof
    # of robust stability, but it may fall.
    end = grid.centre[-1]
    omega = np.concatenate([grid.centre[every], np.geomspace(1.1, settings.beyond, settings.points_beyond) * end])
    most = np.concatenate([upper[every], np.full(settings.points_beyond, upper[-1])])
    least = np.concatenate([lower[every], np.full(settings.points_beyond, upper[-1] / settings.beyond)])
    best = None
    for fit in covering_fits(omega, least, most, range(settings.most + 1), reach=reach):
        if best is None or fit.error_max_dB < best.error_max_dB:
            best = fit
        if fit.error_max_dB <= settings.excess_dB:
            break
    assert best is not None
    W = best.function
    slope, _ = log_slopes([*W.zeros(), *W.poles()], grid.centre, grid.half)
    reached = W.magnitude(grid.centre) * np.exp(-grid.half * slope)
    return W.scaled(max(1.0, float(np.max(lower / reached))))
