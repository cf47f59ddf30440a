"""Upper bounds of mu and skewed mu from the scalings of `mu_lmi`: initialisation, normalisation, final check.

The reported value is always recomputed from the final scalings by an eigenvalue computation. It is therefore an upper
bound even if the optimisation did not converge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avis_ctrl.robust.mu_diagonal_kernel import balanced_squares, follow_diagonal, level_squares
from avis_ctrl.robust.mu_kernel import SETTINGS as PATH
from avis_ctrl.robust.mu_lmi import Array, LmiScalings, ScalingSpace, follow, joined, least_level, selected
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class UpperBoundSettings:
    """batch_bytes : memory of the matrices that are processed together.
    worth : with many blocks, the full bound is computed only for matrices whose bound with one number per block exceeds
        this fraction of the largest bound.
    most_decades : maximum distance of a squared scaling from the middle of the range, in decades: chains of blocks that
        are closed only by round-off would need a range beyond that of floating-point numbers.
    room : a search that starts from scalings that prove a level begins at this multiple of the squared level.
    bisections : maximum number of trial gains in the bisection for skewed mu.
    negligible : gain relative to the norm of the performance rows below which skewed mu need not be resolved.
    """

    batch_bytes: float = 64e6
    worth: float = 0.97
    most_decades: float = 80.0
    room: float = 1.1
    bisections: int = 60
    negligible: float = 1e-9


SETTINGS = UpperBoundSettings()


class UpperBound(NamedTuple):
    """beta (B,) and the scalings that prove it."""

    beta: Array
    scalings: LmiScalings


def block_balance(M: Array, structure: BlockStructure, goal: Array | float = 0.0, sweeps: int = 20) -> Array:
    """Osborne's scaling: d (B, n_blocks) > 0 that balances the block norms of M (B, n_shared, n_z, n_w); norms below
    goal (B,) need no scaling."""
    power = np.sum(np.abs(M) ** 2, axis=1)
    places = list(structure.slices())
    rows = np.stack([power[:, z].sum(axis=1) for _, _, z in places], axis=1)
    norm2 = np.stack([rows[:, :, w].sum(axis=2) for _, w, _ in places], axis=2)
    n = len(places)
    norm2[:, np.arange(n), np.arange(n)] = 0.0
    # First remove the effect of the signal units, because the floor below is relative to the largest entry.
    goal2 = np.broadcast_to(np.square(goal), M.shape[:1]).astype(float)
    units = level_squares(norm2, goal2, SETTINGS.most_decades * np.log(10.0))
    norm2 = norm2 * units[:, :, None] / units[:, None, :]
    # A floor keeps the scaling finite if a block is not coupled in both directions.
    norm2 = norm2 + 1e-16 * np.max(norm2, axis=(1, 2), initial=0.0)[:, None, None] + 1e-300
    d2 = units * balanced_squares(norm2, sweeps)
    return np.sqrt(d2 / np.exp(np.mean(np.log(d2), axis=1, keepdims=True)))


def expand(structure: BlockStructure, d: Array) -> tuple[Array, Array]:
    """Per-entry scalings (d_z (B, n_z), d_w (B, n_w)) from one number per block."""
    return (
        np.repeat(d, [b.cols for b in structure.blocks], axis=1),
        np.repeat(d, [b.rows for b in structure.blocks], axis=1),
    )


def rescaled(scalings: LmiScalings, d_z: Array, d_w: Array, size: Array) -> LmiScalings:
    """Convert scalings of diag(d_z) M / diag(d_w) / size to scalings of M."""
    return LmiScalings(
        d_z[:, :, None] * scalings.X_z * d_z[:, None, :],
        d_w[:, :, None] * scalings.X_w * d_w[:, None, :],
        size[:, None, None] * d_w[:, :, None] * scalings.G * d_z[:, None, :],
    )


def upper_bound(
    M: Array,
    structure: BlockStructure,
    tolerance: float = 1e-5,
    goal: Array | float = 0.0,
    start: UpperBound | None = None,
) -> UpperBound:
    """Minimum beta with scalings that prove mu <= beta, for M (B, n_shared, n_z, n_w).

    Matrices along axis 1 share scalings. With `goal` > 0 the search stops when beta <= goal, at the analytic centre of
    the scalings that prove it, where the margin is largest. start : initial bound whose scalings fit `structure`, such
    as the bound of the simplified blocks.
    """
    goals = np.broadcast_to(goal, M.shape[:1])
    if _is_diagonal(structure):
        return _upper_chunk(M, structure, tolerance, goals)
    n_chunk = max(1, int(SETTINGS.batch_bytes / (32 * ScalingSpace.of(structure).form.row.size ** 2 * M.shape[1])))
    chunks = [np.arange(k, min(k + n_chunk, M.shape[0])) for k in range(0, M.shape[0], n_chunk)]
    return joined(
        [
            _upper_chunk(M[at], structure, tolerance, goals[at], None if start is None else selected(start, at))
            for at in chunks
        ]
    )


def bound_for_goal(M: Array, structure: BlockStructure, tolerance: float, goal: float) -> UpperBound:
    """`upper_bound` with a goal > 0; with many blocks, full scalings only if one number per block misses the goal."""
    if not structure.many:
        return upper_bound(M, structure, tolerance, goal)
    found = upper_bound(M, structure.simplified(), tolerance, goal)
    if (left := np.flatnonzero(found.beta >= goal)).size:
        _replace(found, left, upper_bound(M[left], structure, tolerance, goal, selected(found, left)))
    return found


def bound_of_peak(M: Array, structure: BlockStructure, tolerance: float) -> UpperBound:
    """`upper_bound`; with many blocks, full scalings only for the matrices that can determine the largest bound."""
    if not structure.many:
        return upper_bound(M, structure, tolerance)
    found, full = upper_bound(M, structure.simplified(), tolerance), np.zeros(M.shape[0], bool)
    while not full[np.argmax(found.beta)]:
        left = np.flatnonzero(~full & (found.beta >= SETTINGS.worth * np.max(found.beta)))
        _replace(found, left, upper_bound(M[left], structure, tolerance, start=selected(found, left)))
        full[left] = True
    return found


def _replace(found: UpperBound, which: Array, better: UpperBound) -> None:
    for whole, new in zip((found.beta, *found.scalings), (better.beta, *better.scalings), strict=True):
        whole[which] = new


def _upper_chunk(
    M: Array, structure: BlockStructure, tolerance: float, goal: Array, start: UpperBound | None = None
) -> UpperBound:
    d_z, d_w = expand(structure, block_balance(M, structure, goal))
    balanced = M * d_z[:, None, :, None] / d_w[:, None, None, :]
    size = np.max(np.linalg.norm(balanced, ord=2, axis=(2, 3)), axis=1)
    live = size > 0
    # Values below the goal need not be resolved.
    size = np.where(live, np.maximum(size, goal), 1.0)
    unit = balanced / size[:, None, None, None]
    floor = np.where(goal > 0, (goal / size) ** 2, -1e-8)
    if _is_diagonal(structure):
        scalings = _diagonal(unit, structure, live, floor, tolerance)
    else:
        space = ScalingSpace.of(structure)
        theta, lam = space.identity(M.shape[0]), np.full(M.shape[0], 2.0)
        if start is not None:
            theta = space.theta(rescaled(start.scalings, 1 / d_z, 1 / d_w, 1 / size))
            theta = theta * (space.core.size / (theta @ space.trace))[:, None]
            lam = SETTINGS.room * (start.beta / size) ** 2
        if np.any(live):
            found, _ = follow(space, unit[live], theta[live], lam[live], floor[live], tolerance)
            theta[live] = found
        scalings = space.scalings(theta)
    lam = np.where(live, least_level(unit, scalings, np.ones(structure.n_w, bool)), 0.0)
    beta = size * np.sqrt(np.maximum(lam, 0.0))
    return UpperBound(beta, rescaled(scalings, d_z, d_w, size))


def _is_diagonal(structure: BlockStructure) -> bool:
    """Whether the scaling of every block is a single number."""
    return all(block.kind == "full" or (block.kind == "complex" and block.rows == 1) for block in structure.blocks)


def _diagonal(M: Array, structure: BlockStructure, live: Array, floor: Array, tolerance: float) -> LmiScalings:
    """Scalings of one number per block, by the compiled path; 1 where M is zero (not live)."""
    of_z, of_w = (
        np.repeat(np.arange(len(structure.blocks)), sizes)
        for sizes in zip(*((b.cols, b.rows) for b in structure.blocks), strict=True)
    )
    p = np.ones((M.shape[0], len(structure.blocks)))
    if np.any(live):
        p[live], _ = follow_diagonal(
            np.ascontiguousarray(M[live]), of_z, of_w, p[0], np.full(live.sum(), 2.0), floor[live], tolerance / 5, PATH
        )
    X_z, X_w = (p[:, of, None] * np.eye(of.size, dtype=complex) for of in (of_z, of_w))
    return LmiScalings(X_z, X_w, np.zeros((M.shape[0], of_w.size, of_z.size), complex))


def skewed_upper_bound(M: Array, structure: BlockStructure, tolerance: float = 1e-5) -> UpperBound:
    """Minimum upper bound beta of the gain of the performance channel (last block) if the other blocks have norm 1.

    M (B, n_shared, n_z, n_w). beta = inf if the scalings cannot prove robust stability (the upper bound of mu of the
    other blocks is not below 1).

    The gain is below g if and only if mu of M with the performance rows divided by g is below 1 (main loop theorem). g
    is found by bisection. Scalings that prove mu < 1 also prove a bound of the gain. Where the bound of mu is
    beta > 1, the bound of the gain is at least beta g.
    """
    robust = BlockStructure(structure.blocks[:-1])
    r_w, r_z = robust.n_w, robust.n_z
    if not r_w:
        return upper_bound(M, structure, tolerance)
    batch = M.shape[0]
    shapes = ((structure.n_z,) * 2, (structure.n_w,) * 2, (structure.n_w, structure.n_z))
    found = UpperBound(np.full(batch, np.inf), LmiScalings(*(np.zeros((batch, *shape), complex) for shape in shapes)))
    if not batch:
        return found
    least = np.max(np.linalg.norm(M[:, :, r_z:, r_w:], ord=2, axis=(2, 3)), axis=1)
    most = np.full(batch, np.inf)
    unit = np.max(np.linalg.norm(M[:, :, r_z:], axis=(2, 3)), axis=1)
    unit = np.where(unit > 0, unit, 1.0)
    least, trial = np.maximum(least, SETTINGS.negligible * unit), np.where(least > 0, 2 * least, unit)
    inner = bound_for_goal(M[:, :, :r_z, :r_w], robust, tolerance, 1.0 - 1e-9).beta
    left = np.flatnonzero(inner < 1.0)
    for _ in range(SETTINGS.bisections):
        if not left.size:
            break
        g = trial[left]
        scaled = M[left].copy()
        scaled[:, :, r_z:] /= g[:, None, None, None]
        bound = bound_for_goal(scaled, structure, tolerance, 1.0)
        gain = g * np.sqrt(np.maximum(_level_of_performance(scaled, structure, bound.scalings), 0.0))
        better = gain < most[left]
        for scaling, side in ((bound.scalings.X_z, r_z), (bound.scalings.X_w, r_w)):
            scaling[:, side:, side:] /= g[:, None, None] ** 2
        _replace(found, left[better], selected(UpperBound(gain, bound.scalings), better))
        most[left] = np.minimum(most[left], gain)
        least[left] = np.where(bound.beta > 1, np.maximum(least[left], bound.beta * g), least[left])
        left = left[most[left] > (1 + tolerance) * least[left]]
        bounded = np.isfinite(most[left])
        trial[left] = np.where(bounded, np.sqrt(least[left] * most[left]), 10 * trial[left])
    return found


def _level_of_performance(M: Array, structure: BlockStructure, scalings: LmiScalings) -> Array:
    """`least_level` (B,) of the last block at level 1 of the others, in coordinates in which X is near the identity:
    round-off must not hide that the other blocks are robustly stable."""
    d = np.stack(
        [
            np.sqrt(np.trace(scalings.X_w[:, w, w], axis1=1, axis2=2).real / (w.stop - w.start))
            for _, w, _ in structure.slices()
        ],
        axis=1,
    )
    d_z, d_w = expand(structure, d)
    unit = M * d_z[:, None, :, None] / d_w[:, None, None, :]
    performance = np.arange(structure.n_w) >= structure.n_w - structure.blocks[-1].rows
    return least_level(unit, rescaled(scalings, 1 / d_z, 1 / d_w, np.ones(len(M))), performance)
