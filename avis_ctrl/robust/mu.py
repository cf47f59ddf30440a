"""Structured singular value of matrices: bounds with their proofs.

    w = Delta z,  z = M w:    mu(M) = 1 / min{ ||Delta|| : det(I - M Delta) = 0 },  0 if there is no such Delta.

The upper bound comes with the scalings that prove it, the lower bound with a perturbation that makes I - M Delta
singular. Both bounds are recomputed from the returned scalings and perturbation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.robust.mu_lmi import Array
from avis_ctrl.robust.mu_lower import lower_bound
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.one_thread import one_thread
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.blocks import Block, BlockStructure


@dataclass(frozen=True, eq=False, repr=False)
class MuBounds(Shown):
    """Bounds of mu with their proofs; arrays have a leading frequency axis if M has one.

    upper, lower : scalar or (n_omega,); lower is 0 if no singular perturbation was found (mu itself may be 0).
    D, D_w : (.., n_z, n_z) and (.., n_w, n_w), Hermitian positive definite, commuting with Delta.
    G : (.., n_w, n_z), Hermitian on each real block, zero elsewhere.
    delta : (.., n_w, n_z) with the block structure, ||delta|| = 1/lower and I - M delta singular. If lower is 0, delta
        is None for a single M, and has NaN entries in a stack.

    M^H D^2 M + j (G M - M^H G^H) <= upper^2 D_w^2; without real blocks upper = sigma_max(D M inv(D_w)).
    """

    upper: float | Array
    D: Array
    D_w: Array
    G: Array
    lower: float | Array
    delta: Array | None


def checked(M: Array, blocks: BlockStructure | Sequence[Block]) -> tuple[Array, BlockStructure]:
    """M as complex (n_omega, n_z, n_w) and its block structure; InputError if they do not fit."""
    structure = BlockStructure.of(blocks)
    if not structure.blocks:
        raise InputError("expected at least one block", field="blocks")
    try:
        M = np.asarray(M, complex)
    except (TypeError, ValueError):
        raise InputError("expected a matrix of numbers", field="M") from None
    if M.ndim not in (2, 3):
        raise InputError("expected (n_z, n_w) or (n_omega, n_z, n_w)", field="shape of M", value=M.shape)
    if M.shape[-2:] != (structure.n_z, structure.n_w):
        raise InputError(
            f"the blocks need {structure.n_z} rows (their cols) and {structure.n_w} columns (their rows)",
            field="shape of M",
            value=M.shape[-2:],
        )
    if not np.all(np.isfinite(M)):
        raise InputError("expected finite entries", field="M")
    return M.reshape(-1, *M.shape[-2:]), structure


def mu(M: Array, blocks: BlockStructure | Sequence[Block], tolerance: float = 1e-5) -> MuBounds:
    """Bounds of the structured singular value with the scalings and the perturbation that prove them.

    The lower bound comes from a local search, which can miss the smallest perturbation. The perturbation is verified:
    with M balanced, the smallest singular value of I - M delta is below 1e-9, and an eigenvalue of M delta is within
    1e-6 of 1. For up to three full complex blocks the upper bound is mu.

    Parameters
    ----------
    M : (n_z, n_w) or (n_omega, n_z, n_w) complex; n_z = sum of the blocks' cols, n_w = sum of their rows.
    tolerance : relative accuracy in upper^2 at which the optimisation of the scalings stops.

    Raises
    ------
    InputError : shapes that do not fit the blocks, entries that are not finite.

    Examples
    --------
    Of a positive matrix and complex scalars, mu is the largest eigenvalue (Perron), here (0.8 + sqrt(0.84))/2:

    >>> M, blocks = [[0.5, 2.0], [0.1, 0.3]], [ac.ComplexScalar(1), ac.ComplexScalar(1)]
    >>> bounds = ac.mu(M, blocks)
    >>> round(bounds.lower, 4), round(bounds.upper, 4)
    (0.8583, 0.8583)
    """
    stack, structure = checked(M, blocks)
    if not 0 < tolerance < 1:
        raise InputError("expected a number between 0 and 1", field="tolerance", value=tolerance)
    with one_thread():
        bound = upper_bound(stack[:, None], structure, tolerance)
        found = lower_bound(stack, structure, bound.beta, bound.scalings)
        X_z, X_w, G = bound.scalings
        D, D_w = _root(X_z), _root(X_w)
    if np.ndim(M) == 2:
        lower = float(found.beta[0])
        return MuBounds(float(bound.beta[0]), D[0], D_w[0], G[0], lower, found.delta[0] if lower else None)
    delta = np.where((found.beta > 0)[:, None, None], found.delta, np.nan)
    return MuBounds(bound.beta, D, D_w, G, found.beta, delta)


def _root(X: Array) -> Array:
    """Hermitian square root of positive definite matrices (n_omega, n, n)."""
    values, vectors = np.linalg.eigh(X)
    return (vectors * np.sqrt(values)[:, None, :]) @ np.conj(np.swapaxes(vectors, 1, 2))
