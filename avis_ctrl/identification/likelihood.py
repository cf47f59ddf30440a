"""Fit of a table to records by penalised least squares, with the evidence for the model (Laplace).

    -2 log p(y, z) = |e(z)|^2 + log det C + |z|^2,    evidence = p(y, z) / sqrt(det(J J^T + I))

z are standardised parameters; the whitened residual e is free of the transients of the records.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from avis_ctrl.errors import InputError
from avis_ctrl.identification.fit_settings import SETTINGS, FitSettings
from avis_ctrl.identification.maximum_likelihood import block_residual, transient_unknowns
from avis_ctrl.identification.priors import Priors, Tolerance
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.weights import Group, Variances, Weights, bands, estimated, path_contributions, weigh


@dataclass(frozen=True, eq=False)
class Data:
    """Blocks that are fitted together, and the level [V] of each."""

    blocks: tuple[SpectralBlock, ...]
    levels: tuple[float, ...]

    @staticmethod
    def of(blocks: Sequence[SpectralBlock], levels: Mapping[str, float], lines: int) -> Data:
        """Some lines of each block; levels [V] by record. Equal lines are one array, so that models keep what they have
        computed on them (`response.kept_lines`)."""
        known: dict[bytes, np.ndarray] = {}
        few = [thinned(block, lines) for block in blocks]
        shared = (replace(block, omega=known.setdefault(block.omega.tobytes(), block.omega)) for block in few)
        return Data(tuple(shared), tuple(levels[block.name] for block in blocks))


@dataclass(frozen=True, eq=False)
class Evaluated:
    """e (N,) whitened residual, J (n, N) its negative derivative by z, left (n, n_y) a block in the unit of y."""

    e: np.ndarray
    J: np.ndarray
    left: list[np.ndarray]


@dataclass(frozen=True, eq=False)
class Fitted:
    """The most probable parameters of a model.

    model : at the estimate. priors, z (n,), covariance (n, n) of z. variances : of what is not explained.
    log_evidence : Laplace. log_likelihoods : by level and band; what is in the evidence beside their sum is of priors.
    iterations : Gauss-Newton steps. weights : of the data. white : residual and Jacobian, whitened by noise and
    distortion; both empty once only the evidence is of interest (`bare`).
    """

    model: Any
    priors: Priors
    z: np.ndarray
    covariance: np.ndarray
    variances: Variances
    log_evidence: float
    log_likelihoods: Mapping[Group, float]
    iterations: int
    weights: Weights
    white: Evaluated

    def bare(self) -> Fitted:
        """Without residual, Jacobian and weights, which take most of the memory."""
        return replace(self, weights=Weights((), (), {}), white=Evaluated(np.empty(0), np.empty((0, 0)), []))

    @cached_property
    def e(self) -> np.ndarray:
        """(N,) residual, path errors integrated out."""
        return self.weights.flatten(self.white.e[None])[0]

    @cached_property
    def J(self) -> np.ndarray:
        """(n, N) negative derivative of `e` by z."""
        return self.weights.flatten(self.white.J)

    @property
    def rows(self) -> dict[Group, np.ndarray]:
        """Entries of `e` by level and band."""
        return {one.group: one.rows for one in self.weights.paths}

    @property
    def labels(self) -> tuple[str, ...]:
        """Effects of the model but the second-order terms."""
        return tuple(self.model.labels)

    def moved(self, names: Sequence[str]) -> tuple[Tolerance, ...]:
        """Of values of the rig file that have a tolerance, the most moved first."""
        units = dict(zip(self.model.names, self.model.units, strict=True))
        values, std = self.priors.values(self.z), np.sqrt(np.diag(self.covariance)) * self.priors.slopes(self.z)
        at = [self.priors.names.index(name) for name in names]
        rows = [Tolerance(name, float(values[k]), float(std[k]), float(self.z[k]), units[name])
                for name, k in zip(names, at, strict=True)]
        return tuple(sorted(rows, key=lambda one: -abs(one.moved)))

    def covariance_of(self, names: Sequence[str]) -> np.ndarray:
        """(k, k) of some parameters in their units; zero for those that are not free."""
        slopes = self.priors.slopes(self.z)
        rows = [self.priors.names.index(name) if name in self.priors.names else -1 for name in names]
        return np.pad((self.covariance * slopes) * slopes[:, None], (0, 1))[np.ix_(rows, rows)]


def first_variances(data: Data, settings: FitSettings) -> Variances:
    """Where nothing is known yet: a relative error of every path, and distortion as a part of it."""
    path: dict[Group, np.ndarray] = {}
    distortion: dict[Group, np.ndarray] = {}
    count: dict[Group, int] = {}
    for block, level in zip(data.blocks, data.levels, strict=True):
        own = bands(block.omega, settings.bands_per_octave)
        for band in np.unique(own):
            at, group = own == band, (level, int(band))
            path[group] = np.full(block.Y.shape[1], settings.first_error ** 2)
            power = settings.first_error ** 2 * np.sum(np.abs(block.Y[at, :, 0]) ** 2, axis=0)
            distortion[group] = distortion.get(group, 0.0) + settings.first_distortion * power
            count[group] = count.get(group, 0) + int(at.sum())
    return Variances(path, {group: value / count[group] for group, value in distortion.items()})


@dataclass(frozen=True, eq=False)
class _Expansion:
    """The penalised sum of squares about z (n,): cost + |z|^2 at z, H (n, n) and g (n,) of cost by a step."""

    model: Any
    z: np.ndarray
    now: Evaluated
    H: np.ndarray
    g: np.ndarray
    cost: float

    @property
    def whole(self) -> float:
        return self.cost + float(self.z @ self.z)


def _descent(expand: Callable[[np.ndarray], _Expansion], at: _Expansion, iterations: int, settings: FitSettings
             ) -> tuple[_Expansion, int]:
    """Gauss-Newton steps, each shortened until it descends; the last expansion, and how many steps there were."""
    for steps in range(iterations):
        step = np.linalg.solve(at.H + np.eye(len(at.z)), at.g - at.z)
        if step @ (at.g - at.z) < settings.converged * len(at.now.e):
            return at, steps
        size, after = 1.0, None
        while size > settings.shortest_step:
            try:
                after = expand(at.z + size * step)
                if after.whole < at.whole:
                    break
            except InputError:
                pass  # no rig has these values: a shorter step
            size /= 3
        else:
            return at, steps
        assert after is not None
        at = after
    return at, iterations


def fit(model: Any, priors: Priors, z: np.ndarray, data: Data, variances: Variances, settings: FitSettings = SETTINGS
        ) -> Fitted:
    """Alternate Gauss-Newton steps in z with estimates of the variances."""
    steps, before = 0, -np.inf
    model = model.at(priors.values(z))
    for k in range(settings.rounds + 1):
        paths = [path_contributions(model, block) for block in data.blocks]
        weights = weigh(data.blocks, data.levels, paths, variances, settings)

        def expand(z: np.ndarray, model: Any = model, weights: Weights = weights) -> _Expansion:
            moved = model.at(priors.values(z))
            now = _evaluate(moved, priors, z, data, weights)
            return _Expansion(moved, z, now, *weights.normal_equations(now.J, now.e))
        at, more = _descent(expand, expand(z), settings.iterations, settings)
        model, z, steps = at.model, at.z, steps + more
        reached = -0.5 * (at.whole + weights.log_determinant) + _hyper(variances, settings)
        if k == settings.rounds or reached - before < settings.settled:
            break
        before, variances = reached, estimated(at.now.left, data.blocks, data.levels, paths, variances, settings)
    H = at.H + np.eye(len(z))
    log_evidence = reached - _price_of_ends(model, data) - 0.5 * np.linalg.slogdet(H)[1]
    by_group = _by_group(weights, weights.flatten(at.now.e[None])[0])
    return Fitted(model, priors, z, np.linalg.inv(H), variances, float(log_evidence), by_group, steps, weights, at.now)


def _price_of_ends(model: Any, data: Data) -> float:
    """The states at the ends of a record have no prior; each costs what one with unit information would (Schwarz 1978).
    """
    return sum(0.5 * transient_unknowns(block, model) * np.log(2 * block.Y.size) for block in data.blocks)


class Profile:
    """A fit to which a few parameters are added: those of the fit move along to first order (profile likelihood).

    basis : (n, N + n) orthonormal rows that span its Jacobian, with the priors as rows of their own below the data.
    """

    def __init__(self, fitted: Fitted, data: Data, settings: FitSettings = SETTINGS):
        self.fitted, self.data, self.settings = fitted, data, settings
        root = np.linalg.cholesky(np.linalg.inv(fitted.covariance))
        self.basis = solve_triangular(root, np.concatenate([fitted.J, np.eye(len(fitted.z))], axis=1), lower=True)
        self.e = self.free(fitted.white.e[None], -fitted.z)[0]

    def free(self, white: np.ndarray, prior: np.ndarray | float = 0.0) -> np.ndarray:
        """(k, N + n) of whitened rows (k, N), with those of the priors (n,), free of what the fit's parameters take."""
        rows = self.fitted.weights.flatten(white)
        rows = np.concatenate([rows, np.broadcast_to(prior, (len(rows), len(self.fitted.z)))], axis=1)
        return rows - (rows @ self.basis.T) @ self.basis

    def fit(self, model: Any, priors: Priors, z: np.ndarray, iterations: int, at: np.ndarray | None = None
            ) -> tuple[np.ndarray, float]:
        """z (k,) of the added parameters, the free ones of `model`, and the gain of log evidence with them.

        at : (n,) standardised parameters of the fit in `model`; where the fit ended by default.

        Raises InputError where no table has the values that it begins with.
        """
        rest = -(self.fitted.z if at is None else at)
        weights = self.fitted.weights

        def expand(z: np.ndarray) -> _Expansion:
            moved = model.at(priors.values(z))
            now = _evaluate(moved, priors, z, self.data, weights)
            J, e = self.free(now.J), self.free(now.e[None], rest)[0]
            return _Expansion(moved, z, now, J @ J.T, J @ e, float(e @ e))
        end, _ = _descent(expand, expand(z), iterations, self.settings)
        gain = 0.5 * (float(self.e @ self.e) - end.whole - np.linalg.slogdet(end.H + np.eye(len(z)))[1])
        return end.z, gain - _price_of_ends(end.model, self.data) + _price_of_ends(self.fitted.model, self.data)


def _hyper(variances: Variances, settings: FitSettings) -> float:
    """Logarithm of the prior of the path variances, but for a constant."""
    nu, v0 = settings.error_weight, settings.least_error ** 2
    return sum(float(np.sum(-(nu / 2 + 1) * np.log(v) - nu * v0 / (2 * v))) for v in variances.path.values())


def log_likelihoods(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> dict[Group, float]:
    """Of records that no fit has seen, by level and band, by the fitted parameters and variances."""
    return _by_group(*unseen(fitted, data, settings))


def unseen(fitted: Fitted, data: Data, settings: FitSettings = SETTINGS) -> tuple[Weights, np.ndarray]:
    """Weights and (N,) residual of records that no fit has seen, as `Fitted.weights` and `Fitted.e`."""
    paths = [path_contributions(fitted.model, block) for block in data.blocks]
    weights = weigh(data.blocks, data.levels, paths, fitted.variances, settings)
    own = _evaluate(fitted.model, fitted.priors, fitted.z, data, weights, derivative=False)
    return weights, weights.flatten(own.e[None])[0]


def _by_group(weights: Weights, flat: np.ndarray) -> dict[Group, float]:
    return {one.group: -0.5 * float(flat[one.rows] @ flat[one.rows] + weights.log_determinants[one.group])
            for one in weights.paths}


def _evaluate(model: Any, priors: Priors, z: np.ndarray, data: Data, weights: Weights, derivative: bool = True
              ) -> Evaluated:
    parts = [block_residual(model, block, L[:, None], derivative=derivative)
             for block, L in zip(data.blocks, weights.L, strict=True)]
    e = np.concatenate([one[0] for one in parts])
    J = np.empty((len(z) if derivative else 0, len(e)))
    start, slopes = 0, priors.slopes(z)[:, None]
    for own, rows, _ in parts if derivative else ():
        np.multiply(rows, slopes, out=J[:, start:start + len(own)])
        start += len(own)
    return Evaluated(e, J, [one[2].error[:, :, 0] for one in parts])
