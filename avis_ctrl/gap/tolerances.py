"""Effects within and beyond the tolerances of values in the rig file, and their priors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from avis_ctrl.gap.effects.base import Effect, EffectParameter
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.effects.payload import PRODUCTS
from avis_ctrl.gap.settings import SETTINGS, GapSettings
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.likelihood import Fitted
from avis_ctrl.identification.priors import Priors, Tolerance, lag_tolerance, re_identified
from avis_ctrl.identification.response import AMPLIFIERS
from avis_ctrl.rigs.instruments import Tolerances

Stated = Callable[[Tolerances, Sequence[EffectParameter]], tuple[float, ...]]
# Effects that represent one value of the rig file beyond its tolerance: the tolerance of each of their parameters, in
# its unit, zero without one; and the names of these tolerances. A name that ends in "." or "_" is the start of several.
BEYOND: Mapping[str, tuple[Stated, tuple[str, ...]]] = {
    "sensor_gain": (lambda t, p: (t.sensor_gain_percent / 100,), ("sensor.{place}",)),
    "actuator_gain": (lambda t, p: (t.actuator_gain_percent / 100,), ("actuator.{place}",)),
    "sensor_misalignment": (lambda t, p: (float(np.degrees(t.direction_rad)),) * 2, ("direction.{place}.",)),
    "com_offset": (lambda t, p: (t.centre_of_mass_m,) * 3, ("com_",)),
    "product_of_inertia": (lambda t, p: (t.product_of_inertia_kgm2,), ("{product}",)),
    "geophone_corner": (
        lambda t, p: (t.sensor_corner_percent / 100 * p[0].none, t.sensor_damping_percent / 100 * p[1].none),
        ("corner.{place}", "damping.{place}"),
    ),
    # The lower limit is the difference between no lag and the expected one; zero if none is expected. How much the
    # drives differ has no tolerance.
    "actuator_lag": (
        lambda t, p: (lag_tolerance(-p[0].low) if p[0].low else 0.0, *[0.0] * (len(p) - 1)),
        (AMPLIFIERS,),
    ),
}


def of_values(effects: Sequence[Effect], model: TableModel) -> list[Effect]:
    """Effects that represent a value of a model beyond its tolerance. The lag of the amplifiers is such a value if the
    model has one."""
    none = {"actuator_lag"} if model.amplifier_corner_Hz is None else set()
    return [one for one in effects if one.name in BEYOND.keys() - none]


def has_tolerance(effect: ActiveEffect, tolerances: Tolerances) -> bool:
    """Whether an effect represents values that all have a tolerance."""
    return effect.effect.name in BEYOND and bool(np.all(tolerance_of(effect, tolerances)))


def tolerance_of(effect: ActiveEffect, tolerances: Tolerances) -> np.ndarray:
    """(n,) tolerances of the parameters of an effect of `BEYOND`, in their units."""
    return np.array(BEYOND[effect.effect.name][0](tolerances, effect.parameters))


def tolerances_behind(effect: ActiveEffect, names: Sequence[str]) -> list[int]:
    """Indices of the tolerances of the values that an effect of `BEYOND` represents."""
    _, starts = BEYOND.get(effect.effect.name, (None, ()))
    own = tuple(start.format(place=effect.place, product=PRODUCTS.get(effect.place)) for start in starts)
    several = tuple(one for one in own if one.endswith((".", "_")))
    return [k for k, name in enumerate(names) if (name in own or name.startswith(several)) and "@" not in name]


def rescaled(priors: Priors, effect: ActiveEffect, factor: float) -> Priors:
    """Priors with the tolerances behind an effect of `BEYOND` multiplied by a factor: `GapSettings.held` with the
    effect, which then alone represents the value; its inverse after the effect is removed."""
    return priors.scaled(tolerances_behind(effect, priors.names), factor)


def with_tolerance(fitted: Fitted) -> list[str]:
    """Names of the free values of the rig file that have a tolerance."""
    theta = set(re_identified(fitted.model.rig).names)
    return [name for name in fitted.priors.names if "@" not in name and name not in theta]


def credible(fitted: Fitted, settings: GapSettings) -> bool:
    """Whether values of the rig file moved no further, as a whole, than their tolerances allow.

    Otherwise they represent something that the model lacks, at wrong values of everything else. Without a missing
    effect, the estimates z (in tolerances) have the covariance I - S, with S that of the fit; z^T z is compared with a
    scaled chi-square variable of the same mean and variance (Satterthwaite, Biometrics Bulletin 2 (1946) 110-114).
    Values whose tolerance is held by an effect do not move and have no weight.
    """
    rows = [fitted.priors.names.index(name) for name in with_tolerance(fitted)]
    determined = np.linalg.eigvalsh(np.eye(len(rows)) - fitted.covariance[np.ix_(rows, rows)]).clip(0.0)
    mean, square = float(determined.sum()), float(determined @ determined)
    if not square:
        return True
    z = fitted.z[rows]
    return bool(chi2.sf(float(z @ z) * mean / square, mean**2 / square) >= settings.credible)


def spread(fitted: Fitted, settings: GapSettings) -> tuple[list[int], float]:
    """Indices of the values of the rig file that the data determine, and their spread in tolerances.

    The spread is the root of the sum of z^2 over the sum of the fractions by which the data reduce their prior variance
    (D. MacKay, Neural Computation 4 (1992) 415-447), at most 1. A table may be built more accurately than its
    tolerances state; a value that is off by three tolerances is then an outlier.
    """
    own = {k for one in fitted.model.effects for k in tolerances_behind(one, fitted.priors.names)}
    determined = 1 - np.diag(fitted.covariance)
    rows = [
        k
        for k in map(fitted.priors.names.index, with_tolerance(fitted))
        if k not in own and determined[k] > settings.determined
    ]
    if not rows:
        return [], 1.0
    size = np.sqrt(np.sum(fitted.z[rows] ** 2) / np.sum(determined[rows]))
    return rows, float(np.clip(size, settings.least_spread, 1.0))


def moved(fitted: Fitted, names: Sequence[str], tolerances: Tolerances, settings: GapSettings) -> tuple[Tolerance, ...]:
    """Shifts of values of the rig file in tolerances, the largest first; for values beyond their tolerance as estimated
    by their effects."""
    found = {one.parameter: one for one in fitted.moved(names)}
    for effect in fitted.model.effects:
        behind = [fitted.priors.names[k] for k in tolerances_behind(effect, fitted.priors.names)]
        if not behind:
            continue
        priors = rescaled(fitted.priors, effect, 1 / settings.held).of(behind)
        size = tolerance_of(effect, tolerances)[: len(behind)]
        std = np.sqrt(np.diag(fitted.covariance_of(effect.names)))[: len(behind)] / size
        none = np.array([p.none for p in effect.parameters])[: len(behind)]
        away = np.array(effect.values)[: len(behind)] - none
        # The logarithm of a positive value has the normal prior.
        z = (
            np.array(
                [none[k] * np.log1p(away[k] / none[k]) if priors.positive[k] else away[k] for k in range(len(behind))]
            )
            / size
        )
        values, slopes = priors.values(z), priors.slopes(z)
        for k, name in enumerate(behind):
            found[name] = replace(found[name], value=float(values[k]), std=float(std[k] * slopes[k]), moved=float(z[k]))
    return tuple(sorted(found.values(), key=lambda one: -abs(one.moved)))


def within_tolerance(effect: ActiveEffect, tolerances: Tolerances, settings: GapSettings) -> bool:
    """Whether an effect of `BEYOND` has a value that is not beyond its tolerance."""
    if not has_tolerance(effect, tolerances):
        return False
    away = np.array([value - p.none for value, p in zip(effect.values, effect.parameters, strict=True)])
    return bool(np.all(np.abs(away) < settings.beyond_least * tolerance_of(effect, tolerances)))


def of_effect(effect: ActiveEffect, tolerances: Tolerances, settings: GapSettings = SETTINGS) -> Priors:
    """Broad normal priors of an effect's parameters: several tolerances wide for a value beyond its tolerance, centred
    on zero strength for other linear parameters, and on the starting value for shape parameters. Those of the
    second-order terms are narrow: these are known except for the part that turns with the payload."""
    if isinstance(effect.effect, LargeMotion):
        sigma = np.array([settings.second_order_percent, *[settings.turning_percent] * 2]) / 100
        return Priors(effect.names, np.array(effect.values), sigma, np.zeros(3, bool))
    mean = np.array([p.none if p.linear else v for p, v in zip(effect.parameters, effect.values, strict=True)])
    sigma = np.array(
        [
            settings.effect_sizes * p.size if p.linear else max(settings.shape_spread * abs(v), p.size)
            for p, v in zip(effect.parameters, effect.values, strict=True)
        ]
    )
    if effect.effect.name in BEYOND:
        stated = tolerance_of(effect, tolerances)
        sigma = np.where(stated > 0, settings.beyond_tolerance * stated, sigma)
    low, high = (np.array([getattr(p, name) for p in effect.parameters]) for name in ("low", "high"))
    return Priors(effect.names, mean, sigma, np.zeros(len(mean), bool), low, high)
