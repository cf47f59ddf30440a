"""Exact reduction of the number of copies of repeated scalars in an LFT.

M with blocks delta_k I is a multidimensional realisation, with delta_k in place of 1/s. In each block, directions that
cannot be reached from an input (directly or through other blocks) and then directions that cannot be observed at an
output are removed: the Kalman decomposition with one subspace per block (D'Andrea and Khatri 1997, Kalman decomposition
of linear fractional transformation representations and minimality). The result is exact, and minimal for parameters
that do not commute.
"""

from __future__ import annotations

import numpy as np

from avis_ctrl.lti.realisation import balance, reached
from avis_ctrl.lti.statespace import StateSpace


def reduce_copies(M: np.ndarray, sizes: list[int], tolerance: float = 1e-10) -> tuple[np.ndarray, list[int]]:
    """M (n_delta + p, n_delta + m) with leading square blocks of these sizes -> the same LFT with smaller blocks."""
    n = sum(sizes)
    # Diagonal scalings of the copies commute with Delta.
    system = balance(StateSpace(M[:n, :n], M[:n, n:], M[n:, :n], M[n:, n:]))
    A, B, C = system.A, system.B, system.C
    # Limits relative to the given LFT, so that the round-off of a vanishing output is not taken for a direction.
    size = float(np.linalg.norm(A, 2)) if n else 0.0
    limits = [tolerance * max(size, float(np.linalg.norm(one, 2)) if one.size else 0.0) for one in (B, C)]
    V, left = reached(A, B, sizes, (limits[0],) * 2)
    A, B, C = V.T @ A @ V, V.T @ B, C @ V
    W, left = reached(A.T, C.T, left, (limits[1],) * 2)
    if left == list(sizes):
        return M, left
    return np.block([[W.T @ A @ W, W.T @ B], [C @ W, system.D]]), left
