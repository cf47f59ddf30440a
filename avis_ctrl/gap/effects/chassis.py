"""The chassis under the mounts: it recoils."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Table, Values, register
from avis_ctrl.gap.effects.impedance import recoils
from avis_ctrl.gap.effects.mounts import OfMounts
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.score import Reduction, Score, reduction
from avis_ctrl.gap.starting_values import Seed
from avis_ctrl.gap.table_model import ActiveEffect
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.rigs.rigid_body import point_map

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
# Coordinates whose frequencies are searched together: the low centre of mass of a frame couples x and ry, and y and rx,
# so that one can compensate for the other.
TOGETHER = (("x", "ry"), ("y", "rx"), *((coordinate,) for coordinate in COORDINATES))


@dataclass(frozen=True)
class ChassisSettings:
    """Settings of the search for the starting values of a chassis.

    A coordinate is one of x, y, z, rx, ry, rz of the chassis.

    own_Hz : lowest and highest resonance frequency [Hz] of a single coordinate, and number of frequencies searched;
        below the lowest, the suspension modes dominate.
    damping : damping ratio of that search [1]: large enough that the grid misses no resonance.
    least_gain : reduction of chi-square with one more coordinate over that without it, below which that coordinate
        counts as stiff [1].
    stiff_Hz : frequency of a coordinate in which no resonance was found [Hz]: near the end of the band.
    fixed_Hz : frequency of a coordinate that shall not move [Hz]: far above the band, within the parameter's range.
    mass_ratio : ratio of the masses of two coordinates, up to which both can belong to one chassis [1].
    radius_m : smallest and largest radius of gyration [m] at which a fit starts.
    heights_m : height of the mass over the table's centre, and of the springs over the mass [m], at which a fit starts.
    lines : lines of a record for the search around a fit: fewer than the fit's, because only the order of the groups of
        coordinates matters.
    followed_groups : number of groups of coordinates whose new frequencies are fitted, the most promising first.
    """

    own_Hz: tuple[float, float, int] = (7.0, 90.0, 26)
    damping: float = 0.06
    least_gain: float = 1.05
    stiff_Hz: float = 90.0
    fixed_Hz: float = 250.0
    mass_ratio: float = 3.0
    radius_m: tuple[float, float] = (0.1, 3.0)
    heights_m: tuple[float, float] = (-0.3, 0.0)
    lines: int = 100
    followed_groups: int = 2


SETTINGS = ChassisSettings()


@register
class BaseCompliance(OfMounts):
    """The chassis, a rigid body on a soft base: it recoils from mounts and motors, and filters the floor motion.

    c = B (f_mounts + (s C_b + K_b) w), B = inv(s^2 M_c + s C_b + K_b). translation : each axis by itself. rocking :
    with rotations; the mass and the springs of the base have their own heights.
    """

    name = "base_compliance"
    title = "the chassis stands on something soft and recoils"
    looks_like = "one more resonance in every channel, and less floor motion above it"
    at = ("chassis/translation", "chassis/rocking")
    holds_states = True
    resonant = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        m = model.rig.mounted_body().mass

        def frequency(coordinate: str) -> EffectParameter:
            about = f"along {coordinate}" if len(coordinate) == 1 else f"about {coordinate[1]}"
            return EffectParameter(
                f"{coordinate}_Hz",
                "Hz",
                f"of the chassis on its base, {about}",
                0.0,
                1.0,
                300.0,
                10.0,
                False,
                (20.0,),
                True,
            )

        found = (
            EffectParameter("mass_kg", "kg", "of the chassis", 0.0, 0.05 * m, 400 * m, m, False, (2 * m,)),
            EffectParameter("damping", "1", "damping ratio", 0.0, 1e-3, 1.0, 0.05, False, (0.06,), True),
            *(frequency(coordinate) for coordinate in COORDINATES[:3]),
        )
        if place.endswith("translation"):
            return found
        return (
            *found,
            *(frequency(coordinate) for coordinate in COORDINATES[3:]),
            *(
                EffectParameter(
                    f"gyration_{axis}_m",
                    "m",
                    f"radius of gyration about {axis}",
                    0.0,
                    0.03,
                    5.0,
                    0.3,
                    False,
                    (0.5,),
                    True,
                )
                for axis in "xyz"
            ),
            EffectParameter(
                "centre_z_m",
                "m",
                "height of its mass over the table's centre",
                0.0,
                -3.0,
                1.0,
                0.3,
                False,
                (-0.5,),
                True,
            ),
            EffectParameter(
                "base_z_m", "m", "height of its springs over its mass", 0.0, -2.0, 2.0, 0.3, False, (0.0,), True
            ),
        )

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """The best resonance of each coordinate by itself; the masses are estimated together."""
        coordinates = _coordinates(place)
        best, took = _resonances(score, coordinates)
        inverse = dict(zip(best, took.coefficients, strict=True))
        moving = [coordinate for coordinate in best if len(coordinate) == 1]
        # The first coordinate found determines the mass best; one with a different mass is not a recoil of the chassis.
        leader = inverse[moving[0]] if moving else 0.0
        if leader <= 0:
            return []
        ratio = SETTINGS.mass_ratio
        best = {
            coordinate: f
            for coordinate, f in best.items()
            if len(coordinate) > 1 or leader / ratio < inverse[coordinate] < ratio * leader
        }
        mass = self.parameters(score.model, place)[0]
        m = float(np.clip(1 / leader, 2 * mass.low, mass.high / 2))
        at = [best.get(coordinate, SETTINGS.stiff_Hz) for coordinate in coordinates]
        values = [m, SETTINGS.damping, *at[:3]]
        if len(coordinates) > 3:
            radii = [_radius(m, inverse.get(coordinate, 0.0)) for coordinate in coordinates[3:]]
            values += [*at[3:], *radii, *SETTINGS.heights_m]
        return [Seed(tuple(float(v) for v in values), took.chi2, len(best), SETTINGS.own_Hz[2] ** len(best))]

    def extended_models(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """The same law with other frequencies of one coordinate, or of two coupled ones. A fit can end with a wrong
        frequency, for which the other parameters compensate. Therefore the chassis is first fixed in these coordinates,
        and the score test then gives the frequencies that reduce the sum of squares most."""
        blocks = [thinned(part.block, SETTINGS.lines, seed=2) for part in score.parts]
        rest, place = score.model.without(one.label), one.place
        here, found = Score(rest.with_effect(one), blocks).chi2, []
        for group in TOGETHER:
            if not set(group) <= set(_coordinates(place)):
                continue
            fixed = _with_frequencies(one, dict.fromkeys(group, SETTINGS.fixed_Hz))
            without = Score(rest.with_effect(fixed), blocks)
            best, took = _resonances(without, group)
            inverse = dict(zip(best, took.coefficients, strict=True))
            radii = {turn: _radius(one.by_name["mass_kg"], inverse[turn]) for turn in best if len(turn) > 1}
            found.append((without.chi2 - took.chi2, _with_frequencies(fixed, best, radii).values))
        return [(place, values) for chi2, values in sorted(found)[: SETTINGS.followed_groups] if chi2 < here]

    def change(self, ops: Operators, place: str, values: Values) -> None:
        mass, damping, stiffness = of_chassis(values)
        s = ops.s[:, None, None]
        tied = stiffness + s * damping
        if "rx_Hz" in values:
            B = np.linalg.inv(s**2 * mass + tied)
            H = B @ tied[:, :, :3]
        else:
            B, H, along = np.zeros((len(s), 6, 6), complex), np.zeros((len(s), 6, 3), complex), range(3)
            held = tied[:, along, along]
            D = s[:, :, 0] ** 2 * mass[along, along] + held
            B[:, along, along], H[:, along, along] = 1 / D, held / D
        ops.recoil, ops.follow = B, H


def _coordinates(place: str) -> tuple[str, ...]:
    """Coordinates in which a chassis moves."""
    return COORDINATES[:3] if place.endswith("translation") else COORDINATES


def of_chassis(values: Values) -> np.ndarray:
    """(3, 6, 6) mass, damping and stiffness of a chassis on its base, in the payload's coordinates about the table's
    centre; zero in the coordinates in which it does not move."""
    radii = [1.0, 1.0, 1.0, *(values.get(f"gyration_{axis}_m", 0.0) for axis in "xyz")]
    inertia = values["mass_kg"] * np.square(radii)
    w = 2 * np.pi * np.array([values.get(f"{coordinate}_Hz", 0.0) for coordinate in COORDINATES])
    found = np.zeros((3, 6, 6))
    centre = np.array([0.0, 0.0, values.get("centre_z_m", 0.0)])
    G, below = point_map(centre), point_map(centre + np.array([0.0, 0.0, values.get("base_z_m", 0.0)]))
    each = (inertia, 2 * values["damping"] * inertia * w, inertia * w**2)
    for which, place, one in zip(found, (G, below, below), each, strict=True):
        which += place.T @ np.diag(one[:3]) @ place
        which[3:, 3:] += np.diag(one[3:])
    return found


def _radius(mass: float, inverse_inertia: float) -> float:
    """Radius of gyration [m] of a mass [kg] by the inverse of its moment of inertia [1/(kg m^2)]."""
    low, high = SETTINGS.radius_m
    return float(np.clip(1 / np.sqrt(inverse_inertia * mass), low, high)) if inverse_inertia > 0 else high


def _with_frequencies(
    one: ActiveEffect, frequencies: dict[str, float], radii: dict[str, float] | None = None
) -> ActiveEffect:
    """A chassis with other frequencies [Hz] of some coordinates, and other radii of gyration [m] of some rotations."""
    values = one.by_name | {f"{coordinate}_Hz": f for coordinate, f in frequencies.items()}
    values |= {f"gyration_{turn[1]}_m": radius for turn, radius in (radii or {}).items()}
    return one.at(list(values.values()))


def _resonances(score: Score, coordinates: Sequence[str]) -> tuple[dict[str, float], Reduction]:
    """Frequencies [Hz] of the coordinates in which the chassis recoils, the most significant first, with the reduction
    of the sum of squares; its coefficients are the inverse masses [1/kg] and moments of inertia [1/(kg m^2)]."""
    rows, labels = [], []
    for f in np.geomspace(*SETTINGS.own_Hz):
        key = ("recoil", float(f))
        if key not in score.kept:
            score.kept[key] = recoils(score, partial(receptance, frequency_Hz=f, damping=SETTINGS.damping))
        rows += [score.kept[key][COORDINATES.index(coordinate)] for coordinate in coordinates]
        labels += [(coordinate, float(f)) for coordinate in coordinates]
    A = np.array(rows)
    return _greedy(A @ A.T, A @ score.e, labels)


def _greedy(
    gram: np.ndarray, product: np.ndarray, labels: list[tuple[str, float]]
) -> tuple[dict[str, float], Reduction]:
    """Greedy selection of coordinates and their frequencies; each adds the largest reduction to the previous ones.

    A coordinate that adds little, or would need a negative mass, counts as stiff.
    """
    best: dict[str, float] = {}
    took = Reduction(0.0, 0, np.zeros(0))
    rows: list[int] = []
    while True:
        trials = []
        for k, (coordinate, _) in enumerate(labels):
            if coordinate not in best:
                own = [*rows, k]
                one = reduction(gram[np.ix_(own, own)], product[own])
                if np.all(one.coefficients > 0):
                    trials.append((one.chi2, k, one))
        chi2, k, more = max(trials, key=itemgetter(0), default=(0.0, 0, took))
        if not trials or chi2 < SETTINGS.least_gain * took.chi2:
            return best, took
        took = more
        rows.append(k)
        best[labels[k][0]] = labels[k][1]
