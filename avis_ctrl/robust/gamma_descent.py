"""Descent on the H-infinity optimum over the parameters of the scalings.

D-K iteration minimises over D and K in turn and stalls: after a K-step the scaled loop is flat over frequency, so that
no change of D alone helps. Here gamma(theta) = min over K of ||D P_K D^-1|| is minimised as a function of the scaling
parameters; its gradient is cheap. If the optimum is determined by rho(X Y) = gamma^2, the implicit function theorem
gives dgamma/dtheta = -(drho/dtheta) / (drho/dgamma - 2 gamma). The derivatives of X and Y are solutions of Lyapunov
equations, and two adjoint Lyapunov equations serve all parameters:

    A'X + XA + XRX + Q = 0,   A_c = A + R X:     dX solves   A_c' dX + dX A_c + M = 0,
    M = dA'X + X dA + X dR X + dQ,     a' dX a = tr(L M),   A_c L + L A_c' + a a' = 0 .

The data (A, R, Q) of the Riccati equations are invariant under the rotations of z and w and the scalings of u and y
that transform a plant to normal form. Differences of the data are therefore not affected by these transformations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, balance
from avis_ctrl.robust.hinf_plant import NormalForm, Plant, normal_form, rank_margins, regularised
from avis_ctrl.robust.hinf_riccati import GammaBracket, control_riccati, filter_riccati, find_gamma, gamma_test
from avis_ctrl.robust.hinf_settings import SETTINGS as HINF
from avis_ctrl.robust.scalings import SETTINGS as SCALINGS
from avis_ctrl.robust.scalings import ScalarScaling, Scalings

COUPLED = "rho(X Y)"


@dataclass(frozen=True)
class GradientSettings:
    """All values without unit.

    step : change of a parameter (of gamma: relative) by which the data of the Riccati equations are differentiated:
        their error is of its order, and its round-off is far smaller.
    gamma : relative accuracy of gamma, small compared with the gain at which the descent ends.
    regularisation : size of the extra outputs or inputs of a plant whose D12 or D21 is rank deficient, relative to its
        channels: small compared with the weights, large compared with round-off.
    """

    step: float = 1e-6
    gamma: float = 1e-5
    regularisation: float = 1e-4


SETTINGS = GradientSettings()


@dataclass(frozen=True)
class ScaledProblem:
    """The plant to be scaled; its states are balanced only once, so that gamma is smooth in theta."""

    P: StateSpace
    nmeas: int
    ncon: int
    singular: tuple[bool, bool]

    @staticmethod
    def of(P: StateSpace, nmeas: int, ncon: int) -> ScaledProblem:
        """The problem of P; nmeas, ncon : number of measurements and controls, which are last."""
        of_u, of_y = rank_margins(Plant.of(P, nmeas, ncon))
        return ScaledProblem(balance(P), nmeas, ncon, (of_u < HINF.rank_tolerance, of_y < HINF.rank_tolerance))

    def normal(self, scalings: Scalings) -> NormalForm:
        """Normal form of the scaled plant, with extra channels if D12 or D21 is rank deficient."""
        plant = Plant.split(scalings.scale(self.P), self.nmeas, self.ncon)
        return normal_form(
            regularised(plant, SETTINGS.regularisation, *self.singular, False) if any(self.singular) else plant
        )

    def reaches(self, scalings: Scalings, gamma: float) -> bool:
        """Whether some controller achieves a scaled norm below gamma."""
        return gamma_test(self.normal(scalings).plant, gamma).feasible


def parameters(scalings: Scalings) -> np.ndarray:
    """theta of all free scalings in one vector; parameters shared by a group occur once."""
    places = scalings.places()
    theta = np.zeros(1 + max((int(at.max()) for at in places), default=-1))
    for part, at in zip(scalings.parts, places, strict=False):
        theta[at] = part.scalar.theta
    return theta


def with_parameters(scalings: Scalings, theta: np.ndarray) -> Scalings:
    """The scalings with the parameters theta."""
    for k, at in enumerate(scalings.places()):
        scalings = scalings.replace(k, scalings.parts[k].with_scalar(ScalarScaling(theta[at])))
    return scalings


def gamma_and_gradient(
    problem: ScaledProblem, scalings: Scalings, hint: float | None = None
) -> tuple[float, np.ndarray]:
    """gamma(theta), d log gamma / d theta (n_theta,); ComputationError if rho(X Y) does not determine the optimum."""
    slope, gamma, of_gamma = _coupling(problem, scalings, hint)
    theta = parameters(scalings)
    gradient = np.empty(theta.size)
    for k in range(theta.size):
        moved = theta.copy()
        moved[k] += SETTINGS.step
        shift = problem.normal(with_parameters(scalings, moved)).plant
        gradient[k] = -slope.along(shift, gamma) / SETTINGS.step / of_gamma
    return gamma, gradient / gamma


def _coupling(problem: ScaledProblem, scalings: Scalings, hint: float | None) -> tuple[_CouplingSlope, float, float]:
    """Derivatives of rho(X Y) at the optimum, gamma there, and the derivative of rho(X Y) - gamma^2 by gamma."""
    plant = problem.normal(scalings).plant
    bracket = find_gamma(plant, SETTINGS.gamma, hint)
    if COUPLED not in bracket.limited_by:
        raise ComputationError(
            "gamma has no gradient here",
            cause=f"it is limited by {bracket.limited_by}",
            measured=f"gamma = {bracket.upper.gamma:.6g}",
            next_step="fit D and iterate on K",
        )
    gamma = bracket.upper.gamma
    slope = _CouplingSlope.of(plant, bracket)
    step = SETTINGS.step
    return slope, gamma, slope.along(plant, gamma * (1 + step)) / (gamma * step) - 2 * slope.rho / gamma


@dataclass(frozen=True)
class _CouplingSlope:
    """First-order change of rho(X Y) with the data of both Riccati equations."""

    rho: float
    X: np.ndarray
    Y: np.ndarray
    control: tuple[np.ndarray, np.ndarray, np.ndarray]
    filter: tuple[np.ndarray, np.ndarray, np.ndarray]
    L_x: np.ndarray
    L_y: np.ndarray

    @staticmethod
    def of(plant: Plant, bracket: GammaBracket) -> _CouplingSlope:
        X, Y, gamma = bracket.upper.X, bracket.upper.Y, bracket.upper.gamma
        assert X is not None and Y is not None
        control, filter_ = control_riccati(plant, gamma), filter_riccati(plant, gamma)
        values, vectors = la.eig(X @ Y)
        rho = float(np.max(values.real))
        v = vectors[:, np.argmax(values.real)].real
        a = Y @ v
        # drho = (a' dX a + rho v' dY v) / (v' a), since Y v is the left eigenvector of X Y
        weight = float(v @ a)
        L_x = la.solve_continuous_lyapunov(control[0] + control[1] @ X, -np.outer(a, a) / weight)
        L_y = la.solve_continuous_lyapunov(filter_[0] + filter_[1] @ Y, -rho * np.outer(v, v) / weight)
        return _CouplingSlope(rho, X, Y, control, filter_, L_x, L_y)

    def along(self, plant: Plant, gamma: float) -> float:
        """First-order change of rho(X Y) from the present plant and gamma to the given ones."""
        total = 0.0
        for X, L, here, there in (
            (self.X, self.L_x, self.control, control_riccati(plant, gamma)),
            (self.Y, self.L_y, self.filter, filter_riccati(plant, gamma)),
        ):
            dA, dR, dQ = (new - old for new, old in zip(there, here, strict=True))
            total += 2 * np.sum((L @ X) * dA.T) + np.sum((X @ L @ X) * dR) + np.sum(L * dQ)
        return float(total)


def descend(
    P: StateSpace,
    nmeas: int,
    ncon: int,
    scalings: Scalings,
    band: tuple[float, float],
    *,
    evaluations: int = 40,
    tolerance: float = 1e-3,
) -> Scalings:
    """Quasi-Newton descent (BFGS with bounds) on log gamma over the parameters of the scalar scalings.

    P (w, u -> z, y); roots stay within `band` [rad/s]. Ends when five steps together gain less than `tolerance`.
    """
    problem = ScaledProblem.of(P, nmeas, ncon)
    low, high = np.array(parameter_box(scalings, band)).T
    here = with_parameters(scalings, np.clip(parameters(scalings), low, high))
    gamma, slope = gamma_and_gradient(problem, here)
    count, trail = 1, [gamma]
    H = np.eye(low.size)
    while count < evaluations:
        theta = parameters(here)
        step = _direction(H, slope, theta, low, high)
        found = None
        while found is None and np.max(np.abs(step)) > 1e-4 and count < evaluations:
            trial = with_parameters(here, np.clip(theta + step, low, high))
            count += 1
            found = _tried(problem, trial, gamma, 1e-4 * float(slope @ step))
            step = step / 3
        if found is None:
            if np.allclose(H, np.eye(low.size)):
                break
            H = np.eye(low.size)
            continue
        new_gamma, new_slope = found
        H = _updated(H, parameters(trial) - theta, new_slope - slope)
        here, gamma, slope = trial, new_gamma, new_slope
        trail.append(gamma)
        if len(trail) > 5 and trail[-6] / gamma - 1 < tolerance:
            break
    return here


def _direction(H: np.ndarray, slope: np.ndarray, theta: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Quasi-Newton step of at most one (a factor e in a root); parameters at an active bound stay fixed."""
    free = ~(((theta <= low) & (slope > 0)) | ((theta >= high) & (slope < 0)))
    step = np.zeros(theta.size)
    step[free] = -H[np.ix_(free, free)] @ slope[free]
    if step @ slope >= 0:
        step[free] = -slope[free]
    return step / max(1.0, float(np.max(np.abs(step), initial=0.0)))


def _tried(problem: ScaledProblem, trial: Scalings, gamma: float, demanded: float) -> tuple[float, np.ndarray] | None:
    """gamma and slope at a trial point of sufficient decrease (log gamma changes by `demanded` < 0); otherwise None."""
    try:
        # One gamma test rejects a point without sufficient decrease; its optimum is not needed.
        if not problem.reaches(trial, gamma * np.exp(demanded)):
            return None
        return gamma_and_gradient(problem, trial, gamma)
    except ComputationError:
        return None


def _updated(H: np.ndarray, s: np.ndarray, y: np.ndarray) -> np.ndarray:
    """BFGS update of the inverse Hessian; the first update sets its scale."""
    curvature = float(s @ y)
    if curvature <= 1e-10 * float(np.linalg.norm(s) * np.linalg.norm(y)):
        return H
    if np.allclose(H, np.eye(s.size)):
        H = H * curvature / float(y @ y)
    V = np.eye(s.size) - np.outer(s, y) / curvature
    return V @ H @ V.T + np.outer(s, s) / curvature


def with_added_pairs(
    P: StateSpace,
    nmeas: int,
    ncon: int,
    scalings: Scalings,
    band: tuple[float, float],
    max_states: int,
    fraction: float = 0.5,
) -> Scalings | None:
    """The scalings with one more zero-pole pair in the blocks, and at the frequencies, where gamma is most sensitive.

    A zero and a pole that cancel change nothing, but gamma has a slope with respect to their distance. Pairs are tried
    at two frequencies per decade in all blocks at once. Blocks whose slope is at least `fraction` of the largest get a
    pair. None if all slopes vanish, or if no more states are allowed.
    """
    problem = ScaledProblem.of(P, nmeas, ncon)
    places = np.geomspace(*band, max(3, int(2 * np.log10(band[1] / band[0]))))[1:-1]
    room = max_states - scalings.added_states
    blocks = scalings.structure.blocks
    free = [
        group
        for group in scalings.members
        if scalings.parts[group[0]].scalar.order < SCALINGS.max_order
        and sum(blocks[k].rows + blocks[k].cols for k in group) <= room
    ]
    if not free:
        return None
    slopes = np.array([_neutral_slopes(problem, scalings, free, place) for place in places])
    if np.max(np.abs(slopes)) < 1e-3:
        return None
    best = np.argmax(np.abs(slopes), axis=0)
    strength = np.abs(slopes[best, range(len(free))])
    for threshold in (fraction, 0.999):
        larger = scalings
        for number, (at, group, size) in enumerate(zip(best, free, strength, strict=True)):
            if size >= threshold * np.max(strength):
                split = -0.02 * np.sign(slopes[at, number])
                larger = _with_pair(larger, group, places[at], split)
        if larger.added_states <= max_states:
            return larger
    return None


def _with_pair(scalings: Scalings, group: tuple[int, ...], place: float, split: float = 0.0) -> Scalings:
    """The scalings with a neutral (cancelling) pair in each block of a group."""
    for k in group:
        part = scalings.parts[k]
        scalings = scalings.replace(k, part.with_scalar(part.scalar.with_neutral_pair(place, split)))
    return scalings


def _neutral_slopes(
    problem: ScaledProblem, scalings: Scalings, free: list[tuple[int, ...]], place: float
) -> np.ndarray:
    """d log gamma / d split of a neutral pair at a frequency, for each group of blocks."""
    base = scalings
    for group in free:
        base = _with_pair(base, group, place)
    try:
        slope, gamma, of_gamma = _coupling(problem, base, None)
    except ComputationError:
        return np.zeros(len(free))
    result = np.zeros(len(free))
    for at, group in enumerate(free):
        moved = base
        for k in group:
            part = scalings.parts[k]
            moved = moved.replace(k, part.with_scalar(part.scalar.with_neutral_pair(place, SETTINGS.step)))
        result[at] = -slope.along(problem.normal(moved).plant, gamma) / SETTINGS.step / of_gamma / gamma
    return result


def parameter_box(scalings: Scalings, band: tuple[float, float]) -> list[tuple[float, float]]:
    """Bounds: gains within 1e-6..1e6 times their present value, roots in the band, damping from 0.05 to 50."""
    box: list[tuple[float, float]] = []
    slow, fast = np.log(band[0]), np.log(band[1])
    for k, at in enumerate(scalings.places()):
        part = scalings.parts[k].scalar
        box.append((part.theta[0] - np.log(1e6), part.theta[0] + np.log(1e6)))
        if at[-1] != at[0] + part.theta.size - 1:  # the roots are those of an earlier block
            continue
        for _ in range(2):
            box += [(slow, fast), (np.log(0.05), np.log(50.0))] * (part.order // 2) + [(slow, fast)] * (part.order % 2)
    return box
