r"""The few directions of correlated parameters that affect a design most, from the covariance of an identification.

The determined part of the covariance is S S^T, so that theta = theta_0 + S z with r standard normal numbers z. Any
rotation of z is standard normal too. The rotation used here is that of the singular vectors of the response's
sensitivity to z: z_1 changes the response most, z_2 most of the remainder, and so on. The first q become bounded
parameters, theta = theta_0 + sum_i k s_i delta_i with |delta_i| <= 1. For the rest, in a ball, the largest change of
the response is stated, and must be covered by dynamic uncertainty.

Coverage: a box of q numbers with P(|z_i| <= k)^q = p^(q/r) and a ball of r - q numbers with probability p^((r-q)/r)
have exactly the joint probability p if the errors are normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import central_differences
from avis_ctrl.rigs.rig import Rig

KeptMatrices = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class DirectionSettings:
    """negligible : change of the response by several directions together, at every frequency, below which they are
    not kept [1]: cables, threads and glue change a response by as much from day to day."""

    negligible: float = 1e-3


SETTINGS = DirectionSettings()


@dataclass(frozen=True, eq=False)
class Directions:
    """Bounded directions and the effect of the remaining ones.

    Attributes
    ----------
    names : (n_p) parameters of the rig.
    changes : (q, n_p) change at delta = 1, in the parameters' units.
    effect : (q,) largest relative change of the response by each at delta = 1.
    rest : (n,) largest relative change of the actuators' response by the directions not kept, at omega.
    rest_floor : (n,) the same for the response to floor motion.
    omega : (n,) rad/s.
    box : k, half width of the box in standard deviations. ball : radius for the rest, likewise.
    coverage : p, of box and ball together.
    """

    names: tuple[str, ...]
    changes: np.ndarray
    effect: np.ndarray
    rest: np.ndarray
    rest_floor: np.ndarray
    omega: np.ndarray
    box: float
    ball: float
    coverage: float


def directions_that_matter(
    rig: Rig,
    names: Sequence[str],
    factor: np.ndarray,
    keep: Sequence[str],
    omega: np.ndarray,
    confidence: float = 0.95,
    negligible: float = SETTINGS.negligible,
) -> Directions:
    """Minimum number of directions such that the rest changes the kept coordinates' response by less than `negligible`.

    Parameters
    ----------
    rig : at the identified values.
    names, factor : parameters of the rig, and S (n_p, r) with the covariance S S^T in their units.
    keep : coordinates; the others are locked.
    omega : (n,) rad/s at which the response is considered.

    Raises
    ------
    InputError : shapes that do not fit together, parameters that the rig does not have, a confidence outside 0..1.
    """
    factor = np.asarray(factor, float)
    if factor.ndim != 2 or len(factor) != len(names) or not np.all(np.isfinite(factor)):
        raise InputError(f"expected finite numbers of shape ({len(names)}, r)", field="factor", value=factor.shape)
    if not 0 < confidence < 1:
        raise InputError("expected a probability between 0 and 1", field="confidence", value=confidence)
    if unknown := [name for name in names if name not in rig.parameters()]:
        raise InputError(f"the rig {rig.name} has no such parameters", field="names", value=unknown)
    r = factor.shape[1]
    driven, floor = relative_sensitivity(rig, names, keep, omega)
    stacked = np.concatenate([driven, floor], axis=1).reshape(len(names), -1)
    J = np.concatenate([stacked.real, stacked.imag], axis=1).T @ factor
    _, _, Vh = np.linalg.svd(J, full_matrices=True)
    turned = factor @ Vh.T
    driven, floor = (np.tensordot(turned.T, part, 1) for part in (driven, floor))
    for q in range(r + 1):
        box, ball = half_widths(q, r, confidence)
        rest, rest_floor = (ball * _ball_gain(part[q:]) for part in (driven, floor))
        if max(np.max(rest, initial=0.0), np.max(rest_floor, initial=0.0)) <= negligible:
            break
    effect = box * np.max(
        np.maximum(np.linalg.norm(driven[:q], ord=2, axis=(2, 3)), np.linalg.norm(floor[:q], ord=2, axis=(2, 3))),
        axis=1,
    )
    return Directions(
        tuple(names), box * turned[:, :q].T, effect, rest, rest_floor, np.asarray(omega, float), box, ball, confidence
    )


def half_widths(q: int, r: int, confidence: float) -> tuple[float, float]:
    """Half width k of a box of q standard normal numbers and radius of a ball of r - q, with that joint confidence."""
    if r == 0:
        return 0.0, 0.0
    each = confidence ** (1 / r)
    return float(norm.ppf((1 + each) / 2)), float(np.sqrt(chi2.ppf(each ** (r - q), r - q))) if q < r else 0.0


def relative_sensitivity(
    rig: Rig, names: Sequence[str], keep: Sequence[str], omega: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Relative change of the kept coordinates' responses by each parameter, (n_p, n, k, k) each, per its unit.

    With B = K + jw C - w^2 M and F = K + jw C: inv(G) dG = -dB inv(B) of the response to forces, input-multiplicative,
    and inv(T) dT = inv(F) (dF - dB inv(B) F) of the response to the floor. A change of the actuators' constants dT_u
    enters as dT_u A, with A the allocation.
    """
    return relative_changes(kept_matrices(rig, keep), matrix_slopes(rig, names, keep), omega)


def matrix_slopes(rig: Rig, names: Sequence[str], keep: Sequence[str]) -> list[KeptMatrices]:
    """Derivatives of M, C, K, T of the kept coordinates by each parameter, per its unit."""

    def matrices_of(one: Rig) -> KeptMatrices:
        return kept_matrices(one, keep, rig.edge_m)

    return [(M, C, K, T) for M, C, K, T in (central_differences(matrices_of, rig, name) for name in names)]


def relative_changes(
    base: KeptMatrices, changes: Sequence[KeptMatrices], omega: np.ndarray, allocation: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """`relative_sensitivity` for changes of M, C, K, T; allocation (n_u, k): A, by default the inverse of T."""
    (M, C, K, T), s = base, 1j * np.asarray(omega, float)[:, None, None]
    allocation, F = np.linalg.pinv(T) if allocation is None else allocation, K + s * C
    inverse = np.linalg.inv(F + s**2 * M)
    driven, floor = [], []
    for dM, dC, dK, dT in changes:
        dF = dK + s * dC
        dB = dF + s**2 * dM
        driven.append(dT @ allocation - dB @ inverse)
        floor.append(np.linalg.solve(F, dF - dB @ inverse @ F))
    shape = (len(changes), len(s), len(M), len(M))
    return np.reshape(driven, shape), np.reshape(floor, shape)


def kept_matrices(rig: Rig, keep: Sequence[str], edge_m: float | None = None) -> KeptMatrices:
    """M, C, K, T of the kept coordinates, rotations as displacement of the edge: by default the rig's own edge, which
    moves with its isolators."""
    eom = rig.equations_of_motion()
    kept = [eom.coordinates.index(name) for name in keep]
    S = np.diag([1 / (edge_m or rig.edge_m) if name.startswith("phi") else 1.0 for name in keep])
    M, C, K = (S @ X[np.ix_(kept, kept)] @ S for X in (eom.M, eom.C, eom.K))
    return M, C, K, S @ eom.T[kept]


def _ball_gain(parts: np.ndarray) -> np.ndarray:
    """(n,) bound on the largest singular value of sum_i z_i parts_i (m, n, k, k) over real z in the unit ball."""
    m, n = parts.shape[:2]
    if m == 0:
        return np.zeros(n)
    flat = np.moveaxis(parts, 0, -1).reshape(n, -1, m)
    # The Frobenius norm bounds the largest singular value; its maximum over the ball is a real matrix's spectral norm.
    return np.linalg.norm(np.concatenate([flat.real, flat.imag], axis=1), ord=2, axis=(1, 2))
