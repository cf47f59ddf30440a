"""The limiting weights and uncertainties: mu at its peak with one of them removed at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust.mu import mu_upper
from avis_ctrl.study.design_result import ControllerResult
from avis_ctrl.study.identified_uncertainty import RESPONSE
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.uncertainty.blocks import BlockStructure

WORTH_NAMING = 0.02
# A controller whose mu is within this fraction of the passive table's mu is regarded as doing nothing.
IDLE = 0.01
# Uncertainty of an identified response above which a better measurement is recommended.
LARGE_SPREAD = 0.3


def without_each(plant: DesignPlant, K: StateSpace, omega: float) -> list[tuple[str, float]]:
    """(what is removed, upper bound of mu without it) at one frequency, smallest mu first.

    Uncertainty blocks are removed one by one, weighted outputs by kind: transmissibility, control effort, compliance.
    """
    P = plant.synthesis
    M = P.closed(K).frequency_response(np.array([omega]))[0]
    everything = list(P.all_blocks.blocks)
    found = []
    for k, block in enumerate(P.blocks.blocks):
        keep_w, keep_z = np.ones(M.shape[1], bool), np.ones(M.shape[0], bool)
        place = list(P.blocks.slices())[k]
        keep_w[place[1]], keep_z[place[2]] = False, False
        rest = BlockStructure(tuple(everything[:k] + everything[k + 1 :]))
        found.append((f"uncertainty of {block.name}", _mu(M[np.ix_(keep_z, keep_w)], rest)))
    for prefix, words in (
        ("e_", "transmissibility bound"),
        ("effort_", "control effort bound"),
        ("compliance_", "compliance bound"),
    ):
        left = [name for name in P.z if not name.startswith(prefix)]
        if len(left) in (0, len(P.z)):
            continue
        rows = [*range(P.blocks.n_z), *(P.blocks.n_z + P.z.index(name) for name in left)]
        found.append((words, _mu(M[rows], P.blocks.with_performance(len(P.w), len(left)))))
    return sorted(found, key=lambda one: one[1])


def _mu(M: np.ndarray, blocks: BlockStructure) -> float:
    return float(mu_upper(M, blocks).upper)


def best_found(plant: DesignPlant, mu: ControllerResult, others: Sequence[ControllerResult]) -> str:
    """Sentences on a design with mu above 1: what was reached, what limits it, and what to try.

    This does not prove that nothing better exists: the synthesis may have stopped early, which the sentences then
    state.
    """
    if mu.K is None:
        return ""
    spread = _spread_there(plant, mu.mu.omega)
    if no_better_than_none(mu, others):
        return (
            f"The synthesis found no controller better than none: with the best controller found mu is "
            f"{mu.mu.upper:.3g}, at {mu.mu.omega / (2 * np.pi):.3g} Hz, which is not smaller than without control. "
            f"No D-K iteration came closer to the bounds with this uncertainty. "
            f"{spread or 'Specify less uncertainty or wider bounds'}."
        )
    worth = (1 - WORTH_NAMING) * mu.mu.upper
    reliefs = [(name, value) for name, value in without_each(plant, mu.K, mu.mu.omega) if value < worth]
    relief = [f"{name} ({value:.2f} without it)" for name, value in reliefs]
    text = (
        f"The specification is not met for all plants of the set: mu of the mu controller is {mu.mu.upper:.3g}, at "
        f"{mu.mu.omega / (2 * np.pi):.3g} Hz. Main contributions there: "
        f"{', '.join(relief[:4]) or 'no single one'}. "
        f"With uncertainties {mu.mu.upper:.3g} times smaller and bounds {mu.mu.upper:.3g} times wider it is met."
    )
    if spread and any(RESPONSE in name for name, _ in reliefs):
        text += f" {spread}."
    if better := [c for c in others if c.mu.upper < mu.mu.upper]:
        best = min(better, key=lambda c: c.mu.upper)
        text += f" The controller {best.title!r} has a smaller mu, {best.mu.upper:.3g}: the iteration ended too early."
    return text


def no_better_than_none(mu: ControllerResult, others: Sequence[ControllerResult]) -> bool:
    """Whether the mu controller misses its target and reduces mu by less than 1 % relative to the passive table."""
    at_rest = min((c.mu.upper for c in others if c.K is None), default=np.inf)
    return bool(mu.mu.upper >= 1 and np.isfinite(at_rest) and mu.mu.upper > (1 - IDLE) * at_rest)


def _spread_there(plant: DesignPlant, omega: float) -> str:
    """The size of the uncertainty of an identified response, and how to reduce it; empty if it is small."""
    if plant.identified is None:
        return ""
    weight = plant.identified.weight
    size = float(weight.magnitude(np.array([omega]))[0])
    if size < LARGE_SPREAD:
        return ""
    nearest = int(np.argmin(np.abs(np.log(weight.omega / omega))))
    drowned = plant.identified.spread.drowned(plant.identified.confidence)
    if not weight.omega[0] <= omega <= weight.omega[-1]:
        beside = "outside the measured band; the value at its end is used"
    elif drowned[nearest]:
        beside = "assumed, because noise hides the response there"
    else:
        beside = f"{100 * weight.data[nearest]:.3g} % in the data there"
    return (
        f"The uncertainty of the identified response is {100 * size:.3g} % at {omega / (2 * np.pi):.3g} Hz "
        f"({beside}). To reduce it, record longer, at a higher level or with more records; or relax the "
        "requirements at this frequency"
    )
