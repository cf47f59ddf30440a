"""mu synthesis at a fixed order: modes are removed and added, with descent on the upper bound of mu between.

It starts from the full controller and goes down order by order: descent (`mu_descent`), then removal of the mode that
is missed least. Few states do not roll off by themselves: the descent makes a direct term of what the full controller
does with fast modes, hence the limit of the gain in `Task`.

The descent ends in a local minimum. A controller with fewer states than asked is therefore lengthened by the mode that
lowers the smoothed peak most to first order, and at the end modes are exchanged, as long as the peak falls: one or two
are added, descent follows, and those that are missed least are removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, append, balanced_truncation, lft_lower
from avis_ctrl.robust.frequency_grid import frequency_grid
from avis_ctrl.robust.mu_descent import Step, Task, smoothed_peak
from avis_ctrl.robust.mu_lmi import Array
from avis_ctrl.robust.reduction import reduce_controller, split, split_stable


@dataclass(frozen=True)
class FixedOrderSettings:
    """unneeded : Hankel singular values, relative to the largest, of the states that an entry of a decentralised
        controller does not need.
    free : growth of mu for which balanced truncation may shorten the controller at once.
    costly : growth of mu by the removal of a mode from which the controller is improved before it is shortened.
    passing : number of stages of descent, the first ones, for a controller on the way to another order.
    exchanged : states by which a controller is lengthened to look for one of its own order with a smaller peak.
    worth : relative fall of the peak from which the exchange of modes goes on.
    per_decade, damping : natural frequencies per decade, and damping ratios beside a real pole, of the modes that are
        tried as additions.
    small : gain of an added mode before descent, relative to that of the controller at the mode's natural frequency;
        small, because its effect is known to first order only.
    same_pole : relative distance up to which two computations of a pole are one.
    """

    unneeded: float = 1e-6
    free: float = 0.01
    costly: float = 0.02
    passing: int = 2
    exchanged: int = 2
    worth: float = 0.005
    per_decade: int = 10
    damping: tuple[float, ...] = (0.1, 0.3, 0.7)
    small: float = 0.01
    same_pole: float = 1e-9


SETTINGS = FixedOrderSettings()


def fixed_order(task: Task, K: StateSpace, order: int, others: Sequence[StateSpace] = ()) -> Iterator[Step]:
    """Controllers of falling order with small peaks, as they are found; the last one has at most `order` states.

    K stabilises the plant; it is shortened while that is free, then mode by mode with descent where a mode is missed.
    `others` are further controllers to start from, used where they have at most `order` states. ComputationError where
    no shortened controller, or not the diagonal part of K, stabilises the plant.
    """
    if task.decentralised:
        K = _diagonal_part(K)
        if not lft_lower(task.P, K).is_stable():
            raise ComputationError("the diagonal part of the full controller does not stabilise the plant",
                                   cause="the axes are too strongly coupled for loops of their own",
                                   next_step="choose other coordinates for u and y")
    if K.nstates > order:
        omega = frequency_grid(lft_lower(task.P, K))
        K = reduce_controller(task.P, K, lambda one: task.peak(one, omega), SETTINGS.free, range(order, K.nstates)).K
    for step in _shortened(task, K, order):
        if step.K.nstates > order:
            yield step
        K = step.K
    # The start that the first stage brings lowest goes on.
    starts = [K, *(one for one in others if one.nstates <= order and lft_lower(task.P, one).is_stable())]
    best = min((task.descended(one, task.settings.sharpness[:1]) for one in starts), key=lambda one: one.peak)
    # An added mode may not help, or even make the loop unstable; then the shorter controller stays.
    best = min(task.descended(_lengthened(task, best.K, order), task.settings.sharpness[1:]), best,
               key=lambda one: one.peak)
    yield best
    while (step := _exchanged(task, best.K, order)).peak < (1 - SETTINGS.worth) * best.peak:
        yield (best := step)


def _shortened(task: Task, K: StateSpace, order: int) -> Iterator[Step]:
    """K mode by mode down to an order: each controller that descent improved on the way, and the last one without."""
    peak = np.inf
    while K.nstates > order:
        shorter, peak = _shorter(task, K, order)
        if not peak <= (1 + SETTINGS.costly) * task.peak(K, frequency_grid(lft_lower(task.P, K))):
            yield (step := task.descended(K, task.settings.sharpness[:SETTINGS.passing]))
            shorter, peak = _shorter(task, step.K, order)
        if not np.isfinite(peak):
            raise ComputationError(f"no controller of order {order} to start from",
                                   measured=f"at order {K.nstates} every mode is needed for stability",
                                   cause="the plant needs more states to be stabilised",
                                   next_step="ask for a higher order")
        K = shorter
    yield Step(K, peak)


def _lengthened(task: Task, K: StateSpace, order: int) -> StateSpace:
    """K with modes added up to an order, each where it lowers the smoothed peak most, and descent after each."""
    while K.nstates < order:
        K = with_mode(task, K, order - K.nstates)
        K = task.descended(K, task.settings.sharpness[:SETTINGS.passing]).K
    return K


def _exchanged(task: Task, K: StateSpace, order: int) -> Step:
    """K with modes added, then without those that are missed least: a way out of a local minimum."""
    try:
        *_, step = _shortened(task, _lengthened(task, K, order + SETTINGS.exchanged), order)
    except ComputationError:
        return Step(K, np.inf)
    return task.descended(step.K, task.settings.sharpness)


def _diagonal_part(K: StateSpace) -> StateSpace:
    """K with its entries off the diagonal zero, each one on it without the states that it does not need."""
    parts = []
    for k in range(K.noutputs):
        stable, unstable = split_stable(K.select([k], [k]))
        parts.append(balanced_truncation(stable, tolerance=SETTINGS.unneeded) + unstable)
    return append(*parts)


def _shorter(task: Task, K: StateSpace, order: int) -> tuple[StateSpace, float]:
    """K without the mode missed least, and its peak then; one state less than asked where only a pair can go."""
    omega = frequency_grid(lft_lower(task.P, K))
    fewer = [*_without_one_mode(K), *_truncated(K)]
    fewer = [one for one in fewer if one.nstates >= order] or fewer
    peaks = [task.peak(one, omega) for one in fewer]
    least = int(np.argmin(peaks))
    return fewer[least], peaks[least]


def _truncated(K: StateSpace) -> list[StateSpace]:
    """K with one and with two states less, by balanced truncation of its stable part."""
    stable, unstable = split_stable(K)
    return [balanced_truncation(stable, stable.nstates - less) + unstable for less in (1, 2) if stable.nstates >= less]


def _without_one_mode(K: StateSpace) -> list[StateSpace]:
    """K without each of its modes (a pole or a pair), dropped, or replaced by what it contributes at rest."""
    fewer = []
    for pole in K.poles():
        if pole.imag < 0:
            continue

        def other(re: float, im: float, pole: complex = pole) -> bool:
            return abs(complex(re, abs(im)) - pole) > SETTINGS.same_pole * abs(pole)
        kept, gone = split(K, other)
        if gone.nstates:
            fewer.append(kept)
            if abs(pole) > 0:
                fewer.append(replace(kept, D=kept.D + gone.dcgain()))
    return fewer


def with_mode(task: Task, K: StateSpace, most: int) -> StateSpace:
    """K with one mode more, of one state, or two where `most` allows it: the one that lowers the smoothed peak most.

    A mode f(s) u v^T, with f one of wn/(s + wn), and wn^2/d(s) or s wn/d(s) with d(s) = s^2 + 2 zeta wn s + wn^2, adds
    u^T D v to the slope, D = Re sum_k f(j omega_k) G_k^T: the largest singular value of D, for f of unit r.m.s. value
    over the frequencies, says how much the mode can do, and its singular vectors are u and v.
    """
    _, grid = task.measured(K)
    _, omega, G = smoothed_peak(task, K, grid, task.P.frequency_response(grid), task.settings.sharpness[0])
    lowest, highest = np.min(omega[omega > 0]), np.max(omega)
    natural = np.geomspace(lowest, highest, int(np.ceil(SETTINGS.per_decade * np.log10(highest / lowest))) + 1)
    dampings = (None, *SETTINGS.damping) if most > 1 else (None,)
    _, wn, added = max((_best_mode(K, wn, zeta, omega, G, task.decentralised) for wn in natural for zeta in dampings),
                       key=lambda one: one[0])
    gain, own = (np.linalg.norm(one.frequency_response(np.array([wn])), 2, (1, 2)) for one in (K, added))
    return K + replace(added, C=added.C * SETTINGS.small * gain / own)


def _best_mode(K: StateSpace, wn: float, zeta: float | None, omega: Array, G: Array, decentralised: bool
               ) -> tuple[float, float, StateSpace]:
    """The fall of the smoothed peak by a mode of unit r.m.s. value, its natural frequency, and the mode itself."""
    # The first state is the output; a mode of two states has an input for each of its two numerators.
    A = np.array([[-wn]] if zeta is None else [[-2 * zeta * wn, wn], [-wn, 0.0]])
    B = wn * np.eye(len(A))[::-1]
    f = StateSpace(A, B, np.eye(1, len(A)), np.zeros((1, len(A)))).frequency_response(omega)[:, 0]
    size = np.sqrt(np.mean(np.abs(f) ** 2, axis=0))
    D = np.einsum("kf,kyu->fuy", f / size, G).real
    if decentralised:
        D *= np.eye(K.noutputs)
    U, s, Vh = np.linalg.svd(np.concatenate(list(D), axis=1))
    v = Vh[0].reshape(len(A), K.ninputs)
    return s[0], wn, StateSpace(A, B / size @ v, -U[:, :1] @ np.eye(1, len(A)), np.zeros_like(K.D), 0.0, K.inputs,
                                K.outputs)
