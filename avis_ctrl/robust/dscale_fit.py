"""LMI fit of a magnitude by a stable, minimum-phase d(s) with stable inverse, in the log-Chebyshev sense.

|d(j omega)|^2 = p(y) / q(y) with y = omega^2 and p, q polynomials of degree n that are positive on y >= 0.
For a given t the conditions

    1/t <= p / (q |d_k|^2) <= t   at the points,      p, q positive on the whole axis

are linear in (p, q) and in the Gram matrices of the sums of squares p = s0 + y s1 (Boyd and Vandenberghe,
Convex Optimization, sections 3.4.2 and 4.2.5; the certificate is that of Markov and Lukacs for a half line):
a semidefinite feasibility problem inside a bisection on log t. Spectral factorisation then takes the left
half plane roots of p(-s^2) and q(-s^2).

Eight decades of frequency are sixteen decades of y, for which monomials are hopelessly ill conditioned. The powers are
scaled by the coefficients of prod(y + |y_i|), with y_i the roots of the best fit so far. Every basis function is then a
bump of height at most one in log y, and the basis follows the solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import clarabel
import numpy as np
import scipy.sparse as sp

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.robust.scalings import ScalarScaling

Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class MagnitudeFitSettings:
    """positivity : minimum of p and q relative to prod(y + |y_i|) [1], which keeps zeros and poles away from the axis.
    slack : log t / weight [1] above which a point imposes no constraint in double precision.
    """

    positivity: float = 1e-7
    slack: float = 25.0


SETTINGS = MagnitudeFitSettings()


class Fit(NamedTuple, Generic[Fitted]):
    """A fitted scaling, with its error recomputed from the realised scaling.

    error : max over the points of weight |log(|d| / target)|; for a matrix, of weight |log eig(X^-1 D^H D)| / 2.
    error_bound : no scaling of this order (for a matrix, over a scalar denominator) has a smaller error, because the
        bisection proved it infeasible.
    """

    scaling: Fitted
    error: float
    error_bound: float


def fit_magnitude(
    omega: np.ndarray, magnitude: np.ndarray, order: int, weight: np.ndarray | None = None, tolerance: float = 1e-3
) -> Fit[ScalarScaling]:
    """Best log-Chebyshev fit of |d| at the frequencies by a d(s) of the given order.

    Parameters
    ----------
    omega, magnitude : (n_omega,) rad/s and |d| > 0.
    order : number of poles, and of zeros.
    weight : (n_omega,) in 0..1, weight of the logarithmic misfit at each point; default one.
    tolerance : gap between the error and its proved bound at which the bisection ends.
    """
    target = np.log(magnitude)
    weight = np.ones(omega.size) if weight is None else weight
    best, error = _constant_fit(target, weight)
    if order == 0 or error <= tolerance:
        return Fit(best, error, error if order == 0 else 0.0)
    unit = float(np.exp(np.mean(np.log(omega))))
    problem = _Feasibility((omega / unit) ** 2, 2 * target, weight, order, initial_roots(omega / unit, target, order))

    def attempt(level: float) -> tuple[ScalarScaling, float] | None:
        nonlocal problem
        found = problem.solve(2 * level)
        if found is None:
            return None
        p, q = found
        fitted = _spectral_factor(p, q, unit)
        problem = problem.recentred(np.roots(p[::-1]), np.roots(q[::-1]))
        return fitted, float(np.max(weight * np.abs(fitted.log_magnitude(omega) - target)))

    return bisection(best, error, attempt, tolerance)


def bisection(
    best: Fitted, error: float, attempt: Callable[[float], tuple[Fitted, float] | None], tolerance: float
) -> Fit[Fitted]:
    """Bisection on the error of a fit, from the fit `best`.

    attempt : function of a level, a fit with its error, or None if the level is proved infeasible.
    """
    lower = 0.0
    for _ in range(40):
        if error - lower <= tolerance:
            break
        level = (lower + error) / 2
        try:
            found = attempt(level)
        except (ComputationError, InputError):
            # Neither solved nor proved infeasible, or no stable factor because of round-off: keep the best fit so far.
            break
        if found is None:
            lower = level
            continue
        if found[1] >= error:
            # Feasible, but no better after factorisation: the limit of double precision.
            break
        best, error = found
    return Fit(best, error, lower)


def _constant_fit(target: np.ndarray, weight: np.ndarray) -> tuple[ScalarScaling, float]:
    """Constant d of minimum weighted log-Chebyshev error, which is attained at two points with opposite signs."""
    # error e with target_i - e/w_i <= c <= target_j + e/w_j for all i, j
    difference = target[:, None] - target[None, :]
    pull = np.divide(1.0, weight, out=np.full(weight.size, np.inf), where=weight > 0)
    needed = np.maximum(difference, 0) / (pull[:, None] + pull[None, :])
    i, j = np.unravel_index(np.argmax(needed), needed.shape)
    level = float(needed[i, j])
    c = target[i] - level * pull[i] if level > 0 else float(target[np.argmax(weight)])
    return ScalarScaling(np.array([c])), float(np.max(weight * np.abs(target - c)))


def initial_roots(omega: np.ndarray, target: np.ndarray, order: int) -> np.ndarray:
    """Roots -y_i of the initial basis, distributed over the band in proportion to the variation of the target."""
    position = np.log(omega)
    arrange = np.argsort(position)
    position, target = position[arrange], target[arrange]
    step = np.abs(np.diff(target)) + 0.05 * np.diff(position) + 1e-9
    fraction = np.concatenate([[0.0], np.cumsum(step)]) / np.sum(step) if step.size else np.zeros(1)
    return -np.exp(2 * np.interp((np.arange(order) + 0.5) / order, fraction, position)).astype(complex)


class _Feasibility:
    """The semidefinite problem at a level t, in a basis around given roots of p and q."""

    def __init__(
        self,
        y: np.ndarray,
        log_target: np.ndarray,
        weight: np.ndarray,
        order: int,
        zeros: np.ndarray,
        poles: np.ndarray | None = None,
        ratio: np.ndarray | None = None,
    ):
        self.y, self.log_target, self.weight, self.order = y, log_target, weight, order
        self.poles = zeros if poles is None else poles
        self.e_p, self.e_q = basis_scale(zeros), basis_scale(self.poles)
        log_p, log_q = (np.sum(np.log(y[:, None] + np.abs(r)), axis=1) for r in (zeros, self.poles))
        # In the scaled variables P = p / prod, Q = q / prod the target reads T' = T prod_q / prod_p.
        self.shift = float(np.mean(log_target + log_q - log_p))
        self.log_scaled_target = log_target + log_q - log_p - self.shift
        self.rows_p, self.gram_p = half_line_rows(y, log_p, self.e_p)
        self.rows_q, self.gram_q = half_line_rows(y, log_q, self.e_q)
        self.centre = np.ones(y.size) if ratio is None else ratio

    def recentred(self, zeros: np.ndarray, poles: np.ndarray) -> _Feasibility:
        """The same problem in a basis around the latest solution, with its roots kept within a decade of the band.

        A basis that followed a root to infinity could no longer represent solutions with that root in the band.
        """
        low, high = np.min(self.y) / 100, np.max(self.y) * 100
        near_zeros, near_poles = (np.clip(np.abs(roots), low, high) for roots in (zeros, poles))
        log_ratio = np.sum(np.log(np.abs(self.y[:, None] - poles) / (self.y[:, None] + near_poles)), axis=1)
        return _Feasibility(
            self.y,
            self.log_target,
            self.weight,
            self.order,
            near_zeros,
            near_poles,
            np.exp(np.maximum(log_ratio - np.max(log_ratio), -14.0)),
        )

    def solve(self, log_t: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Coefficients of p and q, ascending in y, or None if the level is infeasible."""
        log_t_k = np.divide(log_t, self.weight, out=np.full(self.y.size, np.inf), where=self.weight > 0)
        kept = log_t_k < SETTINGS.slack
        inverse_t = np.exp(-log_t_k[kept])[:, None]
        # Rows are divided by the current value of q, so that each is of order one (differential correction).
        Q = self.rows_q[kept] / self.centre[kept, None]
        P = self.rows_p[kept] * np.exp(-self.log_scaled_target[kept])[:, None] / self.centre[kept, None]
        margin_q = SETTINGS.positivity / self.centre[kept]
        margin_p = SETTINGS.positivity * np.exp(-self.log_scaled_target[kept]) / self.centre[kept]
        n_p, n_q = P.shape[1], Q.shape[1]
        ones = np.ones((P.shape[0], 1))
        # T Q - P / t >= s and P - T Q / t >= s (divided by T), s maximal
        upper = np.hstack([inverse_t * P, -Q, ones])
        lower = np.hstack([-P, inverse_t * Q, ones])
        bound = np.concatenate([margin_q - inverse_t[:, 0] * margin_p, margin_p - inverse_t[:, 0] * margin_q])
        normal = np.concatenate([np.zeros(n_p), np.mean(Q, axis=0), [0.0]])[None, :]
        cones: list[Any] = [clarabel.ZeroConeT(1), clarabel.NonnegativeConeT(bound.size)]
        cones += [gram_cone(size) for size in (*self.gram_p, *self.gram_q) if size]
        A = sp.csc_matrix(np.vstack([normal, upper, lower, -np.eye(n_p + n_q, n_p + n_q + 1)]))
        b = np.concatenate([[1.0], bound, np.zeros(n_p + n_q)])
        x = maximise_last(A, b, cones)
        if x[-1] <= 0:
            return None
        p = half_line_coefficients(x[:n_p], self.gram_p, self.e_p) * np.exp(self.shift)
        return p, half_line_coefficients(x[n_p:-1], self.gram_q, self.e_q)


def basis_scale(roots: np.ndarray) -> np.ndarray:
    """Coefficients e_k of prod(y + |y_i|), ascending."""
    return np.atleast_1d(np.poly(-np.abs(roots))).real[::-1]


def half_line_rows(y: np.ndarray, log_scale: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Rows that map the stacked Gram vectors to p(y) / prod(y + |y_i|), and the Gram sizes."""
    degree = e.size - 1
    sizes = (degree // 2 + 1, (degree + 1) // 2)
    rows = []
    for odd, size in enumerate(sizes):
        if size:
            power = np.arange(size) + odd / 2
            m = np.exp(0.5 * np.log(e[odd::2][:size]) + np.log(y)[:, None] * power - 0.5 * log_scale[:, None])
            i, j = triangle(size)
            rows.append(m[:, i] * m[:, j] * np.where(i == j, 1.0, np.sqrt(2.0)))
    return np.hstack(rows), sizes


def half_line_coefficients(x: np.ndarray, sizes: tuple[int, int], e: np.ndarray) -> np.ndarray:
    """Coefficients of s0(y) + y s1(y) + margin, ascending, from the stacked Gram vectors."""
    coefficients = SETTINGS.positivity * e
    start = 0
    for odd, size in enumerate(sizes):
        scale = np.sqrt(e[odd::2][:size])
        for i, j in zip(*triangle(size), strict=True):
            coefficients[i + j + odd] += x[start] * scale[i] * scale[j] * (1.0 if i == j else np.sqrt(2.0))
            start += 1
    return coefficients


def triangle(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Upper triangle, column by column: the solver's order of a symmetric matrix."""
    j, i = np.tril_indices(size)
    return i, j


def gram_cone(size: int) -> Any:
    """Cone of a positive semidefinite Gram matrix."""
    return clarabel.NonnegativeConeT(1) if size == 1 else clarabel.PSDTriangleConeT(size)


def maximise_last(A: sp.csc_matrix, b: np.ndarray, cones: list[Any]) -> np.ndarray:
    """Solution of max x[-1] subject to b - A x in the cones; ComputationError if the solver fails."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    size = A.shape[1]
    cost = np.zeros(size)
    cost[-1] = -1.0
    solution = clarabel.DefaultSolver(sp.csc_matrix((size, size)), cost, A, b, cones, settings).solve()
    if solution.status not in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved):
        raise ComputationError(
            "the semidefinite program of a scaling was not solved",
            measured=str(solution.status),
            cause="magnitudes or weights spanning too many decades",
            next_step="a lower order",
        )
    return np.asarray(solution.x)


def _spectral_factor(p: np.ndarray, q: np.ndarray, unit: float) -> ScalarScaling:
    """d(s) with |d(j omega)|^2 = p / q at y = (omega / unit)^2, all roots in the left half plane."""
    if not p[-1] / q[-1] > 0:
        raise ComputationError(
            "a positive polynomial came out of the fit with a leading coefficient below zero",
            measured=f"{p[-1]:.3g} over {q[-1]:.3g}",
            cause="frequencies spanning too many decades",
            next_step="a lower order or a narrower band",
        )
    return ScalarScaling.from_roots(float(np.sqrt(p[-1] / q[-1])), stable_roots(p) * unit, stable_roots(q) * unit)


def stable_roots(polynomial: np.ndarray) -> np.ndarray:
    """The left half plane roots s of p(-s^2), for p ascending in y = -s^2 and positive on y >= 0."""
    y = np.roots(polynomial[::-1])
    if np.any((np.abs(y.imag) <= 1e-12 * np.abs(y)) & (y.real >= 0)):
        raise ComputationError(
            "a positive polynomial came out of factorisation with a root on the axis",
            measured=f"y = {y[y.real >= 0][0]:.3g}",
            cause="frequencies spanning too many decades",
            next_step="a lower order or a narrower band",
        )
    return -np.sqrt(-y.astype(complex))
