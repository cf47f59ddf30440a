"""Fewer copies of each repeated scalar in an LFT, without changing it.

Seen from one block delta I with all others left open, the LFT is F_u(M, delta I): a one-parameter realisation
with delta where a dynamic system has 1/s. What delta does not reach, or what cannot be seen of it, is
removed as in the Kalman decomposition, block after block, until none shrinks (Zhou, Doyle and Glover, Robust
and Optimal Control, section 10.4; D'Andrea and Khatri 1997 for the several-parameter case: the result need not be
minimal, but it is exact).
"""

from __future__ import annotations

import numpy as np

from avis_ctrl.lti.realisation import minimal
from avis_ctrl.lti.statespace import StateSpace


def reduce_copies(M: np.ndarray, sizes: list[int]) -> tuple[np.ndarray, list[int]]:
    """M (n_delta + p, n_delta + m) with leading square blocks of the given sizes -> the same LFT, smaller blocks."""
    sizes = list(sizes)
    shrunk = True
    while shrunk:
        shrunk = False
        for k in range(len(sizes)):
            start, stop = sum(sizes[:k]), sum(sizes[:k + 1])
            inside = np.arange(start, stop)
            rows, cols = np.delete(np.arange(M.shape[0]), inside), np.delete(np.arange(M.shape[1]), inside)
            one = StateSpace(M[np.ix_(inside, inside)], M[np.ix_(inside, cols)], M[np.ix_(rows, inside)],
                             M[np.ix_(rows, cols)])
            small = minimal(one, 1e-10)
            if small.nstates == one.nstates:
                continue
            shrunk = True
            n = small.nstates
            new = np.zeros((M.shape[0] - len(inside) + n, M.shape[1] - len(inside) + n))
            own = np.arange(start, start + n)
            other_rows, other_cols = np.delete(np.arange(new.shape[0]), own), np.delete(np.arange(new.shape[1]), own)
            new[np.ix_(own, own)], new[np.ix_(own, other_cols)] = small.A, small.B
            new[np.ix_(other_rows, own)], new[np.ix_(other_rows, other_cols)] = small.C, small.D
            M, sizes[k] = new, n
    return M, sizes
