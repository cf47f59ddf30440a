"""Fit of a table to records by penalised least squares, with the evidence for the model (Laplace).

    -2 log p(y, z) = |e(z)|^2 + log det C + |z|^2,    evidence = p(y, z) / sqrt(det(J J^T + I))

z are standardised parameters; the whitened residual e is free of the transients of the records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap_engine.settings import SETTINGS, GapSettings
from avis_ctrl.gap_engine.tolerances import Priors
from avis_ctrl.gap_engine.weights import Group, Variances, Weights, bands, estimated, path_contributions, weigh
from avis_ctrl.identification.maximum_likelihood import block_residual
from avis_ctrl.identification.spectra import SpectralBlock


@dataclass(frozen=True, eq=False)
class Data:
    """Blocks that are fitted together, and the level [V] of each."""

    blocks: tuple[SpectralBlock, ...]
    levels: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Fitted:
    """The most probable parameters of a model.

    model : at the estimate. priors, z (n,), covariance (n, n) of z. variances : of what is not explained.
    log_evidence : Laplace. iterations : Gauss-Newton steps. e (N,) and J (n, N) : whitened, path errors integrated out.
    rows : of e by level and band. log_likelihoods : by level and band; what is in `log_evidence` beside their sum is of
        the priors.
    """

    model: Any
    priors: Priors
    z: np.ndarray
    covariance: np.ndarray
    variances: Variances
    log_evidence: float
    iterations: int
    e: np.ndarray
    J: np.ndarray
    rows: Mapping[Group, np.ndarray]
    log_likelihoods: Mapping[Group, float]

    @property
    def by_name(self) -> dict[str, float]:
        """Standardised values by name."""
        return dict(zip(self.priors.names, map(float, self.z), strict=True))

    @property
    def labels(self) -> tuple[str, ...]:
        """Effects of the model but the second-order terms."""
        return tuple(one.label for one in self.model.effects if not isinstance(one.effect, LargeMotion))

    def covariance_of(self, names: Sequence[str]) -> np.ndarray:
        """(k, k) of some parameters in their units; zero for those that are not free."""
        slopes = self.priors.slopes(self.z)
        rows = [self.priors.names.index(name) if name in self.priors.names else -1 for name in names]
        C = (self.covariance * slopes) * slopes[:, None]
        C = np.pad(C, (0, 1))[np.ix_(rows, rows)]
        return C


def first_variances(data: Data, settings: GapSettings) -> Variances:
    """Where nothing is known yet: a relative error of every path, distortion as large as a tenth of it."""
    path: dict[Group, np.ndarray] = {}
    distortion: dict[Group, np.ndarray] = {}
    count: dict[Group, int] = {}
    for block, level in zip(data.blocks, data.levels, strict=True):
        own = bands(block.omega, settings.bands_per_octave)
        for band in np.unique(own):
            at, group = own == band, (level, int(band))
            path[group] = np.full(block.Y.shape[1], settings.first_error ** 2)
            power = np.sum(np.abs(block.Y[at, :, 0]) ** 2, axis=0)
            distortion[group] = distortion.get(group, 0.0) + settings.first_distortion * settings.first_error ** 2 * power
            count[group] = count.get(group, 0) + int(at.sum())
    return Variances(path, {group: value / count[group] for group, value in distortion.items()})


def fit(model: Any, priors: Priors, z: np.ndarray, data: Data, variances: Variances, settings: GapSettings = SETTINGS
        ) -> Fitted:
    """Alternate Gauss-Newton steps in z with estimates of the variances."""
    steps = 0
    model = model.at(priors.values(z))
    for k in range(settings.rounds + 1):
        paths = [path_contributions(model, block) for block in data.blocks]
        weights = weigh(data.blocks, data.levels, paths, variances, settings)
        found = _evaluate(model, priors, z, data, weights)
        for _ in range(settings.iterations):
            e, J, _ = found
            flat, Jf = weights.flatten(e[None])[0], weights.flatten(J)
            cost = flat @ flat + z @ z
            H = Jf @ Jf.T + np.eye(len(z))
            step = np.linalg.solve(H, Jf @ flat - z)
            promised = step @ (Jf @ flat - z)
            if promised < settings.converged * len(flat):
                break
            size = 1.0
            while size > 1e-3:
                trial = z + size * step
                moved = model.at(priors.values(trial))
                own = _evaluate(moved, priors, trial, data, weights)
                new = weights.flatten(own[0][None])[0]
                if new @ new + trial @ trial < cost:
                    break
                size /= 3
            else:
                break
            model, z, found, steps = moved, trial, own, steps + 1
        if k < settings.rounds:
            variances = estimated(weights, found[0], found[2], data.blocks, data.levels, variances, settings)
    e, J, _ = found
    flat, Jf = weights.flatten(e[None])[0], weights.flatten(J)
    H = Jf @ Jf.T + np.eye(len(z))
    nu, v0 = settings.error_weight, settings.least_error ** 2
    hyper = sum(float(np.sum(-(nu / 2 + 1) * np.log(v) - nu * v0 / (2 * v))) for v in variances.path.values())
    log_evidence = -0.5 * (flat @ flat + z @ z + weights.log_determinant + np.linalg.slogdet(H)[1]) + hyper
    return Fitted(model, priors, z, np.linalg.inv(H), variances, float(log_evidence), steps, flat, Jf,
                  {one.group: one.rows for one in weights.paths}, _by_group(weights, flat))


def log_likelihoods(fitted: Fitted, data: Data, settings: GapSettings = SETTINGS) -> dict[Group, float]:
    """Of records that no fit has seen, by level and band, by the fitted parameters and variances."""
    paths = [path_contributions(fitted.model, block) for block in data.blocks]
    weights = weigh(data.blocks, data.levels, paths, fitted.variances, settings)
    e, _, _ = _evaluate(fitted.model, fitted.priors, fitted.z, data, weights, derivative=False)
    return _by_group(weights, weights.flatten(e[None])[0])


def _by_group(weights: Weights, flat: np.ndarray) -> dict[Group, float]:
    return {one.group: -0.5 * float(flat[one.rows] @ flat[one.rows] + weights.log_determinants[one.group])
            for one in weights.paths}


def _evaluate(model: Any, priors: Priors, z: np.ndarray, data: Data, weights: Weights, derivative: bool = True):
    """Whitened residual (N,), its negative Jacobian by z (n, N), and the residuals (n, n_y) of the blocks."""
    parts = [block_residual(model, block, L[:, None], derivative=derivative)
             for block, L in zip(data.blocks, weights.L, strict=True)]
    e = np.concatenate([one[0] for one in parts])
    J = np.concatenate([one[1] for one in parts], axis=1) * priors.slopes(z)[:, None] if derivative else np.empty(0)
    return e, J, [one[2].error[:, :, 0] for one in parts]
