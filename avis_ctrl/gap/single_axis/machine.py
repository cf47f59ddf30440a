"""Fits of a base model with candidate terms, judged on blocks of data that the fit has not seen.

The data are cut into contiguous blocks. A model is judged by the Gaussian log score of each block under the parameters
and the scatter that all other blocks give (leave one block out). Residuals are correlated, so that n rows are worth
n/tau independent ones, tau = 1 + 2 sum_l w_l rho_l (Bartlett weights, lags by Andrews' rule, as in
`identification.single_axis.fit`), and every log score is divided by tau.

Candidates are scored with one Gauss-Newton step from the fit to all blocks, exact where the model is linear in its
parameters; the figures of a stage that is kept come from full refits without the block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import least_squares

from avis_ctrl.errors import ComputationError
from avis_ctrl.gap.single_axis.terms import AxisParameter, Term
from avis_ctrl.identification.single_axis.fit import andrews_lags, not_below
from avis_ctrl.measurement.gates.finding import Picture

# Singular values below this part of the largest one are combinations that the data do not determine.
RANK = 1e-8


class AxisProblem(Protocol):
    """A kind of axis with its data, as rows of a residual.

    base : parameters of the base model. block : (n,) block of each row. runs : rows in natural order (time, frequency),
    each an index array, for the correlation of residuals. size : (n,) r.m.s. of what was measured, row by row.
    noise : mean square of the measured noise in the rows, None where nothing tells it. splits : halves of the data
    whose parameters must agree: name, blocks of one, blocks of the other. notes : sentences on the data.
    """

    kind: str
    base: tuple[AxisParameter, ...]
    block: np.ndarray
    runs: Sequence[np.ndarray]
    size: np.ndarray
    noise: float | None
    splits: Sequence[tuple[str, np.ndarray, np.ndarray]]
    notes: Sequence[str]

    def residual(self, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        """(n,) measured less predicted, theta of the base first, then of each term."""

    def sigma(self, e: np.ndarray, used: np.ndarray) -> np.ndarray:
        """(n,) standard deviations of all rows, estimated from the rows used."""

    def references(self, terms: Sequence[Term], theta: np.ndarray) -> Mapping[str, np.ndarray]:
        """Name to columns (n, p): additional regressors of models without physics."""

    def free(self, variable: str, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        """(n, p) regressors of a free function of a variable of `Term.variable`."""

    def where(self, e: np.ndarray) -> tuple[dict[str, Any], ...]:
        """Bands that hold most of the squared residual, as in the contract."""

    def picture(self, errors: Sequence[np.ndarray], names: Sequence[str]) -> Picture:
        """Residuals of the stages on unseen data."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Parameters on some blocks. J : (n, p) derivative of the residual over sigma, all rows."""

    terms: tuple[Term, ...]
    parameters: tuple[AxisParameter, ...]
    theta: np.ndarray
    covariance: np.ndarray
    e: np.ndarray
    sigma: np.ndarray
    J: np.ndarray

    def at_bound(self, first: int) -> bool:
        """Whether a parameter from `first` on lies at an end of its range."""
        return any(x - p.low <= 1e-6 * p.scale or p.high - x <= 1e-6 * p.scale
                   for p, x in zip(self.parameters[first:], self.theta[first:], strict=True))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model on blocks that its fit has not seen. e : (n,); score : (n,) log score of each row before tau."""

    e: np.ndarray
    score: np.ndarray
    sigma: np.ndarray

    def blocks(self, block: np.ndarray, tau: float) -> np.ndarray:
        """(blocks,) log scores."""
        return np.bincount(block, self.score) / tau


def parameters_of(problem: AxisProblem, terms: Sequence[Term]) -> tuple[AxisParameter, ...]:
    return (*problem.base, *(p for term in terms for p in term.parameters(problem)))


def fit(problem: AxisProblem, terms: Sequence[Term], start: np.ndarray, used: np.ndarray | None = None,
        sweeps: int = 2, evaluations: int = 60) -> Fitted:
    """Least squares over the rows used, each in its own standard deviation, which is estimated along the way.

    Raises
    ------
    ComputationError : a residual that is not finite.
    """
    parameters = parameters_of(problem, terms)
    scale = np.array([p.scale for p in parameters])
    low, high = (np.array([getattr(p, end) for p in parameters]) / scale for end in ("low", "high"))
    used = np.ones(len(problem.block), bool) if used is None else used
    x = np.clip(start / scale, low, high)
    sigma = problem.sigma(_finite(problem.residual(terms, x * scale)), used)
    for _ in range(sweeps):
        # Away from the bounds, where the method cannot start.
        inside = np.clip(x, np.nextafter(low, np.inf), np.nextafter(high, -np.inf))
        found = least_squares(lambda z, s=sigma: (_finite(problem.residual(terms, z * scale)) / s)[used], inside,
                              bounds=(low, high), x_scale="jac", xtol=1e-10, ftol=1e-10, max_nfev=evaluations)
        x = found.x
        e = problem.residual(terms, x * scale)
        again = problem.sigma(e, used)
        settled = np.allclose(again / sigma, (again / sigma)[0], rtol=1e-3)
        sigma = again
        if settled:  # a common factor moves no minimum
            break
    J = jacobian(problem, terms, x, scale, low, high, e) / sigma[:, None]
    return Fitted(tuple(terms), parameters, x * scale, _covariance(J, e / sigma, problem.block, used), e, sigma, J)


def jacobian(problem: AxisProblem, terms: Sequence[Term], x: np.ndarray, scale: np.ndarray, low: np.ndarray,
             high: np.ndarray, e: np.ndarray) -> np.ndarray:
    """(n, p) by differences, away from a bound where one is near."""
    J = np.empty((len(e), len(x)))
    for j in range(len(x)):
        h = 1e-5 * max(abs(x[j]), 1e-3)
        h = -h if x[j] + h > high[j] else h
        moved = x.copy()
        moved[j] += h
        J[:, j] = (problem.residual(terms, moved * scale) - e) / (h * scale[j])
    return J


def _finite(e: np.ndarray) -> np.ndarray:
    if not np.all(np.isfinite(e)):
        raise ComputationError("the model of the axis cannot be evaluated", measured="a residual that is not finite",
                               cause="data far from the kind of axis", next_step="check kind, columns and units")
    return e


def _covariance(J: np.ndarray, e: np.ndarray, block: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Sandwich with the scores summed over each block (Liang and Zeger, Biometrika 73 (1986) 13): whatever correlation
    there is inside a block counts. Not below that of a white residual."""
    A, w, b = J[used], e[used], block[used]
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)  # of no influence: the pseudo-inverse gives it no variance
    bread = np.linalg.pinv((A / size).T @ (A / size), rcond=RANK, hermitian=True) / np.outer(size, size)
    scores = np.stack([np.bincount(b, A[:, j] * w, minlength=block.max() + 1) for j in range(A.shape[1])], axis=1)
    scores = scores[np.unique(b)]
    few = len(scores) / max(len(scores) - 1, 1)
    return not_below(few * bread @ (scores.T @ scores) @ bread, bread)


def held_out(problem: AxisProblem, found: Fitted, extra: np.ndarray | None = None, ridge: float = 0.0) -> HeldOut:
    """Every block under one Gauss-Newton step on all other blocks; `extra` adds linear regressors (n, q)."""
    J = found.J if extra is None else np.hstack([found.J, extra / found.sigma[:, None]])
    size = np.maximum(np.linalg.norm(J, axis=0), np.finfo(float).tiny)
    J, w = J / size, found.e / found.sigma
    free = np.array([p.low < x < p.high for p, x in zip(found.parameters, found.theta, strict=True)]
                    + [True] * (J.shape[1] - len(found.theta)))
    J = J[:, free]
    blocks = [np.flatnonzero(problem.block == b) for b in range(problem.block.max() + 1)]
    grams, sides = [J[r].T @ J[r] for r in blocks], [J[r].T @ w[r] for r in blocks]
    gram, side = np.sum(grams, axis=0), np.sum(sides, axis=0)
    own = int(np.count_nonzero(free[:len(found.theta)]))
    penalty = np.diag(np.r_[np.zeros(own), np.full(J.shape[1] - own, ridge)])
    e, sigma, score = np.empty_like(w), np.empty_like(w), np.empty_like(w)
    for b, rows in enumerate(blocks):
        step = -np.linalg.pinv(gram - grams[b] + penalty, rcond=RANK, hermitian=True) @ (side - sides[b])
        left = (w + J @ step) * found.sigma
        e[rows], sigma[rows], score[rows] = _scored(problem, left, problem.block != b, rows, J.shape[1])
    return HeldOut(e, score, sigma)


def held_out_refitted(problem: AxisProblem, found: Fitted) -> HeldOut:
    """Every block under a full refit to all other blocks."""
    e, sigma, score = (np.empty_like(found.e) for _ in range(3))
    for b in range(problem.block.max() + 1):
        train, rows = problem.block != b, np.flatnonzero(problem.block == b)
        one = fit(problem, found.terms, found.theta, train, evaluations=20)
        e[rows], sigma[rows], score[rows] = _scored(problem, one.e, train, rows, len(one.theta))
    return HeldOut(e, score, sigma)


def _scored(problem: AxisProblem, e: np.ndarray, train: np.ndarray, rows: np.ndarray, spent: int
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = int(np.count_nonzero(train))
    sigma = problem.sigma(e, train)[rows] * np.sqrt(n / max(n - spent, 1))
    return e[rows], sigma, -np.log(sigma) - 0.5 * (e[rows] / sigma) ** 2


def correlation_time(problem: AxisProblem, judged: HeldOut) -> float:
    """tau: how many rows are worth one."""
    z = judged.e / judged.sigma
    lags = max(andrews_lags(z[run][:, None]) for run in problem.runs)
    power = max(float(sum(z[run] @ z[run] for run in problem.runs)), np.finfo(float).tiny)
    tau = 1.0
    for lag in range(1, lags + 1):
        rho = sum(float(z[run][lag:] @ z[run][:-lag]) for run in problem.runs if len(run) > lag) / power
        tau += 2 * (1 - lag / (lags + 1)) * rho
    return max(tau, 1.0)


def bumps(x: np.ndarray, count: int) -> list[np.ndarray]:
    """Quadratic splines over quantiles of x, so that each has its share of the data; any shape of x."""
    inner = np.unique(np.quantile(x, np.linspace(0, 1, count - 1)))
    knots = np.r_[[inner[0]] * 2, inner, [inner[-1]] * 2]
    flat = BSpline.design_matrix(np.clip(x.ravel(), inner[0], inner[-1]), knots, 2).toarray()
    return [column.reshape(x.shape) for column in flat.T]


def octaves(frequency_Hz: np.ndarray, power: np.ndarray, channel: dict[str, str]) -> tuple[dict[str, Any], ...]:
    """The octaves that together hold at least half of the power, largest first."""
    top = float(frequency_Hz.max())
    index = np.floor(np.log2(top / np.maximum(frequency_Hz, top * 2.0 ** -12)) + 1e-12).astype(int)
    share = np.bincount(index, power) / max(float(power.sum()), np.finfo(float).tiny)
    found: list[dict[str, Any]] = []
    for k in np.argsort(-share):
        if sum(float(place["share"]) for place in found) >= 0.5 or share[k] <= 0:
            break
        found.append({"from_Hz": top * 2.0 ** -(int(k) + 1.0), "to_Hz": top * 2.0 ** -float(int(k)), **channel,
                      "share": float(share[k])})
    return tuple(found)
