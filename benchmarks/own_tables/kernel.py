"""Compiled equations of motion of a rigid body on mounts, and the sampled loop around it (see `physics`).

State of the table, in this order: place p of the centre of mass (3, earth), quaternion (4), velocity v (3, earth), turn
rate w (3, body), one lag state per drive, `order` states per sensor. Newton: m v' = F + m g; Euler: J w' + w x J w = M,
in body axes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Arrays(NamedTuple):
    """A table as arrays; places from the centre of mass at rest, n mounts, d drives, s sensors of `order` states."""

    mass: float
    J: np.ndarray  # (3, 3) kg m^2, about the centre of mass, body axes
    J_inverse: np.ndarray
    gravity: float  # m/s^2, 0: weight and preload neglected
    tilt: float  # m/s^2, gravity that an inertial sensor feels when it tilts; 0: neglected
    mount_p: np.ndarray  # (n, 3) m, on the body
    mount_K: np.ndarray  # (n, 3, 3) N/m, earth axes
    mount_B: np.ndarray  # (n, 3, 3) N s/m
    mount_F: np.ndarray  # (n, 3) N, preload at rest
    drive_p: np.ndarray  # (d, 3) m
    drive_d: np.ndarray  # (d, 3) unit vectors
    drive_gain: np.ndarray  # (d,) N/V
    drive_w: np.ndarray  # (d,) rad/s, corner of the amplifier; 0: no lag
    drive_earth: np.ndarray  # (d,) bool, direction fixed to the earth and not to the body
    sensor_p: np.ndarray  # (s, 3) m
    sensor_d: np.ndarray  # (s, 3) unit vectors
    sensor_kind: (
        np.ndarray
    )  # (s,) 0 acceleration of the body, 1 of the floor, 2 place against the floor, 3 floor velocity
    A: np.ndarray  # (s, order, order)
    B: np.ndarray  # (s, order)
    C: np.ndarray  # (s, order)
    D: np.ndarray  # (s,)


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _times(M, a, out):
    for i in range(3):
        out[i] = M[i, 0] * a[0] + M[i, 1] * a[1] + M[i, 2] * a[2]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _times_transposed(M, a, out):
    for i in range(3):
        out[i] = M[0, i] * a[0] + M[1, i] * a[1] + M[2, i] * a[2]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def derivative(x, u, fl, P, w3, dx, f):
    """dx and the sensors' inputs f at state x, drive volts u, floor fl (18: place, velocity, acceleration)."""
    R, r, a, b, c, e, F, M, wb, g = (w3[0:3], w3[3], w3[4], w3[5], w3[6], w3[7], w3[8], w3[9], w3[10], w3[11])
    q0, q1, q2, q3 = x[3], x[4], x[5], x[6]
    R[0, 0] = 1 - 2 * (q2 * q2 + q3 * q3)
    R[0, 1] = 2 * (q1 * q2 - q0 * q3)
    R[0, 2] = 2 * (q1 * q3 + q0 * q2)
    R[1, 0] = 2 * (q1 * q2 + q0 * q3)
    R[1, 1] = 1 - 2 * (q1 * q1 + q3 * q3)
    R[1, 2] = 2 * (q2 * q3 - q0 * q1)
    R[2, 0] = 2 * (q1 * q3 - q0 * q2)
    R[2, 1] = 2 * (q2 * q3 + q0 * q1)
    R[2, 2] = 1 - 2 * (q1 * q1 + q2 * q2)
    for i in range(3):
        wb[i] = x[10 + i]
        F[i] = 0.0
        M[i] = 0.0
    F[2] = -P.mass * P.gravity
    for k in range(P.mount_p.shape[0]):
        p = P.mount_p[k]
        _times(R, p, r)
        _cross(wb, p, a)
        _times(R, a, b)  # velocity of the point against the centre of mass
        _cross(fl[3:6], p, a)  # the floor's point stood at the same place at rest
        _cross(fl[9:12], p, c)
        for i in range(3):
            e[i] = x[i] + r[i] - p[i] - fl[i] - a[i]
            b[i] = x[7 + i] + b[i] - fl[6 + i] - c[i]
        for i in range(3):
            a[i] = P.mount_F[k, i]
            for j in range(3):
                a[i] -= P.mount_K[k, i, j] * e[j] + P.mount_B[k, i, j] * b[j]
            F[i] += a[i]
        _times_transposed(R, a, b)
        _cross(p, b, c)
        for i in range(3):
            M[i] += c[i]
    n = 13
    for k in range(P.drive_p.shape[0]):
        force = u[k]
        if P.drive_w[k] > 0.0:
            force = x[n + k]
            dx[n + k] = P.drive_w[k] * (u[k] - x[n + k])
        else:
            dx[n + k] = 0.0
        force *= P.drive_gain[k]
        if P.drive_earth[k]:
            for i in range(3):
                a[i] = P.drive_d[k, i]
            _times_transposed(R, a, b)
        else:
            for i in range(3):
                b[i] = P.drive_d[k, i]
            _times(R, b, a)
        _cross(P.drive_p[k], b, c)
        for i in range(3):
            F[i] += force * a[i]
            M[i] += force * c[i]
    for i in range(3):
        dx[i] = x[7 + i]
        dx[7 + i] = F[i] / P.mass
    dx[3] = 0.5 * (-q1 * wb[0] - q2 * wb[1] - q3 * wb[2])
    dx[4] = 0.5 * (q0 * wb[0] + q2 * wb[2] - q3 * wb[1])
    dx[5] = 0.5 * (q0 * wb[1] + q3 * wb[0] - q1 * wb[2])
    dx[6] = 0.5 * (q0 * wb[2] + q1 * wb[1] - q2 * wb[0])
    _times(P.J, wb, a)
    _cross(wb, a, b)
    for i in range(3):
        M[i] -= b[i]
    _times(P.J_inverse, M, a)
    for i in range(3):
        dx[10 + i] = a[i]
        M[i] = a[i]  # turn acceleration, body
    # what a sensor at rest in the body feels: acceleration of the centre of mass (and gravity that tilts in), body axes
    for i in range(3):
        a[i] = F[i] / P.mass
    a[2] += P.tilt
    _times_transposed(R, a, g)
    g[2] -= P.tilt
    n += P.drive_p.shape[0]
    order = P.B.shape[1]
    for k in range(P.sensor_p.shape[0]):
        p = P.sensor_p[k]
        kind = P.sensor_kind[k]
        f[k] = 0.0
        if kind == 0:
            _cross(M, p, a)
            _cross(wb, p, b)
            _cross(wb, b, c)
            for i in range(3):
                f[k] += P.sensor_d[k, i] * (g[i] + a[i] + c[i])
        elif kind == 1:
            _cross(fl[15:18], p, a)
            _cross(P.sensor_d[k], fl[3:6], b)  # (theta x d) . g z, turned round
            f[k] = -P.tilt * b[2]
            for i in range(3):
                f[k] += P.sensor_d[k, i] * (fl[12 + i] + a[i])
        elif kind == 2:
            _times(R, p, r)
            _cross(fl[3:6], p, a)
            for i in range(3):
                f[k] += P.sensor_d[k, i] * (x[i] + r[i] - p[i] - fl[i] - a[i])
        else:
            _cross(fl[9:12], p, a)
            for i in range(3):
                f[k] += P.sensor_d[k, i] * (fl[6 + i] + a[i])
        for i in range(order):
            s = P.B[k, i] * f[k]
            for j in range(order):
                s += P.A[k, i, j] * x[n + k * order + j]
            dx[n + k * order + i] = s


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _floor_between(floor, k, tau, dt, fl):
    """Place, velocity, acceleration of the floor tau after sample k: quintic through the values of both ends."""
    if floor.shape[0] < 2:
        fl[:] = 0.0
        return
    s = tau / dt
    for i in range(6):
        p, v, a = floor[k, i], floor[k, 6 + i] * dt, floor[k, 12 + i] * dt * dt
        dp = floor[k + 1, i] - p - v - 0.5 * a
        dv = floor[k + 1, 6 + i] * dt - v - a
        da = floor[k + 1, 12 + i] * dt * dt - a
        c3 = 10 * dp - 4 * dv + 0.5 * da
        c4 = -15 * dp + 7 * dv - da
        c5 = 6 * dp - 3 * dv + 0.5 * da
        fl[i] = p + s * (v + s * (0.5 * a + s * (c3 + s * (c4 + s * c5))))
        fl[6 + i] = (v + s * (a + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / dt
        fl[12 + i] = (a + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) / (dt * dt)


@njit(cache=True, error_model="numpy")
def sampled_loop(
    dt, whole, part, steps, x, past, xc, P, K, commands, floor, noise, lsb, full_scale, limit, y, u, motion
):
    """Run the table and a sampled controller over len(y) samples; x, past and xc are advanced in place.

    `whole` + `part` samples of delay; `past` (whole + 1, d): commands before, newest first; `steps`: Runge-Kutta steps
    per sample; `K` = (A, B, C, D) of the controller; `lsb` 0: no quantisation; `motion` (N, 13): state
    of the body. Returns how many samples were done: fewer if the body left its mounts.
    """
    KA, KB, KC, KD = K
    ns, nd, nx, nc = noise.shape[1], limit.shape[0], x.shape[0], xc.shape[0]
    w3, fl, f = np.zeros((12, 3)), np.zeros(18), np.zeros(ns)
    dx, total, xt = np.zeros(nx), np.zeros(nx), np.zeros(nx)
    held, xn = np.zeros(nd), np.zeros(nc)
    order = P.B.shape[1]
    for k in range(y.shape[0]):
        # the sample: sensors with the drive voltage that acted until now
        for i in range(nd):
            held[i] = past[whole, i]
        _floor_between(floor, k, 0.0, dt, fl)
        derivative(x, held, fl, P, w3, dx, f)
        for i in range(ns):
            v = P.D[i] * f[i] + noise[k, i]
            for j in range(order):
                v += P.C[i, j] * x[13 + nd + i * order + j]
            if lsb > 0.0:
                v = min(max(np.round(v / lsb) * lsb, -full_scale), full_scale - lsb)
            y[k, i] = v
        for i in range(13):
            motion[k, i] = x[i]
        # the controller
        for i in range(nd):
            v = commands[k, i]
            for j in range(nc):
                v += KC[i, j] * xc[j]
            for j in range(ns):
                v += KD[i, j] * y[k, j]
            u[k, i] = min(max(v, -limit[i]), limit[i])
        for i in range(nc):
            v = 0.0
            for j in range(nc):
                v += KA[i, j] * xc[j]
            for j in range(ns):
                v += KB[i, j] * y[k, j]
            xn[i] = v
        for i in range(nc):
            xc[i] = xn[i]
        # the table until the next sample: the older command for `part` of it, then the newer one
        for piece in range(2):
            start = 0.0 if piece == 0 else part * dt
            length = part * dt if piece == 0 else (1.0 - part) * dt
            if length <= 0.0:
                continue
            for i in range(nd):
                if piece == 0:
                    held[i] = past[whole, i]
                else:
                    held[i] = u[k, i] if whole == 0 else past[whole - 1, i]
            pieces = int(np.ceil(steps * length / dt - 1e-9))
            h = length / pieces
            for step in range(pieces):
                for i in range(nx):
                    xt[i] = x[i]
                    total[i] = 0.0
                for stage in range(4):
                    late = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                    _floor_between(floor, k, start + (step + late) * h, dt, fl)
                    derivative(xt, held, fl, P, w3, dx, f)
                    weight = 1.0 if stage == 0 or stage == 3 else 2.0
                    ahead = h if stage == 2 else 0.5 * h
                    for i in range(nx):
                        total[i] += weight * dx[i]
                        xt[i] = x[i] + ahead * dx[i]
                for i in range(nx):
                    x[i] += h / 6.0 * total[i]
        for j in range(whole, 0, -1):
            for i in range(nd):
                past[j, i] = past[j - 1, i]
        for i in range(nd):
            past[0, i] = u[k, i]
        norm = np.sqrt(x[3] ** 2 + x[4] ** 2 + x[5] ** 2 + x[6] ** 2)
        for i in range(3, 7):
            x[i] /= norm
        if not np.abs(x[:3]).max() < 1.0:  # a metre: it has left its mounts, or is no number
            return k + 1
    return y.shape[0]
