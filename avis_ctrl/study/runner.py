"""A whole design study: rig, plant, controllers, bounds, simulation, verdict."""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import avis_ctrl
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.subsystem import reduction_error
from avis_ctrl.study.analysis import analyse
from avis_ctrl.study.controllers import (
    Candidate,
    classical_skyhook,
    mu_optimal,
    nominal_hinf,
    passive,
    tuned_skyhook,
)
from avis_ctrl.study.design_file import Design, read_design
from avis_ctrl.study.model import ControllerResult, DesignResult
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.requirements import judge
from avis_ctrl.study.sampling import random_perturbations
from avis_ctrl.study.simulation import simulate_study

Progress = Callable[[str], None]
SAMPLES = 60


def run_file(path: str | Path, progress: Progress = lambda text: None) -> DesignResult:
    """Run a design file; the rig it names is shipped, or a file beside it."""
    path = Path(path)
    design = read_design(path)
    beside = path.parent / design.rig
    rig = load_rig(beside if beside.suffix == ".toml" and beside.exists() else design.rig)
    return run_design(design, rig, progress, source=path)


def run_design(design: Design, rig: Rig, progress: Progress = lambda text: None,
               source: Path | None = None) -> DesignResult:
    """Run a design on a rig.

    Parameters
    ----------
    progress : called with a line of text at each step.
    source : design file, hashed into the provenance.
    """
    began = time.monotonic()
    with threadpool_limits(1):
        progress("model: rig, uncertainty, weights")
        plant = build_plant(design, rig)
        reduction = reduction_error(rig, design.keep)
        candidates, made = _synthesise(design, plant, rig, progress)
        samples = random_perturbations(plant, SAMPLES, design.simulation.seed)
        results = [_measured(design, plant, c, samples, progress) for c in candidates]
        by_name = {c.name: c for c in results}
        progress("skyhook tuned to the same worst-case peak")
        limit = by_name["mu"].worst_peak.upper
        skyhook = tuned_skyhook(plant, rig, design, limit if np.isfinite(limit) else 2.0)
        results.insert(1, _measured(design, plant, skyhook, samples, progress))
        progress("closed loop of the nonlinear rig")
        simulation = simulate_study(design, rig, plant, {c.name: c for c in results}["mu"], progress)
    seconds = time.monotonic() - began
    return DesignResult(design, rig, plant, tuple(results), made.history, judge(design, results), reduction, simulation,
                        provenance(design, source, rig, seconds), seconds, made.notes)


def _synthesise(design: Design, plant: DesignPlant, rig: Rig, progress: Progress) -> tuple[list[Candidate], Any]:
    progress("H-infinity synthesis of the nominal plant")
    hinf = nominal_hinf(design, plant, rig)

    def shown(row: Any) -> None:
        progress(f"D-K iteration {row.iteration}: gamma {row.gamma:.4f}, peak mu {row.mu_upper:.4f}, "
                 f"order {row.order}, D-fit {100 * row.d_fit_error:.2g} %, {row.seconds:.1f} s")
    mu, made = mu_optimal(design, plant, rig, shown)
    return [passive(), classical_skyhook(plant, rig, design), hinf, mu], made


def _measured(design: Design, plant: DesignPlant, c: Candidate, samples: np.ndarray,
              progress: Progress) -> ControllerResult:
    progress(f"bounds of {c.title}")
    return analyse(design, plant, c.K, c.name, c.title, c.kind, samples, c.notes)


def provenance(design: Design, source: Path | None, rig: Rig, seconds: float) -> dict[str, Any]:
    """What made this result: versions, hash of the inputs, seed, time."""
    text = design.model_dump_json() + repr(sorted((k, v.value) for k, v in rig.parameters().items()))
    libraries = ("numpy", "scipy", "slycot", "cvxpy", "clarabel", "numba")
    return {"avis_ctrl": avis_ctrl.__version__, "design_file": source.name if source else None,
            "inputs_sha256": hashlib.sha256(text.encode()).hexdigest(), "seed": design.simulation.seed,
            "date": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": seconds,
            "python": platform.python_version(), **{name: metadata.version(name) for name in libraries}}
