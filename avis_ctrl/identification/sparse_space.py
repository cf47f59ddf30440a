"""Sparse bases of subspaces of parameters, which make a null space readable.

A subspace is given by any basis of it. Its reduced row echelon form with complete pivoting splits it into parts without
common parameters (the connected components of a matroid are those of the graph of its fundamental circuits: Oxley,
Matroid Theory, 2nd ed., 2011, section 4.1). Within a part the vectors of fewest entries are its circuits, found by
setting all but one of the dimensions to zero in turn; if there are too many of them, the echelon form itself is the
result.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import scipy.linalg as la
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class SparseSpaceSettings:
    """most_circuits : candidates for circuits of a part, above which its echelon form is used; each takes 0.1 ms."""

    most_circuits: int = 3000


SETTINGS = SparseSpaceSettings()


def reduced_rows(basis: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
    """Reduced row echelon form, (d, n), of the columns of basis (n, d): row k has 1 at its pivot, where all other rows
    have 0.

    Entries below the tolerance, relative to the largest of their row, are zero.
    """
    rows = np.array(basis, float).T
    _, R, order = la.qr(rows, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    rank = int(np.count_nonzero(size > len(order) * np.finfo(float).eps * np.max(size, initial=0.0)))
    found = np.zeros((rank, rows.shape[1]))
    found[:, order] = la.solve_triangular(R[:rank, :rank], R[:rank])
    return _cleaned(found, tolerance)


def components(rows: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """Parts without common columns: (rows, columns) of each, columns ascending, parts by their first column."""
    count, of = connected_components((rows != 0).astype(int) @ (rows != 0).T.astype(int), directed=False)
    parts = [np.flatnonzero(of == k) for k in range(count)]
    return sorted(
        ((part.tolist(), np.flatnonzero(np.any(rows[part], axis=0)).tolist()) for part in parts),
        key=lambda part: part[1],
    )


def sparse_rows(basis: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
    """(d, n) rows of few entries that span the columns of basis (n, d); the largest entry of a row is 1."""
    rows = reduced_rows(basis, tolerance)
    found = []
    for members, columns in components(rows):
        part = rows[np.ix_(members, columns)]
        full = np.zeros((len(members), rows.shape[1]))
        full[:, columns] = _circuits(part, tolerance)
        found.append(full)
    return np.concatenate(found) if found else rows


def _circuits(part: np.ndarray, tolerance: float) -> np.ndarray:
    d, n = part.shape
    if d == 1 or math.comb(n, d - 1) > SETTINGS.most_circuits:
        return part / np.max(np.abs(part), axis=1, keepdims=True)
    candidates = []
    orthonormal = np.linalg.qr(part.T)[0]
    for zeros in itertools.combinations(range(n), d - 1):
        _, size, Vh = np.linalg.svd(orthonormal[list(zeros)])
        if size[-1] > tolerance:
            row = orthonormal @ Vh[-1]
            candidates.append(_cleaned((row / row[np.argmax(np.abs(row))])[None], tolerance)[0])
    # Fewest entries first; of equally many, the most even.
    candidates.sort(key=lambda row: (np.count_nonzero(row), -round(float(np.sum(np.abs(row))), 6)))
    chosen: list[np.ndarray] = []
    for row in candidates:
        trial = np.array([*chosen, row / np.linalg.norm(row)])
        if np.linalg.svd(trial, compute_uv=False)[-1] > 1e-4:
            chosen.append(trial[-1])
        if len(chosen) == d:
            break
    if len(chosen) < d:
        return part
    found = np.array(chosen)
    return found / np.max(np.abs(found), axis=1, keepdims=True)


def whole_numbers(row: np.ndarray, largest: int = 12, tolerance: float = 1e-4) -> np.ndarray:
    """The row in whole numbers if a factor makes it so; otherwise with its largest entry 1. First entry positive."""
    inside = np.flatnonzero(row)
    if not inside.size:
        return row
    unit = row / np.min(np.abs(row[inside]))
    fractions = [Fraction(float(value)).limit_denominator(largest) for value in unit]
    common = math.lcm(*(f.denominator for f in fractions))
    near = all(
        abs(float(f) - value) <= tolerance * max(1.0, abs(value)) for f, value in zip(fractions, unit, strict=True)
    )
    if near and max(abs(f * common) for f in fractions) <= largest**2:
        found = np.array([float(f * common) for f in fractions])
        found /= math.gcd(*(int(value) for value in found))
    else:
        found = row / np.max(np.abs(row))
    return found * np.sign(found[inside[0]])


def _cleaned(rows: np.ndarray, tolerance: float) -> np.ndarray:
    if not rows.size:
        return rows
    return np.where(np.abs(rows) > tolerance * np.max(np.abs(rows), axis=1, keepdims=True), rows, 0.0)
