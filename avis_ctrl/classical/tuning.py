"""Automatic tuning of skyhook loops, for a fair comparison with a synthesised controller.

The search uses frequency responses of sampled plants: closing the loops then costs one inverse of a matrix of the
number of axes. It starts from the obvious tunings: critical damping and gains and corners around it. From the best of
these, all gains and corners are improved together by linear programs in a trust region, on the largest singular values
and their analytic gradients. The caller then computes a worst-case bound over the whole uncertainty set. Worst cases
that the samples missed are added as new samples (`Scenarios.with_delta`, `Scenarios.with_worst`) until the samples
represent the worst case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.optimize as so

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.lti.norms import largest_singular_value
from avis_ctrl.uncertainty.generalized_plant import GeneralizedPlant


@dataclass(frozen=True, eq=False)
class Channels:
    """Frequency responses between floor (w), payload (z), commands (u) and measurements (y)."""

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
    """Sampled plants as frequency responses: `channels` arrays are (n_samples, n_omega, ...).

    plants : number of samples, from the first, whose perturbation is the same at all frequencies, so that they are
        plants.
    """

    plant: GeneralizedPlant
    omega: np.ndarray
    responses: np.ndarray
    deltas: np.ndarray
    floor: tuple[str, ...]
    payload: tuple[str, ...]
    plants: int

    @staticmethod
    def sample(
        plant: GeneralizedPlant, floor: Sequence[str], payload: Sequence[str], omega: np.ndarray, count: int, seed: int
    ) -> Scenarios:
        """The nominal plant and `count` samples on the boundary of the uncertainty set.

        All complex blocks of one sample have the same phase, and the phases of the samples cover the circle.
        Decentralised loops are destabilised by similar channels that all lag, or all lose gain, at the same time.
        Independent phases would average out in the sum of the channels; the search would then converge to loops that
        are unstable for part of the set.
        """
        rng = np.random.default_rng(seed)
        deltas = np.zeros((count + 1, omega.size, plant.blocks.n_w, plant.blocks.n_z), complex)
        for k in range(1, count + 1):
            deltas[k] = _boundary(plant, rng, np.exp(2j * np.pi * k / count))
        chosen = plant.restricted(list(floor), list(payload))
        return Scenarios(
            chosen, omega, chosen.P.frequency_response(omega), deltas, tuple(floor), tuple(payload), count + 1
        )

    def with_delta(self, delta: np.ndarray) -> Scenarios:
        """A copy with one more sample: a worst case found by a bound, the same at every frequency."""
        more = np.broadcast_to(delta, self.deltas.shape[1:])
        at = self.plants
        return replace(self, deltas=np.concatenate([self.deltas[:at], more[None], self.deltas[at:]]), plants=at + 1)

    def with_worst(self, deltas: np.ndarray) -> Scenarios:
        """A copy with one more sample: the worst case of each frequency by itself (n_omega, n_w, n_z)."""
        return replace(self, deltas=np.concatenate([self.deltas, deltas[None]]))

    def with_frequencies(self, omega: np.ndarray) -> Scenarios:
        """A copy with more frequencies [rad/s]; each new one takes the perturbations of the nearest old frequency."""
        every = np.union1d(self.omega, omega)
        nearest = np.argmin(np.abs(np.log(every[:, None] / self.omega)), axis=1)
        return replace(
            self, omega=every, responses=self.plant.P.frequency_response(every), deltas=self.deltas[:, nearest]
        )

    def channels(self) -> Channels:
        """Close Delta around the responses: F_u(P(j omega), Delta), sample by sample."""
        n_w, n_z = self.plant.blocks.n_w, self.plant.blocks.n_z
        M, M12 = self.responses[:, :n_z, :n_w], self.responses[:, :n_z, n_w:]
        M21, M22 = self.responses[:, n_z:, :n_w], self.responses[:, n_z:, n_w:]
        loop = np.eye(n_z) - M @ self.deltas
        P = M22 + M21 @ self.deltas @ np.linalg.solve(loop, np.broadcast_to(M12, (*loop.shape[:2], *M12.shape[1:])))
        a, f = len(self.payload), len(self.floor)
        return Channels(P[..., :a, :f], P[..., :a, f:], P[..., a:, :f], P[..., a:, f:])

    def open_loop(self) -> np.ndarray:
        """det(j omega I - A) of every plant, the loops open, divided by that of the nominal plant (plants, n_omega)."""
        P, n_w, n_z = self.plant.P, self.plant.blocks.n_w, self.plant.blocks.n_z
        deltas = self.deltas[: self.plants, 0]
        poles = np.linalg.eigvals(
            P.A + P.B[:, :n_w] @ deltas @ np.linalg.solve(np.eye(n_z) - P.D[:n_z, :n_w] @ deltas, P.C[:n_z])
        )
        poles = np.take_along_axis(poles, np.argsort(np.abs(poles), axis=-1), axis=-1)  # factors of similar size
        factors = 1j * self.omega[:, None] - poles[:, None, :]
        return np.prod(factors / factors[:1], axis=-1)


def _boundary(plant: GeneralizedPlant, rng: np.random.Generator, phase: complex) -> np.ndarray:
    """Real scalars at +-1, complex blocks of unit norm with the given phase."""
    return plant.blocks.assemble(
        [
            rng.choice([-1.0, 1.0])
            if block.kind == "real"
            else phase
            if block.kind == "complex"
            else phase * np.eye(block.rows, block.cols)
            for block in plant.blocks.blocks
        ]
    )


@dataclass(frozen=True)
class TuningRange:
    """Bounds of the search: gains as multiples of critical damping, corners in Hz."""

    critical: tuple[float, ...]
    gain_factor: tuple[float, float] = (0.05, 20.0)
    tilt_corner_Hz: tuple[float, float] = (0.005, 1.0)
    roll_off_Hz: tuple[float, float] = (5.0, 400.0)

    def bounds(self) -> np.ndarray:
        """Bounds (n, 2) of the logarithmic search variables: gains, tilt corner, roll-off."""
        limits = [*([self.gain_factor] * len(self.critical)), self.tilt_corner_Hz, self.roll_off_Hz]
        return np.log(np.array(limits, float))

    def skyhook(self, axes: tuple[str, ...], point: np.ndarray) -> Skyhook:
        """The loops at a point of the search."""
        n = len(self.critical)
        factors = np.clip(np.exp(point[:n]), *self.gain_factor)
        tilt, roll = np.clip(np.exp(point[n]), *self.tilt_corner_Hz), np.clip(np.exp(point[n + 1]), *self.roll_off_Hz)
        return Skyhook(axes, tuple(float(g) for g in factors * np.array(self.critical)), float(tilt), float(roll))

    def point(self, gain_factor: float, corners_Hz: tuple[float, float]) -> np.ndarray:
        """The point with the same gain factor for all axes, clipped to the range."""
        bounds = self.bounds()
        wanted = np.log([*([gain_factor] * len(self.critical)), *corners_Hz])
        return np.clip(wanted, bounds[:, 0], bounds[:, 1])


@dataclass(frozen=True)
class TuningSettings:
    """Limits of the search. Every limit is a count, not a time.

    gain_factors : multiples of critical damping to start from, besides the classical rule (1).
    tilt_corners_Hz, roll_offs_Hz : corners to start from: the usual values and half a decade to either side.
    refined : number of starting points that are improved, the best ones by the merit of the search.
    steps : maximum number of linear programs per starting point.
    radius : initial trust region, in logarithms (a factor e^0.5 of a gain or corner).
    converged : relative improvement of a step below which the search stops.
    """

    gain_factors: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    tilt_corners_Hz: tuple[float, ...] = (0.03, 0.1, 0.3)
    roll_offs_Hz: tuple[float, ...] = (30.0, 100.0, 300.0)
    refined: int = 4
    steps: int = 25
    radius: float = 0.5
    converged: float = 1e-3


@dataclass(frozen=True)
class Merit:
    """Figure of merit of a tuning, on samples or on the whole set; smaller is better.

    Stable tunings that meet the limit on the peak rank before all others, by their transmissibility in the band. The
    others rank by `unstable`, then by their peak. unstable : number of unstable poles.
    """

    peak: float
    band: float
    limit: float
    unstable: float = 0.0

    @property
    def meets(self) -> bool:
        """Whether the tuning is stable and its peak within the limit."""
        return self.unstable == 0 and self.peak <= self.limit

    def key(self) -> tuple[float, float, float]:
        """Sort key: the smaller, the better."""
        return (self.unstable, 0.0, self.band) if self.meets else (self.unstable, 1.0, self.peak)


@dataclass(frozen=True, eq=False)
class Search:
    """Tunings of some axes on sampled plants, judged by the largest singular value at each frequency."""

    scenarios: Scenarios
    axes: tuple[str, ...]
    search: TuningRange
    band_Hz: tuple[float, float]
    settings: TuningSettings = TuningSettings()

    @cached_property
    def channels(self) -> Channels:
        """Responses of the sampled plants."""
        return self.scenarios.channels()

    @cached_property
    def open_loop(self) -> np.ndarray:
        """Characteristic polynomials of the sampled plants without control, relative to the nominal one."""
        return self.scenarios.open_loop()

    @cached_property
    def inside(self) -> np.ndarray:
        """Mask of the frequencies inside the band (n_omega,)."""
        low, high = (2 * np.pi * f for f in self.band_Hz)
        return (self.scenarios.omega >= low * (1 - 1e-9)) & (self.scenarios.omega <= high * (1 + 1e-9))

    def merit(self, point: np.ndarray, limit: float) -> Merit:
        """Merit of a tuning on the samples."""
        K, _ = self._loops(point)
        sigma = largest_singular_value(self.channels.closed(K))
        return Merit(float(np.max(sigma)), float(np.max(sigma[:, self.inside])), limit, self._unstable(point, K))

    def _unstable(self, point: np.ndarray, K: np.ndarray) -> float:
        """Largest number of unstable poles over the sampled plants; unstable loops have finite responses too.

        The poles of the nominal closed loop are computed. Those of the other plants follow from the phase of their
        characteristic polynomial relative to the nominal one. This phase is smooth if the closed loops are damped. The
        phase of det(I - P K) by itself is not: at each lightly damped mode of the table without control it turns by 180
        degrees between two frequencies of the grid. A sample with the worst case of each frequency by itself is not a
        plant and does not count.
        """
        nominal = self.scenarios.plant.closed(self.search.skyhook(self.axes, point).controller()).poles()
        plants = self.channels.yu[: self.scenarios.plants]
        returned = np.linalg.det(np.eye(len(self.axes)) - plants * K[:, None, :])
        turned = half_turns(returned / returned[:1] * self.open_loop)
        return float(np.count_nonzero(nominal.real >= 0) + max(0.0, -np.min(turned)))

    def starts(self) -> list[np.ndarray]:
        """The classical tunings: multiples of critical damping with the usual corners and corners around them."""
        asked = self.settings
        points = [
            self.search.point(g, (tilt, roll))
            for g in asked.gain_factors
            for tilt in asked.tilt_corners_Hz
            for roll in asked.roll_offs_Hz
        ]
        return list({tuple(np.round(point, 9)): point for point in points}.values())

    def best_starts(self, limit: float, more: Sequence[np.ndarray] = ()) -> list[np.ndarray]:
        """The best starting points, `more` included, best first. Unstable ones rank last."""
        ranked = sorted([*more, *self.starts()], key=lambda point: self.merit(point, limit).key())
        return ranked[: self.settings.refined]

    def improved(self, point: np.ndarray, limit: float) -> np.ndarray:
        """Minimise the peak down to the limit, then the maximum in the band, by linear programs in a trust region."""
        bounds, radius = self.search.bounds(), self.settings.radius
        here = self.merit(point, limit)
        for _ in range(self.settings.steps):
            if radius < 1e-3:
                break
            values, slopes, in_band = self._linearised(point)
            low, high = np.maximum(bounds[:, 0] - point, -radius), np.minimum(bounds[:, 1] - point, radius)
            trial = np.clip(
                point + _minimax_step(values, slopes, in_band, np.log(limit), low, high), bounds[:, 0], bounds[:, 1]
            )
            there = self.merit(trial, limit)
            if there.key() < here.key():
                gained = 1.0 if there.key()[:2] < here.key()[:2] else 1 - there.key()[2] / here.key()[2]
                point, here, radius = trial, there, min(2 * radius, 1.0)
                if gained < self.settings.converged:
                    break
            else:
                radius *= 0.35
        return point

    def _loops(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal of K (n_omega, n_axes), and d log K / d log corner for both corners (n_omega, 2)."""
        skyhook, s = self.search.skyhook(self.axes, point), 1j * self.scenarios.omega
        tilt, roll = 2 * np.pi * skyhook.tilt_corner_Hz, 2 * np.pi * skyhook.roll_off_Hz
        shape = s / (s + tilt) * roll / (s + roll)
        return -shape[:, None] * np.array(skyhook.gains), np.stack([-tilt / (s + tilt), s / (s + roll)], axis=1)

    def _linearised(self, point: np.ndarray, reach: float = 0.7) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """log sigma (n,) near the peak and the band's maximum, gradients (n, n_point), and a mask of the band."""
        K, of_corners = self._loops(point)
        parts = self.channels
        S = np.linalg.inv(np.eye(K.shape[-1]) - parts.yu * K[:, None, :])
        from_floor = S @ parts.yw
        T = parts.zw + (parts.zu * K[:, None, :]) @ from_floor
        U, s, Vh = np.linalg.svd(T)
        log_s, in_band = np.log(np.maximum(s[..., 0], 1e-300)), np.broadcast_to(self.inside, s.shape[:2])
        near = (log_s > np.max(log_s) - reach) | (in_band & (log_s > np.max(log_s[:, self.inside]) - reach))
        at = np.nonzero(near)
        u, v, K_at = U[at][:, :, 0], np.conj(Vh[at][:, 0]), K[at[1]]
        # dT = P_zu inv(I - K P_yu) dK inv(I - P_yu K) P_yw
        right = (from_floor[at] @ v[..., None])[..., 0]
        left = np.conj(u)[:, None, :] @ parts.zu[at]
        left = (left + (left * K_at[:, None, :]) @ S[at] @ parts.yu[at])[:, 0]
        by_loop = left * K_at * right / s[at][:, :1]
        slopes = np.hstack([by_loop.real, (np.sum(by_loop, axis=1)[:, None] * of_corners[at[1]]).real])
        return log_s[at], slopes, in_band[at]


def _minimax_step(
    values: np.ndarray, slopes: np.ndarray, in_band: np.ndarray, log_limit: float, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Step between low and high that minimises, to first order, the excess over the limit, then the band's maximum."""
    n = slopes.shape[1]
    # Unknowns: the step, the largest excess over the limit (at least 0), the maximum in the band.
    excess = np.hstack([slopes, -np.ones((values.size, 1)), np.zeros((values.size, 1))])
    level = np.hstack([slopes, np.zeros((values.size, 1)), -np.ones((values.size, 1))])[in_band]
    program = so.linprog(
        np.r_[np.zeros(n), 100.0, 1.0],
        A_ub=np.vstack([excess, level]),
        b_ub=np.r_[log_limit - values, -values[in_band]],
        bounds=[*zip(low, high, strict=True), (0, None), (None, None)],
        method="highs-ds",
    )
    return program.x[:n] if program.status == 0 else np.zeros(n)


def half_turns(curves: np.ndarray) -> np.ndarray:
    """Number of half turns of each curve (n, n_omega) about the origin over frequency, counter-clockwise positive."""
    phase = np.unwrap(np.angle(curves), axis=-1)
    turned: np.ndarray = np.round((phase[..., -1] - phase[..., 0]) / np.pi)
    return turned
