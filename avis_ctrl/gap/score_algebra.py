"""Least squares of the score test, and symmetric matrices as vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.identification.response import N_Q

SYMMETRIC = tuple((i, j) for i in range(N_Q) for j in range(i, N_Q))


@dataclass(frozen=True)
class Reduction:
    """Of chi2 by a set of directions: how much, how many directions the data determine, and their coefficients."""

    chi2: float
    rank: int
    coefficients: np.ndarray


def reduction(G: np.ndarray, b: np.ndarray) -> Reduction:
    """b^T inv(G) b over what G determines."""
    size = np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(G / np.outer(size, size))
    known = values > 1e-9 * max(values[-1], 1e-300)
    along = vectors.T @ (b / size)
    step = np.where(known, along / np.where(known, values, 1.0), 0.0)
    return Reduction(float(along @ step), int(known.sum()), vectors @ step / size)


def symmetric_coordinates(S: np.ndarray) -> np.ndarray:
    """(..., 21) of symmetric matrices (..., 6, 6): coefficients of the unit matrices e_i e_j^T + e_j e_i^T."""
    rows, columns = np.array(SYMMETRIC).T
    return S[..., rows, columns]
