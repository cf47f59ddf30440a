"""The chassis under the mounts: it recoils."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from operator import itemgetter

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Table, Values, register
from avis_ctrl.gap.effects.impedance import DIAGONAL, recoil_of, recoils
from avis_ctrl.gap.effects.mounts import OfMounts
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.score import Reduction, Score, reduction
from avis_ctrl.gap.starting_values import SETTINGS, Seed
from avis_ctrl.gap.table_model import ActiveEffect
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.rigs.rigid_body import point_map

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
# Coordinates whose frequencies are searched together: the low centre of mass of a frame couples x and ry, and y and rx.
TOGETHER = (("x", "ry"), ("y", "rx"), *((coordinate,) for coordinate in COORDINATES))
# Entries of the inverse mass matrix in these coordinates.
ENTRIES = (*DIAGONAL, *(tuple(map(COORDINATES.index, group)) for group in TOGETHER[:2]))


@register
class BaseCompliance(OfMounts):
    """The chassis, a rigid body on a soft base: it recoils from mounts and motors, and filters the floor motion.

    c = B (f_mounts + (s C_b + K_b) w), B = inv(s^2 M_c + s C_b + K_b). translation : each axis by itself. rocking :
    with rotations; the mass and the springs of the base have their own heights.
    """

    name = "base_compliance"
    title = "the chassis stands on something soft and recoils"
    looks_like = "further resonances in every channel, and less floor motion above them"
    at = ("chassis/translation", "chassis/rocking")
    holds_states = True
    resonant = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        m, shape = model.rig.mounted_body().mass, partial(EffectParameter.shape, optional=True)
        along = shape("frequency_{}_Hz", "Hz", "of the chassis on its base, along {}", 1.0, 300.0, 10.0, (20.0,))
        found = (
            EffectParameter.shape("mass_kg", "kg", "of the chassis", 0.05 * m, 400 * m, m, (2 * m,)),
            shape("damping", "1", "damping ratio", 1e-3, 1.0, 0.05, (0.06,)),
            *along.of_each("xyz"),
        )
        if place.endswith("translation"):
            return found
        return (
            *found,
            *replace(along, name="frequency_r{}_Hz", description="of the chassis on its base, about {}").of_each("xyz"),
            *shape("gyration_{}_m", "m", "radius of gyration about {}", 0.03, 5.0, 0.3, (0.5,)).of_each("xyz"),
            shape("centre_z_m", "m", "height of its mass over the table's centre", -3.0, 1.0, 0.3, (-0.5,)),
            shape("base_z_m", "m", "height of its springs over its mass", -2.0, 2.0, 0.3, (0.0,)),
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
        ratio = SETTINGS.chassis_mass_ratio
        best = {
            coordinate: f
            for coordinate, f in best.items()
            if len(coordinate) > 1 or leader / ratio < inverse[coordinate] < ratio * leader
        }
        mass = self.parameters(score.model, place)[0]
        m = float(np.clip(1 / leader, 2 * mass.low, mass.high / 2))
        at = [best.get(coordinate, SETTINGS.chassis_stiff_Hz) for coordinate in coordinates]
        values = [m, SETTINGS.chassis_damping, *at[:3]]
        if len(coordinates) > 3:
            radii = [_radius(m, inverse.get(coordinate, 0.0)) for coordinate in coordinates[3:]]
            values += [*at[3:], *radii, *SETTINGS.chassis_heights_m]
        return [Seed(tuple(float(v) for v in values), took.chi2, len(best), SETTINGS.chassis_own_Hz[2] ** len(best))]

    def extended_models(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """The same law with other frequencies of one coordinate, or of two coupled ones. A fit can end with a wrong
        frequency, for which the other parameters compensate.

        To first order, the recoil in these coordinates is replaced by that of other resonances. The suspension modes,
        which are sharp, stay where they are, since the data fix the compliance of the base.
        """
        blocks = [thinned(part.block, SETTINGS.chassis_lines, seed=2) for part in score.parts]
        model = score.model.without(one.label).with_effect(one)
        around, place = Score(replace(model, held=model.held | {one.label}), blocks), one.place
        damping = max(one.by_name["damping"], SETTINGS.narrowest)
        low, high, _ = SETTINGS.chassis_own_Hz
        grid = np.geomspace(low, high, int(np.log(high / low) / (2 * damping)) + 2)
        A = np.array([recoils(around, partial(receptance, frequency_Hz=f, damping=damping), ENTRIES) for f in grid])
        found = []
        for group in TOGETHER:
            if not set(group) <= set(_coordinates(place)):
                continue
            fixed = one.by_name | {f"frequency_{coordinate}_Hz": SETTINGS.chassis_fixed_Hz for coordinate in group}
            rest = around.e + recoil_of(around, partial(_difference, one.by_name, fixed))
            own = set(map(COORDINATES.index, group))
            columns = [k for k, entry in enumerate(ENTRIES) if set(entry) <= own]
            if best := _other_resonances(A[:, columns], rest, group, grid, one):
                found.append(best)
        return [
            (place, values) for chi2, values in sorted(found)[: SETTINGS.chassis_followed_groups] if chi2 < around.chi2
        ]

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.recoil, ops.follow = _recoil(values, ops.s)


def _coordinates(place: str) -> tuple[str, ...]:
    """Coordinates in which a chassis moves."""
    return COORDINATES[:3] if place.endswith("translation") else COORDINATES


def of_chassis(values: Values) -> np.ndarray:
    """(3, 6, 6) mass, damping and stiffness of a chassis on its base, in the payload's coordinates about the table's
    centre; zero in the coordinates in which it does not move."""
    radii = [1.0, 1.0, 1.0, *(values.get(f"gyration_{axis}_m", 0.0) for axis in "xyz")]
    inertia = values["mass_kg"] * np.square(radii)
    w = 2 * np.pi * np.array([values.get(f"frequency_{coordinate}_Hz", 0.0) for coordinate in COORDINATES])
    found = np.zeros((3, 6, 6))
    centre = np.array([0.0, 0.0, values.get("centre_z_m", 0.0)])
    G, below = point_map(centre), point_map(centre + np.array([0.0, 0.0, values.get("base_z_m", 0.0)]))
    each = (inertia, 2 * values["damping"] * inertia * w, inertia * w**2)
    for which, place, one in zip(found, (G, below, below), each, strict=True):
        which += place.T @ np.diag(one[:3]) @ place
        which[3:, 3:] += np.diag(one[3:])
    return found


def _recoil(values: Values, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """B (n, 6, 6), displacement of the chassis per force on it, and H (n, 6, 3), per displacement of the floor."""
    mass, damping, stiffness = of_chassis(values)
    s = s[:, None, None]
    tied = stiffness + s * damping
    if "frequency_rx_Hz" in values:
        B = np.linalg.inv(s**2 * mass + tied)
        return B, B @ tied[:, :, :3]
    B, H, along = np.zeros((len(s), 6, 6), complex), np.zeros((len(s), 6, 3), complex), range(3)
    held = tied[:, along, along]
    D = s[:, :, 0] ** 2 * mass[along, along] + held
    B[:, along, along], H[:, along, along] = 1 / D, held / D
    return B, H


def _difference(one: Values, other: Values, s: np.ndarray) -> np.ndarray:
    """(n, 6, 6): recoil of one chassis beyond that of another."""
    return _recoil(one, s)[0] - _recoil(other, s)[0]


def _other_resonances(
    A: np.ndarray, rest: np.ndarray, group: Sequence[str], grid: np.ndarray, one: ActiveEffect
) -> tuple[float, tuple[float, ...]] | None:
    """Sum of squares and values of the chassis with the best resonances on the grid (n,) [Hz]: a mode for each
    coordinate of the group. None if no body has such resonances.

    A : (n, entries, N) directions. rest : (N,) residual without recoil in these coordinates.
    """
    n, entries, _ = A.shape
    rows = A.reshape(n * entries, -1)
    gram, product, whole = rows @ rows.T, rows @ rest, float(rest @ rest)
    best: tuple[float, dict[str, float]] | None = None
    for at in combinations(range(n), len(group)):
        own = [entries * k + j for k in at for j in range(entries)]
        took = reduction(gram[np.ix_(own, own)], product[own])
        if best is None or whole - took.chi2 < best[0]:
            values = _body_of(group, took.coefficients.reshape(len(at), entries), grid[list(at)], one.by_name)
            best = (whole - took.chi2, values) if values else best
    return best and (best[0], _within(one, best[1]))


def _body_of(group: Sequence[str], entries: np.ndarray, f: np.ndarray, now: Values) -> dict[str, float]:
    """Values of a chassis with the residues of modes at f [Hz] in one coordinate (1, 1), or in a translation and a
    rotation that are coupled (2, 3); empty if no body of about the same mass has them.

    The sum of the residue matrices is the inverse mass matrix, the sum of each over w^2 the compliance of the base.
    From these follow mass, radius of gyration, both heights and both frequencies.
    """
    turn = f"gyration_{group[-1][-1]}_m"
    if len(group) == 1:
        if entries[0, 0] <= 0:
            return {}
        own = {turn: _radius(now["mass_kg"], entries[0, 0])} if len(group[0]) > 1 else {}
        return {f"frequency_{group[0]}_Hz": float(f[0])} | own
    residues, w = entries[:, [[0, 2], [2, 1]]], 2 * np.pi * f[:, None, None]
    inverse, compliance = residues.sum(axis=0), (residues / w**2).sum(axis=0)
    if min(np.linalg.eigvalsh(inverse)[0], np.linalg.eigvalsh(compliance)[0]) <= 0:
        return {}
    M, K = np.linalg.inv(inverse), np.linalg.inv(compliance)
    # A force along x at the height z turns about y with z, one along y about x with -z.
    sign = 1.0 if group[0] == "x" else -1.0
    mass, centre, springs = M[0, 0], sign * M[0, 1] / M[0, 0], sign * K[0, 1] / K[0, 0]
    if not 1 / SETTINGS.chassis_mass_ratio < mass / now["mass_kg"] < SETTINGS.chassis_mass_ratio:
        return {}
    inertia, rotation = M[1, 1] - mass * centre**2, K[1, 1] - K[0, 0] * springs**2
    return {
        "mass_kg": mass,
        f"frequency_{group[0]}_Hz": np.sqrt(K[0, 0] / mass) / (2 * np.pi),
        f"frequency_{group[1]}_Hz": np.sqrt(rotation / inertia) / (2 * np.pi),
        turn: np.sqrt(inertia / mass),
        "centre_z_m": centre,
        "base_z_m": springs - centre,
    }


def _within(one: ActiveEffect, values: Values) -> tuple[float, ...]:
    """The values of a chassis with some of them replaced, within their ranges."""
    found = {**one.by_name, **values}
    return tuple(float(np.clip(found[p.name], p.low, p.high)) for p in one.parameters)


def _radius(mass: float, inverse_inertia: float) -> float:
    """Radius of gyration [m] of a mass [kg] by the inverse of its moment of inertia [1/(kg m^2)]."""
    low, high = SETTINGS.chassis_radius_m
    return float(np.clip(1 / np.sqrt(inverse_inertia * mass), low, high)) if inverse_inertia > 0 else high


def _resonances(score: Score, coordinates: Sequence[str]) -> tuple[dict[str, float], Reduction]:
    """Frequencies [Hz] of the coordinates in which the chassis recoils, the most significant first, with the reduction
    of the sum of squares; its coefficients are the inverse masses [1/kg] and moments of inertia [1/(kg m^2)]."""
    rows, labels = [], []
    for f in np.geomspace(*SETTINGS.chassis_own_Hz):
        key = ("recoil", float(f))
        if key not in score.kept:
            score.kept[key] = recoils(score, partial(receptance, frequency_Hz=f, damping=SETTINGS.chassis_damping))
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
        if not trials or chi2 < SETTINGS.chassis_least_gain * took.chi2:
            return best, took
        took = more
        rows.append(k)
        best[labels[k][0]] = labels[k][1]
