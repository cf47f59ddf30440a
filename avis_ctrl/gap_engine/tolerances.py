"""The parameters of a rig with their priors: what is re-identified, and the tolerances of what the rig file states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.effects.payload import PRODUCTS
from avis_ctrl.gap.table_model import ActiveEffect
from avis_ctrl.gap_engine.settings import SETTINGS, GapSettings
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True, eq=False)
class Priors:
    """Normal priors of free parameters: value = mean + sigma z, z standard normal; of positive ones log value is so.

    names : (n,). mean, sigma : (n,), units of the parameters; of a positive one sigma is that of the logarithm.
    positive : (n,) bool.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sigma: np.ndarray
    positive: np.ndarray
    low: np.ndarray | float = -np.inf
    high: np.ndarray | float = np.inf

    def values(self, z: np.ndarray) -> np.ndarray:
        """(n,) of the parameters at standardised values z (n,)."""
        found = np.where(self.positive, self.mean * np.exp(np.where(self.positive, self.sigma, 0.0) * z),
                         self.mean + self.sigma * z)
        return np.clip(found, self.low, self.high)

    def z(self, values: np.ndarray) -> np.ndarray:
        """(n,) standardised values; the inverse of `values`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.positive, np.log(values / self.mean) / self.sigma, (values - self.mean) / self.sigma)

    def followed_by(self, other: Priors) -> Priors:
        """Both, one after the other."""
        def both(name: str) -> np.ndarray:
            return np.concatenate([np.broadcast_to(getattr(one, name), len(one.names)) for one in (self, other)])
        return Priors((*self.names, *other.names), *map(both, _FIELDS))

    def of(self, names: Sequence[str]) -> Priors:
        """Those of some parameters, in their order. Raises ValueError for one that is not there."""
        rows = [self.names.index(name) for name in names]
        return Priors(tuple(names), *(np.broadcast_to(getattr(self, field), len(self.names))[rows]
                                      for field in _FIELDS))

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """(n,) derivative of the values by z."""
        return np.where(self.positive, self.sigma * self.values(z), self.sigma)


_FIELDS = ("mean", "sigma", "positive", "low", "high")


def re_identified(rig: Rig, settings: GapSettings = SETTINGS) -> Priors:
    """Mass, moments of inertia, stiffness and damping: what every identification leaves free."""
    known, names = rig.parameters(), default_parameters(rig)
    mean = np.array([known[name].value for name in names])
    damping = np.array([known[name].unit.startswith("N s") or known[name].unit.startswith("N m s") for name in names])
    sigma = np.asarray(np.where(damping, settings.damping_percent, settings.stiffness_percent)) / 100
    return Priors(names, mean, sigma, np.ones(len(names), bool))


def with_tolerances(model: ResponseModel, tolerances: Tolerances, settings: GapSettings = SETTINGS) -> Priors:
    """The same and every value of the rig file that has a tolerance; the model has its channels apart."""
    first, known = re_identified(model.rig, settings), model.all_parameters()
    rest = {name: sigma for name in known if name not in first.names and (sigma := _sigma(name, tolerances))}
    mean = np.array([known[name].value for name in rest])
    relative = np.array([name.partition(".")[0] in _RELATIVE for name in rest])
    own = np.array(list(rest.values()))
    return Priors((*first.names, *rest), np.concatenate([first.mean, mean]), np.concatenate([first.sigma, own]),
                  np.concatenate([first.positive, relative]))


def tolerances_of(rig: Rig) -> Tolerances:
    """Of the rig file, or those of the contract."""
    return getattr(rig, "tolerances", None) or Tolerances()


# Effects that are one value of the rig file gone beyond its tolerance, and the tolerance of each of their parameters,
# in its unit; of a geophone's corner and damping ratio relative to them.
BEYOND: Mapping[str, Callable[[Tolerances], tuple[float, ...]]] = {
    "sensor_gain": lambda t: (t.sensor_gain_percent / 100,),
    "actuator_gain": lambda t: (t.actuator_gain_percent / 100,),
    "sensor_misalignment": lambda t: (float(np.degrees(t.direction_rad)),) * 2,
    "com_offset": lambda t: (t.centre_of_mass_m,) * 3, "product_of_inertia": lambda t: (t.product_of_inertia_kgm2,),
    "geophone_corner": lambda t: (t.sensor_corner_percent / 100, t.sensor_damping_percent / 100)}


def tolerance_of(effect: ActiveEffect, tolerances: Tolerances) -> np.ndarray:
    """(n,) of the parameters of an effect of `BEYOND`, in their units."""
    relative = np.array(BEYOND[effect.effect.name](tolerances))
    of = np.array([p.none for p in effect.parameters]) if effect.effect.name == "geophone_corner" else 1.0
    return relative * of


def tolerances_behind(effect: ActiveEffect, names: Sequence[str]) -> list[int]:
    """Indices of the tolerances of the values that an effect of `BEYOND` takes further."""
    place = effect.place
    own = {"sensor_gain": (f"sensor.{place}",), "actuator_gain": (f"actuator.{place}",),
           "sensor_misalignment": (f"direction.{place}.",), "com_offset": ("com_",),
           "product_of_inertia": (PRODUCTS.get(place, ""),), "geophone_corner": (f"corner.{place}", f"damping.{place}")}
    starts = own.get(effect.effect.name)
    return [k for k, name in enumerate(names) if starts and name.startswith(starts)]


def within_tolerance(effect: ActiveEffect, tolerances: Tolerances, settings: GapSettings) -> bool:
    """Whether a value that may be beyond its tolerance is not."""
    if effect.effect.name not in BEYOND:
        return False
    away = np.array([value - p.none for value, p in zip(effect.values, effect.parameters, strict=True)])
    return bool(np.all(np.abs(away) < settings.beyond_least * tolerance_of(effect, tolerances)))


def of_effect(effect: ActiveEffect, tolerances: Tolerances, settings: GapSettings = SETTINGS) -> Priors:
    """Broad normal priors of an effect's parameters: some tolerances wide for what is beyond its tolerance, about none
    for the strength of others, about where its fit begins for what shapes it. Those of the second-order terms are
    narrow: they are known but for what turns with the payload."""
    if isinstance(effect.effect, LargeMotion):
        sigma = np.array([settings.second_order_percent, *[settings.turning_percent] * 2]) / 100
        return Priors(effect.names, np.array(effect.values), sigma, np.zeros(3, bool))
    mean = np.array([p.none if p.linear else v for p, v in zip(effect.parameters, effect.values, strict=True)])
    sigma = np.array([settings.effect_sizes * p.size if p.linear else max(settings.shape_spread * abs(v), p.size)
                      for p, v in zip(effect.parameters, effect.values, strict=True)])
    if effect.effect.name in BEYOND:
        sigma = settings.beyond_tolerance * tolerance_of(effect, tolerances)
    low, high = (np.array([getattr(p, name) for p in effect.parameters]) for name in ("low", "high"))
    return Priors(effect.names, mean, sigma, np.zeros(len(mean), bool), low, high)


_RELATIVE: Mapping[str, str] = {"actuator": "actuator_gain_percent", "sensor": "sensor_gain_percent",
                                "corner": "sensor_corner_percent", "damping": "sensor_damping_percent"}


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
