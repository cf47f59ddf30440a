"""Series, parallel and feedback connection, and inverse, of quadruples (A, B, C, D).

The internal signals, at A, can be closed by integrators or by uncertain elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

Quadruple = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class ScalingSettings:
    """sweeps : number of times that rows and columns are scaled: the first removes the units, the others change
    little."""

    sweeps: int = 3


SETTINGS = ScalingSettings()


def series(X: Quadruple, Y: Quadruple) -> Quadruple:
    """X Y, the outputs of Y connected to the inputs of X; the internal signals of X come first."""
    (A, B, C, D), (a, b, c, d) = X, Y
    return (
        np.block([[A, B @ c], [np.zeros((a.shape[0], A.shape[1])), a]]),
        np.vstack([B @ d, b]),
        np.hstack([C, D @ c]),
        D @ d,
    )


def parallel(X: Quadruple, Y: Quadruple) -> Quadruple:
    """X + Y."""
    (A, B, C, D), (a, b, c, d) = X, Y
    return la.block_diag(A, a), np.vstack([B, b]), np.hstack([C, c]), D + d


def return_difference(X: Quadruple, Y: Quadruple, sign: int) -> np.ndarray:
    """I - sign D_X D_Y, (n_y, n_y); `feedback` inverts it."""
    return np.eye(X[3].shape[0]) - sign * X[3] @ Y[3]


def feedback(X: Quadruple, Y: Quadruple, sign: int) -> Quadruple:
    """Closed loop from r to y with y = X u, u = r + sign Y y."""
    (A, B, C, D), (a, b, c, d) = X, Y
    # y and u as functions of the internal signals of X and Y, and of r.
    y = np.linalg.inv(return_difference(X, Y, sign)) @ np.hstack([C, sign * D @ c, D])
    u = sign * d @ y
    u[:, A.shape[1] :] += np.hstack([sign * c, np.eye(D.shape[1])])
    out, n = np.vstack([B @ u, b @ y]), A.shape[1] + a.shape[1]
    out[:, :n] += la.block_diag(A, a)
    return out[:, :n], out[:, n:], y[:, :n], y[:, n:]


def scaled_condition(D: np.ndarray) -> float:
    """Condition number of a square matrix with rows and columns scaled to similar size, so that their units do not
    matter."""
    for _ in range(SETTINGS.sweeps):
        for axis in (1, 0):
            size = np.linalg.norm(D, axis=axis, keepdims=True)
            D = D / np.where(size > 0, size, 1.0)
    return float(np.linalg.cond(D))


def inverse(X: Quadruple) -> Quadruple:
    """X^-1; D must be invertible."""
    A, B, C, D = X
    inv = np.linalg.inv(D)
    return A - B @ inv @ C, B @ inv, -inv @ C, inv
