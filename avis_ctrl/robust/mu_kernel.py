"""The compiled inner loop of `mu_lmi`: damped Newton steps to the analytic centre, one problem after the other.

For V = [I  M^H], K(theta) = sum_k theta_k K_k given by its entries, F = V K V^H and T = V^H inv(F) V

    d(-log det F) = -tr(T K_k),
    d2(-log det F) = tr(T K_k T K_l) = sum over the entries of v_i v_j T[c_i, r_j] T[c_j, r_i].

Matrices are small and each problem needs its own number of steps: plain loops are several times faster than stacks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

NEAR = 0.4


class Entries(NamedTuple):
    """Non-zero entries of the matrices K_k: place, value, parameter k, and 1.0 where lambda multiplies the entry."""

    row: np.ndarray
    col: np.ndarray
    value: np.ndarray
    parameter: np.ndarray
    on_level: np.ndarray
    size: int


@njit(cache=True)
def _matrix(theta, entries, lam):
    K = np.zeros((entries.size, entries.size), np.complex128)
    for e in range(entries.row.size):
        weight = lam if entries.on_level[e] else 1.0
        K[entries.row[e], entries.col[e]] += theta[entries.parameter[e]] * weight * entries.value[e]
    return K


@njit(cache=True)
def _inverse(A):
    """Inverse of a Hermitian matrix by its Cholesky factor; NaN where it is not positive definite."""
    n = A.shape[0]
    L = np.zeros((n, n), np.complex128)
    for j in range(n):
        for i in range(j, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * np.conj(L[j, k])
            if i > j:
                L[i, j] = total / L[j, j].real
            elif total.real > 0:
                L[j, j] = np.sqrt(total.real)
            else:
                for k in range(n):
                    L[k, k] = np.nan
                return L
    for j in range(n):
        L[j, j] = 1.0 / L[j, j].real
        for i in range(j + 1, n):
            total = 0j
            for k in range(j, i):
                total -= L[i, k] * L[k, j]
            L[i, j] = total / L[i, i].real
    S = np.zeros((n, n), np.complex128)
    for i in range(n):
        for j in range(i + 1):
            total = 0j
            for k in range(i, n):
                total += np.conj(L[k, i]) * L[k, j]
            S[i, j] = total
            S[j, i] = np.conj(total)
    return S


@njit(cache=True)
def _residual(M, K):
    """F = V K V^H for M (n_z, n_w), as (K_ww + K_wz M) + M^H (K_zw + K_zz M)."""
    n_z, n_w = M.shape
    KV = np.zeros((n_w + n_z, n_w), np.complex128)
    for i in range(n_w + n_z):
        for j in range(n_w):
            KV[i, j] = K[i, j]
        for k in range(n_z):
            if K[i, n_w + k] != 0:
                for j in range(n_w):
                    KV[i, j] += K[i, n_w + k] * M[k, j]
    F = np.zeros((n_w, n_w), np.complex128)
    for i in range(n_w):
        for j in range(n_w):
            F[i, j] += KV[i, j]
        for k in range(n_z):
            m = np.conj(M[k, i])
            for j in range(n_w):
                F[i, j] += m * KV[n_w + k, j]
    return F


@njit(cache=True)
def _add_derivatives(T, entries, lam, gradient, hessian):
    """Subtract tr(T K_k) from the gradient and add tr(T K_k T K_l) to the Hessian."""
    n = entries.row.size
    v = np.empty(n, np.complex128)
    for i in range(n):
        v[i] = entries.value[i] * (lam if entries.on_level[i] else 1.0)
    for i in range(n):
        p, r, c = entries.parameter[i], entries.row[i], entries.col[i]
        gradient[p] -= (v[i] * T[c, r]).real
        for j in range(i + 1):
            both = v[i] * v[j] * T[c, entries.row[j]] * T[entries.col[j], r]
            hessian[p, entries.parameter[j]] += both.real
            if j < i:
                hessian[entries.parameter[j], p] += both.real


@njit(cache=True)
def _gram(M, S):
    """T = V^H inv(F) V = [S, S M^H; M S, M S M^H] for S = inv(F)."""
    n_z, n_w = M.shape
    T = np.zeros((n_w + n_z, n_w + n_z), np.complex128)
    for i in range(n_w):
        for j in range(n_w):
            T[i, j] = S[i, j]
    for i in range(n_z):
        for k in range(n_w):
            m = M[i, k]
            for j in range(n_w):
                T[n_w + i, j] += m * S[k, j]
        for j in range(n_w):
            T[j, n_w + i] = np.conj(T[n_w + i, j])
        for l in range(i + 1):
            total = 0j
            for k in range(n_w):
                total += T[n_w + i, k] * np.conj(M[l, k])
            T[n_w + i, n_w + l] = total
            T[n_w + l, n_w + i] = np.conj(total)
    return T


@njit(cache=True)
def _add_slope(T, K, entries, lam, slope):
    """Derivative by lambda of the gradient, from dT = -T Xp T with Xp = dK / d lambda, and from lambda's entries."""
    n = entries.size
    W = np.zeros((n, n), np.complex128)
    for e in range(entries.row.size):
        if entries.on_level[e]:
            x = K[e]
            for j in range(n):
                W[entries.row[e], j] += x * T[entries.col[e], j]
    for e in range(entries.row.size):
        r, c = entries.row[e], entries.col[e]
        total = 0j
        for k in range(n):
            total += T[c, k] * W[k, r]
        weight = lam if entries.on_level[e] else 1.0
        slope[entries.parameter[e]] += (entries.value[e] * weight * total).real
        if entries.on_level[e]:
            slope[entries.parameter[e]] -= (entries.value[e] * T[c, r]).real


@njit(cache=True)
def _solve(A, b):
    """Solution of A x = b by elimination with pivots, in place of b; NaN where A is singular."""
    n = b.size
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        if not abs(A[pivot, k]) > 0.0:
            for i in range(n):
                b[i] = np.nan
            return
        if pivot != k:
            for j in range(n):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
            b[k], b[pivot] = b[pivot], b[k]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            for j in range(k + 1, n):
                A[i, j] -= factor * A[k, j]
            b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= A[k, j] * b[j]
        b[k] /= A[k, k]


@njit(cache=True)
def _newton(hessian, right, is_g):
    """-inv(hessian) right with unit-diagonal scaling; ridges of round-off size where it is singular.

    A G that multiplies a real entry of M has no effect and no curvature: its ridge is measured against the
    largest curvature, so that round-off does not drive it away.
    """
    n = right.size
    top = 0.0
    for i in range(n):
        top = max(top, hessian[i, i])
    d, A, b = np.empty(n), np.empty((n, n)), np.empty(n)
    for i in range(n):
        d[i] = 1.0 / np.sqrt(max(hessian[i, i] + (1e-11 * top if is_g[i] else 0.0), 1e-300))
    for i in range(n):
        b[i] = -d[i] * right[i]
        for j in range(n):
            A[i, j] = hessian[i, j] * d[i] * d[j]
        A[i, i] += 1e-13 + (1e-11 * top * d[i] ** 2 if is_g[i] else 0.0)
    _solve(A, b)
    for i in range(n):
        b[i] *= d[i]
    return b


@njit(cache=True)
def centres(M, theta, lam, form, core, trace, is_g, accuracy, steps):
    """Analytic centres theta (B, p) at fixed lam (B,) and the directions d theta / d lambda (B, p) of their path.

    Of trace theta - log det F - log det X, F of every matrix of M (B, n_shared, n_z, n_w) complex; theta (B, p) to
    start from; form and core are Entries of F and X. NaN where it failed.
    """
    n_p = trace.size
    found, direction = np.empty((theta.shape[0], n_p)), np.empty((theta.shape[0], n_p))
    gradient, slope, hessian, x = np.empty(n_p), np.empty(n_p), np.empty((n_p, n_p)), np.empty(n_p)
    rate = np.empty(form.row.size, np.complex128)
    for b in range(M.shape[0]):
        for k in range(n_p):
            x[k] = theta[b, k]
        for count in range(steps + 1):
            for k in range(n_p):
                gradient[k], slope[k] = trace[k], 0.0
                for l in range(n_p):
                    hessian[k, l] = 0.0
            for e in range(form.row.size):
                rate[e] = x[form.parameter[e]] * form.value[e]
            K = _matrix(x, form, lam[b])
            for s in range(M.shape[1]):
                T = _gram(M[b, s], _inverse(_residual(M[b, s], K)))
                _add_derivatives(T, form, lam[b], gradient, hessian)
                _add_slope(T, rate, form, lam[b], slope)
            _add_derivatives(_inverse(_matrix(x, core, 1.0)), core, 1.0, gradient, hessian)
            step = _newton(hessian, gradient, is_g)
            decrement = 0.0
            for k in range(n_p):
                decrement -= step[k] * gradient[k]
            decrement = np.sqrt(max(decrement, 0.0))
            # Not a number is not far either: the caller sorts such problems out.
            if not decrement >= accuracy or count == steps:
                break
            length = 1.0 if decrement < NEAR else 1.0 / (1.0 + decrement)
            for k in range(n_p):
                x[k] += length * step[k]
        towards = _newton(hessian, slope, is_g)
        for k in range(n_p):
            found[b, k], direction[b, k] = x[k], towards[k]
    return found, direction
