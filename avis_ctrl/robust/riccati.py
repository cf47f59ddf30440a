"""Stabilising solution of a continuous algebraic Riccati equation with an indefinite quadratic term.

    A' X + X A + X R X + Q = 0,     A + R X stable,     Hamiltonian H = [A  R; -Q  -A']

The stable invariant subspace [X1; X2] of H comes from an ordered real Schur form (Laub 1979) after a
symplectic diagonal balancing, and is judged before it is used: eigenvalues on the imaginary axis,
or a subspace that is not Lagrangian, mean that no stabilising solution exists.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from avis_ctrl.lti.norms import symplectic_scale

AXIS_TOLERANCE = 1e-10
LAGRANGIAN_TOLERANCE = 1e-6
INACCURATE = "the Hamiltonian is too badly conditioned for its stable subspace"
ON_AXIS = "the Hamiltonian has eigenvalues on the imaginary axis"


@dataclass(frozen=True)
class RiccatiSolution:
    """X (n, n) symmetric, or None with the reason why there is none.

    semidefinite : whether X >= 0, judged on X1' X2 = X1' X X1, whose entries stay below 1 where X blows up.
    """

    X: np.ndarray | None
    semidefinite: bool
    reason: str = ""


def solve_riccati(A: np.ndarray, R: np.ndarray, Q: np.ndarray) -> RiccatiSolution:
    """The stabilising X of A'X + XA + XRX + Q = 0, with R and Q symmetric (n, n)."""
    n = A.shape[0]
    if n == 0:
        return RiccatiSolution(np.zeros((0, 0)), True)
    scale = symplectic_scale(A, R, Q)
    a, r, q = A / scale[:, None] * scale, R / np.outer(scale, scale), Q * np.outer(scale, scale)
    H = np.block([[a, r], [-q, -a.T]])
    if not np.all(np.isfinite(H)):
        return RiccatiSolution(None, False, "the Hamiltonian overflows")
    T, U, stable = la.schur(H, output="real", sort="lhp")
    poles = _schur_eigenvalues(T)
    on_axis = np.abs(poles.real) <= AXIS_TOLERANCE * np.abs(poles) + 1e-15 * la.norm(H)
    if stable != n or np.any(on_axis):
        return RiccatiSolution(None, False, ON_AXIS)
    X1, X2 = U[:n, :n], U[n:, :n]
    gram = X1.T @ X2
    asymmetry = float(la.norm(gram - gram.T, 2))
    if asymmetry > LAGRANGIAN_TOLERANCE:
        return RiccatiSolution(None, False, INACCURATE)
    lowest = float(la.eigvalsh((gram + gram.T) / 2)[0])
    lu, piv = la.lu_factor(X1.T, check_finite=False)
    if np.min(np.abs(np.diag(lu))) < 1e-15:
        return RiccatiSolution(None, False, "the Riccati solution is infinite")
    X = la.lu_solve((lu, piv), X2.T).T
    X = (X + X.T) / 2 / np.outer(scale, scale)
    # Round-off in the subspace shows in the asymmetry: a negative value of that size proves nothing.
    return RiccatiSolution(X, lowest >= -max(1e-13 * n, 10 * asymmetry))


def _schur_eigenvalues(T: np.ndarray) -> np.ndarray:
    """Eigenvalues of a real quasi-triangular matrix in LAPACK's standard form (equal diagonals in 2 x 2 blocks)."""
    values = np.diag(T).astype(complex)
    for k in np.flatnonzero(np.diag(T, -1)):
        values[k:k + 2] += np.array([1j, -1j]) * np.sqrt(abs(T[k, k + 1] * T[k + 1, k]))
    return values
