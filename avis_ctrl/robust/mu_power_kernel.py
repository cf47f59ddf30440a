"""Compiled search of `mu_lower` for complex blocks: repeated linearisation, one matrix at a time.

Inverse iteration gives an eigenvalue of M Delta near 1 with its eigenvectors x, y. The next Delta has minimum norm and
makes this eigenvalue 1 to first order; every block has that norm (the power iteration of Packard, Fan and Doyle, Proc.
27th CDC, 1988).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from avis_ctrl.robust.mu_kernel import Array

FULL = 1


@njit(cache=True)
def _factor(A: Array, pivot: Array) -> None:
    """LU factors in place of A with row pivoting; a vanishing pivot is replaced by 1e-15."""
    n = A.shape[0]
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(A[i, k].real) + abs(A[i, k].imag) > abs(A[best, k].real) + abs(A[best, k].imag):
                best = i
        pivot[k] = best
        if best != k:
            for j in range(n):
                A[k, j], A[best, j] = A[best, j], A[k, j]
        if abs(A[k, k]) < 1e-15:
            A[k, k] = 1e-15
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, n):
            A[i, k] *= inverse
            factor = A[i, k]
            for j in range(k + 1, n):
                A[i, j] -= factor * A[k, j]


@njit(cache=True)
def _solve(A: Array, pivot: Array, x: Array) -> None:
    """x = inv(A) x from the LU factors, normalised to unit length."""
    n = x.size
    for k in range(n):
        if pivot[k] != k:
            x[k], x[pivot[k]] = x[pivot[k]], x[k]
    for i in range(n):
        for k in range(i):
            x[i] -= A[i, k] * x[k]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= A[i, k] * x[k]
        x[i] /= A[i, i]
    _unit(x)


@njit(cache=True)
def _solve_adjoint(A: Array, pivot: Array, y: Array) -> None:
    """y = inv(A^H) y from the LU factors of A, normalised to unit length."""
    n = y.size
    for i in range(n):
        for k in range(i):
            y[i] -= np.conj(A[k, i]) * y[k]
        y[i] /= np.conj(A[i, i])
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            y[i] -= np.conj(A[k, i]) * y[k]
    for k in range(n - 1, -1, -1):
        if pivot[k] != k:
            y[k], y[pivot[k]] = y[pivot[k]], y[k]
    _unit(y)


@njit(cache=True)
def _unit(x: Array) -> None:
    size = np.sqrt(np.sum(x.real**2 + x.imag**2))
    if size > 0:
        x /= size


@njit(cache=True)
def _aligned(v: Array, u: Array, kinds: Array, w: Array, z: Array, delta: Array) -> None:
    """Fill `delta` with the Delta of norm 1 that best satisfies v = Delta u, block by block."""
    delta[:] = 0.0
    for b in range(kinds.size):
        if kinds[b] == FULL:
            size = np.sqrt(np.sum(np.abs(v[w[b] : w[b + 1]]) ** 2) * np.sum(np.abs(u[z[b] : z[b + 1]]) ** 2))
            for i in range(w[b], w[b + 1]):
                for j in range(z[b], z[b + 1]):
                    delta[i, j] = v[i] * np.conj(u[j]) / size if size > 0 else 0j
        else:
            product = np.sum(np.conj(u[z[b] : z[b + 1]]) * v[w[b] : w[b + 1]])
            value = product / abs(product) if abs(product) > 0 else 1.0 + 0j
            for i in range(w[b + 1] - w[b]):
                delta[w[b] + i, z[b] + i] = value


@njit(cache=True)
def _linearised(a: Array, x: Array, e: complex, kinds: Array, w: Array, z: Array, new: Array) -> float:
    """Fill `new` with the Delta of minimum norm k that makes the eigenvalue 1 to first order; return k, inf if none."""
    total = 0.0
    for b in range(kinds.size):
        if kinds[b] == FULL:
            total += np.sqrt(np.sum(np.abs(a[w[b] : w[b + 1]]) ** 2) * np.sum(np.abs(x[z[b] : z[b + 1]]) ** 2)) / abs(e)
        else:
            total += abs(np.sum(np.conj(a[w[b] : w[b + 1]]) * x[z[b] : z[b + 1]])) / abs(e)
    if not total > 1e-12:
        return np.inf
    k = 1.0 / total
    _aligned(a, x, kinds, w, z, new)
    new *= k * e / abs(e)
    return k


@njit(cache=True)
def search_complex(
    M: Array,
    starts: Array,
    kinds: Array,
    w: Array,
    z: Array,
    iterations: int,
    damping: float,
    enough: float,
    settled: float,
) -> tuple[Array, Array, Array]:
    """The largest 1/||Delta|| (B,) found, its Delta (B, n_w, n_z) and Delta x (B, n_w), from starts (count, B, n_w).

    M (B, n_z, n_w) in units of its upper bound; kinds (n_blocks,) FULL or not; w, z (n_blocks + 1,) first indices of
    the blocks. A start ends when the norm changes by less than `settled`, the search for a matrix when `enough` is
    reached. The results are not verified here.
    """
    batch, n_z, n_w = M.shape
    value, found = np.zeros(batch), np.zeros((batch, n_w, n_z), np.complex128)
    vector = np.zeros((batch, n_w), np.complex128)
    new, pivot = np.empty((n_w, n_z), np.complex128), np.empty(n_z, np.int64)
    for b in range(batch):
        for start in range(starts.shape[0]):
            if value[b] >= enough:
                break
            delta = np.empty((n_w, n_z), np.complex128)
            _aligned(starts[start, b], np.dot(M[b], starts[start, b]), kinds, w, z, delta)
            x, y = np.ones(n_z, np.complex128), np.ones(n_z, np.complex128)
            Mh = np.conj(M[b]).T.copy()
            before, norm = 0.0, 1.0
            for sweep in range(iterations):
                A = np.dot(M[b], delta)
                B = A.copy()
                for i in range(n_z):
                    B[i, i] -= 1.0 + 1e-9 * (1.0 + 0.7j)
                _factor(B, pivot)
                for _ in range(2 if sweep == 0 else 1):
                    _solve(B, pivot, x)
                    _solve_adjoint(B, pivot, y)
                e = complex(np.vdot(y, x))
                if abs(e) < 1e-12:
                    e = 1e-12 + 0j
                # The Rayleigh quotient: Delta divided by it makes I - M Delta singular to second order.
                quotient = complex(np.vdot(y, np.dot(A, x))) / e
                if sweep > 0:
                    size = abs(quotient) / norm
                    if size > value[b] and size <= 1.0 + 1e-6 and abs(quotient - 1.0) < 0.1:
                        value[b] = size
                        found[b] = delta / quotient
                        vector[b] = np.dot(delta, x)
                    if abs(size - before) <= settled * size:
                        break
                    before = size
                k = _linearised(np.dot(Mh, y), x, e, kinds, w, z, new)
                if not np.isfinite(k):
                    break
                if sweep > 0 and damping > 0:
                    # Each block of the mixture has at most this norm.
                    norm = damping * norm + (1 - damping) * k
                    delta = damping * delta + (1 - damping) * new
                else:
                    norm = k
                    delta = new.copy()
    return value, found, vector
