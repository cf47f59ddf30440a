"""Peak over frequency of the structured singular value, and of the worst-case gain.

             Delta <--.
        w |           | z          mu_peak:          sup over omega of mu(N(j omega))
          '--> [ N ] -'            worst_case_gain:  sup over omega and ||Delta|| <= 1 of
        d ---> [   ] ---> e                          sigma_max of the map from d to e

The upper bound is also proved between the computed frequencies (see `mu_cover`), or the result states that it is not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, balance
from avis_ctrl.lti.bilinear import continuous_image, image_frequency, sampled_frequency
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.robust.mu_coupled import Coupled, coupled
from avis_ctrl.robust.mu_cover import Cover, Interval, accuracy_of, distance_to_singular
from avis_ctrl.robust.mu_gain import WorstGain, with_neighbours, worst_gain
from avis_ctrl.robust.mu_lmi import Array, joined, selected
from avis_ctrl.robust.mu_lower import SETTINGS as LOWER
from avis_ctrl.robust.mu_lower import MuLowerBound, lower_bound, singular_frequency
from avis_ctrl.robust.mu_scan import first_frequencies, refine_maxima
from avis_ctrl.robust.mu_upper import UpperBound, bound_of_peak, skewed_upper_bound, upper_bound
from avis_ctrl.robust.one_thread import one_thread
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.blocks import Block, BlockStructure

ALL_FREQUENCIES: Interval = (0.0, np.inf)


@dataclass(frozen=True)
class PeakSettings:
    """slack : relative amount [1] by which the level to be proved exceeds the highest value found: three digits of mu.
    known_slack : a bound that the caller has proved replaces the proof if it exceeds this level by a smaller fraction
        [1]: a proof takes long and would gain less.
    points : number of evenly chosen frequencies of a curve if its bounds take long: enough for a plot.
    highest : number of highest values whose frequencies are added; the peak is refined from these.
    round_off : relative change of A [1] that counts as round-off: a few rounding errors of the eigenvalues.
    near : distance of a pole from the limit of stability, over the norm of A [1], below which this is tested. Round-off
        moves a double pole by its square root (1e-8), a triple pole by its cube root (1e-5).
    """

    slack: float = 5e-4
    known_slack: float = 5e-3
    points: int = 40
    highest: int = 4
    round_off: float = 1e-15
    near: float = 1e-5


SETTINGS = PeakSettings()


@dataclass(frozen=True, eq=False, repr=False)
class MuPeak(Shown):
    """Bounds of a supremum over frequency.

    upper : never exceeded in the band if `guaranteed`; otherwise proved at the computed frequencies only.
    lower : attained at `omega` [rad/s] by `delta`.
    delta : (n_w, n_z). For mu_peak ||delta|| = 1/lower and I - N(j omega) delta is singular; for worst_case_gain
        (without the performance block) ||delta|| <= 1. None if none was found (lower 0).
    covers : description of the range where the upper bound is proved.
    frequencies, upper_curve, lower_curve : (n,) [rad/s] and both bounds there, for plotting; about 40 frequencies with
        many blocks.
    """

    upper: float
    lower: float
    omega: float
    delta: Array | None
    guaranteed: bool
    covers: str
    frequencies: Array
    upper_curve: Array
    lower_curve: Array


# Result of a search at some frequencies: bounds with their proofs.
Found = TypeVar("Found", UpperBound, WorstGain)


def mu_peak(
    N: StateSpace,
    blocks: BlockStructure | Sequence[Block],
    *,
    band: Interval = ALL_FREQUENCIES,
    known_upper: float | None = None,
    slack: float = SETTINGS.slack,
) -> MuPeak:
    """Supremum of mu(N(j omega)) over a band, by default all frequencies including 0 and infinity.

    Parameters
    ----------
    N : stable system (avis_ctrl or python-control) with sum(cols) outputs z and sum(rows) inputs w.
    band : (low, high) in rad/s; the Nyquist frequency replaces infinity for sampled systems.
    known_upper : a bound that the caller has proved for the whole band, such as the measured norm of the loop scaled
        by a realised D(s); if it is within 0.5 % of the level to be proved, it is used as the upper bound without
        another proof, and `guaranteed` is true if the caller's bound is.
    slack : relative amount by which the level to be proved exceeds the highest value found; a larger slack needs fewer
        intervals. If mu is flat over frequency, the level is raised further (see `mu_cover`).

    Raises
    ------
    InputError : blocks that do not fit N, an empty band, a slack outside 1e-5 to 0.1.
    ComputationError : N has an unstable pole (named): mu is not defined for such a loop.

    Examples
    --------
    A loop with 25 k/(s^3 + 10 s^2 + 10 s + 10), stable for -0.4 < k < 3.6 (Routh), k = 1 +- 20 %:

    >>> loop = (ac.real("k", 1.0, percent=20) * ac.tf([25.0], [1.0, 10.0, 10.0, 10.0])).feedback()
    >>> P, blocks = loop.lft()
    >>> peak = ac.mu_peak(P.select(slice(1), slice(1)), blocks)
    >>> round(peak.lower, 3), round(1 / peak.lower, 3), peak.guaranteed        # k = 1 - 7 * 0.2
    (0.143, 7.0, True)
    """
    system, structure = _checked(N, blocks, slack)
    if (system.noutputs, system.ninputs) != (structure.n_z, structure.n_w):
        raise InputError(
            f"the blocks need {structure.n_z} outputs and {structure.n_w} inputs, N has "
            f"{system.noutputs} and {system.ninputs}",
            field="blocks",
        )
    with one_thread():
        part = _prepared(system, structure)
        found = _mu_peak(part.N, part.structure, _continuous_band(system, band), slack, known_upper, system.dt)
        return _in_rad_s(system, part, found)


def worst_case_gain(
    N: StateSpace,
    blocks: BlockStructure | Sequence[Block],
    *,
    band: Interval = ALL_FREQUENCIES,
    slack: float = SETTINGS.slack,
    robust: MuPeak | None = None,
    points: int = SETTINGS.points,
) -> MuPeak:
    """Largest gain from the inputs d to the outputs e of N over all perturbations of norm at most 1.

    Parameters
    ----------
    N : stable system; the first sum(cols) outputs and sum(rows) inputs belong to the blocks, the rest are e and d.
    band : (low, high) in rad/s, for the gain; robust stability is required at all frequencies.
    slack : as for mu_peak.
    robust : bounds of `mu_peak` for the channels of the blocks at all frequencies, if known; otherwise computed.
    points : number of frequencies of the two curves, in addition to those of the highest gains; fewer take less time.

    upper is inf if robust stability is not proved; lower is inf if `delta` (norm at most 1) destabilises the loop.

    Raises
    ------
    InputError : no performance channel besides the blocks, an empty band, a slack outside 1e-5 to 0.1.
    ComputationError : N has an unstable pole (named).
    """
    system, structure = _checked(N, blocks, slack)
    n_d, n_e = system.ninputs - structure.n_w, system.noutputs - structure.n_z
    if n_d < 1 or n_e < 1:
        raise InputError(
            f"the blocks take {structure.n_z} outputs and {structure.n_w} inputs of N's "
            f"{system.noutputs} and {system.ninputs}: no performance channel is left",
            field="blocks",
        )
    with one_thread():
        part = _prepared(system, structure)
        inside = _continuous_band(system, band)
        if robust is None or robust.lower < 1.0:
            found = _worst_case_gain(part.N, part.structure, inside, slack, system.dt, robust, points)
            return _in_rad_s(system, part, found)
        found = _destabilised(part.N, part.structure, robust, first_frequencies(part.N, inside))
        # Frequency and perturbation of `robust` already refer to the whole system.
        return replace(_in_rad_s(system, part, replace(found, delta=None)), omega=robust.omega, delta=robust.delta)


def stability_bound(N: StateSpace, blocks: BlockStructure | Sequence[Block]) -> MuPeak:
    """Bounds of mu at all frequencies, only as tight as needed to prove robust stability: if mu < 1, the upper bound is
    just below 1, and there is no lower bound. For several calls of `worst_case_gain` with one loop.

    Raises
    ------
    InputError, ComputationError : as in mu_peak.
    """
    system, structure = _checked(N, blocks, SETTINGS.slack)
    with one_thread():
        part = _prepared(system, structure)
        done = _stable_cover(part.N, part.structure)
        if not done.gaps and done.level < 1.0:
            none = np.zeros(0)
            return MuPeak(
                done.level, 0.0, 0.0, None, True, _in_words(done, ALL_FREQUENCIES, system.dt), none, none, none
            )
        return _in_rad_s(system, part, _mu_peak(part.N, part.structure, ALL_FREQUENCIES, SETTINGS.slack, dt=system.dt))


def _checked(
    N: StateSpace, blocks: BlockStructure | Sequence[Block], slack: float
) -> tuple[StateSpace, BlockStructure]:
    """N as a stable system of this package, and its blocks."""
    if not 1e-5 <= slack <= 0.1:
        raise InputError("expected 1e-5 to 0.1", field="slack", value=slack)
    N = as_system(N, "N")
    if (pole := _not_stable(N)) is not None:
        raise ComputationError(
            "the bounds of mu need a stable system",
            measured=f"pole {pole:.6g}",
            cause="the nominal closed loop is unstable, or has a mode at the limit of stability that the controller "
            "does not affect",
            next_step="stabilise the loop, or leave out the states of this mode if no output depends on them "
            "(avis_ctrl.lti.minimal; for free motion of a whole mechanism, use differences of positions as states)",
        )
    return N, BlockStructure.of(blocks)


def _not_stable(N: StateSpace) -> complex | None:
    """A pole that is unstable, or at the limit of stability up to round-off; None if there is none.

    At the limit: a change of A by round-off moves a pole to the nearest point s of the imaginary axis (unit circle).
    The smallest such change has the norm sigma_min(s I - A).
    """
    if not N.nstates:
        return None
    poles = N.poles()
    growth = np.abs(poles) - 1 if N.dt else poles.real
    worst = int(np.argmax(growth))
    if growth[worst] >= 0:
        return complex(poles[worst])
    A = la.matrix_balance(N.A, permute=False)[0]
    size = np.linalg.norm(A, 2)
    close = poles[(growth >= -SETTINGS.near * size) & (poles.imag >= 0)]
    points = close / np.abs(close) if N.dt else 1j * close.imag
    doubtful = close[distance_to_singular(points, A) <= SETTINGS.round_off * size]
    return complex(doubtful[np.argmax(doubtful.real)]) if doubtful.size else None


def _prepared(N: StateSpace, structure: BlockStructure) -> Coupled:
    """The blocks that are part of a loop, with a balanced continuous-time system."""
    part = coupled(N, structure)
    return replace(part, N=balance(continuous_image(part.N)))


def _continuous_band(N: StateSpace, band: Interval) -> Interval:
    low, high = float(band[0]), float(band[1])
    if not 0 <= low < high:
        raise InputError("expected 0 <= low < high in rad/s", field="band", value=band)
    if low * N.dt >= np.pi:
        raise InputError(
            f"expected a band that begins below half the sample rate, {np.pi / N.dt:.6g} rad/s",
            field="band",
            value=band,
        )
    return float(image_frequency(low, N.dt)), float(image_frequency(high, N.dt))


def _in_rad_s(N: StateSpace, part: Coupled, result: MuPeak) -> MuPeak:
    """The result with Delta of all blocks, and with frequencies of the bilinear image mapped to those of N."""
    result = replace(result, delta=part.restored(result.delta))
    return replace(
        result,
        omega=float(sampled_frequency(result.omega, N.dt)),
        frequencies=np.asarray(sampled_frequency(result.frequencies, N.dt)),
    )


def _searched(N: StateSpace, band: Interval, slack: float, look: Callable[[Array], Found]) -> tuple[Array, Found]:
    """Frequencies (n,) of a search for the highest values, in increasing order, and the results of look(M) there.

    look : function of responses M (m, n_out, n_in); the first item of its result are the values (m,).
    """
    seen: list[tuple[Array, Found]] = []

    def value(omega: Array) -> Array:
        found = look(N.frequency_response(omega))
        seen.append((omega, found))
        return found[0]

    first = first_frequencies(N, band)
    refine_maxima(value, first, value(first), tolerance=accuracy_of(slack))
    omega = np.concatenate([one for one, _ in seen])
    order = np.argsort(omega)
    return omega[order], selected(joined([found for _, found in seen]), order)


def _thinned(values: Array, most: int) -> Array:
    """Indices of at most `most` evenly spaced values, and of the largest values."""
    even = np.linspace(0, values.size - 1, min(most, values.size)).round().astype(int)
    return np.union1d(even, np.argsort(values)[-SETTINGS.highest :])


def _level(bounds: Array, slack: float) -> float:
    """The level to be proved, above the highest bound found."""
    # A level of zero cannot be proved; a small positive level allows a cover if mu vanishes identically.
    return max(float(np.max(bounds)) * (1 + slack), 1e-9)


def _mu_peak(
    N: StateSpace,
    structure: BlockStructure,
    band: Interval,
    slack: float,
    known_upper: float | None = None,
    dt: float = 0.0,
) -> MuPeak:
    """mu_peak of a continuous system, or of the image of a system sampled at dt."""
    accuracy = accuracy_of(slack)
    omega, bound = _searched(N, band, slack, lambda M: bound_of_peak(M[:, None], structure, accuracy))
    if structure.many:
        # The lower bounds of many blocks take long: only some frequencies, including those of the highest values.
        kept = _thinned(bound.beta, SETTINGS.points)
        omega, bound = omega[kept], selected(bound, kept)
    level, peak = _level(bound.beta, slack), omega[[int(np.argmax(bound.beta))]]
    # One stage is enough for the curve; the search continues at the peaks only.
    lower = lower_bound(N.frequency_response(omega), structure, *bound, enough=0.9, stages=1)
    done = _cover_mu(N, structure, level, accuracy, slack)
    given = None if known_upper is None or known_upper > (1 + SETTINGS.known_slack) * level else known_upper
    if given is None:
        done.run(band, peak)
    else:
        done.level = given
    # The proof finds resonances that are narrower than the spacing of the frequencies computed before.
    if (missed := np.setdiff1d(done.raised_at, omega)).size:
        more = bound_of_peak((M := N.frequency_response(missed))[:, None], structure, accuracy)
        lower = joined([lower, lower_bound(M, structure, *more, enough=0.9, stages=1)])
        omega, bound = np.concatenate([omega, missed]), joined([bound, more])
        order = np.argsort(omega)
        omega, bound, lower = omega[order], selected(bound, order), selected(lower, order)
    best, at, delta = _best_singular(N, structure, omega, bound, lower, done, band)
    if best > done.level:
        # mu of real blocks can jump at a single frequency outside any grid; the search with free frequency found one.
        done, given = _cover_mu(N, structure, best * (1 + slack), accuracy, slack).run(band, np.array([at])), None
    if best == 0.0:
        at = float(peak[0])
    words = f"{_span(band, dt)}: the bound that was given" if given is not None else _in_words(done, band, dt)
    return MuPeak(done.level, best, at, delta, not done.gaps, words, omega, bound.beta, lower.beta)


def _cover_mu(N: StateSpace, structure: BlockStructure, level: float, accuracy: float, slack: float) -> Cover:
    """Proof, to be run, that mu is below a level on intervals with constant scalings."""

    def bound(M: Array) -> Array:
        return upper_bound(M, structure, accuracy).beta

    return Cover(N, structure, lambda level: N.scaled(left=1 / level), bound, level, slack)


def _best_singular(
    N: StateSpace,
    structure: BlockStructure,
    omega: Array,
    found: UpperBound,
    lower: MuLowerBound,
    done: Cover,
    band: Interval,
) -> tuple[float, float, Array | None]:
    """Largest verified lower bound: thorough search at the highest peaks, with a free frequency for real blocks."""
    top = np.unique(np.concatenate([np.argsort(found.beta)[-3:], np.argsort(lower.beta)[-3:]]))
    M = N.frequency_response(omega[top])
    hard = lower_bound(M, structure, *selected(found, top), enough=0.995, seed=1)
    values = np.maximum(hard.beta, lower.beta[top])
    deltas = np.where((hard.beta >= lower.beta[top])[:, None, None], hard.delta, lower.delta[top])
    k = int(np.argmax(values))
    best, at, delta = float(values[k]), float(omega[top[k]]), deltas[k]
    if any(block.kind == "real" for block in structure.blocks) and best < 0.999 * done.level:
        near = np.concatenate([omega[top], done.raised_at])
        moved = singular_frequency(N, structure, near, done.level, band)
        if moved is not None and moved[0] > best:
            best, at, delta = moved
    noise = LOWER.round_off * float(np.max(np.linalg.norm(N.frequency_response(omega), 2, axis=(1, 2))))
    return (best, at, delta) if best > noise else (0.0, at, None)


def _worst_case_gain(
    N: StateSpace, structure: BlockStructure, band: Interval, slack: float, dt: float, known: MuPeak | None, points: int
) -> MuPeak:
    """worst_case_gain of a continuous system, or of the image of a system sampled at dt."""
    accuracy = accuracy_of(slack)
    n_z, n_w = structure.n_z, structure.n_w
    n_e = N.noutputs - n_z
    whole = structure.with_performance(N.ninputs - n_w, n_e)

    def scaled(level: float) -> StateSpace:
        return N.scaled(left=np.r_[np.ones(n_z), np.full(n_e, 1 / level)])

    def bound(M: Array) -> Array:
        return skewed_upper_bound(M, whole, accuracy).beta

    # Lower bounds are cheap and tight: they show where upper bounds are worth computing.
    searched, reached = _searched(N, band, slack, lambda M: worst_gain(M, structure))
    reached = with_neighbours(N.frequency_response(searched), reached, structure)
    kept = _thinned(reached.gain, points)
    omega, lower = searched[kept], reached.gain[kept]
    upper = bound(N.frequency_response(omega)[:, None])
    done = None
    proved = known is not None and known.guaranteed and known.upper < 1.0
    if np.all(np.isfinite(upper)) and (proved or _robustly_stable(N.select(range(n_z), range(n_w)), structure, band)):
        done = Cover(N, whole, scaled, bound, _level(upper, slack), slack).run(band, omega[[int(np.argmax(upper))]])
    if done is not None and np.isfinite(done.level):
        if (missed := np.setdiff1d(done.raised_at, searched)).size:
            M = N.frequency_response(missed)
            more = worst_gain(M, structure)
            searched, reached = np.concatenate([searched, missed]), joined([reached, more])
            order = np.argsort(np.concatenate([omega, missed]))
            omega, upper, lower = (
                np.concatenate(both)[order]
                for both in ((omega, missed), (upper, bound(M[:, None])), (lower, more.gain))
            )
        k = int(np.argmax(reached.gain))
        return MuPeak(
            done.level,
            float(reached.gain[k]),
            float(searched[k]),
            reached.delta[k],
            not done.gaps,
            _in_words(done, band, dt),
            omega,
            upper,
            lower,
        )
    robust = known or _robustness(N.select(range(n_z), range(n_w)), structure, slack)
    if robust.lower >= 1.0:
        return _destabilised(N, structure, robust, omega)
    gain, delta = _gain_of_stable(N.frequency_response(omega), structure, robust)
    k = int(np.argmax(gain))
    words = f"robust stability is not proved: mu of the blocks is between {robust.lower:.6g} and {robust.upper:.6g}"
    return MuPeak(np.inf, float(gain[k]), float(omega[k]), delta[k], True, words, omega, upper, gain)


def _destabilised(N: StateSpace, structure: BlockStructure, robust: MuPeak, omega: Array) -> MuPeak:
    """The result if a perturbation of norm at most 1 makes the loop unstable: the worst-case gain is infinite."""
    gain, _ = _gain_of_stable(N.frequency_response(omega), structure, robust)
    return MuPeak(
        np.inf,
        np.inf,
        robust.omega,
        robust.delta,
        True,
        "a perturbation of norm at most 1 makes the loop unstable",
        omega,
        np.full(omega.size, np.inf),
        gain,
    )


def _gain_of_stable(M: Array, structure: BlockStructure, robust: MuPeak) -> tuple[Array, Array]:
    """Worst gains (n,) and perturbations (n, n_w, n_z) at each frequency, of a norm that keeps the loop stable."""
    radius = min(1.0, (1 - 1e-9) / robust.upper) if robust.guaranteed else 0.0
    n_z = structure.n_z
    found = worst_gain(M * np.r_[np.full(n_z, radius), np.ones(M.shape[1] - n_z)][:, None], structure)
    return found.gain, radius * found.delta


def _robustness(N: StateSpace, structure: BlockStructure, slack: float) -> MuPeak:
    """Bounds of mu without the performance channel; blocks that are in a loop only through this channel are removed."""
    part = coupled(N, structure)
    found = _mu_peak(balance(part.N), part.structure, ALL_FREQUENCIES, slack)
    return replace(found, delta=part.restored(found.delta))


def _robustly_stable(N: StateSpace, structure: BlockStructure, band: Interval) -> bool:
    """Whether mu < 1 is proved at all frequencies; a cover of all frequencies with performance implies it."""
    if band == ALL_FREQUENCIES:
        return True
    done = _stable_cover(N, structure)
    return not done.gaps and done.level < 1.0


def _stable_cover(N: StateSpace, structure: BlockStructure) -> Cover:
    """Cover of all frequencies at a level just below 1, if it exists; otherwise with gaps or a higher level."""
    first = first_frequencies(N, ALL_FREQUENCIES, 0)
    return _cover_mu(N, structure, 1.0 - 1e-6, accuracy=1e-4, slack=0.0).run(ALL_FREQUENCIES, first)


def _in_words(done: Cover, band: Interval, dt: float) -> str:
    """Description of what was proved, in frequencies of the system (sampled at dt), not of its image."""
    span = _span(band, dt)
    if not done.gaps:
        return f"{span}: {done.intervals} intervals with constant scalings prove the upper bound between the points"
    shown = ", ".join(f"{sampled_frequency(a, dt):.6g} to {sampled_frequency(b, dt):.6g}" for a, b in done.gaps[:3])
    return (
        f"the frequencies computed within {span}; not proved in {len(done.gaps)} gaps ({shown} rad/s) at the "
        f"level {done.level:.6g}"
    )


def _span(band: Interval, dt: float) -> str:
    end = "half the sample rate" if dt else "infinity"
    low, high = sampled_frequency(band[0], dt), sampled_frequency(band[1], dt)
    return f"all frequencies from 0 to {end}" if band == ALL_FREQUENCIES else f"{low:g} to {high:g} rad/s"
