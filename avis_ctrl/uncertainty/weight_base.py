"""Base class of weighting filters: a rational shape, a bound, and a description."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.magnitude_fit import covering_fits
from avis_ctrl.lti.rational import Rational
from avis_ctrl.lti.statespace import StateSpace


class Weight(ABC):
    """A scalar weighting filter: stable, minimum phase, proper.

    It multiplies an output that must stay below `limit`, or a normalised input to scale it to its maximum size.
    """

    @property
    @abstractmethod
    def shape(self) -> Rational:
        """The filter."""

    @property
    @abstractmethod
    def meaning(self) -> str:
        """Description of the weight in words and numbers."""

    def system(self, input: str = "u", output: str = "y") -> StateSpace:
        """The filter as a system with those signal names."""
        return self.shape.system(input, output)

    def magnitude(self, omega: np.ndarray) -> np.ndarray:
        """|W(j omega)| at the frequencies omega [rad/s]."""
        return self.shape.magnitude(omega)

    def limit(self, omega: np.ndarray) -> np.ndarray:
        """1/|W(j omega)|: the limit on an output that the filter multiplies."""
        return 1.0 / self.magnitude(omega)


def smallest_cover(
    omega: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    tolerance_dB: float,
    max_order: int,
    what: str,
    target: np.ndarray | None = None,
) -> Rational:
    """The filter of lowest order with |W| >= lower and at most tolerance_dB above upper.

    Raises ComputationError, with the excess reached, if `max_order` is too low.
    """
    excess = np.inf
    for fit in covering_fits(omega, lower, upper, range(max_order + 1), target):
        excess = min(excess, fit.error_max_dB)
        if fit.error_max_dB <= tolerance_dB:
            return fit.function
    raise ComputationError(
        f"no filter of order {max_order} realises {what}",
        measured=f"{excess:.2f} dB above it, {tolerance_dB:g} dB allowed",
        cause="a step too steep for the order",
        next_step="widen the transition, allow a higher order or a larger tolerance",
    )
