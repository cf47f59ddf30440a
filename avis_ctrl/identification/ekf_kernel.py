"""Compiled inner loop of the extended Kalman filter: flow over a sample with its derivatives, square-root covariance.

Order of the augmented state: constant parameters s (n_p), then x = (q, q', f) with f (n_f, often none) a coloured
disturbance that accelerates the table by G f.

The flow over a sample is the Taylor polynomial of fourth order at fixed parameters, which for a linear system equals
the Runge-Kutta step; its error at 5 Hz and 1 kHz is (omega h)^4 / 120 = 8e-9 of the step's change. Phi and Psi are its
exact derivatives. P = W^T W with W upper triangular is symmetric and positive semidefinite by construction:

    x+ = Phi x + Psi s + w,   s+ = s      ->      W+ = qr [ W_ss   W_sx Phi^T + W_ss Psi^T ]
                                                          [ 0      W_xx Phi^T              ]
                                                          [ 0      W_Q                     ]

and only the last two block rows have to be made triangular again: n_x columns, regardless of n_p. Measurements are
processed one by one (diagonal R) by Carlson's triangular update (AIAA Journal 11 (1973), 1259).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

FAST = {"reassoc", "contract"}


class Plant(NamedTuple):
    """M, C and K : constant (3, n_q, n_q) plus slopes (3, n_q, n_q, n_p) times theta = reference (n_p,) times s.

    T (n_q, n_u); H (n_y, n_x) on (q, q', f).

    G (n_q, n_f) : acceleration by the disturbance, which is held over a sample. decay : factor on f over a sample.
    lowest : lower limit of s.
    """

    constant: np.ndarray
    slopes: np.ndarray
    reference: np.ndarray
    T: np.ndarray
    H: np.ndarray
    G: np.ndarray
    decay: float
    lowest: float


class Filter(NamedTuple):
    """State that the loop modifies: s (n_p,), x (n_x,), W (n_p + n_x square, upper triangular), counts of limited s
    (n_p,)."""

    s: np.ndarray
    x: np.ndarray
    W: np.ndarray
    guarded: np.ndarray


class Trace(NamedTuple):
    """Output of the loop: (n, n_y) innovations over their predicted standard deviation, and every `keep` samples s (m,
    n_p), its covariance's diagonal (m, n_p) and x (m, n_x)."""

    innovation: np.ndarray
    s: np.ndarray
    variance: np.ndarray
    x: np.ndarray


@njit(cache=True, fastmath=FAST)
def flow(
    plant: Plant, s: np.ndarray, x: np.ndarray, u: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x after a sample of h seconds at held volts u (n_u,), Phi (n_x, n_x) and Psi (n_x, n_p).

    The terms (A h)^k / k! of the state, of its derivatives and of the transition are computed together. x is NaN if a
    mass or an inertia is not positive.
    """
    n_p, n_q, n_x = s.shape[0], plant.T.shape[0], x.shape[0]
    theta, matrices = plant.reference * s, plant.constant.copy()
    for m in range(3):
        for i in range(n_q):
            for j in range(n_q):
                for p in range(n_p):
                    matrices[m, i, j] += theta[p] * plant.slopes[m, i, j, p]
    for i in range(n_q):
        if not 0.0 < matrices[0, i, i] < np.inf:
            return np.full(n_x, np.nan), np.eye(n_x), np.zeros((n_x, n_p))
    inverse, A = np.linalg.inv(matrices[0]), np.zeros((n_x, n_x))
    for i in range(n_q):
        A[i, n_q + i] = 1.0
    A[n_q : 2 * n_q, :n_q] = -np.dot(inverse, matrices[2])
    A[n_q : 2 * n_q, n_q : 2 * n_q] = -np.dot(inverse, matrices[1])
    A[n_q : 2 * n_q, 2 * n_q :] = plant.G
    term, power, moved = x, np.eye(n_x), np.zeros((n_x, n_p))
    after, Phi, Psi = x.copy(), np.eye(n_x), np.zeros((n_x, n_p))
    for k in range(1, 5):
        slope, moved = np.dot(A, term), np.dot(A, moved)
        if k == 1:
            slope[n_q : 2 * n_q] += np.dot(inverse, np.dot(plant.T, u))
        moved[n_q : 2 * n_q] -= np.dot(inverse, _forces(plant, slope, term))
        term, moved, power = slope * (h / k), moved * (h / k), np.dot(A, power) * (h / k)
        after, Phi, Psi = after + term, Phi + power, Psi + moved
    for i in range(2 * n_q, n_x):
        after[i], Phi[i, i] = plant.decay * x[i], plant.decay
    return after, Phi, Psi


@njit(cache=True, fastmath=FAST)
def _forces(plant: Plant, slope: np.ndarray, term: np.ndarray) -> np.ndarray:
    """(n_q, n_p) dM q'' + dC q' + dK q by each s, for a term (q, q') and its time derivative."""
    n_q, n_p = plant.T.shape[0], plant.reference.shape[0]
    out = np.zeros((n_q, n_p))
    for i in range(n_q):
        for j in range(n_q):
            a, v, q = slope[n_q + j], term[n_q + j], term[j]
            for p in range(n_p):
                out[i, p] += plant.slopes[0, i, j, p] * a + plant.slopes[1, i, j, p] * v + plant.slopes[2, i, j, p] * q
        for p in range(n_p):
            out[i, p] *= plant.reference[p]
    return out


@njit(cache=True)
def propagate(W: np.ndarray, Phi: np.ndarray, Psi: np.ndarray, W_Q: np.ndarray) -> None:
    """Propagate W over a sample, in place; W_Q (n_x, n_x) with W_Q^T W_Q the process noise of the sample."""
    n_p = Psi.shape[1]
    F_t = np.ascontiguousarray(np.concatenate((Psi, Phi), axis=1).T)
    moved = np.dot(W, F_t)
    W[:n_p, n_p:] = moved[:n_p]
    W[n_p:, n_p:] = np.linalg.qr(np.concatenate((moved[n_p:], W_Q)))[1]


@njit(cache=True, fastmath=FAST)
def update(W: np.ndarray, h: np.ndarray, r: float, gain: np.ndarray) -> float:
    """Carlson's update of W by a measurement h x of variance r; `gain` becomes P h / variance, which is returned."""
    n, n_x = W.shape[0], h.shape[0]
    n_p = n - n_x
    alpha = r
    for j in range(n):
        gain[j] = 0.0
    for i in range(n - 1, -1, -1):
        f = 0.0
        for j in range(max(i - n_p, 0), n_x):
            f += W[i, n_p + j] * h[j]
        before = alpha
        alpha += f * f
        b, c = np.sqrt(before / alpha), f / np.sqrt(before * alpha)
        for j in range(i, n):
            w = W[i, j]
            W[i, j] = b * w - c * gain[j]
            gain[j] += f * w
    for j in range(n):
        gain[j] /= alpha
    return alpha


@njit(cache=True)
def _measure(
    plant: Plant, state: Filter, y: np.ndarray, R: np.ndarray, gain: np.ndarray, innovation: np.ndarray
) -> bool:
    """Process all measurements of one sample, one by one; False if an innovation is not finite."""
    n_p = state.s.shape[0]
    for i in range(y.shape[0]):
        e = y[i] - np.dot(plant.H[i], state.x)
        innovation[i] = e / np.sqrt(update(state.W, plant.H[i], R[i], gain))
        if not np.isfinite(innovation[i]):
            return False
        state.s[:] += gain[:n_p] * e
        state.x[:] += gain[n_p:] * e
    for p in range(n_p):
        if state.s[p] < plant.lowest:
            state.s[p] = plant.lowest
            state.guarded[p] += 1
    return True


@njit(cache=True)
def run(
    plant: Plant,
    state: Filter,
    W_Q: np.ndarray,
    R: np.ndarray,
    u: np.ndarray,
    y: np.ndarray,
    h: float,
    keep: int,
    trace: Trace,
) -> int:
    """Filter a record: measurement update, then propagation to the next sample. Returns the number of samples
    processed; fewer than all means failure.

    u : (n, n_u) volts held from each sample to the next. y : (n, n_y). R : (n_y,) variances. keep : decimation.
    """
    n_p = state.s.shape[0]
    gain = np.zeros(state.W.shape[0])
    for k in range(y.shape[0]):
        if not _measure(plant, state, y[k], R, gain, trace.innovation[k]):
            return k
        if k % keep == 0:
            m = k // keep
            trace.s[m], trace.x[m] = state.s, state.x
            trace.variance[m] = np.sum(state.W[:n_p, :n_p] ** 2, axis=0)
        if k < y.shape[0] - 1:
            state.x[:], Phi, Psi = flow(plant, state.s, state.x, u[k], h)
            propagate(state.W, Phi, Psi, W_Q)
    return y.shape[0]
