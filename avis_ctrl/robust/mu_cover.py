"""Proof of upper bounds of mu between frequencies, from the imaginary eigenvalues of a Hamiltonian matrix.

For N(s) = D + C inv(sI - A) B and constant scalings X, G the function

    Phi(omega) = X_w - N^H X_z N - j (G N - N^H G^H) = [.]^H [Q S; S^H R] [inv(j omega I - A) B; I],
    Q = -C^H X_z C,   S = C^H (j G^H - X_z D),   R = X_w - D^H X_z D - j (G D - D^H G^H),

is singular only where j omega is an eigenvalue of

    H = [A - B inv(R) S^H,  -B inv(R) B^H;  S inv(R) S^H - Q,  S inv(R) B^H - A^H]

(Zhou, Doyle and Glover, Robust and Optimal Control, 1996, chapter 13; here with complex weights). If Phi > 0 at one
frequency, then Phi > 0 on the whole interval between the neighbouring eigenvalues. Intervals that cover the band prove
mu <= 1 at every frequency of the band, not only at the computed frequencies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy.linalg as la

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_lmi import Array, LmiScalings, dagger, residual
from avis_ctrl.robust.mu_upper import bound_for_goal
from avis_ctrl.uncertainty.blocks import BlockStructure

Interval = tuple[float, float]


@dataclass(frozen=True)
class IntervalSettings:
    """narrow : width of a gap relative to its frequency [1] below which it is not halved again, since the response is
        constant in it.
    patience : number of gaps at one level from which mu counts as flat: a slightly higher level needs far fewer
        intervals.
    widenings : how often the level is raised for that reason: by 31 times the slack in all.
    """

    narrow: float = 1e-6
    patience: int = 250
    widenings: int = 5


SETTINGS = IntervalSettings()


def midpoint(low: float, high: float) -> float:
    """A frequency between two frequencies: geometric mean, or half or double if one of them is 0 or inf."""
    if low == 0.0:
        return 1.0 if np.isinf(high) else high / 2
    return 2 * low if np.isinf(high) else float(np.sqrt(low) * np.sqrt(high))


def possible_crossings(N: StateSpace, scalings: LmiScalings) -> Array:
    """Sorted superset of the frequencies [rad/s] >= 0 where Phi is singular. The scalings have no batch axis."""
    if not N.nstates:
        return np.zeros(0)
    X_z, X_w, G = scalings
    A, B, C, D = N.A, N.B, N.C, N.D
    if not np.any(G) and not np.any(X_z.imag) and not np.any(X_w.imag):
        X_z, X_w = X_z.real, X_w.real
        R, S = X_w - D.T @ X_z @ D, -C.T @ X_z @ D
    else:
        GD = G @ D
        R, S = X_w - D.T @ X_z @ D - 1j * (GD - dagger(GD)), C.T @ (1j * dagger(G) - X_z @ D)
    RB, RS = np.linalg.solve(R, B.T), np.linalg.solve(R, dagger(S))
    F, BRB = A - B @ RS, B @ RB
    Q = S @ RS + C.T @ X_z @ C
    size_b, size_q = np.linalg.norm(BRB), np.linalg.norm(Q)
    # Off-diagonal blocks of equal norm, so that the eigenvalue computation does not mix magnitudes.
    t = np.sqrt(size_q / size_b) if size_b > 0 and size_q > 0 else 1.0
    H = np.block([[F, -t * BRB], [Q / t, -dagger(F)]])
    values = la.eigvals(H, check_finite=False)
    size = np.max(np.abs(values))
    near = np.abs(values.real) <= 1e-3 * np.abs(values) + 1e-10 * size
    return np.unique(np.abs(values.imag[near & (values.imag >= -1e-10 * size)]))


def _positive(N: StateSpace, scalings: LmiScalings, omega: Array) -> Array:
    """Whether Phi(omega) > 0 at each frequency, with a round-off margin; not at a pole."""
    M = N.frequency_response(omega)[:, None]
    finite = np.isfinite(M).all(axis=(1, 2, 3))
    M = np.where(finite[:, None, None, None], M, 0.0)
    repeated = LmiScalings(*(np.broadcast_to(s, (omega.size, *s.shape)) for s in scalings))
    level = np.ones(N.ninputs, bool)
    F = residual(M, repeated, np.ones(omega.size), level)[:, 0]
    root = np.linalg.inv(np.linalg.cholesky(scalings.X_w))
    return finite & (np.linalg.eigvalsh(root @ F @ dagger(root))[:, 0] > 1e-10)


def proved_intervals(N: StateSpace, scalings: LmiScalings, inside: Interval) -> list[Interval]:
    """Closed parts of an interval on which Phi > 0 with the given scalings."""
    low, high = inside
    crossings = possible_crossings(N, scalings)
    crossings = crossings[(crossings > low) & (crossings < high)]
    edges = np.concatenate([[low], crossings, [high]])
    middles = np.array([midpoint(a, b) for a, b in pairwise(edges.tolist())])
    at_edge, between = np.split(_positive(N, scalings, np.concatenate([edges, middles])), [edges.size])
    parts: list[Interval] = []
    start = None
    for k in range(middles.size):
        # Phi is singular at a true crossing; if it is positive at an edge, the eigenvalue is only near the axis.
        if not between[k]:
            start = None
            continue
        if start is None:
            start = edges[k] if at_edge[k] else middles[k]
        if not at_edge[k + 1] or k + 1 == middles.size:
            end = edges[k + 1] if at_edge[k + 1] else middles[k]
            if end > start:
                parts.append((float(start), float(end)))
            start = None
    return parts


@dataclass
class Cover:
    """Result: the level reached, the remaining gaps, and the frequencies where the level was raised.

    looked : gaps processed since the level was last raised because of their number; widened : how often it was raised.
    """

    level: float
    gaps: list[Interval] = field(default_factory=list)
    raised_at: list[float] = field(default_factory=list)
    intervals: int = 0
    looked: int = 0
    widened: int = 0


def cover(
    N: StateSpace,
    structure: BlockStructure,
    scaled: Callable[[StateSpace, float], StateSpace],
    bound: Callable[[Array], Array],
    level: float,
    band: Interval,
    samples: Array,
    *,
    slack: float,
    rounds: int = 60,
    most: int = 1500,
) -> Cover:
    """Prove a level on a whole band, and raise it if the bound of a gap requires a higher level.

    scaled(N, level) is the system whose mu must be at most 1 for the level to be valid; bound(M) gives the level that
    scalings shared along axis 1 of M (B, n_shared, n_z, n_w) prove. The band is first split at `samples`. The level is
    raised to the required level plus the fraction `slack`; if it needs too many intervals, it is raised by `slack`,
    then by twice, four times .. `slack`. Gaps that are not proved within `rounds` rounds or `most` gaps stay in `gaps`.
    """
    state = Cover(level)
    samples = np.unique(samples[(samples >= band[0]) & (samples <= band[1])])
    edges = np.unique(np.concatenate([[band[0]], samples, [band[1]]]))
    state.gaps = list(pairwise(edges.tolist()))
    total = 0
    for _ in range(rounds):
        total += len(state.gaps)
        state.looked += len(state.gaps)
        if not state.gaps or total > most or not np.isfinite(state.level):
            break
        if state.looked > SETTINGS.patience and state.widened < SETTINGS.widenings:
            state.level *= 1 + slack * 2.0**state.widened
            state.looked, state.widened = 0, state.widened + 1
        _one_round(N, structure, scaled, bound, state, slack)
    return state


def _points(low: float, high: float) -> list[float]:
    middle = midpoint(low, high)
    return [low, middle, midpoint(low, middle), high]


def _one_round(
    N: StateSpace,
    structure: BlockStructure,
    scaled: Callable[[StateSpace, float], StateSpace],
    bound: Callable[[Array], Array],
    state: Cover,
    slack: float,
) -> None:
    unit = scaled(N, state.level)
    gaps, state.gaps = state.gaps, []
    omega = np.array([_points(*gap) for gap in gaps])
    M = unit.frequency_response(omega.ravel()).reshape(*omega.shape, unit.noutputs, unit.ninputs)
    shared = bound_for_goal(M, structure, accuracy_of(slack), 1.0)
    open_gaps = []
    for k, gap in enumerate(gaps):
        if shared.beta[k] >= 1.0:
            open_gaps.append(gap)
            continue
        state.intervals += 1
        proved = proved_intervals(unit, LmiScalings(*(s[k] for s in shared.scalings)), gap)
        state.gaps += _without(gap, proved)
    if open_gaps:
        _split_or_raise(N, unit, structure, bound, state, open_gaps, slack)


def _split_or_raise(
    N: StateSpace,
    unit: StateSpace,
    structure: BlockStructure,
    bound: Callable[[Array], Array],
    state: Cover,
    open_gaps: list[Interval],
    slack: float,
) -> None:
    """Halve the gaps; raise the level if a single frequency in a gap (or a gap too narrow to halve) requires it.

    unit : N scaled so that the level is one.
    """
    middles = np.array([midpoint(*gap) for gap in open_gaps])
    at_one = bound_for_goal(unit.frequency_response(middles)[:, None], structure, accuracy_of(slack), 1.0).beta
    above = middles[at_one >= 1.0]
    needed = bound(N.frequency_response(above)[:, None]) if above.size else above
    narrow = [gap for gap in open_gaps if _is_narrow(gap)]
    for (low, high), middle in zip(open_gaps, middles.tolist(), strict=True):
        state.gaps += [(low, high)] if _is_narrow((low, high)) else [(low, middle), (middle, high)]
    middles = above
    if narrow:
        points = np.array([_points(*gap) for gap in narrow])
        raw = N.frequency_response(points.ravel()).reshape(*points.shape, N.noutputs, N.ninputs)
        shared = bound(raw)
        needed, middles = np.concatenate([needed, shared]), np.concatenate([middles, points[:, 1]])
    if not needed.size:
        return
    worst = int(np.argmax(needed))
    if needed[worst] > state.level:
        state.level = float(needed[worst]) * (1 + slack)
        state.raised_at.append(float(middles[worst]))


def accuracy_of(slack: float) -> float:
    """Accuracy of lambda = beta^2 that is appropriate for a slack of beta."""
    return max(slack / 5, 1e-4)


def _is_narrow(gap: Interval) -> bool:
    # A gap that ends at 0 or infinity is halved (doubled) until the response there has settled.
    return np.isfinite(gap[1]) and gap[1] - gap[0] <= SETTINGS.narrow * gap[1]


def _without(gap: Interval, parts: list[Interval]) -> list[Interval]:
    """The rest of a gap without the parts; a rest that is almost the whole gap is halved, so that progress is made."""
    left, at = [], gap[0]
    for low, high in parts:
        if low > at:
            left.append((at, low))
        at = high
    if gap[1] > at:
        left.append((at, gap[1]))
    middle = midpoint(*gap)
    halved: list[Interval] = []
    for low, high in left:
        almost = low < midpoint(gap[0], middle) and high > midpoint(middle, gap[1])
        halved += [(low, middle), (middle, high)] if almost else [(low, high)]
    return halved
