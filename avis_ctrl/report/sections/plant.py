"""The generalized plant: its diagram, signals, uncertainty and weights."""

from __future__ import annotations

import numpy as np

from avis_ctrl.lti.norms import in_dB
from avis_ctrl.report import words
from avis_ctrl.report.block_diagram import block_diagram
from avis_ctrl.report.elements import Bullets, Drawing, Paragraph, Section, Table, headed, section, table
from avis_ctrl.report.families import EXTERNAL, Families
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, hertz, level, numbered
from avis_ctrl.report.sections.identified import identified
from avis_ctrl.report.sections.transmissibility import nominal, target, upper_bound
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.analysis import SETTINGS as CURVES
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.study.identified_uncertainty import RESPONSE
from avis_ctrl.study.plant import EFFORT, DesignPlant
from avis_ctrl.summary import joined
from avis_ctrl.uncertainty.uncertain_rig import UncertainDirection, UncertainEquation
from avis_ctrl.uncertainty.weights import NeglectedDynamics

ROLES = {
    "w": "disturbance",
    "z": "performance",
    "u": "command",
    "y": "measurement",
    "internal": "internal",
    "w_delta": "from Delta",
    "z_delta": "to Delta",
}
KINDS = {"real": "real", "complex": "complex scalar", "full": "complex"}

HZ = np.geomspace(*SETTINGS.weight_Hz, SETTINGS.weight_points)


def generalized_plant(result: DesignResult) -> Section:
    """The section on the generalized plant."""
    plant = result.plant
    P = plant.synthesis
    drawing = Drawing(
        "blocks",
        "Block diagram of the generalized plant, drawn from its parts and signals. A star "
        "stands for the axes or channels; ×n is the number of equal parts. Red: disturbances; blue: "
        "performance outputs; Δ: uncertainty.",
        block_diagram(plant),
        "Block diagram of the loop: controller, actuators, rig, sensors, weights and uncertainty",
    )
    summary = Paragraph(
        f"The plant of the synthesis has {P.P.nstates} states, {P.ncon} commands, {P.nmeas} "
        f"measurements, {len(P.w)} disturbances, {len(P.z)} weighted outputs and "
        f"{len(P.blocks.blocks)} blocks of uncertainty. The axes are "
        f"{joined([words.axis(a) for a in plant.axes])}."
    )
    meanings = Bullets([f"{n}: {w.meaning}" for n, w in plant.weights.items()])
    figures = (_transmissibility_weight(result), _effort(result), _chains(plant), _noise(result), _compliance(result))
    return section(
        "Generalized plant",
        "plant",
        (summary, drawing, _signals(plant)),
        headed("Uncertainty", _blocks(result), identified(result)),
        headed("Weights", meanings, figures),
    )


def _signals(plant: DesignPlant) -> Table:
    rows = []
    for s in Families(plant).signals:
        inside = "1" if len(s.members) == 1 else str(len(s.members))
        readers = ", ".join(s.readers) or ("controller" if s.role == "y" else "Delta" if s.role == "z_delta" else "")
        source = {"u": "controller", "w_delta": "Delta"}.get(s.role, "outside" if s.source == EXTERNAL else s.source)
        rows.append((s.name, inside, s.meaning or _delta_words(s.role), s.unit or "1", source, readers, ROLES[s.role]))
    return table(
        "Signals of the connection; a star stands for an axis or a channel.",
        ("signal", "number", "meaning", "unit", "output of", "input of", "role"),
        rows,
        "lclllll",
    )


def _delta_words(role: str) -> str:
    return {"w_delta": "output of the perturbation", "z_delta": "input of the perturbation"}.get(role, "")


def _blocks(result: DesignResult) -> Table:
    plant = result.plant
    real = {p.name: p for p in plant.rig.parameters}
    described = {name: p.description for name, p in result.rig.parameters().items()}
    chain = next((w for w in plant.weights.values() if isinstance(w, NeglectedDynamics)), None)
    rows = []
    for block in plant.synthesis.blocks.blocks:
        size = f"{block.rows}" if block.is_scalar_delta else f"{block.rows} × {block.cols}"
        if isinstance(one := real.get(block.name), UncertainDirection):
            spread = f"{len(one.changes)} parameters together, see the table"
            meaning = "direction in which the identified parameters are uncertain"
        elif isinstance(one, UncertainEquation):
            spread = "a row of the equations"
            meaning = f"remaining uncertainty of the equation of {one.coordinate}"
        elif block.name == RESPONSE:
            spread, meaning = "|W| of the weight", "error of the identified model's response, of any phase"
        elif one is not None:
            half = one.half_range(plant.rig.nominal[block.name])
            nominal, unit = plant.rig.nominal[block.name], words.unit(plant.rig.units[block.name])
            spread = f"{nominal:.6g} ± {half:.4g} {unit}".rstrip()
            meaning = described.get(block.name, "parameter of the rig")
        else:
            spread = "see the weight" if chain is None else "|W| of the weight"
            meaning = "neglected dynamics of this channel, of any phase"
        rows.append((block.name, KINDS[block.kind], size, spread, meaning))
    return table(
        "Blocks of the uncertainty, in the order of Delta. The size of a real block is the number of times "
        "that its parameter is repeated; each block has norm at most 1.",
        ("block", "kind", "size", "range", "what it stands for"),
        rows,
        "llcll",
    )


def _transmissibility_weight(result: DesignResult) -> Figure:
    mu = result.controller("mu")
    limit = result.plant.weights["transmissibility"].limit(mu.transmissibility.omega)
    curves = (
        target(result),
        nominal(mu, in_dB(limit), "1/|W_T|, the filter", STYLES["filter"]),
        nominal(mu, in_dB(mu.transmissibility.sigma), "mu synthesis, nominal"),
        upper_bound(mu, "mu synthesis, upper bound over the set"),
    )
    return Figure(
        "weight_transmissibility",
        "The target of the synthesis, its realisation by a rational "
        "filter, and the transmissibility achieved. The loop meets the target where its curves lie below "
        "that of the filter; the upper bound over the set was computed at the marked frequencies.",
        [Panel(hertz(CURVES.plot_Hz), Axis("gain [dB]", "linear", (-60.0, 20.0)), curves)],
    )


def _effort(result: DesignResult) -> Figure:
    plant, omega, curves = result.plant, 2 * np.pi * HZ, []
    for k, axis in enumerate(plant.axes):
        weight, shown = plant.effort_weight(axis), words.axis(axis)
        if EFFORT not in plant.weights or not k:  # one limit for all axes is drawn once
            of = "" if EFFORT in plant.weights else f", {shown}"
            curves.append(Curve(HZ, weight.limit(omega), f"1/|W_u|, allowed{of}", STYLES["limit"]))
        closed = plant.full.closed(result.controller("mu").K).select([f"effort_{axis}"], plant.floor_velocities)
        gain = np.linalg.norm(closed.frequency_response(omega), ord=2, axis=(1, 2)) / weight.magnitude(omega)
        curves.append(Curve(HZ, gain, f"mu synthesis, {shown}", numbered(k)))
    return Figure(
        "weight_effort",
        "Control effort: voltage of the drive that saturates first when a force acts along "
        "the axis, relative to floor velocity, compared with the limit of the weight; nominal plant.",
        [Panel(hertz(), Axis("drive voltage / floor velocity [V s/m]", "log"), curves)],
    )


def _chains(plant: DesignPlant) -> Figure | None:
    chains = {n: w for n, w in plant.weights.items() if isinstance(w, NeglectedDynamics)}
    if not chains:
        return None
    omega = 2 * np.pi * HZ
    curves = [
        Curve(HZ, 100 * w.magnitude(omega), f"{n.removesuffix(' *')}s", numbered(k))
        for k, (n, w) in enumerate(chains.items())
    ]
    curves.append(level(*SETTINGS.weight_Hz, 100.0, "100 %"))
    return Figure(
        "weight_chains",
        "Neglected dynamics of each channel: relative uncertainty over frequency. Where it exceeds 100 %, neither gain "
        "nor phase of the channel is known.",
        [Panel(hertz(), Axis("uncertainty [%]", "log", (1.0, 1000.0)), curves)],
    )


def _noise(result: DesignResult) -> Figure:
    plant = result.plant
    omega = 2 * np.pi * HZ
    noise = np.abs(plant.sensor_noise.frequency_response(omega)[:, 0, 0])
    inside = (plant.floor.low_Hz <= HZ) & (plant.floor.high_Hz >= HZ)
    floor = np.where(inside, plant.floor.asd(HZ, "velocity"), np.nan)
    curves = (
        Curve(HZ, floor, f"floor ({plant.floor.name})", STYLES["plain"]),
        Curve(HZ, noise, "noise of one sensor", STYLES["hinf"]),
        level(*SETTINGS.weight_Hz, plant.floor_density, "mean floor density, unit of the noise inputs"),
    )
    return Figure(
        "weight_noise",
        "Spectral density of the floor velocity at the site, in the band of its model, and "
        "of the noise of one sensor with its converter. Where the noise exceeds the floor motion, sensor "
        "noise dominates the signal.",
        [Panel(hertz(), Axis("velocity [m/s/√Hz]", "log"), curves)],
    )


def _compliance(result: DesignResult) -> Figure | None:
    if "compliance" not in result.plant.weights:
        return None
    mu = result.controller("mu")
    limit = result.plant.weights["compliance"].limit(mu.transmissibility.omega)
    curves = (nominal(mu, limit, "1/|W_c|, allowed", STYLES["limit"]), nominal(mu, mu.compliance, "mu synthesis"))
    return Figure(
        "weight_compliance",
        "Compliance, compared with the limit of the weight; nominal plant.",
        [Panel(hertz(), Axis("compliance [m/N]", "log"), curves)],
    )
