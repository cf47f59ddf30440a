"""Compiled path of `mu_lmi`: damped Newton steps to each analytic centre, one problem at a time.

For V = [I  M^H], K(theta) = sum_k theta_k K_k given by its entries, F = V K V^H and T = V^H inv(F) V

    d(-log det F) = -tr(T K_k),
    d2(-log det F) = tr(T K_k T K_l) = sum over the entries of v_i v_j T[c_i, r_j] T[c_j, r_i].

Matrices are small and the number of steps differs between problems: plain loops are several times faster than stacked
arrays. Only the Newton step itself, with up to hundreds of parameters, uses LAPACK.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

Array = np.ndarray


class PathSettings(NamedTuple):
    """central : Newton decrement below which a point counts as the analytic centre.
    near : Newton decrement below which a full step is taken, because convergence is quadratic there.
    reach : fraction of the distance to the boundary by which lambda decreases in one step: values closer to 1 need
        fewer steps, but more Newton steps for each.
    first, shrink : first trial of that distance, relative to its lower bound, and the factor to the next trial.
    newton, steps : maximum number of Newton steps to a centre, and of centres. A path that ends at its last centre
        gives a valid bound that is larger than necessary.
    """

    central: float = 0.3
    near: float = 0.4
    reach: float = 0.9
    first: float = 3.0
    shrink: float = 0.7
    newton: int = 40
    steps: int = 60


SETTINGS = PathSettings()


class Entries(NamedTuple):
    """Non-zero entries of the matrices K_k: indices, value, parameter k, and whether lambda multiplies the entry."""

    row: np.ndarray
    col: np.ndarray
    value: np.ndarray
    parameter: np.ndarray
    on_level: np.ndarray
    size: int


@njit(cache=True)
def _matrix(theta: Array, entries: Entries, lam: float) -> Array:
    K = np.zeros((entries.size, entries.size), np.complex128)
    for e in range(entries.row.size):
        weight = lam if entries.on_level[e] else 1.0
        K[entries.row[e], entries.col[e]] += theta[entries.parameter[e]] * weight * entries.value[e]
    return K


@njit(cache=True)
def factor(F: Array, least: float) -> bool:
    """Lower Cholesky factor in place of F; False if F is not positive definite: a squared pivot not above `least`."""
    n = F.shape[0]
    for j in range(n):
        total = F[j, j].real
        for k in range(j):
            total -= F[j, k].real ** 2 + F[j, k].imag ** 2
        if not total > least:
            return False
        root = np.sqrt(total)
        F[j, j] = root
        for i in range(j + 1, n):
            s = F[i, j]
            for k in range(j):
                s -= F[i, k] * np.conj(F[j, k])
            F[i, j] = s / root
    return True


@njit(cache=True)
def invert(L: Array) -> None:
    """Inverse of L in place of the lower factor L."""
    n = L.shape[0]
    for j in range(n):
        L[j, j] = 1.0 / L[j, j].real
        for i in range(j + 1, n):
            s = 0j
            for k in range(j, i):
                s -= L[i, k] * L[k, j]
            L[i, j] = s / L[i, i].real


@njit(cache=True)
def _inverse(A: Array) -> Array:
    """Inverse of a Hermitian matrix by its Cholesky factor; NaN if it is not positive definite."""
    n = A.shape[0]
    L = A.copy()
    if not factor(L, 0.0):
        return np.full((n, n), np.nan + 0j)
    invert(L)
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
def _residual(M: Array, K: Array) -> Array:
    """F = V K V^H for M (n_z, n_w), as (K_ww + K_wz M) + M^H (K_zw + K_zz M)."""
    n_w = M.shape[1]
    lower = np.dot(K[n_w:, n_w:].copy(), M) + K[n_w:, :n_w]
    F = np.dot(np.conj(M.T).copy(), lower) + K[:n_w, :n_w]
    if np.any(K[:n_w, n_w:]):
        F += np.dot(K[:n_w, n_w:].copy(), M)
    return F


@njit(cache=True)
def _add_derivatives(T: Array, entries: Entries, lam: float, gradient: Array, hessian: Array) -> None:
    """Subtract tr(T K_k) from the gradient and add tr(T K_k T K_l), l <= k, to the Hessian's lower triangle.

    The entries are sorted by parameter. All matrices are Hermitian, so that only entries on and above the diagonal of
    K_k are visited; the entries below contribute the conjugate.
    """
    n = entries.row.size
    v = np.empty(n, np.complex128)
    for i in range(n):
        v[i] = entries.value[i] * (lam if entries.on_level[i] else 1.0)
    for i in range(n):
        p, r, c = entries.parameter[i], entries.row[i], entries.col[i]
        if r > c:
            continue
        twice = v[i] if r == c else 2.0 * v[i]
        gradient[p] -= (twice * T[c, r]).real
        of_c, of_r = twice * T[c], np.conj(T[r])
        for j in range(n):
            q = entries.parameter[j]
            if q > p:
                break
            hessian[p, q] += (v[j] * of_c[entries.row[j]] * of_r[entries.col[j]]).real


@njit(cache=True)
def _gram(M: Array, S: Array) -> Array:
    """T = V^H inv(F) V = [S, S M^H; M S, M S M^H] for S = inv(F)."""
    n_z, n_w = M.shape
    T = np.empty((n_w + n_z, n_w + n_z), np.complex128)
    MS = np.dot(M, S)
    T[:n_w, :n_w], T[n_w:, :n_w], T[:n_w, n_w:] = S, MS, np.conj(MS.T)
    T[n_w:, n_w:] = np.dot(MS, np.conj(M.T).copy())
    return T


@njit(cache=True)
def _add_slope(T: Array, K: Array, entries: Entries, lam: float, slope: Array) -> None:
    """Derivative of the gradient by lambda, from dT = -T Xp T with Xp = dK / d lambda, and from entries with lambda."""
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
def _newton(hessian: Array, right: Array, is_g: Array) -> Array:
    """-inv(hessian) right, with unit-diagonal scaling and ridges of round-off size for singular cases. Only the lower
    triangle of the Hessian is read. NaN if it is not finite or has no inverse.

    A G that multiplies a real entry of M has no effect and no curvature: its ridge is relative to the largest
    curvature, so that G does not drift by round-off.
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
        for j in range(i):
            A[i, j] = A[j, i] = hessian[i, j] * d[i] * d[j]
        A[i, i] = hessian[i, i] * d[i] ** 2 + 1e-13 + (1e-11 * top * d[i] ** 2 if is_g[i] else 0.0)
    try:
        return d * np.linalg.solve(A, b)
    except Exception:  # singular to machine precision, or not finite
        return np.full(n, np.nan)


@njit(cache=True)
def _to_centre(
    M: Array, x: Array, lam: float, form: Entries, core: Entries, trace: Array, is_g: Array, settings: PathSettings
) -> Array:
    """Move x (p,) to the analytic centre at lam and return d x / d lambda, the direction of the path of centres.

    The centre minimises trace x - log det F - log det X, with an F for every matrix of M (n_shared, n_z, n_w). NaN on
    failure.
    """
    n_p = trace.size
    gradient, slope, hessian = np.empty(n_p), np.zeros(n_p), np.empty((n_p, n_p))
    T = np.empty((M.shape[0], form.size, form.size), np.complex128)
    for count in range(settings.newton + 1):
        hessian[:] = 0.0
        gradient[:] = trace
        K = _matrix(x, form, lam)
        for s in range(M.shape[0]):
            T[s] = _gram(M[s], _inverse(_residual(M[s], K)))
            _add_derivatives(T[s], form, lam, gradient, hessian)
        _add_derivatives(_inverse(_matrix(x, core, 1.0)), core, 1.0, gradient, hessian)
        step = _newton(hessian, gradient, is_g)
        decrement = np.sqrt(max(-np.dot(step, gradient), 0.0))
        # NaN ends the loop as well; `_inside` detects such problems.
        if not decrement >= settings.central or count == settings.newton:
            break
        x += step * (1.0 if decrement < settings.near else 1.0 / (1.0 + decrement))
    rate = x[form.parameter] * form.value
    for s in range(M.shape[0]):
        _add_slope(T[s], rate, form, lam, slope)
    return _newton(hessian, slope, is_g)


@njit(cache=True)
def _positive(A: Array) -> bool:
    """Whether a Hermitian matrix is positive definite, with a round-off margin; overwrites its lower triangle."""
    least = 0.0
    for i in range(A.shape[0]):
        least = max(least, 1e-14 * A[i, i].real)
    return factor(A, least)


@njit(cache=True)
def _inside(M: Array, x: Array, lam: float, form: Entries, core: Entries) -> bool:
    """Whether F > 0 and X > 0."""
    if not np.all(np.isfinite(x)) or not np.isfinite(_inverse(_matrix(x, core, 1.0))[0, 0].real):
        return False
    K, sound = _matrix(x, form, lam), True
    for s in range(M.shape[0]):
        sound = sound and _positive(_residual(M[s], K))
    return sound


@njit(cache=True)
def _speed(M: Array, x: Array, lam: float, direction: Array, form: Entries, core: Entries) -> float:
    """Frobenius norm of d (F, X) / d lambda along the path, in the metric of F and X. It is an upper bound of the
    largest eigenvalue, whose inverse is the distance to the boundary."""
    K, moved = _matrix(x, form, lam), _matrix(direction, form, lam)
    for e in range(form.row.size):
        if form.on_level[e]:
            moved[form.row[e], form.col[e]] += x[form.parameter[e]] * form.value[e]
    Y = np.dot(_inverse(_matrix(x, core, 1.0)), _matrix(direction, core, 1.0))
    total = np.sum((Y * Y.T).real)
    for s in range(M.shape[0]):
        Y = np.dot(_inverse(_residual(M[s], K)), _residual(M[s], moved))
        total += np.sum((Y * Y.T).real)
    return np.sqrt(max(total, 0.0))


@njit(cache=True)
def follow_path(
    M: Array,
    theta: Array,
    lam: Array,
    floor: Array,
    form: Entries,
    core: Entries,
    trace: Array,
    is_g: Array,
    tolerance: float,
    settings: PathSettings,
) -> None:
    """Move scalings theta (B, p) and levels lam (B,) in place along the path of centres down to the minimum level or to
    `floor` (B,); each pair remains feasible.

    M (B, n_shared, n_z, n_w) complex; form and core are Entries of F and X. Ends when the distance to the boundary is
    below `tolerance` lambda, or at the analytic centre when a positive floor is reached.
    """
    for b in range(M.shape[0]):
        x = theta[b].copy()
        for _ in range(settings.steps):
            at = lam[b]
            direction = _to_centre(M[b], x, at, form, core, trace, is_g, settings)
            if not np.all(np.isfinite(direction)) or not _inside(M[b], x, at, form, core):
                # Round-off ends the path here; the last verified point is kept.
                break
            theta[b] = x
            if floor[b] > 0 and at <= floor[b]:
                break
            whole = at - max(floor[b], 0.0)
            fall = min(whole, settings.first / max(_speed(M[b], x, at, direction, form, core), 1e-300))
            # F contains lambda times the scalings, so that the line may leave the set and enter it again: the point
            # that is used is checked, and one further on, which keeps it away from the boundary.
            for _ in range(40):
                step = fall if fall >= whole else settings.reach * fall
                if _inside(M[b], x - fall * direction, at - fall, form, core) and (
                    step == fall or _inside(M[b], x - step * direction, at - step, form, core)
                ):
                    break
                fall *= settings.shrink
            else:
                break
            last = fall <= tolerance * at
            fall = step
            x -= fall * direction
            lam[b] = at - fall
            theta[b] = x
            if last:
                break
