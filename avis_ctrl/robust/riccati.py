"""Stabilising solution of a continuous algebraic Riccati equation with an indefinite quadratic term.

    A' X + X A + X R X + Q = 0,     A + R X stable,     Hamiltonian H = [A  R; -Q  -A']

The stable invariant subspace [X1; X2] of H is computed from an ordered real Schur form (Laub 1979) after a symplectic
diagonal balancing. It is checked before use: with eigenvalues on the imaginary axis no stabilising solution exists, and
a subspace that is not Lagrangian is too inaccurate.

If X is singular, the signs of its computed eigenvalues do not show whether X >= 0, because round-off decides them. This
is common, because X vanishes on stable modes that are unobservable in the cost. The test is therefore whether a
negative eigenvalue exceeds the error of X. To first order, an error of the residual between -W and W changes X by at
most E,

    A_c' E + E A_c + W = 0,   A_c = A + R X,

since a stable Lyapunov equation preserves the order of symmetric matrices. Near the minimum gamma X passes through
infinity. There (X - I) inv(X + I), a rotation of the subspace by 45 degrees, stays bounded; X >= 0 if and only if its
eigenvalues lie between -1 and 1.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as la

from avis_ctrl.lti.norms import symplectic_scale
from avis_ctrl.robust.hinf_settings import SETTINGS

INACCURATE = "the Hamiltonian is too badly conditioned for its stable subspace"
ON_AXIS = "the Hamiltonian has eigenvalues on the imaginary axis"


@dataclass(frozen=True)
class RiccatiSolution:
    """X (n, n) symmetric, or None with the reason.

    semidefinite : whether X >= 0, tested on X and on X1' X2 = X1' X X1, whose entries stay below 1 even for infinite X.
    doubtful : X has negative eigenvalues, but none exceeds its error; `semidefinite` is then true.
    omega : (k,) frequencies [rad/s] of the eigenvalues on, or nearest to, the imaginary axis if X is None.
    """

    X: np.ndarray | None
    semidefinite: bool
    reason: str = ""
    doubtful: bool = False
    omega: np.ndarray = field(default_factory=lambda: np.zeros(0))


def solve_riccati(
    A: np.ndarray, R: np.ndarray, Q: np.ndarray, noise: Sequence[np.ndarray] | None = None
) -> RiccatiSolution:
    """Stabilising solution X of A'X + XA + XRX + Q = 0, with R and Q symmetric (n, n).

    noise : error bounds of the entries of A, R and Q, if these were computed themselves.
    """
    n = A.shape[0]
    if n == 0:
        return RiccatiSolution(np.zeros((0, 0)), True)
    scale = symplectic_scale(A, R, Q)
    a, r, q = _rescaled(scale, A, R, Q)
    H = np.block([[a, r], [-q, -a.T]])
    if not np.all(np.isfinite(H)):
        return RiccatiSolution(None, False, "the Hamiltonian overflows")
    T, U, stable = la.schur(H, output="real", sort="lhp")
    poles = _schur_eigenvalues(T)
    on_axis = np.abs(poles.real) <= SETTINGS.axis_tolerance * np.abs(poles) + 1e-15 * la.norm(H)
    angle = np.abs(poles.real) / np.maximum(np.abs(poles), 1e-300)
    nearest = np.unique(np.abs(poles[np.argsort(angle)[:4]].imag))
    if stable != n or np.any(on_axis):
        return RiccatiSolution(None, False, ON_AXIS, omega=nearest)
    X1, X2 = U[:n, :n], U[n:, :n]
    gram = X1.T @ X2
    asymmetry = float(la.norm(gram - gram.T, 2))
    if asymmetry > SETTINGS.lagrangian_tolerance:
        return RiccatiSolution(None, False, INACCURATE, omega=nearest)
    lowest = float(la.eigvalsh((gram + gram.T) / 2)[0])
    lu, piv, _ = la.lapack.dgetrf(X1.T)  # a singular matrix is a valid result here, without a warning
    if np.min(np.abs(np.diag(lu))) < 1e-15:
        return RiccatiSolution(None, False, "the Riccati solution is infinite")
    X = la.lu_solve((lu, piv), X2.T).T
    X = (X + X.T) / 2
    values = la.eigvalsh(X)
    X = X / np.outer(scale, scale)
    # X1' X2 is small if X1 is small (X near infinity), and X is small if the state units are large: both must pass.
    if lowest >= -1e-13 * n and values[0] >= -SETTINGS.negative * values[-1]:
        return RiccatiSolution(X, True)
    error = None
    if noise is not None:
        a, r, q = _rescaled(scale, *noise)
        error = np.block([[a, r], [q, a.T]])
    indefinite = negative_beyond_error(H, U[:, :n], error)
    return RiccatiSolution(X, not indefinite, doubtful=not indefinite)


def _rescaled(d: np.ndarray, A: np.ndarray, R: np.ndarray, Q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, R, Q) for the states x / d; entries and their error bounds scale alike."""
    both = np.outer(d, d)
    return A / d[:, None] * d, R / both, Q * both


def refined(
    A: np.ndarray, R: np.ndarray, Q: np.ndarray, X: np.ndarray, noise: Sequence[np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """X after one Newton step, and E >= 0 with X - E <= exact solution <= X + E to first order in round-off.

    None if A + R X is not stable or a linear equation is singular.
    """
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            X = X + la.solve_continuous_lyapunov((A + R @ X).T, -_residual(A, R, Q, X)[0])
            X = (X + X.T) / 2
            residual, rounding = _residual(A, R, Q, X)
            if noise is not None:
                x, by_A = np.abs(X), noise[0].T @ np.abs(X)
                rounding = rounding + by_A + by_A.T + x @ noise[1] @ x + noise[2]
            E = _error(A + R @ X, np.abs(residual) + rounding)
        except (np.linalg.LinAlgError, ValueError):
            return None
    return None if E is None else (X, E)


def refined_balanced(
    A: np.ndarray, R: np.ndarray, Q: np.ndarray, X: np.ndarray, noise: Sequence[np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """`refined` after a symplectic balancing of the states, which reduces the effect of round-off."""
    d = symplectic_scale(A, R, Q)
    both = np.outer(d, d)
    found = refined(*_rescaled(d, A, R, Q), X * both, None if noise is None else _rescaled(d, *noise))
    return None if found is None else (found[0] / both, found[1] / both)


def _residual(A: np.ndarray, R: np.ndarray, Q: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual of the equation and an entrywise bound of its round-off."""
    a, r, x = np.abs(A), np.abs(R), np.abs(X)
    product = A.T @ X
    size = a.T @ x
    return product + product.T + X @ R @ X + Q, SETTINGS.round_off * (size + size.T + x @ r @ x + np.abs(Q))


def _error(closed: np.ndarray, size: np.ndarray) -> np.ndarray | None:
    """E for a residual error of at most `size` in each entry; it is bounded by the diagonal matrix W of row sums."""
    if not np.all(np.isfinite(closed)) or np.max(la.eigvals(closed).real) >= 0:
        return None
    E = la.solve_continuous_lyapunov(closed.T, -np.diag(np.sum(size, axis=1)))
    return E if np.all(np.isfinite(E)) else None


def negative_beyond_error(H: np.ndarray, basis: np.ndarray, error: np.ndarray | None = None) -> bool:
    """Whether X = X2 inv(X1) has a negative eigenvalue beyond its error; basis = [X1; X2], the stable subspace of H."""
    n = basis.shape[1]
    X1, X2 = basis[:n], basis[n:]
    turn = np.kron(np.array([[1, 1], [-1, 1]]) / np.sqrt(2), np.eye(n))
    for matrix, top, bottom, low, high in ((H, X1, X2, 0.0, np.inf), (turn @ H @ turn.T, X1 + X2, X2 - X1, -1.0, 1.0)):
        A, R, Q = matrix[:n, :n], matrix[:n, n:], -matrix[n:, :n]
        R, Q = (R + R.T) / 2, (Q + Q.T) / 2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", la.LinAlgWarning)
            try:
                X = la.solve(top.T, bottom.T).T
            except (np.linalg.LinAlgError, ValueError):
                continue
        noise = None
        if error is not None:
            # |turn| |error| |turn'| for the rotated basis, error itself for the original one.
            size = error if matrix is H else np.abs(turn) @ error @ np.abs(turn).T
            noise = size[:n, :n], size[:n, n:], size[n:, :n]
        found = refined(A, R, Q, (X + X.T) / 2, noise)
        if found is None:
            continue
        X, E = found
        if _lowest(X + E) < low or -_lowest(E - X) > high:
            return True
    return False


def _lowest(S: np.ndarray) -> float:
    """Upper bound of the smallest eigenvalue of a symmetric matrix: the computed value plus its round-off."""
    values = la.eigvalsh(S)
    return float(values[0] + S.shape[0] * np.finfo(float).eps * max(-values[0], values[-1]))


def _schur_eigenvalues(T: np.ndarray) -> np.ndarray:
    """Eigenvalues of a real quasi-triangular matrix in LAPACK's standard form (equal diagonals in 2 x 2 blocks)."""
    values = np.diag(T).astype(complex)
    for k in np.flatnonzero(np.diag(T, -1)):
        values[k : k + 2] += np.array([1j, -1j]) * np.sqrt(abs(T[k, k + 1] * T[k + 1, k]))
    return values
