"""Covariance of the noise from what a fit leaves, smoothed over frequency and pooled over records of a kind."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.maximum_likelihood import Residual
from avis_ctrl.identification.spectra import SpectralBlock


def relative_noise(blocks: Sequence[SpectralBlock], fraction: float = 0.1) -> list[SpectralBlock]:
    """A first weight where nothing is known of the noise: independent, a fraction of each output's local power.

    Each line then counts alike. It is good for starting a fit, not for standard deviations.
    """
    found = []
    for block in blocks:
        power = np.sum(np.abs(block.Y) ** 2, axis=2)
        width = max(3, len(block.omega) // 20)
        level = _smoothed(power, width) + 1e-12 * power.max(0)
        found.append(block.with_noise(fraction ** 2 * level[:, :, None] * np.eye(level.shape[1])))
    return found


def residual_noise(residuals: Sequence[Residual], half_width_Hz: float = 0.15, least_dof: int = 30
                   ) -> list[SpectralBlock]:
    """The blocks with the covariance of their residuals, averaged over +- half_width_Hz and records of a kind.

    The window grows until the covariance has least_dof degrees of freedom and three for each output.
    """
    return noise_from_residuals(residuals, [one.block for one in residuals], half_width_Hz, least_dof)


def noise_from_residuals(residuals: Sequence[Residual], blocks: Sequence[SpectralBlock], half_width_Hz: float = 0.15,
                         least_dof: int = 30) -> list[SpectralBlock]:
    """Blocks, which may be other ones, with the covariance that residuals of their kind have near their lines.

    Raises
    ------
    InputError : a block of a kind that no residual is of.
    """
    found = []
    for own in blocks:
        pool = [one for one in residuals if one.block.kind == own.kind]
        if not pool:
            raise InputError(f"expected residuals of its kind, {own.kind}", field=f"block {own.name}")
        least = max(least_dof, 3 * own.Y.shape[1])
        per_Hz = sum(len(one.block.omega) * one.error.shape[2] / np.ptp(one.block.omega) * 2 * np.pi
                     if len(one.block.omega) > 1 else 0 for one in pool)
        half = max(half_width_Hz, least / max(per_Hz, 1e-9) / 2)
        total, count = np.zeros((len(own.omega), *own.Y.shape[1:2] * 2), complex), np.zeros(len(own.omega))
        for one in pool:
            sums, lines = _window_sums(one, own.omega, 2 * np.pi * half)
            total += sums
            count += lines
        noise = total / np.maximum(count, 1)[:, None, None]
        found.append(own.with_noise(_lifted(noise), float(np.median(count))))
    return found


def _window_sums(residual: Residual, omega: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Sums of e e^H of the lines within half of each omega, at least one, and their numbers."""
    e, own = residual.error, residual.block.omega
    outer = e @ np.conj(np.swapaxes(e, -1, -2))
    running = np.concatenate([np.zeros((1, *outer.shape[1:])), np.cumsum(outer, axis=0)])
    # At the ends of the band the window stays whole and slides inward.
    low, high = np.clip(omega - half, own[0], max(own[-1] - 2 * half, own[0])), None
    high = np.minimum(low + 2 * half, own[-1])
    first, last = np.searchsorted(own, low - 1e-9), np.searchsorted(own, high + 1e-9)
    last = np.maximum(last, first + 1)
    return running[np.minimum(last, len(own))] - running[np.minimum(first, len(own) - 1)], (last - first) * e.shape[2]


def _lifted(noise: np.ndarray) -> np.ndarray:
    """Hermitian, its smallest eigenvalues kept above round-off."""
    noise = (noise + np.conj(np.swapaxes(noise, -1, -2))) / 2
    size = np.real(np.einsum("nii->ni", noise))
    n_y = noise.shape[-1]
    return noise + 1e-9 * size[:, :, None] * np.eye(n_y) + 1e-30 * np.eye(n_y) * (size.max() or 1.0)


def _smoothed(power: np.ndarray, width: int) -> np.ndarray:
    """(n, n_y) running mean over lines."""
    kernel = np.ones(width) / width
    padded = np.pad(power, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)
