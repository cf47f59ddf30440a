"""What every weighting filter has: a rational shape, a physical unit, a bound, and its meaning in words."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.magnitude_fit import covering_fits
from avis_ctrl.lti.rational import Rational
from avis_ctrl.lti.statespace import StateSpace

Role = Literal["limit", "level"]


class Weight(ABC):
    """A scalar weighting filter: stable, minimum phase, proper.

    A weight with role "limit" multiplies an output that is to stay below `bound`: W = 1/bound. A weight with role
    "level" multiplies a normalised input to make it as large as `bound` says it can be: W = bound.
    """

    role: ClassVar[Role]
    unit: ClassVar[str]

    @property
    @abstractmethod
    def shape(self) -> Rational:
        """The filter."""

    @property
    @abstractmethod
    def meaning(self) -> str:
        """What the weight stands for, in words and numbers."""

    def system(self, input: str = "u", output: str = "y") -> StateSpace:
        """The filter as a system with those signal names."""
        return self.shape.system(input, output)

    def magnitude(self, omega: np.ndarray) -> np.ndarray:
        """|W(j omega)| at the frequencies omega [rad/s]."""
        return self.shape.magnitude(omega)

    def bound(self, omega: np.ndarray) -> np.ndarray:
        """What the filter bounds, as realised, in `unit`, at the frequencies omega [rad/s]."""
        magnitude = self.magnitude(omega)
        return 1.0 / magnitude if self.role == "limit" else magnitude


def smallest_cover(omega: np.ndarray, lower: np.ndarray, upper: np.ndarray, tolerance_dB: float, max_order: int,
                   what: str, target: np.ndarray | None = None) -> Rational:
    """The filter of lowest order with |W| >= lower and at most tolerance_dB above upper.

    Raises ComputationError with the excess reached where `max_order` is too low.
    """
    excess = np.inf
    for fit in covering_fits(omega, lower, upper, range(max_order + 1), target):
        excess = min(excess, fit.error_max_dB)
        if fit.error_max_dB <= tolerance_dB:
            return fit.function
    raise ComputationError(f"no filter of order {max_order} realises {what}",
                           measured=f"{excess:.2f} dB above it, {tolerance_dB:g} dB allowed",
                           cause="a step too steep for the order", next_step="widen the transition, allow a higher "
                           "order or a larger tolerance")


@dataclass(frozen=True)
class SamplingCheck:
    """Whether a filter can run at a sample rate, with the numbers behind it.

    `pole_to_nyquist` is the magnitude of the fastest pole over pi times the sample rate [rad/s over rad/s].
    """

    fastest_pole_rad_s: float
    sample_rate_Hz: float
    pole_to_nyquist: float
    feasible: bool
    words: str


def sampling_feasibility(filter: Weight | StateSpace, sample_rate_Hz: float) -> SamplingCheck:
    """Whether the fastest pole of a weight or system leaves room at a sample rate.

    Up to a fifth of the Nyquist frequency a bilinear (Tustin) discretisation warps the pole by less than 3.5 %
    (tan x / x at x = 0.1 pi); up to the Nyquist frequency it runs but is warped; beyond it the pole is not represented.

    Raises InputError for a rate that is not positive or a system that is already sampled.
    """
    if not (np.isfinite(sample_rate_Hz) and sample_rate_Hz > 0):
        raise InputError("a finite number greater than zero", field="sample_rate_Hz", value=sample_rate_Hz)
    system = filter.system() if isinstance(filter, Weight) else filter
    if system.dt:
        raise InputError(f"a continuous system; this one is sampled at {system.dt:g} s", field="filter")
    fastest = float(np.max(np.abs(system.poles()), initial=0.0))
    nyquist = np.pi * sample_rate_Hz
    ratio = fastest / nyquist
    verdict = ("can be sampled" if ratio <= 0.2 else
               "can be sampled, but its fastest pole is warped" if ratio < 1.0 else
               "cannot be sampled at this rate: slow the filter down or sample faster")
    return SamplingCheck(fastest, float(sample_rate_Hz), ratio, ratio < 1.0,
                         f"fastest pole {fastest:.4g} rad/s ({fastest / (2 * np.pi):.4g} Hz), "
                         f"{ratio:.2g} of the Nyquist frequency at {sample_rate_Hz:g} Hz: {verdict}")


def require(value: float, field: str, low: float = 0.0, high: float = np.inf) -> None:
    """Raise InputError naming the field unless low < value < high, a finite number."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not (number and np.isfinite(value) and low < value < high):
        span = f"greater than {low:g}" if np.isinf(high) else f"between {low:g} and {high:g}"
        raise InputError(f"a finite number {span}", field=field, value=value)
