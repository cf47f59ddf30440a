"""The D-step: scalings of minimum order that keep the scaled loop within one per cent of its peak mu.

For scalar scalings only the magnitude matters, and log sigma_max(D N D^-1) is convex in log |d| with the gradient
|u_i|^2 - |v_i|^2 of its singular vectors (Sezginer and Overton, IEEE TAC 35, 1990). After the semidefinite fit of
single blocks, all parameters are therefore adjusted jointly by linear programs in a trust region, with the actual
objective: the peak over frequency of the loop scaled by the realised D(s). Repeated blocks take part with the scalar
factors of their matrices, whose orders are raised before those of the matrices. The best scalings at one frequency are
not unique, and fitting them block by block may cost far more than a joint fit of the same order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.cluster.hierarchy as hierarchy
import scipy.optimize as so

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.dscale_fit import fit_magnitude
from avis_ctrl.robust.dscale_matrix import fit_hermitian
from avis_ctrl.robust.gamma_descent import parameter_box, parameters, with_parameters
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.scalings import SETTINGS as SCALINGS
from avis_ctrl.robust.scalings import MatrixScaling, Part, ScalarScaling, Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class DStepSettings:
    """All values without unit.

    fit : accuracy of log |d| in the fit of a single block: all fits are refined jointly afterwards.
    refinement : the joint refinement ends when a linear program predicts a smaller gain in log mu: a tenth of the
        allowed cost of a fit.
    broad_floor, detailed_floor : fraction of the peak of mu below which any misfit is harmless; above it, mu itself is
        the reference. Steps with a large gain need little of the mu profile; the last steps depend on it.
    checked : number of frequencies of the check between grid points: about three times those of the largest grid.
    between : ratio to the peak above which a peak between grid points is added to the grid.
    groups : with many blocks, number of groups of blocks with shared roots, grouped by the similarity of their best
        scalings over frequency: one root per block would add more states than the plant has. The gains are not shared.
    equal_orders : orders of the scalings with equal order in all blocks. Fits of higher order follow details of the
        best scalings at single frequencies, which are not unique.
    """

    fit: float = 2e-2
    refinement: float = 1e-3
    broad_floor: float = 0.5
    detailed_floor: float = 0.3
    checked: int = 400
    between: float = 1.02
    groups: int = 4
    equal_orders: tuple[int, ...] = (1, 2, 3, 4, 5)


SETTINGS = DStepSettings()


@dataclass(frozen=True, eq=False)
class PointwiseScalings:
    """Best scalings at each single frequency: the target of the fit of D(s).

    mu : (n_omega,) upper bounds; log_d : (n_omega, n_blocks), zero for performance; X : block index ->
    (n_omega, n, n) Hermitian positive definite D^H D of a repeated scalar, relative to performance.
    """

    omega: np.ndarray
    M: np.ndarray
    structure: BlockStructure
    mu: np.ndarray
    log_d: np.ndarray
    X: dict[int, np.ndarray]
    floor: float = SETTINGS.broad_floor

    @property
    def peak(self) -> float:
        """Largest upper bound of mu."""
        return float(np.max(self.mu))

    def shape(self, k: int) -> np.ndarray:
        """X of a repeated block divided by its common size |d|^2 (n_omega, n, n)."""
        return self.X[k] / np.exp(2 * self.log_d[:, k])[:, None, None]

    @property
    def reference(self) -> np.ndarray:
        """Reference for the loop scaled by the realised D(s) (n_omega,): mu, but at least a fraction of its peak."""
        return np.maximum(self.mu, self.floor * self.peak)

    @staticmethod
    def of(omega: np.ndarray, M: np.ndarray, structure: BlockStructure, tolerance: float = 2e-3) -> PointwiseScalings:
        """From the response M (n_omega, n_z, n_w) of the loop; the last block is performance, no block is real."""
        mu, scalings = upper_bound(M[:, None], structure, tolerance)
        last = next(reversed(list(structure.slices())))[2].start
        log_d, X = np.zeros((omega.size, len(structure.blocks))), {}
        for k, (block, _, z) in enumerate(structure.slices()):
            part = scalings.X_z[:, z, z] / scalings.X_z[:, last, last].real[:, None, None]
            log_d[:, k] = 0.5 * np.log(np.trace(part, axis1=1, axis2=2).real / block.cols)
            if block.repeated:
                X[k] = part
        return PointwiseScalings(omega, M, structure, mu, log_d, X)

    def extended(self, omega: np.ndarray, M: np.ndarray) -> PointwiseScalings:
        """The same with additional frequencies of the loop."""
        more = PointwiseScalings.of(omega, M, self.structure)
        order = np.argsort(np.concatenate([self.omega, omega]))

        def both(one: np.ndarray, two: np.ndarray) -> np.ndarray:
            return np.concatenate([one, two])[order]

        return replace(
            self,
            omega=both(self.omega, omega),
            M=both(self.M, M),
            mu=both(self.mu, more.mu),
            log_d=both(self.log_d, more.log_d),
            X={k: both(X, more.X[k]) for k, X in self.X.items()},
        )


@dataclass(frozen=True)
class DStep:
    """Realised scalings, the peak of the scaled loop, and their cost: largest relative excess over the reference."""

    scalings: Scalings
    peak: float
    cost: float


def equal_order_fits(points: PointwiseScalings, max_states: int) -> Iterator[DStep]:
    """Scalings fitted block by block, all of equal order: lowest orders first, each with three weights of the misfit.

    They are much faster than `d_steps`, and evaluated on the grid only. Their cost in the last loop says little about
    the next loop, so that the caller compares the gamma that is achievable with them.
    """
    start = _constants(points)
    everywhere = np.ones((points.omega.size, len(start.parts)))
    weights = (everywhere, everywhere * _closeness(points)[:, None], _sensitivities(points, start))
    for order in SETTINGS.equal_orders:
        for weight in weights:
            scalings = start
            for blocks in start.members:
                for k, part in zip(blocks, _fitted(points, start, blocks, order, weight), strict=True):
                    scalings = scalings.replace(k, part)
            if scalings.added_states > max_states:
                return
            yield _evaluated(points, scalings)


def d_steps(
    points: PointwiseScalings,
    loop: StateSpace,
    start: Scalings,
    floors: Sequence[float] = (SETTINGS.broad_floor,),
    allowed_cost: float = 0.01,
    max_states: int = 60,
) -> Iterator[DStep]:
    """Scalings of the loop N(s) chosen on the grid and checked between its points: peaks there are added to the grid.

    For each floor two fits are generated: a new fit, and one continued from `start`, the scalings of the last K-step.
    The first fit within the allowed cost is the last. By this measure no fit costs more than `start`. If no fit follows
    the best scalings at all frequencies, the costs do not show which fit allows the better controller.
    """
    for floor in floors:
        at = replace(points, floor=floor)
        for chosen in (partial(_from_constants, at), partial(_from_start, at, start)):
            step = _settled(at, loop, chosen(allowed_cost, max_states), start, allowed_cost, max_states)
            yield step
            if step.cost <= allowed_cost:
                return


def tightened(
    points: PointwiseScalings, loop: StateSpace, start: Scalings, allowed_cost: float, max_states: int
) -> DStep:
    """Scalings continued from `start` that lower only the peak of the scaled loop N(s), not its values below."""
    points = replace(points, floor=1.0)
    step = _from_start(points, start, allowed_cost, max_states)
    return _settled(points, loop, step, start, allowed_cost, max_states)


def _settled(
    points: PointwiseScalings, loop: StateSpace, step: DStep, start: Scalings, allowed_cost: float, max_states: int
) -> DStep:
    """The step corrected until there are no peaks between grid points, or `start` if that costs less."""
    dense = np.geomspace(points.omega[0], points.omega[-1], SETTINGS.checked)
    response = loop.frequency_response(dense)
    first = _measured(points, loop, dense, response, start)[0]
    for _ in range(4):
        measured, omega, M = _measured(points, loop, dense, response, step.scalings)
        if not omega.size:
            break
        points = points.extended(omega, M)
        step = _from_start(points, step.scalings, allowed_cost, max_states)
    else:
        measured = _measured(points, loop, dense, response, step.scalings)[0]
    return min(measured, first, key=lambda found: found.cost)


def _measured(
    points: PointwiseScalings, loop: StateSpace, dense: np.ndarray, response: np.ndarray, scalings: Scalings
) -> tuple[DStep, np.ndarray, np.ndarray]:
    """The step with peak and cost also between grid points, and the frequencies and M where these exceed the grid."""
    step = _evaluated(points, scalings)
    # Lightly damped roots cause the narrowest peaks that scalings can add.
    roots = np.abs(np.concatenate([np.r_[part.scalar.zeros, part.scalar.poles] for part in scalings.parts]))
    omega = np.concatenate([dense, roots])
    order = np.argsort(omega)
    M = np.concatenate([response, loop.frequency_response(roots)])[order]
    omega = omega[order]
    sigma = _sigma(omega, M, scalings)
    top = (sigma[1:-1] >= sigma[:-2]) & (sigma[1:-1] > sigma[2:]) & (sigma[1:-1] > SETTINGS.between * step.peak)
    at = np.flatnonzero(top) + 1
    at = at[np.argsort(sigma[at])[::-1][:4]]
    reference = np.interp(np.log(omega), np.log(points.omega), points.reference)
    cost = max(step.cost, float(np.max(sigma / reference)) - 1)
    return DStep(scalings, max(step.peak, float(np.max(sigma))), cost), omega[at], M[at]


def _from_constants(points: PointwiseScalings, allowed_cost: float, max_states: int) -> DStep:
    """Greedy search for the smallest orders whose realised scalings cost less than `allowed_cost` of peak mu.

    All orders start at zero. Blocks whose misfit explains most of the excess get a higher order, as long as the
    scalings add at most `max_states` states to the plant.
    """
    return _raised_orders(points, _evaluated(points, _refined(points, _constants(points))), allowed_cost, max_states)


def _from_start(points: PointwiseScalings, start: Scalings, allowed_cost: float, max_states: int) -> DStep:
    """The given scalings, refined if that helps, with orders raised as needed."""
    kept = min(_evaluated(points, start), _evaluated(points, _refined(points, start)), key=lambda step: step.cost)
    return _raised_orders(points, kept, allowed_cost, max_states)


def _raised_orders(points: PointwiseScalings, best: DStep, allowed_cost: float, max_states: int) -> DStep:
    """Raise orders where the misfit costs most, until the cost is allowed or no increase helps."""
    while best.cost > allowed_cost:
        contribution = _blame(points, best.scalings)
        if not np.any(contribution > 0):
            break
        most = np.max(contribution)
        candidates = (
            _raised(points, best, np.flatnonzero(contribution >= part * most), max_states, by, matrices)
            # Matrices last: their scalar factors usually suffice, and are refined jointly with the rest.
            for matrices in (False, True)
            # One more order may not help where two do: a resonance needs a pair of roots.
            for part, by in ((0.4, 1), (0.4, 2), (0.999, 1), (0.999, 2))
        )
        better = next(
            (new for new in candidates if new is not None and new.cost < max(0.9 * best.cost, allowed_cost)), None
        )
        if better is None:
            break
        best = better
    return best


def band_of(omega: np.ndarray) -> tuple[float, float]:
    """Band for the roots of scalings [rad/s]: a decade inside the range of frequencies, so that D is flat beyond it."""
    low, high = float(np.min(omega)), float(np.max(omega))
    return (10 * low, high / 10) if high > 1e3 * low else (low, high)


def _sigma(omega: np.ndarray, M: np.ndarray, scalings: Scalings) -> np.ndarray:
    """sigma_max(D M D^-1) (n_omega,) with the realised scalings."""
    left, right = scalings.response(omega)
    return np.linalg.norm(left @ M @ right, ord=2, axis=(1, 2))


def _evaluated(points: PointwiseScalings, scalings: Scalings) -> DStep:
    sigma = _sigma(points.omega, points.M, scalings)
    return DStep(scalings, float(np.max(sigma)), float(np.max(sigma / points.reference)) - 1)


def _constants(points: PointwiseScalings) -> Scalings:
    """Constant scalings from the frequencies near the peak, in groups."""
    weight = _closeness(points)
    parts = list(Scalings.identity(points.structure).parts)
    for k in range(len(parts) - 1):
        if k in points.X:
            parts[k] = fit_hermitian(points.omega, points.shape(k), 0, weight, SETTINGS.fit).scaling
        d = fit_magnitude(points.omega, np.exp(points.log_d[:, k]), 0, weight).scaling
        parts[k] = parts[k].with_scalar(d)
    return Scalings(points.structure, tuple(parts), _groups(points))


def _groups(points: PointwiseScalings) -> tuple[int, ...]:
    """Group number of each block; empty if there are few blocks, or repeated blocks."""
    n = len(points.structure.blocks) - 1
    if not points.structure.many or points.X:
        return ()
    weight = _closeness(points)[:, None]
    course = points.log_d[:, :n] - np.average(points.log_d[:, :n], axis=0, weights=weight[:, 0])
    tree = hierarchy.linkage((np.sqrt(weight) * course).T, "ward")
    return (*hierarchy.fcluster(tree, SETTINGS.groups, "maxclust").tolist(), 0)


def _raised(
    points: PointwiseScalings, step: DStep, groups: np.ndarray, max_states: int, by: int, matrices: bool
) -> DStep | None:
    """The step with some groups refitted at a higher order and everything refined; None if the order is not allowed.

    matrices : raise the orders of the matrices of repeated blocks, instead of those of their scalar factors.
    """
    scalings = step.scalings
    members = [scalings.members[number] for number in groups]
    if matrices and not any(k in points.X for blocks in members for k in blocks):
        return None
    for blocks in members:
        k = blocks[0]
        part = scalings.parts[k]
        if matrices and isinstance(part, MatrixScaling):
            order = part.order // points.structure.blocks[k].rows + by
            if order > SCALINGS.max_order // 2:
                return None
            weight = _sensitivities(points, step.scalings)[:, k]
            part = fit_hermitian(points.omega, points.X[k], order, weight, SETTINGS.fit).scaling
        else:
            order = part.scalar.order + by
            if order > SCALINGS.max_order:
                return None
            # Sensitivities with the groups that are already refitted.
            weights = _sensitivities(points, scalings)
            for k, part in zip(blocks, _fitted(points, step.scalings, blocks, order, weights), strict=True):
                scalings = scalings.replace(k, part)
            continue
        scalings = scalings.replace(k, part)
    if scalings.added_states > max_states:
        return None
    return _evaluated(points, _refined(points, scalings))


def _fitted(
    points: PointwiseScalings, scalings: Scalings, blocks: tuple[int, ...], order: int, weights: np.ndarray
) -> list[Part]:
    """The blocks of a group with d(s) fitted to their best scalings at each frequency; `weights` (n_omega, n_blocks)
    are the cost of a misfit."""
    weights = weights[:, blocks]
    part, target = scalings.parts[blocks[0]], points.log_d[:, blocks]
    if isinstance(part, MatrixScaling):
        size = np.linalg.norm(part.system.frequency_response(points.omega), axis=(1, 2))
        target = target - np.log(size / np.sqrt(part.system.ninputs))[:, None]
    # Each block has its own gain; the remaining dependence on frequency is common to the group.
    own = np.average(target, axis=0, weights=weights) if len(blocks) > 1 else np.zeros(1)
    common = np.average(target - own, axis=1, weights=weights)
    fit = fit_magnitude(points.omega, np.exp(common), order, np.max(weights, axis=1), SETTINGS.fit)
    theta = fit.scaling.within(band_of(points.omega)).theta
    return [
        scalings.parts[k].with_scalar(ScalarScaling(np.r_[theta[0] + gain, theta[1:]]))
        for k, gain in zip(blocks, own, strict=True)
    ]


def _closeness(points: PointwiseScalings) -> np.ndarray:
    """Weight of a misfit by the distance of mu from its peak: one at the peak, small far below it."""
    room = np.log(points.peak / np.maximum(points.mu, 1e-3 * points.peak))
    return 0.03 / (0.03 + room)


def _sensitivities(points: PointwiseScalings, scalings: Scalings) -> np.ndarray:
    """(n_omega, n_blocks) cost of a misfit: closeness to the peak times the contribution to the singular vectors."""
    left, right = scalings.response(points.omega)
    U, _, Vh = np.linalg.svd(left @ points.M @ right)
    contribution = np.stack(
        [
            np.sum(np.abs(U[:, z, 0]) ** 2, axis=1) + np.sum(np.abs(Vh[:, 0, w]) ** 2, axis=1)
            for _, w, z in points.structure.slices()
        ],
        axis=1,
    )
    # A block that is not part of a loop does not contribute.
    relative = contribution / np.maximum(np.max(contribution, axis=0), np.finfo(float).tiny)
    weight = _closeness(points)[:, None] * np.maximum(relative, 1e-2)
    return np.maximum(weight / np.max(weight, axis=0), 1e-3)


def _blame(points: PointwiseScalings, scalings: Scalings) -> np.ndarray:
    """Part of the excess over the reference explained by the misfit of each group (n_groups,), to first order."""
    left, right = scalings.response(points.omega)
    U, s, Vh = np.linalg.svd(left @ points.M @ right)
    excess = np.maximum(np.log(s[:, 0] / points.reference), 0.0)
    contribution = np.zeros(len(scalings.parts))
    for k, (_, w, z) in enumerate(points.structure.slices()):
        part = scalings.parts[k]
        slope = np.sum(np.abs(U[:, z, 0]) ** 2, axis=1) - np.sum(np.abs(Vh[:, 0, w]) ** 2, axis=1)
        if isinstance(part, ScalarScaling):
            misfit = part.log_magnitude(points.omega) - points.log_d[:, k]
            contribution[k] = float(np.max(excess * np.maximum(slope * misfit, 0.0)))
        else:
            fitted = left[:, z, z]
            ratio = np.linalg.solve(np.conj(np.swapaxes(fitted, 1, 2)) @ fitted, points.X[k])
            distance = np.max(np.abs(np.log(np.abs(np.linalg.eigvals(ratio)))), axis=1)
            weight = np.sum(np.abs(U[:, z, 0]) ** 2, axis=1) + np.sum(np.abs(Vh[:, 0, w]) ** 2, axis=1)
            contribution[k] = float(np.max(excess * weight * distance)) / 2
    return np.array([np.sum(contribution[list(blocks)]) for blocks in scalings.members])


def _refined(points: PointwiseScalings, scalings: Scalings, steps: int = 5) -> Scalings:
    """Minimise max over frequency of log(sigma_max(D N D^-1) / reference) by linear programs in a trust region."""
    if len(scalings.parts) < 2:
        return scalings
    box = np.array(parameter_box(scalings, band_of(points.omega)))
    theta, radius = np.clip(parameters(scalings), box[:, 0], box[:, 1]), 0.5
    scalings = with_parameters(scalings, theta)
    values, slopes = _linearised(points, scalings)
    level = float(np.max(values))
    for _ in range(steps):
        move, predicted = _trust_step(
            values, slopes, np.maximum(box[:, 0] - theta, -radius), np.minimum(box[:, 1] - theta, radius)
        )
        if level - predicted < SETTINGS.refinement or radius < 1e-3:
            break
        trial = with_parameters(scalings, theta + move)
        new_values, new_slopes = _linearised(points, trial)
        gained = (level - float(np.max(new_values))) / (level - predicted)
        if gained > 0.1:
            theta, scalings, values, slopes = theta + move, trial, new_values, new_slopes
            level = float(np.max(values))
        radius = min(2 * radius, 1.0) if gained > 0.7 else radius if gained > 0.3 else 0.35 * radius
    return scalings


def _linearised(points: PointwiseScalings, scalings: Scalings, kept: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the largest singular values relative to the reference near the peak (n,), slopes (n, n_theta)."""
    left, right = scalings.response(points.omega)
    U, s, Vh = np.linalg.svd(left @ points.M @ right, full_matrices=False)
    kept = min(kept, s.shape[1])
    log_s = np.log(np.maximum(s[:, :kept], 1e-300))
    log_ref = np.log(points.reference)
    top = np.argwhere(log_s - log_ref[:, None] > np.max(log_s[:, 0] - log_ref) - 0.7)
    at, which = top[:, 0], top[:, 1]
    u, v = np.swapaxes(U, 1, 2)[at, which], Vh[at, which]
    places = scalings.places()
    slopes = np.zeros((at.size, 1 + max(int(own.max()) for own in places)))
    for (_, w, z), part, own in zip(points.structure.slices(), scalings.parts, places, strict=False):
        slope = np.sum(np.abs(u[:, z]) ** 2, axis=1) - np.sum(np.abs(v[:, w]) ** 2, axis=1)
        slopes[:, own] += slope[:, None] * part.scalar.jacobian(points.omega)[at]
    return (log_s - log_ref[:, None])[at, which], slopes


def _trust_step(values: np.ndarray, slopes: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Move (n_theta,) between low and high that minimises the largest linearised value, and that value."""
    n = slopes.shape[1]
    cost = np.r_[np.zeros(n), 1.0]
    program = so.linprog(
        cost,
        A_ub=np.hstack([slopes, -np.ones((values.size, 1))]),
        b_ub=-values,
        bounds=[*zip(low, high, strict=True), (None, None)],
        method="highs-ds",
    )
    return (program.x[:n], float(program.x[n])) if program.status == 0 else (np.zeros(n), float(np.max(values)))
