"""Bounds of functions of frequency over whole intervals: value and slope at the centre, and a bound of the second
derivative (Taylor's theorem).

Intervals are |omega - centre| <= half; all quantities are arrays over the intervals. Resolvents: with
X0 = (p0 I - A)^-1 and |p - p0| |X0| = rho < 1, |C X| <= |C X0| / (1 - rho), and likewise for X and X B.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.statespace import StateSpace


@dataclass(frozen=True, eq=False)
class Jet:
    """value, slope : (n, ..) at the centres. size, steep, curve : (n,) bounds of the norm of the function and of its
    first two derivatives over the intervals."""

    value: np.ndarray
    slope: np.ndarray
    size: np.ndarray
    steep: np.ndarray
    curve: np.ndarray

    def __mul__(self, other: Jet) -> Jet:
        """Product; `self` is a scalar function."""
        shape = (-1, *[1] * (other.value.ndim - 1))
        value, slope = self.value.reshape(shape), self.slope.reshape(shape)
        return Jet(
            value * other.value,
            slope * other.value + value * other.slope,
            self.size * other.size,
            self.size * other.steep + self.steep * other.size,
            self.size * other.curve + 2 * self.steep * other.steep + self.curve * other.size,
        )

    def __sub__(self, other: Jet) -> Jet:
        return Jet(
            self.value - other.value,
            self.slope - other.slope,
            self.size + other.size,
            self.steep + other.steep,
            self.curve + other.curve,
        )

    def remainder(self, half: np.ndarray) -> np.ndarray:
        """(n,) largest deviation from the linear expansion about the centre, over each interval."""
        return half**2 / 2 * self.curve

    def relative_to(self, K: Jet, least: float, half: np.ndarray, further: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) bound over each interval of |M| in E + F = M [K; least I], where E is this function and |F| <= further;
        and the part of the bound that decreases with the square of the interval width.

        Let P = [K; least I], M = E P^+ and N = (E' - M P') P^+ at the centre. Then E = (M + t N) P + G anywhere in the
        interval, |t| <= half, where G contains only remainders. The smallest singular value of P is at least `least`,
        and at least its value at the centre minus half |P'| minus the remainder.
        """
        n = K.value.shape[-1]
        below = np.broadcast_to(np.eye(n), (len(half), n, n))
        P, dP = np.concatenate([K.value, least * below], axis=1), np.concatenate([K.slope, 0 * below], axis=1)
        inverse = np.linalg.pinv(P, rcond=0.0)
        M = self.value @ inverse
        N = (self.slope - M @ dP) @ inverse
        size, slope, steep = (np.linalg.norm(part, ord=2, axis=(1, 2)) for part in (M, N, dP))
        size += half * slope
        smallest = np.maximum(np.linalg.norm(P, ord=-2, axis=(1, 2)) - half * steep - K.remainder(half), least)
        left = (self.remainder(half) + size * K.remainder(half) + half**2 * slope * steep) / smallest
        return size + further / smallest + left, left


def roots_jet(
    zeros: Iterable[complex], poles: Iterable[complex], leading: float, centre: np.ndarray, half: np.ndarray
) -> Jet:
    """Jet of leading * prod(s - z) / prod(s - p) at s = j omega."""
    s = 1j * centre
    signed = [*((complex(one), 1.0) for one in zeros), *((complex(one), -1.0) for one in poles)]
    S1, S2 = log_slopes([root for root, _ in signed], centre, half)  # first, because it refuses a root on the axis
    value, first = np.full(centre.size, leading, complex), np.zeros(centre.size, complex)
    for root, sign in signed:
        value = value * (s - root) ** sign
        first = first + sign * 1j / (s - root)
    size = np.abs(value) * np.exp(half * S1)
    return Jet(value, value * first, size, size * S1, size * (S1**2 + S2))


def log_slopes(roots: Iterable[complex], centre: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bounds of sum 1/|j omega - r| and of sum 1/|j omega - r|^2 over the intervals."""
    S1, S2 = np.zeros(centre.size), np.zeros(centre.size)
    for root in roots:
        distance = np.abs(1j * centre - root) - half
        if np.min(distance) <= 0:
            raise ComputationError(
                "the frequency grid of the certificate is too coarse for a filter's root",
                measured=f"root {complex(root):.3g} rad/s",
            )
        S1, S2 = S1 + 1 / distance, S2 + 1 / distance**2
    return S1, S2


def delay_jet(delay_s: float, centre: np.ndarray) -> Jet:
    """Jet of exp(-j omega delay)."""
    value, one = np.exp(-1j * centre * delay_s), np.ones(centre.size)
    return Jet(value, -1j * delay_s * value, one, delay_s * one, delay_s**2 * one)


def sinc_jet(period_s: float, centre: np.ndarray) -> Jet:
    """Jet of sin(x) / x with x = omega T / 2; its derivatives with respect to x are at most 1/2 and 1/3."""
    x, one = centre * period_s / 2, np.ones(centre.size)
    safe = np.where(x > 1e-4, x, 1.0)
    slope = np.where(x > 1e-4, (safe * np.cos(safe) - np.sin(safe)) / safe**2, -x / 3)
    return Jet(np.sinc(x / np.pi) + 0j, slope * period_s / 2 + 0j, one, period_s / 4 * one, period_s**2 / 12 * one)


def system_jet(system: StateSpace, centre: np.ndarray, half: np.ndarray) -> Jet:
    """Jet of the frequency response of a continuous or sampled system."""
    T, n = system.dt, system.nstates
    point = np.exp(1j * centre * T) if T else 1j * centre
    first = 1j * T * point if T else np.full(centre.size, 1j)  # derivative of the point with respect to omega
    X = np.linalg.inv(point[:, None, None] * np.eye(n) - system.A)
    CX, XB = system.C @ X, X @ system.B

    def norm(matrices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(matrices, ord=2, axis=(1, 2))

    rho = half * np.abs(first) * norm(X)
    if np.max(rho) >= 1:
        raise ComputationError(
            "the frequency grid of the certificate is too coarse for the controller's poles",
            measured=f"at {centre[np.argmax(rho)] / (2 * np.pi):.3g} Hz",
            cause="a controller with hardly damped modes",
        )
    value = system.D + CX @ system.B
    slope = -(CX @ XB) * first[:, None, None]
    outer = norm(CX) * norm(XB)
    curve = np.abs(first) ** 2 * (2 * outer * norm(X) / (1 - rho) ** 3 + (outer / (1 - rho) ** 2 if T else 0.0))
    steep = norm(slope) + half * curve
    return Jet(value, slope, norm(value) + half * steep, steep, curve)
