"""Variances of path errors and distortion, and their most likely values.

Sensor by sensor and band by band, with the mean noise n_l of a level l, the covariance of the residual e of all lines
is W = D + v G G^H, D = n_l + s_l on the lines of level l, G (m, k) the contributions of the inputs. With

    S = G^H inv(D) G,   b = G^H inv(D) e,   K = (S + I / v)^-1,   x = K b

(K and x are covariance and mean of the path errors given e), the cost, minus the log-likelihood, is

    log det(I + v S) + sum_l (m_l log d_l + |e_l|^2 / d_l) - b^H x,

and only sums over the lines of a level enter: G_l^H G_l, G_l^H e_l and |e_l|^2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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


def log_prior(variances: Variances, noise: Mapping[Group, np.ndarray], settings: FitSettings) -> float:
    """Log prior of the logarithms of the variances, inverse chi-square with the minimum values as scale, up to a
    constant: it decreases as 1/v above them and exponentially below. noise : (n_y,) mean variance by level and band
    (`mean_noise`)."""
    half = settings.error_weight / 2
    pairs = [(v, np.full(len(v), settings.least_error**2)) for v in variances.path.values()]
    pairs += [(variances.of_distortion(*group), settings.least_distortion * n) for group, n in noise.items()]
    return sum(float(np.sum(-half * (np.log(value) + least / value))) for value, least in pairs)


class _Sums(NamedTuple):
    """Sums over the lines of each level, for n pairs of band and sensor; zero for a level without lines.

    M : (n, L, k, k) G^H G. p : (n, L, k) G^H e. q : (n, L) |e|^2. lines : (n, L) their number. noise : (n, L) mean.
    """

    M: np.ndarray
    p: np.ndarray
    q: np.ndarray
    lines: np.ndarray
    noise: np.ndarray

    def some(self, at: np.ndarray) -> _Sums:
        """Some of the bands and sensors."""
        return _Sums(*(one[at] for one in self))

    def path_errors(self, theta: np.ndarray) -> tuple[np.ndarray, ...]:
        """d (n, L), K (n, k, k), b (n, k), x (n, k), and the power (n, L) that x leaves, at theta = log (v, s)."""
        d, (n, L, k) = self.noise + np.exp(theta[:, 1:]), self.p.shape
        S, b = _summed(1 / d, self.M), _summed(1 / d, self.p)
        K = np.linalg.inv(S + np.exp(-theta[:, 0])[:, None, None] * np.eye(k))
        x = (K @ b[..., None])[..., 0]
        Mx = (self.M.reshape(n, L * k, k) @ x[..., None]).reshape(n, L, k)
        left = self.q + np.real(((Mx - 2 * self.p) @ x.conj()[..., None])[..., 0])
        return d, K, b, x, left


def _summed(weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """sum_l weights_l x_l over levels: weights (n, L), x (n, L, ...)."""
    return (weights[:, None] @ x.reshape(*x.shape[:2], -1)).reshape(len(x), *x.shape[2:])


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

    paths : (n, n_y, k) contributions of the inputs. hold_path : keep the variances of the path errors, and follow the
    maximum near the old variances of the distortion.

    The likelihood has several maxima: path errors may explain the residual of one level while all of another is
    distortion. The search therefore starts from several such divisions and from the old variances; the best end counts.
    """
    noise = mean_noise(blocks, levels, settings)
    row = {band: k for k, band in enumerate(sorted({band for _, band in noise}))}
    column = {level: k for k, level in enumerate(sorted({level for level, _ in noise}))}
    used = np.any([np.any(G != 0, axis=(0, 1)) for G in paths], axis=0)
    used[0] |= not used.any()  # a residual without any input is all distortion
    n_y, k = paths[0].shape[1], int(used.sum())
    shape = len(row), n_y, len(column)
    M, p = np.zeros((*shape, k, k), complex), np.zeros((*shape, k), complex)
    q, lines, n = np.zeros(shape), np.zeros(shape), np.ones(shape)
    for e, block, level, path in zip(left, blocks, levels, paths, strict=True):
        own, G = bands(block.omega, settings.bands_per_octave), path[:, :, used]
        for band in np.unique(own):
            at, (b, c) = own == band, (row[int(band)], column[level])
            M[b, :, c] += np.swapaxes(G[at].conj(), 0, 1).swapaxes(1, 2) @ np.swapaxes(G[at], 0, 1)
            p[b, :, c] += np.einsum("mya,my->ya", G[at].conj(), e[at])
            q[b, :, c] += np.sum(np.abs(e[at]) ** 2, axis=0)
            lines[b, :, c] += at.sum()
    theta = np.zeros((*shape[:2], 1 + shape[2]))
    for band, b in row.items():
        theta[b, :, 0] = np.log(old.of_path(band))
    for (level, band), value in noise.items():
        n[row[band], :, column[level]] = value
        theta[row[band], :, 1 + column[level]] = np.log(old.of_distortion(level, band))
    flat = _Sums(*(one.reshape(-1, *one.shape[2:]) for one in (M, p, q, lines, n)))
    end = np.exp(_most_likely(flat, theta.reshape(-1, theta.shape[-1]), settings, hold_path)).reshape(theta.shape)
    return Variances(
        {band: end[b, :, 0] for band, b in row.items()},
        {(level, band): end[row[band], :, 1 + column[level]] for level, band in noise},
    )


def _most_likely(sums: _Sums, old: np.ndarray, settings: FitSettings, hold_path: bool) -> np.ndarray:
    """theta = log (v, s) (n, 1 + L) of the highest maximum; with `hold_path`, of the one near the old values."""
    least = np.hstack([np.full((len(old), 1), settings.least_error**2), settings.least_distortion * sums.noise])
    starts = [old, *(() if hold_path else _starts(sums, np.log(least)))]
    ends = [_descent(sums, start, least, settings, hold_path) for start in starts]
    best = np.argmin([cost for _, cost in ends], axis=0)
    return np.array([theta for theta, _ in ends])[best, np.arange(len(old))]


def _starts(sums: _Sums, least: np.ndarray) -> Iterator[np.ndarray]:
    """theta (n, 1 + L) of each start: path errors explain nothing, all that they can at one level, or at all levels.
    least : (n, 1 + L) minimum of theta."""

    def distortion(power: np.ndarray) -> np.ndarray:
        s = power / np.maximum(sums.lines, 1) - sums.noise
        return np.maximum(np.log(np.maximum(s, np.finfo(float).tiny)), least[:, 1:])

    def explained(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """log v (n, 1) of the path errors that explain as much as they can under distortion s, and what they leave."""
        *_, x, left = sums.path_errors(np.hstack([np.zeros((len(s), 1)), s]))
        size = np.log(np.mean(np.abs(x) ** 2, axis=1, keepdims=True) + np.finfo(float).tiny)
        return np.maximum(size, least[:, :1]), left

    whole = distortion(sums.q)
    yield np.hstack([least[:, :1], whole])
    for level in range(whole.shape[1]):
        s = whole.copy()
        s[:, level] = least[:, 1 + level]
        yield np.hstack([explained(s)[0], s])
    v, left = explained(least[:, 1:])
    yield np.hstack([v, distortion(left)])


def _descent(
    sums: _Sums, theta: np.ndarray, least: np.ndarray, settings: FitSettings, hold_path: bool
) -> tuple[np.ndarray, np.ndarray]:
    """theta (n, 1 + L) and cost (n,) at local minima, by Fisher scoring (S. R. Searle, G. Casella, C. E. McCulloch,
    Variance Components, Wiley 1992, ch. 8), with Levenberg-Marquardt damping where the cost would rise."""
    theta, eye = theta.copy(), np.eye(theta.shape[1])
    cost, g, H = _expanded(sums, theta, least, settings, hold_path)
    damping, moving = np.zeros(len(theta)), np.arange(len(theta))
    for _ in range(settings.variance_steps):
        M = H * (1 + damping[:, None, None] * eye)
        step = -np.linalg.solve(M, g[..., None])[..., 0]
        trial = theta[moving] + np.clip(step, -settings.longest_step, settings.longest_step)
        own, g_new, H_new = _expanded(sums.some(moving), trial, least[moving], settings, hold_path)
        lower = own < cost[moving]
        theta[moving[lower]], cost[moving[lower]] = trial[lower], own[lower]
        kept = -np.sum(step * g, axis=1) > settings.variance_settled
        g[lower], H[lower] = g_new[lower], H_new[lower]
        damping = np.where(
            lower, np.where(damping > 1, damping / settings.damping, 0.0), np.maximum(damping * settings.damping, 1.0)
        )
        moving, g, H, damping = moving[kept], g[kept], H[kept], damping[kept]
        if not len(moving):
            break
    return theta, cost


def _expanded(
    sums: _Sums, theta: np.ndarray, least: np.ndarray, settings: FitSettings, hold_path: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cost with the prior (n,), its gradient (n, 1 + L) and expected second derivative (n, 1 + L, 1 + L) in theta.

    With T_l = K G_l^H G_l / d_l, R = I - K / v and r_l = s_l / d_l, the Fisher information tr(inv(W) W_i inv(W) W_j) is
    tr(R R) in log v, r_l tr(K T_l) / v between log v and log s_l, and r_l r_m tr(T_l T_m) between log s_l and log s_m,
    to which r_l^2 (m_l - 2 tr T_l) is added if l = m.
    """
    half = settings.error_weight / 2
    d, K, b, x, power = sums.path_errors(theta)
    v, r, size = np.exp(theta[:, :1]), np.exp(theta[:, 1:]) / d, K.shape[-1]
    # log det(I + v S) = k log v - log det K
    cost = size * theta[:, 0] - np.linalg.slogdet(K)[1] - np.real(np.sum(b.conj() * x, axis=1))
    cost += np.sum(sums.lines * np.log(d) + sums.q / d, axis=1)
    T = K[:, None] @ sums.M / d[..., None, None]
    of_K, of_T = K.reshape(len(K), 1, -1), T.reshape(*d.shape, -1)
    transposed = T.swapaxes(2, 3).reshape(of_T.shape).swapaxes(1, 2)
    trace = np.real(np.trace(T, axis1=2, axis2=3))
    R = np.eye(size) - K / v[..., None]
    g, H = np.empty_like(theta), np.empty((*theta.shape, theta.shape[1]))
    g[:, 0] = np.real(np.trace(R, axis1=1, axis2=2)) - np.sum(np.abs(x) ** 2, axis=1) / v[:, 0]
    g[:, 1:] = r * (sums.lines - trace - power / d)
    H[:, 0, 0] = np.sum(np.abs(R) ** 2, axis=(1, 2))
    H[:, 0, 1:] = H[:, 1:, 0] = r / v * np.real(of_K @ transposed)[:, 0]
    H[:, 1:, 1:] = r[:, :, None] * r[:, None] * np.real(of_T @ transposed)
    level = np.arange(1, theta.shape[1])
    H[:, level, level] += r**2 * (sums.lines - 2 * trace)
    below = least * np.exp(-theta)
    exists = np.hstack([np.ones_like(v), sums.lines > 0])
    cost += half * np.sum(exists * (theta + below), axis=1)
    g += half * exists * (1 - below)
    parameter = np.arange(theta.shape[1])
    H[:, parameter, parameter] += half * below
    if hold_path:
        g[:, 0], H[:, 0, 1:], H[:, 1:, 0] = 0, 0, 0
    return cost, g, H
