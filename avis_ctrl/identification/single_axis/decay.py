"""Corner frequency and damping ratio from free decays.

A released oscillator decays as a combination of exp(s_1 t) and exp(s_2 t), s^2 + 2 zeta omega_0 s + omega_0^2 = 0, in
every channel that measures it. The amplitudes and a drifting zero of each channel are projected out (Golub and Pereyra
1973).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.single_axis.fit import SingleAxisFit, concluded


def fit_decay(
    time: np.ndarray,
    channels: np.ndarray,
    corner_Hz: float = 1.0,
    damping: float = 0.1,
    drift: int = 1,
    start_s: float = 0.0,
    end_s: float = np.inf,
) -> SingleAxisFit:
    """Corner frequency and damping ratio of a decay, common to all channels.

    Parameters
    ----------
    time : (n,) s. channels : (n, c) or (n,), normalised here to unit standard deviation.
    corner_Hz, damping : initial values. drift : degree of the polynomial of each channel's drifting zero.
    start_s, end_s : of the decay, from after the release, on the scale of `time`.

    Raises
    ------
    InputError : fewer than 32 samples, wrong initial values, a constant channel.
    ComputationError : no decaying oscillation fits.
    """
    keep = (time >= start_s) & (time <= end_s)
    if np.count_nonzero(keep) < 32:
        raise InputError(
            f"expected at least 32 samples between start_s and end_s; the record lasts {time[-1]:g} s",
            field="start_s, end_s",
            value=(start_s, end_s),
        )
    time, y = time[keep], (channels[:, None] if channels.ndim == 1 else channels)[keep]
    if not (corner_Hz > 0 and damping > 0) or not 0 <= drift <= 3:
        raise InputError(
            "expected a positive corner in Hz and damping to start from, and a drift of degree 0 to 3",
            field="corner_Hz, damping, drift",
            value=(corner_Hz, damping, drift),
        )
    if not np.all(y.std(0) > 0):
        raise InputError("expected channels that move; one is constant", field="decay")
    y, t = y / y.std(0), time - time[0]
    start = np.array([corner_Hz, damping])

    def left(x: np.ndarray) -> np.ndarray:
        X = _columns(t, x * start, drift)
        return y - X @ np.linalg.lstsq(X, y, rcond=None)[0]

    found = least_squares(lambda x: left(x).ravel(), np.ones(2), bounds=(1e-3, 1e3), xtol=1e-12, ftol=1e-12)
    theta, e = found.x * start, left(found.x)
    if np.linalg.norm(e) > 0.5 * np.linalg.norm(y):
        raise ComputationError(
            "no decaying oscillation fits the record",
            measured=f"the residual is {100 * np.linalg.norm(e) / np.linalg.norm(y):.0f} % of the signal",
            cause="a start before the release, or a second event inside",
            next_step="choose the part after one release",
        )
    return concluded(
        "free decay of a second-order oscillator",
        {"corner_Hz": "Hz", "damping": ""},
        theta,
        e,
        found.jac.reshape(*e.shape, 2) / start,
        2 + (3 + drift) * y.shape[1],
        (time, y, y - e),
        notes=(
            "valid at the amplitudes of this part of the record; the standard deviations do not include changes with "
            "amplitude",
        ),
    )


def _columns(t: np.ndarray, theta: np.ndarray, drift: int) -> np.ndarray:
    """(n, 3 + drift): both solutions and the drift; finite at critical damping and beyond."""
    w0, zeta = 2 * np.pi * theta[0], theta[1]
    rest = complex(w0 * np.emath.sqrt(1 - zeta**2))
    envelope = np.exp(-zeta * w0 * t)
    if rest.imag:  # aperiodic: cosh and sinh, combined with the exponential before they overflow
        slow, fast = np.exp(-(zeta * w0 - abs(rest.imag)) * t), np.exp(-(zeta * w0 + abs(rest.imag)) * t)
        first, second = (slow + fast) / 2, (slow - fast) / (2 * abs(rest.imag))
    else:
        first, second = envelope * np.cos(rest.real * t), envelope * t * np.sinc(rest.real * t / np.pi)
    return np.column_stack([first, second * w0, (2 * t[:, None] / t[-1] - 1) ** np.arange(drift + 1)])
