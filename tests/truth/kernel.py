"""Newton-Euler equations of the table and its electronics, integrated by the classical Runge-Kutta scheme.

State: X (3, centre of mass, earth axes), quaternion (4), V (3, earth), omega (3, body), per geophone (coil
displacement, coil velocity, two states of the compensation filter), then the states of the effects that are present.
Gravity is balanced by the mounts at rest and does not enter the mechanics (design/equations.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

SENSOR_STATES = 13
FIRST_EFFECT_STATE = SENSOR_STATES + 24


class Physics(NamedTuple):
    """Numbers of one table. Points are body-fixed, from the centre of mass; arrays of length 0: effect absent."""

    m: float
    J: np.ndarray  # (3, 3) kg m^2 about the centre of mass
    Ji: np.ndarray  # its inverse
    rotor: np.ndarray  # (3,) N m s, angular momentum of a spinning rotor
    drag: float  # N s^2/m^2, quadratic damping of the payload
    r: np.ndarray  # (4, 3) mounts on the payload
    k: np.ndarray  # (4, 3) N/m
    c: np.ndarray  # (4, 3) N s/m
    k2: np.ndarray  # (4,) N/m^2, vertical
    k3: np.ndarray  # (4,) N/m^3, vertical
    k5: np.ndarray  # (4,) N/m^5, vertical
    motor_r: np.ndarray  # (8, 3)
    motor_d: np.ndarray  # (8, 3) direction of the force, earth axes
    motor_at: np.ndarray  # (8,) mount of each motor, with which it moves where the payload bends
    motor: np.ndarray  # (8,) N/V
    motor_b1: np.ndarray  # (8,) 1/m, change of the force constant with displacement
    motor_b2: np.ndarray  # (8,) 1/m^2
    sensor_r: np.ndarray  # (6, 3)
    sensor_at: np.ndarray  # (6,) mount of each sensor
    sensor_n: np.ndarray  # (6, 3) axis in the body
    S: np.ndarray  # (6,) V s/m, preamplifier included
    wn: np.ndarray  # (6,) rad/s suspension
    zn: np.ndarray  # (6,)
    b1: np.ndarray  # (6,) numerator minus denominator of the compensation filter, s^1
    b0: np.ndarray  # (6,) s^0
    wc: float
    zc: float
    g: float  # m/s^2 that a tilted sensor feels
    lag: np.ndarray  # (8,) rad/s of the amplifiers, 0: none; or (0,)
    lag2: np.ndarray  # (8,) rad/s of a second pole, not that of lag; or (0,)
    mode_shape: np.ndarray  # (modes, 4, 3) 1/sqrt(kg), at the mounts
    mode_w: np.ndarray
    mode_z: np.ndarray
    osc_r: np.ndarray  # (oscillators, 3)
    osc_d: np.ndarray  # (oscillators, 3)
    osc_m: np.ndarray
    osc_k: np.ndarray
    osc_c: np.ndarray
    base_free: np.ndarray  # (6,) 1 for a coordinate of the chassis that moves on its own, 0: with the floor; or (0,)
    base_r: np.ndarray  # (4, 3) mounts on the chassis, from its centre of mass
    base_motor_r: np.ndarray  # (8, 3) motors on the chassis
    base_Mi: np.ndarray  # (6,) 1/kg, 1/(kg m^2)
    base_K: np.ndarray  # (6, 6)
    base_C: np.ndarray  # (6, 6)
    max_k: np.ndarray  # (branches, 4) Maxwell branches, vertical, N/m
    max_c: np.ndarray  # (branches, 4) N s/m
    max_q: np.ndarray  # (branches, 4) N s^2/m^2, orifice
    ladder_k: np.ndarray  # (rungs, 4) stiffness of each rung over that of the mount
    ladder_w: np.ndarray  # (rungs,) rad/s
    surge_m: np.ndarray  # (4,) kg or (0,)
    surge_c: np.ndarray  # (4,) N s/m
    surge_share: np.ndarray  # (4,) compliance above the mass over that of the mount
    level_w: np.ndarray  # (3,) rad/s or (0,)
    level_tau: float  # s
    cable_r: np.ndarray  # (cables, 3)
    cable_d: np.ndarray  # (cables, 3)
    cable_k: np.ndarray
    cable_c: np.ndarray
    fric_jenkins: int  # 1: elastic until it slips (Jenkins), 0: Dahl and LuGre
    fric_s0: np.ndarray  # (elements, 8) N/m
    fric_s1: float  # N s/m
    fric_s2: float  # N s/m
    fric_Fc: np.ndarray  # (elements, 8) N
    fric_Fs: np.ndarray  # (elements, 8) N
    fric_vs: float  # m/s


def state_size(P: Physics) -> int:
    """Number of states that the effects present in P need."""
    return (
        FIRST_EFFECT_STATE
        + 2 * len(P.mode_w)
        + 2 * len(P.osc_m)
        + 12 * (len(P.base_free) > 0)
        + 4 * len(P.max_k)
        + 12 * len(P.ladder_k)
        + 2 * len(P.surge_m)
        + 2 * len(P.level_w)
        + 8 * len(P.fric_s0)
    )


@njit(cache=True, fastmath=False, inline="never")
def rhs(P, x, u, fd, fv, ks, dx, W):
    """dx of the state x. u : (8,) motor currents as volts. fd, fv : (3,) floor m, m/s. ks : factor of the stiffness.

    W : (40, 3) workspace.
    """
    R, F, G = W[0:3], W[3:7], W[7:11]  # rotation; forces on payload and chassis at the mounts, earth axes
    E, Ed = W[11:15], W[15:19]  # relative displacement and velocity over the mounts, earth axes
    B = W[19:23]  # forces at the mounts, body axes
    q0, q1, q2, q3 = x[3], x[4], x[5], x[6]
    s = 1.0 / (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    R[0, 0] = 1 - 2 * s * (q2 * q2 + q3 * q3)
    R[0, 1] = 2 * s * (q1 * q2 - q0 * q3)
    R[0, 2] = 2 * s * (q1 * q3 + q0 * q2)
    R[1, 0] = 2 * s * (q1 * q2 + q0 * q3)
    R[1, 1] = 1 - 2 * s * (q1 * q1 + q3 * q3)
    R[1, 2] = 2 * s * (q2 * q3 - q0 * q1)
    R[2, 0] = 2 * s * (q1 * q3 - q0 * q2)
    R[2, 1] = 2 * s * (q2 * q3 + q0 * q1)
    R[2, 2] = 1 - 2 * s * (q1 * q1 + q2 * q2)
    w0, w1, w2 = x[10], x[11], x[12]
    dx[3] = 0.5 * (-q1 * w0 - q2 * w1 - q3 * w2)
    dx[4] = 0.5 * (q0 * w0 + q2 * w2 - q3 * w1)
    dx[5] = 0.5 * (q0 * w1 + q3 * w0 - q1 * w2)
    dx[6] = 0.5 * (q0 * w2 + q1 * w1 - q2 * w0)

    # places of the effects' states
    n_mode, n_osc, rungs = P.mode_w.size, P.osc_m.size, P.ladder_w.size
    chassis = P.base_free.size > 0
    o_mode = FIRST_EFFECT_STATE
    o_osc = o_mode + 2 * n_mode
    o_base = o_osc + 2 * n_osc
    o_max = o_base + (12 if chassis else 0)
    o_lad = o_max + P.max_k.size
    o_sur = o_lad + 12 * rungs
    o_lev = o_sur + 2 * P.surge_m.size
    o_fri = o_lev + 2 * P.level_w.size

    b, bd = W[33:35], W[35:37]  # chassis: displacement and rotation of its centre of mass, and their rates
    for a in range(3):
        b[0, a], bd[0, a], b[1, a], bd[1, a] = fd[a], fv[a], 0.0, 0.0
    if chassis:
        for a in range(6):
            if P.base_free[a] > 0:
                b[a // 3, a % 3], bd[a // 3, a % 3] = x[o_base + a], x[o_base + 6 + a]

    for i in range(4):
        ra, rb, rc = P.r[i, 0], P.r[i, 1], P.r[i, 2]
        va, vb, vc = w1 * rc - w2 * rb, w2 * ra - w0 * rc, w0 * rb - w1 * ra
        da, db, dc = 0.0, 0.0, 0.0
        for j in range(n_mode):
            y, yd = x[o_mode + 2 * j], x[o_mode + 2 * j + 1]
            da += P.mode_shape[j, i, 0] * y
            db += P.mode_shape[j, i, 1] * y
            dc += P.mode_shape[j, i, 2] * y
            va += P.mode_shape[j, i, 0] * yd
            vb += P.mode_shape[j, i, 1] * yd
            vc += P.mode_shape[j, i, 2] * yd
        for a in range(3):
            e = R[a, 0] * (ra + da) + R[a, 1] * (rb + db) + R[a, 2] * (rc + dc) - P.r[i, a]
            E[i, a] = x[a] + e - b[0, a]
            Ed[i, a] = x[7 + a] + R[a, 0] * va + R[a, 1] * vb + R[a, 2] * vc - bd[0, a]
        W[29 + i, 0], W[29 + i, 1] = b[0, 2], bd[0, 2]  # vertical motion of the chassis point
        if chassis:
            pa, pb, pc = P.base_r[i, 0], P.base_r[i, 1], P.base_r[i, 2]
            for h in range(2):
                T = E if h == 0 else Ed
                t = b[1] if h == 0 else bd[1]
                T[i, 0] -= t[1] * pc - t[2] * pb
                T[i, 1] -= t[2] * pa - t[0] * pc
                T[i, 2] -= t[0] * pb - t[1] * pa
                W[29 + i, h] += t[0] * pb - t[1] * pa

    for i in range(4):
        for a in range(3):
            k, e = ks * P.k[i, a], E[i, a]
            force = -P.c[i, a] * Ed[i, a]
            if not (a == 2 and P.surge_m.size > 0):
                force -= k * e
            for j in range(rungs):
                o = o_lad + (3 * i + a) * rungs + j
                stretch = e - x[o]
                force -= P.ladder_k[j, i] * k * stretch
                dx[o] = P.ladder_w[j] * stretch
            F[i, a] = force
            G[i, a] = -force
        z, zd = E[i, 2], Ed[i, 2]
        force = -P.k2[i] * z * z - P.k3[i] * z * z * z - P.k5[i] * z * z * z * z * z
        for j in range(P.max_k.shape[0]):
            o, c, q = o_max + 4 * j + i, P.max_c[j, i], P.max_q[j, i]
            branch = ks * P.max_k[j, i] * (z - x[o])
            force -= branch
            if q > 0:
                flow = (np.sqrt(c * c + 4 * q * abs(branch)) - c) / (2 * q)
                dx[o] = flow if branch > 0 else -flow
            else:
                dx[o] = branch / c
        if P.level_w.size > 0 and i < 3:
            o = o_lev + 2 * i
            force -= P.level_w[i] * P.k[i, 2] * x[o]
            if P.level_tau > 0:
                dx[o] = x[o + 1]
                dx[o + 1] = (z - x[o + 1]) / P.level_tau
            else:
                dx[o] = z
                dx[o + 1] = 0.0
        F[i, 2] += force
        G[i, 2] -= force
        if P.surge_m.size > 0:  # the mass sits between two springs, together the mount's; its motion is absolute
            o = o_sur + 2 * i
            k, share = ks * P.k[i, 2], P.surge_share[i]
            below, below_d = x[o] - W[29 + i, 0], x[o + 1] - W[29 + i, 1]
            upper = k / share * (z - below) + P.surge_c[i] * (zd - below_d)
            lower = k / (1 - share) * below + P.surge_c[i] * below_d
            F[i, 2] -= upper
            G[i, 2] += lower
            dx[o] = x[o + 1]
            dx[o + 1] = (upper - lower) / P.surge_m[i]

    fx, fy, fz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # earth force, body torque
    bx, by, bz, b3, b4, b5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # reaction on the chassis
    for i in range(4):
        fx += F[i, 0]
        fy += F[i, 1]
        fz += F[i, 2]
        for a in range(3):
            B[i, a] = R[0, a] * F[i, 0] + R[1, a] * F[i, 1] + R[2, a] * F[i, 2]
        tx += P.r[i, 1] * B[i, 2] - P.r[i, 2] * B[i, 1]
        ty += P.r[i, 2] * B[i, 0] - P.r[i, 0] * B[i, 2]
        tz += P.r[i, 0] * B[i, 1] - P.r[i, 1] * B[i, 0]
        if chassis:
            p = P.base_r[i]
            bx += G[i, 0]
            by += G[i, 1]
            bz += G[i, 2]
            b3 += p[1] * G[i, 2] - p[2] * G[i, 1]
            b4 += p[2] * G[i, 0] - p[0] * G[i, 2]
            b5 += p[0] * G[i, 1] - p[1] * G[i, 0]

    elements = P.fric_s0.shape[0]
    for j in range(8):
        force = P.motor[j] * u[j]
        if elements > 0 or P.motor_b1[j] != 0 or P.motor_b2[j] != 0:  # motion across the gap, along the motor
            i, p0, p1, p2 = P.motor_at[j], P.motor_r[j, 0], P.motor_r[j, 1], P.motor_r[j, 2]
            d0, d1, d2 = P.motor_d[j, 0], P.motor_d[j, 1], P.motor_d[j, 2]
            va, vb, vc = w1 * p2 - w2 * p1, w2 * p0 - w0 * p2, w0 * p1 - w1 * p0
            da, db, dc = 0.0, 0.0, 0.0
            for h in range(n_mode):
                y, yd = x[o_mode + 2 * h], x[o_mode + 2 * h + 1]
                da += P.mode_shape[h, i, 0] * y
                db += P.mode_shape[h, i, 1] * y
                dc += P.mode_shape[h, i, 2] * y
                va += P.mode_shape[h, i, 0] * yd
                vb += P.mode_shape[h, i, 1] * yd
                vc += P.mode_shape[h, i, 2] * yd
            e, v = 0.0, 0.0
            for a in range(3):
                e += P.motor_d[j, a] * (
                    x[a] - b[0, a] + R[a, 0] * (p0 + da) + R[a, 1] * (p1 + db) + R[a, 2] * (p2 + dc)
                )
                v += P.motor_d[j, a] * (x[7 + a] + R[a, 0] * va + R[a, 1] * vb + R[a, 2] * vc - bd[0, a])
            e -= d0 * p0 + d1 * p1 + d2 * p2
            if chassis:
                p = P.base_motor_r[j]
                n0, n1, n2 = p[1] * d2 - p[2] * d1, p[2] * d0 - p[0] * d2, p[0] * d1 - p[1] * d0
                e -= n0 * b[1, 0] + n1 * b[1, 1] + n2 * b[1, 2]
                v -= n0 * bd[1, 0] + n1 * bd[1, 1] + n2 * bd[1, 2]
            force *= 1 + P.motor_b1[j] * e + P.motor_b2[j] * e * e
            for h in range(elements):
                o = o_fri + 8 * h + j
                z, s0, level = x[o], P.fric_s0[h, j], P.fric_Fc[h, j]
                if P.fric_jenkins > 0:
                    # Slipping, it stays at its force; what a step carried it beyond is taken back within a millisecond.
                    zd = 1e3 * (np.sign(z) * level / s0 - z) if abs(s0 * z) >= level and z * v > 0 else v
                    force -= min(max(s0 * z, -level), level)
                else:
                    level += (P.fric_Fs[h, j] - level) * np.exp(-((v / P.fric_vs) ** 2))
                    zd = v - s0 * abs(v) * z / level
                    force -= s0 * z + P.fric_s1 * zd + P.fric_s2 * v
                dx[o] = zd
        f0, f1, f2 = force * P.motor_d[j, 0], force * P.motor_d[j, 1], force * P.motor_d[j, 2]
        fx += f0
        fy += f1
        fz += f2
        n0 = R[0, 0] * f0 + R[1, 0] * f1 + R[2, 0] * f2
        n1 = R[0, 1] * f0 + R[1, 1] * f1 + R[2, 1] * f2
        n2 = R[0, 2] * f0 + R[1, 2] * f1 + R[2, 2] * f2
        tx += P.motor_r[j, 1] * n2 - P.motor_r[j, 2] * n1
        ty += P.motor_r[j, 2] * n0 - P.motor_r[j, 0] * n2
        tz += P.motor_r[j, 0] * n1 - P.motor_r[j, 1] * n0
        if n_mode > 0:
            i = P.motor_at[j]
            B[i, 0] += n0
            B[i, 1] += n1
            B[i, 2] += n2
        if chassis:
            p = P.base_motor_r[j]
            bx -= f0
            by -= f1
            bz -= f2
            b3 -= p[1] * f2 - p[2] * f1
            b4 -= p[2] * f0 - p[0] * f2
            b5 -= p[0] * f1 - p[1] * f0

    for j in range(P.cable_k.size):
        p, d = P.cable_r[j], P.cable_d[j]
        va, vb, vc = w1 * p[2] - w2 * p[1], w2 * p[0] - w0 * p[2], w0 * p[1] - w1 * p[0]
        e, v = 0.0, 0.0
        for a in range(3):
            e += d[a] * (x[a] + R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2] - p[a] - b[0, a])
            v += d[a] * (x[7 + a] + R[a, 0] * va + R[a, 1] * vb + R[a, 2] * vc - bd[0, a])
        force = -P.cable_k[j] * e - P.cable_c[j] * v
        fx += force * d[0]
        fy += force * d[1]
        fz += force * d[2]
        bx -= force * d[0]
        by -= force * d[1]
        bz -= force * d[2]
        n0 = force * (R[0, 0] * d[0] + R[1, 0] * d[1] + R[2, 0] * d[2])
        n1 = force * (R[0, 1] * d[0] + R[1, 1] * d[1] + R[2, 1] * d[2])
        n2 = force * (R[0, 2] * d[0] + R[1, 2] * d[1] + R[2, 2] * d[2])
        tx += p[1] * n2 - p[2] * n1
        ty += p[2] * n0 - p[0] * n2
        tz += p[0] * n1 - p[1] * n0
    for j in range(n_osc):
        p, d = P.osc_r[j], P.osc_d[j]
        force = P.osc_k[j] * x[o_osc + 2 * j] + P.osc_c[j] * x[o_osc + 2 * j + 1]
        n0, n1, n2 = force * d[0], force * d[1], force * d[2]
        fx += R[0, 0] * n0 + R[0, 1] * n1 + R[0, 2] * n2
        fy += R[1, 0] * n0 + R[1, 1] * n1 + R[1, 2] * n2
        fz += R[2, 0] * n0 + R[2, 1] * n1 + R[2, 2] * n2
        tx += p[1] * n2 - p[2] * n1
        ty += p[2] * n0 - p[0] * n2
        tz += p[0] * n1 - p[1] * n0
    if P.drag > 0:
        fx -= P.drag * abs(x[7]) * x[7]
        fy -= P.drag * abs(x[8]) * x[8]
        fz -= P.drag * abs(x[9]) * x[9]

    J, Ji = P.J, P.Ji
    h0 = J[0, 0] * w0 + J[0, 1] * w1 + J[0, 2] * w2 + P.rotor[0]
    h1 = J[1, 0] * w0 + J[1, 1] * w1 + J[1, 2] * w2 + P.rotor[1]
    h2 = J[2, 0] * w0 + J[2, 1] * w1 + J[2, 2] * w2 + P.rotor[2]
    tx -= w1 * h2 - w2 * h1
    ty -= w2 * h0 - w0 * h2
    tz -= w0 * h1 - w1 * h0
    g0 = Ji[0, 0] * tx + Ji[0, 1] * ty + Ji[0, 2] * tz
    g1 = Ji[1, 0] * tx + Ji[1, 1] * ty + Ji[1, 2] * tz
    g2 = Ji[2, 0] * tx + Ji[2, 1] * ty + Ji[2, 2] * tz
    ax, ay, az = fx / P.m, fy / P.m, fz / P.m
    for a in range(3):
        dx[a] = x[7 + a]
    dx[7], dx[8], dx[9] = ax, ay, az
    dx[10], dx[11], dx[12] = g0, g1, g2

    for j in range(n_mode):
        o = o_mode + 2 * j
        drive = 0.0
        for i in range(4):
            for a in range(3):
                drive += P.mode_shape[j, i, a] * B[i, a]
        dx[o] = x[o + 1]
        dx[o + 1] = drive - 2 * P.mode_z[j] * P.mode_w[j] * x[o + 1] - P.mode_w[j] ** 2 * x[o]

    a0 = R[0, 0] * ax + R[1, 0] * ay + R[2, 0] * az
    a1 = R[0, 1] * ax + R[1, 1] * ay + R[2, 1] * az
    a2 = R[0, 2] * ax + R[1, 2] * ay + R[2, 2] * az
    for j in range(n_osc):
        p, d = P.osc_r[j], P.osc_d[j]
        o = o_osc + 2 * j
        along = (
            d[0] * (a0 + g1 * p[2] - g2 * p[1])
            + d[1] * (a1 + g2 * p[0] - g0 * p[2])
            + d[2] * (a2 + g0 * p[1] - g1 * p[0])
        )
        dx[o] = x[o + 1]
        dx[o + 1] = -(P.osc_k[j] * x[o] + P.osc_c[j] * x[o + 1]) / P.osc_m[j] - along

    if chassis:
        W[27, 0], W[27, 1], W[27, 2] = bx, by, bz
        W[28, 0], W[28, 1], W[28, 2] = b3, b4, b5
        for a in range(6):
            force = W[27 + a // 3, a % 3]
            for h in range(6):
                e, v = b[h // 3, h % 3], bd[h // 3, h % 3]
                if h < 3:
                    e -= fd[h]
                    v -= fv[h]
                force -= P.base_K[a, h] * e + P.base_C[a, h] * v
            dx[o_base + a] = x[o_base + 6 + a]
            dx[o_base + 6 + a] = force * P.base_Mi[a] if P.base_free[a] > 0 else 0.0

    for j in range(6):
        p0, p1, p2 = P.sensor_r[j, 0], P.sensor_r[j, 1], P.sensor_r[j, 2]
        n0, n1, n2 = P.sensor_n[j, 0], P.sensor_n[j, 1], P.sensor_n[j, 2]
        v0, v1, v2 = w1 * p2 - w2 * p1, w2 * p0 - w0 * p2, w0 * p1 - w1 * p0
        a = (
            n0 * (a0 + g1 * p2 - g2 * p1 + w1 * v2 - w2 * v1)
            + n1 * (a1 + g2 * p0 - g0 * p2 + w2 * v0 - w0 * v2)
            + n2 * (a2 + g0 * p1 - g1 * p0 + w0 * v1 - w1 * v0)
        )
        for h in range(n_mode):
            i = P.sensor_at[j]
            a += dx[o_mode + 2 * h + 1] * (
                n0 * P.mode_shape[h, i, 0] + n1 * P.mode_shape[h, i, 1] + n2 * P.mode_shape[h, i, 2]
            )
        if P.g > 0:  # specific force; the part at rest hangs in the suspension spring
            a += P.g * (n0 * R[2, 0] + n1 * R[2, 1] + n2 * (R[2, 2] - 1.0))
        o = SENSOR_STATES + 4 * j
        dx[o] = x[o + 1]
        dx[o + 1] = a - 2 * P.zn[j] * P.wn[j] * x[o + 1] - P.wn[j] ** 2 * x[o]
        dx[o + 2] = x[o + 3]
        dx[o + 3] = P.S[j] * x[o + 1] - 2 * P.zc * P.wc * x[o + 3] - P.wc**2 * x[o + 2]


@njit(cache=True)
def integrate(P, x, u, first, switch, floor, ks, dt, y, trace):
    """March over all samples; y[k] is the analogue sensor voltage at the start of sample interval k.

    x : initial state, overwritten by the last one. u : (n_u, 8) held voltages after clipping. first : (N,) index of
    the voltage held at the start of interval k, negative or beyond the end: zero volts; at the fraction switch[k] of
    the interval the next one takes over. floor : (N + 1, 9) displacement, velocity, acceleration of the floor.
    ks : (N,) stiffness factor. y : (N, 6). trace : (N or 0, states).
    """
    n, N = x.size, y.shape[0]
    k1, k2, k3, k4, xs = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    W, drive, lagged = np.zeros((40, 3)), np.zeros((3, 8)), np.zeros((2, 8))
    f = np.zeros((3, 2, 3))
    edge = np.zeros(4)
    for k in range(N):
        for j in range(6):
            o = SENSOR_STATES + 4 * j
            y[k, j] = P.S[j] * x[o + 1] + P.b1[j] * x[o + 3] + P.b0[j] * x[o + 2]
        if trace.shape[0] > 0:
            trace[k, :] = x
        edges = 3
        edge[0], edge[1], edge[2] = 0.0, 0.5, 1.0
        sw = switch[k]
        if 1e-9 < sw < 1 - 1e-9 and abs(sw - 0.5) > 1e-9:
            edges = 4
            edge[1], edge[2], edge[3] = min(sw, 0.5), max(sw, 0.5), 1.0
        for step in range(edges - 1):
            t0, t1 = edge[step], edge[step + 1]
            h = (t1 - t0) * dt
            row = first[k] + (1 if t0 >= sw - 1e-9 else 0)
            for j in range(8):
                held = u[row, j] if 0 <= row < u.shape[0] else 0.0
                if P.lag.size > 0 and P.lag[j] > 0:  # first- or second-order lag under a held voltage, exactly
                    w, v = P.lag[j], (P.lag2[j] if P.lag2.size > 0 else 0.0)
                    first_off = lagged[0, j] - held
                    through = first_off * v / (v - w) if v > 0 else first_off
                    own = lagged[1, j] - held - through if v > 0 else 0.0
                    lagged[0, j] = held + first_off * np.exp(-h * w)
                    drive[0, j] = held + through + own
                    drive[2, j] = held + through * np.exp(-h * w) + own * np.exp(-h * v)
                    # Simpson's rule of the stages then has the exact mean, however short the lag is in steps.
                    mean = held - through * np.expm1(-h * w) / (h * w)
                    if v > 0:
                        mean -= own * np.expm1(-h * v) / (h * v)
                    drive[1, j] = (6 * mean - drive[0, j] - drive[2, j]) / 4
                    lagged[1, j] = drive[2, j]
                else:
                    drive[0, j] = drive[1, j] = drive[2, j] = held
            for stage in range(3):  # cubic Hermite interpolation of the floor: 60 Hz at 1 kHz to 5e-5
                t = t0 + 0.5 * stage * (t1 - t0)
                a, b = 2 * t**3 - 3 * t * t + 1, (t**3 - 2 * t * t + t) * dt
                c, d = 1 - a, (t**3 - t * t) * dt
                for i in range(3):
                    for o in range(2):
                        f[stage, o, i] = (
                            a * floor[k, 3 * o + i]
                            + b * floor[k, 3 * o + 3 + i]
                            + c * floor[k + 1, 3 * o + i]
                            + d * floor[k + 1, 3 * o + 3 + i]
                        )
            rhs(P, x, drive[0], f[0, 0], f[0, 1], ks[k], k1, W)
            for i in range(n):
                xs[i] = x[i] + 0.5 * h * k1[i]
            rhs(P, xs, drive[1], f[1, 0], f[1, 1], ks[k], k2, W)
            for i in range(n):
                xs[i] = x[i] + 0.5 * h * k2[i]
            rhs(P, xs, drive[1], f[1, 0], f[1, 1], ks[k], k3, W)
            for i in range(n):
                xs[i] = x[i] + h * k3[i]
            rhs(P, xs, drive[2], f[2, 0], f[2, 1], ks[k], k4, W)
            for i in range(n):
                x[i] += h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i])
