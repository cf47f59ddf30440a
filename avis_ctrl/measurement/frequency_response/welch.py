"""Frequency responses by spectral averaging (Welch) for many inputs and outputs.

With averaged spectra S_uu = mean u u^H, S_yu = mean y u^H, S_yy:

    H1 = S_yu inv(S_uu)          noise on the outputs only
    H2 = S_yy pinv(S_uy)         noise on the inputs only; needs n_u <= n_y
    Hv = total least squares     noise on both, in a given ratio of standard deviations

(Bendat and Piersol, Random Data, 4th ed., 2010, chapter 7; Vold, Crowley and Rocklin, Sound and Vibration 18, 1984.)
Windows leave a bias from leakage and from the curvature of G over the window's main lobe, which no covariance here
includes: `local_polynomial` is the better method for resonances; this one is what other tools compute.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import fft, signal

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.spectra import (
    Band,
    Channels,
    channels,
    checked_band,
    hermitian_solve,
    lines,
    taking_part,
)

Estimator = Literal["H1", "H2", "Hv"]


@dataclass(frozen=True)
class WelchSettings:
    """samples_at_once : number of samples in the segments transformed together; it limits the memory.
    dependent : eigenvalue of the inputs' spectral matrix, scaled to unit diagonal, below which the responses cannot be
        separated: they would have 10^5 times the noise.
    """

    samples_at_once: int = 1 << 20
    dependent: float = 1e-10


SETTINGS = WelchSettings()


def effective_averages(window: np.ndarray, step: int, segments: int) -> float:
    """Independent segments that average as well as overlapping ones do: K / (1 + 2 sum (1 - j/K) rho_j), rho_j the
    squared normalised correlation of the window with itself shifted by j steps (Welch, IEEE Trans. AU-15, 1967)."""
    energy, total = float(window @ window), 1.0
    for j in range(1, min(segments, -(-window.size // step))):
        rho = float(window[j * step:] @ window[:window.size - j * step]) / energy
        total += 2 * (1 - j / segments) * rho ** 2
    return segments / total


def spectral_average(campaign: Campaign, *, estimator: Estimator = "H1", segment_samples: int | None = None,
                     window: str | tuple[str, float] = "hann", overlap: float = 0.5, band_Hz: Band | None = None,
                     inputs: Sequence[str] | None = None, floor: bool | None = None,
                     noise_ratio: tuple[Sequence[float], Sequence[float]] | None = None) -> FrequencyResponse:
    """H1, H2 or Hv with multiple coherence and covariance, averaged over segments of all records.

    Parameters
    ----------
    segment_samples : length of a segment; by default a power of two that gives at least 8 (1 + n_u) segments.
    window : any of scipy.signal.get_window. overlap : part of a segment shared with the next, 0 to below 1.
    band_Hz, inputs, floor : as in local_polynomial.
    noise_ratio : standard deviations of the noise of the inputs (n_u,) and of the outputs (n_y,), up to a common
        factor, for Hv; by default each channel's noise is taken proportional to its r.m.s.: an assumption, not a
        measurement.

    The covariance counts e = y - G u over the effective number of averages less n_u; for H2 and Hv it is of first
    order in the noise.

    Raises
    ------
    InputError : too few averages, H2 with n_u > n_y, wrong options.
    ComputationError : dependent inputs.
    """
    if estimator not in ("H1", "H2", "Hv"):
        raise InputError("expected H1, H2 or Hv", field="estimator", value=estimator)
    records = taking_part(campaign, floor)
    used = channels(campaign, records, inputs, floor)
    n_u, n_y, rate = len(used.inputs), len(used.outputs), campaign.sample_rate_Hz
    if estimator == "H2" and n_u > n_y:
        raise InputError(f"H2 is not defined for {n_u} inputs and {n_y} outputs: S_uy has no right inverse; use H1 or "
                         "Hv, or choose fewer inputs", field="estimator", value=estimator)
    n = _segment(segment_samples, records, n_u)
    if not 0 <= overlap < 1:
        raise InputError("expected 0 to below 1", field="overlap", value=overlap)
    shape, step = _window(window, n), max(1, round(n * (1 - overlap)))
    keep = lines(n, rate, checked_band(band_Hz, rate))
    if keep.stop <= keep.start:
        raise InputError(f"expected a band with lines of {rate / n:g} Hz", field="band_Hz", value=band_Hz)
    S, count = _spectra(records, used, shape, step, keep)
    if count <= n_u:
        raise InputError(f"expected more than {n_u} averages for {n_u} inputs, there are {count:.3g}: shorter segments "
                         "or longer records", field="segment_samples", value=n)
    _check_rank(S[:, :n_u, :n_u], used.inputs, np.arange(keep.start, keep.stop) * rate / n)
    G = _estimate(S, n_u, estimator, noise_ratio)
    error = np.concatenate([-G, np.broadcast_to(np.eye(n_y), (len(G), n_y, n_y))], axis=2)
    noise = error @ S @ np.swapaxes(error.conj(), 1, 2) * count / (count - n_u)
    return FrequencyResponse(
        np.arange(keep.start, keep.stop) * rate / n, G, noise, S[:, :n_u, :n_u] * count, used.inputs, used.outputs,
        used.input_unit, used.output_unit, float(count - n_u), coherence=_coherence(S, n_u),
        method=f"{estimator}, {window} window of {n} samples, overlap {overlap:g}, {count:.1f} effective averages")


def _segment(asked: int | None, records: Sequence[RecordSource], n_u: int) -> int:
    longest, total = max(r.header.samples for r in records), sum(r.header.samples for r in records)
    if asked is None:
        return max(16, min(1 << int(np.log2(max(total // (4 * (1 + n_u)), 16))), longest))
    if not 4 <= asked <= longest:
        raise InputError(f"expected 4 to {longest} samples, the longest record", field="segment_samples", value=asked)
    return asked


def _window(window: str | tuple[str, float], n: int) -> np.ndarray:
    try:
        return np.asarray(signal.get_window(window, n), float)
    except (ValueError, TypeError):
        raise InputError("expected a window of scipy.signal.get_window, such as hann, boxcar or ('kaiser', 8.0)",
                         field="window", value=window) from None


def _spectra(records: Sequence[RecordSource], used: Channels, window: np.ndarray, step: int,
             keep: slice) -> tuple[np.ndarray, float]:
    """S (lines, n_z, n_z) of [u, y] and the effective number of averages over all records."""
    total: np.ndarray | float = 0.0
    segments, effective = 0, 0.0
    scale = 1 / np.sqrt(float(window @ window))
    for record in records:
        count = (record.header.samples - window.size) // step + 1
        if count < 1:
            continue
        for x in _segments(record, used, window.size, step, count):
            x = (x - x.mean(axis=1, keepdims=True)) * window[:, None]
            Z = np.moveaxis(fft.rfft(x, axis=1)[:, keep], 0, 1) * scale
            total = total + np.swapaxes(Z, 1, 2) @ Z.conj()
        segments += count
        effective += effective_averages(window, step, count)
    return np.asarray(total) / segments, effective


def _segments(record: RecordSource, used: Channels, n: int, step: int, count: int) -> Iterator[np.ndarray]:
    """(some, n, n_z) overlapping segments; no more of the record in memory than these need."""
    some = max(1, SETTINGS.samples_at_once // n)
    for first in range(0, count, some):
        last = min(first + some, count)
        z = np.hstack(used.of(record.load(first * step, (last - 1) * step + n)))
        yield np.stack([z[k * step:k * step + n] for k in range(last - first)])


def _check_rank(S_uu: np.ndarray, names: tuple[str, ...], frequency_Hz: np.ndarray) -> None:
    size = np.sqrt(np.maximum(np.real(np.einsum("nii->ni", S_uu)), np.finfo(float).tiny))
    # Power far below an input's largest is the window's side lobes or rounding.
    silent = size < 1e-9 * size.max(axis=0)
    values, vectors = np.linalg.eigh(S_uu / (size[:, :, None] * size[:, None, :]))
    bad = np.flatnonzero((values[:, 0] < SETTINGS.dependent) | silent.any(axis=1))
    if bad.size:
        k = bad[0]
        which = [n for n, part, off in zip(names, np.abs(vectors[k, :, 0]), silent[k], strict=True)
                 if off or (values[k, 0] < SETTINGS.dependent and part > 0.03)]
        raise ComputationError(
            f"the responses to {', '.join(which)} cannot be distinguished or are not excited",
            measured=f"{bad.size} of {frequency_Hz.size} lines from {frequency_Hz[k]:.6g} Hz",
            cause="inputs that are silent there or driven by the same signal",
            next_step="keep to the excited band, choose other inputs, or take in records that drive them differently")


def _estimate(S: np.ndarray, n_u: int, estimator: str,
              noise_ratio: tuple[Sequence[float], Sequence[float]] | None) -> np.ndarray:
    S_uu, S_uy, S_yy = S[:, :n_u, :n_u], S[:, :n_u, n_u:], S[:, n_u:, n_u:]
    S_yu = np.swapaxes(S_uy.conj(), 1, 2)
    if estimator == "H1":
        return hermitian_solve(S_yu, S_uu)
    power = np.sqrt(np.mean(np.real(np.einsum("nii->ni", S)), axis=0))
    power = np.where(power > 0, power, 1.0)
    if estimator == "H2":
        # Scaled, so that the pseudo-inverse does not weigh outputs or inputs by their units.
        scaled = S_uy / power[:n_u, None] / power[n_u:]
        return S_yy / power[n_u:] @ np.linalg.pinv(scaled, rcond=1e-12) / power[:n_u]
    sigma = power if noise_ratio is None else _ratio(noise_ratio, n_u, S.shape[1] - n_u)
    _, vectors = np.linalg.eigh(S / (sigma[:, None] * sigma))
    null = np.swapaxes(vectors[:, :, :S.shape[1] - n_u].conj(), 1, 2)
    return -np.linalg.solve(null[:, :, n_u:], null[:, :, :n_u]) * sigma[n_u:, None] / sigma[:n_u]


def _ratio(noise_ratio: tuple[Sequence[float], Sequence[float]], n_u: int, n_y: int) -> np.ndarray:
    of_inputs, of_outputs = (np.asarray(part, float) for part in noise_ratio)
    if of_inputs.shape != (n_u,) or of_outputs.shape != (n_y,):
        raise InputError(f"expected {n_u} and {n_y} standard deviations, of the noise of inputs and outputs",
                         field="noise_ratio", value=(of_inputs.shape, of_outputs.shape))
    sigma = np.concatenate([of_inputs, of_outputs])
    if not (np.all(np.isfinite(sigma)) and np.all(sigma > 0)):
        raise InputError("expected positive standard deviations; for noise-free inputs use H1", field="noise_ratio",
                         value=sigma.tolist())
    return sigma


def _coherence(S: np.ndarray, n_u: int) -> np.ndarray:
    """(n, n_y) part of each output's power that the inputs explain linearly; an output without power has none."""
    S_uy = S[:, :n_u, n_u:]
    S_yu = np.swapaxes(S_uy.conj(), 1, 2)
    explained = np.real(np.einsum("nij,nji->ni", hermitian_solve(S_yu, S[:, :n_u, :n_u]), S_uy))
    power = np.real(np.einsum("nii->ni", S[:, n_u:, n_u:]))
    return np.clip(np.divide(explained, power, out=np.zeros_like(power), where=power > 0), 0.0, 1.0)
