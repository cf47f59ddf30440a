"""Random plants of a design's uncertainty set."""

from __future__ import annotations

import numpy as np

from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.uncertainty.blocks import BlockStructure


def random_perturbations(plant: DesignPlant, count: int, seed: int) -> np.ndarray:
    """(count, n_w, n_z) random perturbations: parameters in their ranges, chains of random size and phase."""
    rng = np.random.default_rng(seed)
    blocks = plant.synthesis.blocks
    drawn = [of_rank_one(blocks, blocks.random(rng)) for _ in range(count)]
    return np.array(drawn).reshape(count, blocks.n_w, blocks.n_z)


def of_rank_one(blocks: BlockStructure, delta: np.ndarray) -> np.ndarray:
    """Replace full blocks by their largest dyad: only rank-one blocks are realised as stable all-pass systems."""
    values = blocks.values(delta)
    for k, (value, block) in enumerate(zip(values, blocks.blocks, strict=True)):
        if block.kind == "full" and min(block.rows, block.cols) > 1:
            U, sigma, Vh = np.linalg.svd(np.asarray(value))
            values[k] = sigma[0] * np.outer(U[:, 0], Vh[0])
    return blocks.assemble(values)
