"""Fewer copies of each repeated scalar in an LFT, without changing it.

M with blocks delta_k I is a realisation in several parameters, delta_k in place of 1/s. Directions of a block that no
input reaches, directly or through the other blocks, and then those that no output sees, are removed: the
Kalman decomposition with one subspace a block (D'Andrea and Khatri 1997, Kalman decomposition of linear fractional
transformation representations and minimality). The result is exact, and minimal as long as products of
different parameters are not exchanged.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from avis_ctrl.lti.realisation import balance
from avis_ctrl.lti.statespace import StateSpace


def reduce_copies(M: np.ndarray, sizes: list[int], tolerance: float = 1e-10) -> tuple[np.ndarray, list[int]]:
    """M (n_delta + p, n_delta + m) with leading square blocks of the given sizes -> the same LFT, smaller blocks."""
    n = sum(sizes)
    # Diagonal scalings of the copies commute with Delta.
    system = balance(StateSpace(M[:n, :n], M[:n, n:], M[n:, :n], M[n:, n:]))
    A, B, C = system.A, system.B, system.C
    # Relative to the LFT as given: what is left of an output that sees nothing is round-off, not a direction.
    size = float(np.linalg.norm(A, 2)) if n else 0.0
    limits = [tolerance * max(size, float(np.linalg.norm(one, 2)) if one.size else 0.0) for one in (B, C)]
    V, reached = _reached(A, B, sizes, limits[0])
    A, B, C = V.T @ A @ V, V.T @ B, C @ V
    W, left = _reached(A.T, C.T, reached, limits[1])
    if left == list(sizes):
        return M, left
    return np.block([[W.T @ A @ W, W.T @ B], [C @ W, system.D]]), left


def _reached(A: np.ndarray, B: np.ndarray, sizes: list[int], limit: float) -> tuple[np.ndarray, list[int]]:
    """Orthonormal block-diagonal V, smallest with range B and A V inside, and its number of columns a block.

    limit : singular value up to which a direction counts as round-off.
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
