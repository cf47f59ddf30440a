"""Random problems for hinfsyn, mu, mu_peak and worst_case_gain, each answer recomputed by another route.

    python -m benchmarks.random_plants --out FILE.jsonl [--count N] [--seed S] [--first I] [--jobs J] [--sb10ad K]
                                       [--sampled]

Problem i of a seed is always the same one. Orders are 2 to 60; D11 and D22 are not zero, modes lie near the imaginary
axis, signals and states are scaled by up to 1e8, parts are uncontrollable or unobservable, D12 or D21 loses rank,
blocks are real, complex, repeated and not square, and some systems are the bilinear image of a continuous one. With
--sampled every problem is posed in discrete time: poles anywhere in the z plane, at zero (delays) and near z = -1, and
musyn joins in. One line of FILE is written for each
problem; a run on the same file goes on where the last one ended. The table counts how each ended.

A problem is WRONG where

    the measured gamma is not the norm of F_l(P, K): stability from the poles of a loop formed here, the norm from
        SLICOT's AB13DD and from P(jw), K(jw) closed pointwise (the larger of the two; the tolerance is 1e-3);
    a bracket wider than 1 per cent is reported as the optimum;
    the bracket's lower end is above that norm, or the bracket misses that of the plant before it was scaled and
        padded, or for every fourth problem that of the transposed plant or the optimum of the matrix inequalities
        (an upper end that a controller keeps by AB13DD is right whatever these say);
    I - M Delta is not singular, Delta has not its structure or its norm, or a bound of mu is passed by a perturbation;
    musyn's bound is below mu of its loop at a frequency, by AB13MD where that takes the blocks;
    an exception is neither InputError nor ComputationError.

--sb10ad K: every K-th synthesis of low order is also given to SLICOT's SB10AD (python-control's hinfsyn); its claims
are counted.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, discretise
from avis_ctrl.robust.hinf_lmi import lmi_gamma
from avis_ctrl.robust.hinfsyn import Status, hinf_suboptimal, hinfsyn
from avis_ctrl.robust.mu import mu
from avis_ctrl.robust.mu_peak import mu_peak, worst_case_gain
from avis_ctrl.robust.musyn import musyn
from avis_ctrl.robust.slycot_adapter import hinf_norm_slicot, mu_upper_slicot
from avis_ctrl.uncertainty.blocks import Block, BlockStructure, ComplexFull, ComplexScalar, RealScalar

SAME = 1e-3  # relative difference from which two computations of one figure are called different
SB10AD_ORDER = 12  # it takes minutes above
LIMIT_S = 120  # seconds after which a problem counts as hung


# -- problems -------------------------------------------------------------------------------------


def order(rng: np.random.Generator) -> int:
    """Most are small, some have up to 60 states."""
    return int(np.clip(np.round(2 * 30 ** (rng.uniform() ** 3)), 2, 60))


def dynamics(rng: np.random.Generator, n: int, stable: bool) -> np.ndarray:
    """A of modes over up to four decades, damping down to 1e-6, real poles between, in random coordinates."""
    blocks: list[np.ndarray] = []
    decades, left = rng.uniform(0, 4), n
    least = rng.choice([1e-1, 1e-2, 1e-4, 1e-6])
    while left:
        w = 10.0 ** rng.uniform(-decades / 2, decades / 2)
        sign = 1.0 if not stable and rng.uniform() < 0.15 else -1.0
        if left == 1 or rng.uniform() < 0.3:
            blocks.append(np.array([[sign * w]]))
        else:
            zeta = 10.0 ** rng.uniform(np.log10(least), 0)
            blocks.append(np.array([[0, w], [-w, 2 * sign * zeta * w]]))
        left -= blocks[-1].shape[0]
    A = la.block_diag(*blocks)
    Q = la.qr(rng.standard_normal((n, n)))[0]
    return Q.T @ A @ Q


def sampled_dynamics(rng: np.random.Generator, n: int, stable: bool) -> np.ndarray:
    """A in discrete time: modes of any frequency up to half the rate, radius up to 1 - 1e-6, real poles, delays."""
    blocks: list[np.ndarray] = []
    left = n
    least = rng.choice([1e-1, 1e-2, 1e-4, 1e-6])
    while left:
        draw, outside = rng.uniform(), not stable and rng.uniform() < 0.15
        away = 10.0 ** rng.uniform(np.log10(least), 0)
        radius = 1 / (1 - 0.9 * away) if outside else 1 - 0.9 * away
        if draw < 0.15:
            # A delay of up to three samples: nilpotent, its poles all at zero.
            k = min(left, int(rng.integers(1, 4)))
            blocks.append(np.eye(k, k=1))
        elif left == 1 or draw < 0.35:
            blocks.append(np.array([[radius * rng.choice([-1.0, 1.0])]]))
        else:
            angle = np.pi * rng.uniform() ** rng.choice([1, 4])
            c, s = radius * np.cos(angle), radius * np.sin(angle)
            blocks.append(np.array([[c, s], [-s, c]]))
        left -= blocks[-1].shape[0]
    A = la.block_diag(*blocks)
    Q = la.qr(rng.standard_normal((n, n)))[0]
    return Q.T @ A @ Q


def transformed(rng: np.random.Generator, P: StateSpace, u: int, y: int) -> tuple[StateSpace, list[str]]:
    """The same problem in other units and with superfluous states: its optimum is that of P."""
    done = []
    if rng.uniform() < 0.4:
        d = 10.0 ** rng.uniform(-1, 1, P.nstates) ** 1 if rng.uniform() < 0.5 else 10.0 ** rng.uniform(-4, 4, P.nstates)
        P = P.similar(np.diag(d))
        done.append("states scaled")
    if rng.uniform() < 0.4:
        left, right = np.ones(P.noutputs), np.ones(P.ninputs)
        left[-y:], right[-u:] = 10.0 ** rng.uniform(-4, 4, y), 10.0 ** rng.uniform(-4, 4, u)
        P = P.scaled(left, right)
        done.append("u and y scaled")
    if rng.uniform() < 0.3:
        # A copy of the states' own dynamics or other stable modes that no input moves, or that no output sees.
        modes = sampled_dynamics if P.dt else dynamics
        extra = P.A if rng.uniform() < 0.3 and P.is_stable() else modes(rng, int(rng.integers(1, 4)), True)
        k, n = extra.shape[0], P.nstates
        into, out = rng.standard_normal((n, k)), rng.standard_normal((k, n))
        kind = rng.choice(["uncontrollable", "unobservable"])
        if kind == "uncontrollable":
            A = np.block([[P.A, into], [np.zeros((k, n)), extra]])
            B, C = np.vstack([P.B, np.zeros((k, P.ninputs))]), np.hstack([P.C, rng.standard_normal((P.noutputs, k))])
        else:
            A = np.block([[P.A, np.zeros((n, k))], [out, extra]])
            B, C = np.vstack([P.B, rng.standard_normal((k, P.ninputs))]), np.hstack([P.C, np.zeros((P.noutputs, k))])
        T = la.qr(rng.standard_normal((n + k, n + k)))[0] if rng.uniform() < 0.7 else np.eye(n + k)
        P = StateSpace(T.T @ A @ T, T.T @ B, C @ T, P.D, P.dt)
        done.append(str(kind))
    return P, done


def plant(rng: np.random.Generator, sampled: bool = False) -> tuple[StateSpace, StateSpace, int, int, list[str]]:
    """(P as posed, the plain plant with the same optimum, ncon, nmeas, what was done)."""
    n = order(rng)
    modes, dt = (sampled_dynamics, 10.0 ** rng.uniform(-4, 1)) if sampled else (dynamics, 0.0)
    u, y = (int(k) for k in rng.integers(1, 4, 2))
    z, w = u + int(rng.integers(0, 4)), y + int(rng.integers(0, 4))
    tags = []
    A = modes(rng, n, bool(rng.uniform() < 0.6))
    B, C = rng.standard_normal((n, w + u)), rng.standard_normal((z + y, n))
    D = rng.standard_normal((z + y, w + u)) * 10.0 ** rng.uniform(-2, 1)
    D[:z, :w] *= rng.choice([0, 0, 0.1, 1])
    D[z:, w:] *= rng.choice([0, 0, 0.1, 1])
    fate = rng.uniform()
    if fate < 0.08:
        D[:z, w:], tags = 0.0, ["D12 zero"]
    elif fate < 0.16:
        D[z:, :w], tags = 0.0, ["D21 zero"]
    elif fate < 0.2:
        D[:], tags = 0.0, ["D zero"]
    elif fate < 0.3:
        # Disturbances that reach the plant only where the measurement shows them exactly: Y is zero (or singular).
        B[:, y:w], D[z:, :w], tags = 0.0, np.eye(y, w), ["Y singular"]
    elif fate < 0.4:
        # Half of the states do not enter z: X is singular.
        keep = rng.uniform(size=n) < 0.5
        A[np.ix_(~keep, keep)] = 0.0
        A[np.ix_(keep, ~keep)] = 0.0
        C[:z, ~keep], tags = 0.0, ["X singular"]
    base = StateSpace(A, B, C, D, dt)
    P, more = transformed(rng, base, u, y)
    if not sampled and rng.uniform() < 0.1:
        P = discretise(P, float(0.1 / np.max(np.abs(base.poles()))), "tustin")
        more = [*more, "sampled"]
    return P, base, u, y, tags + more


def structure(rng: np.random.Generator) -> BlockStructure:
    """One to four blocks, real or complex, repeated, full and not square."""
    blocks = []
    for _ in range(int(rng.integers(1, 5))):
        kind, size = rng.choice(["real", "complex", "full"]), int(rng.integers(1, 4))
        if kind == "real":
            blocks.append(RealScalar(size))
        elif kind == "complex":
            blocks.append(ComplexScalar(size))
        else:
            blocks.append(ComplexFull(size, int(rng.integers(1, 4))))
    return BlockStructure.of(blocks)


def loop(rng: np.random.Generator, n_out: int, n_in: int, sampled: bool = False) -> StateSpace:
    """A stable system whose gain is of the order of one."""
    n = min(order(rng), 24)
    A = sampled_dynamics(rng, n, True) if sampled else dynamics(rng, n, True)
    dt = 10.0 ** rng.uniform(-4, 1) if sampled else 0.0
    root = np.sqrt(np.abs(la.eigvals(A)).mean())
    N = StateSpace(
        A,
        root * rng.standard_normal((n, n_in)),
        root * rng.standard_normal((n_out, n)),
        rng.standard_normal((n_out, n_in)) * rng.choice([0, 0.1, 1]),
        dt,
    )
    omega = np.abs(np.angle(N.poles())) / dt if dt else np.abs(N.poles())
    size = float(np.max(np.linalg.norm(N.frequency_response(omega), 2, axis=(1, 2))))
    return N.scaled(left=10.0 ** rng.uniform(-1, 0.5) / size)


# -- the other route ------------------------------------------------------------------------------


def closed(P: StateSpace, K: StateSpace) -> StateSpace:
    """F_l(P, K), formed here."""
    u, y = K.noutputs, K.ninputs
    w, z = P.ninputs - u, P.noutputs - y
    B1, B2, C1, C2 = P.B[:, :w], P.B[:, w:], P.C[:z], P.C[z:]
    D11, D12, D21, D22 = P.D[:z, :w], P.D[:z, w:], P.D[z:, :w], P.D[z:, w:]
    # u = M (D_K C2 x + C_K x_K + D_K D21 w), M = inv(I - D_K D22)
    M = la.inv(np.eye(u) - K.D @ D22)
    Ux, Uk, Uw = M @ K.D @ C2, M @ K.C, M @ K.D @ D21
    A = np.block([[P.A + B2 @ Ux, B2 @ Uk], [K.B @ (C2 + D22 @ Ux), K.A + K.B @ D22 @ Uk]])
    B = np.vstack([B1 + B2 @ Uw, K.B @ (D21 + D22 @ Uw)])
    return StateSpace(A, B, np.hstack([C1 + D12 @ Ux, D12 @ Uk]), D11 + D12 @ Uw, P.dt)


def at(system: StateSpace, omega: float) -> np.ndarray:
    """Response at one frequency by elimination on the balanced system."""
    if not system.nstates or np.isinf(omega):
        return system.D.astype(complex)
    point = np.exp(1j * omega * system.dt) if system.dt else 1j * omega
    A, (d, _) = la.matrix_balance(system.A, permute=False, separate=True)
    return (system.C * d) @ np.linalg.solve(
        point * np.eye(system.nstates) - A, (system.B / d[:, None]).astype(complex)
    ) + system.D


def pointwise(P: StateSpace, K: StateSpace, omegas: np.ndarray) -> float:
    """Largest gain of F_l(P, K) over frequencies, P and K evaluated apart."""
    u, y = K.noutputs, K.ninputs
    w, z = P.ninputs - u, P.noutputs - y
    best = 0.0
    for omega in omegas:
        p, k = at(P, omega), at(K, omega)
        if not (np.all(np.isfinite(p)) and np.all(np.isfinite(k))):
            continue
        p11, p12, p21, p22 = p[:z, :w], p[:z, w:], p[z:, :w], p[z:, w:]
        best = max(best, float(la.norm(p11 + p12 @ np.linalg.solve(np.eye(u) - k @ p22, k @ p21), 2)))
    return best


def frequencies(*systems: StateSpace, count: int = 300) -> np.ndarray:
    """A grid over all poles, and the poles themselves."""
    poles = np.concatenate([s.poles() for s in systems])
    if systems[0].dt:
        dt = systems[0].dt
        return np.concatenate([np.linspace(0, np.pi / dt, count), np.abs(np.angle(poles)) / dt])
    sizes = np.abs(poles[poles != 0])
    grid = np.geomspace(sizes.min() / 30, sizes.max() * 30, count) if sizes.size else np.ones(1)
    return np.concatenate([[0.0, np.inf], grid, sizes, np.abs(poles.imag)])


def in_doubt(r: Any) -> bool:
    """Whether the synthesis itself reports round-off in its gamma."""
    return any("round-off shows in gamma" in note for note in r.notes)


def size(P: StateSpace, u: int, y: int) -> float:
    """The gain relative to which F_l(P, K) is judged to be zero: |P11| + |P12| |P21|, median over frequencies."""
    z, w = P.noutputs - y, P.ninputs - u
    responses = [at(P, omega) for omega in frequencies(P, count=20)]
    return float(np.median([la.norm(p[:z, :w], 2) + la.norm(p[:z, w:], 2) * la.norm(p[z:, :w], 2) for p in responses]))


def judge_synthesis(P: StateSpace, base: StateSpace, u: int, y: int, r: Any, second: bool) -> list[str]:
    """What is wrong with a synthesis; `second`: other opinions on the bracket, too."""
    wrong = []
    own = closed(P, r.K)
    tiny = 1e-8 * size(base, u, y)
    balanced = la.matrix_balance(own.A, permute=False)[0] if own.nstates else own.A
    poles = la.eigvals(balanced) if own.nstates else np.zeros(0)
    margin = np.max(np.abs(poles) - 1 if P.dt else poles.real, initial=-1.0)
    if margin >= 0:
        wrong.append(f"unstable: {margin:.2e}")
    on_grid = pointwise(P, r.K, frequencies(P, own))
    norm = on_grid
    if margin < 0:
        with contextlib.suppress(ComputationError):
            norm = max(norm, hinf_norm_slicot(own))
        if norm > on_grid * (1 + SAME):
            # Either a peak between the points or round-off of poles that are far apart: more points decide.
            on_grid = pointwise(P, r.K, frequencies(P, own, count=10_000))
            norm = min(norm, max(on_grid, r.gamma))
    if in_doubt(r):
        norm = min(norm, on_grid)
    elif not r.gamma >= norm * (1 - SAME) - tiny:
        wrong.append(f"gamma {r.gamma:.6g} below the norm {norm:.6g} ({on_grid:.6g} on the grid)")
    if not in_doubt(r) and not r.gamma <= norm * (1 + 10 * SAME) + tiny:
        wrong.append(f"gamma {r.gamma:.6g} above the norm {norm:.6g}")
    lower, upper = r.gamma_optimal_bounds
    if not lower <= upper * (1 + 1e-9):
        wrong.append(f"bracket {lower:.6g}..{upper:.6g} upside down")
    if r.status is Status.OPTIMAL and upper > tiny and lower < 0.99 * upper:
        wrong.append(f"bracket {lower:.6g}..{upper:.6g} reported as the optimum")
    if lower > norm * (1 + 1e-6) + tiny:
        wrong.append(f"lower bound {lower:.6g} above the norm {norm:.6g} of its own loop")
    others: list[tuple[str, float, float]] = []
    references = [("plain", base, u, y)] if base is not P else []
    if second:
        references.append(("transposed", StateSpace(base.A.T, base.C.T, base.B.T, base.D.T, base.dt), y, u))
    for name, other, a, b in references:
        try:
            s = hinfsyn(other, b, a)
        except ComputationError:
            continue
        others.append((name, s.gamma_optimal_bounds[0], min(s.gamma_optimal_bounds[1], s.gamma)))
    if second and base.nstates <= 8:
        try:
            o = lmi_gamma(base, y, u)
            if o.violation <= 0 and o.lower >= 0.99 * o.upper:
                others.append(("inequalities", o.lower, o.upper))
        except ComputationError:
            pass
    for name, low, high in others:
        if lower > high * (1 + SAME) + tiny:
            wrong.append(f"lower bound {lower:.6g} above {high:.6g} reached: {name}")
        if low > min(upper, norm) * (1 + SAME) + 100 * tiny and not confirmed(base, u, y, upper):
            wrong.append(f"upper bound {upper:.6g} (norm {norm:.6g}) below what is possible, {low:.6g}: {name}")
    return wrong


def confirmed(base: StateSpace, u: int, y: int, upper: float) -> bool:
    """Whether a controller at an upper bound keeps it by AB13DD: then it is the other opinion that is wrong."""
    with contextlib.suppress(ComputationError):
        loop = closed(base, hinf_suboptimal(base, y, u, upper * (1 + SAME / 2)).K)
        return bool(loop.is_stable() and hinf_norm_slicot(loop) <= upper * (1 + SAME))
    return False


def judge_delta(N: np.ndarray, blocks: BlockStructure, lower: float, delta: np.ndarray | None) -> list[str]:
    """What is wrong with a perturbation said to make I - N Delta singular."""
    if lower == 0:
        return []
    if delta is None:
        return ["no perturbation for a lower bound above zero"]
    wrong = [] if blocks.contains(delta) else ["the perturbation has not the structure"]
    if not np.isclose(la.norm(delta, 2), 1 / lower, rtol=1e-6):
        wrong.append(f"norm of the perturbation {la.norm(delta, 2):.6g}, not {1 / lower:.6g}")
    # The eigenvalue of N Delta nearest to 1: the determinant's own measure, free of units.
    away = float(np.min(np.abs(la.eigvals(N @ delta) - 1)))
    if away > 1e-6:
        wrong.append(f"I - M Delta is not singular: an eigenvalue is {away:.1e} from 1")
    return wrong


def passed_by_a_sample(M: np.ndarray, blocks: BlockStructure, rng: np.random.Generator) -> float:
    """A lower bound of mu: the largest real spectral radius of M Delta (any radius where nothing is real)."""
    best = 0.0
    some_real = any(b.kind == "real" for b in blocks.blocks)
    for _ in range(60):
        values = la.eigvals(M @ blocks.random(rng))
        if some_real:
            values = values[np.abs(values.imag) < 1e-9 * np.abs(values)]
        best = max(best, float(np.max(np.abs(values), initial=0.0)))
    return best


# -- one problem ----------------------------------------------------------------------------------


def solve(seed: int, index: int, sampled: bool = False) -> dict[str, Any]:
    """Pose, answer and judge problem `index`, of those in discrete time where `sampled`."""
    rng = np.random.default_rng([seed, index, 1] if sampled else [seed, index])
    # Matrices have no clock; their part goes to mu synthesis.
    second = "musyn" if sampled else "mu"
    kind = rng.choice(
        ["hinfsyn", second, "mu_peak", "worst_case_gain"],
        p=[0.6, 0.05, 0.21, 0.14] if sampled else [0.6, 0.2, 0.12, 0.08],
    )
    out: dict[str, Any] = {"index": index, "kind": str(kind), "wrong": []}
    began = time.perf_counter()
    try:
        if kind == "hinfsyn":
            P, base, u, y, tags = plant(rng, sampled)
            out |= {"n": P.nstates, "tags": tags}
            r = hinfsyn(P, y, u, far_poles="gain" if index % 2 else "kept")
            said = ", gamma said to be round-off" if in_doubt(r) else ""
            out |= {
                "status": r.status.name + said,
                "gamma": r.gamma,
                "bounds": list(r.gamma_optimal_bounds),
                "fastest": r.fastest_pole,
                "plant_fastest": float(np.max(np.abs(base.poles()))),
                "seconds": time.perf_counter() - began,
            }
            out["wrong"] = judge_synthesis(P, base, u, y, r, index % 4 == 0)
        elif kind == "musyn":
            P, blocks = uncertain_plant(rng)
            r = musyn(P, blocks, 1, 1, max_iterations=4)
            out |= {
                "n": P.nstates,
                "status": "proved" if r.guaranteed else "not proved",
                "gamma": r.mu_upper,
                "bounds": [r.mu_lower, r.mu_upper],
                "seconds": time.perf_counter() - began,
            }
            out["wrong"] = judge_mu_synthesis(P, r)
        elif kind == "mu":
            blocks = structure(rng)
            M = rng.standard_normal((blocks.n_z, blocks.n_w)) + 1j * rng.standard_normal((blocks.n_z, blocks.n_w))
            if rng.uniform() < 0.3:
                M = M.real
            M = M * 10.0 ** rng.uniform(-8, 8)
            b = mu(M, blocks)
            out |= {
                "n": M.shape[0],
                "status": "tight" if b.lower > 0.99 * b.upper else "gap",
                "gamma": float(b.upper),
                "bounds": [float(b.lower), float(b.upper)],
                "seconds": time.perf_counter() - began,
            }
            wrong = judge_delta(M, blocks, float(b.lower), b.delta)
            if b.lower > b.upper * (1 + 1e-6):
                wrong.append(f"bounds {b.lower:.6g} > {b.upper:.6g}")
            low = passed_by_a_sample(M, blocks, rng)
            if low > b.upper * (1 + 1e-9):
                wrong.append(f"a perturbation of norm {1 / low:.6g} passes the upper bound {b.upper:.6g}")
            left = b.upper**2 * b.D_w @ b.D_w.conj().T - M.conj().T @ b.D.conj().T @ b.D @ M
            left = left - 1j * (b.G @ M - M.conj().T @ b.G.conj().T)
            size = b.upper**2 * la.norm(b.D_w, 2) ** 2 + la.norm(b.G @ M, 2)
            if la.eigvalsh((left + left.conj().T) / 2)[0] < -1e-7 * size:
                wrong.append("the scalings do not prove the upper bound")
            out["wrong"] = wrong
        else:
            blocks = structure(rng)
            extra = (int(rng.integers(1, 3)), int(rng.integers(1, 3))) if kind == "worst_case_gain" else (0, 0)
            N = loop(rng, blocks.n_z + extra[0], blocks.n_w + extra[1], sampled)
            if not sampled and rng.uniform() < 0.15:
                N = discretise(N, float(0.1 / np.max(np.abs(N.poles()))), "tustin")
            out |= {"n": N.nstates}
            p = mu_peak(N, blocks) if kind == "mu_peak" else worst_case_gain(N, blocks)
            out |= {
                "status": ("proved" if p.guaranteed else "not proved") if np.isfinite(p.upper) else "not robust",
                "gamma": p.upper,
                "bounds": [p.lower, p.upper],
                "seconds": time.perf_counter() - began,
            }
            out["wrong"] = judge_peak(N, blocks, p, rng)
    except (ComputationError, InputError) as error:
        out |= {
            "status": f"{type(error).__name__}: {str(error).split(':')[0].split('(')[0][:60].strip()}",
            "said": str(error)[:300],
        }
    out.setdefault("seconds", time.perf_counter() - began)
    return out


def uncertain_plant(rng: np.random.Generator) -> tuple[StateSpace, list[Block]]:
    """A small sampled plant with one or two scalar blocks, one w, z = (error, effort), one u and one noisy y."""
    n, k = int(rng.integers(2, 7)), int(rng.integers(1, 3))
    A = sampled_dynamics(rng, n, bool(rng.uniform() < 0.7))
    B, C = rng.standard_normal((n, k + 3)), rng.standard_normal((k + 3, n))
    D = 0.1 * rng.standard_normal((k + 3, k + 3))
    D[:k], D[:, :k], C[:k] = 0.1 * D[:k], 0.1 * D[:, :k], 0.1 * C[:k]
    D[k + 1, k + 2], D[k + 2, k + 1] = 1.0, 0.3
    return (
        StateSpace(A, B, C, D, 10.0 ** rng.uniform(-4, 1)),
        [RealScalar() if rng.uniform() < 0.5 else ComplexScalar() for _ in range(k)],
    )


def judge_mu_synthesis(P: StateSpace, r: Any) -> list[str]:
    """What is wrong with musyn's answer: its loop is formed here, its complex mu computed by AB13MD on a grid."""
    own = closed(P, r.K)
    margin = np.max(np.abs(own.poles())) - 1
    wrong = [] if margin < 0 else [f"unstable: {margin:.2e}"]
    if r.K.dt != P.dt:
        wrong.append(f"sample time {r.K.dt}")
    complexified = r.blocks.complexified()
    # Its performance block is 1 x 2, which AB13MD takes only when it is filled up with zeros.
    square = BlockStructure.of([*complexified.blocks[:-1], ComplexFull(2)])
    reached = 0.0
    for omega in frequencies(own, count=60):
        M = at(own, omega)
        reached = max(reached, mu_upper_slicot(np.hstack([M, np.zeros((M.shape[0], 1))]), square))
    if reached > r.mu_upper_complex * (1 + SAME):
        wrong.append(f"complex mu {reached:.6g} on the grid above the bound {r.mu_upper_complex:.6g}")
    if r.mu_upper > r.mu_upper_complex * (1 + 1e-9) or r.mu_lower > r.mu_upper * (1 + 1e-6):
        wrong.append(f"bounds {r.mu_lower:.6g}, {r.mu_upper:.6g}, {r.mu_upper_complex:.6g} out of order")
    return wrong + (judge_delta(at(own, r.omega_peak), r.blocks, r.mu_lower, r.delta))


def judge_peak(N: StateSpace, blocks: BlockStructure, p: Any, rng: np.random.Generator) -> list[str]:
    """What is wrong with mu_peak's or worst_case_gain's answer."""
    wrong = []
    gain = N.noutputs > blocks.n_z
    if p.lower > p.upper * (1 + 1e-6):
        wrong.append(f"bounds {p.lower:.6g} > {p.upper:.6g}")
    N11 = N.select(range(blocks.n_z), range(blocks.n_w))
    if not gain or np.isinf(p.lower):
        if gain:
            size = float(la.norm(p.delta, 2))
            if size > 1 + 1e-9:
                wrong.append(f"a destabilising perturbation of norm {size:.6g}")
            wrong += judge_delta(at(N11, p.omega), blocks, 1 / size, p.delta)
        else:
            wrong += judge_delta(at(N11, p.omega), blocks, p.lower, p.delta)
        if gain:
            return wrong
    elif p.lower > 0:
        if la.norm(p.delta, 2) > 1 + 1e-9 or not blocks.contains(p.delta):
            wrong.append("the perturbation is too large or has not the structure")
        M = at(N, p.omega)
        z, w = blocks.n_z, blocks.n_w
        e = M[z:, w:] + M[z:, :w] @ p.delta @ np.linalg.solve(np.eye(z) - M[:z, :w] @ p.delta, M[:z, w:])
        if not np.isclose(la.norm(e, 2), p.lower, rtol=1e-6):
            wrong.append(f"gain {la.norm(e, 2):.6g} under the perturbation, not {p.lower:.6g}")
    if np.isfinite(p.upper):
        for omega in frequencies(N, count=40):
            M = at(N, omega)
            for _ in range(4):
                delta = blocks.random(rng)
                size = la.norm(delta, 2)
                if gain:
                    z, w = blocks.n_z, blocks.n_w
                    delta = delta / size
                    e = M[z:, w:] + M[z:, :w] @ delta @ np.linalg.solve(np.eye(z) - M[:z, :w] @ delta, M[:z, w:])
                    found = float(la.norm(e, 2))
                else:
                    values = la.eigvals(M @ delta / size)
                    if any(b.kind == "real" for b in blocks.blocks):
                        values = values[np.abs(values.imag) < 1e-9 * np.abs(values)]
                    found = float(np.max(np.abs(values), initial=0.0))
                if found > p.upper * (1 + 1e-6):
                    wrong.append(f"{found:.6g} at {omega:.6g} rad/s passes the upper bound {p.upper:.6g}")
                    return wrong
    return wrong


def _alarm(_signal: int, _frame: Any) -> None:
    raise TimeoutError


def timed(seed: int, index: int, sampled: bool) -> dict[str, Any]:
    """`solve` with a time limit; other exceptions are a result, a wrong one."""
    signal.signal(signal.SIGALRM, _alarm)
    signal.alarm(LIMIT_S)
    try:
        with np.errstate(all="ignore"):
            return solve(seed, index, sampled)
    except TimeoutError:
        return {"index": index, "kind": "any", "status": "HUNG", "wrong": [f"longer than {LIMIT_S} s"]}
    except Exception as error:  # what nobody meant to raise is what this looks for
        return {"index": index, "kind": "any", "status": "CRASHED", "wrong": [f"{type(error).__name__}: {error}"[:300]]}
    finally:
        signal.alarm(0)


# -- SLICOT beside it -----------------------------------------------------------------------------


def _sb10ad(seed: int, index: int, queue: Any) -> None:
    import control

    rng = np.random.default_rng([seed, index])
    rng.choice(4, p=[0.6, 0.2, 0.12, 0.08])
    P, _, u, y, _ = plant(rng)
    try:
        K, _, gamma, _ = control.hinfsyn(P.to_control(), y, u)
        K = StateSpace.from_control(K)
        own = closed(P, K)
        stable = np.max(la.eigvals(la.matrix_balance(own.A, permute=False)[0]).real, initial=-1.0) < 0
        norm = max(hinf_norm_slicot(own), pointwise(P, K, frequencies(P, own))) if stable else np.inf
        queue.put((float(gamma), float(norm), ""))
    except Exception as error:  # whatever it raises is its answer
        queue.put((np.nan, np.nan, f"{type(error).__name__}"))


def sb10ad(seed: int, index: int, limit: float = 20.0) -> dict[str, Any]:
    """SB10AD in a process of its own: it cannot be interrupted."""
    queue: Any = multiprocessing.Queue()
    process = multiprocessing.Process(target=_sb10ad, args=(seed, index, queue))
    process.start()
    try:
        gamma, norm, said = queue.get(timeout=limit)
        end = said or (
            "unstable"
            if np.isinf(norm)
            else "wrong gamma"
            if abs(norm / gamma - 1) > 10 * SAME and norm > gamma
            else "right"
        )
    except Exception:  # queue.Empty
        gamma = norm = np.nan
        end = "crash" if process.exitcode not in (None, 0) else "time limit"
        process.terminate()
    process.join()
    return {"gamma": gamma, "norm": norm, "end": end}


# -- run ------------------------------------------------------------------------------------------


def _work(task: tuple[int, int, bool]) -> dict[str, Any]:
    return timed(*task)


def read(path: Path) -> Iterator[dict[str, Any]]:
    """The lines written so far (a last one cut short is left out)."""
    if path.exists():
        for line in path.read_text().splitlines():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                continue


def table(rows: list[dict[str, Any]]) -> str:
    """Statuses by kind, with the number of wrong ones and the time."""
    lines = [f"{'kind':16s} {'status':64s} {'count':>6s} {'wrong':>6s} {'median s':>9s} {'longest s':>9s}"]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = collections.defaultdict(list)
    for row in rows:
        groups[row["kind"], row["status"]].append(row)
    for (kind, status), found in sorted(groups.items()):
        seconds = [row.get("seconds", np.nan) for row in found]
        lines.append(
            f"{kind:16s} {status:64s} {len(found):6d} {sum(bool(row['wrong']) for row in found):6d} "
            f"{np.median(seconds):9.3f} {np.max(seconds):9.2f}"
        )
    lines.append(f"{'all':16s} {'':64s} {len(rows):6d} {sum(bool(row['wrong']) for row in rows):6d}")
    ends = collections.Counter(row["sb10ad"]["end"] for row in rows if "sb10ad" in row)
    if ends:
        lines.append("SB10AD: " + ", ".join(f"{count} {end}" for end, count in ends.most_common()))
    return "\n".join(lines)


def main() -> None:
    """Run what is missing from the file, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="lines of JSON, outside the repository")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first problem")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--sb10ad", type=int, default=0, metavar="K", help="every K-th synthesis to SLICOT, too")
    parser.add_argument("--sampled", action="store_true", help="problems in discrete time, in a file of their own")
    asked = parser.parse_args()
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    done = {row["index"] for row in read(asked.out)}
    todo = [(asked.seed, k, asked.sampled) for k in range(asked.first, asked.first + asked.count) if k not in done]
    with asked.out.open("a") as file, multiprocessing.Pool(asked.jobs) as pool:
        for row in pool.imap_unordered(_work, todo):
            if (
                asked.sb10ad
                and row["kind"] == "hinfsyn"
                and row["index"] % asked.sb10ad == 0
                and row["n"] <= SB10AD_ORDER
                and not asked.sampled
                and "sampled" not in row["tags"]
            ):
                row["sb10ad"] = sb10ad(asked.seed, row["index"])
            file.write(json.dumps(row) + "\n")
            file.flush()
            if row["wrong"]:
                print(
                    row["index"],
                    row["kind"],
                    row["status"],
                    row.get("n"),
                    row.get("tags", ""),
                    row["wrong"],
                    flush=True,
                )
    print(table(list(read(asked.out))))


if __name__ == "__main__":
    main()
