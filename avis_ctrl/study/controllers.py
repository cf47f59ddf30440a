"""The controllers that a study compares, each made on the same plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.classical.skyhook import Skyhook, critical_damping
from avis_ctrl.classical.tuning import Scenarios, TuningRange, tune_skyhook
from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.frequency_grid import merged, resonances
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.mu_peak import worst_case_gain
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn import MuSynthesis, musyn
from avis_ctrl.robust.reduction import reduce_controller, residualise_fast
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.model import ControllerKind
from avis_ctrl.study.plant import DesignPlant

# Coarse: it only ranks controllers of different order; what is reported is computed on the one chosen. The resonances
# of the table at rest and the peak of mu join it, for both are narrower than its steps.
REDUCTION_HZ = np.geomspace(0.05, 300.0, 25)
# Tilt corner well below the table's modes, roll-off well above its loops' band.
CUSTOMARY_CORNERS_HZ = (0.1, 100.0)
TUNING_HZ = np.concatenate([np.geomspace(0.1, 5.0, 20), np.geomspace(5.5, 200.0, 44), [300.0, 400.0]])
TUNING_SAMPLES = 16
TUNING_ROUNDS = 6
TUNING_SLACK = 2e-2


@dataclass(frozen=True, eq=False)
class Candidate:
    """A controller to be analysed."""

    name: str
    title: str
    kind: ControllerKind
    K: StateSpace | None
    notes: tuple[str, ...] = ()


def passive() -> Candidate:
    """Actuators at rest."""
    return Candidate("passive", "passive", "passive", None)


def nominal_hinf(design: Design, plant: DesignPlant, rig: Rig) -> Candidate:
    """H-infinity controller of the weighted performance of the nominal plant: no D-K, no uncertainty."""
    nominal = plant.synthesis.nominal()
    made = hinfsyn(nominal.P, nominal.nmeas, nominal.ncon, backoff=design.synthesis.backoff_percent / 100,
                   sample_rate_Hz=rig.sample_rate_Hz)
    return Candidate("hinf", "H-infinity, nominal", "hinf", made.K, made.notes)


def mu_optimal(design: Design, plant: DesignPlant, rig: Rig,
               callback: Callable[[Any], Any] | None = None) -> tuple[Candidate, MuSynthesis]:
    """D-K iteration on the whole uncertainty set, then the lowest order that keeps its mu."""
    P = plant.synthesis
    asked = design.synthesis
    # D-K iteration stalls at 1.24 on one plant and reaches 0.88 on another that differs by a per cent.
    polish = asked.target_mu is not None if asked.polish is None else asked.polish
    made = musyn(P.P, P.blocks, P.nmeas, P.ncon, callback=callback, target=asked.target_mu, polish=polish,
                 time_limit=asked.time_limit_s, max_iterations=asked.max_iterations,
                 backoff=asked.backoff_percent / 100, sample_rate_Hz=rig.sample_rate_Hz)
    blocks = P.all_blocks.complexified()
    omega = reduction_grid(plant, made.omega_peak)

    def peak_on_grid(K: StateSpace) -> float:
        return float(np.max(upper_bound(P.closed(K).frequency_response(omega)[:, None], blocks, 1e-3).beta))
    # Poles beyond the Nyquist frequency cannot be implemented; what removing them costs is in the measured figure.
    full, slow = peak_on_grid(made.K), residualise_fast(made.K, np.pi * rig.sample_rate_Hz)
    harmless = P.closed(slow).is_stable() and peak_on_grid(slow) <= (1 + asked.reduction_cost_percent / 100) * full
    reduced = reduce_controller(P.P, slow if harmless else made.K, peak_on_grid, asked.reduction_cost_percent / 100)
    note = (f"reduced from {made.K.nstates} to {reduced.order} states: complex mu on a grid of {omega.size} "
            f"frequencies from {full:.4f} to {reduced.figure:.4f}")
    before = tuple(f"before reduction: {one}" for one in made.notes)
    return Candidate("mu", "mu synthesis", "mu", reduced.K, (made.status, *before, note)), made


def reduction_grid(plant: DesignPlant, omega_peak: float) -> np.ndarray:
    """Frequencies [rad/s] at which controllers of lower order are compared, the peaks that mu may have among them."""
    even = 2 * np.pi * REDUCTION_HZ
    at_rest = resonances(plant.rig.system.poles())
    return merged(even, np.append(at_rest, omega_peak))


def classical_skyhook(plant: DesignPlant, rig: Rig, design: Design) -> Candidate:
    """Critical damping of each axis taken alone, with customary corners."""
    loops = Skyhook(plant.axes, critical_gains(rig, design.keep), *CUSTOMARY_CORNERS_HZ)
    return Candidate("skyhook_classical", "skyhook, critical damping", "skyhook", loops.controller(), (_words(loops),))


def tuned_skyhook(plant: DesignPlant, rig: Rig, design: Design, peak_limit: float) -> Candidate:
    """The skyhook with the lowest worst-case transmissibility in the band whose worst-case peak stays below a limit.

    The search runs on samples; the bound over the whole set is then computed, and where it is above the limit its
    worst case joins the samples.
    """
    omega = 2 * np.pi * TUNING_HZ
    scenarios = Scenarios.sample(plant.full, plant.floor_velocities, plant.velocities, omega, TUNING_SAMPLES,
                                 design.simulation.seed)
    search = TuningRange(critical_gains(rig, design.keep), tilt_corner_Hz=_pair(design.skyhook.tilt_corner_Hz),
                         roll_off_Hz=_pair(design.skyhook.roll_off_Hz))
    band = _pair(design.transmissibility.band_Hz)
    motion = plant.full.restricted(plant.floor_velocities, plant.velocities)
    limit = peak_limit
    for round_number in range(TUNING_ROUNDS):
        try:
            loops = tune_skyhook(scenarios, plant.axes, search, band, limit, seed=design.simulation.seed + round_number)
        except ComputationError as error:
            # Many axes make a search of many dimensions; the study goes on with loops that anyone would try first.
            classical = classical_skyhook(plant, rig, design)
            return replace(classical, name="skyhook", title="skyhook, tuned",
                           notes=(f"critical damping in its place: {error}", *classical.notes))
        found = worst_case_gain(motion.closed(loops.controller()), motion.blocks, slack=TUNING_SLACK)
        if found.upper <= peak_limit:
            break
        if found.delta is not None:
            scenarios = scenarios.with_delta(found.delta[:motion.blocks.n_w, :motion.blocks.n_z])
        # In small steps: a limit below 1 is out of reach, the payload follows the floor at low frequency.
        limit *= float(np.clip(0.98 * peak_limit / found.upper, 0.95, 1.0))
    notes = [_words(loops)]
    if found.upper > peak_limit:
        notes.append(f"no tuning found keeps the worst-case peak at {peak_limit:.3g}: this one has {found.upper:.3g}")
    return Candidate("skyhook", "skyhook, tuned", "skyhook", loops.controller(), tuple(notes))


def critical_gains(rig: Rig, axes: Sequence[str]) -> tuple[float, ...]:
    """Classical gains [N s/m] of some axes, rotations at the edge."""
    equations = rig.equations_of_motion()
    kept = [equations.coordinates.index(name) for name in axes]
    scale = np.array([1.0 / rig.edge_m ** 2 if name.startswith("phi") else 1.0 for name in axes])
    return tuple(critical_damping(*(np.diag(X)[kept] * scale for X in (equations.M, equations.K, equations.C))))


def _pair(limits: list[float]) -> tuple[float, float]:
    return limits[0], limits[1]


def _words(loops: Skyhook) -> str:
    gains = ", ".join(f"{axis} {gain:.4g} N s/m" for axis, gain in zip(loops.axes, loops.gains, strict=True))
    return f"gains {gains}; tilt corner {loops.tilt_corner_Hz:.3g} Hz, roll-off {loops.roll_off_Hz:.3g} Hz"
