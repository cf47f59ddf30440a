"""A whole design study: rig, plant, controllers, bounds, simulation, verdict."""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import avis_ctrl
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.subsystem import reduction_error
from avis_ctrl.robust.musyn import MuSynthesis
from avis_ctrl.study.analysis import analyse
from avis_ctrl.study.controllers import (
    Candidate,
    classical_skyhook,
    mu_optimal,
    nominal_hinf,
    passive,
    tuned_skyhook,
)
from avis_ctrl.study.design_file import Design, read_study
from avis_ctrl.study.limits import best_found
from avis_ctrl.study.model import ControllerResult, DesignResult
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.requirements import judge
from avis_ctrl.study.sampling import random_perturbations
from avis_ctrl.study.simulation import SimulationCheck, simulate_study, six_dof_check
from avis_ctrl.study.workers import Workers

Progress = Callable[[str], None]
SAMPLES = 60


def run_file(path: str | Path, progress: Progress = lambda text: None) -> DesignResult:
    """Run a design file; the rig it names is shipped, or a file beside it."""
    return run_design(*read_study(path), progress, source=Path(path))


def run_design(design: Design, rig: Rig, progress: Progress = lambda text: None,
               source: Path | None = None) -> DesignResult:
    """Run a design on a rig.

    Parameters
    ----------
    progress : called with a line of text at each step.
    source : design file, hashed into the provenance.
    """
    began = time.monotonic()
    progress("model: rig, uncertainty, weights")
    plant = build_plant(design, rig)
    candidates, synthesis = synthesise(design, plant, rig, progress)
    controllers, simulation = compare(design, plant, rig, candidates, progress)
    return conclude(design, plant, rig, synthesis, controllers, simulation, time.monotonic() - began, source)


def synthesise(design: Design, plant: DesignPlant, rig: Rig,
               progress: Progress = lambda text: None) -> tuple[list[Candidate], MuSynthesis]:
    """The controllers that need no other: mu, nominal H-infinity, classical skyhook, none; and the D-K iteration."""
    with threadpool_limits(1):
        progress("H-infinity synthesis of the nominal plant")
        hinf = nominal_hinf(design, plant, rig)

        def shown(row: Any) -> None:
            progress(f"D-K iteration {row.iteration}: gamma {row.gamma:.4f}, peak mu {row.mu_upper:.4f}, "
                     f"order {row.order}, D-fit {100 * row.d_fit_error:.2g} %, {row.seconds:.1f} s")
        mu, made = mu_optimal(design, plant, rig, shown)
        progress(mu.notes[-1])
        return [mu, hinf, classical_skyhook(plant, rig, design), passive()], made


def conclude(design: Design, plant: DesignPlant, rig: Rig, synthesis: MuSynthesis,
             controllers: Sequence[ControllerResult], simulation: SimulationCheck, seconds: float,
             source: Path | None = None) -> DesignResult:
    """The verdict, with what the reduction to the kept axes leaves out, and the provenance."""
    with threadpool_limits(1):
        reduction = reduction_error(rig, design.keep)
        mu = next(c for c in controllers if c.name == "mu")
        six_dof = six_dof_check(design, rig, plant, mu)
        assumed = plant.identified.assumption if plant.identified else ""
        verdict = best_found(plant, mu, controllers, synthesis.history) if mu.mu.upper >= 1 else ""
        notes = tuple(text for text in (verdict, assumed) if text)
    return DesignResult(design, rig, plant, tuple(controllers), synthesis.history, judge(design, controllers),
                        reduction, six_dof, simulation, provenance(design, source, rig, seconds), seconds, notes)


def compare(design: Design, plant: DesignPlant, rig: Rig, candidates: Sequence[Candidate],
            progress: Progress = lambda text: None) -> tuple[list[ControllerResult], SimulationCheck]:
    """Bounds of every controller, a skyhook tuned to the worst-case peak of mu, and the simulation of mu.

    On two processes: none needs another but the last two, which need the bounds of mu.
    """
    samples = random_perturbations(plant, SAMPLES, design.simulation.seed)
    with Workers() as workers:
        jobs = {c.name: workers.submit(_measured, design, plant, c, samples) for c in candidates}
        progress("bounds of every controller over the whole uncertainty set, closed loop of the nonlinear rig")
        mu = jobs["mu"].result()
        progress("  done: bounds of mu synthesis")
        jobs["simulation"] = workers.submit(simulate_study, design, rig, plant, mu)
        jobs["skyhook"] = workers.submit(_tuned, design, plant, rig, skyhook_limit(design, mu), samples)
        found = {}
        for job in as_completed(jobs.values()):
            name = next(name for name, one in jobs.items() if one is job)
            found[name] = job.result()
            if name != "mu":
                progress(f"  done: {design.simulation.random_plants + 2} nonlinear plants" if name == "simulation"
                         else f"  done: bounds of {found[name].title}")
    return [found[name] for name in ("passive", "skyhook_classical", "skyhook", "hinf", "mu")], found["simulation"]


def _measured(design: Design, plant: DesignPlant, c: Candidate, samples: np.ndarray) -> ControllerResult:
    with threadpool_limits(1):
        return analyse(design, plant, c.K, c.name, c.title, c.kind, samples, c.notes)


def _tuned(design: Design, plant: DesignPlant, rig: Rig, peak_limit: float, samples: np.ndarray) -> ControllerResult:
    with threadpool_limits(1):
        return _measured(design, plant, tuned_skyhook(plant, rig, design, peak_limit), samples)


def skyhook_limit(design: Design, mu: ControllerResult) -> float:
    """Worst-case peak that the skyhook may have: what the design asks of its rival, or the rival's own if larger."""
    asked = [10 ** (one.at_most / 20) for one in design.requirement
             if one.quantity == "worst_case_peak_transmissibility_dB" and one.at_most is not None]
    known = [limit for limit in (*asked, mu.worst_peak.upper) if np.isfinite(limit)]
    return max(known, default=10 ** (design.transmissibility.peak_dB / 20))


def provenance(design: Design, source: Path | None, rig: Rig, seconds: float) -> dict[str, Any]:
    """What made this result: versions, hash of the inputs, seed, time."""
    text = design.model_dump_json() + repr(sorted((k, v.value) for k, v in rig.parameters().items()))
    libraries = ("numpy", "scipy", "slycot", "cvxpy", "clarabel", "numba")
    return {"avis_ctrl": avis_ctrl.__version__, "design_file": source.name if source else None,
            "inputs_sha256": hashlib.sha256(text.encode()).hexdigest(), "seed": design.simulation.seed,
            "date": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": seconds,
            "python": platform.python_version(), **{name: metadata.version(name) for name in libraries}}
