"""The upper bound of mu as it is written on paper, for cvxpy and Clarabel: slow, and independent of `mu_lmi`."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.robust.mu import checked
from avis_ctrl.robust.mu_lmi import Array
from avis_ctrl.uncertainty.blocks import Block, BlockStructure


def mu_upper_by_bisection(M: Array, blocks: BlockStructure | Sequence[Block], tolerance: float = 1e-4) -> float:
    """Least beta (to a relative tolerance) with M^H X_z M + j (G M - M^H G^H) <= beta^2 X_w, one matrix (n_z, n_w).

    Bisection between 0 and the largest singular value over LMIs that minimise the largest eigenvalue of the left
    side less the right one, with trace X = its size.

    Raises
    ------
    InputError : shapes that do not fit. ComputationError : the solver failed.
    """
    import cvxpy as cp

    stack, structure = checked(M, blocks)
    matrix = stack[0]
    size = float(np.linalg.norm(matrix, 2))
    if size == 0.0:
        return 0.0
    matrix = matrix / size
    beta2 = cp.Parameter(nonneg=True)
    X_w, X_z, G = _variables(structure)
    margin = cp.Variable()
    left = matrix.conj().T @ X_z @ matrix + 1j * (G @ matrix - (G @ matrix).H) - beta2 * X_w
    hermitian = (left + left.H) / 2
    constraints = [
        hermitian << margin * np.eye(structure.n_w),
        cp.real(cp.trace(X_w)) == structure.n_w,
        X_w >> 1e-9 * np.eye(structure.n_w),
    ]
    problem = cp.Problem(cp.Minimize(margin), constraints)
    low, high = 0.0, 1.0
    while high - low > tolerance * high and high > 1e-6:
        beta = (low + high) / 2
        beta2.value = beta**2
        with warnings.catch_warnings():
            # The margin tends to zero as the bisection closes in: its sign is what is asked, not its digits.
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
        if problem.status not in ("optimal", "optimal_inaccurate"):
            raise ComputationError("the LMI of mu was not solved", measured=f"status {problem.status}")
        low, high = (low, beta) if float(problem.value) < 0 else (beta, high)
    return high * size


def _variables(structure: BlockStructure) -> tuple[Any, Any, Any]:
    """X_w (n_w, n_w), X_z (n_z, n_z) and G (n_w, n_z) as cvxpy expressions."""
    import cvxpy as cp

    X_w: Any = 0
    X_z: Any = 0
    G: Any = cp.Constant(np.zeros((structure.n_w, structure.n_z)))
    for block, w, z in structure.slices():
        E_w, E_z = np.eye(structure.n_w)[:, w], np.eye(structure.n_z)[:, z]
        if block.kind == "full":
            x = cp.Variable()
            X_w, X_z = X_w + x * (E_w @ E_w.T), X_z + x * (E_z @ E_z.T)
            continue
        X = cp.Variable((block.rows, block.rows), hermitian=True)
        X_w, X_z = X_w + E_w @ X @ E_w.T, X_z + E_z @ X @ E_z.T
        if block.kind == "real":
            G = G + E_w @ cp.Variable((block.rows, block.rows), hermitian=True) @ E_z.T
    return X_w, X_z, G
