"""A loop to test with: velocity feedback with roll-offs on all six axes of either rig."""

from __future__ import annotations

import numpy as np
import pytest

from avis_ctrl.lti import StateSpace, append, tf
from avis_ctrl.rigs import COORDINATES, load_rig
from avis_ctrl.rigs.floor_spectrum import shipped_spectrum
from avis_ctrl.simulation.sampled_loop import SampledLoop, rig_bank
from avis_ctrl.study.skyhooks import critical_gains

CONTROLLED = ("z", "phi_x")


def velocity_feedback(rig, axis: str, factor: float) -> StateSpace:
    """-g v with a high-pass of 0.2 Hz and a low-pass of 150 Hz, g a multiple of critical; in edge units."""
    g, low, high = factor * critical_gains(rig, [axis])[0], 2 * np.pi * 0.2, 2 * np.pi * 150.0
    return tf([-g * high, 0.0], [1.0, low + high, low * high])


@pytest.fixture(scope="session")
def make_loop():
    def make(name: str = "avis", factor: float = 1.0, **changes) -> SampledLoop:
        rig = load_rig(name)
        K = append(*(velocity_feedback(rig, axis, factor) for axis in CONTROLLED))
        loops = {axis: velocity_feedback(rig, axis, factor) for axis in COORDINATES if axis not in CONTROLLED}
        floor = shipped_spectrum("kamioka_quiet").scaled_to_rms(2e-6, 0.5, 60.0)
        sensors = rig_bank(rig, 0.1)
        given = {"sensors": sensors, "floor": dict.fromkeys(("x", "y", "z"), floor), "amplifier_corner_Hz": 300.0}
        return SampledLoop(rig, K, CONTROLLED, loops, **(given | changes))

    return make


@pytest.fixture(scope="session")
def passive(make_loop):
    """The same rig with a controller that asks for nothing."""

    def make(name: str = "avis", **changes) -> SampledLoop:
        return make_loop(name, 0.0, **changes)

    return make
