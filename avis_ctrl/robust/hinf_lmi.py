"""Minimum H-infinity norm by linear matrix inequalities: an independent check of the Riccati test.

A controller of the plant's order with ||F_l(P, K)|| < gamma exists if and only if symmetric R, S exist
with (Gahinet and Apkarian, Int. J. Robust Nonlinear Control 4 (1994) 421-448, theorem 4.3)

    N_R' [A R + R A'  R C1'    B1    ]        N_S' [A' S + S A  S B1     C1'   ]
         [C1 R       -gamma I  D11   ] N_R < 0     [B1' S      -gamma I  D11'  ] N_S < 0 ,  [R I; I S] >= 0
         [B1'         D11'    -gamma I]            [C1          D11     -gamma I]

where N_R spans the kernel of [B2' D12'] and N_S that of [C2 D21] (and the identity on the last block).
D12 and D21 may have any rank. Before the problem is posed, the plant is balanced, and time and norm are scaled.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.bilinear import continuous_image
from avis_ctrl.robust.hinf_plant import Plant, as_plant, check_stabilisable
from avis_ctrl.robust.riccati import solve_riccati

UNCERTIFIED = "upper bound not certified"


@dataclass(frozen=True)
class LmiOptimum:
    """Optimum of the semidefinite program.

    upper : gamma at which the returned R and S satisfy the inequalities, verified by their eigenvalues.
    lower : dual objective, a lower bound to the accuracy of the solver (about 1e-6 relative).
    R, S : (n, n) certificates in the balanced coordinates.
    violation : largest eigenvalue of the inequalities at (R, S, upper), relative to gamma; not positive if certified.
    status : that of the solver, with a remark if `upper` is not certified.
    """

    upper: float
    lower: float
    R: np.ndarray
    S: np.ndarray
    violation: float
    status: str


def lmi_gamma(P: Any, nmeas: int, ncon: int) -> LmiOptimum:
    """Optimal gamma of the H-infinity problem by semidefinite programming (cvxpy, clarabel).

    Arguments and input errors as in `hinfsyn`; ComputationError if the solver fails.
    """
    P, nmeas, ncon = as_plant(P, nmeas, ncon)
    plant = Plant.of(continuous_image(P), nmeas, ncon)
    check_stabilisable(plant)
    first = size = float(plant.size(plant.B1, plant.C1, plant.D11))
    best: LmiOptimum | None = None
    # The solver's tolerances are absolute: the norm is scaled by the last result until the result is 1.
    for _ in range(6):
        scaled = _balanced(_scaled(plant, size))
        R, S, bounds, status = _optimum(scaled)
        upper, violation, R, S = certified(scaled, R, S, bounds[1])
        if violation > 0:
            status = f"{status}, {UNCERTIFIED}"
        found = LmiOptimum(upper * size, min(bounds[0], upper) * size, R, S, violation, status)
        settled = best is not None and abs(found.upper - best.upper) < 1e-5 * best.upper
        if best is None or found.upper < best.upper:
            best = found
        if settled or found.upper < 1e-7 * first:
            break
        size = found.upper
    assert best is not None
    return best


def _balanced(plant: Plant) -> Plant:
    """LQG-balanced coordinates, in which both Riccati solutions of the plant's LQG problem are equal and diagonal.

    With this change of coordinates R and S have similar sizes, which diagonal balancing does not achieve
    (Jonckheere and Silverman, IEEE Trans. Automatic Control 28 (1983) 953-964).
    """
    B, C = np.hstack([plant.B1, plant.B2]), np.vstack([plant.C1, plant.C2])
    floor = 1e-8 * np.eye(plant.n)
    control = solve_riccati(plant.A, -plant.B2 @ plant.B2.T, C.T @ C + floor * la.norm(C, 2) ** 2)
    observer = solve_riccati(plant.A.T, -plant.C2.T @ plant.C2, B @ B.T + floor * la.norm(B, 2) ** 2)
    if not plant.n or control.X is None or observer.X is None:
        return plant
    (lx, x), (ly, y) = la.eigh(control.X), la.eigh(observer.X)
    if min(lx[0], ly[0]) <= 0:
        return plant
    U, s, Vt = la.svd((x * np.sqrt(lx)).T @ (y * np.sqrt(ly)))
    T, T_inverse = (y * np.sqrt(ly)) @ Vt.T / np.sqrt(s), (U / np.sqrt(s)).T @ (x * np.sqrt(lx)).T
    return replace(
        plant,
        A=T_inverse @ plant.A @ T,
        B1=T_inverse @ plant.B1,
        B2=T_inverse @ plant.B2,
        C1=plant.C1 @ T,
        C2=plant.C2 @ T,
    )


def _scaled(plant: Plant, size: float) -> Plant:
    """Time scaled by the geometric mean of the poles, and the norm by `size`, split equally between w and z."""
    poles = np.abs(la.eigvals(plant.A)) if plant.n else np.ones(1)
    rate = float(np.exp(np.mean(np.log(np.maximum(poles, 1e-3 * max(np.max(poles), 1e-12))))))
    root, half = np.sqrt(rate), np.sqrt(size)
    return replace(
        plant,
        A=plant.A / rate,
        B1=plant.B1 / root / half,
        B2=plant.B2 / root,
        C1=plant.C1 / root / half,
        C2=plant.C2 / root,
        D11=plant.D11 / size,
        D12=plant.D12 / half,
        D21=plant.D21 / half,
    )


def _optimum(plant: Plant) -> tuple[np.ndarray, np.ndarray, tuple[float, float], str]:
    import cvxpy

    cp: Any = cvxpy
    n = plant.n
    gamma = cp.Variable(nonneg=True)
    constraints, variables = [], []
    for A, B1, C1, D11, outer in _sides(plant):
        X = cp.Variable((n, n), symmetric=True)
        p, m = D11.shape
        inner = (
            cp.bmat(
                [[A @ X + X @ A.T, X @ C1.T, B1], [C1 @ X, -gamma * np.eye(p), D11], [B1.T, D11.T, -gamma * np.eye(m)]]
            )
            if n
            else cp.bmat([[-gamma * np.eye(p), D11], [D11.T, -gamma * np.eye(m)]])
        )
        projected = outer.T @ inner @ outer
        constraints.append((projected + projected.T) / 2 << 0)
        variables.append(X)
    if n:
        constraints.append(cp.bmat([[variables[0], np.eye(n)], [np.eye(n), variables[1]]]) >> 0)
    problem = cp.Problem(cp.Minimize(gamma), constraints)
    try:
        with warnings.catch_warnings():
            # An inaccurate solution is reported in `status`, and `upper` is verified by eigenvalues in any case.
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise ComputationError(
            "the linear matrix inequalities were not solved",
            measured=str(error),
            cause="a badly scaled plant",
            next_step="use the Riccati method",
        ) from error
    if gamma.value is None:
        raise ComputationError(
            "the linear matrix inequalities have no solution",
            measured=problem.status,
            cause="a badly scaled plant",
            next_step="use the Riccati method",
        )
    R, S = (np.asarray(X.value) if n else np.zeros((0, 0)) for X in variables)
    dual = _dual_value(plant, [np.asarray(one.dual_value) for one in constraints])
    return R, S, (dual, float(gamma.value)), str(problem.status)


def _dual_value(plant: Plant, multipliers: list[np.ndarray]) -> float:
    """Lower bound from the multipliers: constant term of the Lagrangian divided by its coefficient of gamma."""
    constant, weight = 0.0, 0.0
    for (_, B1, _, D11, N), Z in zip(_sides(plant), multipliers[:2], strict=True):
        p, m, n = *D11.shape, plant.n
        fixed = np.zeros((n + p + m, n + p + m))
        fixed[:n, n + p :], fixed[n : n + p, n + p :] = B1, D11
        spread = N @ Z @ N.T
        constant += float(np.sum((fixed + fixed.T) * spread))
        weight += float(np.trace(spread[n:, n:]))
    if plant.n:
        constant -= 2 * float(np.trace(multipliers[2][: plant.n, plant.n :]))
    return max(constant / weight, 0.0) if weight > 0 else 0.0


def _sides(plant: Plant) -> list[tuple[np.ndarray, ...]]:
    """(A, B1, C1, D11, N) of the inequality of R, and of that of S, which is the same for the transposed plant."""
    sides: list[tuple[np.ndarray, ...]] = []
    for A, B1, C1, D11, B2, D12 in (
        (plant.A, plant.B1, plant.C1, plant.D11, plant.B2, plant.D12),
        (plant.A.T, plant.C1.T, plant.B1.T, plant.D11.T, plant.C2.T, plant.D21.T),
    ):
        kernel = la.null_space(np.hstack([B2.T, D12.T]))
        sides.append((A, B1, C1, D11, la.block_diag(kernel, np.eye(D11.shape[1]))))
    return sides


def certified(plant: Plant, R: np.ndarray, S: np.ndarray, gamma: float) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Smallest gamma, from that of the solver upwards, at which the inequalities are verified; largest eigenvalue;
    the R and S of this verification."""
    coupling = la.eigvalsh(np.block([[R, np.eye(plant.n)], [np.eye(plant.n), S]])) if plant.n else np.ones(1)
    # R and S are shifted equally until [R I; I S] >= 0; gamma is then increased to compensate.
    lift = max(0.0, -float(coupling[0]) * (1 + 1e-6))
    R, S = R + lift * np.eye(plant.n), S + lift * np.eye(plant.n)
    worst = np.inf
    for step in (0.0, *(1e-9 * 4.0 ** np.arange(12))):
        level = gamma * (1 + step)
        worst = -np.inf
        for (A, B1, C1, D11, N), X in zip(_sides(plant), (R, S), strict=True):
            p, m = D11.shape
            inner = np.block(
                [[A @ X + X @ A.T, X @ C1.T, B1], [C1 @ X, -level * np.eye(p), D11], [B1.T, D11.T, -level * np.eye(m)]]
            )
            worst = max(worst, float(la.eigvalsh(N.T @ inner @ N)[-1]))
        if worst <= 0:
            return level, worst / max(level, 1e-300), R, S
    return gamma, worst / max(gamma, 1e-300), R, S
