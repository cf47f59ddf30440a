"""The first sentence of a design's result: is the loop stable, and what was asked and reached."""

from __future__ import annotations

from avis_ctrl.errors import ComputationError
from avis_ctrl.study.model import DesignResult


def first_sentence(result: DesignResult) -> str:
    """Unstable loops first, then requirements that are not met, by name."""
    return unstable(result) or _counted(result)


def unstable(result: DesignResult) -> str:
    """Which plants are unstable and what makes them so; empty where all are stable."""
    if result.stable or result.loop is None:
        return ""
    plants = result.loop.check.plants
    bad = sum(not plant.stable for plant in plants)
    why = f": {result.loop.culprit.words()}" if result.loop.culprit else ""
    return (f"UNSTABLE: {'the closed loop of all axes' if bad == len(plants) else 'the closed loop'} is unstable in "
            f"{bad} of {len(plants)} plants{why}.")


def refuse_unstable(result: DesignResult) -> None:
    """Raises ComputationError, exit code 3, where the delivered loop is unstable in some plant."""
    if not (text := unstable(result)):
        return
    kind = result.loop.culprit.kind if result.loop is not None and result.loop.culprit is not None else ""
    steps = {"table": "check the rig file's stiffness, centre of mass and damping",
             "nonlinear": "look at that plant's voltages (drives at their limit?) and floor motion",
             "controller": "keep the axes that move among those the design controls, or ask for less bandwidth"}
    step = steps.get(kind, "use sensors with a lower corner, or keep these axes in the design")
    raise ComputationError(text.removesuffix("."), next_step=step)


def _counted(result: DesignResult) -> str:
    asked = result.requirements
    missed = [r.name for r in asked if not r.met]
    if not asked:
        return "The design file asks for nothing, so nothing is judged."
    if missed:
        return (f"{len(missed)} of {len(asked)} requirements {'is' if len(missed) == 1 else 'are'} not met: "
                f"{'; '.join(missed)}.")
    return f"All {len(asked)} requirements are met." if len(asked) > 1 else "The requirement is met."
