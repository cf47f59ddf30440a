"""mu synthesis: a controller that makes the peak of the structured singular value small.

D-K iteration (Doyle 1985; Zhou, Doyle and Glover 1996, section 11.4) with scalings of automatic order, followed,
where it stalls, by descent on the H-infinity optimum over the scalings themselves (`gamma_descent`). Where the first
H-infinity controller does nothing, the iteration starts from other constant scalings (`_stuck_at_rest`).

Real uncertainty is synthesised for as if it were complex, which is conservative: every real perturbation is a
complex one. What that costs is measured on the final loop, where mu is computed both ways.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, gain, hinf_norm, lft_lower
from avis_ctrl.robust.dstep import BROAD_FLOOR, DETAILED_FLOOR, PointwiseScalings, band_of, d_step, tightened
from avis_ctrl.robust.frequency_grid import frequency_grid, refined_grid
from avis_ctrl.robust.gamma_descent import descend, grown
from avis_ctrl.robust.hinf_plant import as_plant
from avis_ctrl.robust.hinfsyn import Synthesis, hinfsyn
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn_state import Iteration, Loop, State, analysed
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import Block, BlockStructure

# An iteration that lowers the best gamma by less than this share has stalled.
STALL = 0.005
FLAT = 0.001
# A step that lowers mu by more than this share is followed by another of its kind.
FAST = 0.25
# A loop within this share of the plant without control is that of a controller that does nothing.
IDLE = 0.01
# Constant scalings of all uncertainty against performance from which the iteration starts where identity leads nowhere.
STARTS = tuple(10.0 ** k for k in (-3, -2.5, -2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2, 2.5, 3))
# What the certificate may leave above mu of the final loop.
TIGHT = 0.003
NORM_TOLERANCE = 1e-6
DONE = "done"
FOLLOWING = {"D-K": "descent", "descent": "growth", "growth": DONE}


@dataclass(frozen=True, eq=False)
class MuSynthesis:
    """The best controller of all iterations, and what was measured on it.

    mu_upper, mu_lower : bounds of the peak of mu over all frequencies with the blocks as given (real ones real).
    mu_upper_complex : the same upper bound with real blocks taken as complex, as the synthesis did.
    delta : the perturbation behind mu_lower, at omega_peak [rad/s].
    guaranteed : whether mu_upper is an upper bound between the frequencies computed, too.
    gamma : measured norm of the loop scaled by `scalings`: no less than complex mu at any frequency.
    saved_state : JSON-able; `musyn(..., state=saved_state)` goes on from here.
    """

    K: StateSpace
    mu_upper: float
    mu_lower: float
    omega_peak: float
    mu_upper_complex: float
    guaranteed: bool
    delta: np.ndarray | None
    blocks: BlockStructure
    scalings: Scalings
    gamma: float
    closed_loop: StateSpace
    fastest_pole: float
    history: tuple[Iteration, ...]
    status: str
    notes: tuple[str, ...]
    saved_state: dict[str, Any]


@dataclass(frozen=True)
class _Options:
    target: float | None
    deadline: float
    max_iterations: int
    backoff: float
    polish: bool
    max_added_states: int
    callback: Callable[[Iteration], Any] | None


def musyn(P: Any, blocks: BlockStructure | Sequence[Block], nmeas: int, ncon: int, *,
          callback: Callable[[Iteration], Any] | None = None, target: float | None = None,
          time_limit: float | None = None, max_iterations: int = 30, backoff: float = 0.01, polish: bool = True,
          max_added_states: int | None = None, state: dict[str, Any] | None = None,
          sample_rate_Hz: float | None = None) -> MuSynthesis:
    """Controller u = K y of least peak mu.

    Parameters
    ----------
    P : StateSpace (ours or python-control's), continuous, inputs (w_delta, w, u), outputs (z_delta, z, y).
    blocks : uncertainty in the order of w_delta; the rest of w and z is the performance block.
    nmeas, ncon : number of measurements y and controls u.
    callback : called with each `Iteration`; returning False or "stop" ends the iteration.
    target : stop once the scaled loop is measured below this (mu is then below it at every frequency).
    time_limit : seconds after which no further iteration starts.
    backoff : distance from the H-infinity optimum at which each controller is taken.
    polish : go on with descent on gamma where D-K iteration stalls (and orders that grow where that pays).
    max_added_states : most states that all scalings together may add to the plant.
    state : `saved_state` of an earlier result, to go on from.
    sample_rate_Hz : the controller's fastest pole is compared with half of it, in `notes`.

    Raises
    ------
    InputError : blocks that do not fit P, counts or options that are wrong, a state of another problem.
    ComputationError : no stabilising controller (the mode is named), or none found.
    """
    P = as_plant(P, nmeas, ncon)
    uncertainty, structure = _structures(P, blocks, nmeas, ncon)
    cap = P.nstates + 20 if max_added_states is None else max_added_states
    options = _options(target, time_limit, max_iterations, backoff, polish, cap, callback)
    problem = _Problem(P, structure, nmeas, ncon)
    with threadpool_limits(1, user_api="blas"):
        current = State() if state is None else State.from_dict(state, structure, P, nmeas, ncon)
        current, status = _iterate(problem, current, options)
        return _result(problem, uncertainty, current, status, sample_rate_Hz)


def _structures(P: StateSpace, blocks: BlockStructure | Sequence[Block], nmeas: int,
                ncon: int) -> tuple[BlockStructure, BlockStructure]:
    """The blocks as given with performance, and as the synthesis sees them (complex)."""
    if P.dt:
        raise InputError("expected a continuous plant (dt = 0); discretise K afterwards", field="P.dt", value=P.dt)
    uncertainty = BlockStructure.of(blocks)
    n_w, n_z = P.ninputs - ncon - uncertainty.n_w, P.noutputs - nmeas - uncertainty.n_z
    if n_w < 1 or n_z < 1:
        raise InputError(
            f"blocks take {uncertainty.n_w} inputs and {uncertainty.n_z} outputs of a plant with "
            f"{P.ninputs - ncon} inputs (w_delta, w) and {P.noutputs - nmeas} outputs (z_delta, z); "
            "at least one of each must be left for performance", field="blocks")
    full = uncertainty.with_performance(n_w, n_z)
    return full, full.complexified()


def _options(target: float | None, time_limit: float | None, max_iterations: int, backoff: float, polish: bool,
             cap: int, callback: Callable[[Iteration], Any] | None) -> _Options:
    for field, value in (("target", target), ("time_limit", time_limit)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError("expected a positive number or None", field=field, value=value)
    if int(max_iterations) != max_iterations or max_iterations < 1:
        raise InputError("expected a whole number of at least 1", field="max_iterations", value=max_iterations)
    if not (np.isfinite(backoff) and 0 <= backoff < 1):
        raise InputError("expected a number from 0 to below 1", field="backoff", value=backoff)
    if cap < 0:
        raise InputError("expected a number of at least 0", field="max_added_states", value=cap)
    deadline = np.inf if time_limit is None else time.monotonic() + time_limit
    return _Options(target, deadline, int(max_iterations), backoff, polish, int(cap), callback)


@dataclass(frozen=True, eq=False)
class _Problem:
    P: StateSpace
    structure: BlockStructure
    nmeas: int
    ncon: int


def _iterate(problem: _Problem, state: State, options: _Options) -> tuple[State, str]:
    """Scalings, K-step and analysis, again and again, until something says stop."""
    while True:
        if status := _no_further(state, options):
            return state, status
        began = time.monotonic()
        proposal = _proposed(problem, state, options)
        synthesis = _k_step(problem, state, proposal, options) if proposal else None
        if proposal is None or synthesis is None:
            state = replace(state, phase=FOLLOWING[state.phase])
            continue
        scalings, cost, kind = proposal
        points = analysed(problem.P, synthesis.K, problem.structure, _next_grid(state, synthesis.closed_loop))
        loop = Loop(synthesis.K, scalings, synthesis.gamma, points.peak)
        row = Iteration(len(state.history), synthesis.gamma, points.peak, synthesis.K.nstates, cost,
                        sum(scalings.orders), time.monotonic() - began, kind)
        state = _recorded(state, loop, row, points)
        answer = options.callback(row) if options.callback else None
        if answer is False or answer == "stop":
            return state, "stopped by the callback"


def _k_step(problem: _Problem, state: State, proposal: _Proposal, options: _Options) -> Synthesis | None:
    """H-infinity controller of the scaled plant; None where scalings, not the plant, make it fail."""
    try:
        return hinfsyn(proposal.scalings.scale(problem.P), problem.nmeas, problem.ncon, backoff=options.backoff,
                       gamma_hint=state.best.gamma if state.best else None)
    except ComputationError:
        if state.best is None:
            raise
        return None


def _no_further(state: State, options: _Options) -> str:
    """Why no further iteration starts; empty where one does."""
    if state.phase == DONE:
        return f"converged: neither D-K iteration nor descent on gamma gains {100 * STALL:g} % more"
    if state.phase != "D-K" and not options.polish:
        return f"D-K iteration stalled: a step gained less than {100 * STALL:g} %, or left the scaled loop flat"
    if options.target is not None and state.best and state.best.gamma <= options.target:
        return f"target {options.target:g} reached"
    if len(state.history) >= options.max_iterations:
        return f"{options.max_iterations} iterations done"
    if time.monotonic() > options.deadline and state.best:
        return "time limit reached"
    return ""


class _Proposal(NamedTuple):
    """Scalings, what their realisation costs against the best at each frequency, and how they were made."""

    scalings: Scalings
    cost: float
    kind: str


def _proposed(problem: _Problem, state: State, options: _Options) -> _Proposal | None:
    """The next scalings; None where the phase has nothing more to offer."""
    if state.last is None or state.best is None or state.points is None:
        return _Proposal(Scalings.identity(problem.structure), 0.0, "H-infinity")
    if _stuck_at_rest(problem, state) and (other := _other_start(problem, state.best.gamma, options)):
        return other
    if state.phase == "D-K":
        points = replace(state.points, floor=BROAD_FLOOR if _falls_fast(state) else DETAILED_FLOOR)
        try:
            step = d_step(points, lft_lower(problem.P, state.last.K), state.last.scalings,
                          max_states=options.max_added_states)
        except np.linalg.LinAlgError:
            # A loop that no decomposition takes (entries beyond all scale) ends the D-K phase, not the synthesis.
            return None
        return _Proposal(step.scalings, step.cost, "D-K")
    band = band_of(state.points.omega)
    start = min(state.last, state.best, key=lambda loop: loop.gamma).scalings
    if state.phase == "growth":
        larger = grown(problem.P, problem.nmeas, problem.ncon, start, band, options.max_added_states)
        if larger is None:
            return None
        start = larger
    target = 0.0 if options.target is None else options.target / (1 + options.backoff)
    try:
        descent = descend(problem.P, problem.nmeas, problem.ncon, start, band,
                          stop=lambda gamma: gamma <= target or time.monotonic() > options.deadline)
    except ComputationError:
        return None
    return _Proposal(descent.scalings, 0.0, state.phase)


def _stuck_at_rest(problem: _Problem, state: State) -> bool:
    """Whether the H-infinity controller of the first scalings does nothing, and no other start was tried.

    With K = 0 the uncertainty of the drives sees no signal and no D is better than another: no D-step leads away.
    """
    if len(state.history) != 1 or state.last is None or state.points is None:
        return False
    at_rest = lft_lower(problem.P, gain(np.zeros((problem.ncon, problem.nmeas)), state.last.K.inputs,
                                        state.last.K.outputs))
    if not at_rest.is_stable():
        return False
    open_loop = upper_bound(at_rest.frequency_response(state.points.omega)[:, None], problem.structure, 1e-3).beta
    return state.last.mu > (1 - IDLE) * float(np.max(open_loop))


def _other_start(problem: _Problem, gamma: float, options: _Options) -> _Proposal | None:
    """The constant scalings, alike for all uncertainty, of least H-infinity optimum; None where none is below gamma."""
    best = None
    for d in STARTS:
        scalings = Scalings.uniform(problem.structure, d)
        try:
            made = hinfsyn(scalings.scale(problem.P), problem.nmeas, problem.ncon, backoff=options.backoff)
        except ComputationError:
            continue
        if made.gamma < (1 - STALL) * gamma:
            best, gamma = scalings, made.gamma
        if time.monotonic() > options.deadline:
            break
    return _Proposal(best, 0.0, "start") if best else None


def _falls_fast(state: State) -> bool:
    """Whether the last step lowered mu by more than `FAST`, or none was taken yet."""
    return len(state.history) < 2 or state.history[-1].mu_upper < (1 - FAST) * state.history[-2].mu_upper


def _next_grid(state: State, closed_loop: StateSpace) -> np.ndarray:
    """Frequencies of the next analysis: those of the last one, denser at its peaks."""
    if state.points is None:
        return frequency_grid(closed_loop)
    return refined_grid(state.points.omega, state.points.mu)


def _recorded(state: State, loop: Loop, row: Iteration, points: PointwiseScalings) -> State:
    """The state after an iteration: the best loop kept, the phase moved on where nothing was gained."""
    gained = np.inf if state.best is None else 1 - loop.mu / state.best.mu
    best = loop if gained > 0 else state.best
    # A loop that fitted scalings have made flat has mu at its bound everywhere: no other D lowers it further.
    flat = row.kind == "D-K" and loop.gamma < (1 + FLAT) * loop.mu
    phase = state.phase if gained > STALL and not flat else FOLLOWING[state.phase]
    return State(phase, points, loop, best, (*state.history, row))


def _certificate(problem: _Problem, best: Loop) -> tuple[Scalings, float]:
    """Realised scalings that bound mu of a loop at every frequency, and the bound.

    Those that K was made with, or others of the least peak where they leave more than `TIGHT` above mu on the grid.
    """
    closed = lft_lower(problem.P, best.K)

    def bound(scalings: Scalings) -> float:
        return hinf_norm(scalings.scale(closed), NORM_TOLERANCE).gain * (1 + NORM_TOLERANCE)
    candidates = [(best.scalings, bound(best.scalings))]
    if candidates[0][1] > (1 + TIGHT) * best.mu:
        points = analysed(problem.P, best.K, problem.structure, frequency_grid(closed))
        tighter = tightened(points, closed, best.scalings, TIGHT, 10 * problem.P.nstates).scalings
        candidates.append((tighter, bound(tighter)))
    return min(candidates, key=lambda pair: pair[1])


def _result(problem: _Problem, uncertainty: BlockStructure, state: State, status: str,
            sample_rate_Hz: float | None) -> MuSynthesis:
    """The best controller, with mu of the plant as given measured anew on it."""
    best = state.best
    assert best is not None
    closed = lft_lower(problem.P, best.K)
    # The norm of the scaled loop holds between all frequencies; with real blocks taken as complex it bounds theirs.
    scalings, gamma = _certificate(problem, best)
    peak = mu_peak(closed, uncertainty, known_upper=gamma)
    has_real = any(block.kind == "real" for block in uncertainty.blocks)
    mu_upper = min(peak.upper, gamma)
    complex_upper = gamma if has_real else mu_upper
    fastest = float(np.max(np.abs(best.K.poles()), initial=0.0))
    notes = []
    if has_real:
        notes.append(f"real blocks were synthesised for as complex ones: peak mu {complex_upper:.4g} so, "
                     f"{mu_upper:.4g} with the real blocks real")
    if sample_rate_Hz is not None:
        ratio = fastest / (np.pi * sample_rate_Hz)
        notes.append(f"fastest controller pole {fastest:.4g} rad/s is {ratio:.2g} of half the sample rate")
    guaranteed = peak.guaranteed or mu_upper == gamma
    return MuSynthesis(best.K, mu_upper, peak.lower, peak.omega, complex_upper, guaranteed, peak.delta, uncertainty,
                       scalings, gamma, closed, fastest, state.history, status, tuple(notes),
                       state.as_dict(problem.P, problem.nmeas, problem.ncon))
