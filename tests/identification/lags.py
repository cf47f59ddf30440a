"""Is a channel late by a pure delay, or by dynamics: judged on frequencies that the fit has not seen.

The displacement of a mass over its velocity is K D(s)/s with D = exp(-s tau) (delay), 1/(1 + s T) (extra pole) or
1/(1 + 2 zeta s/omega_m + (s/omega_m)^2) (a mechanical mode of the sensor's mount; lightly damped, zeta <= 0.2, for one
of zeta = 0.87 has the phase of a delay to fourth order). K is real, so the phase holds D alone.

The phase of a delay is -tau omega, that of a pole -T omega + (T omega)^3/3 - ..: the share of the cubic term is 0 or 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from avis_ctrl.errors import InputError

LARGEST_MODE_DAMPING = 0.2


@dataclass(frozen=True)
class LagHypothesis:
    """What one hypothesis makes of the phase.

    parameters : by name. standard_deviation : of the first. fitted_deg, held_out_deg : r.m.s. phase error on the
    frequencies fitted and held out. held_out_sigma : the latter in standard deviations of the noise (r.m.s.).
    held_out_magnitude : r.m.s. relative error of |D| K on the frequencies held out, K from those fitted.
    """

    name: str
    parameters: dict[str, float]
    standard_deviation: float
    fitted_deg: float
    held_out_deg: float
    held_out_sigma: float
    held_out_magnitude: float


def _delay(s: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.exp(-s * x[0])


def _pole(s: np.ndarray, x: np.ndarray) -> np.ndarray:
    return 1 / (1 + s * x[0])


def _mode(s: np.ndarray, x: np.ndarray) -> np.ndarray:
    # x[0] is the delay 2 zeta / omega_m that the mode has at low frequency.
    omega = 2 * x[1] / x[0]
    return 1 / (1 + x[0] * s + (s / omega) ** 2)


def compare_lags(
    frequency_Hz: np.ndarray, ratio: np.ndarray, variance: np.ndarray, fitted: np.ndarray
) -> tuple[LagHypothesis, ...]:
    """Delay, pole and mode, in this order.

    Parameters
    ----------
    ratio : (n,) complex displacement over velocity. variance : (n,) E|error|^2 of it. fitted : (n,) bool, the
        frequencies that each hypothesis is fitted to, all alike; the others are held out.

    Raises
    ------
    InputError : fewer than three frequencies fitted, or none held out.
    """
    fitted = np.asarray(fitted, bool)
    if np.count_nonzero(fitted) < 3 or np.all(fitted) or np.any(np.abs(ratio) == 0):
        raise InputError(
            "expected at least three frequencies to fit, and some held out",
            field="fitted",
            value=int(np.count_nonzero(fitted)),
        )
    s = 2j * np.pi * np.asarray(frequency_Hz, float)
    D = ratio * s
    D = D * np.sign(np.sum(D.real))  # a sensor may count backwards
    start = float(-np.sum(np.angle(D[fitted]) * s[fitted].imag) / np.sum(s[fitted].imag ** 2))
    start = start if start > 0 else 1e-4
    sigma = np.sqrt(variance / 2) / np.abs(ratio)
    models: tuple[tuple[str, Callable, list[str], list[float]], ...] = (
        ("delay", _delay, ["delay_s"], [start]),
        ("pole", _pole, ["time_constant_s"], [start]),
        ("mode", _mode, ["lag_s", "damping"], [start, 0.1]),
    )
    return tuple(_judged(name, shape, names, np.array(x0), s, D, sigma, fitted) for name, shape, names, x0 in models)


def _judged(
    name: str,
    shape: Callable,
    names: list[str],
    x0: np.ndarray,
    s: np.ndarray,
    D: np.ndarray,
    sigma: np.ndarray,
    fitted: np.ndarray,
) -> LagHypothesis:
    def error(x: np.ndarray, keep: np.ndarray) -> np.ndarray:
        return np.angle(D[keep] / shape(s[keep], x * x0))

    bounds = (np.full(len(x0), 1e-2), np.array([1e2, LARGEST_MODE_DAMPING / x0[-1]][: len(x0)]))
    found = least_squares(error, np.ones(len(x0)), bounds=bounds, args=(fitted,), xtol=1e-14, ftol=1e-14)
    e, out = found.fun, error(found.x, ~fitted)
    slope = np.linalg.norm(found.jac[:, 0])
    level = np.linalg.norm(e) / np.sqrt(max(len(e) - len(x0), 1))
    gain = np.abs(D / shape(s, found.x * x0))
    K = np.exp(np.mean(np.log(gain[fitted])))

    def rms(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(x**2)))

    return LagHypothesis(
        name,
        dict(zip(names, (found.x * x0).tolist(), strict=True)),
        float(level / slope * x0[0]),
        float(np.degrees(rms(e))),
        float(np.degrees(rms(out))),
        rms(out / sigma[~fitted]),
        rms(gain[~fitted] / K - 1),
    )


def cubic_share(frequency_Hz: np.ndarray, ratio: np.ndarray) -> tuple[float, float]:
    """Share of a pole's cubic phase in the measured one, over all frequencies: 0 for a delay, 1 for a pole.

    With its standard deviation from the scatter of the phases, which are taken as independent.

    Raises
    ------
    InputError : fewer than four frequencies.
    """
    if len(frequency_Hz) < 4:
        raise InputError("expected at least four frequencies", field="frequency_Hz", value=len(frequency_Hz))
    # In units of the highest frequency: the share has none.
    x = np.asarray(frequency_Hz, float) / np.max(frequency_Hz)
    D = ratio * 1j * x
    phase = np.angle(D * np.sign(np.sum(D.real)))
    X = np.column_stack([-x, x**3 / 3])
    (tau, cubic), *_ = np.linalg.lstsq(X, phase, rcond=None)
    e = phase - X @ (tau, cubic)
    sigma = np.sqrt(np.linalg.inv(X.T @ X)[1, 1] * float(e @ e) / (len(e) - 2))
    return float(cubic / tau**3), float(sigma / abs(tau) ** 3)
