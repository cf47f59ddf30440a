"""Maximum likelihood in the frequency domain for a rig's physical parameters.

With circular complex Gaussian noise of covariance C_k on line k (Pintelon and Schoukens 2012, section 9.11), minus
twice the log-likelihood is, up to a constant, the chi-square

    chi2(theta) = 2 sum_k e_k^H inv(C_k) e_k + sum_j (theta_j - prior_j)^2 / sigma_j^2
    e_k = Y_k - G_k(theta) U_k - t_k

with t_k the transient of a record, linear in real unknowns x, which are projected out (variable projection of Golub and
Pereyra 1973; the Jacobian contains the derivative of t_k at the best x, so that the step is that of the joint problem).

Levenberg-Marquardt steps are taken in relative parameters. The information matrix is J^T J at the end; its inverse is
the Cramer-Rao bound if C_k is known. If C_k was estimated, the scatter of the weights costs precision, and the
information is reduced accordingly (`weight_cost`). Directions that the data do not determine keep their starting value.
Parameters that are positive for physical reasons stop just above zero, and stay there as long as chi2 would decrease
only below zero (an active set); the remaining parameters then reach their own optimum. A moment of inertia stops in the
same way at the sum of the other two.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from scipy.linalg import null_space

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import FrequencyModel, moment_rows, positive
from avis_ctrl.identification.spectra import span, thinned, transient_columns, transient_parts
from avis_ctrl.identification.spectral_block import SpectralBlock

Prior = tuple[float, float]
Fitted = TypeVar("Fitted", bound=FrequencyModel)


@dataclass(frozen=True)
class LikelihoodSettings:
    """few_lines : number of lines of all blocks together, below which threads cost more time than they save.
    edge : distance that a moment of inertia keeps from the sum of the other two, relative to the sum of all three;
        large enough to be safe against round-off.
    thin_lines, thin_by : lines of a block on which a start other than the first begins: one in thin_by, at least
        thin_lines.
    at_once : lines that are whitened together: with about a hundred parameters they fit into the processor's cache.
    """

    few_lines: int = 4000
    thin_lines: int = 200
    thin_by: int = 8
    at_once: int = 32
    edge: float = 1e-6


SETTINGS = LikelihoodSettings()


@dataclass(frozen=True, eq=False)
class Residual:
    """Residual of a block.

    plain : (n, n_y, m) Y - G U. error : the same without the transient of the record's ends.
    white : (n, n_y, m) the error whitened, E|white|^2 = 1 if it is noise only.
    """

    block: SpectralBlock
    plain: np.ndarray
    error: np.ndarray
    white: np.ndarray


@dataclass(frozen=True, eq=False)
class LikelihoodFit(Generic[Fitted]):
    """The most likely parameters.

    Attributes
    ----------
    model : at the estimate.
    information : of the estimate (inverse of the Cramer-Rao bound), reduced by the cost of estimated weights.
    chi2, dof : sum of squares that should be standard normal, including priors, and its degrees of freedom: the
        transients' unknowns and the determined combinations of parameters are subtracted.
    iterations, converged : of the best start.
    residuals : one per block.
    starts : chi2 reached from each start, infinite if it failed.
    priors : parameters that have one.
    held : parameters that ended at their smallest physical value, and moments of inertia that ended at their largest;
        for these, and for parameters correlated with them, the information describes a normal distribution that is
        truncated there.
    """

    model: Fitted
    information: Information
    chi2: float
    dof: int
    iterations: int
    converged: bool
    residuals: tuple[Residual, ...]
    starts: tuple[float, ...]
    priors: tuple[str, ...] = ()
    held: tuple[str, ...] = ()

    @property
    def values(self) -> np.ndarray:
        """(n_p,) estimate."""
        return self.model.values

    @property
    def chi2_per_dof(self) -> float:
        """Reduced chi-square, 1 expected."""
        return self.chi2 / self.dof


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """chi2 and its expansion in relative parameters: g = -J^T e, H = J^T J; F is H reduced by the cost of the
    weights."""

    chi2: float
    gradient: np.ndarray
    H: np.ndarray
    F: np.ndarray
    residuals: tuple[Residual, ...] = ()


def fit(
    model: Fitted,
    blocks: Sequence[SpectralBlock],
    priors: Mapping[str, Prior] | None = None,
    starts: int = 1,
    spread: float = 0.1,
    seed: int = 1,
    max_iterations: int = 60,
    progress: Callable[[str], None] | None = None,
    about: Fitted | None = None,
) -> LikelihoodFit[Fitted]:
    """The most likely parameters of `model.names`, starting from its present values.

    Parameters
    ----------
    blocks : data with the covariance of their noise.
    priors : (mean, standard deviation) of parameters, in their units.
    starts : number of starting points; the first is the model itself, the others are drawn within `spread` (relative).
    about : model whose values scale the steps and set the bounds, `model` by default. A fit that continues an earlier
        one passes the earlier start: a parameter that ended near zero would be useless as a scale.

    Raises
    ------
    InputError : no parameters, blocks without noise, priors of unknown parameters.
    ComputationError : no start reached a finite chi-square.
    """
    priors, about = dict(priors or {}), about or model
    _check(model, blocks, priors, starts)
    rng = np.random.default_rng(seed)
    whiteners = [whitener(block) for block in blocks]
    reached: list[tuple[float, _Descent[Fitted] | None]] = []
    for k in range(starts):
        begin = model if k == 0 else _moved(model, spread, rng)
        if begin is not None:
            if k > 0:
                # A first descent on some of the lines leads from a distant start to the same minimum in less time.
                few = [thinned(b, max(SETTINGS.thin_lines, len(b.omega) // SETTINGS.thin_by)) for b in blocks]
                first = _Descent(begin, few, [whitener(block) for block in few], priors, about)
                first.run(max_iterations)
                begin = first.model
            descent = _Descent(begin, blocks, whiteners, priors, about)
            descent.run(max_iterations)
            reached.append((descent.now.chi2, descent))
        else:
            reached.append((np.inf, None))
        if progress:
            progress(f"start {k + 1} of {starts}: chi-square {reached[-1][0]:.6g}")
    chi2, best = min(reached, key=lambda pair: pair[0])
    if best is None or not np.isfinite(chi2):
        raise ComputationError(
            "no starting point of the fit reached a finite chi-square",
            measured=f"{chi2}",
            cause="data that are zero or far from this rig",
            next_step="check the findings of the gates, and start from better values",
        )
    last = best.evaluate(best.model, residuals=True)
    scale = about.scales()
    unknown = sum(transient_unknowns(block, model) for block in blocks)
    information = Information(model.names, best.model.values, model.units, last.F / np.outer(scale, scale), scale)
    dof = sum(block.numbers for block in blocks) + len(priors) - unknown - information.rank
    return LikelihoodFit(
        best.model,
        information,
        last.chi2,
        dof,
        best.iterations,
        best.converged,
        last.residuals,
        tuple(value for value, _ in reached),
        tuple(priors),
        tuple(name for name, low in zip(model.names, best.at_bounds()[0], strict=True) if low) + best.largest_moments(),
    )


class _Descent(Generic[Fitted]):
    """One Levenberg-Marquardt run."""

    def __init__(
        self,
        model: Fitted,
        blocks: Sequence[SpectralBlock],
        whiteners: Sequence[np.ndarray],
        priors: Mapping[str, Prior],
        first: Fitted,
    ):
        self.model, self.blocks, self.whiteners, self.priors = model, blocks, whiteners, priors
        self.scale, (self.lowest, self.highest) = first.scales(), first.bounds()
        self.rows = _held_rows(first)
        self.now = self.evaluate(model)
        self.iterations, self.converged = 0, False

    def evaluate(self, model: Fitted, derivative: bool = True, residuals: bool = False) -> _Quadratic:
        """chi2 at a model, with its expansion if requested."""
        n_p = len(model.names)
        chi2, g, H, F, kept = 0.0, np.zeros(n_p), np.zeros((n_p, n_p)), np.zeros((n_p, n_p)), []
        _ = model.matrices, derivative and model.derivative_matrices  # computed once, before the threads need them
        work = partial(block_residual, model, derivative=derivative)
        # Few calls on large arrays, which release the interpreter: threads are efficient, and the order of the sums is
        # fixed.
        if sum(len(block.omega) for block in self.blocks) < SETTINGS.few_lines:
            parts = list(map(work, self.blocks, self.whiteners))
        else:
            with ThreadPoolExecutor(min(len(self.blocks), os.cpu_count() or 1)) as threads:
                parts = list(threads.map(work, self.blocks, self.whiteners))
        for e, J, residual in parts:
            chi2 += float(e @ e)
            if derivative:
                J *= self.scale[:, None]
                g -= J @ e
                own = J @ J.T
                H += own
                F += own / weight_cost(residual.block)
            if residuals:
                kept.append(residual)
        for name, (mean, sigma) in self.priors.items():
            j = model.names.index(name)
            miss, slope = (mean - model.values[j]) / sigma, self.scale[j] / sigma
            chi2 += miss**2
            g[j] -= slope * miss
            H[j, j] += slope**2
            F[j, j] += slope**2
        return _Quadratic(chi2, g, H, F, tuple(kept))

    def run(self, max_iterations: int) -> None:
        damping = 1e-3
        while self.iterations < max_iterations and not self.converged:
            step, promised = self._step(damping)
            if promised < 1e-6 * max(1.0, 1e-3 * self.now.chi2 / len(self.model.names)) + 1e-12 * self.now.chi2:
                # A step that is small only because of the damping does not show convergence.
                self.converged = damping <= 1.0
                break
            trial = self._try(step)
            if trial is not None and trial[1] < self.now.chi2:
                gain = (self.now.chi2 - trial[1]) / promised
                self.model, self.iterations = trial[0], self.iterations + 1
                self.now = self.evaluate(self.model)
                damping = max(damping * (0.1 if gain > 0.5 else 1.0), 1e-12)
            else:
                damping *= 10
                if damping > 1e8:
                    # No smaller chi-square in any direction: the limit of numerical resolution.
                    self.converged = promised < 1e-3
                    break

    def _step(self, damping: float) -> tuple[np.ndarray, float]:
        """Relative step, and the decrease of chi2 that the expansion predicts for it.

        The step runs along the bounds and edges that it would otherwise cross.
        """
        low, high = self.at_bounds()
        free = ~((low & (self.now.gradient > 0)) | (high & (self.now.gradient < 0)))
        basis = np.eye(len(free))[:, free]
        step, promised = self._step_in(basis, damping)
        rows, edge, held = self.rows * self.scale, self.at_edge(), np.zeros(len(self.rows), bool)
        for _ in rows:
            leaving = edge & ~held & (rows @ step < 0)
            if not np.any(leaving):
                break
            held |= leaving
            step, promised = self._step_in(basis @ null_space(rows[held] @ basis), damping)
        return step, promised

    def _step_in(self, basis: np.ndarray, damping: float) -> tuple[np.ndarray, float]:
        """The step in the space spanned by the columns of basis (n_p, k).

        H is scaled to a unit diagonal before its eigenvalues decide which directions are determined.
        """
        H, g = basis.T @ self.now.H @ basis, basis.T @ self.now.gradient
        if not g.size:
            return np.zeros(len(basis)), 0.0
        size = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(H / np.outer(size, size))
        along = vectors.T @ (g / size)
        known = values > 1e-11 * values[-1]
        # No parameter moves by more than its reach: damping first limits the poorly determined directions.
        down, up = self.model.reach()
        while True:
            y = np.where(known, -along / np.where(known, values + damping, 1.0), 0.0)
            step = basis @ (vectors @ y / size)
            largest = np.max(np.abs(step) / np.where(step > 0, up, down))
            if largest <= 1 or damping >= 1.0:
                break
            damping *= 4
        if largest > 1:
            y, step = y / largest, step / largest
        return step, float(-(2 * along @ y + y @ (values * y)))

    def at_edge(self) -> np.ndarray:
        """(k,) whether the moment of inertia of each row has reached the sum of the other two."""
        return self.rows @ self.model.values <= 3 * SETTINGS.edge * np.abs(self.rows) @ np.abs(self.model.values)

    def largest_moments(self) -> tuple[str, ...]:
        """Names of the moments of inertia at the largest value that a rigid body can have."""
        return tuple(self.model.names[int(np.argmin(row))] for row in self.rows[self.at_edge()])

    def at_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) each: which parameters are at their smallest and at their largest physical value."""
        low, high = (1e-9 * np.nan_to_num(np.abs(one), posinf=0.0) for one in (self.lowest, self.highest))
        return self.model.values <= self.lowest + low, self.model.values >= self.highest - high

    def _try(self, step: np.ndarray) -> tuple[Fitted, float] | None:
        values = np.clip(self.model.values + step * self.scale, self.lowest, self.highest)
        if len(self.rows):
            # Shorten the step so that it ends where a moment comes within `edge` of the sum of the other two.
            size = SETTINGS.edge * np.abs(self.rows) @ np.abs(self.model.values)
            room = np.maximum(self.rows @ self.model.values - size, 0.0)
            used = -(self.rows @ (values - self.model.values))
            beyond = used > room + 1e-6 * size  # a step along the edge leaves it by round-off
            share = np.min(np.where(beyond, room / np.where(beyond, used, 1.0), 1.0))
            values = self.model.values + share * (values - self.model.values)
        try:
            model = self.model.at(values)
        except InputError:
            return None  # no rig has these parameters: try a shorter step
        if not _physical(model):
            return None
        chi2 = self.evaluate(model, derivative=False).chi2
        return (model, chi2) if np.isfinite(chi2) else None


def _physical(model: FrequencyModel) -> bool:
    """Whether stiffness, damping and sensitivities have the sign that they have on a real rig."""
    return all(value > 0 for name, value in zip(model.names, model.values, strict=True) if positive(name))


def block_residual(
    model: FrequencyModel, block: SpectralBlock, L: np.ndarray, *, derivative: bool
) -> tuple[np.ndarray, np.ndarray, Residual]:
    """Real residual e (N,) of unit variance and its negative Jacobian J (n_p, N), with the transient projected out of
    both."""
    if not block.transient:
        found = model.answer(block, None, derivative)
        error = block.Y - found.Y
        white = whitened(L, error)
        J = whitened_real(L, found.dY) if derivative else np.empty(0)
        return as_real(white[None])[0], J, Residual(block, error, error, white / np.sqrt(2))
    columns, norms, Q, X = whitened_transient(model, block, L)
    plain = block.Y - model.answer(block, None, False).Y
    e = as_real(whitened(L, plain)[None])[0]
    x = X @ (Q.T @ e)
    error = plain - (columns @ x)[:, :, None]
    white = whitened(L, error)
    e = as_real(white[None])[0]
    J = np.empty(0)
    if derivative:
        body, inner = transient_parts(x, norms, block, model)
        J = whitened_real(L, model.answer(block, body, inner=inner).dY)
        J -= (Q @ (Q.T @ J.T)).T  # parameters come last in memory
    return e, J, Residual(block, plain, error, white / np.sqrt(2))


def whitened_transient(
    model: FrequencyModel, block: SpectralBlock, L: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`transient_columns` of a block with their norms, and `span` Q (N, r), X (n_t, r) of the whitened columns."""
    columns, norms = transient_columns(model, block.omega)
    return columns, norms, *span(white_columns(columns, L).T)


def white_columns(columns: np.ndarray, L: np.ndarray) -> np.ndarray:
    """(n_t, N) whitened real columns from (n, n_y, n_t)."""
    return as_real(np.moveaxis(whitened(L, columns), -1, 0))


def added_terms(
    model: FrequencyModel, blocks: Sequence[SpectralBlock], columns: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """H (k, k) and g (k,) with chi2 = chi2_0 + s^T H s - 2 g^T s, if s times k known terms are added to the model's
    outputs.

    The parameters move along to the minimum of chi2 (to first order), and the transients are projected out.

    columns : (k, n, n_y, m) of each block. Raises InputError for blocks without noise.
    """
    n_p, k = len(model.names), len(columns[0])
    H, g = np.zeros((n_p + k, n_p + k)), np.zeros(n_p + k)
    scale = model.scales()
    for block, of in zip(blocks, columns, strict=True):
        L = whitener(block)
        e, J, _ = block_residual(model, block, L, derivative=True)
        c = as_real(whitened(L, of))
        if block.transient:
            Q = whitened_transient(model, block, L)[2]
            c = c - (c @ Q) @ Q.T
        rows = np.concatenate([J * scale[:, None], c])
        H += rows @ rows.T
        g += rows @ e
    size = np.sqrt(np.maximum(np.diag(H)[:n_p], np.finfo(float).tiny))
    inner = np.linalg.pinv(H[:n_p, :n_p] / np.outer(size, size), rcond=1e-11, hermitian=True)
    across = H[n_p:, :n_p] / size
    return H[n_p:, n_p:] - across @ inner @ across.T, g[n_p:] - across @ inner @ (g[:n_p] / size)


def whitener(block: SpectralBlock) -> np.ndarray:
    """(n, 1 or m, n_y, n_y) sqrt(2) inv(chol(C)), C the noise covariance with `SpectralBlock.precision_factor`."""
    if block.noise is None:
        raise InputError("expected the covariance of its noise", field=f"block {block.name}")
    correction = block.precision_factor
    try:
        factor = np.linalg.cholesky(block.noise)
    except np.linalg.LinAlgError:
        raise InputError(
            "expected a positive definite noise covariance on every line; a channel without noise, or two "
            "equal channels, make it singular",
            field=f"block {block.name}",
        ) from None
    return np.sqrt(2 * correction) * np.linalg.inv(factor)


def weight_cost(block: SpectralBlock) -> float:
    """Ratio of the variance of an estimate with estimated weights to that with the true ones.

    For weights inv(C_k) of independent complex Wishart matrices of p outputs and nu degrees of freedom, the errors of a
    weighted least squares follow from E inv(W) and E inv(W)^2 (Maiwald and Kraus, IEE Proc. Radar 147, 2000): the ratio
    is nu (nu - p) / ((nu - p)^2 - 1). With less than one degree of freedom above p this moment does not exist.
    """
    assert block.noise is not None
    p, nu = block.noise.shape[-1], block.dof
    return 1.0 if np.isinf(nu) else nu * (nu - p) / max((nu - p) ** 2 - 1, 1.0)


def whitened(L: np.ndarray, error: np.ndarray) -> np.ndarray:
    """L (n, 1 or m, n_y, n_y) applied to (..., n, n_y, m)."""
    if L.shape[1] == 1:
        return L[:, 0] @ error
    return np.moveaxis((L @ np.moveaxis(error, -1, -2)[..., None])[..., 0], -1, -2)


def whitened_real(L: np.ndarray, dY: np.ndarray) -> np.ndarray:
    """(p, N) `as_real` of `whitened` dY (p, n, n_y, m), for many parameters p, which are last in memory."""
    p, n, n_y, m = dY.shape
    J, few = np.empty((2, n, n_y, m, p)), SETTINGS.at_once
    for at in (slice(k, k + few) for k in range(0, n, few)):
        white = (L[at] @ np.ascontiguousarray(dY[:, at].transpose(1, 3, 2, 0))).swapaxes(1, 2)
        J[0, at], J[1, at] = white.real, white.imag
    return J.reshape(-1, p).T


def as_real(white: np.ndarray) -> np.ndarray:
    """(p, ...) complex to (p, N) real."""
    flat = white.reshape(len(white), -1)
    return np.concatenate([flat.real, flat.imag], axis=1)


def as_complex(real: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(N,) of `as_real` back to a complex array of this shape."""
    return np.asarray(real[: len(real) // 2] + 1j * real[len(real) // 2 :]).reshape(shape)


def transient_unknowns(block: SpectralBlock, model: FrequencyModel) -> int:
    """Number of unknowns in the transient of a block."""
    return len(transient_columns(model, block.omega[:1])[1]) if block.transient else 0


def _moved(model: Fitted, spread: float, rng: np.random.Generator) -> Fitted | None:
    """Another start: each parameter changed by a random relative amount; None if no rig has the drawn values."""
    for _ in range(20):
        try:
            moved = model.at(model.values + model.scales() * spread * rng.uniform(-1, 1, len(model.names)))
        except InputError:
            continue
        if _physical(moved) and np.all(_held_rows(model) @ moved.values > 0):
            return moved
    return None


def _held_rows(first: FrequencyModel) -> np.ndarray:
    """`moment_rows` that the starting values satisfy to within `edge`: a thin plate starts at the sum itself."""
    rows = moment_rows(first.names)
    return rows[rows @ first.values >= -SETTINGS.edge * np.abs(rows) @ np.abs(first.values)]


def _check(model: FrequencyModel, blocks: Sequence[SpectralBlock], priors: Mapping[str, Prior], starts: int) -> None:
    if not model.names:
        raise InputError("expected at least one free parameter", field="parameters")
    if not blocks:
        raise InputError("expected at least one record or response to fit", field="blocks")
    if starts < 1:
        raise InputError("expected at least one start", field="starts", value=starts)
    for name, (mean, sigma) in priors.items():
        if name not in model.names:
            raise InputError(f"expected a free parameter out of {', '.join(model.names)}", field="priors", value=name)
        if not (np.isfinite(mean) and np.isfinite(sigma) and sigma > 0):
            raise InputError(
                "expected a finite mean and a positive standard deviation",
                field=f"prior of {name}",
                value=(mean, sigma),
            )
