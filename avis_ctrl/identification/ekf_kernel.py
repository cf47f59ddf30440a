"""The compiled inner loop of the extended Kalman filter: flow of a sample with its derivatives, and the filter.

Order of the augmented state: parameters s (n_p), then x = (q, q', f) with f (n_f, often none) a coloured disturbance
that accelerates the table by G f.

The flow over a sample is the Taylor polynomial of fourth order at fixed parameters, which for a linear system is
Runge and Kutta's; its error at 5 Hz and 1 kHz is (omega h)^4 / 120 = 8e-9 of the step's change. Phi and
Psi are its exact derivatives. The cache of compiled code looks at the date of this file only: after a change in
`ekf_square_root`, delete the .nbi and .nbc files of this package (numba's rule for functions of other files).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from avis_ctrl.identification.ekf_square_root import propagate, update

FAST = {"reassoc", "contract"}


class ModelArrays(NamedTuple):
    """M(theta) = M0 + sum theta_j dM[..., j], C and K likewise; T (n_q, n_u); H (n_y, n_x) on (q, q', f).

    G (n_q, n_f) : acceleration by the disturbance, which is held over a sample. decay : what a sample leaves of f.
    """

    M0: np.ndarray
    C0: np.ndarray
    K0: np.ndarray
    dM: np.ndarray
    dC: np.ndarray
    dK: np.ndarray
    T: np.ndarray
    H: np.ndarray
    G: np.ndarray
    decay: float


class Scaling(NamedTuple):
    """theta = reference s, or reference exp(s) where logarithmic; s is held at `lowest` or above."""

    reference: np.ndarray
    lowest: np.ndarray
    logarithmic: bool


class Filter(NamedTuple):
    """What the loop changes: s (n_p,), x (n_x,), W (n_p + n_x square, upper triangular), guard counts (n_p,)."""

    s: np.ndarray
    x: np.ndarray
    W: np.ndarray
    guarded: np.ndarray


class Trace(NamedTuple):
    """What the loop writes: (n, n_y) innovations over their predicted standard deviation, and every `keep` samples
    s (m, n_p), its covariance's diagonal (m, n_p) and x (m, n_x)."""

    innovation: np.ndarray
    s: np.ndarray
    variance: np.ndarray
    x: np.ndarray


class Step(NamedTuple):
    """Flow of one sample: Phi^T (n_x, n_x), Psi^T (n_p, n_x), and room for what leads there."""

    Phi_t: np.ndarray
    Psi_t: np.ndarray
    alpha: np.ndarray
    motion: np.ndarray
    theta: np.ndarray
    slope: np.ndarray
    M: np.ndarray
    inverse: np.ndarray
    N: np.ndarray
    D: np.ndarray
    powers: np.ndarray
    force: np.ndarray


def step_room(n_q: int, n_p: int, n_f: int = 0) -> Step:
    """Zeroed room for `flow`."""
    zeros, n_x = np.zeros, 2 * n_q + n_f
    return Step(zeros((n_x, n_x)), zeros((n_p, n_x)), zeros((4, n_q, n_p)), zeros((6, n_q)), zeros(n_p), zeros(n_p),
                zeros((n_q, n_q)), zeros((n_q, n_q)), zeros((n_q, n_q)), zeros((n_q, n_q)), zeros((5, n_q, 2 * n_q)),
                zeros(n_q))


@njit(cache=True)
def _sum(out, base, parts, theta):
    """out = base + sum theta_j parts[..., j]"""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = base[i, j]
            for p in range(theta.shape[0]):
                total += theta[p] * parts[i, j, p]
            out[i, j] = total


@njit(cache=True)
def _invert(A, inverse):
    """Inverse of a symmetric matrix by Gauss and Jordan, A destroyed; False where it is not positive definite."""
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    for k in range(n):
        pivot = A[k, k]
        if not pivot > 0.0:
            return False
        for j in range(n):
            A[k, j] /= pivot
            inverse[k, j] /= pivot
        for i in range(n):
            factor = A[i, k]
            if i != k and factor != 0.0:
                for j in range(n):
                    A[i, j] -= factor * A[k, j]
                    inverse[i, j] -= factor * inverse[k, j]
    return True


@njit(cache=True, fastmath=FAST)
def _product(out, A, B):
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for k in range(A.shape[1]):
            a = A[i, k]
            for j in range(B.shape[1]):
                out[i, j] += a * B[k, j]


@njit(cache=True)
def _matrices(model, room):
    """M^-1, N = M^-1 K and D = M^-1 C at room.theta; False where M is not positive definite."""
    _sum(room.M, model.M0, model.dM, room.theta)
    if not _invert(room.M, room.inverse):
        return False
    _sum(room.M, model.K0, model.dK, room.theta)
    _product(room.N, room.inverse, room.M)
    _sum(room.M, model.C0, model.dC, room.theta)
    _product(room.D, room.inverse, room.M)
    return True


@njit(cache=True, fastmath=FAST)
def _motion(model, room, x, u):
    """room.motion: derivatives 0..5 of q by time at the start of the sample."""
    n_q, n_f, d = room.N.shape[0], model.G.shape[1], room.motion
    for i in range(n_q):
        d[0, i], d[1, i] = x[i], x[n_q + i]
        room.force[i] = 0.0
        for j in range(u.shape[0]):
            room.force[i] += model.T[i, j] * u[j]
    for k in range(2, 6):
        for i in range(n_q):
            total = 0.0
            for j in range(n_q):
                total -= room.N[i, j] * d[k - 2, j] + room.D[i, j] * d[k - 1, j]
                if k == 2:
                    total += room.inverse[i, j] * room.force[j]
            if k == 2:
                for j in range(n_f):
                    total += model.G[i, j] * x[2 * n_q + j]
            d[k, i] = total


@njit(cache=True, fastmath=FAST)
def _transition(room, h):
    """Phi^T by the rows R_k = [0 I] A^k, of which the upper half of A^(k+1) consists too."""
    n_q, R = room.N.shape[0], room.powers
    for i in range(n_q):
        for j in range(2 * n_q):
            R[0, i, j] = 1.0 if j == n_q + i else 0.0
    for k in range(1, 5):
        for i in range(n_q):
            for j in range(n_q):
                R[k, i, j], R[k, i, n_q + j] = 0.0, R[k - 1, i, j]
            for m in range(n_q):
                a = R[k - 1, i, n_q + m]
                for j in range(n_q):
                    R[k, i, j] -= a * room.N[m, j]
                    R[k, i, n_q + j] -= a * room.D[m, j]
    h2, h3, h4 = h * h / 2, h * h * h / 6, h * h * h * h / 24
    for i in range(n_q):
        for j in range(2 * n_q):
            room.Phi_t[j, i] = (1.0 if i == j else 0.0) + h * R[0, i, j] + h2 * R[1, i, j] + h3 * R[2, i, j] + \
                h4 * R[3, i, j]
            room.Phi_t[j, n_q + i] = R[0, i, j] + h * R[1, i, j] + h2 * R[2, i, j] + h3 * R[3, i, j] + h4 * R[4, i, j]


@njit(cache=True, fastmath=FAST)
def _disturbance(model, room, h):
    """Rows of Phi^T that belong to f: the step response of an acceleration G, again by the rows R_k."""
    n_q, n_f = room.N.shape[0], model.G.shape[1]
    for p in range(n_f):
        for i in range(n_q):
            q = v = 0.0
            weight = h
            for k in range(4):
                a = 0.0
                for m in range(n_q):
                    a += room.powers[k, i, n_q + m] * model.G[m, p]
                v += weight * a
                weight *= h / (k + 2)
                if k < 3:
                    q += weight * a
            room.Phi_t[2 * n_q + p, i], room.Phi_t[2 * n_q + p, n_q + i] = q, v
        room.Phi_t[2 * n_q + p, 2 * n_q + p] = model.decay


@njit(cache=True, fastmath=FAST)
def _sensitivity(model, room, h):
    """Psi^T: alpha_k, the derivative of q^(k+2) by s, = J_k - N alpha_(k-2) - D alpha_(k-1), with
    J_k = -M^-1 (dM q^(k+2) + dC q^(k+1) + dK q^(k))."""
    n_q, n_p = room.N.shape[0], room.theta.shape[0]
    alpha, d, slope = room.alpha, room.motion, room.slope
    g = np.empty((n_q, n_p))
    for k in range(4):
        for i in range(n_q):
            for p in range(n_p):
                g[i, p] = 0.0
            for m in range(n_q):
                a, v, q = d[k + 2, m], d[k + 1, m], d[k, m]
                for p in range(n_p):
                    g[i, p] += model.dM[i, m, p] * a + model.dC[i, m, p] * v + model.dK[i, m, p] * q
        for i in range(n_q):
            for p in range(n_p):
                alpha[k, i, p] = 0.0
            for m in range(n_q):
                a = room.inverse[i, m]
                for p in range(n_p):
                    alpha[k, i, p] -= a * g[m, p] * slope[p]
            for m in range(n_q):
                if k >= 1:
                    a = room.D[i, m]
                    for p in range(n_p):
                        alpha[k, i, p] -= a * alpha[k - 1, m, p]
                if k >= 2:
                    a = room.N[i, m]
                    for p in range(n_p):
                        alpha[k, i, p] -= a * alpha[k - 2, m, p]
    h2, h3, h4 = h * h / 2, h * h * h / 6, h * h * h * h / 24
    for p in range(n_p):
        for i in range(n_q):
            a0, a1, a2, a3 = alpha[0, i, p], alpha[1, i, p], alpha[2, i, p], alpha[3, i, p]
            room.Psi_t[p, i] = h2 * a0 + h3 * a1 + h4 * a2
            room.Psi_t[p, n_q + i] = h * a0 + h2 * a1 + h3 * a2 + h4 * a3


@njit(cache=True)
def flow(model, scaling, s, x, u, h, room):
    """x after a sample of h seconds at held volts u, in place; Phi^T and Psi^T in the room.

    False where the mass matrix is not positive definite.
    """
    for p in range(s.shape[0]):
        room.theta[p] = scaling.reference[p] * (np.exp(s[p]) if scaling.logarithmic else s[p])
        room.slope[p] = room.theta[p] if scaling.logarithmic else scaling.reference[p]
    if not _matrices(model, room):
        return False
    _motion(model, room, x, u)
    _transition(room, h)
    _disturbance(model, room, h)
    _sensitivity(model, room, h)
    n_q, d = room.N.shape[0], room.motion
    h2, h3, h4 = h * h / 2, h * h * h / 6, h * h * h * h / 24
    for i in range(n_q):
        x[i] = d[0, i] + h * d[1, i] + h2 * d[2, i] + h3 * d[3, i] + h4 * d[4, i]
        x[n_q + i] = d[1, i] + h * d[2, i] + h2 * d[3, i] + h3 * d[4, i] + h4 * d[5, i]
    for i in range(2 * n_q, x.shape[0]):
        x[i] *= model.decay
    return True


@njit(cache=True)
def _measure(model, scaling, state, y, R, gain, innovation):
    """All measurements of one sample, one by one; False where an innovation is not finite."""
    n_p, n_x = state.s.shape[0], state.x.shape[0]
    for i in range(y.shape[0]):
        e = y[i]
        for j in range(n_x):
            e -= model.H[i, j] * state.x[j]
        variance = update(state.W, model.H[i], R[i], gain)
        innovation[i] = e / np.sqrt(variance)
        if not np.isfinite(innovation[i]):
            return False
        for p in range(n_p):
            state.s[p] += gain[p] * e
        for j in range(n_x):
            state.x[j] += gain[n_p + j] * e
    if not scaling.logarithmic:
        for p in range(n_p):
            if state.s[p] < scaling.lowest[p]:
                state.s[p] = scaling.lowest[p]
                state.guarded[p] += 1
    return True


@njit(cache=True)
def run(model, scaling, state, W_Q, R, u, y, h, keep, room, trace):
    """Filters a record: measure, then go to the next sample. Returns the samples done; fewer than all is a failure.

    u : (n, n_u) volts held from each sample to the next. y : (n, n_y). R : (n_y,) variances. keep : decimation.
    """
    n_p, n_x = state.s.shape[0], state.x.shape[0]
    stack, gain = np.zeros((2 * n_x, n_x)), np.zeros(n_p + n_x)
    for k in range(y.shape[0]):
        if not _measure(model, scaling, state, y[k], R, gain, trace.innovation[k]):
            return k
        if k % keep == 0:
            m = k // keep
            for p in range(n_p):
                trace.s[m, p] = state.s[p]
                total = 0.0
                for i in range(p + 1):
                    total += state.W[i, p] * state.W[i, p]
                trace.variance[m, p] = total
            for j in range(n_x):
                trace.x[m, j] = state.x[j]
        if k < y.shape[0] - 1:
            if not flow(model, scaling, state.s, state.x, u[k], h, room):
                return k
            propagate(state.W, room.Phi_t, room.Psi_t, W_Q, stack)
    return y.shape[0]
