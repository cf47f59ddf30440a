"""mu synthesis at a fixed order: modes are removed and added, with descent on the upper bound of mu in between.

The method starts from the full controller and reduces the order stepwise: descent (`mu_descent`), then removal of the
mode whose removal raises the peak least. A controller with few states does not roll off by itself: the descent replaces
the fast modes of the full controller by a direct term. Hence the gain limit in `Task`.

The descent ends in a local minimum. A controller with fewer states than requested is therefore extended by the mode
that lowers the smoothed peak most to first order. At the end modes are exchanged as long as the peak decreases: one or
two modes are added, descent follows, and the modes with the smallest effect are removed.
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
    """unneeded : relative Hankel singular value up to which states of an entry of a decentralised controller are
        removed.
    free : growth of mu up to which balanced truncation may reduce the order at once.
    costly : growth of mu by the removal of a mode above which descent precedes the removal.
    passing : number of stages of descent (the first ones) for a controller of intermediate order.
    exchanged : number of states added temporarily to find a controller of the same order with a smaller peak.
    worth : minimum relative decrease of the peak for the exchange of modes to continue.
    per_decade, damping : natural frequencies per decade, and damping ratios in addition to a real pole, of the modes
        that are tried as additions.
    small : gain of an added mode before descent, relative to that of the controller at the mode's natural frequency;
        small, because its effect is known to first order only.
    same_pole : relative distance up to which two computed poles count as equal.
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
    """Generate controllers of decreasing order with small peaks; the last one has at most `order` states.

    K stabilises the plant. Its order is reduced by truncation while this is free, then mode by mode, with descent
    before costly removals. `others` are further initial controllers, used if they have at most `order` states.
    ComputationError if no reduced controller stabilises the plant, or if the diagonal part of K does not.
    """
    if task.decentralised:
        K = _diagonal_part(K)
        if not lft_lower(task.P, K).is_stable():
            raise ComputationError(
                "the diagonal part of the full controller does not stabilise the plant",
                cause="the axes are too strongly coupled for loops of their own",
                next_step="choose other coordinates for u and y",
            )
    if K.nstates > order:
        omega = frequency_grid(lft_lower(task.P, K))
        K = reduce_controller(task.P, K, lambda one: task.peak(one, omega), SETTINGS.free, range(order, K.nstates))
    for step in _shortened(task, K, order):
        if step.K.nstates > order:
            yield step
        K = step.K
    # Continue from the start with the lowest peak after the first stage.
    starts = [K, *(one for one in others if one.nstates <= order and lft_lower(task.P, one).is_stable())]
    best = min((task.descended(one, task.settings.sharpness[:1]) for one in starts), key=lambda one: one.peak)
    # An added mode may not help, or even make the loop unstable; then the controller without it is kept.
    best = min(
        task.descended(_lengthened(task, best.K, order), task.settings.sharpness[1:]), best, key=lambda one: one.peak
    )
    yield best
    while (step := _exchanged(task, best.K, order)).peak < (1 - SETTINGS.worth) * best.peak:
        yield (best := step)


def _shortened(task: Task, K: StateSpace, order: int) -> Iterator[Step]:
    """Remove modes of K one by one down to an order; yields each descent step, and the last controller as it is."""
    peak = np.inf
    while K.nstates > order:
        shorter, peak = _shorter(task, K, order)
        if not peak <= (1 + SETTINGS.costly) * task.peak(K, frequency_grid(lft_lower(task.P, K))):
            yield (step := task.descended(K, task.settings.sharpness[: SETTINGS.passing]))
            shorter, peak = _shorter(task, step.K, order)
        if not np.isfinite(peak):
            raise ComputationError(
                f"no controller of order {order} to start from",
                measured=f"at order {K.nstates} every mode is needed for stability",
                cause="the plant needs more states to be stabilised",
                next_step="ask for a higher order",
            )
        K = shorter
    yield Step(K, peak)


def _lengthened(task: Task, K: StateSpace, order: int) -> StateSpace:
    """Add modes to K up to an order, each where it lowers the smoothed peak most, with descent after each."""
    while K.nstates < order:
        K = with_mode(task, K, order - K.nstates)
        K = task.descended(K, task.settings.sharpness[: SETTINGS.passing]).K
    return K


def _exchanged(task: Task, K: StateSpace, order: int) -> Step:
    """Add modes to K, then remove those with the smallest effect, to leave a local minimum."""
    try:
        *_, step = _shortened(task, _lengthened(task, K, order + SETTINGS.exchanged), order)
    except ComputationError:
        return Step(K, np.inf)
    return task.descended(step.K, task.settings.sharpness)


def _diagonal_part(K: StateSpace) -> StateSpace:
    """The diagonal entries of K, each without the states that it does not need; off-diagonal entries are zero."""
    parts = []
    for k in range(K.noutputs):
        stable, unstable = split_stable(K.select([k], [k]))
        parts.append(balanced_truncation(stable, tolerance=SETTINGS.unneeded) + unstable)
    return append(*parts)


def _shorter(task: Task, K: StateSpace, order: int) -> tuple[StateSpace, float]:
    """K without the mode of smallest effect, and its peak; below `order` by one if only a pair can be removed."""
    omega = frequency_grid(lft_lower(task.P, K))
    fewer = [*_without_one_mode(K), *_truncated(K)]
    fewer = [one for one in fewer if one.nstates >= order] or fewer
    peaks = [task.peak(one, omega) for one in fewer]
    least = int(np.argmin(peaks))
    return fewer[least], peaks[least]


def _truncated(K: StateSpace) -> list[StateSpace]:
    """K with one and with two states fewer, by balanced truncation of its stable part."""
    stable, unstable = split_stable(K)
    return [balanced_truncation(stable, stable.nstates - less) + unstable for less in (1, 2) if stable.nstates >= less]


def _without_one_mode(K: StateSpace) -> list[StateSpace]:
    """K without each of its modes (a pole or a pair), once dropped and once replaced by its static gain."""
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
    """K with one more mode (one state, or two if `most` allows it): the mode that lowers the smoothed peak most.

    A mode f(s) u v^T, with f one of wn/(s + wn), and wn^2/d(s) or s wn/d(s) with d(s) = s^2 + 2 zeta wn s + wn^2, adds
    u^T D v to the slope, D = Re sum_k f(j omega_k) G_k^T. With f of unit r.m.s. value over the frequencies, the largest
    singular value of D measures the possible decrease by the mode, and its singular vectors are u and v.
    """
    _, grid = task.measured(K)
    _, omega, G = smoothed_peak(task, K, grid, task.P.frequency_response(grid), task.settings.sharpness[0])
    lowest, highest = np.min(omega[omega > 0]), np.max(omega)
    natural = np.geomspace(lowest, highest, int(np.ceil(SETTINGS.per_decade * np.log10(highest / lowest))) + 1)
    dampings = (None, *SETTINGS.damping) if most > 1 else (None,)
    _, wn, added = max(
        (_best_mode(K, wn, zeta, omega, G, task.decentralised) for wn in natural for zeta in dampings),
        key=lambda one: one[0],
    )
    gain, own = (np.linalg.norm(one.frequency_response(np.array([wn])), 2, (1, 2)) for one in (K, added))
    return K + replace(added, C=added.C * SETTINGS.small * gain / own)


def _best_mode(
    K: StateSpace, wn: float, zeta: float | None, omega: Array, G: Array, decentralised: bool
) -> tuple[float, float, StateSpace]:
    """Decrease of the smoothed peak by a mode of unit r.m.s. value, its natural frequency, and the mode itself."""
    # The first state is the output; a mode with two states has one input per numerator.
    A = np.array([[-wn]] if zeta is None else [[-2 * zeta * wn, wn], [-wn, 0.0]])
    B = wn * np.eye(len(A))[::-1]
    f = StateSpace(A, B, np.eye(1, len(A)), np.zeros((1, len(A)))).frequency_response(omega)[:, 0]
    size = np.sqrt(np.mean(np.abs(f) ** 2, axis=0))
    D = np.einsum("kf,kyu->fuy", f / size, G).real
    if decentralised:
        D *= np.eye(K.noutputs)
    U, s, Vh = np.linalg.svd(np.concatenate(list(D), axis=1))
    v = Vh[0].reshape(len(A), K.ninputs)
    return (
        s[0],
        wn,
        StateSpace(A, B / size @ v, -U[:, :1] @ np.eye(1, len(A)), np.zeros_like(K.D), 0.0, K.inputs, K.outputs),
    )
