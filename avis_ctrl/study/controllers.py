"""The controllers that a study compares, each made on the same plant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.frequency_grid import merged, resonances
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn import MuSynthesis, musyn
from avis_ctrl.robust.reduction import reduce_controller, residualise_fast
from avis_ctrl.study.candidate import Candidate as Candidate
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.study.skyhooks import CUSTOMARY_CORNERS_HZ as CUSTOMARY_CORNERS_HZ
from avis_ctrl.study.skyhooks import TUNING_HZ as TUNING_HZ
from avis_ctrl.study.skyhooks import classical_skyhook as classical_skyhook
from avis_ctrl.study.skyhooks import critical_gains as critical_gains
from avis_ctrl.study.skyhooks import tuned_skyhook as tuned_skyhook

# Coarse: it only ranks controllers of different order; what is reported is computed on the one chosen. The resonances
# of the table at rest and the peak of mu join it, for both are narrower than its steps.
REDUCTION_HZ = np.geomspace(0.05, 300.0, 25)


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
                 max_iterations=asked.max_iterations, backoff=asked.backoff_percent / 100,
                 sample_rate_Hz=rig.sample_rate_Hz)
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
