"""The verdict table: each requirement of the design with the result of the mu controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.norms import decibels
from avis_ctrl.simulation.design_check import SimulationCheck
from avis_ctrl.study.at_rest import AtRest
from avis_ctrl.study.design_file import Design, Quantity
from avis_ctrl.study.design_result import AxisGain, ControllerResult, Requirement
from avis_ctrl.study.limits import no_better_than_none


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
    n = len(check.plants)

    def row(name: str, kept: int, note: str) -> Requirement:
        return Requirement(name, n, kept, "plants", kept == n, "at least", note)

    return (
        row(
            "closed loop of all axes is stable",
            sum(p.stable for p in check.plants),
            "linear sampled loop and nonlinear simulation, with hold, delay, converters, sensors and all axes' loops",
        ),
        row(
            "voltages stay within the limits of drives and converter",
            sum(p.within_limits for p in check.plants),
            f"nonlinear simulation of {check.duration_s:g} s",
        ),
        row(
            "motion agrees with the linear prediction",
            sum(p.agrees for p in check.plants),
            f"in third octaves; probability {check.false_alarm:g} that noise alone makes at least one plant fail",
        ),
        *(
            ()
            if rest is None
            else (
                Requirement(
                    "drive voltage for the electronics' offset, relative to its limit",
                    offset_percent,
                    rest.percent,
                    "%",
                    rest.percent <= offset_percent,
                    "at most",
                    rest.words(),
                ),
            )
        ),
    )


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
