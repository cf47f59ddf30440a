"""Automatic tuning of skyhook loops, so that the comparison with a synthesised controller is fair.

The search runs on frequency responses of sampled plants: closing two scalar loops around a stored response
costs a 2 x 2 inverse, so that thousands of tunings are tried in seconds. The bound on the worst case is then
computed by the caller on the whole uncertainty set; worst cases that the samples missed come back as new
samples (`Scenarios.with_delta`) until the tuning holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import differential_evolution

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.connect import lft_lower
from avis_ctrl.uncertainty.generalized_plant import GeneralizedPlant


@dataclass(frozen=True, eq=False)
class Channels:
    """The responses between floor (w), payload (z), commands (u) and measurements (y) at each frequency."""

    zw: np.ndarray
    zu: np.ndarray
    yw: np.ndarray
    yu: np.ndarray

    def closed(self, K: np.ndarray) -> np.ndarray:
        """T = P_zw + P_zu K inv(I - P_yu K) P_yw for diagonal K (n_omega, n_axes)."""
        loop = np.eye(K.shape[-1]) - self.yu * K[..., None, :]
        return self.zw + (self.zu * K[..., None, :]) @ np.linalg.solve(loop, self.yw)


@dataclass(frozen=True, eq=False)
class Scenarios:
    """Sampled plants as frequency responses: `channels` arrays are (n_samples, n_omega, ...)."""

    plant: GeneralizedPlant
    omega: np.ndarray
    responses: np.ndarray
    deltas: np.ndarray
    floor: tuple[str, ...]
    payload: tuple[str, ...]

    @staticmethod
    def sample(plant: GeneralizedPlant, floor: Sequence[str], payload: Sequence[str], omega: np.ndarray,
               count: int, seed: int) -> Scenarios:
        """The nominal plant and `count` samples on the boundary of the set.

        Complex blocks of one sample share a phase, and the phases of the samples go round the circle: alike channels
        that all lag, or all lose their gain, together are what destabilises decentralised loops. Phases drawn for each
        channel cancel in the sum, and the search then ends at loops that are not stable for the whole set.
        """
        rng = np.random.default_rng(seed)
        deltas = np.zeros((count + 1, omega.size, plant.blocks.n_w, plant.blocks.n_z), complex)
        for k in range(1, count + 1):
            deltas[k] = _boundary(plant, rng, np.exp(2j * np.pi * k / count))
        chosen = plant.restricted(list(floor), list(payload))
        return Scenarios(chosen, omega, chosen.P.frequency_response(omega), deltas, tuple(floor), tuple(payload))

    def with_delta(self, delta: np.ndarray) -> Scenarios:
        """The same with one more sample: a worst case found by a bound, at every frequency alike."""
        more = np.broadcast_to(delta, self.deltas.shape[1:])
        return Scenarios(self.plant, self.omega, self.responses, np.concatenate([self.deltas, more[None]]), self.floor,
                         self.payload)

    def channels(self) -> Channels:
        """Closes Delta around the responses: F_u(P(j omega), Delta) sample by sample."""
        n_w, n_z = self.plant.blocks.n_w, self.plant.blocks.n_z
        M, M12 = self.responses[:, :n_z, :n_w], self.responses[:, :n_z, n_w:]
        M21, M22 = self.responses[:, n_z:, :n_w], self.responses[:, n_z:, n_w:]
        loop = np.eye(n_z) - M @ self.deltas
        P = M22 + M21 @ self.deltas @ np.linalg.solve(loop, np.broadcast_to(M12, (*loop.shape[:2], *M12.shape[1:])))
        a, f = len(self.payload), len(self.floor)
        return Channels(P[..., :a, :f], P[..., :a, f:], P[..., a:, :f], P[..., a:, f:])


def _boundary(plant: GeneralizedPlant, rng: np.random.Generator, phase: complex) -> np.ndarray:
    """Real scalars at +-1, complex blocks of unit norm with the phase given."""
    return plant.blocks.assemble([rng.choice([-1.0, 1.0]) if block.kind == "real"
                                  else phase if block.kind == "complex"
                                  else phase * np.eye(block.rows, block.cols) for block in plant.blocks.blocks])


@dataclass(frozen=True)
class TuningRange:
    """Where the search may go: gains as multiples of critical damping, corners in Hz."""

    critical: tuple[float, ...]
    gain_factor: tuple[float, float] = (0.05, 20.0)
    tilt_corner_Hz: tuple[float, float] = (0.005, 1.0)
    roll_off_Hz: tuple[float, float] = (5.0, 400.0)

    def bounds(self) -> list[tuple[float, float]]:
        """Bounds of the logarithms searched over."""
        limits = [*([self.gain_factor] * len(self.critical)), self.tilt_corner_Hz, self.roll_off_Hz]
        return [(float(np.log(low)), float(np.log(high))) for low, high in limits]

    def skyhook(self, axes: tuple[str, ...], point: np.ndarray) -> Skyhook:
        """The loops at a point of the search."""
        n = len(self.critical)
        gains = tuple(float(g) for g in np.exp(point[:n]) * np.array(self.critical))
        return Skyhook(axes, gains, float(np.exp(point[n])), float(np.exp(point[n + 1])))


def tune_skyhook(scenarios: Scenarios, axes: tuple[str, ...], search: TuningRange, band_Hz: tuple[float, float],
                 peak_limit: float, seed: int = 0) -> Skyhook:
    """The skyhook with the lowest sampled transmissibility in a band whose sampled peak stays below a limit.

    Parameters
    ----------
    peak_limit : largest singular value allowed at any frequency (a ratio, not dB). Where no tuning keeps it, the
        excess is weighed ten times as heavily as the transmissibility in the band.

    Raises
    ------
    ComputationError : no stable tuning in the range (the nominal closed loop is tested at the end).
    """
    channels, omega = scenarios.channels(), scenarios.omega
    inside = (omega >= 2 * np.pi * band_Hz[0] * (1 - 1e-9)) & (omega <= 2 * np.pi * band_Hz[1] * (1 + 1e-9))

    def cost(point: np.ndarray) -> float:
        skyhook = search.skyhook(axes, point)
        shape = skyhook.filter.frequency_response(omega)[:, 0, 0]
        K = -shape[:, None] * np.array(skyhook.gains)
        # Unstable loops have finite responses too: the return difference must not circle the origin.
        turns = _encirclements(np.linalg.det(np.eye(len(axes)) - channels.yu * K[:, None, :]))
        sigma = _largest_singular_value(channels.closed(K))
        excess = max(0.0, float(np.max(sigma)) / peak_limit - 1.0)
        return float(np.max(sigma[:, inside])) + 10.0 * excess + 100.0 * turns

    found = differential_evolution(cost, search.bounds(), seed=seed, popsize=10, maxiter=40, tol=1e-3, polish=False)
    best = search.skyhook(axes, found.x)
    closed = lft_lower(scenarios.plant.P, best.controller())
    if not closed.is_stable():
        raise ComputationError("no stable skyhook in the range searched",
                               measured=f"largest real part of a pole {np.max(closed.poles().real):.3g} rad/s",
                               cause="gains or delay too large", next_step="widen the range of gains downwards")
    return best


def _largest_singular_value(T: np.ndarray) -> np.ndarray:
    """sigma_max of each matrix; in closed form for 2 x 2, where a decomposition of each would take most of the time."""
    if T.shape[-2:] != (2, 2):
        return np.linalg.norm(T, ord=2, axis=(-2, -1))
    square = np.sum(np.abs(T) ** 2, axis=(-2, -1))
    product = np.abs(T[..., 0, 0] * T[..., 1, 1] - T[..., 0, 1] * T[..., 1, 0])
    return np.sqrt((square + np.sqrt(np.maximum(square ** 2 - 4 * product ** 2, 0.0))) / 2)


def _encirclements(return_difference: np.ndarray) -> float:
    """Largest number of half turns of det(I - P K) about the origin over the samples, from its phase."""
    phase = np.unwrap(np.angle(return_difference), axis=-1)
    return float(np.max(np.round(np.abs(phase[..., -1] - phase[..., 0]) / np.pi)))
