"""Fit of a table to records by penalised least squares, with the model evidence by Laplace's approximation.

    -2 log p(y, z) = |e(z)|^2 + log det C + |z|^2,    evidence = p(y, z) / sqrt(det(J J^T + I))

z are standardised parameters; the transients of the records are removed from the whitened residual e (`transients`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr

from avis_ctrl.errors import InputError
from avis_ctrl.identification.clusters import ClusterCovariance, cluster_moves, clusterings, widening
from avis_ctrl.identification.fit_settings import SETTINGS, FitSettings
from avis_ctrl.identification.maximum_likelihood import (
    as_complex,
    as_real,
    block_residual,
    weight_cost,
    whitened,
    whitened_real,
)
from avis_ctrl.identification.priors import Priors, Tolerance
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.transients import Transients
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
    y. transients : of the blocks, which were removed from e and J. along : `Weights.along` of (J, e)."""

    e: np.ndarray
    J: np.ndarray
    left: list[np.ndarray]
    transients: Transients
    along: Sequence[np.ndarray] = ()


@dataclass(frozen=True, eq=False)
class Fitted:
    """The most probable parameters of a model.

    model : at the estimate. priors, z (n,), covariance (n, n) of z. variances : of path errors and distortion.
    log_evidence : Laplace. weight_cost : factor by which estimated noise weights increase the variances.
    log_likelihoods : by level and band; the remainder of the evidence comes from the priors. iterations : Gauss-Newton
    steps. settings : of the fit. weights : of the data. white : residual and Jacobian, whitened by noise and
    distortion; both empty once only the evidence is needed (`bare`).
    """

    model: Any
    priors: Priors
    z: np.ndarray
    covariance: np.ndarray
    variances: Variances
    log_evidence: float
    weight_cost: float
    log_likelihoods: Mapping[Group, float]
    iterations: int
    settings: FitSettings
    weights: Weights
    white: Evaluated

    def bare(self) -> Fitted:
        """The fit without residual, Jacobian and weights, which take most of the memory."""
        return replace(
            self, weights=Weights((), (), {}, {}), white=Evaluated(np.empty(0), np.empty((0, 0)), [], Transients.none())
        )

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
        found = [
            Tolerance(name, float(values[k]), float(self._std[k] * slopes[k]), float(self.z[k]), units[name])
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
        own = self.weight_cost * self.covariance[np.ix_(rows, rows)]
        for robust in self._by_clusters if rows else ():
            own = robust.covering(own, rows)
        found, slopes = np.zeros((len(names), len(names))), self.priors.slopes(self.z)[rows]
        found[np.ix_(free, free)] = own * slopes * slopes[:, None]
        return found

    def whole_covariance(self) -> np.ndarray:
        """(n, n) of all parameters in their units: the standard deviations are those of `covariance_of`, the
        correlations those of the model, because there are more directions than octaves."""
        wider = self._std / np.sqrt(np.diag(self.covariance)) * self.priors.slopes(self.z)
        return np.asarray(self.covariance * wider * wider[:, None])

    @cached_property
    def _std(self) -> np.ndarray:
        """(n,) standard deviations of z, as those of `covariance_of`."""
        variance = self.weight_cost * np.diag(self.covariance)
        for robust in self._by_clusters:
            variance = variance * widening(np.diag(robust.covariance) / variance, robust.clusters)
        return np.sqrt(variance)

    @cached_property
    def _by_clusters(self) -> list[ClusterCovariance]:
        """Covariances of z from the differences of octaves and of levels; none for a fit without its residual, or with
        one cluster."""
        if not len(self.white.e):
            return []
        J = self.J

        def robust(divisions: Sequence[Sequence[Sequence[Group]]]) -> ClusterCovariance:
            found = []
            for parts in divisions:
                rows = [np.concatenate([self.weights.rows[group] for group in part]) for part in parts]
                moves = cluster_moves(self.covariance, J, self.e, rows, self.settings.least_elsewhere)
                found.append(self.covariance @ self.covariance + moves.T @ moves)
            return ClusterCovariance(np.mean(found, axis=0), float(np.mean([len(parts) for parts in divisions])))

        by_octave, by_level = clusterings(list(self.weights.rows), self.settings.bands_per_octave)
        several = [[parts for parts in one if len(parts) > 1] for one in (by_octave, [by_level])]
        return [robust(one) for one in several if one]


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


def _log_volume(at: _Expansion, priors: Priors) -> float:
    """log of the posterior's volume over that of the prior, by Laplace's approximation within the bounds.

    A normal distribution with the curvature of the expansion, at a bound also with its gradient, is integrated between
    the bounds of each parameter; the others follow to first order, and different parameters are taken as independent.
    If the sum of squares still falls from the bound inwards, the fit ended early; this slope is ignored, because the
    maximum that it predicts was not reached.
    """
    H, (low, high) = at.H + np.eye(len(at.z)), priors.bounds
    bounded = np.isfinite(low) | np.isfinite(high)
    std = np.sqrt(np.diag(np.linalg.inv(H))[bounded])
    outward = (at.z - at.g)[bounded] * std  # gradient of half the sum of squares, zero within the bounds
    at_low, at_high = (at.z <= low)[bounded], (at.z >= high)[bounded]
    outward = np.where(at_low, np.maximum(outward, 0.0), np.where(at_high, np.minimum(outward, 0.0), 0.0))
    below, above = ((end - at.z)[bounded] / std + outward for end in (low, high))
    # log(Phi(above) - Phi(below)) on the side where both are small.
    below, above = np.where(below > 0, -above, below), np.where(below > 0, -below, above)
    inside = log_ndtr(above) + np.log1p(-np.exp(log_ndtr(below) - log_ndtr(above))) + outward**2 / 2
    return float(-0.5 * np.linalg.slogdet(H)[1] - priors.log_inside + np.sum(inside))


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
            return _Expansion(moved, z, now, *weights.normal_equations(now.J, now.e, now.along))

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
    log_evidence = reached - at.now.transients.price + _log_volume(at, priors)
    by_group = _by_group(weights, weights.flatten(at.now.e[None])[0])
    # By eigenvalues: with poorly determined directions, round-off makes `inv` neither symmetric nor positive definite.
    size, vectors = np.linalg.eigh(at.H + np.eye(len(at.z)))
    root = vectors / np.sqrt(np.maximum(size, 1.0))  # the priors contribute at least 1
    return Fitted(
        at.model,
        priors,
        at.z,
        root @ root.T,
        variances,
        float(log_evidence),
        float(np.average([weight_cost(one) for one in data.blocks], weights=[one.numbers for one in data.blocks])),
        by_group,
        steps,
        settings,
        weights,
        at.now,
    )


def refit(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> Fitted:
    """The same model fitted again, from where it is: to other data, with other settings, or after a change of it."""
    return fit(fitted.model, fitted.priors, fitted.z, data, fitted.variances, settings)


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
        """(k, N + n) of whitened rows (k, N), with those of the priors (n,), after projecting out the transients and
        the fit's parameters."""
        rows = white.copy()
        self.fitted.white.transients.remove_from(rows)
        rows = self.fitted.weights.flatten(rows)
        rows = np.concatenate([rows, np.broadcast_to(prior, (len(rows), len(self.fitted.z)))], axis=1)
        return rows - (rows @ self.basis.T) @ self.basis

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
            H, g, cost = weights.normal_equations(now.J, now.e, now.along)
            A, b = now.J @ self._white_basis, now.e @ self._white_basis + self.basis[:, len(now.e) :] @ rest
            return _Expansion(moved, z, now, H - A @ A.T, g - A @ b, cost + float(rest @ rest - b @ b))

        end, _ = descent(expand, z, priors, iterations, self.settings)
        fall = float(self.e @ self.e) - end.whole
        gain = 0.5 * fall + _log_volume(end, priors) + self.fitted.white.transients.price - end.now.transients.price
        return end.z, gain, fall


def log_likelihood(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> float:
    """Log-likelihood of records that were not fitted, with the fitted parameters and variances. The states at the
    records' ends are integrated out."""
    weights, own = _unseen(fitted, data, settings)
    return sum(_by_group(weights, weights.flatten(own.e[None])[0]).values()) - own.transients.price


def unseen(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> tuple[Weights, np.ndarray]:
    """Weights and (N,) residual of records that were not fitted, as `Fitted.weights` and `Fitted.e`."""
    weights, own = _unseen(fitted, data, settings)
    return weights, weights.flatten(own.e[None])[0]


def _unseen(fitted: Fitted, data: Data, settings: FitSettings) -> tuple[Weights, Evaluated]:
    paths = [path_contributions(fitted.model, block) for block in data.blocks]
    weights = weigh(data.blocks, data.levels, paths, fitted.variances, settings)
    return weights, _evaluate(fitted.model, fitted.priors, fitted.z, data, weights, derivative=False)


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
    whiteners = [L[:, None] for L in weights.L]
    transients = near.transients if near else Transients.of(model, data.blocks, whiteners, weights.paths)
    e = np.empty(transients.rows[-1].stop)
    J, slopes = np.empty((len(z) if derivative else 0, len(e))), priors.slopes(z)[:, None]
    parts = list(zip(data.blocks, whiteners, transients.rows, transients.initial, strict=True))
    for block, L, rows, (body, inner) in parts:
        found = model.answer(block, body, derivative, inner)
        e[rows] = as_real(whitened(L, block.Y - found.Y)[None])[0]
        if derivative:
            np.multiply(whitened_real(L, found.dY), slopes, out=J[:, rows])
    of_e, of_J = transients.remove_from(e[None]), transients.remove_from(J)
    along = [np.concatenate(both) for both in zip(of_J, of_e, strict=True)]
    left = [np.linalg.solve(L[:, 0], as_complex(e[rows], block.Y.shape))[:, :, 0] for block, L, rows, _ in parts]
    return Evaluated(e, J, left, transients, along)
