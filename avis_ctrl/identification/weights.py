"""Weights of residuals: noise, distortion, and unspecified relative errors of the paths from inputs to sensors.

On a line the residual of a record has the covariance N + diag(s) of noise and distortion; s depends on level and band.
In addition, every path from an input to a sensor may have a relative error, constant over a band and the same in all
records, because the errors of the linear model are the same at every level:

    e_c(k) = sum_j eps_cjb G_cj(k) u_j(k) + noise,     eps circular normal, E|eps|^2 = v_cb

The path errors are integrated out. In real numbers whitened by N + diag(s), with B the columns of the path errors times
their standard deviation, the covariance is I + B B^T, and its inverse root is

    (I + B B^T)^(-1/2) = I - Q diag(1 - 1/sqrt(1 + lambda)) Q^T,      B B^T = Q diag(lambda) Q^T
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.identification.fit_settings import FitSettings
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.variances import Group, Variances, bands


@dataclass(frozen=True, eq=False)
class PathError:
    """Path errors of one band: rows (m,) of the stacked real residual, and Q (m, r), lambda (r,) of B B^T."""

    rows: np.ndarray
    Q: np.ndarray
    size: np.ndarray

    @property
    def share(self) -> np.ndarray:
        """(r,) fraction of the power along Q that the inverse covariance leaves out."""
        return self.size / (1 + self.size)

    def along(self, x: np.ndarray) -> np.ndarray:
        """(k, r) whitened rows x (k, N) times Q."""
        return np.asarray(x[:, self.rows] @ self.Q)


@dataclass(frozen=True, eq=False)
class Weights:
    """Whitening of stacked residuals.

    L : (n, n_y, n_y) per block. paths : one per band. rows : of the stacked real residual, by level and band.
    log_determinants : of the covariance of the real numbers, by level and band; the contribution of a band's path
        errors is divided among its levels in proportion to their rows.
    """

    L: tuple[np.ndarray, ...]
    paths: tuple[PathError, ...]
    rows: Mapping[Group, np.ndarray]
    log_determinants: Mapping[Group, float]

    @property
    def log_determinant(self) -> float:
        """Sum over all levels and bands."""
        return float(sum(self.log_determinants.values()))

    def flatten(self, x: np.ndarray) -> np.ndarray:
        """(k, N) whitened rows multiplied by the inverse root of I + B B^T."""
        out = x.copy()
        for one in self.paths:
            part = x[:, one.rows]
            out[:, one.rows] = part - ((part @ one.Q) * (1 - 1 / np.sqrt(1 + one.size))) @ one.Q.T
        return out

    def along(self, x: np.ndarray) -> list[np.ndarray]:
        """`PathError.along` of each path error."""
        return [one.along(x) for one in self.paths]

    def normal_equations(
        self, J: np.ndarray, e: np.ndarray, along: Sequence[np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """J W J^T (n, n), J W e (n,) and e W e of whitened rows, W = inv(I + B B^T), without forming its root. along :
        `along` of the rows (J, e), if it is known."""
        H, g, cost = J @ J.T, J @ e, float(e @ e)
        for one, both in zip(self.paths, along or self.along(np.concatenate([J, e[None]])), strict=True):
            of_J, of_e = both[:-1], both[-1]
            H -= (of_J * one.share) @ of_J.T
            g -= of_J @ (one.share * of_e)
            cost -= float(one.share @ of_e**2)
        return H, g, cost


def path_contributions(model: Any, block: SpectralBlock) -> np.ndarray:
    """(n, n_y, n_in): contribution of each input of a record to each sensor, or the parts that the model itself
    defines."""
    if hasattr(model, "contributions"):
        return np.asarray(model.contributions(block))
    U = np.zeros((*block.U.shape[:2], block.U.shape[1]), complex)
    k = np.arange(block.U.shape[1])
    U[:, k, k] = block.U[:, :, 0]
    return model.driven(block.omega, U, derivative=False).Y


def with_distortion(block: SpectralBlock, level: float, variances: Variances, settings: FitSettings) -> SpectralBlock:
    """The block with the sum of noise and distortion as its covariance."""
    assert block.noise is not None
    own, of_line = np.unique(bands(block.omega, settings.bands_per_octave), return_inverse=True)
    s = np.array([variances.of_distortion(level, int(band)) for band in own])[of_line]
    return block.with_noise(block.noise[:, 0] / block.precision_factor + s[:, :, None] * np.eye(s.shape[1]))


def weigh(
    blocks: Sequence[SpectralBlock],
    levels: Sequence[float],
    paths: Sequence[np.ndarray],
    variances: Variances,
    settings: FitSettings,
) -> Weights:
    """Weights of blocks; paths : (n, n_y, n_in) G_cj u_j of each block, from the present model."""
    L, start = [], 0
    determinants: dict[Group, float] = {}
    members: dict[int, list[tuple[Group, np.ndarray, np.ndarray]]] = {}
    for block, level, path in zip(blocks, levels, paths, strict=True):
        n, n_y, n_in = path.shape
        own = bands(block.omega, settings.bands_per_octave)
        whole = with_distortion(block, level, variances, settings).noise
        assert whole is not None
        factor = np.linalg.cholesky(whole[:, 0])
        by_line = 4 * np.sum(np.log(np.real(np.einsum("kii->ki", factor))), axis=1)
        white = np.sqrt(2) * np.linalg.inv(factor)
        L.append(white)
        # Real parts of all lines and sensors, then imaginary parts, as `as_real` stacks them.
        place = start + np.arange(n * n_y).reshape(n, n_y)
        start += 2 * n * n_y
        for band in np.unique(own):
            at = own == band
            group = level, int(band)
            determinants[group] = determinants.get(group, 0.0) + float(by_line[at].sum())
            # columns (m, n_y, n_y * n_in): sensor c, input j
            C = (white[at][:, :, :, None] * path[at][:, None, :, :]).reshape(at.sum() * n_y, n_y * n_in)
            rows = np.concatenate([place[at].ravel(), place[at].ravel() + n * n_y])
            real = np.block([[C.real, -C.imag], [C.imag, C.real]])
            members.setdefault(int(band), []).append((group, rows, real))
    errors = []
    by_group: dict[Group, np.ndarray] = {}
    for band, parts in members.items():
        v = variances.of_path(band)
        n_y = len(v)
        n_in = parts[0][2].shape[1] // (2 * n_y)
        columns = np.concatenate([real for _, _, real in parts])
        sensor = np.tile(np.repeat(np.arange(n_y), n_in), 2)
        used = np.any(columns != 0, axis=0)
        columns, sensor = columns[:, used], sensor[used]
        B = columns * np.sqrt(v[sensor] / 2)
        values, vectors = np.linalg.eigh(B.T @ B)
        kept = values > settings.least_eigenvalue
        Q = B @ vectors[:, kept] / np.sqrt(values[kept])
        errors.append(PathError(np.concatenate([rows for _, rows, _ in parts]), Q, values[kept]))
        for group, rows, _ in parts:
            by_group[group] = np.concatenate([by_group.get(group, np.empty(0, int)), rows])
            determinants[group] += float(np.sum(np.log1p(values[kept]))) * len(rows) / len(B)
    return Weights(tuple(L), tuple(errors), by_group, determinants)
