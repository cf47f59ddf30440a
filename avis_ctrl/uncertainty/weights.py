"""Weighting filters with a physical meaning: how large what comes in can be, and a user's own filter.

The weights on what is to stay small are written in `performance_weights`; all are reachable from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import Rational
from avis_ctrl.rigs.floor_motion import Quantity
from avis_ctrl.rigs.floor_spectrum import ONE_SIDED, SpectrumModel
from avis_ctrl.rigs.geophone import SensorChain
from avis_ctrl.uncertainty.performance_weights import (
    Band,
    ComplianceBound,
    ControlEffort,
    TransmissibilityBound,
    VibrationCriterion,
)
from avis_ctrl.uncertainty.weight_base import (
    Role,
    SamplingCheck,
    Weight,
    require,
    sampling_feasibility,
    smallest_cover,
)

__all__ = ["Band", "ComplianceBound", "ControlEffort", "FlickerNoise", "FloorMotion", "NeglectedDynamics",
           "RationalWeight", "SamplingCheck", "SensorNoise", "TransmissibilityBound", "VibrationCriterion", "Weight",
           "sampling_feasibility"]


@dataclass(frozen=True)
class FlickerNoise(Weight):
    """1/f noise of a sensor's electronics: sqrt(1 + flicker^2 / f) over its white noise.

    Parameters
    ----------
    flicker : density of the 1/f noise at 1 Hz over that of the white noise; its square is the corner [Hz].
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
        if not 0 <= self.flicker < np.inf:
            raise InputError("a finite number, zero or positive", field="flicker", value=self.flicker)

    def asked(self, omega: np.ndarray) -> np.ndarray:
        """The density over that of the white noise, at omega > 0 [rad/s]."""
        return np.sqrt(1 + self.flicker ** 2 / (np.asarray(omega, float) / (2 * np.pi)))

    @cached_property
    def shape(self) -> Rational:
        if not self.flicker:
            return Rational(1.0)
        corner = self.flicker ** 2
        # Far below and above, where the weight is constant, it must cover, too.
        omega = 2 * np.pi * np.geomspace(self.lowest_Hz / 100, 1000 * max(corner, self.lowest_Hz), 120)
        level = self.asked(np.maximum(omega, 2 * np.pi * self.lowest_Hz))
        return smallest_cover(omega, level, level, self.tolerance_dB, self.max_order, "the 1/f noise")

    @property
    def meaning(self) -> str:
        return (f"1/f noise of the sensors' electronics over their white noise, corner {self.flicker ** 2:.3g} Hz; "
                f"constant below {self.lowest_Hz:g} Hz; realised with {self.shape.order} states")


@dataclass(frozen=True, eq=False)
class SensorNoise(Weight):
    """Noise of a sensor chain: the filter covers its one-sided density with the smallest order.

    Parameters
    ----------
    omega : (n,) frequencies [rad/s].
    density : (n,) one-sided density [unit/sqrt(Hz)].
    of_what : words for the report.
    """

    omega: np.ndarray
    density: np.ndarray
    of_what: str = "sensor noise"
    tolerance_dB: float = 0.5
    max_order: int = 6

    role: ClassVar[Role] = "level"
    unit: ClassVar[str] = "unit of the signal/sqrt(Hz)"

    @staticmethod
    def from_chain(chain: SensorChain, low_Hz: float = 0.1, as_velocity: bool = False) -> SensorNoise:
        """The chain's noise from low_Hz to half its sample rate: in volts at the converter, or as case velocity."""
        high = chain.converter.sample_rate_Hz / 2
        require(low_Hz, "low_Hz", 0.0, high)
        omega = 2 * np.pi * np.geomspace(low_Hz, high, 120)
        density = chain.velocity_noise_density(omega) if as_velocity else chain.noise_density(omega)
        return SensorNoise(omega, density, "equivalent velocity noise, m/s/sqrt(Hz)" if as_velocity
                           else "voltage noise at the converter, V/sqrt(Hz)")

    @cached_property
    def shape(self) -> Rational:
        return smallest_cover(self.omega, self.density, self.density, self.tolerance_dB, self.max_order,
                              "the noise density")

    @property
    def meaning(self) -> str:
        return (f"{self.of_what}: {np.min(self.density):.3g} to {np.max(self.density):.3g} from "
                f"{self.omega[0] / (2 * np.pi):.3g} to {self.omega[-1] / (2 * np.pi):.3g} Hz")


@dataclass(frozen=True)
class FloorMotion(Weight):
    """Floor motion: the magnitude is the one-sided density of a spectrum model, per sqrt(Hz).

    As a velocity the model's displacement is multiplied by s + w instead of s, w a tenth of the lowest modelled
    frequency, so that the filter keeps a stable inverse; inside the modelled band that adds at most 0.5 %.
    """

    spectrum: SpectrumModel
    quantity: Quantity = "velocity"

    role: ClassVar[Role] = "level"
    unit: ClassVar[str] = "m or m/s per sqrt(Hz)"

    def __post_init__(self) -> None:
        if self.quantity not in ("displacement", "velocity"):
            raise InputError("displacement or velocity", field="quantity", value=self.quantity)

    @cached_property
    def shape(self) -> Rational:
        shape = self.spectrum.shape.scaled(ONE_SIDED)
        if self.quantity == "displacement":
            return shape
        slow = 2 * np.pi * self.spectrum.low_Hz / 10
        return Rational(shape.gain, shape.zero_pairs, shape.pole_pairs, (*shape.real_zeros, slow), shape.real_poles)

    @property
    def meaning(self) -> str:
        model = self.spectrum
        return (f"floor {self.quantity} of {model.name}, {model.low_Hz:.3g} to {model.high_Hz:.3g} Hz, fitted within "
                f"{model.error_rms_dB:.2g} dB r.m.s. ({model.source})")


@dataclass(frozen=True)
class NeglectedDynamics(Weight):
    """Relative uncertainty of a chain: `low` at rest, 1 at crossover_Hz exactly, `high` at high frequency.

    First order, W = (tau s + low)/(tau s/high + 1) (Skogestad and Postlethwaite, Multivariable Feedback Control,
    section 7.4), or the square of such a factor, which rises twice as fast. tau is solved so that |W| is 1 at the
    crossover, not only asymptotically.

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
        tau = np.sqrt((1 - a ** 2) / (1 - 1 / b ** 2)) / (2 * np.pi * self.crossover_Hz)
        return Rational(self.high, real_zeros=(float(a / tau),) * self.order,
                        real_poles=(float(b / tau),) * self.order)

    @property
    def meaning(self) -> str:
        return (f"relative uncertainty {100 * self.low:g} % at low frequency, 100 % at {self.crossover_Hz:g} Hz, "
                f"{100 * self.high:g} % at high frequency, order {self.order}")


@dataclass(frozen=True)
class RationalWeight(Weight):
    """A user's own filter: leading * prod(s - zeros) / prod(s - poles), roots in rad/s.

    Parameters
    ----------
    of_what : words for the report.
    bounded : "limit" (an output is to stay below 1/|W|) or "level" (an input is as large as |W|).
    unit_name : unit of the bound.

    Raises
    ------
    InputError : improper, a pole or zero on or right of the imaginary axis, a root that is not finite or lacks its
        conjugate, a leading coefficient that is not positive.
    """

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    leading: float
    of_what: str = "user's weight"
    bounded: Role = "limit"
    unit_name: str = ""

    def __post_init__(self) -> None:
        if self.bounded not in ("limit", "level"):
            raise InputError("limit or level", field="bounded", value=self.bounded)
        require(self.leading, "leading")
        if len(self.zeros) > len(self.poles):
            raise InputError(f"improper: {len(self.zeros)} zeros over {len(self.poles)} poles; at least as many poles "
                             "as zeros", field="zeros")
        _ = self.shape

    @staticmethod
    def from_polynomials(numerator: Sequence[float], denominator: Sequence[float], of_what: str = "user's weight",
                         bounded: Role = "limit", unit_name: str = "") -> RationalWeight:
        """From coefficients by descending power of s; an overall sign is dropped (it changes no bound)."""
        coefficients = {}
        for field, given in (("numerator", numerator), ("denominator", denominator)):
            try:
                c = np.trim_zeros(np.atleast_1d(np.asarray(given, float)), "f")
            except (TypeError, ValueError):
                c = np.zeros(0)
            if not c.size or c.ndim != 1 or not np.all(np.isfinite(c)):
                raise InputError("finite coefficients, not all zero", field=field, value=given)
            coefficients[field] = c
        num, den = coefficients["numerator"], coefficients["denominator"]
        return RationalWeight(tuple(np.roots(num).astype(complex)), tuple(np.roots(den).astype(complex)),
                              float(abs(num[0] / den[0])), of_what, bounded, unit_name)

    @property
    def role(self) -> Role:  # type: ignore[override]
        return self.bounded

    @property
    def unit(self) -> str:  # type: ignore[override]
        return self.unit_name

    @cached_property
    def shape(self) -> Rational:
        return Rational.from_roots(self.zeros, self.poles, self.leading)

    @property
    def meaning(self) -> str:
        verb = "to stay below 1/|W|" if self.bounded == "limit" else "as large as |W|"
        return f"{self.of_what}, {verb}, {self.shape.order} states" + (f" [{self.unit_name}]" if self.unit_name else "")
