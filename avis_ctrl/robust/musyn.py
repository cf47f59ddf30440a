"""mu synthesis: a controller that minimises the peak of the structured singular value.

D-K iteration (Doyle 1985; Zhou, Doyle and Glover 1996, section 11.4) with scalings of automatic order: among several
fits to the best scalings at each frequency, one is used whose gamma is within 0.5 % of the smallest. When D-K iteration
stalls, it is followed by descent on the H-infinity optimum over the scalings (`gamma_descent`). If the first H-infinity
controller is no better than no control, the iteration starts from other constant scalings. See `musyn_iteration`.

The synthesis treats real uncertainty as complex. This is conservative, because every real perturbation is also a
complex perturbation. The conservatism is measured on the final loop, where mu is computed both ways.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.checks import require_whole
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, hinf_norm, lft_lower
from avis_ctrl.lti.bilinear import continuous_image, sampled_image
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.robust.dstep import PointwiseScalings, tightened
from avis_ctrl.robust.fixed_order import fixed_order
from avis_ctrl.robust.frequency_grid import frequency_grid
from avis_ctrl.robust.hinf_plant import as_plant
from avis_ctrl.robust.mu_descent import Task
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn_iteration import Options, Problem, initial_controllers, initial_loop, iterate
from avis_ctrl.robust.musyn_state import Iteration, Loop, State, analysed
from avis_ctrl.robust.one_thread import one_thread
from avis_ctrl.robust.robustness import opened
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.blocks import Block, BlockStructure
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem


@dataclass(frozen=True)
class CertificateSettings:
    """tight : largest relative difference between the certificate and mu of the final loop that is accepted [1]: less
        than what a step of the D-K iteration has to gain.
    norm : relative accuracy of the norm in the certificate [1]; it is added to the norm, hence far below `tight`.
    """

    tight: float = 0.003
    norm: float = 1e-6


SETTINGS = CertificateSettings()


@dataclass(frozen=True, eq=False, repr=False)
class MuSynthesis(Shown):
    """The best controller of all iterations, and the properties of its closed loop.

    mu_upper, mu_lower : bounds of the peak of mu over all frequencies with the blocks as given (real blocks real).
    mu_upper_complex : the same upper bound with real blocks treated as complex, as in the synthesis.
    delta : the perturbation that proves mu_lower, at omega_peak [rad/s].
    guaranteed : whether mu_upper is also an upper bound between the computed frequencies.
    scalings, gamma : D-scalings and measured norm of the scaled loop, an upper bound of complex mu at every frequency.
        For a sampled loop the scalings are functions of the frequency of its continuous image
        (`lti.bilinear.image_frequency`).
    fastest_pole : largest magnitude [rad/s] of a pole of K (of its continuous image if K is sampled).
    closed_loop : the generalized plant with K; `mu_peak(closed_loop, blocks)` gives mu over frequency.
    saved_state : JSON-serialisable; `musyn(..., state=saved_state)` continues from here.
    """

    in_line = ("K", "mu_upper", "mu_lower", "omega_peak", "guaranteed", "status")

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


def musyn(
    P: Any,
    blocks: Any = None,
    nmeas: Any = None,
    ncon: Any = None,
    *,
    callback: Callable[[Iteration], Any] | None = None,
    target: float | None = None,
    max_iterations: int = 30,
    backoff: float = 0.01,
    polish: bool = True,
    max_added_states: int | None = None,
    starts: Sequence[StateSpace] = (),
    state: dict[str, Any] | None = None,
    sample_rate_Hz: float | None = None,
    order: int | None = None,
    structure: Literal["full", "decentralised"] = "full",
) -> MuSynthesis:
    """Controller u = K y that minimises the peak of mu, by D-K iteration: `musyn(P, nmeas, ncon)` for an uncertain
    system, `musyn(P, blocks, nmeas, ncon)` for a system with its blocks.

    Parameters
    ----------
    P : `UncertainSystem`, inputs (w, u), outputs (z, y); or StateSpace (avis_ctrl or python-control), inputs
        (w_delta, w, u), outputs (z_delta, z, y), with `blocks`. If P is sampled, K is designed for its continuous image
        (`lti.bilinear`) and has the same sample rate; all results are computed from the sampled loop.
    blocks : uncertainty of a StateSpace in the order of w_delta. w and z form the performance block.
    nmeas, ncon : number of measurements y and controls u, which are the last signals; or their names.
    callback : called with each `Iteration`; returning False or "stop" ends the iteration.
    target : stop as soon as the norm of the scaled loop is below this value (so is mu, at every frequency).
    max_iterations : maximum number of K-steps, including the first H-infinity controller. There is no time limit, so
        the same call gives the same controller on the same machine; on another processor, rounding may lead D-K
        iteration along another path. A call with more iterations, or with a lower target, repeats the steps of a
        shorter call and continues; only the step that reaches the target may differ.
    backoff : relative distance of each controller from the H-infinity optimum. It raises mu by about the same fraction;
        a smaller value gives faster controller poles.
    polish : when D-K iteration stalls, continue with descent on gamma (and scalings of higher order if they lower
        it), then with D-K iteration again, until a whole round no longer improves the result.
    max_added_states : maximum number of states that all scalings together may add to the plant.
    starts : known controllers u = K y. The iteration starts from the best of these and the H-infinity controllers. The
        result is not worse than any of them that stabilises P: in complex mu on the grid, or, with real blocks, in mu.
    state : `saved_state` of an earlier result, to continue from. If it belongs to another plant with the same y and u
        (a changed weight, more uncertainty), its controllers are used as `starts`.
    order : maximum number of states of the controller. The order of the full controller is reduced; the result is
        improved by descent on mu over its entries (`fixed_order`), and all results are those of this controller.
        `saved_state` belongs to the full-order controller.
    structure : "decentralised": u_k depends on y_k only; K has the given order (default: that of the full controller).
    sample_rate_Hz : `notes` compare the controller's fastest pole with half of this rate.

    Raises
    ------
    InputError : blocks that do not fit P, invalid counts or options, controllers that do not fit, a saved state with
        controllers of other dimensions or sample time.
    ComputationError : no stabilising controller exists (the mode is named), or none was found.

    Examples
    --------
    x' = -x + w + k u with z = (x, u) and y = x + n, the actuator's gain k known to 50 %:

    >>> k = ac.real("k", 1.0, percent=50)
    >>> names = {"inputs": ["w", "n", "u"], "outputs": ["x", "effort", "y"]}
    >>> plant = ac.ss([[-1]], [[1, 0, k]], [[1], [0], [1]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]], **names)
    >>> made = ac.musyn(plant, nmeas="y", ncon="u", max_iterations=3, polish=False)      # or nmeas=1, ncon=1
    >>> made.guaranteed, round(made.mu_upper, 2)
    (True, 0.91)
    >>> loop = ac.connect([plant, made.K], ["w", "n"], ["x", "effort"])      # the uncertain closed loop
    >>> round(ac.robust_performance(loop).lower, 2)
    1.1
    """
    if isinstance(P, UncertainSystem) and ncon is None and blocks is not None:
        blocks, nmeas, ncon = None, blocks, nmeas
    if isinstance(P, UncertainSystem) or blocks is None:
        P, blocks, _ = opened(P, blocks)
    P, nmeas, ncon = as_plant(P, nmeas, ncon)
    if structure not in ("full", "decentralised"):
        raise InputError("expected 'full' or 'decentralised'", field="structure", value=structure)
    apart = structure == "decentralised"
    if apart and nmeas != ncon:
        raise InputError(
            "a decentralised controller has as many outputs as inputs", field="nmeas, ncon", value=(nmeas, ncon)
        )
    if order is not None:
        require_whole(order, "order", 0)
    options = Options(target, max_iterations, backoff, polish, max_added_states, callback)
    made = dk_iteration(P, blocks, nmeas, ncon, options, starts, state)
    with threadpool_limits(1, user_api="blas"):
        best, notes = made.best, tuple[str, ...]()
        if apart or (order is not None and best.K.nstates > order):
            task = Task(made.problem.P, made.problem.structure, decentralised=apart)
            *_, short = fixed_order(task, best.K, best.K.nstates if order is None else order)
            K, peak = short.K, short.peak
            notes = (
                f"{structure}, order {K.nstates} instead of {best.K.nstates}: complex mu on the grid {peak:.4g} "
                f"instead of {best.mu:.4g}",
            )
            best = Loop(K, best.scalings, np.nan, peak)
            return _result(made, best, sample_rate_Hz, notes)
        return _best_with_real_blocks(made, _result(made, best, sample_rate_Hz, notes), sample_rate_Hz)


@dataclass(frozen=True, eq=False)
class DKIteration:
    """Result of D-K iteration, before the final bounds are computed.

    P, uncertainty : as given, performance as the last block. problem : P and blocks as used in the synthesis.
    initial : kind and constructor of each initial controller.
    best : the controller with the smallest complex mu on the grid; for a sampled plant its continuous image.
    """

    P: StateSpace
    problem: Problem
    uncertainty: BlockStructure
    state: State
    status: str
    initial: Sequence[tuple[str, Callable[[], StateSpace]]]

    @property
    def best(self) -> Loop:
        """The loop with the smallest peak of mu."""
        assert self.state.best is not None
        return self.state.best

    @property
    def history(self) -> tuple[Iteration, ...]:
        """The iterations in order."""
        return self.state.history

    @cached_property
    def omega_peak(self) -> float:
        """Frequency of the largest complex mu of the best loop on the grid of the last iteration [rad/s]."""
        points = self.state.points
        assert points is not None
        if self.state.last is not self.best:
            points = analysed(self.problem.P, self.best.K, self.problem.structure, points.omega, self.best.gamma)
        return float(points.omega[np.argmax(points.mu)])


def dk_iteration(
    P: StateSpace,
    blocks: BlockStructure | Sequence[Block],
    nmeas: int,
    ncon: int,
    options: Options,
    starts: Sequence[StateSpace] = (),
    state: dict[str, Any] | None = None,
) -> DKIteration:
    """The iteration of `musyn` alone, with the same parameters and errors, for callers that change the controller
    before its bounds are computed."""
    uncertainty, complexified = _structures(P, blocks, nmeas, ncon)
    problem = Problem(continuous_image(P), complexified, nmeas, ncon)
    given = tuple(continuous_image(_named(P, as_system(K, "starts"), nmeas, ncon)) for K in starts)
    with threadpool_limits(1, user_api="blas"):
        current, known = State(), tuple[StateSpace, ...]()
        if state is not None:
            current, known = State.from_dict(state, complexified, problem.P, nmeas, ncon, P.dt)
        current, status = iterate(problem, current, (*known, *given), options)
        initial = initial_controllers(problem, given, options.backoff)
        return DKIteration(P, problem, uncertainty, current, status, initial)


def _structures(
    P: StateSpace, blocks: BlockStructure | Sequence[Block], nmeas: int, ncon: int
) -> tuple[BlockStructure, BlockStructure]:
    """The given blocks with performance, and the blocks used in the synthesis: complex, and with one number per
    scaling if there are many blocks."""
    uncertainty = BlockStructure.of(blocks)
    n_w, n_z = P.ninputs - ncon - uncertainty.n_w, P.noutputs - nmeas - uncertainty.n_z
    if n_w < 1 or n_z < 1:
        raise InputError(
            "expected at least one input and one output for performance: besides those of the controller, the plant "
            f"has {P.ninputs - ncon} inputs and {P.noutputs - nmeas} outputs, of which the blocks take "
            f"{uncertainty.n_w} and {uncertainty.n_z}",
            field="P",
        )
    full = uncertainty.with_performance(n_w, n_z)
    return full, full.simplified() if full.many else full.complexified()


def _named(P: StateSpace, K: StateSpace, nmeas: int, ncon: int) -> StateSpace:
    """A given controller with the signal names of the plant."""
    if not isinstance(K, StateSpace) or (K.ninputs, K.noutputs) != (nmeas, ncon) or K.dt != P.dt:
        clock = f"sampled at {P.dt:g} s" if P.dt else "continuous"
        raise InputError(
            f"expected {clock} controllers with {nmeas} inputs and {ncon} outputs", field="starts", value=repr(K)
        )
    return K.renamed(P.outputs[P.noutputs - nmeas :], P.inputs[P.ninputs - ncon :])


def _certificate(problem: Problem, best: Loop, closed: StateSpace) -> tuple[Scalings, float]:
    """Realised scalings that bound mu of a loop (the image of a sampled loop) at every frequency, and the bound.

    These are the scalings of the K-step, or tightened ones if the former bound exceeds mu on the grid by over
    `SETTINGS.tight`.
    """

    def bound(scalings: Scalings) -> float:
        return hinf_norm(scalings.scale(closed), SETTINGS.norm).gain * (1 + SETTINGS.norm)

    candidates = [(best.scalings, bound(best.scalings))]
    if candidates[0][1] > (1 + SETTINGS.tight) * best.mu:
        omega = frequency_grid(closed)
        points = PointwiseScalings.of(omega, closed.frequency_response(omega), problem.structure)
        tighter = tightened(points, closed, best.scalings, SETTINGS.tight, 10 * problem.P.nstates).scalings
        candidates.append((tighter, bound(tighter)))
    return min(candidates, key=lambda pair: pair[1])


def _best_with_real_blocks(made: DKIteration, result: MuSynthesis, sample_rate_Hz: float | None) -> MuSynthesis:
    """The result, or that of an initial controller whose mu with real blocks is smaller.

    D-K iteration minimises mu with complex blocks, by which it also chooses the best controller.
    """
    if all(block.kind != "real" for block in made.uncertainty.blocks):
        return result
    for kind, make in made.initial:
        try:
            loop, points = initial_loop(made.problem, make())
        except ComputationError:
            continue
        response = lft_lower(made.problem.P, loop.K).frequency_response(points.omega)
        with one_thread():
            upper = upper_bound(response[:, None], made.uncertainty).beta
        if np.max(upper) < result.mu_upper:
            note = (
                f"an initial controller ({kind}) has a smaller mu with real blocks than that of the D-K iteration, "
                f"{result.mu_upper:.4g}, and is the result"
            )
            other = _result(made, loop, sample_rate_Hz, (note,))
            result = min(result, other, key=lambda one: one.mu_upper)
    return result


def _result(made: DKIteration, best: Loop, sample_rate_Hz: float | None, given_notes: tuple[str, ...]) -> MuSynthesis:
    """The controller in the time domain of P, with mu recomputed on its loop with P as given."""
    P, problem, uncertainty, state = made.P, made.problem, made.uncertainty, made.state
    K = sampled_image(best.K, P.dt) if P.dt else best.K
    closed = lft_lower(P, K)
    # The norm of the scaled loop bounds complex mu at all frequencies, and therefore mu with real blocks, too.
    scalings, gamma = _certificate(problem, best, continuous_image(closed))
    peak = mu_peak(closed, uncertainty, known_upper=gamma)
    has_real = any(block.kind == "real" for block in uncertainty.blocks)
    mu_upper = min(peak.upper, gamma)
    complex_upper = gamma if has_real else mu_upper
    if has_real and gamma > (1 + SETTINGS.tight) * best.mu:
        # Rational scalings of acceptable order do not reach complex mu: it is bounded with scalings for each interval.
        complex_upper = min(gamma, mu_peak(closed, uncertainty.complexified()).upper)
    fastest = float(np.max(np.abs(best.K.poles()), initial=0.0))
    notes = [*given_notes]
    if has_real:
        notes.append(
            f"the synthesis treats real blocks as complex: peak mu {complex_upper:.4g} with complex "
            f"blocks, {mu_upper:.4g} with real ones"
        )
    if sample_rate_Hz is not None and not P.dt:
        ratio = fastest / (np.pi * sample_rate_Hz)
        notes.append(f"fastest controller pole {fastest:.4g} rad/s is {ratio:.3g} times half the sample rate")
    guaranteed = peak.guaranteed or mu_upper == gamma
    return MuSynthesis(
        K,
        mu_upper,
        peak.lower,
        peak.omega,
        complex_upper,
        guaranteed,
        peak.delta,
        uncertainty,
        scalings,
        gamma,
        closed,
        fastest,
        state.history,
        made.status,
        tuple(notes),
        state.as_dict(problem.P, problem.structure, problem.nmeas, problem.ncon, P.dt),
    )
