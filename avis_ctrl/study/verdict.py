"""The first sentences of a design's result: whether the loop is stable, and which requirements are met."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.identification.identifiability_text import listed
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.summary import digits_apart


def first_sentence(result: DesignResult) -> str:
    """A sentence on instability, if the loop is unstable; otherwise on the requirements that are not met."""
    return unstable(result) or _counted(result)


def unstable(result: DesignResult) -> str:
    """How many plants are unstable, and why; empty if all are stable."""
    if result.stable or result.loop is None:
        return ""
    plants = result.loop.check.plants
    bad = sum(not plant.stable for plant in plants)
    why = f": {result.loop.culprit.words()}" if result.loop.culprit else ""
    return f"UNSTABLE: the closed loop of all axes is unstable in {bad} of {len(plants)} plants{why}."


def all_axes(result: DesignResult) -> str:
    """Transmissibility of the sampled loop with all six degrees of freedom, and the bounds of the design model.

    The bounds are those of the kept coordinates with the others locked. If the nominal loop of all axes exceeds them,
    the sentence states this; without bounds it mentions none.
    """
    mu, six = result.controller("mu"), result.six_dof
    low, high = result.design.transmissibility.band_Hz
    inside = (six.omega >= 2 * np.pi * low) & (six.omega <= 2 * np.pi * high)
    peak, band = (decibels(np.max(sigma)) for sigma in (six.kept, six.kept[inside]))
    inside_band = f"from {low:g} to {high:g} Hz"
    beyond = [
        f"{value:+.1f} dB {where} (bound {decibels(bound.upper):+.1f} dB)"
        for value, bound, where in ((peak, mu.worst_peak, "at the peak"), (band, mu.worst_band, inside_band))
        if np.isfinite(bound.upper) and value > decibels(bound.upper)
    ]
    locked = f"The worst-case bounds hold for {listed(result.design.keep)} with the other coordinates locked"
    reached = (
        "With all six degrees of freedom the transmissibility of the nominal sampled loop is at most "
        f"{peak:+.1f} dB, and at most {band:+.1f} dB {inside_band}"
    )
    if beyond:
        compared = f"{locked}. With all six degrees of freedom the nominal sampled loop exceeds them: {listed(beyond)}."
    elif not (np.isfinite(mu.worst_peak.upper) and np.isfinite(mu.worst_band.upper)):
        compared = f"{reached}. For the other plants of the uncertainty set there is no bound."
    else:
        compared = f"{locked}. {reached}."
    return compared + _outside(result, six.alone[inside].max(axis=0), inside_band)


def _outside(result: DesignResult, most: np.ndarray, inside_band: str) -> str:
    """What the axes outside the design do: most (6,), largest gain of each axis in the band."""
    rows = [
        f"{decibels(most[k]):+.1f} dB ({name})" for k, name in enumerate(COORDINATES) if name not in result.design.keep
    ]
    if not rows:
        return ""
    return (
        f" The axes outside the design have skyhook loops or remain passive; {inside_band} their gain from the floor "
        f"to the payload along the same axis is at most {listed(rows)}, nominal."
    )


def requirement_rows(result: DesignResult) -> list[tuple[str, str, str, bool]]:
    """Name, limit and value of each requirement as text, and whether it is met."""
    rows = []
    for one in result.requirements:
        unit = f" {one.unit}" if one.unit else ""
        limit = "yes" if one.comparison == "is" else f"{one.comparison} {one.limit:.4g}{unit}"
        digits = 4 if one.met else digits_apart(one.value, one.limit, 4)
        rows.append((one.name, limit, f"{one.value:.{digits}g}{unit}" if np.isfinite(one.value) else "-", one.met))
    return rows


def refuse_unstable(result: DesignResult) -> None:
    """Raise ComputationError (exit code 3) if the delivered loop is unstable for any plant."""
    if not (text := unstable(result)):
        return
    culprit = result.loop.culprit if result.loop is not None else None
    steps = {
        "table": "check the rig file's stiffness, centre of mass and damping",
        "nonlinear": "check whether the drive voltages of that plant are at their limits, and its floor motion",
    }
    step = steps.get(
        culprit.kind if culprit else "",
        "use sensors with a lower corner frequency, or add these axes to keep in the design file",
    )
    if culprit is not None and culprit.kind == "controller":
        step = _relaxed(result, culprit.axes)
    raise ComputationError(text.removesuffix("."), next_step=step)


def _relaxed(result: DesignResult, moving: Sequence[str]) -> str:
    """What to change if the designed controller itself makes a plant unstable. moving : axes of the unstable motion."""
    mu = result.controller("mu")
    if not mu.stability.upper < 1:
        return (
            f"the specification is too demanding: mu of the controller is {mu.mu.upper:.3g} and must be below 1; relax "
            "the limiting bound or reduce the uncertainty (named below the table of requirements)"
        )
    if outside := [axis for axis in moving if axis not in result.design.keep]:
        return f"add {listed(outside)} to keep in the design file, or reduce the bandwidth"
    return "reduce the bandwidth, or use a higher sample rate"


def _counted(result: DesignResult) -> str:
    asked = result.requirements
    missed = [r.name for r in asked if not r.met]
    if not asked:
        return "The design file states no requirements, so there is no verdict."
    if missed:
        return (
            f"{len(missed)} of {len(asked)} requirements {'is' if len(missed) == 1 else 'are'} not met: "
            f"{'; '.join(missed)}."
        )
    return f"All {len(asked)} requirements are met." if len(asked) > 1 else "The requirement is met."
