"""Closed-loop simulation of the certificate's worst plant, a nonlinear six-axis table, with the compiled code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avis_ctrl.export.certificate import Certificate
from avis_ctrl.export.compiled import CompiledController
from avis_ctrl.export.design_folder import DesignFolder
from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.simulation import with_delta


@dataclass(frozen=True)
class CompiledSimulationSettings:
    """settle_s : time before the measurement; covers the start of the code and the slowest poles of such loops, about
    0.02 Hz. periods : number of whole periods of the sine that are measured. velocity_rms : r.m.s. of the floor's sine
    over the site's velocity; the table is then as nonlinear as at the site."""

    settle_s: float = 40.0
    periods: int = 4
    velocity_rms: float = 1.0


@dataclass(frozen=True, eq=False)
class CompiledSimulation:
    """gain : payload velocity over floor velocity of the kept axes, in the worst direction of the sine; inf if the loop
    diverged. record : of the measured periods."""

    gain: float
    record: SimulationRecord


def simulate_worst_plant(
    folder: DesignFolder,
    certificate: Certificate,
    controller: SampledController,
    files: Mapping[str, str],
    settings: CompiledSimulationSettings = CompiledSimulationSettings(),
) -> CompiledSimulation:
    """Move the floor of the worst plant with a sine at the worst frequency, in the worst direction.

    The motion caused by sensor and converter noise is subtracted. It comes from a second simulation with the same noise
    and the floor at rest.

    Raises
    ------
    ComputationError : no compiler, or source that does not compile.
    """
    worst, design, rig = certificate.worst, folder.design, folder.rig
    loop = with_delta(rig, folder.plant, certificate.loop, "worst case", worst.delta, worst.omega)
    kept = [COORDINATES.index(name) for name in design.keep]
    arms = lever_arms(rig)[kept]
    rate = loop.sample_rate_Hz
    settle = round(settings.settle_s * rate)
    measured = round(settings.periods * 2 * np.pi / worst.omega * rate)
    time = np.arange(settle + measured + 1) / rate
    low, high = design.floor.band_Hz
    size = settings.velocity_rms * np.sqrt(2) * folder.plant.floor.rms(low, high)
    floor = np.zeros((time.size, len(COORDINATES)))
    floor[:, kept] = size * np.real(worst.direction * np.exp(1j * worst.omega * time)[:, None]) / arms
    code = CompiledController(files, controller)
    record = simulate(loop, measured / rate, settle_s=settle / rate, floor=floor, code=code.step)
    if record.diverged:
        return CompiledSimulation(np.inf, record)
    code.reset()
    noise = simulate(loop, measured / rate, settle_s=settle / rate, floor=0 * floor, code=code.step)
    wave = np.exp(-1j * worst.omega * (record.time + settle / rate))[:, None]
    moved = 2 * np.mean((record.q_dot - noise.q_dot)[:, kept] * arms * wave, axis=0)
    return CompiledSimulation(float(np.linalg.norm(moved) / size), record)
