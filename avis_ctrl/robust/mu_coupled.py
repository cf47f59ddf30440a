"""Removal of blocks that are not part of a loop: their z is always zero or their w has no effect, for any Delta.

mu and the worst-case gain do not depend on these blocks. They are identified from the zero pattern of A, B, C, D, so
that round-off has no influence. States that are unreachable or unobservable from the rest are removed as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_lmi import Array
from avis_ctrl.uncertainty.blocks import Block, BlockStructure


@dataclass(frozen=True, eq=False)
class Coupled:
    """The remaining part of N and its blocks, and the indices w (n,), z (m,) of these blocks in the whole Delta."""

    N: StateSpace
    structure: BlockStructure
    whole: BlockStructure
    w: Array
    z: Array

    def restored(self, delta: Array | None) -> Array | None:
        """Delta (n_w, n_z) of all blocks, zero in the removed blocks."""
        if delta is None:
            return None
        full = np.zeros((self.whole.n_w, self.whole.n_z), complex)
        full[np.ix_(self.w, self.z)] = delta
        return full


def coupled(N: StateSpace, structure: BlockStructure) -> Coupled:
    """Remove the blocks without a loop; if no block has one, all are kept. The channels after the blocks are kept."""
    places = list(structure.slices())
    kept = np.ones(len(places), bool)
    while True:
        w, z = _places(places, kept, structure)
        inputs = np.r_[w, structure.n_w : N.ninputs].astype(int)
        outputs = np.r_[z, structure.n_z : N.noutputs].astype(int)
        reached = _spread(N.A != 0, np.any(N.B[:, inputs] != 0, axis=1))
        seen = _spread(N.A.T != 0, np.any(N.C[outputs] != 0, axis=0))
        moved = np.any(N.D[:, inputs] != 0, axis=1) | np.any(N.C[:, reached] != 0, axis=1)
        felt = np.any(N.D[outputs] != 0, axis=0) | np.any(N.B[seen] != 0, axis=0)
        looped = np.array([np.any(moved[iz]) and np.any(felt[iw]) for _, iw, iz in places], bool) & kept
        if not np.any(looped):
            return Coupled(N, structure, structure, *_places(places, np.ones(len(places), bool), structure))
        if np.all(looped == kept):
            break
        kept = looped
    states = reached & seen
    rest = replace(
        N.select(outputs.tolist(), inputs.tolist()),
        A=N.A[np.ix_(states, states)],
        B=N.B[np.ix_(states, inputs)],
        C=N.C[np.ix_(outputs, states)],
        states=(),
    )
    left = BlockStructure(tuple(block for (block, _, _), keep in zip(places, kept, strict=True) if keep))
    return Coupled(rest, left, structure, w, z)


def _places(places: list[tuple[Block, slice, slice]], kept: Array, structure: BlockStructure) -> tuple[Array, Array]:
    w, z = np.zeros(structure.n_w, bool), np.zeros(structure.n_z, bool)
    for (_, iw, iz), keep in zip(places, kept, strict=True):
        w[iw] = z[iz] = keep
    return np.flatnonzero(w), np.flatnonzero(z)


def _spread(linked: Array, start: Array) -> Array:
    """States reachable from the states `start`; linked[i, k]: state k drives state i."""
    reached = start
    while True:
        grown = reached | np.any(linked[:, reached], axis=1)
        if np.all(grown == reached):
            return reached
        reached = grown
