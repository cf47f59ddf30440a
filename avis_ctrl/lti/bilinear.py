"""The bilinear map between sampled and continuous systems, s = (2/dt) (z - 1)/(z + 1).

It maps the unit circle one to one to the imaginary axis, z = exp(j omega dt) to s = j v, v = (2/dt) tan(omega dt/2).
The Nyquist frequency maps to infinity, and the inside of the circle to the left half plane. The response of the
sampled system at omega equals that of its image at v. Both therefore have the same stability, H-infinity norm,
structured singular value and scalings (Zhou, Doyle and Glover, Robust and Optimal Control, 1996, section 21.4). The
factor 2/dt keeps frequencies far below the sample rate unchanged, so that the image is as well scaled as the system.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.statespace import StateSpace


@dataclass(frozen=True)
class BilinearSettings:
    """at_infinity : a pole is treated as mapped to infinity if its distance from the point that maps to infinity,
    relative to that point, is at most this value; for nearer poles the map loses too many digits for a design."""

    at_infinity: float = 1e-9


SETTINGS = BilinearSettings()


def continuous_image(system: StateSpace) -> StateSpace:
    """Continuous system with the response of a sampled system on the warped frequency axis; keeps the signal names.

    A continuous system is returned unchanged. Raises ComputationError if A has an eigenvalue at z = -1.
    """
    if not system.dt:
        return system
    n, a = system.nstates, 2.0 / system.dt
    if not n:
        return replace(system, dt=0.0)
    # In Schur coordinates a pole near z = -1 does not spoil the accuracy of the other poles.
    _, (scale, _) = la.matrix_balance(system.A, permute=False, separate=True)
    T, Q = la.schur(system.A / scale[:, None] * scale)
    B, C = Q.T @ (system.B / scale[:, None]), (system.C * scale) @ Q
    inverse = _inverse(
        np.eye(n) + T,
        1.0,
        "a pole at z = -1, half the sample rate, has no continuous image",
        "a derivative discretised by the bilinear rule, or a resonance aliased to half the rate",
    )
    root = np.sqrt(2 * a)
    return replace(
        system,
        A=a * inverse @ (T - np.eye(n)),
        B=root * inverse @ B,
        C=root * C @ inverse,
        D=system.D - C @ inverse @ B,
        dt=0.0,
        states=(),
    )


def sampled_image(system: StateSpace, dt: float) -> StateSpace:
    """Inverse of `continuous_image` for a sample time dt [s] > 0; with a pole at 2/dt the result is not causal.

    Raises ComputationError if A has an eigenvalue at 2/dt.
    """
    n, a = system.nstates, 2.0 / dt
    if not n:
        return replace(system, dt=dt)
    inverse = _inverse(
        a * np.eye(n) - system.A,
        a,
        f"a pole at s = 2/dt = {a:.6g} rad/s has no sampled image",
        "an unstable pole as fast as the sample rate",
    )
    root = np.sqrt(2 * a)
    return replace(
        system,
        A=inverse @ (a * np.eye(n) + system.A),
        B=root * inverse @ system.B,
        C=root * system.C @ inverse,
        D=system.D + system.C @ inverse @ system.B,
        dt=dt,
    )


def image_frequency(omega: np.ndarray | float, dt: float) -> np.ndarray | float:
    """Frequency [rad/s] of the continuous image for omega from 0 to pi/dt; inf at and above the Nyquist frequency."""
    if not dt:
        return omega
    inside = np.asarray(omega) * dt < np.pi
    return np.where(inside, 2 / dt * np.tan(np.where(inside, omega, 0.0) * dt / 2), np.inf)[()]


def sampled_frequency(image: np.ndarray | float, dt: float) -> np.ndarray | float:
    """Frequency [rad/s] of the sampled system for a frequency of its continuous image; inf gives pi/dt."""
    return (2 / dt * np.arctan(np.asarray(image) * dt / 2))[()] if dt else image


def _inverse(matrix: np.ndarray, size: float, failed: str, cause: str) -> np.ndarray:
    # The test uses the poles, because a condition number would depend on the units of the states.
    nearest = float(np.min(np.abs(la.eigvals(matrix)))) / size
    if nearest <= SETTINGS.at_infinity:
        raise ComputationError(
            failed,
            measured=f"relative distance {nearest:.1e}",
            cause=cause,
            next_step="move the pole off this point, or take another discretisation",
        )
    return np.linalg.inv(matrix)
