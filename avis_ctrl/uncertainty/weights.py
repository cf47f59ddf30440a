"""Physical weighting filters: transmissibility, compliance, control effort, neglected dynamics, 1/f noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from avis_ctrl.lti.rational import Rational
from avis_ctrl.uncertainty.weight_base import Weight, smallest_cover


@dataclass(frozen=True)
class TransmissibilityBound(Weight):
    """Payload motion over floor motion: at most `peak_dB`, and inside band_Hz at most band_dB.

    A rational filter has no steps. On the grid it is nowhere less strict than specified. Within `transition_octaves`
    outside a stricter band it may be stricter than specified, elsewhere by about `tolerance_dB` at most (`excess_dB` is
    the result). It has the lowest order that achieves this. The limit applies from a hundredth of the lower to a
    hundred times the upper edge of the band, and the filter is flat outside.
    """

    peak_dB: float
    band_Hz: tuple[float, float]
    band_dB: float
    transition_octaves: float
    tolerance_dB: float
    max_order: int = 8

    def asked(self, omega: np.ndarray) -> np.ndarray:
        """The limit as specified, with its steps."""
        # The band includes its edges in spite of the rounding of 2 pi f.
        f, slack, (low, high) = np.asarray(omega, float) / (2 * np.pi), 1e-12, self.band_Hz
        inside = (f >= low * (1 - slack)) & (f <= high * (1 + slack))
        return np.where(inside, 10 ** (self.band_dB / 20), 10 ** (self.peak_dB / 20))

    @cached_property
    def shape(self) -> Rational:
        omega = 2 * np.pi * self._grid(120, 15)
        lower = 1.0 / self.asked(omega)
        window = 2.0**self.transition_octaves
        first = np.searchsorted(omega, omega / window * (1 - 1e-9))
        last = np.searchsorted(omega, omega * window * (1 + 1e-9))
        upper = np.array([np.max(lower[i:j]) for i, j in zip(first, last, strict=True)])
        # The search starts from straight flanks, in double-logarithmic axes, across the transitions.
        level = np.log(lower)
        slope = np.ptp(level) / np.log(window)
        distance = np.abs(np.log(omega[:, None] / omega))
        target = np.exp(np.max(level - slope * distance, axis=1))
        shape = smallest_cover(
            omega, lower, upper, self.tolerance_dB, self.max_order, "the transmissibility bound", target
        )
        dense = 2 * np.pi * self._dense
        # 1e-4 covers violations between the dense points.
        return shape.scaled(max(1.0, float(np.max(1.0 / (self.asked(dense) * shape.magnitude(dense)))) * (1 + 1e-4)))

    @cached_property
    def _dense(self) -> np.ndarray:
        """Frequencies [Hz] at which the filter is compared with the bounds."""
        return self._grid(4000, 400)

    def _grid(self, points: int, fine_points: int) -> np.ndarray:
        """Frequencies [Hz], evenly spaced in logarithm, dense about both steps and on both sides of them."""
        low, high = self.band_Hz
        window = 2.0**self.transition_octaves
        fine = [np.geomspace(f / window, f * window, fine_points) for f in (low, high)]
        sides = [f * (1 + side) for f in (low, high) for side in (-1e-6, 0.0, 1e-6)]
        grid = np.sort(np.concatenate([np.geomspace(low / 100, high * 100, points), *fine, sides]))
        return grid[np.concatenate([[True], np.diff(grid) > 1e-9 * grid[1:]])]

    @property
    def meaning(self) -> str:
        low, high = self.band_Hz
        return (
            f"transmissibility at most {self.peak_dB:+g} dB, at most {self.band_dB:+g} dB from {low:g} to {high:g} Hz; "
            f"realised with {self.shape.order} states; more than {self.transition_octaves:g} octave from the edges of "
            f"the band, it is up to {self.excess_dB:.2g} dB stricter than these bounds"
        )

    @cached_property
    def excess_dB(self) -> float:
        """By how much the filter is stricter than the bounds, at most, outside the transitions [dB]."""
        away = np.min(np.abs(np.log2(self._dense[:, None] / np.array(self.band_Hz))), axis=1)
        omega = 2 * np.pi * self._dense[away >= self.transition_octaves]
        return float(20 * np.log10(np.max(self.asked(omega) * self.shape.magnitude(omega))))


@dataclass(frozen=True)
class ComplianceBound(Weight):
    """Payload displacement per force on the payload: at most limit_m_per_N."""

    limit_m_per_N: float

    @property
    def shape(self) -> Rational:
        return Rational(1.0 / self.limit_m_per_N)

    @property
    def meaning(self) -> str:
        return f"compliance at most {self.limit_m_per_N:.3g} m/N"


@dataclass(frozen=True)
class ControlEffort(Weight):
    """Voltage of an actuator: at most its limit if the floor has the expected velocity.

    W = (velocity / limit) (s/wb + 1)/(s/(R wb) + 1): up to wb the full limit may be used, far above it only the
    fraction 1/R, so that the controller rolls off. Below a corner w0, W is larger by the factor (s + k w0)/(s + w0),
    k = sqrt(1 + offset^2), so that the controller also rolls off towards zero frequency.

    Parameters
    ----------
    limit_V : actuator limit.
    floor_velocity_m_per_s : floor velocity (of the table's edge for rotations) that may use the full limit.
    bandwidth_Hz : wb.
    reduction : R > 1, factor by which the allowed voltage is smaller far above wb.
    offset, offset_corner_Hz : constant offset of the same input, relative to its unit, 0 for none; it may drift with
        frequencies up to the corner.
    """

    limit_V: float
    floor_velocity_m_per_s: float
    bandwidth_Hz: float
    reduction: float
    offset: float
    offset_corner_Hz: float

    @cached_property
    def shape(self) -> Rational:
        gain, w0 = self.floor_velocity_m_per_s / self.limit_V, 2 * np.pi * self.offset_corner_Hz
        zeros, poles = ((w0 * np.hypot(1, self.offset),), (w0,)) if self.offset else ((), ())
        wb = 2 * np.pi * self.bandwidth_Hz
        return Rational(gain * self.reduction, real_zeros=(*zeros, wb), real_poles=(*poles, self.reduction * wb))

    @property
    def meaning(self) -> str:
        text = (
            f"at most {self.limit_V:g} V for a floor velocity of {self.floor_velocity_m_per_s:.3g} m/s, up to "
            f"{self.bandwidth_Hz:g} Hz; above that the permitted voltage falls at 20 dB per decade to "
            f"{1 / self.reduction:.2g} times this value"
        )
        if not self.offset:
            return text
        return (
            f"{text}; below {self.offset_corner_Hz:g} Hz it is {np.hypot(1, self.offset):.3g} times smaller, because "
            "of the offset of the electronics"
        )


@dataclass(frozen=True)
class FlickerNoise(Weight):
    """1/f noise of a sensor's electronics: density sqrt(1 + flicker^2 / f) relative to its white noise.

    Parameters
    ----------
    flicker : density of the 1/f noise at 1 Hz relative to that of the white noise; its square is the corner [Hz].
    lowest_Hz : below it the weight is constant.
    """

    flicker: float
    lowest_Hz: float
    tolerance_dB: float = 1.0
    max_order: int = 4

    def asked(self, omega: np.ndarray) -> np.ndarray:
        """Noise density relative to that of the white noise, at omega > 0 [rad/s]."""
        return np.sqrt(1 + self.flicker**2 / (np.asarray(omega, float) / (2 * np.pi)))

    @cached_property
    def shape(self) -> Rational:
        if not self.flicker:
            return Rational(1.0)
        corner = self.flicker**2
        # The filter must also cover far below and far above, where the weight is constant.
        omega = 2 * np.pi * np.geomspace(self.lowest_Hz / 100, 1000 * max(corner, self.lowest_Hz), 120)
        level = self.asked(np.maximum(omega, 2 * np.pi * self.lowest_Hz))
        return smallest_cover(omega, level, level, self.tolerance_dB, self.max_order, "the 1/f noise")

    @property
    def meaning(self) -> str:
        return (
            f"1/f noise of the sensors' electronics over their white noise, corner {self.flicker**2:.3g} Hz; "
            f"constant below {self.lowest_Hz:g} Hz; realised with {self.shape.order} states"
        )


@dataclass(frozen=True)
class NeglectedDynamics(Weight):
    """Relative uncertainty of a channel: `low` at low frequency, exactly 1 at crossover_Hz, `high` at high frequency.

    W = (tau s + low)/(tau s/high + 1) with 0 < low < 1 < high (Skogestad and Postlethwaite, Multivariable Feedback
    Control, section 7.4). tau is computed so that |W| = 1 exactly at the crossover, not only asymptotically.
    """

    low: float
    crossover_Hz: float
    high: float

    @cached_property
    def shape(self) -> Rational:
        # |W|^2 = (x + low^2)/(x/high^2 + 1) = 1 with x = (tau w)^2
        tau = np.sqrt((1 - self.low**2) / (1 - 1 / self.high**2)) / (2 * np.pi * self.crossover_Hz)
        return Rational(self.high, real_zeros=(float(self.low / tau),), real_poles=(float(self.high / tau),))

    @property
    def meaning(self) -> str:
        return (
            f"relative uncertainty {100 * self.low:g} % at low frequency, 100 % at {self.crossover_Hz:g} Hz, "
            f"{100 * self.high:g} % at high frequency, realised with one state"
        )
