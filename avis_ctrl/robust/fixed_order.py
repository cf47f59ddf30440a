"""mu synthesis at a fixed order: descent on the upper bound of mu over the entries of the controller.

At each frequency the least level of mu's upper bound, lambda = beta^2, moves with K as

    d lambda = 2 Re tr(G dK),   G = R Z M^H X_z L,   dM = L dK R,   Z = inv(F) / tr(X_w inv(F)),

for the optimal scalings do not move it to first order (F, X_z, X_w as in `mu_lmi`); Z is the dual solution, so that the
slope is right where several singular values meet, too. The largest of them over the frequencies is smoothed by a
log-sum-exp that is sharpened from stage to stage, and lowered by BFGS with a weak Wolfe line search, which needs no
smoothness (Lewis and Overton, Mathematical Programming 141, 2013; Burke, Henrion, Lewis and Overton, HIFOO, 2006). A
step that makes the loop unstable is refused. What the result is worth between the frequencies is for `mu_peak` to say.

It starts from the full controller, shortened mode by mode, each time by the one that mu misses least.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

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
    same_pole : relative distance up to which two computations of a pole are one.
    """

    sharpness: tuple[float, ...] = (20.0, 80.0, 300.0, 1000.0)
    unneeded: float = 1e-6
    free: float = 0.01
    costly: float = 0.02
    iterations: int = 150
    stall: float = 5e-4
    accuracy: float = 1e-4
    armijo: float = 1e-4
    wolfe: float = 0.5
    trials: int = 25
    narrow: float = 0.2
    negligible: float = 1e-13
    first: int = 3
    same_pole: float = 1e-9


SETTINGS = FixedOrderSettings()


def fixed_order(P: StateSpace, structure: BlockStructure, K: StateSpace, order: int, decentralised: bool = False,
                settings: FixedOrderSettings = SETTINGS) -> tuple[StateSpace, float]:
    """A controller of at most an order with small peak complex mu, and that peak on its last frequency grid.

    P continuous, u and y last; `structure` complex, performance last; K a controller that stabilises P. A decentralised
    one moves u_k by y_k alone. ComputationError where no shortened controller, or not the diagonal part of K,
    stabilises P.
    """
    if decentralised:
        K = _diagonal_part(K)
        if not lft_lower(P, K).is_stable():
            raise ComputationError("the diagonal part of the full controller does not stabilise the plant",
                                   cause="the axes are too strongly coupled for loops of their own",
                                   next_step="choose other coordinates for u and y")
    K = _shortened(P, structure, K, order, decentralised, settings)
    closed = lft_lower(P, K)
    omega, beta = _with_peaks(closed, structure, frequency_grid(closed), settings)
    best, best_mu = K, float(np.max(beta))
    for sharpness in settings.sharpness:
        K = _improved(P, structure, K, omega, sharpness, decentralised, settings)
        closed = lft_lower(P, K)
        omega, beta = _with_peaks(closed, structure, merged(omega, frequency_grid(closed)), settings)
        if float(np.max(beta)) < best_mu:
            best, best_mu = K, float(np.max(beta))
    return best, best_mu


def _diagonal_part(K: StateSpace) -> StateSpace:
    """K with its entries off the diagonal zero, each one on it without the states that it does not need."""
    parts = []
    for k in range(K.noutputs):
        stable, unstable = split_stable(K.select([k], [k]))
        parts.append(balanced_truncation(stable, tolerance=SETTINGS.unneeded) + unstable)
    return append(*parts)


def _improved(P: StateSpace, structure: BlockStructure, K: StateSpace, omega: Array, sharpness: float,
              decentralised: bool, settings: FixedOrderSettings) -> StateSpace:
    """K after one stage of descent on the frequencies omega."""
    form = Entries.of(K, decentralised)
    problem = Objective(P, structure, form, omega, sharpness, settings.accuracy, settings)
    return form.controller(_bfgs(problem.value, form.start, settings))


def _shortened(P: StateSpace, structure: BlockStructure, K: StateSpace, order: int, decentralised: bool,
               settings: FixedOrderSettings) -> StateSpace:
    """K without all but `order` states: truncated while that is free, then mode by mode."""
    omega = frequency_grid(lft_lower(P, K))

    def peak(one: StateSpace) -> float:
        closed = lft_lower(P, one)
        if not closed.is_stable():
            return np.inf
        M = closed.frequency_response(omega)[:, None]
        return float(np.max(upper_bound(M, structure, 10 * settings.accuracy).beta))
    if K.nstates > order:
        K = reduce_controller(P, K, peak, settings.free, range(order, K.nstates)).K
    now, improved = peak(K), False
    while K.nstates > order:
        fewer = [*_without_one_mode(K), *_truncated(K)]
        # One state less than asked where only a pair of poles can go.
        fewer = [one for one in fewer if one.nstates >= order] or fewer
        peaks = [peak(one) for one in fewer]
        least = int(np.argmin(peaks))
        if peaks[least] > (1 + settings.costly) * now and not improved:
            K = _improved(P, structure, K, omega, settings.sharpness[0], decentralised, settings)
            improved = True
            now = peak(K)
            continue
        if not np.isfinite(peaks[least]):
            raise ComputationError(f"no controller of order {order} to start from",
                                   measured=f"at order {K.nstates} every mode is needed for stability",
                                   cause="the plant needs more states to be stabilised",
                                   next_step="ask for a higher order")
        K, now, improved = fewer[least], peaks[least], False
    return K


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


def _with_peaks(closed: StateSpace, structure: BlockStructure, omega: Array,
                settings: FixedOrderSettings) -> tuple[Array, Array]:
    """The grid with the local maxima of mu found between its points, and mu on it."""
    def value(at: Array) -> Array:
        return upper_bound(closed.frequency_response(at)[:, None], structure, settings.accuracy).beta
    return refine_maxima(value, omega, value(omega), tolerance=1e-3, worth=0.95)


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
    """The smoothed maximum of log mu over a frequency grid as a function of the entries of K, with its slope."""

    P: StateSpace
    structure: BlockStructure
    form: Entries
    omega: Array
    sharpness: float
    accuracy: float
    settings: FixedOrderSettings = SETTINGS

    def value(self, x: Array) -> tuple[float, Array]:
        """log of the smoothed peak and its slope; inf where the loop is unstable."""
        K = self.form.controller(x)
        try:
            closed = lft_lower(self.P, K)
        except ComputationError:
            return np.inf, np.zeros(x.size)
        if not closed.is_stable():
            return np.inf, np.zeros(x.size)
        # Narrow modes move from step to step; on the grid alone descent would hide their peaks between its points.
        narrow = resonances(closed.poles(), damping=self.settings.narrow)
        omega = np.concatenate([self.omega, narrow])
        n_u, n_y = K.noutputs, K.ninputs
        p = np.concatenate([self.response, self.P.frequency_response(narrow)])
        z, w = p.shape[1] - n_y, p.shape[2] - n_u
        phi = np.linalg.inv(1j * omega[:, None, None] * np.eye(K.nstates) - K.A)
        k = K.C @ phi @ K.B + K.D
        # With E = inv(I - P22 K): dM = P12 (I + K E P22) dK E P21.
        E = np.linalg.inv(np.eye(n_y) - p[:, z:, w:] @ k)
        R = E @ p[:, z:, :w]
        M = p[:, :z, :w] + p[:, :z, w:] @ k @ R
        L = p[:, :z, w:] @ (np.eye(n_u) + k @ E @ p[:, z:, w:])
        near, bound = self._highest(M)
        M, L, R, phi = M[near], L[near], R[near], phi[near]
        lam = bound.beta ** 2 * (1 + self.accuracy)
        dual = np.linalg.inv(residual(M[:, None], bound.scalings, lam, np.ones(w, bool))[:, 0])
        dual /= np.trace(bound.scalings.X_w @ dual, axis1=1, axis2=2).real[:, None, None]
        # d log beta = d lambda / (2 lambda) = Re tr(G dK).
        G = R @ dual @ dagger(M) @ bound.scalings.X_z @ L / lam[:, None, None]
        logs = np.log(bound.beta)
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
        the frequency does not count.
        """
        d_z, d_w = expand(self.structure, block_balance(M[:, None], self.structure))
        size = np.linalg.norm(M * d_z[:, :, None] / d_w[:, None, :], ord=2, axis=(1, 2))
        first = np.argsort(size)[-self.settings.first:]
        top = float(np.max(upper_bound(M[first][:, None], self.structure, self.accuracy).beta))
        near = np.flatnonzero(size >= top * self.settings.negligible ** (1 / self.sharpness))
        return near, upper_bound(M[near][:, None], self.structure, self.accuracy)

    @property
    def response(self) -> Array:
        """P at the frequencies (n_omega, n_out, n_in)."""
        found = self.__dict__.get("_response")
        if found is None:
            found = self.P.frequency_response(self.omega)
            object.__setattr__(self, "_response", found)
        return found


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
