"""The verdict on a design: each requirement with the result of the mu controller, and the first sentences on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.robust.musyn_iteration import STOPPED
from avis_ctrl.simulation.design_check import SimulationCheck
from avis_ctrl.study.dc_gain import AtRest
from avis_ctrl.study.design_file import Design, Quantity
from avis_ctrl.study.design_result import AxisGain, ControllerResult, DesignResult, Requirement
from avis_ctrl.study.limiting_bounds import no_better_than_none
from avis_ctrl.summary import digits_apart, joined, rounded_down, rounded_up


def _advantage(skyhook: ControllerResult, mu: ControllerResult) -> float:
    """Lower bound of the skyhook's worst case over the upper bound of the mu controller's worst case [dB].

    nan (never met) for a skyhook that a plant of the set destabilises: its infinite gain would flatter any controller.
    """
    if not np.isfinite(skyhook.worst_peak.upper):
        return np.nan
    return decibels(skyhook.worst_band.lower) - decibels(mu.worst_band.upper)


def check_loop(
    check: SimulationCheck, rest: AtRest | None = None, offset_percent: float = 100.0
) -> tuple[Requirement, ...]:
    """Requirements that every design must meet, in addition to those of its file.

    For each plant the sampled loop of all axes is stable, stays within its voltage limits, and moves as the linear
    model predicts. The offset of the electronics uses at most `offset_percent` of a drive's range.
    """
    every = "linear sampled loop and nonlinear simulation, with hold, delay, converters, sensors and all axes' loops"
    scatter = f"in third octaves; probability {check.false_alarm:g} that noise alone makes at least one plant fail"
    simulated = f"nonlinear simulation of {check.duration_s:g} s"
    counted = (
        ("closed loop of all axes is stable", [p.stable for p in check.plants], every),
        ("voltages stay within the limits of drives and converter", [p.within_limits for p in check.plants], simulated),
        ("motion agrees with the linear prediction", [p.agrees for p in check.plants], scatter),
    )
    rows = [
        Requirement(name, len(kept), sum(kept), "plants", all(kept), "at least", note) for name, kept, note in counted
    ]
    if rest is not None:
        name, met = "drive voltage for the electronics' offset, relative to its limit", rest.percent <= offset_percent
        rows.append(Requirement(name, offset_percent, rest.percent, "%", met, "at most", rest.words()))
    return tuple(rows)


def check_requirements(
    design: Design, controllers: Sequence[ControllerResult], by_axis: Sequence[AxisGain] = ()
) -> tuple[Requirement, ...]:
    """One row per requirement of the design file, in the order of the file."""
    by_name = {c.name: c for c in controllers}
    mu, skyhook, passive = (by_name.get(name) for name in ("mu", "skyhook", "passive"))
    if mu is None or passive is None:
        raise InputError("requirements need the controllers mu and passive", field="controllers", value=sorted(by_name))
    low, high = design.transmissibility.band_Hz
    # The poles of a controller that does nothing have no meaning.
    idle = no_better_than_none(mu, controllers)
    band = f"over {low:g} to {high:g} Hz"
    measured: dict[Quantity, tuple[str, Callable[[], float], str]] = {
        "mu_upper": (
            "mu of the weighted performance, upper bound",
            lambda: mu.mu.upper,
            "guaranteed at every frequency" if mu.mu.guaranteed else "at the computed frequencies",
        ),
        "mu_gap_percent": (
            "gap between the bounds of mu at its peak",
            lambda: 100 * (1 - mu.mu.lower / mu.mu.upper),
            "the report lists the perturbation that attains the lower bound",
        ),
        "worst_case_peak_transmissibility_dB": (
            "worst-case peak transmissibility",
            lambda: decibels(mu.worst_peak.upper),
            "; ".join(mu.worst_peak.words),
        ),
        "worst_case_band_transmissibility_dB": (
            f"worst-case transmissibility {band}",
            lambda: decibels(mu.worst_band.upper),
            "; ".join(mu.worst_band.words),
        ),
        "passive_peak_transmissibility_dB": (
            "passive peak transmissibility, nominal",
            lambda: decibels(passive.peak_transmissibility),
            "",
        ),
        "advantage_over_skyhook_dB": (
            f"worst case {band}: improvement on the tuned skyhook",
            lambda: _advantage(skyhook, mu) if skyhook else np.nan,
            f"worst case of the skyhook: {decibels(skyhook.worst_band.lower):+.1f} dB in this band, "
            f"{decibels(skyhook.worst_peak.lower):+.1f} dB at its peak"
            if skyhook
            else "no skyhook to compare with",
        ),
        "advantage_on_each_axis_dB": (
            f"worst case {band}: least improvement of any axis on the tuned skyhook",
            lambda: min((decibels(one.advantage) for one in by_axis), default=np.nan),
            ", ".join(f"{one.axis} {decibels(one.advantage):+.1f} dB" for one in by_axis),
        ),
        "fastest_controller_pole_Hz": (
            "fastest pole of the mu controller",
            lambda: np.nan if idle else mu.fastest_pole_Hz,
            "no controller better than none was found" if idle else "",
        ),
    }
    rows = []
    for one in design.requirement:
        name, value, note = measured[one.quantity]
        number = value()
        limit = one.at_most if one.at_most is not None else one.at_least
        assert limit is not None  # the design file gives exactly one of the two
        met = number <= limit if one.at_most is not None else number >= limit
        rows.append(
            Requirement(
                name, limit, number, one.unit, bool(met), "at most" if one.at_most is not None else "at least", note
            )
        )
    return tuple(rows)


def first_sentence(result: DesignResult) -> str:
    """A sentence on instability, if the loop is unstable; otherwise on the requirements that are not met. Before it,
    whether the synthesis was stopped."""
    early = "The synthesis was stopped before it had converged; let it finish before you judge the design. "
    return early * stopped(result) + (unstable(result) or _counted(result))


def stopped(result: DesignResult) -> bool:
    """Whether the user stopped the synthesis before it had converged."""
    return any(STOPPED in one.notes for one in result.controllers if one.name == "mu")


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
    others = "" if len(result.design.keep) == len(COORDINATES) else " with the other coordinates locked"
    locked = f"The worst-case bounds hold for {joined(result.design.keep)}{others}"
    reached = (
        "With all six degrees of freedom the transmissibility of the nominal sampled loop is at most "
        f"{peak:+.1f} dB, and at most {band:+.1f} dB {inside_band}"
    )
    if beyond:
        compared = f"{locked}. With all six degrees of freedom the nominal sampled loop exceeds them: {joined(beyond)}."
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
        f"to the payload along the same axis is at most {joined(rows)}, nominal."
    )


def requirement_rows(result: DesignResult) -> list[tuple[str, str, str, bool]]:
    """Name, limit and value of each requirement as text, and whether it is met."""
    rows = []
    for one in result.requirements:
        unit = f" {one.unit}" if one.unit else ""
        limit = "yes" if one.comparison == "is" else f"{one.comparison} {one.limit:.4g}{unit}"
        digits = 4 if one.met else digits_apart(one.value, one.limit, 4)
        value = (rounded_up if one.comparison == "at most" else rounded_down)(one.value, digits)
        rows.append((one.name, limit, f"{value:.{digits}g}{unit}" if np.isfinite(value) else "-", one.met))
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
    if stopped(result):
        return "run it again to the end: the synthesis was stopped before it had converged"
    if not mu.stability.upper < 1:
        return (
            f"the specification is too demanding: mu of the controller is {mu.mu.upper:.3g} and must be below 1; relax "
            "the limiting bound or reduce the uncertainty (named below the table of requirements)"
        )
    if outside := [axis for axis in moving if axis not in result.design.keep]:
        return f"add {joined(outside)} to keep in the design file, or reduce the bandwidth"
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
    met = f"All {len(asked)} requirements are met" if len(asked) > 1 else "The requirement is met"
    proved = result.controller("mu").guaranteed
    return f"{met}." if proved else f"{met}; bounds are proved at the computed frequencies only."
