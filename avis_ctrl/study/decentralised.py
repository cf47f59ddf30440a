"""One loop per axis, tuned on mu: what decentralised control achieves on the same plant with the same weights.

The structure of a skyhook was not chosen for these weights. The advantage of a multivariable controller is only
meaningful in comparison with loops that each use the velocity of their own axis and are otherwise unrestricted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.fixed_order import fixed_order
from avis_ctrl.robust.mu_descent import Task
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.design_result import Candidate
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.study.roll_off import gain_limit
from avis_ctrl.study.skyhooks import classical_loops

LOOPS_TITLE = "one loop per axis, tuned on mu"


@dataclass(frozen=True)
class LoopSettings:
    """states : mean number per axis. A skyhook has two, one per corner; a third one permits a complex pair of poles."""

    states: int = 3


def tuned_loops(
    plant: DesignPlant, rig: Rig, design: Design, K: StateSpace, settings: LoopSettings = LoopSettings()
) -> Candidate:
    """Decentralised loops tuned on mu: the force on an axis depends on the measured velocity of that axis only.

    They are found by descent on the peak of mu, from the diagonal part of the controller K or from the classical
    skyhook. The states are allotted to the axes that need them, `settings.states` per axis on average.

    Raises ComputationError: no starting point stabilises the nominal plant, or the gain of the table is unbounded.
    """
    P, skyhook = plant.synthesis, classical_loops(plant, rig, design).controller()
    task = Task(P.P, P.all_blocks.complexified(), decentralised=True, limit=gain_limit(plant, rig.sample_rate_Hz))
    order = settings.states * len(plant.axes)
    try:
        *_, found = fixed_order(task, K, order, [skyhook])
    except ComputationError:  # the diagonal part of K does not suffice
        *_, found = fixed_order(task, skyhook, order)
    K = found.K.renamed(K.inputs, K.outputs)
    states = ", ".join(f"{axis} {np.count_nonzero(row)}" for axis, row in zip(plant.axes, K.C, strict=True))
    return Candidate("loops", LOOPS_TITLE, "skyhook", K, (f"states of each axis's loop: {states}",))
