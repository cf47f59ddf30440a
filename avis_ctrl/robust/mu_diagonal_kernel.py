"""Compiled path to the minimum level of `mu_lmi` for structures with one number per block as scaling.

Single complex scalars and full blocks have only scalings p_k > 0. With W = S M^H, T = M S M^H and S the inverse of

    F = lambda P_w - M^H P_z M,

the derivatives of the barrier sum_k c_k p_k - log det F - sum_k c_k log p_k are sums of |S|^2, |W|^2 and |T|^2 over
blocks: a Newton step costs three matrix products. Matrices along axis 1 of M share p.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from avis_ctrl.robust.mu_kernel import Array, PathSettings, factor, invert


@njit(cache=True)
def _level_matrix(M: Array, p_z: Array, p_w: Array, F: Array) -> None:
    """F = diag(p_w) - M^H diag(p_z) M, lower triangle."""
    n_z, n_w = M.shape
    for i in range(n_w):
        for j in range(i + 1):
            F[i, j] = 0.0
        F[i, i] = p_w[i]
    for k in range(n_z):
        for i in range(n_w):
            m = p_z[k] * np.conj(M[k, i])
            for j in range(i + 1):
                F[i, j] -= m * M[k, j]


@njit(cache=True)
def _add_block_norms(X: Array, rows: Array, cols: Array, weight: float, out: Array) -> None:
    """out[rows[i], cols[j]] += weight |X[i, j]|^2."""
    for i in range(X.shape[0]):
        for j in range(X.shape[1]):
            out[rows[i], cols[j]] += weight * (X[i, j].real ** 2 + X[i, j].imag ** 2)


@njit(cache=True)
def _solve_positive(H: Array, b: Array) -> Array:
    """Solution of H x = b for positive definite H, scaled to unit diagonal, with a small ridge for singular H."""
    n = b.size
    d, A = np.empty(n), np.empty((n, n))
    for i in range(n):
        d[i] = 1.0 / np.sqrt(max(H[i, i], 1e-300))
    for i in range(n):
        for j in range(i + 1):
            A[i, j] = H[i, j] * d[i] * d[j]
        A[i, i] += 1e-13
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] ** 2
        A[j, j] = np.sqrt(max(A[j, j], 1e-30))
        for i in range(j + 1, n):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    x = d * b
    for i in range(n):
        for k in range(i):
            x[i] -= A[i, k] * x[k]
        x[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= A[k, i] * x[k]
        x[i] /= A[i, i]
    return d * x


@njit(cache=True)
def _derivatives(
    M: Array,
    p: Array,
    lam: float,
    of_z: Array,
    of_w: Array,
    copies: Array,
    gradient: Array,
    slope: Array,
    hessian: Array,
    falling: Array,
) -> bool:
    """Gradient, its derivative by lambda, and Hessian of the barrier at (p, lam); False outside its domain.

    falling (n_blocks + 1,) : tr(S P_w S dF/dp_k), and tr(S P_w S P_w), for the rate at which F decreases.
    """
    n_b = p.size
    n_z, n_w = M.shape[1:]
    SS, WS, TS = np.zeros((n_b, n_b)), np.zeros((n_b, n_b)), np.zeros((n_b, n_b))
    F = np.empty((n_w, n_w), np.complex128)
    for k in range(n_b):
        gradient[k], slope[k], falling[k] = copies[k] - copies[k] / p[k], 0.0, 0.0
    falling[n_b] = 0.0
    for s in range(M.shape[0]):
        _level_matrix(M[s], p[of_z], lam * p[of_w], F)
        if not factor(F, 0.0):
            return False
        invert(F)
        for i in range(n_w):
            for j in range(i + 1, n_w):
                F[i, j] = 0.0
        # V = inv(L) M^H, hence S = inv(L)^H inv(L), W = inv(L)^H V, T = V^H V.
        V = np.dot(F, np.conj(M[s]).T)
        Lh = np.conj(F).T
        S, W, T = np.dot(Lh, F), np.dot(Lh, V), np.dot(np.conj(V).T, V)
        _add_block_norms(S, of_w, of_w, 1.0, SS)
        _add_block_norms(W, of_w, of_z, 1.0, WS)
        _add_block_norms(T, of_z, of_z, 1.0, TS)
        for i in range(n_w):
            gradient[of_w[i]] -= lam * S[i, i].real
            slope[of_w[i]] -= S[i, i].real
        for i in range(n_z):
            gradient[of_z[i]] += T[i, i].real
    for k in range(n_b):
        for l in range(n_b):
            hessian[k, l] = lam * lam * SS[k, l] - lam * (WS[k, l] + WS[l, k]) + TS[k, l]
            falling[k] += p[l] * (lam * SS[k, l] - WS[l, k])
            falling[n_b] += p[k] * p[l] * SS[k, l]
        slope[k] += falling[k]
        hessian[k, k] += copies[k] / p[k] ** 2
    return True


@njit(cache=True)
def _inside(M: Array, p: Array, lam: float, of_z: Array, of_w: Array, F: Array) -> bool:
    """Whether p > 0 and F > 0."""
    for k in range(p.size):
        if not p[k] > 0.0:
            return False
    for s in range(M.shape[0]):
        _level_matrix(M[s], p[of_z], lam * p[of_w], F)
        if not factor(F, 0.0):
            return False
    return True


@njit(cache=True)
def follow_diagonal(
    M: Array,
    of_z: Array,
    of_w: Array,
    copies: Array,
    lam: Array,
    floor: Array,
    tolerance: float,
    settings: PathSettings,
) -> tuple[Array, Array]:
    """Scalings (B, n_blocks) and the levels (B,) that they prove, from p = 1 at lam (B,) to the minimum or `floor`.

    M (B, n_shared, n_z, n_w) complex, of_z (n_z,) and of_w (n_w,) the block of each entry, copies (n_blocks,) the
    weights c_k. Ends when the distance to the boundary is below `tolerance` lambda, or at the analytic centre when a
    `floor` > 0 is reached.
    """
    batch, n_b = M.shape[0], copies.size
    found, level = np.ones((batch, n_b)), lam.copy()
    gradient, slope, hessian, falling = np.empty(n_b), np.empty(n_b), np.empty((n_b, n_b)), np.empty(n_b + 1)
    F = np.empty((M.shape[3], M.shape[3]), np.complex128)
    for b in range(batch):
        p, at = found[b].copy(), lam[b]
        for _ in range(settings.steps):
            sound = True
            for _ in range(settings.newton):
                if not _derivatives(M[b], p, at, of_z, of_w, copies, gradient, slope, hessian, falling):
                    sound = False
                    break
                step = _solve_positive(hessian, gradient)
                decrement = np.sqrt(max(np.dot(step, gradient), 0.0))
                if decrement < settings.central:
                    break
                p = p - step * (1.0 if decrement < settings.near else 1.0 / (1.0 + decrement))
            if not sound or not _inside(M[b], p, at, of_z, of_w, F):
                # Round-off ends the path here; the last verified point is kept.
                break
            found[b], level[b] = p, at
            if floor[b] > 0 and at <= floor[b]:
                break
            towards = _solve_positive(hessian, slope)
            # The Frobenius norm of dF / d lambda in the metric of F gives the distance to the boundary up to a factor.
            speed = falling[n_b]
            for k in range(n_b):
                speed += towards[k] * (slope[k] - 2 * falling[k]) - copies[k] * (towards[k] / p[k]) ** 2
            whole = at - max(floor[b], 0.0)
            fall = min(whole, settings.first / np.sqrt(max(speed, 1e-300)))
            # d p / d lambda = -towards: lambda decreases, p moves along `towards`. Two points are checked, as in
            # `mu_kernel.follow_path`.
            for _ in range(40):
                step = fall if fall >= whole else settings.reach * fall
                if _inside(M[b], p + fall * towards, at - fall, of_z, of_w, F) and (
                    step == fall or _inside(M[b], p + step * towards, at - step, of_z, of_w, F)
                ):
                    break
                fall *= settings.shrink
            else:
                break
            last = fall <= tolerance * at
            fall = step
            p, at = p + fall * towards, at - fall
            if last:
                found[b], level[b] = p, at
                break
    return found, level


@njit(cache=True)
def balanced_squares(norm2: Array, sweeps: int) -> Array:
    """Squares (B, n) of Osborne's scalings from the squared norms (B, n, n) of the off-diagonal blocks."""
    batch, n = norm2.shape[:2]
    d2 = np.ones((batch, n))
    for b in range(batch):
        for _ in range(sweeps):
            for k in range(n):
                row, col = 0.0, 0.0
                for j in range(n):
                    row += norm2[b, k, j] / d2[b, j]
                    col += norm2[b, j, k] * d2[b, j]
                d2[b, k] = np.sqrt(d2[b, k] ** 2 * (col / d2[b, k]) / (row * d2[b, k]))
    return d2


@njit(cache=True)
def level_squares(norm2: Array, enough2: Array, most: float) -> Array:
    """d2 (B, n) > 0 such that every norm2_kj d2_k / d2_j is at most the largest geometric mean of norm2 (B, n, n)
    around a cycle of blocks, or at most enough2 (B,) if that is larger; 1 if there is no cycle and enough2 is zero.
    The mean does not depend on the units of the signals.

    The mean is computed by Karp's theorem (Discrete Mathematics 23, 1978), log d2 as the longest walk to each block.

    most : maximum distance of log d2 from the middle of its range.
    """
    batch, n = norm2.shape[:2]
    d2 = np.ones((batch, n))
    walk = np.empty((n + 1, n))
    size = np.empty((n, n))
    for b in range(batch):
        for k in range(n):
            for j in range(n):
                size[k, j] = np.log(norm2[b, k, j]) if norm2[b, k, j] > 0.0 else -np.inf
        walk[0] = 0.0
        for m in range(n):
            for j in range(n):
                walk[m + 1, j] = np.max(walk[m] + size[:, j])
        mean = -np.inf
        for j in range(n):
            if walk[n, j] > -np.inf:
                least = np.inf
                for m in range(n):
                    least = min(least, (walk[n, j] - walk[m, j]) / (n - m))
                mean = max(mean, least)
        if enough2[b] > 0.0:
            mean = max(mean, np.log(enough2[b]))
        if mean > -np.inf:
            longest = np.zeros(n)
            for _ in range(n):
                for j in range(n):
                    longest[j] = max(longest[j], np.max(longest + size[:, j]) - mean)
            middle = (np.max(longest) + np.min(longest)) / 2
            for j in range(n):
                d2[b, j] = np.exp(min(max(longest[j] - middle, -most), most))
    return d2
