"""The controllers that a study compares, all designed on the same plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.frequency_grid import merged, resonances
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.mu_descent import GainLimit, Task
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.musyn import DKIteration, dk_iteration
from avis_ctrl.robust.musyn_iteration import Options
from avis_ctrl.robust.reduction import reduce_controller, replace_fast_by_lags, residualise_fast, truncate_slow
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.design_result import Candidate, ControllerResult
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.study.roll_off import gain_limit
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class ReductionSettings:
    """Settings of the order reduction.

    frequencies_Hz : grid on which controllers of different order are compared. It is coarse, because the reported
        figures are computed separately for the selected controller. The resonances of the passive table and the peak of
        mu are added; both are narrower than the grid. Below the band mu bounds the drive voltage for the offset of the
        electronics.
    accuracy : relative accuracy of the square of mu on the grid, small compared with the default reduction cost.
    lag_orders, lag_corners : orders and corners tried for `replace_fast_by_lags` if the reduced controller is too fast
        for its processor; corners as fractions of half the sample rate. The first lags that raise mu by no more than
        the reduction cost are used: the lower their corner, the less Tustin's rule changes the controller. Three lags
        can compensate a third-order anti-alias filter; amplifier and delay may need more.
    """

    frequencies_Hz: tuple[float, ...] = (*np.geomspace(1e-3, 0.03, 5).tolist(), *np.geomspace(0.05, 300.0, 25).tolist())
    accuracy: float = 1e-3
    lag_orders: tuple[int, ...] = (3, 6)
    lag_corners: tuple[float, ...] = (0.2, 0.3, 0.45, 0.7, 1.0)


SETTINGS = ReductionSettings()


def passive() -> Candidate:
    """No control."""
    return Candidate("passive", "passive", "passive", None)


def nominal_hinf(design: Design, plant: DesignPlant, rig: Rig) -> Candidate:
    """H-infinity controller for the weighted performance of the nominal plant, without D-K iteration or uncertainty."""
    nominal = plant.synthesis.nominal()
    # Near the optimum some controller poles tend to infinity and act as a gain. They are replaced by this gain, because
    # a processor cannot realise them.
    made = hinfsyn(
        nominal.P,
        nominal.nmeas,
        nominal.ncon,
        backoff=design.synthesis.backoff_percent / 100,
        sample_rate_Hz=rig.sample_rate_Hz,
        far_poles="gain",
    )
    return Candidate("hinf", "H-infinity, nominal", "hinf", made.K, made.notes)


def mu_optimal(
    design: Design,
    plant: DesignPlant,
    rig: Rig,
    callback: Callable[[Any], Any] | None = None,
    rivals: Sequence[Candidate] = (),
) -> tuple[Candidate, DKIteration]:
    """D-K iteration over the whole uncertainty set, then reduction to the lowest order with nearly the same mu.

    rivals : controllers that the study already has. The iteration starts from the best of them, and its complex mu is
        never larger than theirs; that of the reduced controller is within reduction_cost_percent of it.
    """
    P, asked = plant.synthesis, design.synthesis
    made = dk_iteration(
        P.P,
        P.blocks,
        P.nmeas,
        P.ncon,
        Options(
            asked.target_mu,
            asked.max_iterations,
            asked.backoff_percent / 100,
            asked.polish is not False,
            callback=callback,
        ),
        starts=[one.K for one in rivals if one.K is not None],
    )
    K, note = _reduced(design, plant, rig, made)
    old = ("synthesis.time_limit_s is ignored: max_iterations and target_mu end the iteration",)
    notes = (made.status, *(old if asked.time_limit_s is not None else ()), note)
    return Candidate("mu", "mu synthesis", "mu", K, notes), made


def _reduced(design: Design, plant: DesignPlant, rig: Rig, made: DKIteration) -> tuple[StateSpace, str]:
    """The controller of lowest order whose complex mu grows by no more than the cost, and a note on the reduction."""
    P, cost = plant.synthesis, design.synthesis.reduction_cost_percent / 100
    blocks = P.all_blocks.simplified() if P.all_blocks.many else P.all_blocks.complexified()
    omega = reduction_grid(plant, made.omega_peak)

    peak, K = partial(peak_of_loop, blocks=blocks, omega=omega), made.best.K
    full = peak(P.closed(K))
    limit = (1 + cost) * full

    def harmless(candidate: StateSpace) -> bool:
        closed = P.closed(candidate)
        return closed.is_stable() and peak(closed, goal=limit) <= limit

    def lowest_order(start: StateSpace) -> StateSpace:
        # No weight changes below the corner up to which the offset may drift.
        lasting = truncate_slow(start, 2 * np.pi * design.control_effort.offset_corner_Hz / 3)
        start = lasting if harmless(lasting) else start
        return reduce_controller(P.P, start, lambda one: peak(P.closed(one), goal=limit), limit=limit)

    # Tustin's rule distorts poles near and above the Nyquist frequency. Poles above it are residualised (only their DC
    # gain is kept) if mu allows it. If the reduced controller still has such poles, poles that the design excludes, or
    # more gain beyond the Nyquist frequency than the proof of its code allows, lags replace them.
    nyquist = np.pi * rig.sample_rate_Hz
    roll_off = Task(P.P, P.all_blocks.complexified(), limit=_roll_off(plant, rig))
    allowed = min([nyquist, *(2 * np.pi * f for f in design.upper_limits("fastest_controller_pole_Hz"))])
    residual = residualise_fast(K, nyquist, also_unstable=True)
    first = lowest_order(residual if harmless(residual) else K)

    def fastest(one: StateSpace) -> float:
        return float(np.max(np.abs(one.poles()), initial=0.0))

    def certifiable(one: StateSpace) -> bool:
        return fastest(one) <= allowed and roll_off.gain(one) <= 1

    def sampled(one: StateSpace) -> bool:
        return fastest(one) <= nyquist

    def found(accepted: Callable[[StateSpace], bool]) -> StateSpace | None:
        """The first controller that is accepted, with lags also before their reduction."""
        lags = (replace_fast_by_lags(K, f * nyquist, n) for n in SETTINGS.lag_orders for f in SETTINGS.lag_corners)
        made = (lowest_order(one) for one in lags if accepted(one) and harmless(one))
        return next(filter(accepted, chain([first], made)), None)

    reduced = found(certifiable) or found(sampled) or first
    return reduced, (
        f"reduced from {K.nstates} to {reduced.nstates} states: complex mu, at {omega.size} frequencies "
        f"and the resonances of each loop, changes from {full:.4f} to {peak(P.closed(reduced)):.4f}"
    )


def _roll_off(plant: DesignPlant, rig: Rig) -> GainLimit | None:
    """Limit of the gain beyond half the sample rate; None for a table whose gain there is not bounded."""
    try:
        return gain_limit(plant, rig.sample_rate_Hz)
    except ComputationError:
        return None


def peak_of_loop(closed: StateSpace, blocks: BlockStructure, omega: np.ndarray, goal: float = 0.0) -> float:
    """Largest upper bound of mu at given frequencies [rad/s] and at the resonances of this loop, where it may be
    higher: a reduction can remove the damping of a mode. A result below `goal` is only an upper bound of this."""
    M = closed.frequency_response(np.concatenate([omega, resonances(closed.poles())]))
    return float(np.max(upper_bound(M[:, None], blocks, SETTINGS.accuracy, goal).beta))


def best_of(mu: ControllerResult, others: Sequence[ControllerResult]) -> ControllerResult:
    """The controller with the smallest mu of all those analysed, delivered under the name of the mu controller.

    This is `mu` itself, unless another controller has a smaller upper bound over the whole set; a note then names it.
    The passive table (K None) and unstable loops are excluded.
    """
    stable = [one for one in others if one.K is not None and one.stable and np.isfinite(one.mu.upper)]
    best = min((mu, *stable), key=lambda one: one.mu.upper if np.isfinite(one.mu.upper) else np.inf)
    if best is mu:
        return mu
    note = (
        f"this is the controller {best.title!r}: its mu of {best.mu.upper:.4g} is below the {mu.mu.upper:.4g} "
        "reached by D-K iteration and order reduction"
    )
    return replace(best, name=mu.name, title=mu.title, kind=mu.kind, notes=(note, *mu.notes, *best.notes))


def reduction_grid(plant: DesignPlant, omega_peak: float) -> np.ndarray:
    """Frequencies [rad/s] at which controllers of lower order are compared, including possible peaks of mu."""
    even = 2 * np.pi * np.array(SETTINGS.frequencies_Hz)
    at_rest = resonances(plant.rig.system.poles())
    return merged(even, np.append(at_rest, omega_peak))
