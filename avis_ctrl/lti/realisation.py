"""State-space realisations: scaling, minimal realisation, balanced truncation, discretisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.bilinear import sampled_image
from avis_ctrl.lti.statespace import StateSpace


def balance(system: StateSpace) -> StateSpace:
    """Balance [A B; C 0] by a diagonal state scaling with powers of two; the transfer matrix is exactly unchanged."""
    n = system.nstates
    if not n:
        return system
    norm_B = np.linalg.norm(system.B, axis=1)
    norm_C = np.linalg.norm(system.C, axis=0)
    scale = np.ones(n)
    A = np.abs(system.A - np.diag(np.diag(system.A)))
    for _ in range(30):
        Ak = A / scale[:, None] * scale
        rows = np.sqrt(np.sum(Ak**2, axis=1) + (norm_B / scale) ** 2)
        cols = np.sqrt(np.sum(Ak**2, axis=0) + (norm_C * scale) ** 2)
        step = np.where((rows > 0) & (cols > 0), np.sqrt(np.divide(rows, cols, out=np.ones(n), where=cols > 0)), 1.0)
        step = 2.0 ** np.round(np.log2(step) * 0.8)
        if np.all(step == 1.0):
            break
        scale *= step
    return replace(system, A=system.A / scale[:, None] * scale, B=system.B / scale[:, None], C=system.C * scale)


def gramian_factors(system: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Square-root factors L_c, L_o of the controllability and observability Gramians of a stable system."""
    if not system.is_stable():
        poles = system.poles()
        raise ComputationError(
            "Gramians exist for stable systems only",
            measured=(
                f"largest magnitude of a pole {np.max(np.abs(poles)):.3g}"
                if system.dt
                else f"largest real part {np.max(poles.real):.3g} rad/s"
            ),
        )
    if system.dt:
        Wc = la.solve_discrete_lyapunov(system.A, system.B @ system.B.T)
        Wo = la.solve_discrete_lyapunov(system.A.T, system.C.T @ system.C)
    else:
        Wc = la.solve_continuous_lyapunov(system.A, -system.B @ system.B.T)
        Wo = la.solve_continuous_lyapunov(system.A.T, -system.C.T @ system.C)

    def factor(W: np.ndarray) -> np.ndarray:
        values, vectors = la.eigh((W + W.T) / 2)
        return vectors * np.sqrt(np.maximum(values, 0.0))

    return factor(Wc), factor(Wo)


def balanced_truncation(system: StateSpace, order: int | None = None, tolerance: float | None = None) -> StateSpace:
    """Balanced truncation (square-root method; Tombs and Postlethwaite 1987) of a stable system.

    Keeps at most `order` states, and only states whose Hankel singular value exceeds `tolerance` times the largest.
    The H-infinity norm of the error is at most twice the sum of the discarded Hankel singular values.
    """
    if not system.nstates:
        return system
    Lc, Lo = gramian_factors(balance(system))
    base = balance(system)
    U, sigma, Vt = la.svd(Lo.T @ Lc)
    limit = 1e-13 if tolerance is None else tolerance
    kept = int(np.sum(sigma > limit * sigma[0])) if sigma[0] > 0 else 0
    kept = min(order, kept) if order is not None else kept
    root = np.sqrt(sigma[:kept])
    T = Lc @ Vt[:kept].T / root
    Ti = (U[:, :kept] / root).T @ Lo.T
    return replace(system, A=Ti @ base.A @ T, B=Ti @ base.B, C=base.C @ T, states=())


def minimal(system: StateSpace, tolerance: float = 1e-9) -> StateSpace:
    """Remove uncontrollable and unobservable states (staircase algorithm by SVD on the balanced system)."""

    def reachable(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        limits = tuple(tolerance * float(np.linalg.norm(one, 2)) if one.size else 0.0 for one in (B, A))
        return reached(A, B, [A.shape[0]], limits)[0]

    if not system.nstates:
        return system
    base = balance(system)
    V = reachable(base.A, base.B)
    A, B, C = V.T @ base.A @ V, V.T @ base.B, base.C @ V
    W = reachable(A.T, C.T)
    return replace(system, A=W.T @ A @ W, B=W.T @ B, C=C @ W, states=())


def reached(A: np.ndarray, B: np.ndarray, sizes: list[int], limits: Sequence[float]) -> tuple[np.ndarray, list[int]]:
    """Smallest orthonormal block-diagonal V whose range contains B and A V, and its number of columns per block.

    sizes : rows of the blocks; one block of all states gives the reachable subspace. limits : singular values of B, and
    of what A adds, up to which they are round-off.
    """
    ends = [0, *np.cumsum(sizes)]
    blocks = [slice(start, stop) for start, stop in pairwise(ends)]
    bases = [np.zeros((size, 0)) for size in sizes]
    step, limit = B, limits[0]
    while True:
        fresh = []
        for k, block in enumerate(blocks):
            new = step[block]
            for _ in range(2):  # twice is enough for orthogonality to round-off
                new = new - bases[k] @ (bases[k].T @ new)
            Q, sigma, _ = np.linalg.svd(new, full_matrices=False)
            Q = Q[:, sigma > limit]
            bases[k] = np.hstack([bases[k], Q])
            fresh.append(A[:, block] @ Q)
        step = np.hstack([np.zeros((A.shape[0], 0)), *fresh])
        limit = limits[1]
        if not step.shape[1]:
            break
    V = np.zeros((A.shape[0], sum(basis.shape[1] for basis in bases)))
    columns = [0, *np.cumsum([basis.shape[1] for basis in bases])]
    for block, basis, (start, stop) in zip(blocks, bases, pairwise(columns), strict=True):
        V[block, start:stop] = basis
    return V, [basis.shape[1] for basis in bases]


def with_rate_input(system: StateSpace, name: str, times: int) -> StateSpace:
    """Add a second input v to a system of one input u, so that v acts as u = v/s^times, without adding integrators.

    If the system has a zero at s = 0, the transfer function divided by s is C inv(s I - A) inv(A) B: each zero cancels
    one integrator.

    Raises InputError if the system has fewer than `times` zeros at s = 0, or a pole there.
    """
    B, D, size = system.B, system.D, float(np.max(np.abs(system.frequency_response(np.ones(1)))))
    for _ in range(times):
        try:
            B = np.linalg.solve(system.A, B)
        except np.linalg.LinAlgError as error:
            raise InputError("a pole at zero frequency", field="rate input", value=name) from error
        if abs((D - system.C @ B).item()) > 1e-6 * size:
            raise InputError(f"expected {times} zeros at zero frequency", field="rate input", value=name)
        D = np.zeros((1, 1))
    return replace(system, B=np.hstack([system.B, B]), D=np.hstack([system.D, D]), inputs=(*system.inputs, name))


def discretise(system: StateSpace, dt: float, method: Literal["zoh", "tustin"] = "tustin") -> StateSpace:
    """Discretise with sample time dt [s], by a zero-order hold on the inputs ("zoh") or the bilinear map ("tustin").

    Raises InputError if the system is already sampled, dt is not positive, or the method is unknown.
    """
    if method not in ("zoh", "tustin"):
        raise InputError("expected 'zoh' or 'tustin'", field="method", value=method)
    if system.dt:
        raise InputError(f"the system is already sampled at {system.dt:g} s")
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"the sample time must be positive, not {dt!r}")
    n, m = system.nstates, system.ninputs
    if not n:
        return replace(system, dt=dt)
    if method == "zoh":
        block = la.expm(np.block([[system.A, system.B], [np.zeros((m, n + m))]]) * dt)
        return replace(system, A=block[:n, :n], B=block[:n, n:], dt=dt)
    # Keeps the units of the continuous states; the bilinear map alone would divide them by sqrt(dt).
    image = sampled_image(system, dt)
    return replace(image, B=image.B * np.sqrt(dt), C=image.C / np.sqrt(dt))
