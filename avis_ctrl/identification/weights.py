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

Group = tuple[float, int]


@dataclass(frozen=True, eq=False)
class Variances:
    """path : (n_y,) relative variances v by band. distortion : (n_y,) variances s [unit of y^2] by level [V]
    and band."""

    path: Mapping[int, np.ndarray]
    distortion: Mapping[Group, np.ndarray]

    def of_path(self, band: int) -> np.ndarray:
        """v (n_y,) of a band, or of the nearest fitted band."""
        if band in self.path:
            return self.path[band]
        return self.path[min(self.path, key=lambda one: abs(one - band))]

    def of_distortion(self, level: float, band: int) -> np.ndarray:
        """s (n_y,) of a level and band, or of the nearest fitted ones."""
        if (level, band) in self.distortion:
            return self.distortion[level, band]
        return self.distortion[
            min(
                self.distortion, key=lambda one: (abs(np.log(max(one[0], 1e-9) / max(level, 1e-9))), abs(one[1] - band))
            )
        ]


def bands(omega: np.ndarray, per_octave: int) -> np.ndarray:
    """(n,) band number of each line, counted from 1 rad/s."""
    return np.floor(per_octave * np.log2(omega) + 1e-9).astype(int)


@dataclass(frozen=True, eq=False)
class PathError:
    """Path errors of one band: rows (m,) of the stacked real residual, and Q (m, r), lambda (r,) of B B^T."""

    rows: np.ndarray
    Q: np.ndarray
    size: np.ndarray


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

    def normal_equations(self, J: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """J W J^T (n, n), J W e (n,) and e W e of whitened rows, W = inv(I + B B^T), without forming its root."""
        H, g, cost = J @ J.T, J @ e, float(e @ e)
        for one in self.paths:
            along, of = J[:, one.rows] @ one.Q, one.Q.T @ e[one.rows]
            less = one.size / (1 + one.size)
            H -= (along * less) @ along.T
            g -= along @ (less * of)
            cost -= float(less @ of**2)
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
    return block.with_noise(block.noise[:, 0] + s[:, :, None] * np.eye(s.shape[1]))


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


def mean_noise(
    blocks: Sequence[SpectralBlock], levels: Sequence[float], settings: FitSettings
) -> dict[Group, np.ndarray]:
    """(n_y,) mean noise variance by level and band."""
    found: dict[Group, list[np.ndarray]] = {}
    for block, level in zip(blocks, levels, strict=True):
        assert block.noise is not None
        noise, own = np.real(np.einsum("kii->ki", block.noise[:, 0])), bands(block.omega, settings.bands_per_octave)
        for band in np.unique(own):
            found.setdefault((level, int(band)), []).append(noise[own == band])
    return {group: np.concatenate(parts).mean(axis=0) for group, parts in found.items()}


def estimated(
    left: Sequence[np.ndarray],
    blocks: Sequence[SpectralBlock],
    levels: Sequence[float],
    paths: Sequence[np.ndarray],
    old: Variances,
    settings: FitSettings,
    hold_path: bool = False,
) -> Variances:
    """Most likely variances of path errors and distortion, for residuals `left` (n, n_y) of each block.

    hold_path : keep the variances of the path errors.

    Sensor by sensor and band by band, with the mean noise n_l of a level l, the covariance of the residual e is W = D +
    v G G^H, D = n_l + s_l on the lines of level l, G (m, k) the contributions of the inputs. With

        K = (G^H inv(D) G + I / v)^-1,   x = K G^H inv(D) e    (covariance and mean of the path errors given e)

    the likelihood is maximised by minorisation-maximisation (H. Zhou, L. Hu, J. Zhou, K. Lange, J. Comput. Graph. Stat.
    28 (2019) 350-361),

        v <- v sqrt((|x|^2 / v^2 + nu v0 / 2 v^2) / ((k - tr K / v) / v + nu / 2 v)),

    and s_l likewise. Both have priors of the same kind (`log_prior`), with nu degrees of freedom and scale v0.
    """
    noise = mean_noise(blocks, levels, settings)
    row = {band: k for k, band in enumerate(sorted({band for _, band in noise}))}
    column = {level: k for k, level in enumerate(sorted({level for level, _ in noise}))}
    n_y, k = paths[0].shape[1:]
    shape = len(row), len(column), n_y
    # Sums over the lines of a band and level: G^H G, G^H e, |e|^2, and their number; zero for a level without lines.
    M, p = np.zeros((*shape, k, k), complex), np.zeros((*shape, k), complex)
    q, lines, n, s = np.zeros(shape), np.zeros((*shape[:2], 1)), np.ones(shape), np.ones(shape)
    for e, block, level, G in zip(left, blocks, levels, paths, strict=True):
        own = bands(block.omega, settings.bands_per_octave)
        for band in np.unique(own):
            at, b, c = own == band, row[int(band)], column[level]
            M[b, c] += np.swapaxes(G[at].conj(), 0, 1).swapaxes(1, 2) @ np.swapaxes(G[at], 0, 1)
            p[b, c] += np.einsum("mya,my->ya", G[at].conj(), e[at])
            q[b, c] += np.sum(np.abs(e[at]) ** 2, axis=0)
            lines[b, c] += at.sum()
    for (level, band), value in noise.items():
        n[row[band], column[level]], s[row[band], column[level]] = value, old.of_distortion(level, band)
    v = np.array([old.of_path(band) for band in row])
    half, v0, s0 = settings.error_weight / 2, settings.least_error**2, settings.least_distortion * n
    for _ in range(settings.climbs):
        d = n + s
        K = np.linalg.inv(np.sum(M / d[..., None, None], axis=1) + np.eye(k) / v[..., None, None])
        x = (K @ np.sum(p / d[..., None], axis=1)[..., None])[..., 0]
        Mx = (M @ x[:, None, :, :, None])[..., 0]
        power = q + np.real(np.sum(x[:, None].conj() * (Mx - 2 * p), axis=-1))
        known = np.real(np.sum(np.swapaxes(K, -1, -2)[:, None] * M, axis=(-1, -2)))
        of_v = (np.sum(np.abs(x) ** 2, axis=-1) + half * v0) / v**2
        of_s = power / d**2 + half * s0 / s**2
        v = v if hold_path else v * np.sqrt(of_v / ((k - np.real(np.einsum("byaa->by", K)) / v + half) / v))
        s = s * np.sqrt(of_s / (lines / d - known / d**2 + half / s))
    return Variances(
        {band: v[b] for band, b in row.items()}, {(level, band): s[row[band], column[level]] for level, band in noise}
    )


def log_prior(variances: Variances, noise: Mapping[Group, np.ndarray], settings: FitSettings) -> float:
    """Log prior of the variances up to a constant: flat in the logarithm, with an exponential decrease below the
    minimum values. noise : (n_y,) mean variance by level and band (`mean_noise`)."""
    half = settings.error_weight / 2
    pairs = [(v, np.full(len(v), settings.least_error**2)) for v in variances.path.values()]
    pairs += [(variances.of_distortion(*group), settings.least_distortion * n) for group, n in noise.items()]
    return sum(float(np.sum(-half * (np.log(value) + least / value))) for value, least in pairs)
