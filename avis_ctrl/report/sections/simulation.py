"""Simulation of the closed loop with the nonlinear rig: verdict for each plant, spectrum against prediction."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Cell, Mark, Paragraph, Section, Table, listed, section, table, yes_or_no
from avis_ctrl.report.figures import PALETTE, STYLES, Axis, Curve, Figure, Panel, Style, hertz, markers
from avis_ctrl.simulation.design_check import PlantCheck, SimulationCheck
from avis_ctrl.simulation.spectrum_check import SpectrumAgreement
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.study.other_axes import Companions


def simulation(result: DesignResult) -> Section:
    """The section on the simulation."""
    check = result.simulation
    if not isinstance(check, SimulationCheck):
        return section("Simulation of the nonlinear rig", "simulation", Paragraph("No simulation was run."))
    passed = sum(p.passed for p in check.plants)
    text = (
        f"{passed} of {len(check.plants)} plants pass. Each is the nonlinear rig with six degrees of freedom, with "
        f"the sampled mu controller and the skyhook loops of the other axes, simulated for "
        f"{words.number(check.duration_s)} s with hold, delay, converter, limits, sensors, floor motion and "
        "noise. A plant passes if it is stable, no voltage reaches its limit, and its "
        "spectrum agrees with the linear prediction within the limits of random scatter "
        f"(probability of a false alarm in any plant: {words.number(100 * check.false_alarm, 2)} %)."
    )
    first = check.plants[0]
    return section(
        "Simulation of the nonlinear rig",
        "simulation",
        Paragraph(text, "verdict", passed == len(check.plants)),
        _plants(check),
        _companions(result.loop.companions) if result.loop is not None else None,
        [_spectrum(first.name, first.spectrum), _ratios(check)] if first.spectrum is not None else None,
        _record(check),
    )


def _plants(check: SimulationCheck) -> Table:
    loop = check.first.loop
    limits = dict(zip(loop.rig.equations_of_motion().actuators, loop.limits_V.tolist(), strict=True))
    differ = len(set(limits.values())) > 1
    nearest = "of the drive that comes closest to its limit;" if differ else "limit"
    return listed(
        f"Every simulated plant. Commanded voltages, {nearest} {words.limits(limits)}; clipped samples of "
        "drives and converter together. The voltages include the offset of the electronics. The velocity contains all "
        f"frequencies from 0 to {words.number(loop.rig.sample_rate_Hz / 2)} Hz, with the slow motion below the band of "
        "the floor, to which the comparison of controllers is limited.",
        check.plants,
        {
            "plant": lambda p: p.name,
            "verdict": lambda p: Mark("pass", True) if p.passed else Mark("FAIL", False),
            "stable": lambda p: Mark("diverged", False) if p.diverged else yes_or_no(p.stable),
            "bands that agree": _agreement,
            "peak voltage": lambda p: f"{words.number(p.peak_V)}{f' of {words.number(p.limit_V)}' if differ else ''} V",
            "clipped": lambda p: str(p.clipped_dac + p.clipped_adc),
            "velocity r.m.s. [µm/s]": lambda p: ", ".join(
                f"{words.axis(a)} {words.number(1e6 * v)}" for a, v in p.payload_rms.items()
            ),
        },
        "lcccrrl",
    )


def _companions(companions: Companions) -> Table:
    asked, low = companions.settings.modulus_margin, companions.below_margin()
    rows: list[tuple[Cell, ...]] = [
        (
            words.axis(one.axis),
            f"{words.number(one.gain)} N s/m",
            f"{words.number(one.tilt_corner_Hz)} Hz",
            f"{words.number(one.roll_off_Hz)} Hz",
            Mark(words.number(one.modulus_margin, 2), one not in low),
        )
        for one in companions.loops
    ]
    rows += [(words.axis(axis), "passive", "", "", why) for axis, why in companions.passive]
    return table(
        "Axes that the mu controller does not control. Each has a skyhook loop, designed for this rig's "
        "sensors with all other loops closed, or remains passive. The modulus margin is the smallest distance "
        "of the Nyquist curve from the critical point, for the nominal plant; at least "
        f"{asked:g} is required. sampled_controller.json contains these loops and the mu controller.",
        ("axis", "gain", "tilt corner", "roll-off", "modulus margin"),
        rows,
        "lrrrr",
    )


def _agreement(p: PlantCheck) -> Mark | str:
    if p.spectrum is None:
        return "none computed"
    outside = int(np.count_nonzero(p.spectrum.outside))
    return Mark(f"{p.spectrum.ratio.size - outside} of {p.spectrum.ratio.size}", outside == 0)


def _spectrum(name: str, s: SpectrumAgreement) -> Figure:
    panels = []
    for axis, estimated, predicted in zip(s.axes, s.estimated_psd, s.predicted_psd, strict=True):
        curves = (
            Curve(s.frequency_Hz, np.sqrt(estimated), "simulated", Style("#e69f00", "solid", 1.2)),
            Curve(s.frequency_Hz, np.sqrt(predicted), "predicted", STYLES["mu"]),
        )
        panels.append(Panel(hertz(), Axis("velocity [m/s/√Hz]", "log"), curves, (), words.axis(axis)))
    return Figure(
        "spectrum",
        f'Spectral density of the payload velocity for the plant "{name}": simulated (Welch\'s '
        "method), and predicted by the linear model of the sampled loop.",
        panels,
        2,
    )


def _ratios(check: SimulationCheck) -> Figure:
    found = [p.spectrum for p in check.plants if p.spectrum is not None]
    first, each = found[0], Style("#0072b2", "solid", 0.7)
    panels = []
    for k, axis in enumerate(first.axes):
        curves = [markers(s.midband_Hz, 10 * np.log10(s.ratio[k]), "each plant", each) for s in found]
        for edge in (first.lower, first.upper):
            curves.append(Curve(first.midband_Hz, 10 * np.log10(edge[k]), "limits of random scatter", STYLES["limit"]))
        panels.append(Panel(hertz((0.8, 100.0)), Axis("simulated over predicted [dB]"), curves, (), words.axis(axis)))
    return Figure(
        "spectrum_ratio",
        "Power in third octaves, simulated over predicted, for every plant. The dashed "
        "lines are the limits of the first plant; each plant is tested against its own.",
        panels,
        2,
    )


def _record(check: SimulationCheck) -> Figure:
    first = check.first
    time = first.time[:5000]
    motion = [
        Curve(time, 1e6 * first.velocity(axis)[:5000], words.axis(axis), Style(PALETTE[k % 3], "solid", 0.9))
        for k, axis in enumerate(first.loop.axes)
    ]
    return Figure(
        "record",
        f'The first seconds of the simulation of the plant "{check.plants[0].name}": payload '
        "velocity, rotations at the edge.",
        [Panel(Axis("time [s]", "linear", (time[0], time[-1])), Axis("velocity [µm/s]"), motion)],
    )
