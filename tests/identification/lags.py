"""Is a channel late by a pure delay, or by dynamics: judged on frequencies that the fit has not seen.

The displacement of a mass over its velocity is K D(s)/s with D = exp(-s tau) (delay), 1/(1 + s T) (extra pole) or
1/(1 + 2 zeta s/omega_m + (s/omega_m)^2) (a mechanical mode of the sensor's mount; lightly damped, zeta <= 0.2, for one
of zeta = 0.87 has the phase of a delay to fourth order). K is real, so the phase holds D alone.

The phase of a delay is -tau omega, that of a pole -T omega + (T omega)^3/3 - ..: the share of the cubic term is 0 or 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

LARGEST_MODE_DAMPING = 0.2
# By the lag [s] at low frequency x[0] (of the mode 2 zeta / omega_m), and the damping ratio x[1] of the mode.
SHAPES = {
    "delay": lambda s, x: np.exp(-s * x[0]),
    "pole": lambda s, x: 1 / (1 + s * x[0]),
    "mode": lambda s, x: 1 / (1 + x[0] * s + (s * x[0] / (2 * x[1])) ** 2),
}


class Lag(NamedTuple):
    """What one hypothesis makes of the phase: its lag [s] with standard deviation, and the r.m.s. phase error on the
    frequencies held out [degrees]."""

    lag_s: float
    std_s: float
    held_out_deg: float


def compare_lags(frequency_Hz: np.ndarray, ratio: np.ndarray, fitted: np.ndarray) -> dict[str, Lag]:
    """Delay, pole and mode, fitted to the phase of ratio (n,), displacement over velocity, at some frequencies (n,)
    bool."""
    s, D = _turned(frequency_Hz, ratio)
    start, found = float(-np.sum(np.angle(D[fitted]) * s[fitted].imag) / np.sum(s[fitted].imag ** 2)), {}
    for name, shape in SHAPES.items():
        x0 = np.array([start if start > 0 else 1e-4, 0.1][: 2 if name == "mode" else 1])

        def error(x: np.ndarray, keep: np.ndarray, shape=shape, x0=x0) -> np.ndarray:
            return np.angle(D[keep] / shape(s[keep], x * x0))

        most = np.array([1e2, LARGEST_MODE_DAMPING / x0[-1]][: len(x0)])
        best = least_squares(error, np.ones(len(x0)), bounds=(1e-2, most), args=(fitted,), xtol=1e-14, ftol=1e-14)
        level = np.linalg.norm(best.fun) / np.sqrt(len(best.fun) - len(x0))
        out = np.degrees(np.sqrt(np.mean(error(best.x, ~fitted) ** 2)))
        found[name] = Lag(best.x[0] * x0[0], level / np.linalg.norm(best.jac[:, 0]) * x0[0], out)
    return found


def _turned(frequency_Hz: np.ndarray, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s and K D; a sensor may count backwards."""
    s = 2j * np.pi * frequency_Hz
    return s, ratio * s * np.sign(np.sum((ratio * s).real))


def cubic_share(frequency_Hz: np.ndarray, ratio: np.ndarray) -> tuple[float, float]:
    """Share of a pole's cubic phase in the measured one, over all frequencies: 0 for a delay, 1 for a pole.

    With its standard deviation from the scatter of the phases, which are taken as independent.
    """
    # In units of the highest frequency: the share has none.
    x, phase = frequency_Hz / np.max(frequency_Hz), np.angle(_turned(frequency_Hz, ratio)[1])
    X = np.column_stack([-x, x**3 / 3])
    (tau, cubic), *_ = np.linalg.lstsq(X, phase, rcond=None)
    e = phase - X @ (tau, cubic)
    sigma = np.sqrt(np.linalg.inv(X.T @ X)[1, 1] * float(e @ e) / (len(e) - 2))
    return float(cubic / tau**3), float(sigma / abs(tau) ** 3)
