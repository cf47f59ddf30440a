"""Frequency response of a table in closed form, from matrices: what the time-domain simulator is checked against.

Assembled as dynamic stiffness Z(s), with every linear effect as an extra coordinate or a complex stiffness. Nothing of
the integrator is used; the sampled response follows from the continuous one by summing its aliases.
"""

from __future__ import annotations

import numpy as np

from .kernel import Physics
from .table import carry


def mount_stiffness(P: Physics, s: complex) -> np.ndarray:
    """(4, 3) complex stiffness of the mounts."""
    k = P.k + P.c * s
    for g, w in zip(P.ladder_k, P.ladder_w, strict=True):
        k = k + P.k * g[:, None] * s / (s + w)
    if len(P.surge_m):
        above, below = P.k[:, 2] / P.surge_share + P.surge_c * s, P.k[:, 2] / (1 - P.surge_share) + P.surge_c * s
        k[:, 2] += above - above**2 / (above + below + P.surge_m * s**2) - P.k[:, 2]
    for branch, damper in zip(P.max_k, P.max_c, strict=True):
        k[:, 2] += branch * s / (s + branch / damper)
    if len(P.level_w):
        k[:3, 2] += P.level_w * P.k[:3, 2] / (s * (1 + s * P.level_tau))
    return k


def response(P: Physics, f_Hz: float) -> np.ndarray:
    """(6, 8) from held motor voltage to sensor voltage, without delay and hold."""
    s = 2j * np.pi * f_Hz
    modes, free = len(P.mode_w), np.flatnonzero(P.base_free)
    chassis = len(free)
    n = 6 + modes + chassis

    def motion(p: np.ndarray, mount: int) -> np.ndarray:
        """(3, n) of the payload at p, where it bends as at a mount."""
        shapes = [P.mode_shape[j, mount][:, None] for j in range(modes)]
        return np.hstack([carry(p), *shapes, np.zeros((3, chassis))])

    def apart(on_payload: np.ndarray, on_chassis: np.ndarray, mount: int) -> np.ndarray:
        """(3, n) of the payload less that of the chassis."""
        out = motion(on_payload, mount)
        out[:, 6 + modes :] -= carry(on_chassis)[:, free]
        return out

    stretch = [apart(P.r[i], P.base_r[i], i) for i in range(4)]
    Z = np.zeros((n, n), complex)
    Z[:3, :3] = s**2 * P.m * np.eye(3)
    h = P.rotor
    Z[3:6, 3:6] = s**2 * P.J + s * np.array([[0, h[2], -h[1]], [-h[2], 0, h[0]], [h[1], -h[0], 0]])
    for j in range(modes):
        Z[6 + j, 6 + j] = s**2 + 2 * P.mode_z[j] * P.mode_w[j] * s + P.mode_w[j] ** 2
    if chassis:
        own = np.diag(s**2 / P.base_Mi) + s * P.base_C + P.base_K
        Z[6 + modes :, 6 + modes :] = own[np.ix_(free, free)]
    k = mount_stiffness(P, s)
    for i in range(4):
        Z += stretch[i].T @ np.diag(k[i]) @ stretch[i]
    for p, d, kc, cc in zip(P.cable_r, P.cable_d, P.cable_k, P.cable_c, strict=True):
        row = np.zeros(n)
        row[:6] = d @ carry(p)
        row[6 + modes :] -= np.append(d, np.zeros(3))[free]
        Z += np.outer(row, row) * (kc + cc * s)
    for p, d, m, ko, co in zip(P.osc_r, P.osc_d, P.osc_m, P.osc_k, P.osc_c, strict=True):
        row = np.zeros(n)
        row[:6] = d @ carry(p)
        Z += np.outer(row, row) * m * s**2 * (ko + co * s) / (m * s**2 + co * s + ko)
    lag = np.ones(8, complex)
    for poles in (P.lag, P.lag2):
        if len(poles):
            lag = lag * np.array([w / (s + w) if w > 0 else 1.0 for w in poles])
    T = np.array(
        [
            d @ apart(p, c, i) * tau * w
            for p, c, d, i, tau, w in zip(P.motor_r, P.base_motor_r, P.motor_d, P.motor_at, P.motor, lag, strict=True)
        ]
    ).T
    q = np.linalg.solve(Z, T)
    out = np.empty((6, 8), complex)
    for j in range(6):
        tilt = np.zeros(n)
        tilt[3:6] = P.g * np.array([P.sensor_n[j, 1], -P.sensor_n[j, 0], 0.0])  # of y by +phi_x, of x by -phi_y
        acceleration = (s**2 * P.sensor_n[j] @ motion(P.sensor_r[j], P.sensor_at[j]) + tilt) @ q
        coil = P.S[j] * s / (s**2 + 2 * P.zn[j] * P.wn[j] * s + P.wn[j] ** 2)
        compensation = 1 + (P.b1[j] * s + P.b0[j]) / (s**2 + 2 * P.zc * P.wc * s + P.wc**2)
        out[j] = coil * compensation * acceleration
    return out


def sampled_response(P: Physics, f_Hz: float, rate_Hz: float, delay_s: float, aliases: int = 6) -> np.ndarray:
    """(6, 8) from voltage samples, held and delayed, to samples of the sensors: the sum over aliases.

    Beyond the first `aliases` the response falls as 1/s (a velocity per force), and their sum is taken as that.
    """

    def hold(n: np.ndarray | int) -> np.ndarray:
        s = 2j * np.pi * (f_Hz + n * rate_Hz)
        return (1 - np.exp(-s / rate_Hz)) / (s / rate_Hz) * np.exp(-s * delay_s)

    total = sum(response(P, f_Hz + n * rate_Hz) * hold(n) for n in range(-aliases, aliases + 1))
    for sign in (-1, 1):
        n = sign * np.arange(aliases + 1, 4000)
        last = f_Hz + sign * aliases * rate_Hz
        total = total + response(P, last) * np.sum(hold(n) * last / (f_Hz + n * rate_Hz))
    return total
