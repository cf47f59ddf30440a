"""The mu controller on the nonlinear six-degree-of-freedom rig, with skyhook loops on the other axes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.lti.statespace import StateSpace, append, gain
from avis_ctrl.rigs.floor_spectrum import SpectrumModel
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.robust.mu_realise import realise_delta
from avis_ctrl.robust.mu_scan import refine_maxima
from avis_ctrl.simulation.design_check import check_designs
from avis_ctrl.simulation.discrete import digital_controller
from avis_ctrl.simulation.instability_cause import find_cause
from avis_ctrl.simulation.sampled_loop import SampledLoop, lever_arms, rig_bank
from avis_ctrl.simulation.sampled_response import predict_transmissibility_6dof
from avis_ctrl.study.dc_gain import at_rest
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.design_result import ControllerResult, Simulated, SixDofCheck
from avis_ctrl.study.identified_uncertainty import RESPONSE
from avis_ctrl.study.other_axes import Companions, design_companions, until_stable
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.study.random_plants import random_perturbations


def simulate_study(design: Design, rig: Rig, plant: DesignPlant, result: ControllerResult) -> Simulated:
    """Simulate nominal, worst-case and random plants in closed loop; each is compared with the linear prediction.

    The loops of the other axes are designed here, around this controller and for this rig's sensors.
    """
    bare = bare_loop(design, rig, plant, result.K)
    errors = plant.weights.get("actuator chain *")
    perturbed = list(perturbed_loops(design, rig, plant, result, bare))
    companions = until_stable(design_companions(bare, errors, design.floor.band_Hz), [bare, *perturbed])
    loops = [replace(one, loops=companions.systems()) for one in (bare, *perturbed)]
    rest = at_rest(loops[0])
    # The offsets that use the largest part of a drive's range; with an integrating controller there is no
    # equilibrium.
    offset = (
        [replace(one, sensors=replace(one.sensors, offset_V=rest.worst_offset_V)) for one in loops]
        if np.isfinite(rest.percent)
        else loops
    )
    check = check_designs(offset, design.simulation.duration_s, design.simulation.seed)
    unstable = [loop for loop, one in zip(loops, check.plants, strict=True) if not one.stable]
    nominal = loops[0]
    return Simulated(
        companions,
        check,
        digital_controller(nominal),
        nominal.loop_delay_s * nominal.sample_rate_Hz,
        find_cause(unstable[0]) if unstable else None,
        rest,
    )


def bare_loop(design: Design, rig: Rig, plant: DesignPlant, K: StateSpace | None) -> SampledLoop:
    """The design's controller on its nominal rig, without loops on the other axes.

    The floor moves along x, y, z and the controlled rotations.
    """
    if K is None:
        K = gain(np.zeros((len(design.keep), len(design.keep))))
    return SampledLoop(
        rig,
        K,
        tuple(design.keep),
        {},
        rig_bank(rig, design.loop.integrator_corner_Hz),
        floor_by_coordinate(design, rig, plant.floor),
        name="nominal",
        gravity=True,
        amplifier_corner_Hz=design.loop.amplifier_corner_Hz,
    )


@dataclass(frozen=True)
class SixDofSettings:
    """slowest_Hz : lowest frequency of the check [Hz]: below it geophones measure little but their own noise.
    points : frequencies from there to the lowest one of the design model."""

    slowest_Hz: float = 0.01
    points: int = 60


SETTINGS = SixDofSettings()


def six_dof_check(
    design: Design, rig: Rig, plant: DesignPlant, result: ControllerResult, companions: Companions
) -> SixDofCheck:
    """Compare the transmissibility of the sampled loop in six degrees of freedom with that of the design model.

    The frequencies are those of the design model, lower ones, the ends of the band, and points around the peaks, over
    all frequencies and in the band: a lightly damped mode is narrower than the grid.
    """
    T2 = result.transmissibility
    loop = replace(bare_loop(design, rig, plant, result.K), loops=companions.systems())
    kept = [COORDINATES.index(name) for name in design.keep]
    others = [k for k in range(6) if k not in kept]
    known: dict[float, np.ndarray] = {}

    def every(omega: np.ndarray) -> np.ndarray:
        new = np.array([w for w in omega.tolist() if w not in known])
        if new.size:
            known.update(zip(new.tolist(), predict_transmissibility_6dof(loop, new), strict=True))
        return np.array([known[w] for w in omega.tolist()])

    def sigma(omega: np.ndarray) -> np.ndarray:
        return np.linalg.norm(every(omega)[:, kept][:, :, kept], ord=2, axis=(1, 2))

    low, high = (2 * np.pi * f for f in design.transmissibility.band_Hz)
    inside = (T2.omega >= low) & (T2.omega <= high)
    slow = np.geomspace(2 * np.pi * SETTINGS.slowest_Hz, T2.omega[0], SETTINGS.points, endpoint=False)
    whole = np.unique(np.concatenate([slow, T2.omega, [low, high]]))
    band = whole[(whole >= low) & (whole <= high)]

    def alone(k: int) -> Callable[[np.ndarray], np.ndarray]:
        return lambda omega: np.abs(every(omega)[:, k, k])

    curves = [(sigma, whole), (sigma, band), *((alone(k), band) for k in others)]
    omega = np.unique(np.concatenate([refine_maxima(curve, part, curve(part))[0] for curve, part in curves]))
    if not np.any(inside):  # a band between two of the design model's frequencies
        inside = np.arange(T2.omega.size) == np.argmin(np.abs(np.log(T2.omega**2 / (low * high))))
    deviation = 20 * np.max(np.abs(np.log10(sigma(T2.omega[inside]) / T2.sigma[inside])))
    response = every(omega)
    return SixDofCheck(
        omega,
        sigma(omega),
        np.linalg.norm(response[:, kept][:, :, others], ord=2, axis=(1, 2)),
        np.abs(np.einsum("nii->ni", response)),
        float(deviation),
    )


def floor_by_coordinate(design: Design, rig: Rig, spectrum: SpectrumModel) -> dict[str, SpectrumModel]:
    """Floor spectra: the site's level for each translation, and for each kept rotation at the edge."""
    low, high = design.floor.band_Hz
    turning = spectrum.scaled_to_rms(spectrum.rms(low, high) / rig.edge_m, low, high)
    return {
        name: turning if name.startswith("phi") else spectrum
        for name in COORDINATES
        if name in design.keep or not name.startswith("phi")
    }


def perturbed_loops(
    design: Design, rig: Rig, plant: DesignPlant, result: ControllerResult, nominal: SampledLoop
) -> Iterator[SampledLoop]:
    """The worst case of transmissibility, then the random plants, as rigs with changed parameters and channels."""
    blocks = plant.synthesis.blocks
    if result.worst_peak.delta is not None:
        delta = result.worst_peak.delta[: blocks.n_w, : blocks.n_z]
        yield with_delta(rig, plant, nominal, "worst case", delta, result.worst_peak.omega)
    rng = np.random.default_rng((design.simulation.seed, 2))
    samples = random_perturbations(plant, design.simulation.random_plants, design.simulation.seed)
    for k, delta in enumerate(samples, 1):
        # The random phase of a chain is attained at a random frequency from 1 to 100 Hz.
        yield with_delta(rig, plant, nominal, f"random {k}", delta, 2 * np.pi * 10 ** rng.uniform(0.0, 2.0))


def with_delta(
    rig: Rig, plant: DesignPlant, nominal: SampledLoop, name: str, delta: np.ndarray, omega: float
) -> SampledLoop:
    """The loop around the rig with a given perturbation."""
    blocks = plant.synthesis.blocks
    real = {
        block.name: complex(np.ravel(value)[0]).real
        for value, block in zip(blocks.values(delta), blocks.blocks, strict=True)
        if block.kind == "real"
    }
    changed = rig.with_parameters(plant.rig.values([real[p.name] for p in plant.rig.parameters]))
    chains = {
        block.name: (value, block)
        for value, block in zip(blocks.values(delta), blocks.blocks, strict=True)
        if block.kind != "real"
    }
    actuators = rig.equations_of_motion().actuators
    coupling = _response_error(rig, plant, nominal.axes, chains, omega)
    drives = [_chain(plant, chains, "actuator chain", one, omega) for one in actuators]
    sensors = [_chain(plant, chains, "sensor chain", one, omega) for one in plant.sensors]
    return nominal.with_plant(name, changed, drives, sensors, coupling)


def _response_error(
    rig: Rig, plant: DesignPlant, keep: tuple[str, ...], chains: dict[str, Any], omega: float
) -> StateSpace | None:
    """I + A W(s) Delta(s) T from all drives to all drives; None if the plant has no such error.

    T maps volts to the forces on the axes, A maps the additional forces back to volts.
    """
    if RESPONSE not in chains:
        return None
    value, block = chains[RESPONSE]
    delta = realise_delta(np.asarray(value), omega, [block])
    n = len(keep)
    W = append(*[plant.weights[RESPONSE].system(f"f{k}", f"z{k}") for k in range(n)])
    axes = actuator_axes(rig, keep)
    lever = lever_arms(rig, keep)
    T = axes.matrix[[COORDINATES.index(name) for name in keep]] / lever[:, None]
    error = delta.renamed([f"z{k}" for k in range(n)], [f"w{k}" for k in range(n)]) @ W
    volts = list(axes.actuators)
    return gain(np.eye(len(volts)), volts, volts) + gain(axes.allocation * lever) @ error @ gain(T)


def _chain(plant: DesignPlant, chains: dict[str, Any], kind: str, name: str, omega: float) -> StateSpace | None:
    """1 + W(s) delta(s) of one channel; None if the channel is certain."""
    if f"{kind} {name}" not in chains:
        return None
    value, block = chains[f"{kind} {name}"]
    delta = realise_delta(np.atleast_2d(value), omega, [block])
    weight = plant.weights[f"{kind} *"].system("u", "z")
    error = delta.renamed(["z"], ["w"]) @ weight
    return gain(1.0, ["u"], ["w"]) + error
