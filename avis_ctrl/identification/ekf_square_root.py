"""Square-root covariance of the extended Kalman filter, block by block, compiled.

P = W^T W with W upper triangular is symmetric and positive semidefinite by construction. States are the parameters s
(n_p), which do not move, then x (n_x). Over a sample

    x+ = Phi x + Psi s + w,   s+ = s      ->      W+ = qr [ W_ss   W_sx Phi^T + W_ss Psi^T ]
                                                          [ 0      W_xx Phi^T              ]
                                                          [ 0      W_Q                     ]

and only the last two block rows have to be made triangular again: n_x columns, whatever n_p. Measurements are taken
one by one (diagonal R) by Carlson's triangular update (AIAA Journal 11 (1973), 1259).
"""

from __future__ import annotations

import numpy as np
from numba import njit

FAST = {"reassoc", "contract"}


@njit(cache=True, fastmath=FAST)
def _triangular(A, columns):
    """Upper triangle R with R^T R = A^T A, by Householder's reflections, into the first rows of A (2 n, n).

    The lower half of A is upper triangular: in column k only rows k .. n + k are not zero.
    """
    n = columns
    w = np.empty(n)
    for k in range(n):
        last = n + k + 1
        norm = 0.0
        for i in range(k, last):
            norm += A[i, k] * A[i, k]
        if norm == 0.0:
            continue
        norm = np.sqrt(norm)
        diagonal = -norm if A[k, k] > 0 else norm
        head = A[k, k] - diagonal
        beta = -1.0 / (diagonal * head)  # 2 / v^T v, v = (head, A[k+1:, k])
        A[k, k] = head
        for j in range(k + 1, n):
            w[j] = 0.0
        for i in range(k, last):
            a = A[i, k]
            for j in range(k + 1, n):
                w[j] += a * A[i, j]
        for i in range(k, last):
            a = A[i, k] * beta
            for j in range(k + 1, n):
                A[i, j] -= a * w[j]
        A[k, k] = diagonal
        for i in range(k + 1, last):
            A[i, k] = 0.0


@njit(cache=True, fastmath=FAST)
def propagate(W, Phi_t, Psi_t, W_Q, stack):
    """W over a sample, in place; W_Q (n_x, n_x) upper triangular with W_Q^T W_Q the process noise of the sample."""
    n_p, n_x = Psi_t.shape
    row = np.empty(n_x)
    for i in range(n_p):
        for j in range(n_x):
            row[j] = 0.0
        for k in range(n_x):
            a = W[i, n_p + k]
            for j in range(n_x):
                row[j] += a * Phi_t[k, j]
        for k in range(i, n_p):
            a = W[i, k]
            for j in range(n_x):
                row[j] += a * Psi_t[k, j]
        for j in range(n_x):
            W[i, n_p + j] = row[j]
    for i in range(n_x):
        for j in range(n_x):
            stack[i, j], stack[n_x + i, j] = 0.0, W_Q[i, j]
        for k in range(i, n_x):
            a = W[n_p + i, n_p + k]
            for j in range(n_x):
                stack[i, j] += a * Phi_t[k, j]
    _triangular(stack, n_x)
    for i in range(n_x):
        for j in range(i, n_x):
            W[n_p + i, n_p + j] = stack[i, j]


@njit(cache=True, fastmath=FAST)
def update(W, h, r, gain):
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
