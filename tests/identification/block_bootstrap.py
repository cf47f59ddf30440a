"""Standard deviations by resampling blocks: an independent check of the sandwich estimates of single-axis fits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def block_bootstrap(
    estimate: Callable[[np.ndarray], np.ndarray], samples: int, block: int, draws: int, rng: np.random.Generator
) -> np.ndarray:
    """(p,) standard deviations of estimate(indices) over moving blocks of rows (Kuensch, Ann. Statist. 17 (1989) 1217).

    It assumes nothing of the scores but that blocks are long against their correlation.
    """
    count = -(-samples // block)
    found = []
    for _ in range(draws):
        starts = rng.integers(0, samples - block + 1, count)
        found.append(estimate((starts[:, None] + np.arange(block)).ravel()[:samples]))
    return np.std(found, axis=0, ddof=1)
