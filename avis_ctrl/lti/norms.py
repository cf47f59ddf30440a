"""The H-infinity norm, computed on the realisation as given.

`hinf_norm` is the two-step method of Bruinsma and Steinbuch (Systems & Control Letters 14, 1990). The level is raised
to the gain at the midpoints between imaginary-axis eigenvalues of its Hamiltonian, until the Hamiltonian has no
imaginary eigenvalues. The peak is therefore found independently of a frequency grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.bilinear import continuous_image, sampled_frequency
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.lti.statespace import StateSpace


@dataclass(frozen=True)
class NormSettings:
    """near_axis : angle from the imaginary axis within which eigenvalues of the Hamiltonian are tried as crossings
        [rad]. Round-off moves the crossings of a flat response far off the axis (a nearly multiple eigenvalue). The
        response is evaluated at every one of them: an extra frequency costs little, a missing one the norm.
    beside, points : range as multiples of the peak frequency [1], and number of frequencies in it, that are searched
        once more before a peak is accepted. If the poles span many decades, round-off can hide the crossings of a flat
        peak.
    """

    near_axis: float = 3e-2
    beside: tuple[float, float] = (0.5, 2.0)
    points: int = 101


SETTINGS = NormSettings()


def decibels(gain: float) -> float:
    """20 log10 of a gain; minus infinity for a zero gain."""
    return float(20 * np.log10(gain)) if gain > 0 else -np.inf


def in_dB(gain: np.ndarray | Sequence[float]) -> np.ndarray:
    """20 log10 |gain| (n,) for plots; nan where the gain is zero or not finite."""
    size = np.abs(np.asarray(gain))
    known = np.isfinite(size) & (size > 0)
    return np.where(known, 20 * np.log10(np.where(known, size, 1.0)), np.nan)


class PeakGain(NamedTuple):
    """H-infinity norm and the frequency [rad/s] where it is attained (inf for the direct term)."""

    gain: float
    omega: float


def hinf_norm(system: Any, tolerance: float = 1e-6) -> PeakGain:
    """H-infinity norm of a stable system to a relative tolerance; gain inf for an unstable system.

    system : StateSpace (avis_ctrl or python-control) or TransferFunction, continuous or sampled. The returned value is
    a lower bound attained at `omega`; the true norm is at most (1 + tolerance) times this value.

    Examples
    --------
    The peak of 1/(s^2 + 2 d s + 1) is 1/(2 d sqrt(1 - d^2)), at sqrt(1 - 2 d^2):

    >>> peak = ac.hinf_norm(ac.tf([1.0], [1.0, 0.2, 1.0]))
    >>> round(peak.gain, 4), round(peak.omega, 4)
    (5.0252, 0.9899)
    """
    system = as_system(system)
    if not 0 < tolerance < 1:
        raise InputError("expected a number between 0 and 1", field="tolerance", value=tolerance)
    if not system.is_stable():
        return PeakGain(np.inf, np.nan)
    if system.dt:
        # The direct term of the image is the response at the Nyquist frequency.
        peak = hinf_norm(continuous_image(system), tolerance)
        return PeakGain(peak.gain, float(sampled_frequency(peak.omega, system.dt)))
    if not system.ninputs or not system.noutputs:
        return PeakGain(0.0, 0.0)
    poles = system.poles()
    sizes = np.abs(poles[poles != 0]) if np.any(poles) else np.ones(1)
    # A coarse grid catches flat responses, whose Hamiltonian eigenvalues are ill conditioned.
    grid = np.geomspace(0.1 * np.min(sizes), 10 * np.max(sizes), 100)
    candidates = np.concatenate(
        [
            [0.0, np.inf],
            grid,
            np.abs(poles),
            np.abs(poles.imag),
            np.sqrt(np.maximum(np.abs(poles) ** 2 - 2 * poles.real**2, 0.0)),
        ]
    )
    omega, level = _best(system, np.unique(candidates))
    if level == 0.0:
        return PeakGain(0.0, 0.0)
    balanced = _balanced(system)
    for _ in range(60):
        crossings = _level_crossings(balanced, (1.0 + tolerance) * level)
        new_omega, new_level = omega, level
        if crossings.size:
            edges = np.unique(np.concatenate([[0.0], crossings]))
            points = np.concatenate([edges, (edges[:-1] + edges[1:]) / 2, np.sqrt(edges[:-1] * edges[1:])])
            new_omega, new_level = _best(system, points)
        if new_level <= (1.0 + tolerance) * level and 0 < omega < np.inf:
            near_omega, near = _best(system, omega * np.geomspace(*SETTINGS.beside, SETTINGS.points))
            if near > new_level:
                new_omega, new_level = near_omega, near
        if new_level <= (1.0 + tolerance) * level:
            return PeakGain(max(level, new_level), omega if level >= new_level else new_omega)
        omega, level = new_omega, new_level
    raise ComputationError(
        "the H-infinity norm did not settle in 60 steps",
        measured=f"last level {level:.6g}",
        cause="a badly scaled realisation",
        next_step="balance the system first",
    )


def norm_is_below(system: StateSpace, level: float) -> bool:
    """Whether the H-infinity norm of a continuous system is below a level; False for an unstable system.

    Much faster than `hinf_norm`: if no singular value crosses the level, one frequency decides for all frequencies
    (Boyd, Balakrishnan and Kabamba 1989).
    """
    if not system.is_stable():
        return False
    if not (system.nstates and system.ninputs and system.noutputs):
        return not system.D.size or float(np.linalg.norm(system.D, 2)) < level
    if not np.linalg.norm(system.D, 2) < level:
        return False
    sizes = np.abs(system.poles())
    # The grid catches flat responses, whose Hamiltonian eigenvalues are ill conditioned; it is cheap and often decides.
    if not _best(system, np.geomspace(0.1 * np.min(sizes), 10 * np.max(sizes), 100))[1] < level:
        return False
    edges = np.unique(np.concatenate([[0.0], _level_crossings(_balanced(system), level)]))
    points = np.concatenate([edges, (edges[:-1] + edges[1:]) / 2, np.sqrt(edges[:-1] * edges[1:])])
    return _best(system, points)[1] < level


def largest_singular_value(M: np.ndarray) -> np.ndarray:
    """Largest singular value of each matrix (.., m, n), in closed form for 2 x 2, otherwise from M^H M.

    Faster than a singular value decomposition and as accurate for the largest singular value."""
    size = np.max(np.abs(M), axis=(-2, -1), initial=0.0)
    M = M / np.where(size > 0, size, 1.0)[..., None, None]
    rows, columns = M.shape[-2:]
    if rows == columns == 2:
        square = np.sum(np.abs(M) ** 2, axis=(-2, -1))
        product = np.abs(M[..., 0, 0] * M[..., 1, 1] - M[..., 0, 1] * M[..., 1, 0])
        return size * np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * product**2, 0.0))) / 2)
    if not (rows and columns):
        return size
    adjoint = np.conj(np.swapaxes(M, -1, -2))
    gram = M @ adjoint if rows < columns else adjoint @ M
    return size * np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[..., -1], 0.0))


def _best(system: StateSpace, omegas: np.ndarray) -> tuple[float, float]:
    response = system.frequency_response(omegas)
    if not np.all(np.isfinite(response)):
        lost = int(np.sum(~np.all(np.isfinite(response), axis=(1, 2))))
        raise ComputationError(
            "the response overflows",
            measured=f"at {lost} of {len(omegas)} frequencies",
            cause="a badly scaled realisation",
            next_step="balance the system first",
        )
    gains = np.linalg.norm(response, ord=2, axis=(1, 2))
    best = int(np.argmax(gains))
    return float(omegas[best]), float(gains[best])


def _balanced(system: StateSpace) -> StateSpace:
    if not system.nstates:
        return system
    _, (scale, _) = la.matrix_balance(system.A, permute=False, separate=True)
    return system.similar(np.diag(scale))


def _level_crossings(system: StateSpace, level: float) -> np.ndarray:
    """Frequencies [rad/s] where a singular value of the response (nearly) equals the level; level > sigma_max(D)."""
    A, B, C, D = system.A, system.B, system.C, system.D
    R = level**2 * np.eye(system.ninputs) - D.T @ D
    if not system.nstates or np.min(la.eigvalsh(R)) <= 0:
        return np.zeros(0)
    gain_x = np.linalg.solve(R, D.T @ C)
    F = A + B @ gain_x
    BR = B @ np.linalg.solve(R, B.T)
    Q = C.T @ C + C.T @ D @ gain_x
    scale = symplectic_scale(F, BR, Q)
    eigenvalues = la.eigvals(
        np.block(
            [
                [F / scale[:, None] * scale, BR / np.outer(scale, scale)],
                [-Q * np.outer(scale, scale), -(F / scale[:, None] * scale).T],
            ]
        )
    )
    size = np.maximum(np.abs(eigenvalues), 1e-12 * np.max(np.abs(eigenvalues)))
    on_axis = np.abs(eigenvalues.real) < SETTINGS.near_axis * size
    return np.unique(np.abs(eigenvalues[on_axis].imag))


def symplectic_scale(A: np.ndarray, R: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """State scaling d (powers of two) such that diag(d, 1/d) balances [A R; -Q -A'] and keeps it Hamiltonian."""
    n = A.shape[0]
    magnitude = np.abs(np.block([[A, R], [-Q, -A.T]]))
    np.fill_diagonal(magnitude, 0.0)
    _, (both, _) = la.matrix_balance(magnitude, permute=False, separate=True)
    logs = np.log2(both)
    return np.exp2(np.round((logs[:n] - logs[n:]) / 2))
