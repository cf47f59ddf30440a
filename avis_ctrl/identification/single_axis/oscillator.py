"""A lumped oscillator m y'' + d y' + k y = u identified from input and output records in the frequency domain.

For a non-periodic stretch of record, the discrete Fourier transforms obey exactly (Pintelon and Schoukens 2012, section
6.3.2; band-limited signals)

    Y = (U + T) / (m s^2 + d s + k),    T a polynomial in s: the state at both ends of the stretch, and leakage

The coefficients of T are projected out. The noise is the residual of the fit, smoothed over neighbouring lines, so that
the lines are weighted according to its colour. A cubic spring k3 y^3 is not a parameter here: for a Gaussian output of
variance sigma^2 the best linear spring is k + 3 k3 sigma^2 (equivalent linearisation, Caughey 1963).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.single_axis.fit import SingleAxisFit, concluded, slopes

PARAMETERS = {"m": "u s^2 a unit of y", "d": "u s a unit of y", "k": "u a unit of y"}


@dataclass(frozen=True)
class OscillatorSettings:
    """transient : coefficients of T: two for the state at both ends of the stretch, two for leakage.
    smoothed : lines on either side whose residual gives the noise; 17 lines give its level to a quarter, and its colour
        is as smooth as that.
    correlated_lines : neighbouring lines whose residuals count as correlated, because leakage spreads over several
        lines; few compared with the lines of a band.
    """

    transient: int = 4
    smoothed: int = 8
    correlated_lines: int = 4


SETTINGS = OscillatorSettings()


def fit_oscillator(u: np.ndarray, y: np.ndarray, sample_rate_Hz: float, band_Hz: tuple[float, float]) -> SingleAxisFit:
    """Fit m, d and k to one stretch of record.

    Parameters
    ----------
    u, y : (n,), band-limited (not held between samples). band_Hz : of the lines used; the input must excite it.

    Raises
    ------
    InputError : a band outside 0 .. half the sample rate or with fewer than 40 lines.
    ComputationError : no oscillator with positive mass and stiffness fits.
    """
    U, Y, f = _lines(u, y, sample_rate_Hz, band_Hz)
    s = 2j * np.pi * f
    s0 = 2 * np.pi * float(np.sqrt(band_Hz[0] * band_Hz[1])) if band_Hz[0] > 0 else np.pi * band_Hz[1]
    powers = (s / s0)[:, None] ** np.arange(SETTINGS.transient)

    def oscillator(x: np.ndarray) -> np.ndarray:
        return x[0] * (s / s0) ** 2 + x[1] * s / s0 + x[2]

    def left(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        D = oscillator(x)
        T, e = _parts(powers / D[:, None] * weight[:, None]), _parts((Y - U / D) * weight)
        return e - T @ np.linalg.lstsq(T, e, rcond=None)[0]

    weight = np.full(len(f), 1 / np.linalg.norm(Y))
    x = _linear(U, Y, s / s0, powers)
    for _ in range(4):
        scale = np.where(x == 0, 1.0, np.abs(x))
        found = least_squares(lambda z, w=weight, a=scale: left(z * a, w), x / scale, xtol=1e-13, ftol=1e-13)
        x = found.x * scale
        e = left(x, weight)
        error = (e[: len(f)] + 1j * e[len(f) :]) / weight
        power = np.abs(error) ** 2
        level = uniform_filter1d(power, 2 * SETTINGS.smoothed + 1, mode="nearest")
        weight = np.sqrt(2 / np.maximum(level, 1e-12 * power.mean() + np.finfo(float).tiny))
    to_units = np.array([1 / s0**2, 1 / s0, 1.0])
    if not (x[0] > 0 and x[2] > 0):
        raise ComputationError(
            "no oscillator with positive mass and stiffness fits the record",
            measured=f"m {x[0] * to_units[0]:.3g}, k {x[2]:.3g}",
            cause="input and output exchanged, or a band without the resonance",
            next_step="check the columns and widen the band",
        )
    J = slopes(lambda x: left(x, weight), x, np.abs(x)) / to_units
    n, e, spent = len(f), left(x, weight), len(x) + SETTINGS.transient
    # The damping is determined by the few lines of the resonance, to which the fit adapts.
    return concluded(
        "m y'' + d y' + k y = u",
        PARAMETERS,
        x * to_units,
        e.reshape(2, n).T,
        J.reshape(2, n, -1).swapaxes(0, 1),
        spent,
        (f, Y, Y - error),
        lags=SETTINGS.correlated_lines,
        method=f"noise from the residual's spectrum, neighbouring {SETTINGS.correlated_lines} lines correlated",
        notes=(
            "values of the best linear oscillator at the level of this record; they change with the level, which the "
            "standard deviations do not include",
            "figure data: spectrum of the output and of the model's, transient included",
        ),
    )


def _lines(
    u: np.ndarray, y: np.ndarray, rate: float, band_Hz: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    low, high = band_Hz
    if not 0 <= low < high < rate / 2:
        raise InputError(f"expected low < high between 0 and {rate / 2:g} Hz", field="band_Hz", value=(low, high))
    f = np.fft.rfftfreq(len(u), 1 / rate)
    keep = (f >= low) & (f <= high) & (f > 0)
    if np.count_nonzero(keep) < 40:
        raise InputError(
            "expected at least 40 lines in the band; a longer stretch has more", field="band_Hz", value=(low, high)
        )
    U, Y = np.fft.rfft(u)[keep], np.fft.rfft(y)[keep]
    if not (np.any(U) and np.any(Y)):
        raise InputError("expected an input and an output that move in the band", field="u, y")
    return U, Y, f[keep]


def _linear(U: np.ndarray, Y: np.ndarray, s: np.ndarray, powers: np.ndarray) -> np.ndarray:
    """Initial values: Y (m s^2 + d s + k) - T = U is linear in the unknowns."""
    A = np.column_stack([Y * s**2, Y * s, Y, -powers])
    return np.linalg.lstsq(_parts(A), _parts(U), rcond=None)[0][:3]


def _parts(z: np.ndarray) -> np.ndarray:
    return np.concatenate([z.real, z.imag])
