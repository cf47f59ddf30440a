"""Controller order reduction: the cost of each step is measured, not assumed.

Balanced truncation bounds the error of K itself, but the closed loop matters. A reduced controller is therefore
accepted only if the caller's figure of merit (gamma, mu, ...) grows by no more than allowed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, balanced_truncation, hinf_norm, lft_lower
from avis_ctrl.robust.hinf_plant import as_plant


@dataclass(frozen=True)
class LagSettings:
    """Fit of `replace_fast_by_lags`.

    kept : poles slower than this fraction of the corner frequency are kept.
    lowest, points : the fit uses `points` logarithmically spaced frequencies from `lowest` times the corner to the
        corner. They begin far below the corner, because fast poles contribute phase there.
    """

    kept: float = 2 / 3
    lowest: float = 1 / 500
    points: int = 60


LAGS = LagSettings()


def closed_loop_gamma(P: StateSpace, K: StateSpace) -> float:
    """H-infinity norm of F_l(P, K); inf if it is unstable."""
    return hinf_norm(lft_lower(P, K)).gain


def reduce_controller(
    P: Any,
    K: StateSpace,
    measure: Callable[[StateSpace], float] | None = None,
    growth: float = 0.01,
    orders: range | None = None,
    limit: float | None = None,
) -> StateSpace:
    """The controller of lowest order whose figure of merit grows by at most `growth` (relative).

    Parameters
    ----------
    P : generalized plant, u and y last; a candidate must stabilise it.
    K : controller; its unstable part is kept, its stable part is reduced by balanced truncation.
    measure : figure of merit of a controller, smaller is better; default: H-infinity norm of the closed loop.
    growth : allowed relative growth of the figure.
    orders : candidate orders; default: all from that of the unstable part to that of K. They are searched by bisection:
        the next lower order was tried and failed, but not every order is tried.
    limit : maximum figure of a reduced controller, instead of `growth`. `measure` then has to be exact only above the
        limit; figures below it are upper bounds. If no reduced controller stays within the limit, K is returned.

    Raises
    ------
    InputError : negative growth, or a K that does not fit P or does not stabilise it.
    """
    P, _, _ = as_plant(P, K.ninputs, K.noutputs)
    if not (np.isfinite(growth) and growth >= 0):
        raise InputError("expected a number of at least 0, such as 0.01", field="growth", value=growth)
    figure = measure or (lambda candidate: closed_loop_gamma(P, candidate))
    if not lft_lower(P, K).is_stable():
        raise InputError("the controller to reduce does not stabilise the plant", field="K", value=repr(K))
    allowed = (1 + growth) * float(figure(K)) if limit is None else limit
    stable, unstable = split_stable(K)
    choices = [k for k in sorted(range(K.nstates) if orders is None else orders) if unstable.nstates <= k < K.nstates]
    best, failed, passed = K, -1, len(choices)
    while passed - failed > 1:
        middle = (failed + passed) // 2
        candidate = balanced_truncation(stable, choices[middle] - unstable.nstates) + unstable
        if lft_lower(P, candidate).is_stable() and float(figure(candidate)) <= allowed:
            best, passed = candidate, middle
        else:
            failed = middle
    return best


def split_stable(K: StateSpace) -> tuple[StateSpace, StateSpace]:
    """K = stable + unstable (poles on the stability boundary count as unstable); the first has the direct term."""
    # The margin is relative to the fastest pole: a slow pole within round-off of the boundary counts as unstable.
    margin = 1e-12 * float(np.max(np.abs(K.poles()), initial=0.0))
    inside = (lambda re, im: np.hypot(re, im) < 1 - 1e-12) if K.dt else (lambda re, im: re < -margin)
    return split(K, inside)


def residualise_fast(K: StateSpace, limit: float, also_unstable: bool = False) -> StateSpace:
    """K with every pole faster than `limit` [rad/s] replaced by its static gain; K(0) is unchanged.

    A controller close to the H-infinity optimum often has poles too fast for its sample rate. Raises InputError for
    sampled K, ComputationError if a fast pole is unstable (unless `also_unstable`, for callers that check the resulting
    loop).
    """
    if K.dt:
        raise InputError("expected a continuous controller", field="K.dt", value=K.dt)
    slow, fast = split(K, lambda re, im: np.hypot(re, im) <= limit)
    if not fast.nstates:
        return K
    if not fast.is_stable() and not also_unstable:
        raise ComputationError(
            "an unstable pole is too fast to implement",
            measured=f"{np.max(np.abs(fast.poles())):.4g} rad/s, limit {limit:.4g} rad/s",
            next_step="raise the back-off, or sample faster",
        )
    return replace(slow, D=slow.D + fast.dcgain())


def replace_fast_by_lags(K: StateSpace, corner: float, order: int = 3) -> StateSpace:
    """K with its poles faster than `LAGS.kept` times `corner` [rad/s] replaced by first-order lags of that corner.

    Fast poles may give K phase lead below the corner, which is lost if only their static gain is kept
    (`residualise_fast`). The fast part is approximated by the sum of G_k / (1 + s/corner)^k, k = 0 to `order`, with
    constant matrices G_k, by least squares at frequencies up to the corner, relative to the largest singular value of
    K. K(0) is unchanged. The lags have `order` times K.ninputs states. Unstable fast poles are replaced, too; the
    caller must check the stability of the closed loop. Raises InputError for sampled K.
    """
    if K.dt:
        raise InputError("expected a continuous controller", field="K.dt", value=K.dt)
    slow, fast = split(K, lambda re, im: np.hypot(re, im) <= LAGS.kept * corner)
    if not fast.nstates:
        return K
    n_u, n_y = K.noutputs, K.ninputs
    omega = np.geomspace(LAGS.lowest * corner, corner, LAGS.points)
    lag = 1 / (1 + 1j * omega / corner)
    size = np.maximum(np.linalg.norm(K.frequency_response(omega), ord=2, axis=(1, 2)), np.finfo(float).tiny)
    # lag^k - lag^(k + 1) is zero at s = 0: the fit cannot change K(0).
    basis = np.stack([(lag**k - lag ** (k + 1)) / size for k in range(order)], axis=1)
    target = ((fast.frequency_response(omega) - fast.dcgain()) / size[:, None, None]).reshape(omega.size, -1)
    gains = np.linalg.lstsq(np.r_[basis.real, basis.imag], np.r_[target.real, target.imag])[0]
    gains = np.concatenate([gains.reshape(order, n_u, n_y), np.zeros((1, n_u, n_y))])
    A = corner * np.kron(np.diag(np.ones(order - 1), -1) - np.eye(order), np.eye(n_y))
    B = corner * np.kron(np.eye(order, 1), np.eye(n_y))
    C = np.concatenate(list(gains[1:] - gains[:-1]), axis=1)
    return replace(slow, D=slow.D + fast.dcgain() + gains[0]) + StateSpace(A, B, C, np.zeros((n_u, n_y)))


def truncate_slow(K: StateSpace, limit: float) -> StateSpace:
    """K without its stable poles slower than `limit` [rad/s]; its response far above them is unchanged.

    Synthesis produces such poles at frequencies where all weights are constant. They have little effect, but their
    states decay only within hours. Raises InputError for sampled K.
    """
    if K.dt:
        raise InputError("expected a continuous controller", field="K.dt", value=K.dt)
    return split(K, lambda re, im: re >= 0 or np.hypot(re, im) >= limit)[0]


def split(K: StateSpace, first: Callable[[float, float], bool]) -> tuple[StateSpace, StateSpace]:
    """Split K into the part with the poles selected by `first` (and the direct term), and the rest."""
    n = K.nstates
    if not n:
        return K, StateSpace(K.A, K.B, K.C, 0 * K.D, K.dt, K.inputs, K.outputs)
    T, U, k = la.schur(K.A, output="real", sort=first)
    # Solve T11 X - X T22 = -T12, so that the coordinates [I X; 0 I] decouple the two parts.
    X = la.solve_sylvester(T[:k, :k], -T[k:, k:], -T[:k, k:]) if 0 < k < n else np.zeros((k, n - k))
    B, C = U.T @ K.B, K.C @ U
    chosen = StateSpace(T[:k, :k], B[:k] - X @ B[k:], C[:, :k], K.D, K.dt, K.inputs, K.outputs)
    rest = StateSpace(T[k:, k:], B[k:], C[:, :k] @ X + C[:, k:], 0 * K.D, K.dt, K.inputs, K.outputs)
    return chosen, rest
