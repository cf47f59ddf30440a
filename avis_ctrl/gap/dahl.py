"""Dahl friction: a spring before slip, a constant force after it (P. R. Dahl, A solid friction model, 1968)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def dahl(deflection: np.ndarray, last: np.ndarray, slip: float, state: np.ndarray) -> np.ndarray:
    """(samples, m) friction force over stiffness [m] for a deflection (samples, m), exact between samples.

    While the motion keeps its direction, f approaches +-slip as exp(-|dx|/slip). last, state : (m,) deflection and
    force over stiffness before the first sample.
    """
    n, m = deflection.shape
    out = np.empty((n, m))
    for j in range(m):
        f, before = state[j], last[j]
        for k in range(n):
            step = deflection[k, j] - before
            before = deflection[k, j]
            end = slip if step > 0 else -slip
            f = end + (f - end) * np.exp(-abs(step) / slip)
            out[k, j] = f
    return out
