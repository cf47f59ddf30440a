"""A weight that covers the spread of a measured frequency response about an identified model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.rational import Rational
from avis_ctrl.uncertainty.weight_base import Weight, smallest_cover
from avis_ctrl.uncertainty.weights import NeglectedDynamics


@dataclass(frozen=True)
class SpreadSettings:
    """points_per_octave : frequencies of the fit added between the data: the steep envelope changes by 1.5 dB at most
        from one to the next.
    reach : factor in frequency [1] by which the fit extends beyond the data (and beyond a declared crossover), so that
        the filter follows the ends of the envelope.
    dense : number of frequencies at which the filter is compared with the envelope between the points of the fit.
    between : relative amount by which the filter may be below the envelope there [1].
    slopes, orders : slopes of the envelope [decades per decade] and largest orders of its filter: the flatter envelope
        is used if order 6 cannot follow the steep one.
    """

    points_per_octave: int = 8
    reach: float = 10.0
    dense: int = 4000
    between: float = 1e-4
    slopes: tuple[float, ...] = (2.0, 1.0)
    orders: tuple[int, ...] = (6, 12)


SETTINGS = SpreadSettings()


@dataclass(frozen=True, eq=False)
class IdentifiedSpread(Weight):
    """Relative error of a model's response: covers the measured data and a declared uncertainty.

    The envelope is the smallest curve above the data with slopes of at most `slope` decades per decade, constant
    outside the measured band, or `declared` where that is larger. The filter has the lowest order with which it is
    above the envelope by about `tolerance_dB` at most (`slack_dB` is the result).

    Parameters
    ----------
    omega, data : (n,) frequencies [rad/s] and relative spread.
    declared : relative uncertainty stated by the user, multiplied by `factor`; None for none.

    Raises
    ------
    InputError : data or frequencies that are not positive and finite, frequencies that do not increase.
    """

    omega: np.ndarray
    data: np.ndarray
    declared: NeglectedDynamics | None = None
    factor: float = 1.0
    slope: float = 1.0
    tolerance_dB: float = 1.0
    max_order: int = 12

    def __post_init__(self) -> None:
        omega, data = np.asarray(self.omega, float), np.asarray(self.data, float)
        if omega.ndim != 1 or omega.shape != data.shape or omega.size < 2:
            raise InputError(f"expected two vectors of one length, got {omega.shape} and {data.shape}", field="data")
        for name, values, rising in (("omega", omega, True), ("data", data, False)):
            if not (np.all(np.isfinite(values)) and np.all(values > 0)) or (rising and np.any(np.diff(values) <= 0)):
                raise InputError(f"expected finite positive numbers{', increasing' if rising else ''}", field=name)

    @cached_property
    def grid(self) -> np.ndarray:
        """Frequencies [rad/s] of the fit: those of the data and a decade on either side, or beyond a crossover."""
        low, high = self.omega[0] / SETTINGS.reach, self.omega[-1] * SETTINGS.reach
        if self.declared is not None:
            high = max(high, 2 * np.pi * self.declared.crossover_Hz * SETTINGS.reach)
        density = SETTINGS.points_per_octave
        even = np.geomspace(low, high, int(density * np.log2(high / low)) + 1)
        apart = np.min(np.abs(np.log(even[:, None] / self.omega)), axis=1) > 0.25 * np.log(2) / density
        return np.sort(np.concatenate([even[apart], self.omega]))

    def envelope(self, omega: np.ndarray) -> np.ndarray:
        """The curve that the filter has to cover, at the frequencies omega [rad/s]."""
        omega = np.asarray(omega, float)
        inside = np.log(np.clip(omega, self.omega[0], self.omega[-1]))
        fall = self.slope * np.abs(inside[:, None] - np.log(self.omega))
        covered = np.exp(np.max(np.log(self.data) - fall, axis=1))
        return covered if self.declared is None else np.maximum(covered, self.factor * self.declared.magnitude(omega))

    @cached_property
    def shape(self) -> Rational:
        curve = self.envelope(self.grid)
        shape = smallest_cover(self.grid, curve, curve, self.tolerance_dB, self.max_order, "the identified spread")
        lacking = float(np.max(self.envelope(self._dense) / shape.magnitude(self._dense)))
        return shape.scaled(lacking * (1 + SETTINGS.between)) if lacking > 1 + SETTINGS.between else shape

    @cached_property
    def _dense(self) -> np.ndarray:
        """Frequencies [rad/s] on and between those of the fit, and beyond them."""
        low, high = self.grid[0] / SETTINGS.reach, self.grid[-1] * SETTINGS.reach
        return np.union1d(self.grid, np.geomspace(low, high, SETTINGS.dense))

    @cached_property
    def slack_dB(self) -> float:
        """Maximum excess of the filter over the envelope."""
        return float(20 * np.max(np.log10(self.shape.magnitude(self._dense) / self.envelope(self._dense))))

    @property
    def meaning(self) -> str:
        low, high = (self.omega[k] / (2 * np.pi) for k in (0, -1))
        text = (
            f"measured relative uncertainty of the response: {100 * np.min(self.data):.2g} to "
            f"{100 * np.max(self.data):.2g} % from {low:.3g} to {high:.3g} Hz; the filter of order "
            f"{self.shape.order} lies at most {self.slack_dB:.2f} dB above an envelope with slopes of at most "
            f"{20 * self.slope:g} dB per decade, constant outside the band"
        )
        return (
            text
            if self.declared is None
            else f"{text}; or the uncertainty stated for the drives, where it is larger: {self.declared.meaning}"
        )


def covering_spread(
    omega: np.ndarray, data: np.ndarray, declared: NeglectedDynamics | None = None, factor: float = 1.0
) -> IdentifiedSpread:
    """Filter above an envelope with slopes of 40 dB per decade if order 6 suffices, otherwise of 20 dB per decade.

    Raises
    ------
    InputError : as `IdentifiedSpread`. ComputationError : order 12 does not suffice for the flatter envelope.
    """
    steep, flat = (
        IdentifiedSpread(omega, data, declared, factor, slope, max_order=order)
        for slope, order in zip(SETTINGS.slopes, SETTINGS.orders, strict=True)
    )
    try:
        _ = steep.shape
    except ComputationError:
        _ = flat.shape
        return flat
    return steep
