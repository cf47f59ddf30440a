"""Proof of upper bounds of mu between frequencies, from the imaginary eigenvalues of a Hamiltonian matrix.

For N(s) = D + C inv(sI - A) B and constant scalings X, G the function

    Phi(omega) = X_w - N^H X_z N - j (G N - N^H G^H) = [.]^H [Q S; S^H R] [inv(j omega I - A) B; I],
    Q = -C^H X_z C,   S = C^H (j G^H - X_z D),   R = X_w - D^H X_z D - j (G D - D^H G^H),

is singular only where j omega is an eigenvalue of

    H = [A - B inv(R) S^H,  -B inv(R) B^H;  S inv(R) S^H - Q,  S inv(R) B^H - A^H]

(Zhou, Doyle and Glover, Robust and Optimal Control, 1996, chapter 13; here with complex weights). If Phi > 0 at one
frequency, then Phi > 0 on the whole interval between the neighbouring eigenvalues. Intervals that cover the band prove
mu <= 1 at every frequency of the band, not only at the computed frequencies.

Round-off: the two crossings of a narrow peak that hardly exceeds the level are nearly a double eigenvalue, which is
accurate to the square root of the precision only, while the mean of the two is accurate. Phi is therefore also tested
between neighbouring crossings and near every pole. A band around a pole where the response itself is round-off is not
proved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.linalg as la

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_lmi import Array, LmiScalings, dagger, residual, selected
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
    beside : tested frequencies near a pole, as its frequency plus these multiples of its real part [1]: the top and the
        flanks of its resonance.
    response_error : relative error of the response by round-off [1] from which the frequencies around a pole are not
        proved: three digits of mu.
    """

    narrow: float = 1e-6
    patience: int = 250
    widenings: int = 5
    beside: tuple[float, ...] = (-1.0, -0.5, 0.0, 0.5, 1.0)
    response_error: float = 5e-4


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


def near_poles(poles: Array) -> Array:
    """Frequencies [rad/s] >= 0 at the top and on the flanks of the resonances."""
    return np.abs(np.multiply.outer(SETTINGS.beside, poles.real) + poles.imag).ravel()


def proved_intervals(N: StateSpace, scalings: LmiScalings, inside: Interval, also: Array) -> list[Interval]:
    """Closed parts of an interval on which Phi > 0 with the given scalings. also : further frequencies [rad/s] that are
    tested, such as those of `near_poles`."""
    low, high = inside
    crossings = possible_crossings(N, scalings)
    tested = np.unique(np.concatenate([crossings, (crossings[1:] + crossings[:-1]) / 2, also]))
    edges = np.concatenate([[low], tested[(tested > low) & (tested < high)], [high]])
    middles = np.array([midpoint(a, b) for a, b in pairwise(edges.tolist())])
    at_edge, between = np.split(_positive(N, scalings, np.concatenate([edges, middles])), [edges.size])
    parts: list[Interval] = []
    start = None
    for k in range(middles.size):
        # Phi is singular at a true crossing; if it is positive at an edge, there is no crossing.
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
    """Proof of a level on a band: the level reached, the remaining gaps, and the frequencies where it was raised.

    scaled : function of a level, the system whose mu must be at most 1 for the level to be valid, with the blocks of
        `structure`.
    bound : function of responses of N, the level that scalings shared along axis 1 of M (B, n_shared, n_z, n_w) prove.
    intervals : number of intervals proved. looked : gaps processed since the level was last raised because of their
        number; widened : how often it was raised.
    """

    N: StateSpace
    structure: BlockStructure
    scaled: Callable[[float], StateSpace]
    bound: Callable[[Array], Array]
    level: float
    slack: float
    gaps: list[Interval] = field(default_factory=list)
    raised_at: list[float] = field(default_factory=list)
    intervals: int = 0
    looked: int = 0
    widened: int = 0

    def run(self, band: Interval, samples: Array, rounds: int = 60, most: int = 1500) -> Cover:
        """Prove the level on a band, which is first split at `samples`, and raise it if the bound of a gap requires it.

        The level is raised to the required level plus the fraction `slack`; if it needs too many intervals, it is
        raised by `slack`, then by twice, four times .. `slack`. Gaps that are not proved within `rounds` rounds or
        `most` gaps stay in `gaps`.
        """
        samples = samples[(samples >= band[0]) & (samples <= band[1])]
        edges = np.unique(np.concatenate([[band[0]], samples, [band[1]]]))
        self.gaps = list(pairwise(edges.tolist()))
        total = 0
        for _ in range(rounds):
            total += len(self.gaps)
            self.looked += len(self.gaps)
            if not self.gaps or total > most or not np.isfinite(self.level):
                break
            if self.looked > SETTINGS.patience and self.widened < SETTINGS.widenings:
                self.level *= 1 + self.slack * 2.0**self.widened
                self.looked, self.widened = 0, self.widened + 1
            self._one_round()
        self.gaps += doubtful(self.N.A, self._poles, band)
        return self

    @cached_property
    def _poles(self) -> Array:
        """Poles of N in the upper half plane."""
        poles = self.N.poles() if self.N.nstates else np.zeros(0, complex)
        return poles[poles.imag >= 0]

    def _one_round(self) -> None:
        unit = self.scaled(self.level)
        gaps, self.gaps = self.gaps, []
        shared = bound_for_goal(_in_gaps(unit, gaps), self.structure, accuracy_of(self.slack), 1.0)
        open_gaps = []
        for k, gap in enumerate(gaps):
            if shared.beta[k] >= 1.0:
                open_gaps.append(gap)
                continue
            self.intervals += 1
            self.gaps += _without(
                gap, proved_intervals(unit, selected(shared.scalings, k), gap, near_poles(self._poles))
            )
        if open_gaps:
            self._split_or_raise(unit, open_gaps)

    def _split_or_raise(self, unit: StateSpace, open_gaps: list[Interval]) -> None:
        """Halve the gaps; raise the level if a single frequency in a gap (or a gap too narrow to halve) requires it.

        unit : N scaled so that the level is one.
        """
        middles = np.array([midpoint(*gap) for gap in open_gaps])
        M = unit.frequency_response(middles)[:, None]
        above = middles[bound_for_goal(M, self.structure, accuracy_of(self.slack), 1.0).beta >= 1.0]
        needed = self.bound(self.N.frequency_response(above)[:, None]) if above.size else above
        narrow = [gap for gap in open_gaps if _is_narrow(gap)]
        for (low, high), middle in zip(open_gaps, middles.tolist(), strict=True):
            self.gaps += [(low, high)] if _is_narrow((low, high)) else [(low, middle), (middle, high)]
        if narrow:
            needed = np.concatenate([needed, self.bound(_in_gaps(self.N, narrow))])
            above = np.concatenate([above, [midpoint(*gap) for gap in narrow]])
        if needed.size and needed[worst := int(np.argmax(needed))] > self.level:
            self.level = float(needed[worst]) * (1 + self.slack)
            self.raised_at.append(float(above[worst]))


def distance_to_singular(points: Array, A: Array) -> Array:
    """(k,) smallest singular value of s I - A at points s (k,): the norm of the smallest change of A that moves a pole
    there."""
    return np.asarray(np.linalg.svd(points[:, None, None] * np.eye(len(A)) - A, compute_uv=False)[:, -1])


def doubtful(A: Array, poles: Array, band: Interval) -> list[Interval]:
    """Parts of a band around poles where the relative error of the response by round-off may be too large: the
    backward error n eps |A| of a solution of n equations over the smallest singular value of j omega I - A."""
    if not poles.size:
        return []
    error = len(A) * np.finfo(float).eps * np.linalg.norm(A, 2) / SETTINGS.response_error
    poor = poles[distance_to_singular(1j * poles.imag, A) < error]
    ends = poor.imag + np.multiply.outer([-1, 1], np.abs(poor.real))
    return [(low, high) for low, high in np.clip(ends, *band).T.tolist() if low < high]


def _in_gaps(N: StateSpace, gaps: list[Interval]) -> Array:
    """Responses (n, 4, n_z, n_w) at both ends of each gap, in its middle, and in between."""
    omega = np.array(
        [(low, middle, midpoint(low, middle), high) for low, high in gaps for middle in [midpoint(low, high)]]
    )
    return N.frequency_response(omega.ravel()).reshape(*omega.shape, N.noutputs, N.ninputs)


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
