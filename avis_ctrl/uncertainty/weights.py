"""Physical weighting filters: transmissibility, compliance, control effort, neglected dynamics, 1/f noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np

from avis_ctrl.checks import require, require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import Rational
from avis_ctrl.uncertainty.weight_base import Role, Weight, smallest_cover


@dataclass(frozen=True)
class Band:
    """A limit [dB] from low_Hz to high_Hz, in place of the overall one."""

    low_Hz: float
    high_Hz: float
    limit_dB: float

    def __post_init__(self) -> None:
        require(self.low_Hz, "low_Hz")
        require(self.high_Hz, "high_Hz", self.low_Hz)
        require(self.limit_dB, "limit_dB", -200.0, 200.0)


@dataclass(frozen=True)
class TransmissibilityBound(Weight):
    """Payload motion over floor motion: at most `overall_dB`, and in each band at most that band's limit.

    A rational filter has no steps. On the grid it is nowhere less strict than specified. Within `transition_octaves`
    outside a stricter band it may be stricter than specified, elsewhere by at most `tolerance_dB`. It has the lowest
    order that achieves this.

    Parameters
    ----------
    overall_dB : limit outside the bands.
    bands : they must not overlap.
    relaxed_below_Hz, relaxed_above_Hz : no limit beyond (None: the limit applies from a hundredth of the lowest to a
        hundred times the highest specified frequency, and the filter is flat outside).
    """

    overall_dB: float = 4.0
    bands: tuple[Band, ...] = ()
    transition_octaves: float = 0.5
    tolerance_dB: float = 0.5
    relaxed_below_Hz: float | None = None
    relaxed_above_Hz: float | None = None
    max_order: int = 8

    role: ClassVar[Role] = "limit"
    unit: ClassVar[str] = "m/m"

    def __post_init__(self) -> None:
        require(self.overall_dB, "overall_dB", -200.0, 200.0)
        require(self.transition_octaves, "transition_octaves")
        require(self.tolerance_dB, "tolerance_dB")
        ordered = sorted(self.bands, key=lambda band: band.low_Hz)
        for first, second in pairwise(ordered):
            if second.low_Hz < first.high_Hz:
                raise InputError(
                    f"bands that do not overlap; {first.low_Hz:g} to {first.high_Hz:g} Hz and "
                    f"{second.low_Hz:g} to {second.high_Hz:g} Hz do",
                    field="bands",
                )
        for field in ("relaxed_below_Hz", "relaxed_above_Hz"):
            if getattr(self, field) is not None:
                require(getattr(self, field), field)

    def asked(self, omega: np.ndarray) -> np.ndarray:
        """The limit as specified, with its steps; inf where there is no limit."""
        # A band includes its edges in spite of the rounding of 2 pi f.
        f, slack = np.asarray(omega, float) / (2 * np.pi), 1e-12
        limit = np.full(f.shape, 10 ** (self.overall_dB / 20))
        for band in self.bands:
            inside = (f >= band.low_Hz * (1 - slack)) & (f <= band.high_Hz * (1 + slack))
            limit = np.where(inside, 10 ** (band.limit_dB / 20), limit)
        low, high = self.relaxed_below_Hz or 0.0, self.relaxed_above_Hz or np.inf
        return np.where((f < low) | (f > high), np.inf, limit)

    @cached_property
    def shape(self) -> Rational:
        if not self.bands and self.relaxed_below_Hz is None and self.relaxed_above_Hz is None:
            return Rational(10 ** (-self.overall_dB / 20))
        omega = 2 * np.pi * self._grid(120, 15)
        lower = 1.0 / self.asked(omega)
        window = 2.0**self.transition_octaves
        first = np.searchsorted(omega, omega / window * (1 - 1e-9))
        last = np.searchsorted(omega, omega * window * (1 + 1e-9))
        upper = np.array([np.max(lower[i:j]) for i, j in zip(first, last, strict=True)])
        # Where there is no limit the filter may fall freely, but not rise.
        usual = 10 ** (-self.overall_dB / 20)
        upper = np.where(upper > 0, upper, usual)
        level = np.log(np.where(lower > 0, lower, usual))
        # The search starts from straight flanks, in double-logarithmic axes, across the transitions.
        slope = np.ptp(level) / np.log(window)
        distance = np.abs(np.log(omega[:, None] / omega))
        target = np.exp(np.max(level - slope * distance, axis=1))
        lower = np.where(lower > 0, lower, 1e-4 * usual)
        shape = smallest_cover(
            omega, lower, upper, self.tolerance_dB, self.max_order, "the transmissibility bound", target
        )
        dense = 2 * np.pi * self._grid(4000, 400)
        # 1e-4 covers violations between the dense points.
        return shape.scaled(max(1.0, float(np.max(1.0 / (self.asked(dense) * shape.magnitude(dense)))) * (1 + 1e-4)))

    def _grid(self, points: int, fine_points: int) -> np.ndarray:
        """Frequencies [Hz], evenly spaced in logarithm, dense about every step and on both sides of it."""
        steps = [edge for band in self.bands for edge in (band.low_Hz, band.high_Hz)]
        steps += [f for f in (self.relaxed_below_Hz, self.relaxed_above_Hz) if f is not None]
        window = 2.0**self.transition_octaves
        fine = [np.geomspace(f / window, f * window, fine_points) for f in steps]
        sides = [f * (1 + side) for f in steps for side in (-1e-6, 0.0, 1e-6)]
        grid = np.sort(np.concatenate([np.geomspace(min(steps) / 100, max(steps) * 100, points), *fine, sides]))
        return grid[np.concatenate([[True], np.diff(grid) > 1e-9 * grid[1:]])]

    @property
    def meaning(self) -> str:
        parts = [f"at most {band.limit_dB:+g} dB from {band.low_Hz:g} to {band.high_Hz:g} Hz" for band in self.bands]
        return (
            f"transmissibility at most {self.overall_dB:+g} dB"
            + "".join(f", {part}" for part in parts)
            + f"; realised with {self.shape.order} states, stricter than this bound by up to "
            f"{self.tolerance_dB:g} dB, and by more within {self.transition_octaves:g} octave of a stricter band"
        )


@dataclass(frozen=True)
class ComplianceBound(Weight):
    """Payload displacement per force on the payload: at most limit_m_per_N.

    Parameters
    ----------
    limit_m_per_N : limit in the middle band.
    static_limit_m_per_N, corner_Hz : below the corner the limit rises to the static limit (velocity feedback cannot
        stiffen the rig at zero frequency); both or neither.
    relaxed_above_Hz : above it the limit rises in proportion to frequency (the payload's mass dominates).
    """

    limit_m_per_N: float
    static_limit_m_per_N: float | None = None
    corner_Hz: float | None = None
    relaxed_above_Hz: float | None = None

    role: ClassVar[Role] = "limit"
    unit: ClassVar[str] = "m/N"

    def __post_init__(self) -> None:
        require(self.limit_m_per_N, "limit_m_per_N")
        if (self.static_limit_m_per_N is None) != (self.corner_Hz is None):
            raise InputError(
                "static_limit_m_per_N and corner_Hz belong together: give both or neither",
                field="corner_Hz",
                value=self.corner_Hz,
            )
        if self.static_limit_m_per_N is not None and self.corner_Hz is not None:
            require(self.static_limit_m_per_N, "static_limit_m_per_N", self.limit_m_per_N)
            require(self.corner_Hz, "corner_Hz")
        if self.relaxed_above_Hz is not None:
            require(self.relaxed_above_Hz, "relaxed_above_Hz")

    @cached_property
    def shape(self) -> Rational:
        gain, zeros, poles = 1.0 / self.limit_m_per_N, [], []
        if self.static_limit_m_per_N is not None and self.corner_Hz is not None:
            poles.append(2 * np.pi * self.corner_Hz)
            zeros.append(poles[0] * self.limit_m_per_N / self.static_limit_m_per_N)
        if self.relaxed_above_Hz is not None:
            poles.append(2 * np.pi * self.relaxed_above_Hz)
            gain *= poles[-1]
        return Rational(gain, real_zeros=tuple(zeros), real_poles=tuple(poles))

    @property
    def meaning(self) -> str:
        text = f"compliance at most {self.limit_m_per_N:.3g} m/N"
        if self.static_limit_m_per_N is not None:
            text += f", rising below {self.corner_Hz:g} Hz to {self.static_limit_m_per_N:.3g} m/N at rest"
        return text + (f", rising above {self.relaxed_above_Hz:g} Hz" if self.relaxed_above_Hz else "")


@dataclass(frozen=True)
class ControlEffort(Weight):
    """Voltage of an actuator: at most its limit if the disturbance has the expected level.

    W = (level / limit) ((s/wb + 1)/(s/(R wb) + 1))^order: up to wb the full limit may be used, far above it only
    the fraction 1/R^order, so that the controller rolls off. Below a corner w0, W is larger by the factor
    (s + k w0)/(s + w0), k = sqrt(1 + offset^2), so that the controller also rolls off towards zero frequency.

    Parameters
    ----------
    limit_V : actuator limit.
    disturbance_level : disturbance, in the unit of the plant's disturbance input, that may use the full limit.
    bandwidth_Hz : wb; None for a constant weight.
    reduction : R > 1, factor per order by which the allowed voltage is smaller far above wb.
    order : 1 or 2.
    offset, offset_corner_Hz : constant offset of the same input, relative to its unit, 0 for none; it may drift with
        frequencies up to the corner.
    """

    limit_V: float
    disturbance_level: float = 1.0
    bandwidth_Hz: float | None = None
    reduction: float = 10.0
    order: int = 1
    offset: float = 0.0
    offset_corner_Hz: float = 0.003

    role: ClassVar[Role] = "limit"
    unit: ClassVar[str] = "V per unit of disturbance"

    def __post_init__(self) -> None:
        require(self.limit_V, "limit_V")
        require(self.disturbance_level, "disturbance_level")
        require(self.reduction, "reduction", 1.0)
        if self.bandwidth_Hz is not None:
            require(self.bandwidth_Hz, "bandwidth_Hz")
        require(self.offset_corner_Hz, "offset_corner_Hz")
        require_positive(self.offset, "offset", zero_allowed=True)
        if self.order not in (1, 2):
            raise InputError("1 or 2", field="order", value=self.order)

    @cached_property
    def shape(self) -> Rational:
        gain, w0 = self.disturbance_level / self.limit_V, 2 * np.pi * self.offset_corner_Hz
        zeros, poles = ((w0 * np.hypot(1, self.offset),), (w0,)) if self.offset else ((), ())
        if self.bandwidth_Hz is None:
            return Rational(gain, real_zeros=zeros, real_poles=poles)
        wb = 2 * np.pi * self.bandwidth_Hz
        return Rational(
            gain * self.reduction**self.order,
            real_zeros=(*zeros, *(wb,) * self.order),
            real_poles=(*poles, *(self.reduction * wb,) * self.order),
        )

    @property
    def meaning(self) -> str:
        text = f"at most {self.limit_V:g} V when the disturbance has the level {self.disturbance_level:.3g}"
        if self.offset:
            text += (
                f"; {np.hypot(1, self.offset):.3g} times stricter below {self.offset_corner_Hz:g} Hz, for the "
                "offset of the electronics"
            )
        if self.bandwidth_Hz is None:
            return text
        return text + (
            f" up to {self.bandwidth_Hz:g} Hz, falling with order {self.order} to a fraction "
            f"{self.reduction**-self.order:.2g} of it"
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

    role: ClassVar[Role] = "level"
    unit: ClassVar[str] = "white noise"

    def __post_init__(self) -> None:
        require(self.lowest_Hz, "lowest_Hz")
        require_positive(self.flicker, "flicker", zero_allowed=True)

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

    First order, W = (tau s + low)/(tau s/high + 1) (Skogestad and Postlethwaite, Multivariable Feedback Control,
    section 7.4), or the square of such a factor, which rises twice as fast. tau is computed so that |W| = 1
    exactly at the crossover, not only asymptotically.

    Raises InputError unless 0 < low < 1 < high.
    """

    low: float = 0.1
    crossover_Hz: float = 80.0
    high: float = 3.0
    order: int = 1

    role: ClassVar[Role] = "level"
    unit: ClassVar[str] = "relative"

    def __post_init__(self) -> None:
        require(self.low, "low", 0.0, 1.0)
        require(self.high, "high", 1.0)
        require(self.crossover_Hz, "crossover_Hz")
        if self.order not in (1, 2):
            raise InputError("1 or 2", field="order", value=self.order)

    @cached_property
    def shape(self) -> Rational:
        # |W|^(2/order) with zero at a/tau and pole at b/tau: (x + a^2)/(x/b^2 + 1) = 1 with x = (tau w)^2
        a, b = self.low ** (1 / self.order), self.high ** (1 / self.order)
        tau = np.sqrt((1 - a**2) / (1 - 1 / b**2)) / (2 * np.pi * self.crossover_Hz)
        return Rational(self.high, real_zeros=(float(a / tau),) * self.order, real_poles=(float(b / tau),) * self.order)

    @property
    def meaning(self) -> str:
        return (
            f"relative uncertainty {100 * self.low:g} % at low frequency, 100 % at {self.crossover_Hz:g} Hz, "
            f"{100 * self.high:g} % at high frequency, order {self.order}"
        )
