"""mu synthesis: a controller that makes the peak of the structured singular value small.

D-K iteration (Doyle 1985; Zhou, Doyle and Glover 1996, section 11.4) with scalings of automatic order, followed,
where it stalls, by descent on the H-infinity optimum over the scalings themselves (`gamma_descent`).

Real uncertainty is synthesised for as if it were complex, which is conservative: every real perturbation is a
complex one. What that costs is measured on the final loop, where mu is computed both ways.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, lft_lower
from avis_ctrl.robust.dstep import PointwiseScalings, choose_scalings
from avis_ctrl.robust.frequency_grid import frequency_grid, refined_grid
from avis_ctrl.robust.gamma_descent import descend, grown
from avis_ctrl.robust.hinf_plant import as_plant
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.robust.musyn_state import Iteration, Loop, State
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import Block, BlockStructure

# An iteration that lowers the best gamma by less than this share has stalled.
STALL = 0.005
DONE = "done"


@dataclass(frozen=True, eq=False)
class MuSynthesis:
    """The best controller of all iterations, and what was measured on it.

    mu_upper, mu_lower : bounds of the peak of mu over all frequencies with the blocks as given (real ones real).
    mu_upper_complex : the same upper bound with real blocks taken as complex, as the synthesis did.
    delta : the perturbation behind mu_lower, at omega_peak [rad/s].
    guaranteed : whether mu_upper is an upper bound between the frequencies computed, too.
    gamma : measured norm of the loop scaled by `scalings`.
    saved_state : JSON-able; `musyn(..., state=saved_state)` goes on from here.
    """

    K: StateSpace
    mu_upper: float
    mu_lower: float
    omega_peak: float
    mu_upper_complex: float
    guaranteed: bool
    delta: np.ndarray
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
    max_added_states: int
    callback: Callable[[Iteration], Any] | None


def musyn(P: Any, blocks: BlockStructure | Sequence[Block], nmeas: int, ncon: int, *,
          callback: Callable[[Iteration], Any] | None = None, target: float | None = None,
          time_limit: float | None = None, max_iterations: int = 30, backoff: float = 0.01,
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
    cap = 2 * P.nstates + 20 if max_added_states is None else max_added_states
    options = _options(target, time_limit, max_iterations, backoff, cap, callback)
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


def _options(target: float | None, time_limit: float | None, max_iterations: int, backoff: float, cap: int,
             callback: Callable[[Iteration], Any] | None) -> _Options:
    for field, value in (("target", target), ("time_limit", time_limit)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError("expected a positive number or None", field=field, value=value)
    if int(max_iterations) != max_iterations or max_iterations < 1:
        raise InputError("expected a whole number of at least 1", field="max_iterations", value=max_iterations)
    if not (np.isfinite(backoff) and 0 < backoff < 1):
        raise InputError("expected a number between 0 and 1", field="backoff", value=backoff)
    if cap < 0:
        raise InputError("expected a number of at least 0", field="max_added_states", value=cap)
    deadline = np.inf if time_limit is None else time.monotonic() + time_limit
    return _Options(target, deadline, int(max_iterations), backoff, int(cap), callback)


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
        scalings, cost, kind = _proposed(problem, state, options)
        if scalings is None:
            state = replace(state, phase="descent" if state.phase == "D-K" else DONE)
            continue
        hint = state.best.gamma if state.best else None
        synthesis = hinfsyn(scalings.scale(problem.P), problem.nmeas, problem.ncon, backoff=options.backoff,
                            gamma_hint=hint)
        loop = Loop(synthesis.K, scalings, synthesis.gamma)
        omega = frequency_grid(synthesis.closed_loop) if not state.omega.size else state.omega
        points = _analysed(problem, loop, omega)
        row = Iteration(len(state.history), synthesis.gamma, points.peak, synthesis.K.nstates, cost,
                        sum(scalings.orders), time.monotonic() - began, kind)
        state = _recorded(state, loop, row, refined_grid(omega, points.mu))
        answer = options.callback(row) if options.callback else None
        if answer is False or answer == "stop":
            return state, "stopped by the callback"


def _no_further(state: State, options: _Options) -> str:
    """Why no further iteration starts; empty where one does."""
    if state.phase == DONE:
        return f"converged: neither D-K iteration nor descent on gamma gains {100 * STALL:g} % more"
    if options.target is not None and state.best and state.best.gamma <= options.target:
        return f"target {options.target:g} reached"
    if len(state.history) >= options.max_iterations:
        return f"{options.max_iterations} iterations done"
    if time.monotonic() > options.deadline and state.best:
        return "time limit reached"
    return ""


def _proposed(problem: _Problem, state: State, options: _Options) -> tuple[Scalings | None, float, str]:
    """The next scalings, what their realisation costs against the best at each frequency, and how they were made."""
    if state.last is None or state.best is None:
        return Scalings.identity(problem.structure), 0.0, "H-infinity"
    if state.phase == "D-K":
        points = _analysed(problem, state.last, state.omega)
        step = choose_scalings(points, max_states=options.max_added_states, start=state.last.scalings)
        return step.scalings, step.cost, "D-K"
    band = (float(state.omega[0]), float(state.omega[-1]))
    start = state.best.scalings
    if state.phase == "growth":
        larger = grown(problem.P, problem.nmeas, problem.ncon, start, band, options.max_added_states)
        if larger is None:
            return None, 0.0, ""
        start = larger
    target = 0.0 if options.target is None else options.target / (1 + options.backoff)
    try:
        descent = descend(problem.P, problem.nmeas, problem.ncon, start, band,
                          stop=lambda gamma: gamma <= target or time.monotonic() > options.deadline)
    except ComputationError:
        return None, 0.0, ""
    return descent.scalings, 0.0, state.phase


def _analysed(problem: _Problem, loop: Loop, omega: np.ndarray) -> PointwiseScalings:
    closed = lft_lower(problem.P, loop.K)
    return PointwiseScalings.of(omega, closed.frequency_response(omega), problem.structure)


def _recorded(state: State, loop: Loop, row: Iteration, omega: np.ndarray) -> State:
    """The state after an iteration: the best loop kept, the phase moved on where nothing was gained."""
    gained = np.inf if state.best is None else 1 - loop.gamma / state.best.gamma
    best = loop if gained > 0 else state.best
    following = {"D-K": "descent", "descent": "growth", "growth": DONE}
    phase = state.phase if gained > STALL else following[state.phase]
    return State(phase, omega, loop, best, (*state.history, row))


def _result(problem: _Problem, uncertainty: BlockStructure, state: State, status: str,
            sample_rate_Hz: float | None) -> MuSynthesis:
    """The best controller, with mu of the plant as given measured anew on it."""
    best = state.best
    assert best is not None
    closed = lft_lower(problem.P, best.K)
    peak = mu_peak(closed, uncertainty)
    has_real = any(block.kind == "real" for block in uncertainty.blocks)
    complex_peak = mu_peak(closed, problem.structure) if has_real else peak
    fastest = float(np.max(np.abs(best.K.poles()), initial=0.0))
    notes = []
    if has_real:
        notes.append(f"real blocks were synthesised for as complex ones: peak mu {complex_peak.upper:.4g} so, "
                     f"{peak.upper:.4g} with the real blocks real")
    if sample_rate_Hz is not None:
        ratio = fastest / (np.pi * sample_rate_Hz)
        notes.append(f"fastest controller pole {fastest:.4g} rad/s is {ratio:.2g} of half the sample rate")
    return MuSynthesis(best.K, peak.upper, peak.lower, peak.omega, complex_peak.upper, peak.guaranteed, peak.delta,
                       uncertainty, best.scalings, best.gamma, closed, fastest, state.history, status, tuple(notes),
                       state.as_dict(problem.P, problem.nmeas, problem.ncon))
