"""Generalized plant of a design on a model with effects, and the part of it that files of `avis design` can describe.

    floor -> (chassis) -> rig, its uncertain parameters -> + effects -> motion at the sensors -> decoding as before

The uncertainty enters as in the design. Quantities that the effects multiply (the branch of a mount, the recoil of the
chassis) have their nominal values. Allocation, decoding and sensitivities are those of the first plant: the controller
does not know that a motor or sensor differs from its rig file, or is elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.gap.effects.drives import voltage_limits
from avis_ctrl.gap.effects.mounts import contacts
from avis_ctrl.gap.realisation import loop_lag, realise, sufficient_order, with_effects
from avis_ctrl.gap.state_space import drift_at
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.lti.connect import connect, lft_lower
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.realisation import with_rate_input
from avis_ctrl.lti.statespace import StateSpace, append, gain
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.file_names import DESIGN_FILE, RIG_FILE
from avis_ctrl.study.identification_design import design_toml
from avis_ctrl.study.plant import DesignPlant, Wiring, build_plant
from avis_ctrl.uncertainty.generalized_plant import Part
from avis_ctrl.uncertainty.uncertain_rig import Uncertain

# Effects whose linear part a rig or design file can describe, and where.
DESCRIBED_IN: Mapping[str, str] = {
    "com_offset": "the rig's centre of mass",
    "product_of_inertia": "the rig's inertia",
    "actuator_gain": "the motor's force constant in the rig file",
    "sensor_gain": "the sensor's sensitivity in the rig file",
    "loop_delay": "the rig's loop delay",
    "actuator_lag": "loop.amplifier_corner_Hz of the design",
    "actuator_saturation": "the rig's drive limit",
    "stiffness_drift": "the rig's stiffness at that moment",
    "contact_friction": "the rig's stiffness far below the slip, and the range of that stiffness covers it too",
}


@dataclass(frozen=True)
class DelaySettings:
    """error : error of the approximated delay, at the bandwidth of the drives [1], above which its order is raised: far
        below the uncertainty of a drive.
    most_order : largest order: the largest of a design file.
    """

    error: float = 0.02
    most_order: int = 6


SETTINGS = DelaySettings()


@dataclass(frozen=True, eq=False)
class DesignFiles:
    """A model as files of `avis design`: rig, design, and labels of the effects inside and outside these files."""

    rig: Rig
    design: Design
    inside: tuple[str, ...]
    outside: tuple[str, ...]

    def texts(self) -> dict[str, str]:
        """Contents of rig.toml and design.toml by name."""
        held = ", ".join(self.inside) or "none"
        header = f"{self.rig.name}, updated by avis gap\neffects in this folder's rig.toml and design.toml: {held}"
        if self.outside:
            header += f"\neffects that no rig or design file holds: {', '.join(self.outside)}"
        design = self.design.model_copy(update={"rig": RIG_FILE})
        return {RIG_FILE: rig_toml(self.rig, header=header), DESIGN_FILE: design_toml(design)}


def wiring_of(plant: DesignPlant, model: TableModel) -> Wiring:
    """Allocation and decoding of a plant's controller; the decoding is divided by the model's sensitivities."""
    sensors = model.sensors
    decoding = plant.decoding[:, [plant.sensors.index(name) for name in sensors.names]] / sensors.sensitivity
    return Wiring(plant.actuators, plant.allocation, tuple(sensors.names), decoding)


def plant_of(
    design: Design, model: TableModel, wiring: Wiring | None = None, when: float = 0.0, fit: Sequence[Uncertain] = ()
) -> tuple[DesignPlant, Design, Rig]:
    """Plant of a design on a model with its effects, and the design and rig that correspond to its loop.

    Parameters
    ----------
    wiring : of the controller (`wiring_of`); by default that for the model's own rig.
    when : time in the campaign, -0.5 .. 0.5, for drifts.
    fit : uncertain elements in addition to those of the design (`gap_uncertainty`).

    Raises
    ------
    InputError : as `build_plant`; impossible values of an effect.
    """
    rig, asked = _loop(model.effective.rig, design, model)
    if wiring is not None:
        wiring = replace(wiring, decoding=wiring.decoding * model.sensors.sensitivity)
    plant = build_plant(asked, rig, wiring, fit, gravity=False)
    if not model.effects:
        return plant, asked, rig
    wrapped = with_effects(plant.rig.system, model, asked.keep, when)
    systems = {part.name: part for part in plant.full.parts}
    systems["rig"] = Part("rig", "rig", _rig_part(plant, model, wrapped))
    for axis in plant.axes:
        name = f"sensor chain {axis}"
        systems.pop(f"motion of {name}", None)  # the new parts decode each sensor separately
        chain = plant.sensor_chain.renamed([f"sensed_{axis}_dot"], [f"clean_{axis}_dot"])
        # The rate of gravity acts on the velocity twice integrated.
        systems[name] = Part(name, "sensor", with_rate_input(chain, f"tilt_{axis}", 2))
    return _rebuilt(plant, tuple(systems.values()), wrapped), asked, rig


def _loop(rig: Rig, design: Design, model: TableModel) -> tuple[Rig, Design]:
    """Rig and design with the model's delay, amplifiers and drive limit; unknown amplifiers remain as in the design.

    The order of the delay is raised if the design's order is too low within its bandwidth.
    """
    delay, corner = loop_lag(model)
    # The lowest limit is used: the design has one limit for all drives.
    limits = [
        float(np.min(voltage_limits(one.by_name))) for one in model.effects if one.effect.name == "actuator_saturation"
    ]
    rig = rig.with_loop_delay(delay).with_drives_limited(min(limits, default=np.inf))
    order, _ = delay_order(design, rig)
    changes = {"pade_order": order} | ({} if corner is None else {"amplifier_corner_Hz": corner})
    return rig, design.model_copy(update={"loop": design.loop.model_copy(update=changes)})


def delay_order(design: Design, rig: Rig) -> tuple[int, float]:
    """Order of the design's delay, at least its own, and the remaining error at the bandwidth of its drives."""
    omega = 2 * np.pi * design.control_effort.bandwidth_Hz
    delay_s = rig.loop_delay_s + 0.5 / rig.sample_rate_Hz
    return sufficient_order(delay_s, omega, SETTINGS.error, SETTINGS.most_order, design.loop.pade_order)


def _rebuilt(plant: DesignPlant, parts: tuple[Part, ...], rig: StateSpace) -> DesignPlant:
    """The interconnection with other parts; signals and blocks are unchanged."""
    old = plant.full
    P = connect({part.name: part.system for part in parts}, list(old.P.inputs), list(old.P.outputs))
    full = replace(old, P=P, parts=parts)
    return replace(
        plant,
        full=full,
        synthesis=full.restricted(plant.synthesis.w, plant.synthesis.z),
        rig=replace(plant.rig, system=rig),
    )


def _rig_part(plant: DesignPlant, model: TableModel, wrapped: StateSpace) -> StateSpace:
    """The rig's motion, and the decoded deviations of the sensors and decoded effect of gravity."""
    old = next(part.system for part in plant.full.parts if part.name == "rig")
    sensors, n = list(model.sensors.names), len(plant.axes)
    keep = [axis.removesuffix("_edge") for axis in plant.axes]
    known = [k for k, name in enumerate(plant.sensors) if name in sensors]
    decoding = plant.decoding[:, known]
    names = [plant.sensors[k] for k in known]
    plain = wrapped.select(list(old.outputs), list(old.inputs))
    dot = wrapped.select(
        [f"{a}_dot" for a in plant.axes] + [f"{kind}_{k}" for kind in ("deviation", "tilt") for k in names],
        list(old.inputs),
    )
    _, rows = model.effective.rig.sensor_rows()
    own = plant.decoding @ (rows[:, [COORDINATES.index(name) for name in keep]] * (1 / lever_arms(model.rig, keep)))
    left = np.block([[own, decoding, np.zeros_like(decoding)], [np.zeros((n, n)), np.zeros_like(decoding), decoding]])
    C, D = np.vstack([plain.C, left @ dot.C]), np.vstack([plain.D, left @ dot.D])
    outputs = (*old.outputs, *(f"sensed_{a}_dot" for a in plant.axes), *(f"tilt_{a}" for a in plant.axes))
    return StateSpace(wrapped.A, plain.B, C, D, 0.0, old.inputs, outputs)


def six_dof_is_stable(design: Design, model: TableModel, plant: DesignPlant, K: StateSpace, when: float = 0.0) -> bool:
    """Whether the loop is stable with all six coordinates, the others without control: eigenvalues of a realisation.

    The loop is not modelled as in the plant: it runs from volts to volts with hold, delay and the chain of each sensor.
    It includes what the locked coordinates of a design hide (an offset centre of mass, gravity, a tilted sensor).
    """
    table = realise(model, when=when).system
    volts = table.inputs[: len(model.actuators)]
    A = np.zeros((len(volts), len(plant.axes)))
    for row, name in zip(plant.allocation, plant.actuators, strict=True):
        A[volts.index(name)] = row
    sensors = list(model.sensors.names)
    seen = plant.decoding[:, [plant.sensors.index(name) for name in sensors]] / model.sensors.sensitivity
    corner = 2 * np.pi * design.loop.amplifier_corner_Hz
    lag = cascade([], [-corner], corner) if loop_lag(model)[1] is None else gain([[1.0]])
    lags = append(*(lag.renamed([f"c{k}"], [f"d{k}"]) for k in range(len(plant.axes))))
    G = table.select(sensors, list(volts)).scaled(seen, A) @ lags
    n = len(plant.axes)
    open_loop = StateSpace(
        G.A,
        np.hstack([np.zeros((G.nstates, n)), G.B]),
        np.vstack([G.C, G.C]),
        np.block([[np.zeros((n, n)), G.D], [np.zeros((n, n)), G.D]]),
    )
    return lft_lower(open_loop, K).is_stable()


def design_files(design: Design, model: TableModel, when: float = 0.0) -> DesignFiles:
    """Rig and design for `avis design` on a model, as far as the files can describe its effects.

    The controller knows the sensitivities and force constants of the file: `avis design` calibrates them away.
    """
    rig, asked = _loop(model.effective.rig, design, model)
    changes: dict[str, float] = {}
    known = rig.parameters()

    def add(name: str, value: float) -> None:
        changes[name] = changes.get(name, known[name].value) + value

    inside: list[str] = []
    outside: list[str] = []
    factors = dict.fromkeys(model.sensors.names, 1.0)
    for one in model.effects:
        name, values = one.effect.name, one.by_name
        own = bool(one.effect.rig_changes(model, one.place, values))
        # A rig file may have one sensitivity for all sensors; a design has one pole for all amplifiers.
        single = (name == "sensor_gain" and not rig.gain_per_sensor) or (name == "actuator_lag" and "/" in one.place)
        (inside if own or (name in DESCRIBED_IN and not single) else outside).append(one.label)
        if name == "actuator_gain":
            key = rig.force_constant(one.place)
            changes[key] = changes.get(key, known[key].value) * values["gain"]
        elif name == "sensor_gain":
            factors[one.place] *= values["gain"]
        elif name == "stiffness_drift":
            change = drift_at(model, values, when)
            for key in known:
                if key.rpartition(".")[2].startswith("k_"):
                    add(key, change * known[key].value)
        elif name == "contact_friction":
            each = dict(zip(model.actuators, contacts(values), strict=True))
            for name, stiffness in each.items():
                mount, axis = model.rig.mount_of(name)[0].split(".")  # type: ignore[attr-defined]
                add(f"{mount}.k_{axis}", float(stiffness))
    return DesignFiles(
        _with_sensitivity(rig.with_parameters(changes), model, factors), asked, tuple(inside), tuple(outside)
    )


def _with_sensitivity(rig: Any, model: TableModel, factors: Mapping[str, float]) -> Any:
    """The rig with the sensitivities of the model's sensors, including effects."""
    if not rig.gain_per_sensor or model.sensors.unit != "V":
        return rig
    return rig.with_sensor_gains(
        {
            name: float(value) * factors[name]
            for name, value in zip(model.sensors.names, model.sensors.sensitivity, strict=True)
        }
    )
