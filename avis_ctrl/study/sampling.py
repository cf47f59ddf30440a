"""Random members of a design's plant set."""

from __future__ import annotations

import numpy as np

from avis_ctrl.study.plant import DesignPlant


def random_perturbations(plant: DesignPlant, count: int, seed: int) -> np.ndarray:
    """(count, n_w, n_z) random perturbations: parameters in their ranges, chains of random size and phase."""
    rng = np.random.default_rng(seed)
    blocks = plant.synthesis.blocks
    return np.array([blocks.random(rng) for _ in range(count)]).reshape(count, blocks.n_w, blocks.n_z)
