"""Exact reduction of the number of copies of repeated scalars in an LFT.

M with blocks delta_k I is a multidimensional realisation, with delta_k in place of 1/s. In each block, directions that
cannot be reached from an input (directly or through other blocks) and then directions that cannot be observed at an
output are removed: the Kalman decomposition with one subspace per block (D'Andrea and Khatri 1997, Kalman decomposition
of linear fractional transformation representations and minimality). The result is exact, and minimal for parameters
that do not commute.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from avis_ctrl.lti.realisation import balance
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
    V, reached = _reached(A, B, sizes, limits[0])
    A, B, C = V.T @ A @ V, V.T @ B, C @ V
    W, left = _reached(A.T, C.T, reached, limits[1])
    if left == list(sizes):
        return M, left
    return np.block([[W.T @ A @ W, W.T @ B], [C @ W, system.D]]), left


def _reached(A: np.ndarray, B: np.ndarray, sizes: list[int], limit: float) -> tuple[np.ndarray, list[int]]:
    """Smallest orthonormal block-diagonal V whose range contains B and A V, and its number of columns per block.

    limit : singular values up to this limit are round-off.
    """
    ends = [0, *np.cumsum(sizes)]
    blocks = [slice(start, stop) for start, stop in pairwise(ends)]
    bases = [np.zeros((size, 0)) for size in sizes]
    step = B
    while True:
        fresh = []
        for k, block in enumerate(blocks):
            new = step[block]
            for _ in range(2):  # twice is enough for orthogonality to round-off
                new = new - bases[k] @ (bases[k].T @ new)
            Q, sigma, _ = np.linalg.svd(new, full_matrices=False)
            Q = Q[:, sigma > limit]
            bases[k] = np.hstack([bases[k], Q])
            fresh.append(A[:, block] @ Q)
        step = np.hstack([np.zeros((A.shape[0], 0)), *fresh])
        if not step.shape[1]:
            break
    V = np.zeros((A.shape[0], sum(basis.shape[1] for basis in bases)))
    columns = [0, *np.cumsum([basis.shape[1] for basis in bases])]
    for block, basis, (start, stop) in zip(blocks, bases, pairwise(columns), strict=True):
        V[block, start:stop] = basis
    return V, [basis.shape[1] for basis in bases]
