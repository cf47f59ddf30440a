"""Amplitude spectral densities of floor motion, and their r.m.s. in bands and third octaves.

An amplitude spectral density (ASD) is one-sided, per square root of Hz: the variance in a band is the integral of
its square over frequency in Hz. Between points an ASD follows a power law (a straight line in double-logarithmic
axes), which is integrated exactly.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from avis_ctrl.errors import InputError

Quantity = Literal["displacement", "velocity", "acceleration"]
# Order of the time derivative of displacement.
DERIVATIVES: dict[str, int] = {"displacement": 0, "velocity": 1, "acceleration": 2}


def check_spectrum(frequency_Hz: np.ndarray, asd: np.ndarray, field: str = "asd") -> None:
    """Raise InputError unless both are finite positive vectors (n,), n >= 2, and the frequencies increase."""
    if np.ndim(frequency_Hz) != 1 or np.shape(frequency_Hz) != np.shape(asd) or np.size(asd) < 2:
        raise InputError(
            f"two vectors of one length, at least 2 points; got {np.shape(frequency_Hz)} and {np.shape(asd)}",
            field=field,
        )
    if not (
        np.all(np.isfinite(frequency_Hz)) and np.all(np.asarray(frequency_Hz) > 0) and np.all(np.diff(frequency_Hz) > 0)
    ):
        raise InputError("finite, positive, increasing frequencies", field="frequency_Hz")
    if not (np.all(np.isfinite(asd)) and np.all(np.asarray(asd) > 0)):
        raise InputError("finite, positive densities", field=field)


def band_rms(frequency_Hz: np.ndarray, asd: np.ndarray, low_Hz: float, high_Hz: float) -> float:
    """R.m.s. between two frequencies inside the data, exact for the piecewise power law through the points.

    Raises InputError if the band is empty or not inside the data.
    """
    check_spectrum(frequency_Hz, asd)
    f, a = np.asarray(frequency_Hz, float), np.asarray(asd, float)
    slack = 1e-9
    if not (f[0] * (1 - slack) <= low_Hz < high_Hz <= f[-1] * (1 + slack)):
        raise InputError(f"a band inside {f[0]:.4g} to {f[-1]:.4g} Hz", field="band_Hz", value=(low_Hz, high_Hz))
    low_Hz, high_Hz = max(low_Hz, f[0]), min(high_Hz, f[-1])
    inside = (f > low_Hz) & (f < high_Hz)
    points = np.concatenate([[low_Hz], f[inside], [high_Hz]])
    power = np.exp(2 * np.interp(np.log(points), np.log(f), np.log(a)))
    ratio = np.log(points[1:] / points[:-1])
    # Integral of c f^m over one piece; it is a logarithm if the exponent m + 1 vanishes.
    exponent = np.log(power[1:] / power[:-1]) / ratio + 1.0
    growth = exponent * ratio
    pieces = (
        power[:-1]
        * points[:-1]
        * ratio
        * np.where(np.abs(growth) < 1e-9, 1.0 + growth / 2, np.expm1(growth) / np.where(growth == 0, 1.0, growth))
    )
    return float(np.sqrt(np.sum(pieces)))


def third_octave_midbands(low_Hz: float, high_Hz: float) -> np.ndarray:
    """Exact midbands 1000 * 10^(k/10) Hz (IEC 61260-1:2014, base ten) from low_Hz to high_Hz, inclusive.

    The limits are nominal midbands: 8 Hz means the band at 7.943 Hz.
    """
    first, last = (int(np.round(10 * np.log10(f / 1000.0))) for f in (low_Hz, high_Hz))
    return 1000.0 * 10.0 ** (np.arange(first, last + 1) / 10.0)


def third_octave_edges(midband_Hz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper edge of each third-octave band: midband times 10^(-+1/20)."""
    midband_Hz = np.asarray(midband_Hz, float)
    return midband_Hz * 10**-0.05, midband_Hz * 10**0.05


def third_octave_rms(frequency_Hz: np.ndarray, asd: np.ndarray, midband_Hz: np.ndarray) -> np.ndarray:
    """R.m.s. of third octaves. Raises InputError if one is not inside the data."""
    edges = zip(*third_octave_edges(midband_Hz), strict=True)
    return np.array([band_rms(frequency_Hz, asd, low, high) for low, high in edges])
