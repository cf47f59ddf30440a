"""What a residual is held against: noise, distortion, and relative errors of the paths that nobody has named.

On a line the residual of a record has the covariance N + diag(s) of noise and distortion. Beside it every path from an
input to a sensor may have a relative error, constant over a band and alike in all records of a level:

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

Group = tuple[float, int]


@dataclass(frozen=True, eq=False)
class Variances:
    """By level [V] and band: path (n_y,) relative variances v, distortion (n_y,) variances s [unit of y^2]."""

    path: Mapping[Group, np.ndarray]
    distortion: Mapping[Group, np.ndarray]

    def of(self, group: Group) -> tuple[np.ndarray, np.ndarray]:
        """v and s (n_y,) of a level and band, or of the nearest that was fitted."""
        if group not in self.path:
            level, band = group
            group = min(self.path, key=lambda g: (abs(np.log(max(g[0], 1e-9) / max(level, 1e-9))), abs(g[1] - band)))
        return self.path[group], self.distortion[group]


def bands(omega: np.ndarray, per_octave: int) -> np.ndarray:
    """(n,) number of the band of each line, counted from 1 rad/s."""
    return np.floor(per_octave * np.log2(omega) + 1e-9).astype(int)


@dataclass(frozen=True, eq=False)
class PathError:
    """Lines of one level and band: rows (m,) of the stacked real residual, and Q (m, r), lambda (r,) of B B^T."""

    group: Group
    rows: np.ndarray
    Q: np.ndarray
    size: np.ndarray


@dataclass(frozen=True, eq=False)
class Weights:
    """Whitening of stacked residuals.

    L : (n, n_y, n_y) a block. paths : of every level and band. log_determinants : of the covariance of the real numbers
    of each.
    """

    L: tuple[np.ndarray, ...]
    paths: tuple[PathError, ...]
    log_determinants: Mapping[Group, float]

    @property
    def log_determinant(self) -> float:
        return float(sum(self.log_determinants.values()))

    def flatten(self, x: np.ndarray) -> np.ndarray:
        """(k, N) whitened rows times the inverse root of I + B B^T."""
        out = x.copy()
        for one in self.paths:
            part = x[:, one.rows]
            out[:, one.rows] = part - ((part @ one.Q) * (1 - 1 / np.sqrt(1 + one.size))) @ one.Q.T
        return out

    def normal_equations(self, J: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """J W J^T (n, n), J W e (n,) and e W e of whitened rows, W = inv(I + B B^T), without forming its root."""
        H, g, cost = J @ J.T, J @ e, float(e @ e)
        for one in self.paths:
            along, of = J[:, one.rows] @ one.Q, one.Q.T @ e[one.rows]
            less = one.size / (1 + one.size)
            H -= (along * less) @ along.T
            g -= along @ (less * of)
            cost -= float(less @ of ** 2)
        return H, g, cost


def path_contributions(model: Any, block: SpectralBlock) -> np.ndarray:
    """(n, n_y, n_in): what each input of a record contributes to each sensor, or what a model calls its parts."""
    if hasattr(model, "contributions"):
        return np.asarray(model.contributions(block))
    U = np.zeros((*block.U.shape[:2], block.U.shape[1]), complex)
    k = np.arange(block.U.shape[1])
    U[:, k, k] = block.U[:, :, 0]
    return model.driven(block.omega, U, derivative=False).Y


def with_distortion(block: SpectralBlock, level: float, variances: Variances, settings: FitSettings) -> SpectralBlock:
    """The block with noise and distortion as its covariance."""
    assert block.noise is not None
    own = bands(block.omega, settings.bands_per_octave)
    s = np.array([variances.of((level, int(band)))[1] for band in own])
    return block.with_noise(block.noise[:, 0] + s[:, :, None] * np.eye(s.shape[1]))


def weigh(blocks: Sequence[SpectralBlock], levels: Sequence[float], paths: Sequence[np.ndarray], variances: Variances,
          settings: FitSettings) -> Weights:
    """Weights of blocks; paths : (n, n_y, n_in) G_cj u_j of each block by the present model."""
    L, start = [], 0
    determinants: dict[Group, float] = {}
    members: dict[Group, list[tuple[np.ndarray, np.ndarray]]] = {}
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
            members.setdefault(group, []).append((rows, real))
    errors = []
    for group, parts in members.items():
        v, _ = variances.of(group)
        n_y = len(v)
        n_in = parts[0][1].shape[1] // (2 * n_y)
        columns = np.concatenate([part[1] for part in parts])
        sensor = np.tile(np.repeat(np.arange(n_y), n_in), 2)
        used = np.any(columns != 0, axis=0)
        columns, sensor = columns[:, used], sensor[used]
        B = columns * np.sqrt(v[sensor] / 2)
        values, vectors = np.linalg.eigh(B.T @ B)
        kept = values > settings.least_eigenvalue
        Q = B @ vectors[:, kept] / np.sqrt(values[kept])
        errors.append(PathError(group, np.concatenate([part[0] for part in parts]), Q, values[kept]))
        determinants[group] += float(np.sum(np.log1p(values[kept])))
    return Weights(tuple(L), tuple(errors), determinants)


def estimated(left: Sequence[np.ndarray], blocks: Sequence[SpectralBlock], levels: Sequence[float],
              paths: Sequence[np.ndarray], old: Variances, settings: FitSettings) -> Variances:
    """The most likely variances of path errors and distortion for residuals left (n, n_y) of each block.

    Sensor by sensor, with the mean noise n of a band: with U diag(lambda) U^H = G G^H of the contributions G (m, n_in)
    of the inputs on its m lines, the rotated residual y = U^H e has independent parts of variance w = n + s + v lambda.
    The likelihood is climbed by minorisation-maximisation (H. Zhou, L. Hu, J. Zhou, K. Lange, J. Comput. Graph. Stat.
    28 (2019) 350-361),

        v <- v sqrt((sum lambda |y|^2 / w^2 + nu v0 / 2 v^2) / (sum lambda / w + (nu / 2 + 1) / v)),

    and s likewise without a prior.
    """
    members: dict[Group, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for e, block, level, path in zip(left, blocks, levels, paths, strict=True):
        assert block.noise is not None
        noise = np.real(np.einsum("kii->ki", block.noise[:, 0]))
        own = bands(block.omega, settings.bands_per_octave)
        for band in np.unique(own):
            at = own == band
            members.setdefault((level, int(band)), []).append((e[at], path[at], noise[at]))
    path_variance, distortion = {}, {}
    nu, v0 = settings.error_weight, settings.least_error ** 2
    for group, parts in members.items():
        e, G, noise = (np.concatenate([part[k] for part in parts]) for k in range(3))
        n = noise.mean(axis=0)[:, None]
        U, sigma, _ = np.linalg.svd(np.swapaxes(G, 0, 1), full_matrices=False)
        power = np.abs(np.einsum("ymk,my->yk", U.conj(), e)) ** 2
        # All directions beside those of the contributions are alike: one entry of mean power stands for them.
        rest = len(e) - sigma.shape[1]
        beside = np.maximum(np.sum(np.abs(e) ** 2, axis=0) - power.sum(axis=1), 0.0)[:, None] / max(rest, 1)
        size = np.pad(sigma ** 2, ((0, 0), (0, 1)))
        power, count = np.hstack([power, beside]), np.r_[np.ones(sigma.shape[1]), rest]
        v, s = (one[:, None].copy() for one in old.of(group))
        for _ in range(settings.climbs):
            w = n + s + v * size
            rise = np.sum(size * power / w ** 2, axis=1, keepdims=True) + nu * v0 / (2 * v ** 2)
            v *= np.sqrt(rise / (np.sum(size / w, axis=1, keepdims=True) + (nu / 2 + 1) / v))
            s *= np.sqrt(np.sum(count * power / w ** 2, axis=1, keepdims=True)
                         / np.sum(count / w, axis=1, keepdims=True))
            s = np.maximum(s, settings.least_distortion * n)
        path_variance[group], distortion[group] = v[:, 0], s[:, 0]
    return Variances(path_variance, distortion)
