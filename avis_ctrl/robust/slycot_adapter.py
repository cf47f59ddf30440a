"""SLICOT routines through slycot, as an independent check: the only module that imports slycot.

The H-infinity norm of every design is recomputed with SLICOT; tests and benchmarks compare bounds of mu.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_lmi import Array
from avis_ctrl.uncertainty.blocks import Block, BlockStructure


def mu_upper_slicot(M: Array, blocks: BlockStructure | Sequence[Block]) -> float:
    """Upper bound of mu of one matrix (n, n) by AB13MD (Fan, Tits and Doyle's method).

    Raises InputError for structures that AB13MD does not support: repeated scalars and non-square full blocks.
    """
    import slycot

    structure = BlockStructure.of(blocks)
    for block in structure.blocks:
        if block.repeated or block.rows != block.cols:
            raise InputError("AB13MD takes single scalars and square full blocks only", field="blocks", value=block)
    sizes = np.array([block.rows for block in structure.blocks])
    kinds = np.array([1 if block.kind == "real" else 2 for block in structure.blocks])
    return float(slycot.ab13md(np.asarray(M, complex), sizes, kinds)[0])


def hinf_norm_slicot(system: StateSpace, tolerance: float = 1e-9) -> float:
    """H-infinity norm of a stable system by AB13DD (`control.linfnorm`)."""
    import control
    import slycot

    try:
        return float(control.linfnorm(system.to_control(), tolerance)[0])
    except slycot.exceptions.SlycotError as error:
        raise ComputationError("AB13DD failed", measured=str(error)) from error
