"""Maximum likelihood in the frequency domain for a rig's physical parameters.

With circular complex Gaussian noise of covariance C_k on line k (Pintelon and Schoukens 2012, section 9.11), minus
twice the log-likelihood is, up to a constant, the chi-square

    chi2(theta) = 2 sum_k e_k^H inv(C_k) e_k + sum_j (theta_j - prior_j)^2 / sigma_j^2
    e_k = Y_k - G_k(theta) U_k - t_k

with t_k the transient of a record, linear in real unknowns x, which are projected out (variable projection of Golub
and Pereyra 1973; the Jacobian contains the derivative of t_k at the best x, so that the step is that of the joint
problem).
Levenberg-Marquardt steps in relative parameters; the information matrix is J^T J at the end, its inverse the
Cramer-Rao bound where C_k is known. Where C_k was estimated, weights that scatter cost precision, and the information
is less by what they cost (`weight_cost`). Directions that the data do not determine keep their starting value.
Parameters that physics keeps positive stop just above zero, and a moment of inertia at the sum of the other two, while
chi2 would fall further beyond; the other parameters then find their own optimum. In coordinates in which these limits
are a box, a step is a linear least-squares problem with bounds (Stark and Parker, Computational Statistics 10 (1995)
129-141, as scipy has it).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from scipy.optimize import lsq_linear

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import FrequencyModel, moment_rows
from avis_ctrl.identification.spectra import span, thinned, transient_columns, transient_parts
from avis_ctrl.identification.spectral_block import SpectralBlock

Prior = tuple[float, float]
Fitted = TypeVar("Fitted", bound=FrequencyModel)


@dataclass(frozen=True)
class LikelihoodSettings:
    """few_lines : number of lines, all blocks together, below which threads cost more time than they save.
    edge : distance that a moment of inertia keeps from the sum of the other two, relative to the sum of all three.
    near : distance from a limit, in relative units, within which a parameter counts as at it.
    known : smallest eigenvalue of the scaled normal matrix, relative to the largest, of a direction that is determined.
    thin_lines, thin_by : lines of a block on which a start other than the first begins: so many, or one in so many.
    at_once : lines that are whitened together: with some hundred parameters they stay in the processor's cache.
    """

    few_lines: int = 4000
    thin_lines: int = 200
    thin_by: int = 8
    at_once: int = 32
    edge: float = 1e-6
    near: float = 1e-6
    known: float = 1e-11


SETTINGS = LikelihoodSettings()


@dataclass(frozen=True, eq=False)
class Residual:
    """What a block leaves: e (n, n_y, m), the same whitened (unit variance E|e|^2), and the transient (n, n_y, m)."""

    block: SpectralBlock
    error: np.ndarray
    white: np.ndarray
    transient: np.ndarray


@dataclass(frozen=True, eq=False)
class LikelihoodFit(Generic[Fitted]):
    """The most likely parameters.

    Attributes
    ----------
    model : at the estimate.
    information : of the estimate: the Cramer-Rao bound, less what estimated weights cost.
    chi2, dof : sum of squares of what should be standard normal numbers, priors included, and how many are free: less
        the transients' unknowns and the combinations of parameters that are determined.
    iterations, converged : of the best start.
    residuals : one a block.
    starts : chi2 reached from each start, infinite where it failed.
    priors : used, by name. held : parameters that ended at the smallest value that physics allows, and moments of
        inertia that ended at the largest; for these, and for parameters correlated with them, the information describes
        a normal distribution that is truncated there.
    """

    model: Fitted
    information: Information
    chi2: float
    dof: int
    iterations: int
    converged: bool
    residuals: tuple[Residual, ...]
    starts: tuple[float, ...]
    priors: Mapping[str, Prior] = field(default_factory=dict)
    held: tuple[str, ...] = ()

    @property
    def values(self) -> np.ndarray:
        return self.model.values

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / self.dof


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """chi2 and its expansion: gradient -J^T e and H = J^T J in the coordinates of the descent; F = J^T J in the
    parameters' units, less the weights' cost."""

    chi2: float
    gradient: np.ndarray
    H: np.ndarray
    F: np.ndarray


def fit(model: Fitted, blocks: Sequence[SpectralBlock], priors: Mapping[str, Prior] | None = None,
        starts: int = 1, spread: float = 0.1, seed: int = 1, max_iterations: int = 60,
        progress: Callable[[str], None] | None = None, about: Fitted | None = None) -> LikelihoodFit[Fitted]:
    """The most likely parameters of `model.names`, from its present values.

    Parameters
    ----------
    blocks : data with the covariance of their noise.
    priors : (mean, standard deviation) of parameters, in their units.
    starts : how many starting points; the first is the model itself, the others are `spread` (relative) about it.
    about : the model whose values scale the steps and set the bounds, `model` by default. A fit that continues an
        earlier one passes that one's start: a parameter that ended near zero would make a useless scale.

    Raises
    ------
    InputError : no parameters, blocks without noise, priors of unknown parameters.
    ComputationError : no start came to a finite chi-square.
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
                begin = _thinned_descent(begin, blocks, priors, about, max_iterations)
            descent = _Descent(begin, blocks, whiteners, priors, about)
            descent.run(max_iterations)
            reached.append((descent.now.chi2, descent))
        else:
            reached.append((np.inf, None))
        if progress:
            progress(f"start {k + 1} of {starts}: chi-square {reached[-1][0]:.6g}")
    chi2, best = min(reached, key=lambda pair: pair[0])
    if best is None or not np.isfinite(chi2):
        raise ComputationError("no starting point of the fit reached a finite chi-square", measured=f"{chi2}",
                               cause="data that are zero or far from this rig",
                               next_step="check the findings of the gates, and start from better values")
    now = best.now
    residuals = tuple(block_residual(best.model, block, L, derivative=False)[2]
                      for block, L in zip(blocks, whiteners, strict=True))
    unknown = sum(transient_unknowns(block, model) for block in blocks)
    information = Information(model.names, best.model.values, model.units, now.F, about.scales())
    dof = sum(block.numbers for block in blocks) + len(priors) - unknown - information.rank
    return LikelihoodFit(best.model, information, now.chi2, dof, best.iterations, best.converged,
                         residuals, tuple(value for value, _ in reached), priors,
                         tuple(name for name, low in zip(model.names, best.at_lowest(), strict=True) if low))


def _thinned_descent(begin: Fitted, blocks, priors, first: Fitted, max_iterations: int) -> Fitted:
    """A first descent on some of the lines: from afar it leads to the same place, in less time."""
    few = [thinned(block, max(SETTINGS.thin_lines, len(block.omega) // SETTINGS.thin_by)) for block in blocks]
    descent = _Descent(begin, few, [whitener(block) for block in few], priors, first)
    descent.run(max_iterations)
    return descent.model


class _Box:
    """Coordinates x (n_p,), theta = basis @ x, in which the limits of a model's parameters are low and high (n_p,).

    They are the parameters in relative units but for moments of inertia: where all three are free, each stands for the
    sum of the other two less itself. A thin plate starts at the limit itself, or beside it by round-off; one that the
    starting values violate by more than `edge` is none.
    """

    def __init__(self, first: FrequencyModel):
        rows, values = moment_rows(first.names), first.values
        self.low, self.high = first.bounds()
        forward = np.eye(len(values))
        for row in rows:
            k = int(np.argmin(row))
            room, size = float(row @ values), SETTINGS.edge * float(np.abs(row) @ np.abs(values))
            forward[k], self.low[k] = row, min(size, room) if room >= -size else -np.inf
        self.scale = first.scales()
        self.forward, self.basis = forward / self.scale[:, None], np.linalg.inv(forward) * self.scale
        self.low, self.high = self.low / self.scale, self.high / self.scale


class _Descent(Generic[Fitted]):
    """One Levenberg-Marquardt run."""

    def __init__(self, model: Fitted, blocks, whiteners, priors, first: Fitted):
        self.model, self.blocks, self.whiteners, self.priors = model, blocks, whiteners, priors
        self.box = _Box(first)
        self.now = self.evaluate(model)
        self.iterations, self.converged = 0, False

    def evaluate(self, model: Fitted, derivative: bool = True) -> _Quadratic:
        """chi2 at a model, with its expansion if asked for."""
        n_p = len(model.names)
        chi2, g, H, F = 0.0, np.zeros(n_p), np.zeros((n_p, n_p)), np.zeros((n_p, n_p))
        _ = model.matrices, derivative and model.derivative_matrices  # formed once, before the threads ask for them
        work = partial(block_residual, model, derivative=derivative)
        # Large arrays in few calls, which leave the interpreter free: threads serve, and keep the order of the sums.
        if sum(len(block.omega) for block in self.blocks) < SETTINGS.few_lines:
            parts = list(map(work, self.blocks, self.whiteners))
        else:
            with ThreadPoolExecutor(min(len(self.blocks), os.cpu_count() or 1)) as threads:
                parts = list(threads.map(work, self.blocks, self.whiteners))
        for e, J, residual in parts:
            chi2 += float(e @ e)
            if derivative:
                g -= J @ e
                own = J @ J.T
                H += own
                F += own / weight_cost(residual.block)
        for name, (mean, sigma) in self.priors.items():
            j = model.names.index(name)
            chi2 += ((mean - model.values[j]) / sigma) ** 2
            g[j] -= (mean - model.values[j]) / sigma ** 2
            H[j, j] += 1 / sigma ** 2
            F[j, j] += 1 / sigma ** 2
        basis = self.box.basis
        return _Quadratic(chi2, basis.T @ g, basis.T @ H @ basis, F)

    def run(self, max_iterations: int) -> None:
        damping = 1e-3
        while self.iterations < max_iterations and not self.converged:
            step, promised = self._step(damping)
            if promised < 1e-6 * max(1.0, 1e-3 * self.now.chi2 / len(self.model.names)) + 1e-12 * self.now.chi2:
                # Of a step that only damping makes small nothing is known.
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
                    # No smaller chi-square in any direction: the end of what arithmetic resolves.
                    self.converged = promised < 1e-3
                    break

    def _step(self, damping: float) -> tuple[np.ndarray, float]:
        """Step of x inside the box, and the decrease of chi2 that the expansion predicts for it.

        H is scaled to a unit diagonal before its eigenvalues decide what is determined.
        """
        H, g, x = self.now.H, self.now.gradient, self.box.forward @ self.model.values
        size = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(H / np.outer(size, size))
        known = values > SETTINGS.known * values[-1]
        values, V = values[known], vectors[:, known]
        low, high = np.minimum((self.box.low - x) * size, 0.0), np.maximum((self.box.high - x) * size, 0.0)
        # No parameter by more than its reach at once: what the data hardly know is held back first.
        down, up = self.model.reach()
        while True:
            root = np.sqrt(values + damping)
            step = lsq_linear(root[:, None] * V.T, -(V.T @ (g / size)) / root, (low, high),
                              method="bvls").x / size
            moved = self.box.basis @ step / self.box.scale
            largest = np.max(np.abs(moved) / np.where(moved > 0, up, down))
            if largest <= 1 or damping >= 1.0:
                break
            damping *= 4
        step /= max(largest, 1.0)
        return step, float(-(2 * g @ step + step @ H @ step))

    def at_lowest(self) -> np.ndarray:
        """(n_p,) parameters at the smallest value that physics allows, and moments of inertia at the largest."""
        return self.box.forward @ self.model.values <= self.box.low + SETTINGS.near

    def _try(self, step: np.ndarray) -> tuple[Fitted, float] | None:
        x = np.clip(self.box.forward @ self.model.values + step, self.box.low, self.box.high)
        try:
            model = self.model.at(self.box.basis @ x)
        except InputError:
            return None  # no rig has these parameters: a shorter step
        chi2 = self.evaluate(model, derivative=False).chi2
        return (model, chi2) if np.isfinite(chi2) else None


def block_residual(model: FrequencyModel, block: SpectralBlock, L: np.ndarray, *, derivative: bool
                    ) -> tuple[np.ndarray, np.ndarray, Residual]:
    """Real residual e (N,) of unit variance, its negative Jacobian J (n_p, N), both free of the transient."""
    if not block.transient:
        found = model.answer(block, None, derivative)
        error = block.Y - found.Y
        white = whitened(L, error)
        J = whitened_real(L, found.dY) if derivative else np.empty(0)
        return as_real(white[None])[0], J, Residual(block, error, white / np.sqrt(2), np.zeros_like(error))
    columns, norms = transient_columns(block, model)
    plain = block.Y - model.answer(block, None, False).Y
    T = as_real(np.moveaxis(whitened(L, columns), -1, 0))
    Q, X = span(T.T)
    e = as_real(whitened(L, plain)[None])[0]
    x = X @ (Q.T @ e)
    transient = (columns @ x)[:, :, None]
    white = whitened(L, plain - transient)
    e = as_real(white[None])[0]
    J = np.empty(0)
    if derivative:
        body, inner = transient_parts(x, norms, block, model)
        J = whitened_real(L, model.answer(block, body, inner=inner).dY)
        J -= (Q @ (Q.T @ J.T)).T  # parameters come last in memory
    return e, J, Residual(block, plain - transient, white / np.sqrt(2), transient)


def added_terms(model: FrequencyModel, blocks: Sequence[SpectralBlock], columns: Sequence[np.ndarray]
                ) -> tuple[np.ndarray, np.ndarray]:
    """H (k, k) and g (k,) with chi2 = chi2_0 + s^T H s - 2 g^T s for outputs that hold s times k known terms beside the
    model's, the parameters moved along to where chi2 is least (to first order) and the transients taken out.

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
            T = as_real(np.moveaxis(whitened(L, transient_columns(block, model)[0]), -1, 0))
            Q, _ = span(T.T)
            c = c - (c @ Q) @ Q.T
        rows = np.concatenate([J * scale[:, None], c])
        H += rows @ rows.T
        g += rows @ e
    size = np.sqrt(np.maximum(np.diag(H)[:n_p], np.finfo(float).tiny))
    inner = np.linalg.pinv(H[:n_p, :n_p] / np.outer(size, size), rcond=1e-11, hermitian=True)
    across = H[n_p:, :n_p] / size
    return H[n_p:, n_p:] - across @ inner @ across.T, g[n_p:] - across @ inner @ (g[:n_p] / size)


def whitener(block: SpectralBlock) -> np.ndarray:
    """(n, 1 or m, n_y, n_y) sqrt(2) inv(chol(C)), with the correction for a covariance that was itself estimated.

    The inverse of a Wishart matrix of n_y outputs and dof degrees of freedom is too large by dof/(dof - n_y).
    """
    if block.noise is None:
        raise InputError("expected the covariance of its noise", field=f"block {block.name}")
    n_y = block.noise.shape[-1]
    if block.dof <= n_y:
        raise InputError(f"expected more than {n_y} degrees of freedom in the noise covariance",
                         field=f"block {block.name}", value=block.dof)
    try:
        factor = np.linalg.cholesky(block.noise)
    except np.linalg.LinAlgError:
        raise InputError("expected a positive definite noise covariance on every line; a channel without noise, or two "
                         "channels that repeat each other, leave it singular", field=f"block {block.name}") from None
    correction = 1.0 if np.isinf(block.dof) else (block.dof - n_y) / block.dof
    return np.sqrt(2 * correction) * np.linalg.inv(factor)


def weight_cost(block: SpectralBlock) -> float:
    """By how much the variance of an estimate with estimated weights exceeds that with the true ones.

    For weights inv(C_k) of independent complex Wishart matrices of p outputs and nu degrees of freedom, the errors of
    a weighted least squares follow from E inv(W) and E inv(W)^2 (Maiwald and Kraus, IEE Proc. Radar 147, 2000): the
    ratio is nu (nu - p) / ((nu - p)^2 - 1). Of less than a degree of freedom above p there is no such moment.
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
    """(p, N) `as_real` of `whitened` dY (p, n, n_y, m), for many p: these come last in memory."""
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


def transient_unknowns(block: SpectralBlock, model: FrequencyModel) -> int:
    """How many unknowns the transient of a block has."""
    return len(transient_columns(block.lines(np.arange(1)), model)[1]) if block.transient else 0


def _moved(model: Fitted, spread: float, rng: np.random.Generator) -> Fitted | None:
    """Another start: each parameter a random factor away; None where no rig has the draw."""
    box = _Box(model)
    for _ in range(20):
        try:
            moved = model.at(model.values + box.scale * spread * rng.uniform(-1, 1, len(model.names)))
        except InputError:
            continue
        if np.all((box.forward @ moved.values > box.low) & (box.forward @ moved.values < box.high)):
            return moved
    return None


def _check(model: FrequencyModel, blocks, priors, starts: int) -> None:
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
            raise InputError("expected a finite mean and a positive standard deviation", field=f"prior of {name}",
                             value=(mean, sigma))

