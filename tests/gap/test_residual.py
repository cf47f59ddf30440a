"""Where a model leaves more than noise: bands and channels, and the chance of each."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from avis_ctrl.gap.residual import places


@pytest.mark.parametrize("dof", [30.0, 100.0, 400.0])
def test_chance_of_a_place_does_not_count_noise_that_was_not_measured(dof):
    """Two held-out records of 400 lines, known from no more than twice as many lines: a band without a gap beside one
    with a faint one."""
    omega, rng = 2 * np.pi * np.geomspace(1.0, 2.0**0.499, 400), np.random.default_rng(3)
    noise = np.ones((400, 1, 1, 1))

    def error():
        E = (rng.standard_normal((400, 1, 1)) + 1j * rng.standard_normal((400, 1, 1))) / np.sqrt(2)
        block = SimpleNamespace(U=np.zeros((400, 1, 1)), omega=omega, noise=noise, dof=dof)
        return SimpleNamespace(block=block, error=1.15 * E / np.sqrt(np.mean(np.abs(E) ** 2)))

    left = SimpleNamespace(errors=(error(), error()), outputs=("Sz1",), inputs=("Az1",))
    told = places(left)
    least = stats.f.sf(1.15**2, 1600, 2 * max(dof, 1600))
    assert not told or told[0].p_value >= least * (1 - 1e-9)
    assert (dof < 60) or told
