"""Voltages that drive the table, and the motion of the floor."""

from __future__ import annotations

import numpy as np


def multisine(
    rng: np.random.Generator,
    samples: int,
    channels: int,
    period: int,
    band_Hz: tuple[float, float],
    rate_Hz: float,
    level: float,
) -> np.ndarray:
    """(samples, channels) random-phase multisine, flat, period in samples, each channel of r.m.s. level."""
    f = np.fft.rfftfreq(period, 1 / rate_Hz)
    spectrum = np.zeros((len(f), channels), complex)
    lines = (f >= band_Hz[0] - 1e-9) & (f <= band_Hz[1] + 1e-9)
    spectrum[lines] = np.exp(2j * np.pi * rng.random((lines.sum(), channels)))
    one = np.fft.irfft(spectrum, period, axis=0)
    one *= level / one.std(axis=0)
    return one[np.arange(samples) % period]


def noise(
    rng: np.random.Generator, samples: int, channels: int, band_Hz: tuple[float, float], rate_Hz: float, level: float
) -> np.ndarray:
    """(samples, channels) band-limited Gaussian noise: a stretch of a longer periodic draw, so not periodic itself."""
    length = 1 << (samples + samples // 4).bit_length()
    f = np.fft.rfftfreq(length, 1 / rate_Hz)
    spectrum = rng.standard_normal((len(f), channels)) + 1j * rng.standard_normal((len(f), channels))
    spectrum[(f < band_Hz[0]) | (f > band_Hz[1])] = 0
    out = np.fft.irfft(spectrum, length, axis=0)
    return (out * level / out.std(axis=0))[:samples]


def floor_motion(rng: np.random.Generator, samples: int, rate_Hz: float, rms: float, slope: float) -> np.ndarray:
    """(samples, 9) displacement, velocity and acceleration of the floor along x, y, z.

    rms : m/s of the velocity in each direction, within 0.5-60 Hz, where its amplitude falls as f^-slope.
    """
    length = 1 << (samples + samples // 4).bit_length()
    f = np.fft.rfftfreq(length, 1 / rate_Hz)
    inside = (f >= 0.5) & (f <= 60.0)
    v = np.zeros((len(f), 3), complex)
    shape = (inside.sum(), 3)
    v[inside] = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * f[inside, None] ** -slope
    s = 2j * np.pi * np.where(f > 0, f, 1.0)[:, None]
    scale = rms / np.fft.irfft(v, length, axis=0).std(axis=0)
    return np.hstack([np.fft.irfft(one, length, axis=0)[:samples] * scale for one in (v / s, v, v * s)])
