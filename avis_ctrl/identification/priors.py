"""Priors of a rig's parameters: re-identified parameters, and the tolerances of what the rig file states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr

from avis_ctrl.identification.fit_settings import SETTINGS, FitSettings
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import AMPLIFIERS, ResponseModel, positive
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True, eq=False)
class Priors:
    """Normal priors of free parameters: value = mean + sigma z, z standard normal; for positive parameters, of log
    value.

    names : (n,). mean, sigma : (n,), in the parameters' units; for a positive parameter sigma is that of the logarithm.
    positive : (n,) bool. low, high : bounds of the values.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sigma: np.ndarray
    positive: np.ndarray
    low: np.ndarray | float = -np.inf
    high: np.ndarray | float = np.inf

    def values(self, z: np.ndarray) -> np.ndarray:
        """(n,) values of the parameters at standardised values z (n,)."""
        found = np.where(
            self.positive, self.mean * np.exp(np.where(self.positive, self.sigma, 0.0) * z), self.mean + self.sigma * z
        )
        # At its bound a parameter has exactly that value, regardless of rounding.
        low, high = self.bounds
        return np.clip(np.where(z <= low, self.low, np.where(z >= high, self.high, found)), self.low, self.high)

    def z(self, values: np.ndarray) -> np.ndarray:
        """(n,) standardised values; the inverse of `values`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.positive, np.log(values / self.mean) / self.sigma, (values - self.mean) / self.sigma)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: standardised values at the lower and upper bound; infinite without a bound."""
        low, high = (np.broadcast_to(one, len(self.names)).astype(float) for one in (self.low, self.high))
        # A positive parameter has no minimum standardised value if its lower bound is zero or less.
        low = np.where(self.positive & (low <= 0), -np.inf, low)
        z_low, z_high = (np.where(np.isinf(one), one, self.z(one)) for one in (low, high))
        return z_low, z_high

    @cached_property
    def log_inside(self) -> float:
        """Logarithm of the probability of the normal distributions inside the bounds, by which the prior is divided."""
        low, high = self.bounds
        return float(np.sum(np.log(ndtr(high) - ndtr(low))))

    def followed_by(self, other: Priors) -> Priors:
        """Both sets, concatenated."""

        def both(name: str) -> np.ndarray:
            return np.concatenate([np.broadcast_to(getattr(one, name), len(one.names)) for one in (self, other)])

        return Priors((*self.names, *other.names), *map(both, _FIELDS))

    def of(self, names: Sequence[str]) -> Priors:
        """Priors of some parameters, in their order. Raises ValueError for a name that is not among them."""
        rows = [self.names.index(name) for name in names]
        return Priors(
            tuple(names), *(np.broadcast_to(getattr(self, field), len(self.names))[rows] for field in _FIELDS)
        )

    def scaled(self, rows: Sequence[int], factor: float) -> Priors:
        """The priors with some standard deviations multiplied by a factor."""
        sigma = self.sigma.copy()
        sigma[rows] *= factor
        return replace(self, sigma=sigma)

    @cached_property
    def _adds(self) -> np.ndarray:
        """(n,) which parameters are positive and add up: masses, stiffnesses and dampings, but not gains."""
        return self.positive & np.array([not name.startswith(_GAINS) for name in self.names], bool)

    def stepped(self, z: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n,) standardised values whose parameters have moved as they would to first order from z to `end`.

        Gains multiply each other, so the step is one of their logarithms. Masses, stiffnesses and dampings add up:
        where the data determine a sum of dampings but not each of them, equal and opposite steps of two logarithms
        would change the sum, and a fit would need ever shorter steps. The step is therefore one of these parameters
        themselves, and shorter if one would lose more than half of its value.
        """
        low, high = self.bounds
        # A step that ends at a bound ends there exactly.
        moving = self._adds & (end > low) & (end < high)
        sigma = np.where(moving, self.sigma, 1.0)
        change = np.where(moving, sigma * (end - z), 0.0)
        moved = np.where(change > -0.5, np.log1p(np.maximum(change, -0.5)), np.log(0.5) + 2 * (change + 0.5))
        return np.clip(np.where(moving, z + moved / sigma, end), low, high)

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """(n,) derivative of the values by z."""
        return np.where(self.positive, self.sigma * self.values(z), self.sigma)


# The names of gains start with these.
_GAINS = ("sensor.", "actuator.")
_FIELDS = ("mean", "sigma", "positive", "low", "high")


def re_identified(rig: Rig, settings: FitSettings = SETTINGS) -> Priors:
    """Priors of mass, moments of inertia, stiffness and damping: free in every identification."""
    known, names = rig.parameters(), default_parameters(rig)
    mean = np.array([known[name].value for name in names])
    damping = np.array([known[name].unit.startswith("N s") or known[name].unit.startswith("N m s") for name in names])
    sigma = np.asarray(np.where(damping, settings.damping_percent, settings.stiffness_percent)) / 100
    return Priors(names, mean, sigma, np.ones(len(names), bool))


def with_tolerances(model: ResponseModel, tolerances: Tolerances, settings: FitSettings = SETTINGS) -> Priors:
    """`re_identified`, and every value of the rig file that has a tolerance; the model has separate channels."""
    first = re_identified(model.rig, settings)
    return first.followed_by(beside(model, first.names, tolerances, settings))


def beside(
    model: ResponseModel, names: Sequence[str], tolerances: Tolerances, settings: FitSettings = SETTINGS
) -> Priors:
    """Priors of every value of the rig file that has a tolerance, except `names`, and of the lag of the amplifiers, if
    any, which no rig file states; the model has separate channels."""
    known = model.all_parameters()
    rest = {name: sigma for name in known if name not in names and (sigma := _sigma(name, tolerances))}
    mean = np.array([known[name].value for name in rest])
    relative = np.array([name.partition(".")[0] in _RELATIVE for name in rest], bool)
    found = Priors(tuple(rest), mean, np.array(list(rest.values())), relative)
    if AMPLIFIERS not in known or AMPLIFIERS in names:
        return found
    tau, no = np.array([known[AMPLIFIERS].value]), np.zeros(1, bool)
    within = np.array([lag_tolerance(float(tau[0]), settings)])
    lag = Priors((AMPLIFIERS,), tau, within, no, settings.shortest_lag * tau)
    return found.followed_by(lag)


def identified(
    model: ResponseModel, stated: Mapping[str, tuple[float, float]], settings: FitSettings = SETTINGS
) -> Priors:
    """Priors of the free parameters of a model: as stated (mean, standard deviation), otherwise about their present
    values. The latter keep combinations that the data determine poorly near these values (`unknown_percent`); they
    do not count as information."""
    mean, scale = model.values.copy(), model.scales()
    sigma = settings.unknown_percent / 100 * scale
    for name, (value, deviation) in stated.items():
        mean[model.names.index(name)], sigma[model.names.index(name)] = value, deviation
    above = np.array([positive(name) for name in model.names], bool) & (mean > 0)
    return Priors(model.names, mean, np.where(above, sigma / np.abs(np.where(mean == 0, 1.0, mean)), sigma), above)


@dataclass(frozen=True)
class Tolerance:
    """A value of the rig file with a tolerance: its estimate, standard deviation, and shift in units of its
    tolerance."""

    parameter: str
    value: float
    std: float
    moved: float
    unit: str = ""

    def to_json(self) -> dict[str, Any]:
        """As specified in the contract."""
        return {"parameter": self.parameter, "value": self.value, "std": self.std, "tolerances_moved": self.moved}


def tolerances_of(rig: Rig) -> Tolerances:
    """Tolerances of the rig file, or those of the contract."""
    return getattr(rig, "tolerances", None) or Tolerances()


def lag_tolerance(tau_s: float, settings: FitSettings = SETTINGS) -> float:
    """Standard deviation [s] of the time constant of amplifiers, from its expected value [s]."""
    return max(settings.lag_percent / 100 * tau_s, settings.least_lag_s)


_RELATIVE: Mapping[str, str] = {
    "actuator": "actuator_gain_percent",
    "sensor": "sensor_gain_percent",
    "corner": "sensor_corner_percent",
    "damping": "sensor_damping_percent",
}


def _sigma(name: str, t: Tolerances) -> float:
    """Standard deviation of a parameter, relative for gains, corners and damping ratios; 0 without a tolerance."""
    kind = name.partition(".")[0]
    if kind in _RELATIVE:
        return float(getattr(t, _RELATIVE[kind])) / 100
    if kind == "place" or ".p_" in name:
        return t.place_m
    if kind == "direction":
        return t.direction_rad
    if name.startswith("com_"):
        return t.centre_of_mass_m
    return t.product_of_inertia_kgm2 if name in ("J12", "J13", "J23") else 0.0
