"""Realisation for a processor: states of similar size, few operations, poles with minimum sensitivity to rounding.

Each group of states that is not coupled to any other is balanced (equal Gramians), then transformed into real Schur
form by an orthogonal matrix. Only the upper triangle of A and the pairs on its diagonal remain: about half the
multiplications. The poles are on the diagonal: rounding a coefficient moves a real pole by the rounding error of that
coefficient, and a pair by that of its block. A companion or modal form has no such bound for poles close to each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg as la
from scipy.sparse.csgraph import connected_components

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.realisation import balance, gramian_factors
from avis_ctrl.lti.statespace import StateSpace


def processor_form(system: StateSpace) -> StateSpace:
    """The same transfer matrix (n_u, n_y) with A block diagonal, each block in real Schur form with balanced states.

    Raises
    ------
    ComputationError : a controller that is unstable by itself: it cannot start from zero output.
    """
    if not system.is_stable():
        raise ComputationError(
            "the sampled controller is not stable by itself, so it cannot run with its output at "
            "zero, as a safe start needs",
            measured=f"spectral radius {np.max(np.abs(system.poles())):.6g}",
            next_step="export another controller of the folder, or design with less bandwidth",
        )
    if not system.nstates:
        return system
    _, group = connected_components(system.A != 0, directed=False)
    parts = [_schur(_part(system, np.flatnonzero(group == k))) for k in range(group.max() + 1)]
    joined = StateSpace(
        la.block_diag(*(p.A for p in parts)),
        np.vstack([p.B for p in parts]),
        np.hstack([p.C for p in parts]),
        system.D,
        system.dt,
        system.inputs,
        system.outputs,
    )
    return joined


def _part(system: StateSpace, kept: np.ndarray) -> StateSpace:
    return replace(system, A=system.A[np.ix_(kept, kept)], B=system.B[kept], C=system.C[:, kept], states=())


def _schur(part: StateSpace) -> StateSpace:
    """Balanced as far as the Gramians are regular, in real Schur form."""
    part = balanced(part)
    T, Q = la.schur(part.A, output="real")
    T = np.triu(T, -1)
    return replace(part, A=T, B=Q.T @ part.B, C=part.C @ Q, states=())


def balanced(part: StateSpace) -> StateSpace:
    """States with equal and diagonal Gramians; only scaled if a state is almost unreachable or unobservable."""
    part = balance(part)
    Lc, Lo = gramian_factors(part)
    U, sigma, Vt = la.svd(Lo.T @ Lc)
    if sigma[-1] <= np.sqrt(np.finfo(float).eps) * sigma[0]:
        return part
    root = np.sqrt(sigma)
    return replace(
        part,
        A=(U / root).T @ Lo.T @ part.A @ Lc @ Vt.T / root,
        B=(U / root).T @ Lo.T @ part.B,
        C=part.C @ Lc @ Vt.T / root,
    )
