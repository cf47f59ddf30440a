"""A complete design study: rig, plant, controllers, bounds, simulation, verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, as_completed
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import ComputationError
from avis_ctrl.rigs.reduction_error import reduction_error
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.musyn import DKIteration
from avis_ctrl.robust.musyn_state import GIVEN, HINF, NOMINAL
from avis_ctrl.study.analysis import SETTINGS as ANALYSIS
from avis_ctrl.study.analysis import analyse, worst_of_axis
from avis_ctrl.study.controllers import best_of, mu_optimal, nominal_hinf, passive
from avis_ctrl.study.dc_gain import at_rest
from avis_ctrl.study.decentralised import LOOPS_TITLE, tuned_loops
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.design_result import (
    AxisGain,
    Candidate,
    ControllerResult,
    DesignResult,
    FailedController,
    Simulated,
)
from avis_ctrl.study.limiting_bounds import best_found, limiting
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.provenance import provenance
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.simulation import bare_loop, simulate_study, six_dof_check
from avis_ctrl.study.skyhooks import classical_skyhook, tuned_skyhook
from avis_ctrl.study.verdict import check_loop, check_requirements
from avis_ctrl.study.workers import Workers

Progress = Callable[[str], None]
# Context of the D-K iteration; it gives a function that is called after each step and returns whether to stop.
Stop = AbstractContextManager[Callable[[], bool]]
NEVER: Stop = nullcontext(lambda: False)


def run_design(
    design: Design, rig: Rig, progress: Progress = lambda text: None, source: Path | None = None, stop: Stop = NEVER
) -> DesignResult:
    """Run a design on a rig.

    Parameters
    ----------
    progress : called with a line of text at each step.
    source : design file, named in the provenance.
    stop : ends the D-K iteration early; the design continues with the best controller so far.
    """
    began = time.monotonic()
    progress("model: rig, uncertainty, weights")
    plant = build_plant(design, rig)
    with threadpool_limits(1):
        # Computations that do not depend on the mu controller run in parallel with the D-K iteration.
        with Workers(beside=True) as workers:
            others, failed = other_controllers(design, plant, rig, progress)
            early = start_bounds(design, plant, rig, others, workers)
            candidate, synthesis = synthesise(design, plant, rig, others, progress, stop)
            compared = compare(design, plant, rig, [candidate, *others], failed, progress, early)
        reduction = reduction_error(rig, design.keep)
        controllers, companions = compared.controllers, compared.loop.companions
        mu = next(c for c in controllers if c.name == "mu")
        six_dof = six_dof_check(design, rig, plant, mu, companions)
        assumed = plant.identified.assumption if plant.identified else ""
        limits = best_found(plant, mu, controllers) if mu.mu.upper >= 1 else limiting(plant, mu)
        unlike = [f"{one.title!r} is missing from the comparison: {one.reason}" for one in compared.failed]
        passive_axes = [f"The axis {axis} remains passive: {why}." for axis, why in companions.passive]
        notes = tuple(text for text in (assumed, *unlike, *passive_axes, *companions.remarks()) if text)
        requirements = (
            *check_loop(compared.loop.check, compared.loop.rest, design.control_effort.offset_percent),
            *check_requirements(design, controllers, compared.by_axis),
        )
    seconds = time.monotonic() - began
    return DesignResult(
        design,
        rig,
        plant,
        dk_history=synthesis.history,
        requirements=requirements,
        reduction=reduction,
        six_dof=six_dof,
        provenance=design_provenance(design, source, rig, seconds),
        seconds=seconds,
        notes=notes,
        limits=limits,
        **vars(compared),
    )


# Controllers from which the D-K iteration starts, by their kind in its history.
INITIAL = {
    HINF: "H-infinity, uncertainty as performance",
    NOMINAL: "H-infinity, nominal plant",
    GIVEN: "controller for comparison",
}
# Steps other than those of D-K iteration, by their kind.
STEPS = {
    "start": "D-K iteration restarted from constant scalings",
    "descent": "descent on gamma over the scalings",
    "growth": "descent on gamma, scalings of higher order",
}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Controllers in the report's order, failed ones with reasons, the loop of all axes, each axis against skyhook."""

    controllers: tuple[ControllerResult, ...]
    failed: tuple[FailedController, ...]
    loop: Simulated
    by_axis: tuple[AxisGain, ...] = ()


def other_controllers(
    design: Design, plant: DesignPlant, rig: Rig, progress: Progress = lambda text: None
) -> tuple[list[Candidate], list[FailedController]]:
    """Controllers for comparison that do not depend on mu: nominal H-infinity, classical skyhook, no control.

    A controller that cannot be designed does not stop the study: it is returned among the failed ones.
    """
    made: list[Candidate] = []
    failed: list[FailedController] = []
    if "hinf" in design.compare_with:
        progress("H-infinity synthesis of the nominal plant")
        try:
            made.append(nominal_hinf(design, plant, rig))
        except ComputationError as error:
            failed.append(FailedController("hinf", "H-infinity, nominal", "hinf", str(error)))
    if "skyhook_classical" in design.compare_with:
        made.append(classical_skyhook(plant, rig, design))
    return [*made, passive()], failed


def start_bounds(
    design: Design, plant: DesignPlant, rig: Rig, others: Sequence[Candidate], workers: Workers
) -> dict[str, Future[Any]]:
    """Start the bounds of the other controllers, by name; the skyhook is tuned to the peak that the design requires."""
    samples = random_perturbations(plant, ANALYSIS.samples, design.simulation.seed)
    limit, jobs = max(_asked_peaks(design), default=None), {}
    if "skyhook" in design.compare_with and limit is not None:
        jobs["skyhook"] = workers.submit(_tuned, design, plant, rig, "skyhook", limit, samples)
    return jobs | {c.name: workers.submit(_measured, design, plant, c, samples) for c in others}


def synthesise(
    design: Design,
    plant: DesignPlant,
    rig: Rig,
    others: Sequence[Candidate],
    progress: Progress = lambda text: None,
    stop: Stop = NEVER,
) -> tuple[Candidate, DKIteration]:
    """The mu controller and its D-K iteration, which starts from the best of the other controllers."""

    def shown(row: Any) -> bool:
        """Called after each iteration; False stops it."""
        ends = enough()  # before the line: once it is visible, Ctrl-C keeps this controller
        reached = f"peak mu {row.mu_upper:.5g}, order {row.order}"
        # Numbered as in the report, where the initial controllers are rows of the same table.
        if row.kind in INITIAL:
            progress(f"step {row.iteration}, initial controller ({INITIAL[row.kind]}): {reached}")
        else:
            progress(
                f"step {row.iteration}, {STEPS.get(row.kind, 'D-K iteration')}: gamma {row.gamma:.5g}, {reached}, "
                f"fit error of the D-scalings {100 * row.d_fit_error:.0f} %, {row.seconds:.1f} s"
            )
        return not ends

    with stop as enough:
        mu, made = mu_optimal(design, plant, rig, shown, others)
    progress(mu.notes[-1])
    return mu, made


ORDER = ("passive", "skyhook_classical", "skyhook", "loops", "hinf", "mu")


def compare(
    design: Design,
    plant: DesignPlant,
    rig: Rig,
    candidates: Sequence[Candidate],
    failed: Sequence[FailedController] = (),
    progress: Progress = lambda text: None,
    early: Mapping[str, Future[Any]] | None = None,
) -> Comparison:
    """Bounds of every controller, of the tuned loops and the tuned skyhook if required, and the simulation of mu.

    Runs on two processes, in parallel with those of `early`. The simulation waits for the bounds of all other
    controllers, because the best of these is delivered as the mu controller. So does the tuning of a skyhook whose peak
    the design does not limit.

    early : bounds that were started before, on processes with a lower priority than those for the mu controller.

    Raises ComputationError: the mu controller, or the passive table, could not be analysed.
    """
    samples = random_perturbations(plant, ANALYSIS.samples, design.simulation.seed)
    begun = early or {}
    with Workers() as workers:
        jobs = {begun.get(c.name) or workers.submit(_measured, design, plant, c, samples): c.name for c in candidates}
        if "loops" in design.compare_with:
            made = next(c.K for c in candidates if c.name == "mu")
            jobs[workers.submit(_tuned, design, plant, rig, "loops", made, samples)] = "loops"
        progress("bounds of every controller over the whole uncertainty set, closed loop of the nonlinear rig")
        found: dict[str, ControllerResult | FailedController] = {}

        def gather() -> None:
            for job in as_completed(jobs):
                found[jobs[job]] = one = job.result()
                progress(
                    f"  {one.title}: {one.reason}"
                    if isinstance(one, FailedController)
                    else f"  done: bounds of {one.title}"
                )

        gather()
        mu = found["mu"]
        if isinstance(mu, FailedController):
            raise ComputationError(f"the controller {mu.title!r} could not be analysed: {mu.reason}")
        # The best controller found is delivered, whatever its name; it determines the skyhook's limit.
        mu = best_of(mu, [one for one in found.values() if isinstance(one, ControllerResult)])
        simulation = workers.submit(simulate_study, design, rig, plant, mu)
        axes = range(len(plant.axes))
        by_axis = [workers.submit(worst_of_axis, design, plant, k, mu.K, mu.stability) for k in axes]
        jobs = {}
        if "skyhook" in design.compare_with:
            limit = skyhook_limit(design, mu)
            tuning = begun.get("skyhook") if limit in _asked_peaks(design) else None
            jobs = {tuning or workers.submit(_tuned, design, plant, rig, "skyhook", limit, samples): "skyhook"}
        gather()
        loop = simulation.result()
        proved = [one.result() for one in by_axis]
        progress(f"  done: {design.simulation.random_plants + 2} nonlinear plants")
        found["mu"] = mu
        if isinstance(skyhook := found.get("skyhook"), ControllerResult) and best_of(mu, [skyhook]) is not mu:
            found["mu"] = mu = best_of(mu, [skyhook])
            loop = simulate_study(design, rig, plant, mu)
            proved = [worst_of_axis(design, plant, k, mu.K, mu.stability) for k in axes]
        rival = [np.nan for _ in axes]
        if isinstance(skyhook, ControllerResult):
            stable = np.isfinite(skyhook.worst_peak.upper)
            rival = [worst_of_axis(design, plant, k, skyhook.K) if stable else np.inf for k in axes]
    if isinstance(rest := found["passive"], FailedController):
        raise ComputationError(f"the table without control could not be analysed: {rest.reason}")
    every = [*failed, *(one for one in found.values() if isinstance(one, FailedController))]
    measured = {
        name: replace(one, rest=at_rest(bare_loop(design, rig, plant, one.K)) if one.K is not None else None)
        for name, one in found.items()
        if isinstance(one, ControllerResult)
    }
    return Comparison(
        tuple(measured[name] for name in ORDER if name in measured),
        tuple(sorted(every, key=lambda one: ORDER.index(one.name))),
        loop,
        tuple(AxisGain(axis, mine, its) for axis, mine, its in zip(plant.axes, proved, rival, strict=True)),
    )


def _measured(
    design: Design, plant: DesignPlant, c: Candidate, samples: np.ndarray
) -> ControllerResult | FailedController:
    try:
        return analyse(design, plant, c, samples)
    except ComputationError as error:
        return FailedController(c.name, c.title, c.kind, str(error))


def _tuned(
    design: Design, plant: DesignPlant, rig: Rig, name: Literal["skyhook", "loops"], given: Any, samples: np.ndarray
) -> ControllerResult | FailedController:
    """given : allowed peak of the skyhook, or the controller from which the loops start."""
    make, title = (tuned_skyhook, "skyhook, tuned") if name == "skyhook" else (tuned_loops, LOOPS_TITLE)
    try:
        candidate = make(plant, rig, design, given)
    except ComputationError as error:
        return FailedController(name, title, "skyhook", str(error))
    return _measured(design, plant, candidate, samples)


def skyhook_limit(design: Design, mu: ControllerResult) -> float:
    """Allowed worst-case peak of the skyhook: the limit of the design, or the peak of the mu controller if larger."""
    known = [limit for limit in (*_asked_peaks(design), mu.worst_peak.upper) if np.isfinite(limit)]
    return max(known, default=10 ** (design.transmissibility.peak_dB / 20))


def _asked_peaks(design: Design) -> list[float]:
    return [10 ** (limit / 20) for limit in design.upper_limits("worst_case_peak_transmissibility_dB")]


def design_provenance(design: Design, source: Path | None, rig: Rig, seconds: float) -> dict[str, Any]:
    """Provenance of a design. source : design file."""
    return provenance(
        rig,
        design.model_dump_json(),
        design.simulation.seed,
        seconds,
        ("numpy", "scipy", "slycot", "cvxpy", "clarabel", "numba"),
        design_file=source.name if source else None,
    )
