"""An AVIS with effects as a plain differential equation, integrated by Runge-Kutta: shares nothing with `gap`.

x' = A x + B u(t) + E f(d, d', t),    x = (q, q', chain states of each sensor, states of effects)
"""

from __future__ import annotations

import numpy as np
from numba import njit

SUBSTEPS = 8


def mount_map(position):
    """(3, 6) displacement of a point by q."""
    x, y, z = position
    return np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0.0]])


class Table:
    """Matrices of a rig; effects that are linear add states to them."""

    def __init__(self, rig):
        self.rig = rig
        m, J = rig.mass, rig.inertia_matrix()
        assert not any(rig.centre_of_mass)
        self.M = np.zeros((6, 6))
        self.M[:3, :3], self.M[3:, 3:] = m * np.eye(3), J
        self.maps = [mount_map(one.position) for one in rig.isolators]
        self.K = sum(G.T @ np.diag(one.stiffness) @ G for G, one in zip(self.maps, rig.isolators, strict=True))
        self.C = sum(G.T @ np.diag(one.damping) @ G for G, one in zip(self.maps, rig.isolators, strict=True))
        axis = {"x": 0, "y": 1, "z": 2}
        self.T = np.array([self.maps[one.isolator - 1][axis[one.axis]] * one.constant_N_per_V for one in rig.motors]).T
        g = rig.geophones
        self.R = np.array([self.maps[i - 1][axis[a]] for i, a in zip(g.isolator, g.axis, strict=True)])
        self.motor_rows = np.array([3 * (one.isolator - 1) + axis[one.axis] for one in rig.motors])
        self.rows = np.vstack(self.maps)
        self.stiffness = np.array([k for one in rig.isolators for k in one.stiffness])
        self.extra: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.lag_s = 0.0

    def attach(self, row, A, into_A, stiffness_row):
        """Internal states a' = A a + into_A (d, d') with d = row q; force on d: stiffness_row (d, d', a)."""
        self.extra.append((np.asarray(row, float), np.atleast_2d(A), np.atleast_2d(into_A), np.asarray(stiffness_row)))

    def system(self):
        """A, B, E (force on q to x), C of y, rows of the deflection."""
        g = self.rig.geophones
        Mi = np.linalg.inv(self.M)
        n_a = sum(len(A) for _, A, _, _ in self.extra)
        n_u = self.T.shape[1] if self.lag_s else 0
        n = 12 + 12 + n_a + n_u
        A, B, E = np.zeros((n, n)), np.zeros((n, self.T.shape[1])), np.zeros((n, 6))
        A[:6, 6:12] = np.eye(6)
        A[6:12, :6], A[6:12, 6:12], E[6:12] = -Mi @ self.K, -Mi @ self.C, Mi
        if self.lag_s:
            A[n - n_u :, n - n_u :] = -np.eye(n_u) / self.lag_s
            B[n - n_u :] = np.eye(n_u) / self.lag_s
            A[6:12, n - n_u :] = Mi @ self.T
        else:
            B[6:12] = Mi @ self.T
        w, z = 2 * np.pi * g.compensated_Hz, g.compensated_damping
        gain = np.array(g.sensitivity_Vs_per_m) * g.preamplifier_gain
        C = np.zeros((6, n))
        for k in range(6):  # v -> s^2/(s^2 + 2 z w s + w^2): c'' + 2 z w c' + w^2 c = v, output c''
            a = 12 + 2 * k
            A[a, a + 1] = 1
            A[a + 1, a], A[a + 1, a + 1] = -w * w, -2 * z * w
            A[a + 1, 6:12] = self.R[k]
            C[k] = gain[k] * A[a + 1]
        at = 24
        for row, own, into, force in self.extra:
            m = len(own)
            A[at : at + m, at : at + m] = own
            A[at : at + m, :6], A[at : at + m, 6:12] = np.outer(into[:, 0], row), np.outer(into[:, 1], row)
            push = np.outer(Mi @ row, force)
            A[6:12, :6] += np.outer(push[:, 0], row)
            A[6:12, 6:12] += np.outer(push[:, 1], row)
            A[6:12, at : at + m] += push[:, 2:]
            at += m
        return A, B, E, C

    def run(self, u, fs, delay_substeps=SUBSTEPS, cubic=0.0, drift=(0.0, 0.0, 1.0), friction=(0.0, 1.0)):
        """y (n, 6), deflection (n, 12) for held volts; drift: change, start and length of the campaign [s]."""
        A, B, E, C = self.system()
        x = integrate(
            A,
            B,
            E,
            np.ascontiguousarray(u),
            1 / fs,
            SUBSTEPS,
            delay_substeps,
            self.rows,
            self.stiffness,
            cubic,
            np.array(drift, float),
            np.array(friction, float),
            self.motor_rows,
        )
        return x @ C.T, x[:, :6] @ self.rows.T


@njit(cache=True)
def slope(x, f, drive, t, given):
    """x' and f' (friction states)."""
    A, E, rows, stiffness, cubic, drift, friction, motor_rows = given
    d, v = rows @ x[:6], rows @ x[6:12]
    push = np.zeros(12)
    for i in range(12):
        if i % 3 == 2:
            push[i] -= cubic * d[i] ** 3
        push[i] -= drift[0] * ((t - drift[1]) / drift[2] - 0.5) * stiffness[i] * d[i]
    df = np.zeros(len(f))
    if friction[0] > 0:
        for j in range(len(f)):
            i = motor_rows[j]
            push[i] -= friction[0] * f[j]
            df[j] = v[i] * (1 - np.sign(v[i]) * f[j] / friction[1])
    return A @ x + drive + E @ (rows.T @ push), df


@njit(cache=True)
def integrate(A, B, E, u, T, substeps, delay, rows, stiffness, cubic, drift, friction, motor_rows):
    """(samples, n) states at the samples, fourth-order Runge-Kutta."""
    n = len(u)
    x, f = np.zeros(A.shape[0]), np.zeros(u.shape[1])
    out = np.zeros((n, A.shape[0]))
    h = T / substeps
    rows = np.ascontiguousarray(rows)
    given = (A, E, rows, stiffness, cubic, drift, friction, motor_rows)
    for k in range(n):
        out[k] = x
        for j in range(substeps):
            at = k * substeps + j - delay
            drive = B @ u[at // substeps] if at >= 0 else np.zeros(A.shape[0])
            t = k * T + j * h
            a1, b1 = slope(x, f, drive, t, given)
            a2, b2 = slope(x + h / 2 * a1, f + h / 2 * b1, drive, t + h / 2, given)
            a3, b3 = slope(x + h / 2 * a2, f + h / 2 * b2, drive, t + h / 2, given)
            a4, b4 = slope(x + h * a3, f + h * b3, drive, t + h, given)
            x = x + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            f = f + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
    return out
