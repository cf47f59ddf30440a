"""Generalized plant of a design and a rig, with the physical channels that evaluate it.

    floor velocity, forces ->  rig (uncertain parameters)  -> payload velocity -> sensor chains -> seen velocity (y)
    force commands (u) -> delay -> amplifier -> allocation -> volts -> neglected dynamics of each chain -> rig

The seen velocity is the measured one; a chain is one sensor or drive channel. One diagram contains the weighted
channels for synthesis and the physical channels (transmissibility, compliance, volts, noise) for analysis, so both use
the same plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.connect import summing_junction
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.realisation import with_rate_input
from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.rigs.delay_models import pade_delay
from avis_ctrl.rigs.floor_spectrum import SpectrumModel, shipped_spectrum
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES, GRAVITY
from avis_ctrl.rigs.sensing import NoiseGroup, Sensing, sensing
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.design_file import ChainUncertainty, Design, EffortSection
from avis_ctrl.study.identified_uncertainty import RESPONSE, InDesign, in_design
from avis_ctrl.uncertainty.blocks import ComplexFull
from avis_ctrl.uncertainty.generalized_plant import Diagram, GeneralizedPlant
from avis_ctrl.uncertainty.uncertain_rig import Uncertain, UncertainRig, uncertain_rig
from avis_ctrl.uncertainty.weight_base import Weight
from avis_ctrl.uncertainty.weights import (
    ComplianceBound,
    ControlEffort,
    FlickerNoise,
    NeglectedDynamics,
    TransmissibilityBound,
)

# Name of the weight on the drives in `DesignPlant.weights`; followed by the axis if the drives' limits differ.
EFFORT = "control effort"
NOISE = "1/f noise"


@dataclass(frozen=True, eq=False)
class DesignPlant:
    """The plant for synthesis and analysis.

    Attributes
    ----------
    full : generalized plant with weighted and physical channels.
    synthesis : the same, weighted channels only.
    rig : the uncertain rig inside.
    axes : kept coordinates (those that the design controls), rotations named as edge displacements ("phi_x_edge").
    actuators : channels that the kept axes use.
    allocation : (n_actuators, n_axes) volts per newton on each axis (edge force for rotations).
    decoding : (n_axes, n_sensors) axis velocity (edge velocity) per velocity along each sensor.
    sensor_chain : velocity -> seen velocity of one axis, unit passband gain.
    sensor_noise : white noise of unit density -> noise of one sensor as velocity [m/s/sqrt(Hz)]; for the first kind of
        sensor if there are several.
    noises : inputs of the sensors' noise, with the weight of the 1/f noise of each. relative : axes whose velocity is
        measured relative to the chassis.
    floor_density : mean velocity density of the floor [m/s/sqrt(Hz)]: the unit of the noise inputs.
    floor : spectrum of the floor motion, the same for each kept axis.
    weights : the weighting filters by name, with their meaning, for the report.
    identified : uncertainty from an identification, if the design names one.
    """

    full: GeneralizedPlant
    synthesis: GeneralizedPlant
    rig: UncertainRig
    axes: tuple[str, ...]
    actuators: tuple[str, ...]
    sensors: tuple[str, ...]
    allocation: np.ndarray
    decoding: np.ndarray
    sensor_chain: StateSpace
    sensor_noise: StateSpace
    floor_density: float
    floor: SpectrumModel
    weights: dict[str, Weight]
    identified: InDesign | None = None
    noises: Mapping[str, FlickerNoise] = field(default_factory=dict)
    relative: tuple[str, ...] = ()

    @property
    def floor_velocities(self) -> list[str]:
        """Inputs of the floor motion, one per axis."""
        return [f"floor_{axis}_dot" for axis in self.axes]

    @property
    def velocities(self) -> list[str]:
        """Outputs of the payload's velocity, one per axis."""
        return [f"{axis}_dot" for axis in self.axes]

    def effort_weight(self, axis: str) -> Weight:
        """The weight on the control effort of an axis; a common one if the drives have the same limit."""
        return self.weights.get(EFFORT) or self.weights[f"{EFFORT} {axis}"]

    @property
    def volts(self) -> list[str]:
        """Outputs of the drive voltages."""
        return [f"{name}_command" for name in self.actuators]


@dataclass(frozen=True, eq=False)
class Wiring:
    """Connection of an existing controller.

    allocation : (n_u, n_axes) volts per newton of the named actuators. decoding : (n_axes, n_y) axis velocity per
        velocity along the named sensors; other sensors are not used.
    """

    actuators: tuple[str, ...]
    allocation: np.ndarray
    sensors: tuple[str, ...]
    decoding: np.ndarray


def build_plant(
    design: Design, rig: Rig, wiring: Wiring | None = None, fit: Sequence[Uncertain] = (), gravity: bool = True
) -> DesignPlant:
    """The generalized plant of a design.

    wiring : of a controller made for another rig; by default that for this rig. fit : uncertain elements in addition to
        those of the design. gravity : whether the sensors of horizontal motion measure the tilt of the kept axes.

    Raises InputError: parameters or axes that the rig does not have, axes that its actuators cannot drive or its
    sensors cannot separate; an identification of another rig or other coordinates.
    """
    identified = _identified(design, rig)
    directions = identified.directions if identified else ()
    uncertain = uncertain_rig(rig, [*design.uncertainty.of(rig), *directions, *fit], design.keep)
    axes = uncertain.coordinates
    lever = lever_arms(rig, design.keep)
    allocation = actuator_axes(rig, design.keep)
    # An edge force F at lever e is a moment F e.
    matrix = allocation.allocation * lever
    if wiring is not None:
        matrix = np.zeros_like(matrix)
        matrix[[allocation.actuators.index(name) for name in wiring.actuators]] = wiring.allocation
    used = [k for k in range(len(allocation.actuators)) if np.any(np.abs(matrix[k]) > 1e-9 * np.abs(matrix).max())]
    actuators = tuple(allocation.actuators[k] for k in used)
    seen = sensing(rig, design.keep, design.loop.integrator_corner_Hz)
    decoder = seen.decoder
    decoding = decoder.decoding * lever[:, None]
    if wiring is not None:
        decoding = np.zeros_like(decoding)
        decoding[:, [decoder.sensors.index(name) for name in wiring.sensors]] = wiring.decoding
    # Motion and apparent acceleration along each sensor per unit of the kept axes, rotations at the edge.
    kept = [COORDINATES.index(name) for name in design.keep]
    rows, tilt = decoder.matrix[:, kept] / lever, rig.tilt_rows()[:, kept] / lever * gravity

    floor = floor_spectrum(design, rig)
    low, high = design.floor.band_Hz
    reference = floor.rms(low, high) / np.sqrt(high - low)
    connection = _Connection(design, rig, axes, actuators, matrix[used])
    connection.rig_part(uncertain)
    connection.actuator_side(identified)
    flicker = [FlickerNoise(one.flicker, low) for one in seen.noise]
    noises = connection.sensor_side(seen, decoding, (rows, tilt), flicker, reference)
    offset = max(
        _offset(design.control_effort, one, weight, len(axes), reference)
        for one, weight in zip(seen.noise, flicker, strict=True)
    )
    connection.performance(offset)
    inputs = {name: one.weight for one in noises for name in one.inputs}
    w = [*(f"floor_{a}_dot" for a in axes), *inputs, *(f"force_{a}" for a in axes)]
    weighted = [*(f"e_{a}" for a in axes), *(f"effort_{a}" for a in axes)]
    compliance = [f"compliance_{a}" for a in axes] if design.compliance else []
    physical = [*(f"{a}_dot" for a in axes), *(f"{a}_rel" for a in axes), *(f"{n}_command" for n in actuators)]
    u, y = [f"command_{a}" for a in axes], [f"seen_{a}_dot" for a in axes]
    full = connection.diagram.plant(w, [*weighted, *compliance, *physical], u, y)
    asked = w if design.compliance else w[: len(axes) + len(inputs)]
    return DesignPlant(
        full,
        full.restricted(asked, [*weighted, *compliance]),
        uncertain,
        axes,
        actuators,
        decoder.sensors,
        matrix[used],
        decoding,
        seen.chain,
        seen.noise[0].shape,
        reference,
        floor,
        connection.weights,
        identified,
        inputs,
        tuple(axis for axis, name in zip(axes, design.keep, strict=True) if name in seen.relative),
    )


def _identified(design: Design, rig: Rig) -> InDesign | None:
    """The identification's directions and filter; the filter includes what the design declares of its drives."""
    content = design.uncertainty.identification
    if content is None:
        return None
    declared, factor = None, 1.0
    if (chains := design.uncertainty.actuator_chains) is not None:
        declared = neglected_dynamics(chains)
        factor = channels_gain(rig, design.keep)
    return in_design(content, rig, design.keep, design.uncertainty.confidence_percent / 100, declared, factor)


def channels_gain(rig: Rig, keep: Sequence[str]) -> float:
    """Largest joint error of the axes' forces for independent errors of at most 1 in the channels: |T| |A|.

    With T A = I, any errors E = diag(e_k), |e_k| <= 1, give |T E A| <= |T| |A|; this is 1 if every channel serves the
    axes alike.
    """
    lever = lever_arms(rig, keep)
    found = actuator_axes(rig, keep)
    used = np.any(np.abs(found.allocation) > 1e-9 * np.abs(found.allocation).max(), axis=1)
    T = found.matrix[[COORDINATES.index(name) for name in keep]][:, used] / lever[:, None]
    return float(np.linalg.norm(T, 2) * np.linalg.norm((found.allocation * lever)[used], 2))


def floor_spectrum(design: Design, rig: Rig) -> SpectrumModel:
    """The design's floor motion: the measured spectrum, scaled to the site's r.m.s. velocity."""
    rms = design.floor.velocity_rms_m_per_s
    if rms is None:
        if rig.ambient is None:
            raise InputError(
                "the rig file has no [ambient] section: give the floor's r.m.s. velocity here",
                field="floor.velocity_rms_m_per_s",
            )
        rms = rig.ambient.floor_velocity_rms_m_per_s
    return shipped_spectrum(design.floor.spectrum).scaled_to_rms(rms, design.floor.band_Hz[0], design.floor.band_Hz[1])


# Meaning and unit of the signals of each axis, of each noise ("axis", or "axis_2" for a second kind of sensor), and of
# each actuator channel.
OF_AXES = {
    "floor_{}_dot": ("velocity of the floor", "m/s"),
    "{}_dot": ("velocity of the payload", "m/s"),
    "{}_rel": ("displacement of the payload relative to the floor", "m"),
    "force_{}": ("force on the payload", "N"),
    "command_{}": ("force commanded by the controller", "N"),
    "drive_{}": ("commanded force after delay and amplifier", "N"),
    "clean_{}_dot": ("velocity within the sensor band", "m/s"),
    "{}_in_space": ("velocity within the sensor band", "m/s"),
    "{}_against_chassis": ("velocity within the sensor band", "m/s"),
    "seen_{}_dot": ("measured velocity", "m/s"),
    "chain_error_{}": ("contribution of neglected sensor dynamics to the velocity", "m/s"),
    "e_{}": ("payload velocity relative to its bound", "1"),
    "effort_{}": ("drive voltage relative to its limit", "1"),
    "compliance_{}": ("displacement relative to its bound", "1"),
}
OF_NOISES = {
    "mixed_noise_{}": ("noise of the sensors used for this axis, before its filter", "1"),
    "noise_{}": ("sensor noise that accompanies 1 m/s of floor velocity", "1"),
    "sensor_noise_{}": ("sensor noise as velocity", "m/s"),
}
OF_CHANNELS = {
    "{}": ("voltage that acts at the motor", "V"),
    "{}_command": ("voltage of the channel", "V"),
    "{}_error": ("voltage equivalent to the response error", "V"),
}


def neglected_dynamics(chains: ChainUncertainty) -> NeglectedDynamics:
    """The filter of the neglected dynamics of channels."""
    return NeglectedDynamics(chains.low_percent / 100, chains.crossover_Hz, chains.high_percent / 100)


def _offset(effort: EffortSection, group: NoiseGroup, noise: FlickerNoise, axes: int, reference: float) -> float:
    """Factor of the control effort's weight at zero frequency with which mu below 1 bounds the voltage for the offset.

    One unit of noise accompanies 1 m/s of floor velocity (`sensor_side`) and may use as much of the drive as a floor
    velocity of floor_velocity_m_per_s; the offset may use offset_percent of this. Offsets of n sensors, each of either
    sign, lie within sqrt(n) times the ellipsoid of independent offsets. The voltages of m axes add up to at most
    sqrt(m) times their norm.
    """
    spread = np.sqrt(np.count_nonzero(group.share) * axes)
    allowed = effort.offset_percent / 100 * effort.floor_velocity_m_per_s
    return float(spread * group.offset_rtHz * reference / allowed / noise.magnitude(np.zeros(1))[0])


class _Connection:
    """The diagram of a plant and its weights, part by part.

    allocation : (n_actuators, n_axes) volts per newton on each axis.
    """

    def __init__(
        self, design: Design, rig: Rig, axes: tuple[str, ...], actuators: tuple[str, ...], allocation: np.ndarray
    ) -> None:
        self.design, self.rig, self.axes, self.actuators, self.allocation = design, rig, axes, actuators, allocation
        self.diagram, self.weights = Diagram(), dict[str, Weight]()
        self._mean(OF_AXES, axes)
        self._mean(OF_CHANNELS, actuators)

    def _mean(self, meanings: Mapping[str, tuple[str, str]], names: Sequence[str]) -> None:
        for pattern, (meaning, unit) in meanings.items():
            for name in names:
                self.diagram.means(pattern.format(name), meaning, unit)

    def _each(self, pattern: str) -> list[str]:
        """A signal of each axis."""
        return [pattern.format(axis) for axis in self.axes]

    def rig_part(self, uncertain: UncertainRig) -> None:
        """The rig with its uncertain parameters."""
        system = uncertain.system
        w, z = ([n for n in names if n.startswith(p)] for names, p in ((system.inputs, "w:"), (system.outputs, "z:")))
        outputs = [*z, *self._each("{}_dot"), *self._each("{}_rel")]
        inputs = [*w, *self.actuators, *self._each("floor_{}_dot"), *self._each("force_{}")]
        self.diagram.add("rig", system.select(outputs, inputs), "rig")
        place = 0
        for block in uncertain.blocks.blocks:
            names = w[place : place + block.rows]
            place += block.rows
            self.diagram.uncertain(block, names, [f"z:{name[2:]}" for name in names])

    def actuator_side(self, identified: InDesign | None) -> None:
        """Delay including the converter's hold, amplifier, allocation, neglected dynamics."""
        loop = self.design.loop
        corner = 2 * np.pi * loop.amplifier_corner_Hz
        # A zero-order hold delays by half a sample on average.
        delay_s = self.rig.loop_delay_s + 0.5 / self.rig.sample_rate_Hz
        for axis in self.axes:
            lag = cascade([], [-corner], corner) @ pade_delay(delay_s, loop.pade_order)
            lag = lag.renamed([f"command_{axis}"], [f"drive_{axis}"])
            self.diagram.add(f"delay and amplifier {axis}", lag, "actuator")
        # Voltages at the amplifiers, to which the limits apply, after delay and lag (both of unit gain).
        commands = [f"{name}_command" for name in self.actuators]
        self.diagram.add("allocation", gain(self.allocation, self._each("drive_{}"), commands), "allocation")
        if identified is not None:
            self._response_error(identified)
        else:
            self._neglected_dynamics(self.design.uncertainty.actuator_chains)

    def _response_error(self, identified: InDesign) -> None:
        """(I + W Delta) on the axes' forces, Delta full: difference of the measured from the identified response.

        Errors per channel do not suffice: an error on one axis by the force of another need not be a channel error.
        """
        diagram, n = self.diagram, len(self.axes)
        self.weights[RESPONSE] = identified.weight
        tags = [f"{RESPONSE}[{k}]" if n > 1 else RESPONSE for k in range(n)]
        w, z = [f"w:{tag}" for tag in tags], [f"z:{tag}" for tag in tags]
        for axis, force, filtered in zip(self.axes, w, z, strict=True):
            diagram.add(f"W {RESPONSE} {axis}", identified.weight.system(f"drive_{axis}", filtered), "weight")
            diagram.means(force, "force by which the response differs from the identified one", "N")
        errors = gain(self.allocation, w, [f"{name}_error" for name in self.actuators])
        diagram.add("identified response error", errors, "allocation")
        for name in self.actuators:
            total = summing_junction(name, [f"{name}_command", f"{name}_error"])
            diagram.add(f"actuator chain {name}", total, "actuator")
        diagram.uncertain(ComplexFull(n, n, RESPONSE), w, z)

    def _neglected_dynamics(self, uncertainty: ChainUncertainty | None) -> None:
        """(1 + W delta) in each actuator channel: neglected dynamics as multiplicative input uncertainty."""
        for name in self.actuators:
            label, command = f"actuator chain {name}", f"{name}_command"
            if uncertainty is None:
                self.diagram.add(label, gain([[1.0]], [command], [name]), "actuator")
                continue
            weight = self.weights.setdefault("actuator chain *", neglected_dynamics(uncertainty))
            self.diagram.add(f"W {label}", weight.system(command, f"z:{label}"), "weight")
            self.diagram.add(label, gain([[1.0, 1.0]], [command, f"w:{label}"], [name]), "actuator")
            self.diagram.uncertain(ComplexFull(1, 1, label), [f"w:{label}"], [f"z:{label}"])

    def sensor_side(
        self,
        seen: Sensing,
        decoding: np.ndarray,
        rows: tuple[np.ndarray, np.ndarray],
        flicker: Sequence[FlickerNoise],
        reference: float,
    ) -> list[_Noise]:
        """Sensor chains of the logical axes and their noise. The chains are equal, so decoding and chain commute.

        rows : (n_s, n_axes) each, from the axes' motion to the motion along each sensor, and to its apparent
            acceleration by gravity.

        One unit of noise accompanies 1 m/s of floor velocity: sensor density over floor density.
        """
        uncertainty = self.design.uncertainty.sensor_chains
        groups = [
            _Noise.of(self.axes, group, weight, decoding, reference, k)
            for k, (group, weight) in enumerate(zip(seen.noise, flicker, strict=True))
        ]
        inertial = seen.decoder.inertial
        # Decoded motion in space, and decoded motion relative to the chassis.
        by_velocity, by_relative = (decoding[:, one] @ rows[0][one] for one in (inertial, ~inertial))
        by_tilt = decoding @ rows[1]
        for k, axis in enumerate(self.axes):
            both = (
                (by_velocity[k], "dot", seen.chain, f"sensor chain {axis}", f"{axis}_in_space"),
                (by_relative[k], "rel", seen.relative_chain, f"position chain {axis}", f"{axis}_against_chassis"),
            )
            ways = [one for one in both if np.any(np.abs(one[0]) > 1e-9)]
            clean = f"clean_{axis}_dot"
            for row, of, chain, label, made in ways:
                assert chain is not None
                tilt = by_tilt[k] if of == "dot" else np.zeros(len(self.axes))
                self._sensor_chain(k, (row, tilt), of, chain, label, clean if len(ways) == 1 else made)
            if len(ways) > 1:
                self.diagram.add(f"motion sum {axis}", summing_junction(clean, [made for *_, made in ways]), "sum")
            own = [f"{axis}{one.tag}" for one in groups if axis in one.axes]
            for one in groups:
                if axis in one.axes:
                    one.add(self.diagram, axis)
            errors = [f"chain_error_{axis}"] if uncertainty is not None else []
            terms = [clean, *(f"sensor_noise_{name}" for name in own), *errors]
            self.diagram.add(f"sum {axis}", summing_junction(f"seen_{axis}_dot", terms), "sum")
            self._mean(OF_NOISES, own)
        for one in groups:
            mixing = gain(one.mix, one.inputs, [f"mixed_{name}" for name in one.inputs])
            self.diagram.add(f"noise mixing{one.tag}", mixing, "allocation")
        self.weights |= {f"{NOISE}{one.tag}": one.weight for one in groups if one.weight.flicker}
        if uncertainty is not None:
            self._sensor_errors(uncertainty, seen.decoder.sensors, rows[0], decoding)
        return groups

    def _sensor_chain(
        self, k: int, rows: tuple[np.ndarray, np.ndarray], of: str, chain: StateSpace, label: str, made: str
    ) -> None:
        """The common sensor chain of axis k, applied to its decoded motion and to gravity; rows (n_axes,) each."""
        axes, diagram = self.axes, self.diagram
        read, (row, tilt) = f"{axes[k]}_{of}", rows
        if np.max(np.abs(row - np.eye(len(axes))[k])) > 1e-9:
            felt = [a for a in range(len(axes)) if abs(row[a]) > 1e-9]
            read = f"{made}_motion"
            diagram.add(f"motion of {label}", gain(row[None, felt], [f"{axes[a]}_{of}" for a in felt], [read]), "sum")
            diagram.means(read, "motion decoded for this axis, before the sensor chain", "m/s" if of == "dot" else "m")
        system = chain.renamed([read], [made])
        if felt := [a for a in range(len(axes)) if abs(tilt[a]) > 1e-9 * GRAVITY]:
            # The input of the chain is velocity: the rate of the apparent acceleration is integrated twice.
            gravity = gain(tilt[None, felt], [f"{axes[a]}_dot" for a in felt], [f"{made}_tilt"])
            diagram.add(f"gravity in {label}", gravity, "sum")
            diagram.means(f"{made}_tilt", "rate of what gravity adds to the measured acceleration", "m/s^3")
            system = with_rate_input(system, f"{made}_tilt", 2)
        diagram.add(label, system, "sensor")

    def _sensor_errors(
        self, uncertainty: ChainUncertainty, sensors: tuple[str, ...], rows: np.ndarray, decoding: np.ndarray
    ) -> None:
        """Errors of the decoded velocities by the neglected dynamics of each sensor chain: decoding (W Delta) rows."""
        weight = self.weights["sensor chain *"] = neglected_dynamics(uncertainty)
        used = [k for k, row in enumerate(rows) if np.any(np.abs(row) > 1e-9) and np.any(np.abs(decoding[:, k]) > 1e-9)]
        labels = [f"sensor chain {sensors[k]}" for k in used]
        for k, label in zip(used, labels, strict=True):
            motion = gain([rows[k]], self._each("clean_{}_dot"), [f"{sensors[k]}_dot"])
            self.diagram.add(f"at {sensors[k]}", motion, "sum")
            self.diagram.add(f"W {label}", weight.system(f"{sensors[k]}_dot", f"z:{label}"), "weight")
            self.diagram.uncertain(ComplexFull(1, 1, label), [f"w:{label}"], [f"z:{label}"])
        errors = gain(decoding[:, used], [f"w:{label}" for label in labels], self._each("chain_error_{}"))
        self.diagram.add("decoding of errors", errors, "allocation")

    def performance(self, offset: float) -> None:
        """Weighted outputs, per m/s of floor velocity (compliance: per newton)."""
        asked, effort = self.design.transmissibility, self.design.control_effort
        limits_V = self.rig.limits_of(self.actuators)
        low, high = asked.band_Hz
        bound = TransmissibilityBound(
            asked.peak_dB, (low, high), asked.band_dB, asked.transition_octaves, asked.tolerance_dB
        )
        self.weights["transmissibility"] = bound
        load = np.abs(self.allocation) * (limits_V.max() / limits_V)[:, None]
        for k, axis in enumerate(self.axes):
            self.diagram.add(f"W_T {axis}", bound.system(f"{axis}_dot", f"e_{axis}"), "weight")
            # Voltage of the channel that reaches its limit first for a force on this axis.
            first = int(np.argmax(load[:, k]))
            weight = ControlEffort(
                float(limits_V[first]),
                effort.floor_velocity_m_per_s,
                effort.bandwidth_Hz,
                effort.reduction,
                offset,
                effort.offset_corner_Hz,
            )
            self.weights[f"{EFFORT} {axis}" if np.ptp(limits_V) else EFFORT] = weight
            volts = float(np.abs(self.allocation[first, k]))
            system = weight.system(f"command_{axis}", f"effort_{axis}").scaled(right=volts)
            self.diagram.add(f"W_u {axis}", system, "weight")
        if self.design.compliance:
            allowed = self.weights["compliance"] = ComplianceBound(self.design.compliance.limit_m_per_N)
            for axis in self.axes:
                self.diagram.add(f"W_c {axis}", allowed.system(f"{axis}_rel", f"compliance_{axis}"), "weight")


@dataclass(frozen=True, eq=False)
class _Noise:
    """Noise of one kind of sensor on the axes decoded from it; the decoding correlates the axes."""

    shape: StateSpace
    weight: FlickerNoise
    axes: tuple[str, ...]
    mix: np.ndarray
    tag: str

    @staticmethod
    def of(
        axes: tuple[str, ...],
        group: NoiseGroup,
        weight: FlickerNoise,
        decoding: np.ndarray,
        reference: float,
        number: int,
    ) -> _Noise:
        own = decoding * group.share
        served = [k for k in range(len(axes)) if np.any(np.abs(own[k]) > 1e-9)]
        # own = L Q: L is a square root of own own', even if this is singular (fewer sensors of this kind than axes).
        root = np.asarray(np.linalg.qr(own[served].T, mode="r"))
        mix = (root * np.where(np.diag(root) < 0, -1.0, 1.0)[:, None]).T / reference
        shape = group.shape @ weight.system(*group.shape.inputs, *group.shape.inputs)
        return _Noise(shape, weight, tuple(axes[k] for k in served), mix, f"_{number + 1}" if number else "")

    @property
    def inputs(self) -> list[str]:
        return [f"noise_{axis}{self.tag}" for axis in self.axes]

    def add(self, diagram: Diagram, axis: str) -> None:
        """The noise of one axis."""
        name = f"{axis}{self.tag}"
        diagram.add(f"noise {name}", self.shape.renamed([f"mixed_noise_{name}"], [f"sensor_noise_{name}"]), "weight")
