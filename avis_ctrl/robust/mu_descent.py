"""Descent on the upper bound of mu over the entries of a controller.

At each frequency the minimum level of mu's upper bound, lambda = beta^2, varies with K as

    d lambda = 2 Re tr(G dK),   G = R Z M^H X_z L,   dM = L dK R,   Z = inv(F) / tr(X_w inv(F)),

because changes of the optimal scalings do not affect it to first order (F, X_z, X_w as in `mu_lmi`). Z is the dual
solution, so that the slope is also correct where several singular values coincide. The maximum over the frequencies is
smoothed by a log-sum-exp that is sharpened from stage to stage, and minimised by BFGS with a weak Wolfe line search,
which requires no smoothness (Lewis and Overton, Mathematical Programming 141, 2013; Burke, Henrion, Lewis and Overton,
HIFOO, 2006). A step that makes the loop unstable is rejected. `mu_peak` evaluates the result between the frequencies.

A limit of the controller gain at high frequency is part of the objective: the largest singular value of K relative to
the limit is treated like a value of mu, with the slope u v^H from its singular vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, lft_lower
from avis_ctrl.robust.controller_entries import ControllerEntries
from avis_ctrl.robust.frequency_grid import frequency_grid, merged, resonances
from avis_ctrl.robust.mu_lmi import Array, dagger, joined, residual
from avis_ctrl.robust.mu_scan import refine_maxima
from avis_ctrl.robust.mu_upper import UpperBound, block_balance, expand, upper_bound
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class DescentSettings:
    """sharpness : exponents of the smoothed maximum over frequency, one per stage. The error of the maximum is
        log(number of frequencies) / exponent, less than one per cent in the last stage.
    iterations : maximum number of BFGS steps per stage.
    stall : relative decrease of the smoothed maximum over ten steps below which a stage ends.
    accuracy : relative accuracy of beta^2 at each frequency, and the distance above it at which the slope is evaluated:
        a smaller distance makes the slope less smooth, a larger distance less accurate.
    armijo, wolfe : fractions of the slope in the Armijo and the weak Wolfe condition (Lewis and Overton 2013).
    trials : maximum number of points of a line search.
    narrow : damping ratio below which the resonance of a closed-loop mode is added to the frequencies of every step.
    negligible : weight in the smoothed maximum, relative to the largest, below which a frequency is omitted: less than
        the effect of rounding errors.
    first : number of frequencies with the largest balanced norms, whose mu determines which other frequencies count.
    between : number of points per interval of the gain limit at which the gain is checked, so that no peak is missed.
    """

    sharpness: tuple[float, ...] = (20.0, 80.0, 300.0, 1000.0)
    iterations: int = 300
    stall: float = 1e-4
    accuracy: float = 1e-4
    armijo: float = 1e-4
    wolfe: float = 0.5
    trials: int = 25
    narrow: float = 0.2
    negligible: float = 1e-13
    first: int = 3
    between: int = 4


SETTINGS = DescentSettings()


@dataclass(frozen=True, eq=False)
class GainLimit:
    """Maximum gain `most` (n,) [unit of K] at frequencies omega (n,) [rad/s]; gain / limit is treated like mu."""

    omega: Array
    most: Array

    def frequencies(self, K: StateSpace, between: int) -> Array:
        """omega with intermediate points, and the natural frequencies of K, where its gain can peak."""
        low, high, own = self.omega[0], self.omega[-1], np.abs(K.poles())
        fine = np.geomspace(low, high, (self.omega.size - 1) * between + 1)
        return merged(self.omega, np.concatenate([fine, own[(own > low) & (own < high)]]))

    def at(self, omega: Array) -> Array:
        """The limit at other frequencies, by a power law between neighbouring points."""
        return np.exp(np.interp(np.log(omega), np.log(self.omega), np.log(self.most)))


@dataclass(frozen=True, eq=False)
class Step:
    """A controller of the descent, and the peak on its grid of complex mu and of its gain relative to the limit."""

    K: StateSpace
    peak: float


@dataclass(frozen=True, eq=False)
class Task:
    """The minimisation problem: P continuous, u and y last; `structure` complex, performance last. In a decentralised
    controller u_k depends on y_k only."""

    P: StateSpace
    structure: BlockStructure
    decentralised: bool = False
    limit: GainLimit | None = None
    settings: DescentSettings = SETTINGS

    def peak(self, K: StateSpace, omega: Array) -> float:
        """Peak of mu and relative gain on a grid; inf if the loop is unstable."""
        closed = lft_lower(self.P, K)
        if not closed.is_stable():
            return np.inf
        M = closed.frequency_response(omega)[:, None]
        beta = upper_bound(M, self.structure, 10 * self.settings.accuracy).beta
        return max(float(np.max(beta)), self.gain(K))

    def gain(self, K: StateSpace) -> float:
        """Largest gain of K relative to its limit; zero without a limit."""
        return float(np.exp(np.max(self.over_limit(K)[1], initial=-np.inf)))

    def over_limit(self, K: StateSpace) -> tuple[Array, Array, Array]:
        """Frequencies (n,) [rad/s], log of the gain of K relative to its limit there, and G (n, n_y, n_u), where
        Re tr(G dK) is the change of this log; n is zero without a limit."""
        if self.limit is None:
            return np.empty(0), np.empty(0), np.empty((0, K.ninputs, K.noutputs), complex)
        omega = self.limit.frequencies(K, self.settings.between)
        U, s, Vh = np.linalg.svd(K.frequency_response(omega))
        s = np.maximum(s, np.finfo(float).tiny)
        return omega, np.log(s[:, 0] / self.limit.at(omega)), dagger(U[:, :, :1] @ Vh[:, :1]) / s[:, :1, None]

    def descended(self, K: StateSpace, stages: Sequence[float]) -> Step:
        """The best of K and the controllers after each stage of descent from K."""
        best, omega = self.measured(K)
        for sharpness in stages:
            form = ControllerEntries.of(K, self.decentralised)
            K = form.controller(_bfgs(Objective(self, form, omega, sharpness).value, form.start, self.settings))
            step, omega = self.measured(K, omega)
            best = min(best, step, key=lambda one: one.peak)
        return best

    def measured(self, K: StateSpace, omega: Array | None = None) -> tuple[Step, Array]:
        """K with its peak (inf if the loop is unstable), and the grid: that of the loop and `omega`, refined at the
        local maxima of mu."""
        closed = lft_lower(self.P, K)
        grid = frequency_grid(closed) if omega is None else merged(omega, frequency_grid(closed))

        def value(at: Array) -> Array:
            return upper_bound(closed.frequency_response(at)[:, None], self.structure, self.settings.accuracy).beta

        grid, beta = refine_maxima(value, grid, value(grid), tolerance=1e-3, worth=0.95)
        return Step(K, max(float(np.max(beta)), self.gain(K)) if closed.is_stable() else np.inf), grid


@dataclass(frozen=True, eq=False)
class Objective:
    """Smoothed maximum of log mu and of log(gain / limit) over a frequency grid, as a function of the entries of K,
    with its slope."""

    task: Task
    form: ControllerEntries
    omega: Array
    sharpness: float

    def value(self, x: Array) -> tuple[float, Array]:
        """log of the smoothed peak and its slope; inf if the loop is unstable."""
        K = self.form.controller(x)
        try:
            closed = lft_lower(self.task.P, K)
        except ComputationError:
            return np.inf, np.zeros(x.size)
        if not closed.is_stable():
            return np.inf, np.zeros(x.size)
        # Narrow modes move from step to step; on a fixed grid the descent would hide their peaks between its points.
        narrow = resonances(closed.poles(), damping=self.task.settings.narrow)
        total, omega, G = smoothed_peak(
            self.task,
            K,
            np.concatenate([self.omega, narrow]),
            np.concatenate([self.response, self.task.P.frequency_response(narrow)]),
            self.sharpness,
        )
        phi = _resolvent(K, omega)
        into, out = phi @ K.B, K.C @ phi
        n = K.nstates
        slope = np.zeros((n + K.noutputs, n + K.ninputs))
        # tr(G dK) with dK = [out, I] d[A B; C D] [into; I].
        slope[:n, :n] = np.sum(into @ G @ out, axis=0).real.T
        slope[:n, n:] = np.sum(G @ out, axis=0).real.T
        slope[n:, :n] = np.sum(into @ G, axis=0).real.T
        slope[n:, n:] = np.sum(G, axis=0).real.T
        return total, self.form.slope(slope)

    @cached_property
    def response(self) -> Array:
        """P at the frequencies (n_omega, n_out, n_in)."""
        return self.task.P.frequency_response(self.omega)


def smoothed_peak(
    task: Task, K: StateSpace, omega: Array, response: Array, sharpness: float
) -> tuple[float, Array, Array]:
    """Smoothed maximum of log mu and of log(gain / limit), and its slope Re sum_k tr(G_k dK(j omega_k)).

    `response` is P at omega (n,). The slope is returned as the frequencies (m,) that count, and G (m, n_y, n_u).
    """
    p, settings = response, task.settings
    n_u, n_y = K.noutputs, K.ninputs
    z, w = p.shape[1] - n_y, p.shape[2] - n_u
    k = K.frequency_response(omega)
    # With E = inv(I - P22 K): dM = P12 (I + K E P22) dK E P21.
    E = np.linalg.inv(np.eye(n_y) - p[:, z:, w:] @ k)
    R = E @ p[:, z:, :w]
    M = p[:, :z, :w] + p[:, :z, w:] @ k @ R
    L = p[:, :z, w:] @ (np.eye(n_u) + k @ E @ p[:, z:, w:])
    near, bound = _highest(task, M, sharpness)
    omega, M, L, R = omega[near], M[near], L[near], R[near]
    lam = bound.beta**2 * (1 + settings.accuracy)
    dual = np.linalg.inv(residual(M[:, None], bound.scalings, lam, np.ones(w, bool))[:, 0])
    dual /= np.trace(bound.scalings.X_w @ dual, axis1=1, axis2=2).real[:, None, None]
    # d log beta = d lambda / (2 lambda) = Re tr(G dK).
    G = R @ dual @ dagger(M) @ bound.scalings.X_z @ L / lam[:, None, None]
    fast, over, slopes = task.over_limit(K)
    logs = np.concatenate([np.log(bound.beta), over])
    omega, G = np.concatenate([omega, fast]), np.concatenate([G, slopes])
    top = float(np.max(logs))
    weight = np.exp(sharpness * (logs - top))
    total = top + float(np.log(np.sum(weight))) / sharpness
    return total, omega, G * (weight / np.sum(weight))[:, None, None]


def _highest(task: Task, M: Array, sharpness: float) -> tuple[Array, UpperBound]:
    """Indices of the frequencies that count in the smoothed maximum, and the bounds of mu there.

    M (n_omega, n_z, n_w). The norm after Osborne's scaling is cheap and at least the bound: a frequency with a small
    norm does not count. mu at the frequencies with the largest norms determines which other frequencies count.
    """
    structure, settings = task.structure, task.settings
    # The signals of a design plant have similar sizes, so that the block norms need no preliminary scaling.
    d_z, d_w = expand(structure, block_balance(M[:, None], structure, goal=np.inf))
    size = np.linalg.norm(M * d_z[:, :, None] / d_w[:, None, :], ord=2, axis=(1, 2))
    falling = np.argsort(-size)
    first = upper_bound(M[falling[: settings.first]][:, None], structure, settings.accuracy)
    least = float(np.max(first.beta)) * settings.negligible ** (1 / sharpness)
    further = falling[settings.first :]
    further = further[size[further] >= least]
    if not further.size:
        return falling[: settings.first], first
    rest = upper_bound(M[further][:, None], structure, settings.accuracy)
    return np.concatenate([falling[: settings.first], further]), joined([first, rest])


def _resolvent(K: StateSpace, omega: Array) -> Array:
    """inv(j omega I - A), (n_omega, n, n)."""
    return np.linalg.inv(1j * omega[:, None, None] * np.eye(K.nstates) - K.A)


def _bfgs(value: Callable[[Array], tuple[float, Array]], x: Array, settings: DescentSettings) -> Array:
    """BFGS with a weak Wolfe line search by bisection; ends when ten steps gain less than `stall`."""
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
