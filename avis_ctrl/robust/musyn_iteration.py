"""Iteration of a mu synthesis: choice of the next scalings, K-step, analysis, termination.

A path consists of these phases: D-K iteration; descent on the H-infinity optimum over the scalings (`gamma_descent`);
descent with scalings of higher order where gamma is sensitive to it ("growth"); then D-K iteration again from the best
loop. A phase ends when a step gains less than `stall`; the iteration ends when a round of all three phases gains less
than `round`. Once, another path starts at the best constant scalings ("start"): at the beginning if the initial
controllers have no effect, after the first D-K phase if it gains nothing, otherwise at the end. The best loop of all
paths is kept.

Elapsed time never ends the iteration. The target and the maximum number of iterations determine only where it ends; the
target also determines the scalings of the last step. A short run therefore equals the beginning of a long run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from avis_ctrl.checks import require_whole
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, hinf_norm, lft_lower
from avis_ctrl.robust.dstep import SETTINGS as D_STEP
from avis_ctrl.robust.dstep import PointwiseScalings, band_of, d_steps, equal_order_fits
from avis_ctrl.robust.frequency_grid import frequency_grid, refined_grid
from avis_ctrl.robust.gamma_descent import ScaledProblem, descend, with_added_pairs
from avis_ctrl.robust.hinfsyn import Synthesis, hinf_controller
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn_state import DONE, GIVEN, HINF, NOMINAL, Iteration, Loop, State, analysed
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure

# Successor of each phase.
FOLLOWING = {
    "first start": "D-K",
    "D-K": "descent",
    "other start": "descent",
    "descent": "growth",
    "growth": "last start",
    "last start": DONE,
}
STOPPED = "stopped on request (callback or Ctrl-C), before the iteration had converged"


@dataclass(frozen=True)
class IterationSettings:
    """stall : a step that lowers mu by a smaller fraction than this ends its phase; another is not worth a synthesis.
    round : a round of all phases that lowers mu by a smaller fraction than this ends the iteration.
    fast : after a D-K step that lowers mu by a larger fraction than this, the next fit of the scalings is equally
        coarse; after a smaller gain the fit must become finer for mu to decrease further.
    idle : a controller counts as idle (no control action) if its mu is within this fraction of mu of the plant without
        control; ten times the accuracy of that mu.
    constants : constant scalings of the uncertainty relative to the performance, tried as starting points if the
        identity fails. They cover six decades, because the units of the signals may differ.
    """

    stall: float = 0.005
    round: float = 0.002
    fast: float = 0.25
    idle: float = 0.01
    constants: tuple[float, ...] = tuple(10.0**k for k in (-3, -2.5, -2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2, 2.5, 3))


SETTINGS = IterationSettings()


@dataclass(frozen=True)
class Options:
    """Options of `musyn`; max_added_states None: 20 more than the states of the plant. InputError for wrong values."""

    target: float | None = None
    max_iterations: int = 30
    backoff: float = 0.01
    polish: bool = True
    max_added_states: int | None = None
    callback: Callable[[Iteration], Any] | None = None

    def __post_init__(self) -> None:
        if self.target is not None and not (np.isfinite(self.target) and self.target > 0):
            raise InputError("expected a positive number or None", field="target", value=self.target)
        require_whole(self.max_iterations, "max_iterations", 1)
        if not (np.isfinite(self.backoff) and 0 <= self.backoff < 1):
            raise InputError("expected a number from 0 to below 1", field="backoff", value=self.backoff)
        if self.max_added_states is not None and self.max_added_states < 0:
            raise InputError("expected a number of at least 0", field="max_added_states", value=self.max_added_states)

    def added_states(self, problem: Problem) -> int:
        """Maximum number of states that the scalings may add to the plant."""
        return problem.P.nstates + 20 if self.max_added_states is None else int(self.max_added_states)


@dataclass(frozen=True, eq=False)
class Problem:
    """P (w_delta, w, u -> z_delta, z, y) and its blocks as used in the synthesis: complex, performance last."""

    P: StateSpace
    structure: BlockStructure
    nmeas: int
    ncon: int

    @cached_property
    def scaled(self) -> ScaledProblem:
        """The plant for tests of the gamma that is achievable with given scalings."""
        return ScaledProblem.of(self.P, self.nmeas, self.ncon)


def iterate(problem: Problem, state: State, starts: tuple[StateSpace, ...], options: Options) -> tuple[State, str]:
    """Initial controllers, then scalings, K-step and analysis until a stopping criterion is met: state and status."""
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
        grid = _next_grid(state, synthesis.closed_loop)
        points = analysed(problem.P, synthesis.K, problem.structure, grid, synthesis.gamma)
        loop = Loop(synthesis.K, scalings, synthesis.gamma, points.peak)
        row = Iteration(
            len(state.history),
            synthesis.gamma,
            points.peak,
            synthesis.K.nstates,
            cost,
            sum(scalings.orders),
            time.monotonic() - began,
            kind,
        )
        state = _recorded(problem, state, loop, row, points)
        if _stopped_by(options, row):
            return state, STOPPED


def _stopped_by(options: Options, row: Iteration) -> bool:
    answer = options.callback(row) if options.callback else None
    return answer is False or answer == "stop"


def _first(problem: Problem, starts: tuple[StateSpace, ...], options: Options) -> tuple[State, bool]:
    """The state with the best initial controller, and whether the callback stopped the iteration.

    The candidates are the H-infinity controller of the unscaled plant, that of the nominal plant, and the given
    controllers; candidates that do not stabilise the plant are discarded. The nominal controller is often by far the
    best: its loop shows the D-step where the uncertainty affects a controller that achieves performance. With large
    unscaled uncertainty, the H-infinity optimal controller does not act at all.
    """
    state, failure = State(), None
    many = problem.structure.many
    candidates = initial_controllers(problem, starts, options.backoff)
    # With many unscaled blocks, the first candidate does not act and takes longest. The order is therefore reversed,
    # and the search ends when a given controller, or the nominal one, stabilises the plant.
    for kind, make in reversed(candidates) if many else candidates:
        if many and kind != GIVEN and state.best is not None:
            break
        began = time.monotonic()
        try:
            loop, points = initial_loop(problem, make())
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


def initial_controllers(
    problem: Problem, starts: tuple[StateSpace, ...], backoff: float
) -> list[tuple[str, Callable[[], StateSpace]]]:
    """Kind and constructor of each initial controller."""

    def optimal(P: StateSpace) -> StateSpace:
        return hinf_controller(P, problem.nmeas, problem.ncon, backoff).K

    performance = problem.structure.blocks[-1]
    n_z, n_w = problem.structure.n_z - performance.cols, problem.structure.n_w - performance.rows
    made: list[tuple[str, Callable[[], StateSpace]]] = [(HINF, lambda: optimal(problem.P))]
    if n_w:
        made.append((NOMINAL, lambda: optimal(problem.P.select(slice(n_z, None), slice(n_w, None)))))
    return made + [(GIVEN, partial(_itself, K)) for K in starts]


def _itself(K: StateSpace) -> StateSpace:
    return K


def initial_loop(problem: Problem, K: StateSpace) -> tuple[Loop, PointwiseScalings]:
    """Loop of an initial controller with its analysis; ComputationError if it does not stabilise the plant."""
    closed = lft_lower(problem.P, K)
    if not closed.is_stable():
        raise ComputationError(
            "a controller to start from does not stabilise the plant",
            measured=f"largest real part of a pole {np.max(closed.poles().real):.3g} rad/s",
        )
    gamma = hinf_norm(closed).gain
    points = analysed(problem.P, K, problem.structure, frequency_grid(closed), gamma)
    return Loop(K, Scalings.identity(problem.structure), gamma, points.peak), points


def _k_step(problem: Problem, state: State, options: Options) -> tuple[Proposal, Synthesis] | None:
    """Scalings with the smallest H-infinity optimum and their controller; None if no proposal has a controller.

    The fit of scalings to the last loop does not predict the next loop; one gamma test does. In a D-K step the scalings
    that are fitted quickly are tried first. They are accepted if their gamma lowers mu by more than `stall`.
    """
    assert state.path is not None
    hint = state.path.gamma
    if state.phase == "D-K":
        enough = (1 - SETTINGS.stall) * state.path.mu / (1 + options.backoff)
        if found := _best(problem, _equal_orders(problem, state, options), options, hint, enough):
            return found
    return _best(problem, _proposed(problem, state, options), options, hint)


def _best(
    problem: Problem, proposals: Iterable[Proposal], options: Options, hint: float, below: float = np.inf
) -> tuple[Proposal, Synthesis] | None:
    """The proposal with the smallest H-infinity optimum, at most `below`, and its controller. A later proposal is
    preferred if its optimum is smaller by more than `stall`. A proposal that reaches the target ends the search."""
    best: tuple[Proposal, Synthesis] | None = None
    for proposal in proposals:
        try:
            if np.isfinite(below) and not problem.scaled.reaches(proposal.scalings, below):
                continue
            made = hinf_controller(
                proposal.scalings.scale(problem.P),
                problem.nmeas,
                problem.ncon,
                options.backoff,
                best[1].gamma if best else hint,
            )
        except ComputationError:
            continue
        if best is None or made.gamma < best[1].gamma:
            best, below = (proposal, made), (1 - SETTINGS.stall) * made.gamma_optimal_bounds[1]
            if options.target is not None and made.gamma <= options.target:
                break
    return best


def _no_further(state: State, options: Options) -> str:
    """Reason to end the iteration; empty if it continues."""
    if state.phase == DONE:
        return (
            f"converged: a round of D-K iteration, descent on gamma and larger orders gains no more than "
            f"{100 * SETTINGS.round:g} %"
        )
    if state.phase in ("descent", "growth", "last start") and not options.polish:
        return f"D-K iteration stalled: a step gained less than {100 * SETTINGS.stall:g} %"
    if options.target is not None and state.best and state.best.gamma <= options.target:
        return f"target {options.target:g} reached"
    if len(_steps(state)) >= options.max_iterations:
        return f"{options.max_iterations} iterations done"
    return ""


class Proposal(NamedTuple):
    """Scalings, the cost of their realisation relative to the best scalings at each frequency, and their origin."""

    scalings: Scalings
    cost: float
    kind: str


def _equal_orders(problem: Problem, state: State, options: Options) -> Iterator[Proposal]:
    """Scalings of equal order in all blocks; their cost is measured on the grid only."""
    assert state.points is not None
    try:
        for step in equal_order_fits(state.points, options.added_states(problem)):
            yield Proposal(step.scalings, max(0.0, step.cost), "D-K")
    except np.linalg.LinAlgError:
        return


def _proposed(problem: Problem, state: State, options: Options) -> Iterator[Proposal]:
    """Candidates for the next scalings; none if the phase is exhausted."""
    assert state.last is not None and state.path is not None and state.points is not None
    if "start" in state.phase:
        tried = any(row.kind == "start" for row in state.history)
        if not tried and (found := _other_constants(problem, state.path.gamma, options)):
            yield found
        return
    if state.phase == "D-K":
        floors = D_STEP.broad_floor, D_STEP.detailed_floor
        try:
            for step in d_steps(
                state.points,
                lft_lower(problem.P, state.last.K),
                state.last.scalings,
                floors if _falls_fast(state) else floors[::-1],
                max_states=options.added_states(problem),
            ):
                yield Proposal(step.scalings, step.cost, "D-K")
        except np.linalg.LinAlgError:
            # A loop whose decompositions fail (entries of extreme magnitude) ends the D-K phase, not the synthesis.
            return
        return
    band = band_of(state.points.omega)
    start = min(state.last, state.path, key=lambda loop: loop.gamma).scalings
    if state.phase == "growth":
        larger = with_added_pairs(problem.P, problem.nmeas, problem.ncon, start, band, options.added_states(problem))
        if larger is None:
            return
        start = larger
    try:
        yield Proposal(descend(problem.P, problem.nmeas, problem.ncon, start, band), 0.0, state.phase)
    except ComputationError:
        return


def _at_rest(problem: Problem, omega: np.ndarray, mu: float) -> bool:
    """Whether a controller with this mu is idle: mu of the plant without control is no larger (within `idle`).

    With K = 0 the actuator uncertainty receives no signal and all D-scalings are equivalent: no D-step can improve it.
    """
    P = problem.P
    at_rest = P.select(slice(P.noutputs - problem.nmeas), slice(P.ninputs - problem.ncon))
    if not at_rest.is_stable():
        return False
    open_loop = upper_bound(at_rest.frequency_response(omega)[:, None], problem.structure, 1e-3).beta
    return mu > (1 - SETTINGS.idle) * float(np.max(open_loop))


def _other_constants(problem: Problem, gamma: float, options: Options) -> Proposal | None:
    """Constant scalings, equal for all uncertainty, of smallest H-infinity optimum; None if none is below gamma."""
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
    """Whether the last step lowered mu by more than `fast`, or this path has no step yet."""
    steps = _steps(state)
    return len(steps) < 2 or state.history[-1].kind == "start" or steps[-1] < (1 - SETTINGS.fast) * steps[-2]


def _steps(state: State) -> list[float]:
    """mu after each K-step of the scaled plant; nominal and given initial controllers do not count."""
    return [row.mu_upper for row in state.history if row.kind not in (NOMINAL, GIVEN)]


def _next_grid(state: State, closed_loop: StateSpace) -> np.ndarray:
    """Frequencies of the next analysis: those of the last analysis, refined around its peaks."""
    if state.points is None:
        return frequency_grid(closed_loop)
    return refined_grid(state.points.omega, state.points.mu)


def _recorded(problem: Problem, state: State, loop: Loop, row: Iteration, points: PointwiseScalings) -> State:
    """The state after an iteration: best loops updated, and the next phase if too little was gained on this path."""
    path = state.path
    assert state.best is not None and path is not None
    state = replace(
        state,
        points=points,
        last=loop,
        best=loop if loop.mu < state.best.mu else state.best,
        history=(*state.history, row),
    )
    if row.kind == "start":
        return replace(state, phase="D-K", path=loop, round_mu=loop.mu)
    gained = 1 - loop.mu / path.mu
    state = replace(state, path=loop if gained > 0 else path)
    return state if gained > SETTINGS.stall else _moved_on(problem, state)


def _moved_on(problem: Problem, state: State) -> State:
    """The state in the next phase; after growth, a new round from the path's best loop if this round gained enough."""
    assert state.path is not None and state.last is not None and state.points is not None
    if state.phase == "D-K" and state.path.mu >= state.round_mu:
        return replace(state, phase="other start")
    # If neither descent nor growth found a step, D-K iteration would only repeat its last step.
    over = state.path.mu > (1 - SETTINGS.round) * state.round_mu or state.history[-1].kind == "D-K"
    if state.phase != "growth" or over:
        return replace(state, phase=FOLLOWING[state.phase])
    points = state.points
    if state.last is not state.path:
        points = analysed(problem.P, state.path.K, problem.structure, points.omega, state.path.gamma)
    return replace(state, phase="D-K", points=points, last=state.path, round_mu=state.path.mu)
