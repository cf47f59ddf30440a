"""Noise covariance from the residuals of a fit, smoothed over frequency and pooled over records of a kind.

Unmeasured floor motion is most of the noise of a table. It reaches the sensors through the table itself. The covariance
therefore changes direction and peaks at every mode within a fraction of a Hz, and three directions of six are far
quieter than the others: an average over frequency would fill these up. The residuals are therefore whitened first by
the shape

    C_0(w) = G_floor(w) S(w) G_floor(w)^H + diag d(w)

with G_floor of the model and smooth S (3 x 3) and d fitted to the residuals by expectation maximisation (Dempster,
Laird and Rubin 1977; factor analysis with known loadings). Their covariance, whatever it is, is then averaged where it
is nearly flat: prewhitening before smoothing, as Blackman and Tukey (1958) do for spectra. Noise of another origin
reduces the precision of the average, not its validity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from avis_ctrl.errors import InputError
from avis_ctrl.identification.maximum_likelihood import Residual
from avis_ctrl.identification.response import FrequencyModel
from avis_ctrl.identification.spectral_block import SpectralBlock


@dataclass(frozen=True)
class NoiseSettings:
    """shape_half_Hz : half the band over which S and d are taken as constant [Hz]; spectra of floors and sensors are
        smooth over such a band.
    shape_lines : minimum lines in it; S and d have 15 unknowns for six outputs.
    rounds : iterations of their fit. The average corrects what they leave.
    half_Hz : minimum half band of an average [Hz], narrow enough for what the shape leaves of a resonance.
    least_dof : minimum degrees of freedom of an average: an estimate with dof of them costs n_y / dof of the precision
        that the noise would allow (Pintelon and Schoukens 2012, section 12.3).
    """

    shape_half_Hz: float = 0.25
    shape_lines: int = 40
    rounds: int = 30
    half_Hz: float = 0.15
    least_dof: int = 100


SETTINGS = NoiseSettings()


def relative_noise(blocks: Sequence[SpectralBlock], fraction: float = 0.1) -> list[SpectralBlock]:
    """Initial weights for unknown noise: independent, a fraction of each output's local power.

    All lines then have equal weight. It is suitable for starting a fit, not for standard deviations.
    """
    found = []
    for block in blocks:
        power = np.sum(np.abs(block.Y) ** 2, axis=2)
        width = max(3, len(block.omega) // 20)
        level = uniform_filter1d(power, width, axis=0, mode="nearest") + 1e-12 * power.max(0)
        found.append(block.with_noise(fraction**2 * level[:, :, None] * np.eye(level.shape[1])))
    return found


def noise_from_residuals(
    residuals: Sequence[Residual], blocks: Sequence[SpectralBlock], model: FrequencyModel
) -> list[SpectralBlock]:
    """Blocks with the covariance of a model's residuals near their lines, averaged over records of a kind.

    At each line the window grows until the covariance has `least_dof` degrees of freedom, and three for each output:
    thinned records have few lines far from resonances.

    Raises
    ------
    InputError : a block of a kind without residuals.
    """
    found = {}
    for kind in dict.fromkeys(block.kind for block in blocks):
        pool = [one for one in residuals if one.block.kind == kind]
        own = [block for block in blocks if block.kind == kind]
        if not pool:
            raise InputError(f"expected residuals of its kind, {kind}", field=f"block {own[0].name}")
        shape = _shape(pool, model)
        flat = [_outer(np.linalg.solve(shape.factor(one.block.omega, model), one.error)) for one in pool]
        least = max(SETTINGS.least_dof, 3 * own[0].Y.shape[1])
        for block in own:
            half = np.maximum(SETTINGS.half_Hz * 2 * np.pi, _reach(pool, block.omega, least))
            total, count = _window_sums(pool, flat, block.omega, half)
            A = shape.factor(block.omega, model)
            noise = A @ (total / np.maximum(count, 1)[:, None, None]) @ _adjoint(A)
            found[id(block)] = block.with_noise(_lifted(noise), float(np.median(count)))
    return [found[id(block)] for block in blocks]


class _Shape(NamedTuple):
    """S (n, 3, 3) and d (n, n_y) on a grid omega (n,)."""

    omega: np.ndarray
    S: np.ndarray
    d: np.ndarray

    def at(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Linear interpolation between the grid's points, which preserves positivity."""
        right = np.clip(np.searchsorted(self.omega, omega), 1, len(self.omega) - 1)
        gap = self.omega[right] - self.omega[right - 1]
        share = np.clip((omega - self.omega[right - 1]) / gap, 0, 1)
        S = (1 - share)[:, None, None] * self.S[right - 1] + share[:, None, None] * self.S[right]
        return S, (1 - share)[:, None] * self.d[right - 1] + share[:, None] * self.d[right]

    def factor(self, omega: np.ndarray, model: FrequencyModel) -> np.ndarray:
        """(n, n_y, n_y) Cholesky factor of C_0."""
        S, d = self.at(omega)
        G = _floor_response(model, omega)
        return np.linalg.cholesky(_lifted(G @ S @ _adjoint(G) + d[:, :, None] * np.eye(d.shape[1])))


def _shape(pool: Sequence[Residual], model: FrequencyModel) -> _Shape:
    """S and d fitted to residuals, with windows on a grid of half their width."""
    half = max(2 * np.pi * SETTINGS.shape_half_Hz, SETTINGS.shape_lines / _density(pool) / 2)
    low, high = min(one.block.omega[0] for one in pool), max(one.block.omega[-1] for one in pool)
    grid = np.linspace(low, high, max(int(np.ceil((high - low) / half)) + 1, 2))
    G = [_floor_response(model, one.block.omega) for one in pool]
    R = [_outer(one.error) for one in pool]
    m = [one.error.shape[2] for one in pool]
    reach = np.maximum(half, _reach(pool, grid, SETTINGS.shape_lines))
    total, count = _window_sums(pool, R, grid, reach)
    mean = _lifted(total / np.maximum(count, 1)[:, None, None])
    # The quietest directions contain no floor motion; the excess of the others is the floor's, equal on three axes.
    quiet = np.linalg.eigvalsh(mean)[:, 0]
    gain = np.interp(grid, pool[0].block.omega, np.sum(np.abs(G[0]) ** 2, axis=(1, 2)))
    loud = np.real(np.einsum("nii->n", mean)) / gain
    shape = _Shape(grid, loud[:, None, None] * np.eye(3, dtype=complex), np.repeat(quiet[:, None], mean.shape[1], 1))
    for _ in range(SETTINGS.rounds):
        parts = [_expected(g, r, k, *shape.at(one.block.omega)) for g, r, k, one in zip(G, R, m, pool, strict=True)]
        S, count = _window_sums(pool, [part[0] for part in parts], grid, reach)
        d, _ = _window_sums(pool, [part[1] for part in parts], grid, reach)
        shape = _Shape(grid, S / count[:, None, None], np.maximum(d / count[:, None], 1e-9 * quiet[:, None]))
    return shape


def _expected(G: np.ndarray, R: np.ndarray, m: int, S: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E[sum v v^H] (n, 3, 3) of the floor v and E[sum |e - G v|^2] (n, n_y), given R = sum e e^H of m experiments."""
    C = G @ S @ _adjoint(G) + d[:, :, None] * np.eye(d.shape[1])
    B = _adjoint(np.linalg.solve(C, G @ S))
    BR = B @ R
    vv = BR @ _adjoint(B) + m * (S - B @ G @ S)
    left = np.einsum("nii->ni", R) - 2 * np.einsum("nij,nji->ni", G, BR) + np.einsum("nij,njk,nik->ni", G, vv, G.conj())
    return vv, np.real(left)


def _floor_response(model: FrequencyModel, omega: np.ndarray) -> np.ndarray:
    """(n, n_y, 3)"""
    n_u = len(model.actuators)
    U = np.broadcast_to(np.eye(len(model.inputs), dtype=complex)[:, n_u:], (len(omega), len(model.inputs), 3))
    return model.driven(omega, U, derivative=False).Y


def _adjoint(X: np.ndarray) -> np.ndarray:
    return np.conj(X.swapaxes(-1, -2))


def _outer(e: np.ndarray) -> np.ndarray:
    """sum e e^H over experiments, (n, n_y, n_y)."""
    return e @ _adjoint(e)


def _density(pool: Sequence[Residual]) -> float:
    """Number of lines times experiments per rad/s, of all records together."""
    return max(
        sum(
            len(one.block.omega) * one.error.shape[2] / np.ptp(one.block.omega)
            for one in pool
            if len(one.block.omega) > 1
        ),
        1e-9,
    )


def _reach(pool: Sequence[Residual], omega: np.ndarray, least: int) -> np.ndarray:
    """(n,) half width [rad/s] of the smallest window about each omega with `least` lines of the pool, or with all."""
    lines = np.sort(np.concatenate([np.repeat(one.block.omega, one.error.shape[2]) for one in pool]))
    least = min(least, len(lines))
    first = np.clip(np.searchsorted(lines, omega)[:, None] - np.arange(least + 1), 0, len(lines) - least)
    ends = np.maximum(omega[:, None] - lines[first], lines[first + least - 1] - omega[:, None])
    return np.asarray(ends.min(axis=1))


def _window_sums(
    pool: Sequence[Residual], values: Sequence[np.ndarray], omega: np.ndarray, half: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums of values (one array per record, by line) within half of each omega, at least one line; and their
    numbers."""
    total, count = np.zeros((len(omega), *values[0].shape[1:]), values[0].dtype), np.zeros(len(omega))
    for one, value in zip(pool, values, strict=True):
        own = one.block.omega
        running = np.concatenate([np.zeros((1, *value.shape[1:]), value.dtype), np.cumsum(value, axis=0)])
        # At the ends of the band the window keeps its width and shifts inward.
        low = np.clip(omega - half, own[0], np.maximum(own[-1] - 2 * half, own[0]))
        high = np.minimum(low + 2 * half, own[-1])
        first = np.minimum(np.searchsorted(own, low - 1e-9), len(own) - 1)
        last = np.minimum(np.maximum(np.searchsorted(own, high + 1e-9), first + 1), len(own))
        total += running[last] - running[first]
        count += (last - first) * one.error.shape[2]
    return total, count


def _lifted(noise: np.ndarray) -> np.ndarray:
    """Hermitian part, with its smallest eigenvalues kept above round-off."""
    noise = (noise + np.conj(np.swapaxes(noise, -1, -2))) / 2
    size = np.real(np.einsum("nii->ni", noise))
    n_y = noise.shape[-1]
    return noise + 1e-9 * size[:, :, None] * np.eye(n_y) + 1e-30 * np.eye(n_y) * (size.max() or 1.0)
