"""mu synthesis at a fixed order: descent on the upper bound of mu over the entries of the controller.

At each frequency the least level of mu's upper bound, lambda = beta^2, moves with K as

    d lambda = 2 Re tr(G dK),   G = R Z M^H X_z L,   dM = L dK R,   Z = inv(F) / tr(X_w inv(F)),

for the optimal scalings do not move it to first order (F, X_z, X_w as in `mu_lmi`); Z is the dual solution, so that the
slope is right where several singular values meet, too. The largest of them over the frequencies is smoothed by a
log-sum-exp that is sharpened from stage to stage, and lowered by BFGS with a weak Wolfe line search, which needs no
smoothness (Lewis and Overton, Mathematical Programming 141, 2013; Burke, Henrion, Lewis and Overton, HIFOO, 2006). A
step that makes the loop unstable is refused. What the result is worth between the frequencies is for `mu_peak` to say.

It starts from the full controller and goes down order by order: first descent, then without the mode missed least.
Few states do not roll off by themselves: the descent makes a direct term of what the full controller does with fast
modes. A limit of the controller's gain at high frequency is therefore part of what is lowered: its largest singular
value over the limit is one more figure beside mu, with the slope u v^H for its singular vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, append, balanced_truncation, lft_lower
from avis_ctrl.robust.frequency_grid import frequency_grid, merged, resonances
from avis_ctrl.robust.mu_lmi import Array, dagger, residual
from avis_ctrl.robust.mu_scan import refine_maxima
from avis_ctrl.robust.mu_upper import UpperBound, block_balance, expand, upper_bound
from avis_ctrl.robust.reduction import reduce_controller, split, split_stable
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class FixedOrderSettings:
    """sharpness : exponents of the smoothed maximum over frequency, one stage each: its error is log(frequencies) over
        it, so the last one leaves less than a per cent.
    unneeded : Hankel singular values, relative to the largest, of the states that an entry of a decentralised
        controller does not need.
    free : growth of mu for which balanced truncation may shorten the controller at once.
    costly : growth of mu by the removal of a mode from which the controller is improved before it is shortened.
    iterations : most BFGS steps of a stage.
    stall : relative fall of the smoothed maximum over ten steps below which a stage ends.
    accuracy : relative accuracy of beta^2 at each frequency, and the distance above it at which the slope is taken: a
        nearer one makes the slope less smooth, a farther one less true.
    armijo, wolfe : fractions of the slope that a step must gain, and may leave (Lewis and Overton 2013).
    trials : most points of a line search.
    narrow : damping ratio of a mode of the loop below which its resonance joins the frequencies of every step.
    negligible : weight in the smoothed maximum, relative to the largest, below which a frequency is left out: less than
        rounding errors change.
    first : frequencies of the largest balanced norms, whose mu tells which others count.
    passing : number of the first stages that a controller gets which is only a step to one of lower order.
    same_pole : relative distance up to which two computations of a pole are one.
    """

    sharpness: tuple[float, ...] = (20.0, 80.0, 300.0, 1000.0)
    unneeded: float = 1e-6
    free: float = 0.01
    costly: float = 0.02
    iterations: int = 300
    stall: float = 1e-4
    accuracy: float = 1e-4
    armijo: float = 1e-4
    wolfe: float = 0.5
    trials: int = 25
    narrow: float = 0.2
    negligible: float = 1e-13
    first: int = 3
    passing: int = 2
    same_pole: float = 1e-9


SETTINGS = FixedOrderSettings()


@dataclass(frozen=True, eq=False)
class GainLimit:
    """Largest gain of a controller [of K], (n,), at frequencies omega (n,) [rad/s]; it counts as mu does."""

    omega: Array
    most: Array


@dataclass(frozen=True, eq=False)
class Step:
    """A controller on the way down, and the peak of complex mu and of its gain over the limit on its grid."""

    K: StateSpace
    peak: float


@dataclass(frozen=True, eq=False)
class Task:
    """What is lowered. P continuous, u and y last; `structure` complex, performance last; a decentralised controller
    moves u_k by y_k alone."""

    P: StateSpace
    structure: BlockStructure
    decentralised: bool = False
    limit: GainLimit | None = None
    settings: FixedOrderSettings = SETTINGS

    def peak(self, K: StateSpace, omega: Array) -> float:
        """On a grid; inf where the loop is unstable."""
        closed = lft_lower(self.P, K)
        if not closed.is_stable():
            return np.inf
        M = closed.frequency_response(omega)[:, None]
        beta = upper_bound(M, self.structure, 10 * self.settings.accuracy).beta
        return max(float(np.max(beta)), self.gain(K))

    def gain(self, K: StateSpace) -> float:
        """Largest gain of K over its limit."""
        if self.limit is None:
            return 0.0
        size = np.linalg.norm(K.frequency_response(self.limit.omega), 2, axis=(1, 2))
        return float(np.max(size / self.limit.most))

    def descended(self, K: StateSpace, stages: Sequence[float]) -> Step:
        """The best controller after each of some stages of descent from K, K among them."""
        closed = lft_lower(self.P, K)
        omega, beta = self.with_peaks(closed, frequency_grid(closed))
        best = Step(K, max(float(np.max(beta)), self.gain(K)))
        for sharpness in stages:
            form = Entries.of(K, self.decentralised)
            K = form.controller(_bfgs(Objective(self, form, omega, sharpness).value, form.start, self.settings))
            closed = lft_lower(self.P, K)
            omega, beta = self.with_peaks(closed, merged(omega, frequency_grid(closed)))
            if (peak := max(float(np.max(beta)), self.gain(K))) < best.peak:
                best = Step(K, peak)
        return best

    def with_peaks(self, closed: StateSpace, omega: Array) -> tuple[Array, Array]:
        """The grid with the local maxima of mu found between its points, and mu on it."""
        def value(at: Array) -> Array:
            return upper_bound(closed.frequency_response(at)[:, None], self.structure, self.settings.accuracy).beta
        return refine_maxima(value, omega, value(omega), tolerance=1e-3, worth=0.95)


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
    settings = task.settings
    passing = settings.sharpness[:settings.passing]
    if K.nstates > order:
        omega = frequency_grid(lft_lower(task.P, K))
        K = reduce_controller(task.P, K, lambda one: task.peak(one, omega), settings.free, range(order, K.nstates)).K
    while K.nstates > order:
        shorter, peak = _shorter(task, K, order)
        if not peak <= (1 + settings.costly) * task.peak(K, frequency_grid(lft_lower(task.P, K))):
            yield (step := task.descended(K, passing))
            shorter, peak = _shorter(task, step.K, order)
        if not np.isfinite(peak):
            raise ComputationError(f"no controller of order {order} to start from",
                                   measured=f"at order {K.nstates} every mode is needed for stability",
                                   cause="the plant needs more states to be stabilised",
                                   next_step="ask for a higher order")
        K = shorter
    # The start that the first stage brings lowest goes on.
    starts = [K, *(one for one in others if one.nstates <= order and lft_lower(task.P, one).is_stable())]
    best = min((task.descended(one, settings.sharpness[:1]) for one in starts), key=lambda one: one.peak)
    yield task.descended(best.K, settings.sharpness[1:])


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


@dataclass(frozen=True, eq=False)
class Entries:
    """K with tridiagonal A (blocks of its modes), its free entries in units of their own size.

    rows, cols : places of the free entries of [A B; C D]; size : their units; start : their values in these units.
    """

    K: StateSpace
    rows: Array
    cols: Array
    size: Array
    start: Array

    @staticmethod
    def of(K: StateSpace, decentralised: bool = False) -> Entries:
        A, B, C, rate, channel = _modal(K)
        n = rate.size
        whole = np.block([[A, B], [C, K.D]])
        free = np.ones(whole.shape, bool)
        free[:n, :n] = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1
        if decentralised:
            label = np.r_[channel, np.arange(K.ninputs)], np.r_[channel, np.arange(K.noutputs)]
            free &= np.equal.outer(label[1], label[0])
        unit = np.empty(whole.shape)
        unit[:n, :n] = np.sqrt(np.outer(rate, rate))
        unit[:n, n:] = np.linalg.norm(B, axis=1, keepdims=True)
        unit[n:, :n] = np.linalg.norm(C, axis=0)
        unit[n:, n:] = np.linalg.norm(K.D) + np.max(np.abs(C).sum(axis=0) * np.abs(B).sum(axis=1) / rate, initial=0.0)
        unit[unit == 0] = 1.0
        rows, cols = np.nonzero(free)
        return Entries(K, rows, cols, unit[rows, cols], whole[rows, cols] / unit[rows, cols])

    def matrix(self, x: Array) -> Array:
        n = self.K.nstates
        whole = np.zeros((n + self.K.noutputs, n + self.K.ninputs))
        whole[self.rows, self.cols] = x * self.size
        return whole

    def controller(self, x: Array) -> StateSpace:
        n, whole = self.K.nstates, self.matrix(x)
        return StateSpace(whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:], 0.0, self.K.inputs,
                          self.K.outputs)

    def slope(self, whole: Array) -> Array:
        return whole[self.rows, self.cols] * self.size


def _modal(K: StateSpace) -> tuple[Array, Array, Array, Array, Array]:
    """A of 2 x 2 blocks, real poles in pairs of neighbours, with rows of B as long as columns of C; and |poles|.

    Last the output (n,) that each state moves most; the states are in the order of these.
    """
    n, vectors, sizes, channels = K.nstates, [], [], []
    values, V = la.eig(K.A)
    output = np.argmax(np.abs(K.C @ V), axis=0)
    for k in np.lexsort((np.abs(values), output)):
        if values[k].imag > 0:
            vectors += [V[:, k].real, V[:, k].imag]
            sizes += [abs(values[k])] * 2
            channels += [output[k]] * 2
        elif values[k].imag == 0:
            vectors.append(V[:, k].real)
            sizes.append(abs(values[k]))
            channels.append(output[k])
    S = np.array(vectors).T.reshape(n, n)
    A, B, C = np.linalg.solve(S, K.A @ S), np.linalg.solve(S, K.B), K.C @ S
    rows, cols = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    # One scale for both states of a pair keeps its block normal.
    scale = np.sqrt(np.where((rows > 0) & (cols > 0), rows, 1.0) / np.where((rows > 0) & (cols > 0), cols, 1.0))
    for k in range(n - 1):
        if A[k, k + 1] * A[k + 1, k] < 0 and sizes[k] == sizes[k + 1]:
            scale[k:k + 2] = np.sqrt(scale[k] * scale[k + 1])
    rate = np.maximum(np.array(sizes), 1e-6 * max(sizes, default=1.0))
    return A / scale[:, None] * scale, B / scale[:, None], C * scale, rate, np.array(channels, int)


@dataclass(frozen=True, eq=False)
class Objective:
    """The smoothed maximum of log mu over a frequency grid, and of the gain over its limit, as a function of the
    entries of K, with its slope."""

    task: Task
    form: Entries
    omega: Array
    sharpness: float

    def value(self, x: Array) -> tuple[float, Array]:
        """log of the smoothed peak and its slope; inf where the loop is unstable."""
        K, P, settings = self.form.controller(x), self.task.P, self.task.settings
        try:
            closed = lft_lower(P, K)
        except ComputationError:
            return np.inf, np.zeros(x.size)
        if not closed.is_stable():
            return np.inf, np.zeros(x.size)
        # Narrow modes move from step to step; on the grid alone descent would hide their peaks between its points.
        narrow = resonances(closed.poles(), damping=settings.narrow)
        omega = np.concatenate([self.omega, narrow])
        n_u, n_y = K.noutputs, K.ninputs
        p = np.concatenate([self.response, P.frequency_response(narrow)])
        z, w = p.shape[1] - n_y, p.shape[2] - n_u
        phi = _resolvent(K, omega)
        k = K.C @ phi @ K.B + K.D
        # With E = inv(I - P22 K): dM = P12 (I + K E P22) dK E P21.
        E = np.linalg.inv(np.eye(n_y) - p[:, z:, w:] @ k)
        R = E @ p[:, z:, :w]
        M = p[:, :z, :w] + p[:, :z, w:] @ k @ R
        L = p[:, :z, w:] @ (np.eye(n_u) + k @ E @ p[:, z:, w:])
        near, bound = self._highest(M)
        M, L, R, phi = M[near], L[near], R[near], phi[near]
        lam = bound.beta ** 2 * (1 + settings.accuracy)
        dual = np.linalg.inv(residual(M[:, None], bound.scalings, lam, np.ones(w, bool))[:, 0])
        dual /= np.trace(bound.scalings.X_w @ dual, axis1=1, axis2=2).real[:, None, None]
        # d log beta = d lambda / (2 lambda) = Re tr(G dK).
        G = R @ dual @ dagger(M) @ bound.scalings.X_z @ L / lam[:, None, None]
        logs = np.log(bound.beta)
        if self.task.limit is not None:
            high, slopes = _gain(K, self.task.limit.omega)
            logs = np.concatenate([logs, high - np.log(self.task.limit.most)])
            G, phi = np.concatenate([G, slopes]), np.concatenate([phi, _resolvent(K, self.task.limit.omega)])
        top = float(np.max(logs))
        weight = np.exp(self.sharpness * (logs - top))
        total = top + float(np.log(np.sum(weight))) / self.sharpness
        G *= (weight / np.sum(weight))[:, None, None]
        into, out = phi @ K.B, K.C @ phi
        n = K.nstates
        slope = np.zeros((n + n_u, n + n_y))
        # tr(G dK) with dK = [out, I] d[A B; C D] [into; I].
        slope[:n, :n] = np.sum(into @ G @ out, axis=0).real.T
        slope[:n, n:] = np.sum(G @ out, axis=0).real.T
        slope[n:, :n] = np.sum(into @ G, axis=0).real.T
        slope[n:, n:] = np.sum(G, axis=0).real.T
        return total, self.form.slope(slope)

    def _highest(self, M: Array) -> tuple[Array, UpperBound]:
        """Indices of the frequencies that count in the smoothed maximum, and the bounds of mu there.

        M (n_omega, n_z, n_w). The norm after Osborne's scaling is cheap and no less than the bound: where it is small,
        the frequency does not count. The highest norms come first: their mu tells which of the others count.
        """
        structure, settings = self.task.structure, self.task.settings
        d_z, d_w = expand(structure, block_balance(M[:, None], structure))
        size = np.linalg.norm(M * d_z[:, :, None] / d_w[:, None, :], ord=2, axis=(1, 2))
        falling = np.argsort(-size)
        first = upper_bound(M[falling[:settings.first]][:, None], structure, settings.accuracy)
        least = float(np.max(first.beta)) * settings.negligible ** (1 / self.sharpness)
        further = falling[settings.first:]
        further = further[size[further] >= least]
        if not further.size:
            return falling[:settings.first], first
        rest = upper_bound(M[further][:, None], structure, settings.accuracy)
        return np.concatenate([falling[:settings.first], further]), UpperBound.joined([first, rest])

    @cached_property
    def response(self) -> Array:
        """P at the frequencies (n_omega, n_out, n_in)."""
        return self.task.P.frequency_response(self.omega)


def _resolvent(K: StateSpace, omega: Array) -> Array:
    """inv(j omega I - A), (n_omega, n, n)."""
    return np.linalg.inv(1j * omega[:, None, None] * np.eye(K.nstates) - K.A)


def _gain(K: StateSpace, omega: Array) -> tuple[Array, Array]:
    """log of the largest singular value of K at frequencies, and G with its change Re tr(G dK), (n, n_y, n_u)."""
    U, s, Vh = np.linalg.svd(K.frequency_response(omega))
    s = np.maximum(s, np.finfo(float).tiny)
    return np.log(s[:, 0]), dagger(U[:, :, :1] @ Vh[:, :1]) / s[:, :1, None]


def _bfgs(value: Callable[[Array], tuple[float, Array]], x: Array, settings: FixedOrderSettings) -> Array:
    """BFGS with a weak Wolfe line search by bisection; ends where ten steps gain less than `stall`."""
    f, g = value(x)
    H = np.eye(x.size) / max(float(np.linalg.norm(g)), 1e-12) * 0.1
    history = [f]
    for count in range(settings.iterations):
        direction = -H @ g
        fall = float(direction @ g)
        if not fall < 0:
            H = np.eye(x.size) / max(float(np.linalg.norm(g)), 1e-12) * 0.1
            direction, fall = -H @ g, -float(g @ H @ g)
        step, low, high = 1.0, 0.0, np.inf
        found = None
        for _ in range(settings.trials):
            trial = x + step * direction
            f_new, g_new = value(trial)
            if not f_new <= f + settings.armijo * step * fall:
                high = step
            else:
                found = trial, f_new, g_new
                if float(g_new @ direction) >= settings.wolfe * fall:
                    break
                low = step
            step = (low + high) / 2 if np.isfinite(high) else 2 * step
        if found is None:
            break
        s, y = found[0] - x, found[2] - g
        x, f, g = found
        curvature = float(s @ y)
        if curvature > 0:
            if not count:
                H = np.eye(x.size) * curvature / float(y @ y)
            V = np.eye(x.size) - np.outer(s, y) / curvature
            H = V @ H @ V.T + np.outer(s, s) / curvature
        history.append(f)
        if len(history) > 10 and history[-11] - f < settings.stall:
            break
    return x
