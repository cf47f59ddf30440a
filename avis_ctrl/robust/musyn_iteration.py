"""The iteration of a mu synthesis: which scalings come next, the K-step, the analysis, and when it ends.

Phases in turn: D-K iteration; descent on the H-infinity optimum over the scalings (`gamma_descent`); the same with one
more order where gamma asks for it ("growth"); then D-K iteration again from the best loop. Each ends where a step gains
less than `STALL`, the whole where a round of all three gains less than `ROUND`. Only counts end anything, never a
clock, and nothing depends on the target or on the number of iterations allowed but where the iteration ends: what a
short run does is the beginning of what a long one does.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, gain, hinf_norm, lft_lower
from avis_ctrl.robust.dstep import BROAD_FLOOR, DETAILED_FLOOR, PointwiseScalings, band_of, d_step
from avis_ctrl.robust.frequency_grid import frequency_grid, refined_grid
from avis_ctrl.robust.gamma_descent import descend, grown
from avis_ctrl.robust.hinfsyn import Synthesis, hinfsyn
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn_state import DONE, GIVEN, Iteration, Loop, State, analysed
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure

# A step that lowers the best mu by less than this share has stalled; a round of all phases that gains less ends it.
STALL = 0.005
ROUND = 0.002
# A step that lowers mu by more than this share is followed by another of its kind.
FAST = 0.25
# A loop within this share of the plant without control is that of a controller that does nothing.
IDLE = 0.01
# Constant scalings of all uncertainty against performance from which the iteration starts where identity leads nowhere.
CONSTANTS = tuple(10.0 ** k for k in (-3, -2.5, -2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2, 2.5, 3))
FOLLOWING = {"D-K": "descent", "descent": "growth", "growth": DONE}
STOPPED = "stopped by the callback"


@dataclass(frozen=True)
class Options:
    """What the caller of `musyn` asked for."""

    target: float | None
    max_iterations: int
    backoff: float
    polish: bool
    max_added_states: int
    callback: Callable[[Iteration], Any] | None


@dataclass(frozen=True, eq=False)
class Problem:
    """P (w_delta, w, u -> z_delta, z, y) and its blocks as the synthesis sees them: complex, performance last."""

    P: StateSpace
    structure: BlockStructure
    nmeas: int
    ncon: int


def iterate(problem: Problem, state: State, starts: tuple[StateSpace, ...], options: Options) -> tuple[State, str]:
    """The H-infinity controller and the ones given, then scalings, K-step and analysis until something says stop."""
    if not state.history:
        state, stopped = _first(problem, starts, options)
        if stopped:
            return state, STOPPED
    while True:
        if status := _no_further(state, options):
            return state, status
        began = time.monotonic()
        proposal = _proposed(problem, state, options)
        synthesis = _k_step(problem, state, proposal, options) if proposal else None
        if proposal is None or synthesis is None:
            state = _moved_on(problem, state)
            continue
        scalings, cost, kind = proposal
        points = analysed(problem.P, synthesis.K, problem.structure, _next_grid(state, synthesis.closed_loop))
        loop = Loop(synthesis.K, scalings, synthesis.gamma, points.peak)
        row = Iteration(len(state.history), synthesis.gamma, points.peak, synthesis.K.nstates, cost,
                        sum(scalings.orders), time.monotonic() - began, kind)
        state = _recorded(problem, state, loop, row, points)
        if _stopped_by(options, row):
            return state, STOPPED


def _stopped_by(options: Options, row: Iteration) -> bool:
    answer = options.callback(row) if options.callback else None
    return answer is False or answer == "stop"


def _first(problem: Problem, starts: tuple[StateSpace, ...], options: Options) -> tuple[State, bool]:
    """The state with the best of the controllers that the iteration may start from; whether the callback said stop.

    They are the H-infinity controller of the plant as it is, and those given that stabilise it.
    """
    state, failure = State(), None
    for given in (None, *starts):
        began = time.monotonic()
        try:
            loop, points = _start(problem, given, options)
        except ComputationError as error:
            failure = failure or error
            continue
        row = Iteration(len(state.history), loop.gamma, loop.mu, loop.K.nstates, 0.0, 0, time.monotonic() - began,
                        GIVEN if given else "H-infinity")
        state = replace(state, history=(*state.history, row))
        if state.best is None or loop.mu < state.best.mu:
            state = replace(state, points=points, last=loop, best=loop, round_mu=loop.mu)
        if _stopped_by(options, row):
            return state, True
    if state.best is None:
        assert failure is not None
        raise failure
    return state, False


def _start(problem: Problem, K: StateSpace | None, options: Options) -> tuple[Loop, PointwiseScalings]:
    """A controller given, or the H-infinity controller of the plant, with its analysis."""
    if K is None:
        K = hinfsyn(problem.P, problem.nmeas, problem.ncon, backoff=options.backoff).K
    closed = lft_lower(problem.P, K)
    if not closed.is_stable():
        raise ComputationError("a controller to start from does not stabilise the plant",
                               measured=f"largest real part of a pole {np.max(closed.poles().real):.3g} rad/s")
    points = analysed(problem.P, K, problem.structure, frequency_grid(closed))
    return Loop(K, Scalings.identity(problem.structure), hinf_norm(closed).gain, points.peak), points


def _k_step(problem: Problem, state: State, proposal: Proposal, options: Options) -> Synthesis | None:
    """H-infinity controller of the scaled plant; None where scalings, not the plant, make it fail."""
    try:
        return hinfsyn(proposal.scalings.scale(problem.P), problem.nmeas, problem.ncon, backoff=options.backoff,
                       gamma_hint=state.best.gamma if state.best else None)
    except ComputationError:
        return None


def _no_further(state: State, options: Options) -> str:
    """Why no further iteration starts; empty where one does."""
    if state.phase == DONE:
        return (f"converged: a round of D-K iteration, descent on gamma and larger orders gains no more than "
                f"{100 * ROUND:g} %")
    if state.phase != "D-K" and not options.polish:
        return f"D-K iteration stalled: a step gained less than {100 * STALL:g} %"
    if options.target is not None and state.best and state.best.gamma <= options.target:
        return f"target {options.target:g} reached"
    if sum(row.kind != GIVEN for row in state.history) >= options.max_iterations:
        return f"{options.max_iterations} iterations done"
    return ""


class Proposal(NamedTuple):
    """Scalings, what their realisation costs against the best at each frequency, and how they were made."""

    scalings: Scalings
    cost: float
    kind: str


def _proposed(problem: Problem, state: State, options: Options) -> Proposal | None:
    """The next scalings; None where the phase has nothing more to offer."""
    assert state.last is not None and state.best is not None and state.points is not None
    if _stuck_at_rest(problem, state) and (other := _other_constants(problem, state.best.gamma, options)):
        return other
    if state.phase == "D-K":
        points = replace(state.points, floor=BROAD_FLOOR if _falls_fast(state) else DETAILED_FLOOR)
        try:
            step = d_step(points, lft_lower(problem.P, state.last.K), state.last.scalings,
                          max_states=options.max_added_states)
        except np.linalg.LinAlgError:
            # A loop that no decomposition takes (entries beyond all scale) ends the D-K phase, not the synthesis.
            return None
        return Proposal(step.scalings, step.cost, "D-K")
    band = band_of(state.points.omega)
    start = min(state.last, state.best, key=lambda loop: loop.gamma).scalings
    if state.phase == "growth":
        larger = grown(problem.P, problem.nmeas, problem.ncon, start, band, options.max_added_states)
        if larger is None:
            return None
        start = larger
    try:
        return Proposal(descend(problem.P, problem.nmeas, problem.ncon, start, band).scalings, 0.0, state.phase)
    except ComputationError:
        return None


def _stuck_at_rest(problem: Problem, state: State) -> bool:
    """Whether the best controller to start from does nothing, and no other scalings were tried.

    With K = 0 the uncertainty of the drives sees no signal and no D is better than another: no D-step leads away.
    """
    if any(row.kind not in ("H-infinity", GIVEN) for row in state.history):
        return False
    assert state.last is not None and state.points is not None
    at_rest = lft_lower(problem.P, gain(np.zeros((problem.ncon, problem.nmeas)), state.last.K.inputs,
                                        state.last.K.outputs))
    if not at_rest.is_stable():
        return False
    open_loop = upper_bound(at_rest.frequency_response(state.points.omega)[:, None], problem.structure, 1e-3).beta
    return state.last.mu > (1 - IDLE) * float(np.max(open_loop))


def _other_constants(problem: Problem, gamma: float, options: Options) -> Proposal | None:
    """The constant scalings, alike for all uncertainty, of least H-infinity optimum; None where none is below gamma."""
    best = None
    for d in CONSTANTS:
        scalings = Scalings.uniform(problem.structure, d)
        try:
            made = hinfsyn(scalings.scale(problem.P), problem.nmeas, problem.ncon, backoff=options.backoff)
        except ComputationError:
            continue
        if made.gamma < (1 - STALL) * gamma:
            best, gamma = scalings, made.gamma
    return Proposal(best, 0.0, "start") if best else None


def _falls_fast(state: State) -> bool:
    """Whether the last step lowered mu by more than `FAST`, or none was taken yet."""
    steps = [row.mu_upper for row in state.history if row.kind != GIVEN]
    return len(steps) < 2 or steps[-1] < (1 - FAST) * steps[-2]


def _next_grid(state: State, closed_loop: StateSpace) -> np.ndarray:
    """Frequencies of the next analysis: those of the last one, denser at its peaks."""
    if state.points is None:
        return frequency_grid(closed_loop)
    return refined_grid(state.points.omega, state.points.mu)


def _recorded(problem: Problem, state: State, loop: Loop, row: Iteration, points: PointwiseScalings) -> State:
    """The state after an iteration: the best loop kept, the phase moved on where nothing was gained."""
    assert state.best is not None
    gained = 1 - loop.mu / state.best.mu
    state = replace(state, points=points, last=loop, best=loop if gained > 0 else state.best,
                    history=(*state.history, row))
    return state if gained > STALL else _moved_on(problem, state)


def _moved_on(problem: Problem, state: State) -> State:
    """The state in the next phase; after the last one a new round from the best loop, where this one gained enough."""
    assert state.best is not None and state.last is not None and state.points is not None
    phase = FOLLOWING[state.phase]
    if phase != DONE or state.best.mu > (1 - ROUND) * state.round_mu:
        return replace(state, phase=phase)
    points = state.points
    if state.last is not state.best:
        points = analysed(problem.P, state.best.K, problem.structure, points.omega)
    return replace(state, phase="D-K", points=points, last=state.best, round_mu=state.best.mu)
