"""The iteration of a mu synthesis: which scalings come next, the K-step, the analysis, and when it ends.

Phases of a path in turn: D-K iteration; descent on the H-infinity optimum over the scalings (`gamma_descent`); the same
with one more order where gamma asks for it ("growth"); then D-K iteration again from the best loop. Each ends where a
step gains less than `stall`, the whole where a round of all three gains less than `round`. Another path begins, once,
at the best constant scalings ("start"): first of all where the controllers to start from do nothing, next where a D-K
step from them leads nowhere, else in the end. The best loop of all paths is kept.

Only counts end the iteration, never a clock. The target and the number of iterations allowed decide only where it
ends, and the target which scalings the last step takes: a short run is the beginning of a long one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, gain, hinf_norm, lft_lower
from avis_ctrl.robust.dstep import BROAD_FLOOR, DETAILED_FLOOR, PointwiseScalings, band_of, d_steps, equal_order_fits
from avis_ctrl.robust.frequency_grid import frequency_grid, refined_grid
from avis_ctrl.robust.gamma_descent import ScaledProblem, descend, grown
from avis_ctrl.robust.hinfsyn import Synthesis, hinf_controller
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn_state import DONE, GIVEN, HINF, NOMINAL, Iteration, Loop, State, analysed
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure

# Which phase follows which.
FOLLOWING = {"first start": "D-K", "D-K": "descent", "other start": "descent", "descent": "growth",
             "growth": "last start", "last start": DONE}
STOPPED = "stopped by the caller, before the iteration had ended"


@dataclass(frozen=True)
class IterationSettings:
    """stall : a step that lowers mu by a smaller fraction than this ends its phase: another is not worth a synthesis.
    round : a round of all phases that lowers mu by a smaller fraction than this ends the iteration.
    fast : a D-K step that lowers mu by a larger fraction than this is followed by another with an equally coarse fit of
        the scalings; after a smaller gain the fit must become finer for mu to fall further.
    idle : a controller does nothing if its mu is within this fraction of that of the plant without control: ten times
        the accuracy of that mu.
    constants : constant scalings of the uncertainty relative to the performance, tried as starts where the identity
        leads nowhere: over six decades, because the units of the signals may differ.
    """

    stall: float = 0.005
    round: float = 0.002
    fast: float = 0.25
    idle: float = 0.01
    constants: tuple[float, ...] = tuple(10.0 ** k for k in (-3, -2.5, -2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2, 2.5, 3))


SETTINGS = IterationSettings()


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

    @cached_property
    def scaled(self) -> ScaledProblem:
        """For tests of the gamma that scalings allow."""
        return ScaledProblem.of(self.P, self.nmeas, self.ncon)


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
        step = _k_step(problem, state, options)
        if step is None:
            state = _moved_on(problem, state)
            continue
        (scalings, cost, kind), synthesis = step
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

    They are the H-infinity controller of the plant as it is, that of the nominal plant, and those given; the ones that
    do not stabilise the plant are left out. The nominal one is often the best by far: its loop tells the D-step where
    the uncertainty is felt by a controller that does its work, while large uncertainty unscaled forbids any work.
    """
    state, failure = State(), None
    many = problem.structure.many
    candidates = _candidates(problem, starts, options)
    # With many blocks unscaled, that of the plant as it is does nothing, and takes longest: only where the ones given,
    # or that of the nominal plant, do not stabilise.
    for kind, make in reversed(candidates) if many else candidates:
        if many and kind != GIVEN and state.best is not None:
            break
        began = time.monotonic()
        try:
            loop, points = _start(problem, make())
        except ComputationError as error:
            failure = failure or error
            continue
        row = Iteration(len(state.history), loop.gamma, loop.mu, loop.K.nstates, 0.0, 0, time.monotonic() - began, kind)
        state = replace(state, history=(*state.history, row))
        if state.best is None or loop.mu < state.best.mu:
            state = replace(state, points=points, last=loop, best=loop, path=loop, round_mu=loop.mu)
        if _stopped_by(options, row):
            return state, True
    if state.best is None or state.points is None:
        assert failure is not None
        raise failure
    idle = _at_rest(problem, state.points.omega, state.best.mu)
    return replace(state, phase="first start" if idle else "D-K"), False


def _candidates(problem: Problem, starts: tuple[StateSpace, ...],
                options: Options) -> list[tuple[str, Callable[[], StateSpace]]]:
    """Kinds of the controllers to start from, and what makes each."""
    def optimal(P: StateSpace) -> StateSpace:
        return hinf_controller(P, problem.nmeas, problem.ncon, options.backoff).K
    performance = problem.structure.blocks[-1]
    n_z, n_w = problem.structure.n_z - performance.cols, problem.structure.n_w - performance.rows
    made: list[tuple[str, Callable[[], StateSpace]]] = [(HINF, lambda: optimal(problem.P))]
    if n_w:
        made.append((NOMINAL, lambda: optimal(problem.P.select(slice(n_z, None), slice(n_w, None)))))
    return made + [(GIVEN, partial(_itself, K)) for K in starts]


def _itself(K: StateSpace) -> StateSpace:
    return K


def _start(problem: Problem, K: StateSpace) -> tuple[Loop, PointwiseScalings]:
    """A controller to start from with its analysis; ComputationError where it does not stabilise the plant."""
    closed = lft_lower(problem.P, K)
    if not closed.is_stable():
        raise ComputationError("a controller to start from does not stabilise the plant",
                               measured=f"largest real part of a pole {np.max(closed.poles().real):.3g} rad/s")
    points = analysed(problem.P, K, problem.structure, frequency_grid(closed))
    return Loop(K, Scalings.identity(problem.structure), hinf_norm(closed).gain, points.peak), points


def _k_step(problem: Problem, state: State, options: Options) -> tuple[Proposal, Synthesis] | None:
    """The scalings of least H-infinity optimum and their controller; None if no proposal has a controller.

    The fit of scalings to the last loop does not tell what the next one will be; one test of gamma does. In a D-K step
    scalings that are fitted quickly come first, and suffice if their gamma makes mu fall by more than `stall`.
    """
    assert state.path is not None
    hint = state.path.gamma
    if state.phase == "D-K":
        enough = (1 - SETTINGS.stall) * state.path.mu / (1 + options.backoff)
        if found := _best(problem, _equal_orders(state, options), options, hint, enough):
            return found
    return _best(problem, _proposed(problem, state, options), options, hint)


def _best(problem: Problem, proposals: Iterable[Proposal], options: Options, hint: float, below: float = np.inf
          ) -> tuple[Proposal, Synthesis] | None:
    """The proposal of least H-infinity optimum, at most `below`, and its controller: another one is preferred if its
    optimum is smaller by more than `stall`. The first that reaches the target ends the search."""
    best: tuple[Proposal, Synthesis] | None = None
    for proposal in proposals:
        try:
            if np.isfinite(below) and not problem.scaled.reaches(proposal.scalings, below):
                continue
            made = hinf_controller(proposal.scalings.scale(problem.P), problem.nmeas, problem.ncon, options.backoff,
                                   best[1].gamma if best else hint)
        except ComputationError:
            continue
        if best is None or made.gamma < best[1].gamma:
            best, below = (proposal, made), (1 - SETTINGS.stall) * made.gamma_optimal_bounds[1]
            if options.target is not None and made.gamma <= options.target:
                break
    return best


def _no_further(state: State, options: Options) -> str:
    """Why no further iteration starts; empty where one does."""
    if state.phase == DONE:
        return (f"converged: a round of D-K iteration, descent on gamma and larger orders gains no more than "
                f"{100 * SETTINGS.round:g} %")
    if state.phase in ("descent", "growth", "last start") and not options.polish:
        return f"D-K iteration stalled: a step gained less than {100 * SETTINGS.stall:g} %"
    if options.target is not None and state.best and state.best.gamma <= options.target:
        return f"target {options.target:g} reached"
    if len(_steps(state)) >= options.max_iterations:
        return f"{options.max_iterations} iterations done"
    return ""


class Proposal(NamedTuple):
    """Scalings, what their realisation costs against the best at each frequency, and how they were made."""

    scalings: Scalings
    cost: float
    kind: str


def _equal_orders(state: State, options: Options) -> Iterator[Proposal]:
    """Scalings of one order in all blocks; their cost is measured on the grid only."""
    assert state.points is not None
    try:
        for step in equal_order_fits(state.points, options.max_added_states):
            yield Proposal(step.scalings, max(0.0, step.cost), "D-K")
    except np.linalg.LinAlgError:
        return


def _proposed(problem: Problem, state: State, options: Options) -> Iterator[Proposal]:
    """The next scalings to choose from; none where the phase has nothing more to offer."""
    assert state.last is not None and state.path is not None and state.points is not None
    if "start" in state.phase:
        tried = any(row.kind == "start" for row in state.history)
        if not tried and (found := _other_constants(problem, state.path.gamma, options)):
            yield found
        return
    if state.phase == "D-K":
        floors = (BROAD_FLOOR, DETAILED_FLOOR) if _falls_fast(state) else (DETAILED_FLOOR, BROAD_FLOOR)
        try:
            for step in d_steps(state.points, lft_lower(problem.P, state.last.K), state.last.scalings, floors,
                                max_states=options.max_added_states):
                yield Proposal(step.scalings, step.cost, "D-K")
        except np.linalg.LinAlgError:
            # A loop that no decomposition takes (entries beyond all scale) ends the D-K phase, not the synthesis.
            return
        return
    band = band_of(state.points.omega)
    start = min(state.last, state.path, key=lambda loop: loop.gamma).scalings
    if state.phase == "growth":
        larger = grown(problem.P, problem.nmeas, problem.ncon, start, band, options.max_added_states)
        if larger is None:
            return
        start = larger
    try:
        yield Proposal(descend(problem.P, problem.nmeas, problem.ncon, start, band).scalings, 0.0, state.phase)
    except ComputationError:
        return


def _at_rest(problem: Problem, omega: np.ndarray, mu: float) -> bool:
    """Whether a controller that reaches this mu does nothing: the plant without control reaches it, too.

    With K = 0 the uncertainty of the drives sees no signal and no D is better than another: no D-step leads away.
    """
    P = problem.P
    at_rest = lft_lower(P, gain(np.zeros((problem.ncon, problem.nmeas)), P.outputs[P.noutputs - problem.nmeas:],
                                P.inputs[P.ninputs - problem.ncon:]))
    if not at_rest.is_stable():
        return False
    open_loop = upper_bound(at_rest.frequency_response(omega)[:, None], problem.structure, 1e-3).beta
    return mu > (1 - SETTINGS.idle) * float(np.max(open_loop))


def _other_constants(problem: Problem, gamma: float, options: Options) -> Proposal | None:
    """The constant scalings, alike for all uncertainty, of least H-infinity optimum; None where none is below gamma."""
    best = None
    for d in SETTINGS.constants:
        scalings = Scalings.uniform(problem.structure, d)
        try:
            if not problem.scaled.reaches(scalings, (1 - SETTINGS.stall) * gamma):
                continue
            made = hinf_controller(scalings.scale(problem.P), problem.nmeas, problem.ncon, options.backoff)
        except ComputationError:
            continue
        if made.gamma < (1 - SETTINGS.stall) * gamma:
            best, gamma = scalings, made.gamma
    return Proposal(best, 0.0, "start") if best else None


def _falls_fast(state: State) -> bool:
    """Whether the last step lowered mu by more than `fast`, or no step was taken yet on this path."""
    steps = _steps(state)
    return len(steps) < 2 or state.history[-1].kind == "start" or steps[-1] < (1 - SETTINGS.fast) * steps[-2]


def _steps(state: State) -> list[float]:
    """mu after each K-step of the scaled plant; the other controllers to start from do not count."""
    return [row.mu_upper for row in state.history if row.kind not in (NOMINAL, GIVEN)]


def _next_grid(state: State, closed_loop: StateSpace) -> np.ndarray:
    """Frequencies of the next analysis: those of the last one, with more around its peaks."""
    if state.points is None:
        return frequency_grid(closed_loop)
    return refined_grid(state.points.omega, state.points.mu)


def _recorded(problem: Problem, state: State, loop: Loop, row: Iteration, points: PointwiseScalings) -> State:
    """The state after an iteration: the best loops kept, the phase moved on where nothing was gained on this path."""
    path = state.path
    assert state.best is not None and path is not None
    state = replace(state, points=points, last=loop, best=loop if loop.mu < state.best.mu else state.best,
                    history=(*state.history, row))
    if row.kind == "start":
        return replace(state, phase="D-K", path=loop, round_mu=loop.mu)
    gained = 1 - loop.mu / path.mu
    state = replace(state, path=loop if gained > 0 else path)
    return state if gained > SETTINGS.stall else _moved_on(problem, state)


def _moved_on(problem: Problem, state: State) -> State:
    """The state in the next phase; after growth a new round from the path's best loop, where this one gained enough."""
    assert state.path is not None and state.last is not None and state.points is not None
    if state.phase == "D-K" and state.path.mu >= state.round_mu:
        return replace(state, phase="other start")
    # Where neither descent nor growth found a step, D-K iteration would only repeat its last one.
    over = state.path.mu > (1 - SETTINGS.round) * state.round_mu or state.history[-1].kind == "D-K"
    if state.phase != "growth" or over:
        return replace(state, phase=FOLLOWING[state.phase])
    points = state.points
    if state.last is not state.path:
        points = analysed(problem.P, state.path.K, problem.structure, points.omega)
    return replace(state, phase="D-K", points=points, last=state.path, round_mu=state.path.mu)
