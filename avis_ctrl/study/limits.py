"""Which weight or uncertainty forbids more: mu at its peak with one of them left out at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust.mu import mu_upper
from avis_ctrl.robust.musyn_state import Iteration
from avis_ctrl.study.model import ControllerResult
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.uncertainty.blocks import BlockStructure

WORTH_NAMING = 0.02
STILL_FALLING = 0.05


def without_each(plant: DesignPlant, K: StateSpace, omega: float) -> list[tuple[str, float]]:
    """(what is left out, upper bound of mu without it) at one frequency, the largest relief first.

    Uncertainty blocks one by one, weighted outputs by kind: transmissibility, control effort, compliance.
    """
    P = plant.synthesis
    M = P.closed(K).frequency_response(np.array([omega]))[0]
    everything = list(P.all_blocks.blocks)
    found = []
    for k, block in enumerate(P.blocks.blocks):
        keep_w, keep_z = np.ones(M.shape[1], bool), np.ones(M.shape[0], bool)
        place = list(P.blocks.slices())[k]
        keep_w[place[1]], keep_z[place[2]] = False, False
        rest = BlockStructure(tuple(everything[:k] + everything[k + 1:]))
        found.append((f"uncertainty of {block.name}", _mu(M[np.ix_(keep_z, keep_w)], rest)))
    for prefix, words in (("e_", "transmissibility bound"), ("effort_", "control effort bound"),
                          ("compliance_", "compliance bound")):
        left = [name for name in P.z if not name.startswith(prefix)]
        if len(left) in (0, len(P.z)):
            continue
        rows = [*range(P.blocks.n_z), *(P.blocks.n_z + P.z.index(name) for name in left)]
        found.append((words, _mu(M[rows], P.blocks.with_performance(len(P.w), len(left)))))
    return sorted(found, key=lambda one: one[1])


def _mu(M: np.ndarray, blocks: BlockStructure) -> float:
    return float(mu_upper(M, blocks).upper)


def best_found(plant: DesignPlant, mu: ControllerResult, others: Sequence[ControllerResult],
               history: Sequence[Iteration]) -> str:
    """What was reached by a design whose mu stays above 1, what stands in the way, and what to try.

    It is no proof that nothing better exists: the synthesis may have ended early, and says so here.
    """
    if mu.K is None:
        return ""
    worth = (1 - WORTH_NAMING) * mu.mu.upper
    relief = [f"{name} ({value:.2f} without it)" for name, value in without_each(plant, mu.K, mu.mu.omega)
              if value < worth]
    text = (f"The specification is not met for all plants of the set: mu of the mu controller is {mu.mu.upper:.3g}, at "
            f"{mu.mu.omega / (2 * np.pi):.3g} Hz. What holds it up there: {', '.join(relief[:4]) or 'all together'}. "
            f"With uncertainties {mu.mu.upper:.3g} times smaller and bounds {mu.mu.upper:.3g} times wider it is met.")
    if len(history) > 1 and history[-1].mu_upper < (1 - STILL_FALLING) * history[-2].mu_upper:
        text += " The D-K iteration ended while mu was still falling: raise synthesis.max_iterations or time_limit_s."
    if better := [c for c in others if c.mu.upper < mu.mu.upper]:
        best = min(better, key=lambda c: c.mu.upper)
        text += f" The controller {best.title!r} has a smaller mu, {best.mu.upper:.3g}: the iteration ended too early."
    return text
