"""Fit of a table to records by penalised least squares, with the model evidence by Laplace's approximation.

    -2 log p(y, z) = |e(z)|^2 + log det C + |z|^2,    evidence = p(y, z) / sqrt(det(J J^T + I))

z are standardised parameters; the transients of the records are projected out of the whitened residual e.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from avis_ctrl.errors import InputError
from avis_ctrl.identification.clusters import cluster_moves, clusterings, covering
from avis_ctrl.identification.fit_settings import SETTINGS, FitSettings
from avis_ctrl.identification.maximum_likelihood import Transient, block_residual, price_of_transient
from avis_ctrl.identification.priors import Priors, Tolerance
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.variances import Group, Variances, bands, estimated, log_prior, mean_noise
from avis_ctrl.identification.weights import Weights, path_contributions, weigh


@dataclass(frozen=True, eq=False)
class Data:
    """Blocks that are fitted together, and the level [V] of each."""

    blocks: tuple[SpectralBlock, ...]
    levels: tuple[float, ...]

    @staticmethod
    def of(blocks: Sequence[SpectralBlock], levels: Mapping[str, float], lines: int) -> Data:
        """Some lines of each block; levels [V] by record. Equal lines are one array, so that models can reuse what they
        have computed on them (`response.kept_lines`)."""
        known: dict[bytes, np.ndarray] = {}
        few = [thinned(block, lines) for block in blocks]
        shared = (replace(block, omega=known.setdefault(block.omega.tobytes(), block.omega)) for block in few)
        return Data(tuple(shared), tuple(levels[block.name] for block in blocks))


@dataclass(frozen=True, eq=False)
class Evaluated:
    """e (N,) whitened residual, J (n, N) its negative derivative by z, left (n, n_y) residual per block in the unit of
    y. transients : of the blocks, to which e and J belong."""

    e: np.ndarray
    J: np.ndarray
    left: list[np.ndarray]
    transients: Sequence[Transient] = ()


@dataclass(frozen=True, eq=False)
class Fitted:
    """The most probable parameters of a model.

    model : at the estimate. priors, z (n,), covariance (n, n) of z. variances : of path errors and distortion.
    log_evidence : Laplace. log_likelihoods : by level and band; the remainder of the evidence comes from the priors.
    iterations : Gauss-Newton steps. settings : of the fit. weights : of the data. white : residual and Jacobian,
        whitened by noise and distortion; both empty once only the evidence is needed (`bare`).
    """

    model: Any
    priors: Priors
    z: np.ndarray
    covariance: np.ndarray
    variances: Variances
    log_evidence: float
    log_likelihoods: Mapping[Group, float]
    iterations: int
    settings: FitSettings
    weights: Weights
    white: Evaluated

    def bare(self) -> Fitted:
        """The fit without residual, Jacobian and weights, which take most of the memory."""
        return replace(self, weights=Weights((), (), {}, {}), white=Evaluated(np.empty(0), np.empty((0, 0)), []))

    @cached_property
    def e(self) -> np.ndarray:
        """(N,) residual, with the path errors integrated out."""
        return self.weights.flatten(self.white.e[None])[0]

    @property
    def J(self) -> np.ndarray:
        """(n, N) negative derivative of `e` by z; not cached, because it is large."""
        return self.weights.flatten(self.white.J)

    @property
    def rows(self) -> Mapping[Group, np.ndarray]:
        """Entries of `e` by level and band."""
        return self.weights.rows

    @property
    def labels(self) -> tuple[str, ...]:
        """Effects of the model, except the second-order terms."""
        return tuple(self.model.labels)

    def moved(self, names: Sequence[str]) -> tuple[Tolerance, ...]:
        """Values of the rig file that have a tolerance, those that moved most first."""
        units = dict(zip(self.model.names, self.model.units, strict=True))
        at = [self.priors.names.index(name) for name in names]
        values, slopes = self.priors.values(self.z), self.priors.slopes(self.z)
        std = np.sqrt(np.max([one.diagonal() for one in (self.covariance, *self._by_clusters)], axis=0))
        found = [
            Tolerance(name, float(values[k]), float(std[k] * slopes[k]), float(self.z[k]), units[name])
            for name, k in zip(names, at, strict=True)
        ]
        return tuple(sorted(found, key=lambda one: -abs(one.moved)))

    def covariance_of(self, names: Sequence[str]) -> np.ndarray:
        """(k, k) of some parameters in their units; zero for parameters that are not free.

        In every direction at least the covariance of the model and those from differences of octaves and levels
        (`clusters`).
        """
        free = [k for k, name in enumerate(names) if name in self.priors.names]
        rows = [self.priors.names.index(names[k]) for k in free]
        own = self.covariance[np.ix_(rows, rows)]
        for robust in self._by_clusters if rows else ():
            own = covering(own, robust[np.ix_(rows, rows)])
        found, slopes = np.zeros((len(names), len(names))), self.priors.slopes(self.z)[rows]
        found[np.ix_(free, free)] = own * slopes * slopes[:, None]
        return found

    def whole_covariance(self) -> np.ndarray:
        """(n, n) of all parameters in their units: that of the model times one factor, by which octaves or levels
        differ more than it predicts. The factor is a mean over all directions, because there are more directions than
        octaves."""
        ratios = [float(np.mean(np.diag(np.linalg.solve(self.covariance, one)))) for one in self._by_clusters]
        slopes = self.priors.slopes(self.z)
        return np.asarray(max(1.0, *ratios) * self.covariance * slopes * slopes[:, None])

    @cached_property
    def _by_clusters(self) -> tuple[np.ndarray, np.ndarray]:
        """(n, n) covariances of z from the differences of octaves and of levels; the model's own for a fit without its
        residual, or with one cluster."""
        if not len(self.white.e):
            return self.covariance, self.covariance

        J = self.J

        def robust(parts: Sequence[Sequence[Group]]) -> np.ndarray:
            rows = [np.concatenate([self.weights.rows[group] for group in part]) for part in parts]
            if len(rows) == 1:
                return self.covariance
            moves = cluster_moves(self.covariance, J, self.e, rows, self.settings.least_elsewhere)
            return np.asarray(self.covariance @ self.covariance + moves.T @ moves)

        by_octave, by_level = clusterings(list(self.weights.rows), self.settings.bands_per_octave)
        return np.mean([robust(parts) for parts in by_octave], axis=0), robust(by_level)


def first_variances(data: Data, settings: FitSettings) -> Variances:
    """Initial variances: a relative error of every path, and distortion as a fraction of it."""
    path: dict[int, np.ndarray] = {}
    distortion: dict[Group, np.ndarray] = {}
    count: dict[Group, int] = {}
    for block, level in zip(data.blocks, data.levels, strict=True):
        own = bands(block.omega, settings.bands_per_octave)
        for band in np.unique(own):
            at, group = own == band, (level, int(band))
            path[int(band)] = np.full(block.Y.shape[1], settings.first_error**2)
            power = settings.first_error**2 * np.sum(np.abs(block.Y[at, :, 0]) ** 2, axis=0)
            distortion[group] = distortion.get(group, 0.0) + settings.first_distortion * power
            count[group] = count.get(group, 0) + int(at.sum())
    return Variances(path, {group: value / count[group] for group, value in distortion.items()})


@dataclass(frozen=True, eq=False)
class _Expansion:
    """Quadratic expansion of the penalised sum of squares at z (n,): cost + |z|^2, with H (n, n) and g (n,) of cost."""

    model: Any
    z: np.ndarray
    now: Evaluated
    H: np.ndarray
    g: np.ndarray
    cost: float

    @property
    def whole(self) -> float:
        return self.cost + float(self.z @ self.z)


def descent(
    expand: Callable[[np.ndarray, bool, Evaluated | None], _Expansion],
    z: np.ndarray,
    priors: Priors,
    iterations: int,
    settings: FitSettings,
) -> tuple[_Expansion, int]:
    """Gauss-Newton steps from z, each damped until it descends (Levenberg 1944); the last expansion, and the number of
    steps.

    expand : expansion at z. The flag asks for the derivative; without it, only the sum of squares is needed. The last
        argument is an evaluation whose transients are kept, as in a small step, or None. Raises InputError if no rig
        has these values.

    All parameters stay within their bounds; with a parameter at its bound, the remaining ones still reach their
    optimum.

    Damping shortens a step along poorly determined directions and hardly changes it along well determined ones. Along a
    poorly determined combination, the effect on well determined ones is more nonlinear than the expansion shows.
    Shortening the step as a whole hardly corrects this, and leads to ever shorter steps.
    """
    needed, bounds = 0.0, priors.bounds
    at = expand(np.clip(z, *bounds), True, None)
    for steps in range(iterations):
        undamped = _bounded_step(at, 0.0, bounds)
        expected = (undamped - at.z) @ (at.g - at.z)
        if expected < settings.converged * len(at.now.e):
            return at, steps
        near = at.now if expected < settings.settled else None
        for damping in _dampings(at.H, needed, settings):
            z = priors.stepped(at.z, _bounded_step(at, damping, bounds) if damping else undamped)
            try:
                # For a step that may be rejected, the derivative is not needed yet.
                if not (damping or needed) or expand(z, False, at.now).whole < at.whole:
                    after = expand(z, True, near)
                    if after.whole < at.whole:
                        at, needed = after, damping
                        break
            except InputError:
                pass  # no rig has these values: try a shorter step
        else:
            return at, steps
    return at, iterations


def _bounded_step(at: _Expansion, damping: float, bounds: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """z (n,) after a damped Gauss-Newton step within bounds.

    Parameters that would leave their bounds are set to them, and the step of the remaining ones is solved again. A
    parameter stays at its bound as long as the sum of squares decreases only beyond it.
    """
    slope, (low, high) = at.g - at.z, bounds
    M = at.H + (1 + damping) * np.eye(len(at.z))
    z = at.z.copy()
    free = ~((z <= low) & (slope < 0) | (z >= high) & (slope > 0))
    while np.any(free):
        moved = z - at.z
        z[free] = at.z[free] + np.linalg.solve(
            M[np.ix_(free, free)], slope[free] - M[np.ix_(free, ~free)] @ moved[~free]
        )
        beyond = free & ((z < low) | (z > high))
        if not np.any(beyond):
            break
        z = np.clip(z, low, high)
        free &= ~beyond
    return z


def _dampings(H: np.ndarray, last: float, settings: FitSettings) -> Iterator[float]:
    """Dampings to try, increasing from somewhat below the last one needed, or from none, until almost nothing of a
    Gauss-Newton step remains."""
    damping, most = last / settings.damping**2, (1 + np.linalg.norm(H, 2)) / settings.shortest_step
    if damping < 1:
        yield 0.0
        damping = 1.0
    while damping < most:
        yield damping
        damping *= settings.damping


def fit(
    model: Any, priors: Priors, z: np.ndarray, data: Data, variances: Variances, settings: FitSettings = SETTINGS
) -> Fitted:
    """Alternate Gauss-Newton steps in z with estimates of the variances.

    Until the log-likelihood settles, only the distortion is estimated, then the path errors, too. Otherwise path errors
    would explain at once what the parameters explain after a few more steps.
    """
    steps, best, noise, released = 0, None, mean_noise(data.blocks, data.levels, settings), False
    begun = model = model.at(priors.values(z))
    for k in range(settings.rounds + 1):
        paths = [path_contributions(model, block) for block in data.blocks]
        weights = weigh(data.blocks, data.levels, paths, variances, settings)

        def expand(z: np.ndarray, derivative: bool, near: Evaluated | None, weights: Weights = weights) -> _Expansion:
            moved = begun.at(priors.values(z))
            now = _evaluate(moved, priors, z, data, weights, derivative, near)
            return _Expansion(moved, z, now, *weights.normal_equations(now.J, now.e))

        at, more = descent(expand, z, priors, settings.iterations, settings)
        model, z, steps = at.model, at.z, steps + more
        reached = -0.5 * (at.whole + weights.log_determinant) + log_prior(variances, noise, settings)
        rise = reached - best[0] if best else np.inf
        if rise > 0:
            best = reached, at, weights, variances
        if k == settings.rounds or (released and rise < settings.settled):
            break
        released = released or rise < settings.settled or k == settings.rounds - 1
        variances = estimated(at.now.left, data.blocks, data.levels, paths, variances, settings, hold_path=not released)
    assert best is not None
    reached, at, weights, variances = best
    H = at.H + np.eye(len(at.z))
    log_evidence = reached - _price_of_ends(at.model, data, weights) - 0.5 * np.linalg.slogdet(H)[1] - priors.log_inside
    by_group = _by_group(weights, weights.flatten(at.now.e[None])[0])
    # By eigenvalues: with poorly determined directions, round-off makes `inv` neither symmetric nor positive definite.
    size, vectors = np.linalg.eigh(H)
    root = vectors / np.sqrt(np.maximum(size, 1.0))  # the priors contribute at least 1
    return Fitted(
        at.model,
        priors,
        at.z,
        root @ root.T,
        variances,
        float(log_evidence),
        by_group,
        steps,
        settings,
        weights,
        at.now,
    )


def without_path_errors(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> Fitted:
    """The fit with minimum path errors, so that distortion represents everything that is not explained.

    Path errors remove missing effects from the residual, and with them the indication of where a missing effect lies.
    The evidence is not comparable with that of other fits.
    """
    paths = [path_contributions(fitted.model, block) for block in data.blocks]
    path = {band: np.full_like(v, settings.least_error**2) for band, v in fitted.variances.path.items()}
    left = fitted.white.left or [
        block_residual(fitted.model, block, np.sqrt(2) * np.eye(block.Y.shape[1])[None, None], derivative=False)[
            2
        ].error[:, :, 0]
        for block in data.blocks
    ]
    start = Variances(path, fitted.variances.distortion)
    variances = estimated(left, data.blocks, data.levels, paths, start, settings, hold_path=True)
    return fit(fitted.model, fitted.priors, fitted.z, data, variances, replace(settings, rounds=0))


def _price_of_ends(model: Any, data: Data, weights: Weights) -> float:
    """`price_of_transient` of all blocks."""
    return sum(price_of_transient(model, block, L[:, None]) for block, L in zip(data.blocks, weights.L, strict=True))


class Profile:
    """A fit to which a few parameters are added; those of the fit follow to first order (profile likelihood).

    basis : (n, N + n) orthonormal rows that span its Jacobian, with the priors appended to the data.
    """

    def __init__(self, fitted: Fitted, data: Data, settings: FitSettings = SETTINGS):
        self.fitted, self.data, self.settings = fitted, data, settings
        root = np.linalg.cholesky(np.linalg.inv(fitted.covariance))
        self.basis = solve_triangular(root, np.concatenate([fitted.J, np.eye(len(fitted.z))], axis=1), lower=True)
        self.e = self.free(fitted.white.e[None], -fitted.z)[0]

    def free(self, white: np.ndarray, prior: np.ndarray | float = 0.0) -> np.ndarray:
        """(k, N + n) of whitened rows (k, N), with those of the priors (n,), after projecting out the fit's
        parameters."""
        rows = self.fitted.weights.flatten(white)
        rows = np.concatenate([rows, np.broadcast_to(prior, (len(rows), len(self.fitted.z)))], axis=1)
        return rows - (rows @ self.basis.T) @ self.basis

    @cached_property
    def _price_of_ends(self) -> float:
        return _price_of_ends(self.fitted.model, self.data, self.fitted.weights)

    @cached_property
    def _white_basis(self) -> np.ndarray:
        """(N, n) whose products with whitened rows are those of `basis` with the flattened rows."""
        return self.fitted.weights.flatten(self.basis[:, : -len(self.fitted.z)]).T.copy()

    def fit(
        self, model: Any, priors: Priors, z: np.ndarray, iterations: int, at: np.ndarray | None = None
    ) -> tuple[np.ndarray, float, float]:
        """z (k,) of the added parameters, the free ones of `model`; the gain of log evidence with them, and the
        decrease of the penalised sum of squares.

        at : (n,) standardised parameters of the fit in `model`; where the fit ended by default.

        Raises InputError if no table has the initial values.
        """
        rest = -(self.fitted.z if at is None else at)
        weights = self.fitted.weights

        def expand(z: np.ndarray, derivative: bool, near: Evaluated | None) -> _Expansion:
            moved = model.at(priors.values(z))
            now = _evaluate(moved, priors, z, self.data, weights, derivative, near)
            # The products of the rows that `free` would return.
            H, g, cost = weights.normal_equations(now.J, now.e)
            A, b = now.J @ self._white_basis, now.e @ self._white_basis + self.basis[:, len(now.e) :] @ rest
            return _Expansion(moved, z, now, H - A @ A.T, g - A @ b, cost + float(rest @ rest - b @ b))

        end, _ = descent(expand, z, priors, iterations, self.settings)
        fall = float(self.e @ self.e) - end.whole
        gain = 0.5 * (fall - np.linalg.slogdet(end.H + np.eye(len(z)))[1])
        gain += self._price_of_ends - _price_of_ends(end.model, self.data, weights) - priors.log_inside
        return end.z, gain, fall


def log_likelihood(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> float:
    """Log-likelihood of records that were not fitted, with the fitted parameters and variances. The states at the
    records' ends are integrated out."""
    weights, flat = unseen(fitted, data, settings)
    return sum(_by_group(weights, flat).values()) - _price_of_ends(fitted.model, data, weights)


def unseen(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> tuple[Weights, np.ndarray]:
    """Weights and (N,) residual of records that were not fitted, as `Fitted.weights` and `Fitted.e`."""
    paths = [path_contributions(fitted.model, block) for block in data.blocks]
    weights = weigh(data.blocks, data.levels, paths, fitted.variances, settings)
    own = _evaluate(fitted.model, fitted.priors, fitted.z, data, weights, derivative=False)
    return weights, weights.flatten(own.e[None])[0]


def _by_group(weights: Weights, flat: np.ndarray) -> dict[Group, float]:
    return {
        group: -0.5 * float(flat[rows] @ flat[rows] + weights.log_determinants[group])
        for group, rows in weights.rows.items()
    }


def _evaluate(
    model: Any,
    priors: Priors,
    z: np.ndarray,
    data: Data,
    weights: Weights,
    derivative: bool = True,
    near: Evaluated | None = None,
) -> Evaluated:
    """near : whose transients are kept."""
    blocks = [(block, L[:, None]) for block, L in zip(data.blocks, weights.L, strict=True)]
    transients = near.transients if near else [Transient.of(model, *one) for one in blocks]
    parts = [
        transient.residual(model, *one, derivative=derivative)
        for transient, one in zip(transients, blocks, strict=True)
    ]
    e = np.concatenate([one[0] for one in parts])
    J = np.empty((len(z) if derivative else 0, len(e)))
    start, slopes = 0, priors.slopes(z)[:, None]
    for own, rows, _ in parts if derivative else ():
        np.multiply(rows, slopes, out=J[:, start : start + len(own)])
        start += len(own)
    return Evaluated(e, J, [left for _, _, left in parts], transients)
