"""A sprung mass on the payload: along one direction, or along three axes with a separate frequency for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from avis_ctrl.gap.effects.base import SETTINGS as LIBRARY
from avis_ctrl.gap.effects.base import EffectParameter, Reported, Table, Values, register
from avis_ctrl.gap.effects.impedance import (
    about,
    at_points,
    grid_points,
    peaks,
    positions,
    project,
    springs_along,
    unit_matrices,
)
from avis_ctrl.gap.effects.line_of_action import along, best_direction, foot, reported_line
from avis_ctrl.gap.effects.payload import AtPoint, place_of
from avis_ctrl.gap.effects.sensors import second_order, sprung
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.starting_values import SETTINGS, Seed
from avis_ctrl.gap.table_model import ActiveEffect
from avis_ctrl.rigs.rigid_body import point_map

THREE_AXES = ("axes", "turned")


@register
class AttachedOscillator(AtPoint):
    """A mass m on a spring and damper at a point: m s^2 (2 z w s + w^2)/(s^2 + 2 z w s + w^2) along each direction.

    oblique : one direction d; the parameters are d sqrt(m), of either sign. axes : the same mass along x, y and z, with
    a separate frequency for each. turned : the same along three orthogonal axes that are rotated relative to x, y and
    z. "z", "xy" .. : the same mass and frequency along these axes, for values specified by hand.
    """

    name = "attached_oscillator"
    title = "a sprung mass on the payload"
    looks_like = "a dip and a nearby peak around its own frequency, in every channel that moves it"
    at = ("payload/oblique", "payload/axes", "payload/turned")
    holds_states = True
    resonant = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        mass, shape, grid = model.rig.mounted_body().mass, EffectParameter.shape, np.geomspace(*SETTINGS.attached_Hz)
        frequency = shape("frequency_Hz", "Hz", "of the mass on its spring", 0.3, 300.0, 10.0, grid)
        damping = shape("damping", "1", "damping ratio", 1e-3, 2.0, 0.05, (0.05,), optional=True)
        own = EffectParameter("mass_kg", "kg", "sprung mass", 0.0, 0.0, mass, 0.01 * mass)
        variant = place.partition("/")[2]
        if variant == "oblique":
            most, words = float(np.sqrt(mass)), "sqrt(mass) times {} of its direction"
            root = EffectParameter("along_{}", "sqrt(kg)", words, 0.0, -most, most, 0.1 * most).of_each("xyz")
            # The position along the line of action has no effect, so it may end at a bound.
            return (*root, frequency, damping, *(replace(one, optional=True) for one in self.position()))
        if variant in THREE_AXES:
            each = replace(frequency, name="frequency_{}_Hz", description="of the mass along {}").of_each("xyz")
            most, words = LIBRARY.most_turned, "{} component of the rotation vector of its axes"
            turns = shape("turn_{}", "rad", words, -most, most, 0.3, (0.0,), optional=True)
            turned = turns.of_each("xyz") if variant == "turned" else ()
            return (own, *each, damping, *self.position(), *turned)
        across = [one for one in self.position() if len(variant) > 1 or one.name != f"{variant}_m"]
        return (own, frequency, damping, *across)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        for row, mass, frequency in elements(place, values):
            Z = mass * sprung(ops.s, frequency, values["damping"])
            ops.add_impedance(Z[:, None], row[None])
            # The initial state of each mass rings at the mass's own frequency.
            ops.inner.append(row[:, None] / second_order(ops.s, frequency, values["damping"])[:, None, None])

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Seeds over frequencies, damping ratios, places and directions; the mass follows from the score test."""
        parameters = self.parameters(score.model, place)
        search = {"axes": _along_three_axes, "turned": _along_turned_axes, "oblique": _along_one}
        return sorted(search[place.partition("/")[2]](score, parameters), key=lambda seed: -seed.chi2)

    def extended_models(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """From a fit along one direction: three axes, of which the nearest keeps its frequency; along the others, a
        resonance is searched at each frequency, anywhere on the line of action."""
        if not one.place.endswith("oblique"):
            return []
        values = one.by_name
        a = along(values)
        mass, first = float(a @ a), int(np.argmax(np.abs(a)))
        parameters = self.parameters(score.model, "payload/axes")
        # A resonance with damping ratio zeta has a relative width of 2 zeta, so a step of zeta misses none.
        grid, damping = parameters[1].grid, max(values["damping"], SETTINGS.narrowest)
        count = 2 + int(np.log(grid[-1] / grid[0]) / damping)
        frequencies = (*np.geomspace(grid[0], grid[-1], count), SETTINGS.stiff_Hz)
        others = [k for k in range(3) if k != first]
        points = place_of(values) + np.outer(np.linspace(-LIBRARY.reach_m, LIBRARY.reach_m, 25), a / np.sqrt(mass))
        axes = "".join("xyz"[k] for k in others)
        pair, point = _along_the_others(score, values["damping"], frequencies, points, axes)
        frequency = np.full(3, values["frequency_Hz"])
        frequency[others] = pair
        return [("payload/axes", tuple(map(float, (mass, *frequency, values["damping"], *point))))]

    def implausible(self, values: Values, std: Values) -> str:
        if "along_x" in values and np.abs(foot(values)).max() > 0.999 * LIBRARY.reach_m:
            return f"a line of action that passes {LIBRARY.reach_m:g} m from the table"
        return ""

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        """For one direction: mass, direction, and the point on the line of action nearest to the geometric centre,
        because the position along that line has no effect."""
        found = super().reported(model, place, values, covariance)
        if not np.any(along(values)):
            return found
        line = reported_line(values, covariance, "mass_kg", "kg")
        own = {name: found[name] for name in ("frequency_Hz", "damping")}
        return {"mass_kg": line.pop("mass_kg"), **own, **line}


def elements(place: str, values: Values) -> list[tuple[np.ndarray, float, float]]:
    """(row over q (6,), mass, frequency [Hz]) for each direction in which the mass can move."""
    variant, rows = place.partition("/")[2], point_map(place_of(values))
    if variant == "oblique":
        a = along(values)
        mass = float(a @ a)
        return [(a / np.sqrt(mass) @ rows, mass, values["frequency_Hz"])] if mass > 0 else []
    if variant == "turned":
        rows = Rotation.from_rotvec([values[f"turn_{axis}"] for axis in "xyz"]).as_matrix().T @ rows
    axes = "xyz" if variant in THREE_AXES else variant
    name = "frequency_{}_Hz" if variant in THREE_AXES else "frequency_Hz"
    return [(rows["xyz".index(axis)], values["mass_kg"], values[name.format(axis)]) for axis in axes]


def _along_one(score: Score, parameters: Sequence[EffectParameter]) -> list[Seed]:
    """Best place and direction at each frequency of the grid and each peak of the residual, refined near the best."""
    every = positions(parameters)
    most, trials = parameters[0].high, len(parameters[3].grid) * len(SETTINGS.dampings)

    def at(f: float, zeta: float, points: np.ndarray = every) -> Seed | None:
        G, b = project(score, partial(sprung, frequency_Hz=f, damping=zeta), ("sprung", f, zeta))
        chi2, k, d, mass = best_direction(G, b, points)
        a = min(np.sqrt(max(mass, 0.0)), 0.7 * most) * d
        return Seed((*a, f, zeta, *points[k]), chi2, 7, trials) if mass > 0 else None

    grid = parameters[3].grid
    found = [seed for f in grid for zeta in SETTINGS.dampings if (seed := at(f, zeta))]
    found += [seed for f in peaks(score) for zeta in SETTINGS.peak_dampings if (seed := at(f, zeta))]
    if not found:
        return []
    best, step, step_m = max(found, key=lambda seed: seed.chi2), np.sqrt(grid[1] / grid[0]), 0.5
    for _ in range(SETTINGS.halvings):
        f, zeta, point = *best.values[3:5], np.array(best.values[5:])
        near = [
            seed
            for one, other in ((f, zeta), (f * step, zeta), (f / step, zeta), (f, zeta / 2))
            if (seed := at(one, other, about(point, step_m)))
        ]
        found += near
        best, step, step_m = max([best, *near], key=lambda seed: seed.chi2), np.sqrt(step), step_m / 2
    return found


def _along_three_axes(score: Score, parameters: Sequence[EffectParameter]) -> list[Seed]:
    """Three frequencies at once: all triples at every place of the grid, then refined near the best places."""
    if "along three axes" in score.kept:  # turned axes start from these
        return list(score.kept["along three axes"])
    points, (frequencies, G, b) = positions(parameters), _resonances(score, parameters)

    def at(point: np.ndarray) -> tuple[float, float, list[int], np.ndarray]:
        rows = at_points(point[None], "xyz")[0]
        return *_best_triple(_at_place(G, rows), b @ rows.T), point

    starts = sorted((at(point) for point in points), key=lambda one: -one[0])[: SETTINGS.followed_places]
    found = []
    for chi2, mass, triple, point in starts:
        best = chi2, mass, triple, point
        for halving in range(1, SETTINGS.halvings + 1):
            near = about(best[3], 0.5**halving)
            best = max(best, at(near[_best_point(G, b, at_points(near, "xyz"), best[2])]), key=lambda one: one[0])
        chi2, mass, triple, point = best
        if mass > 0:
            values = _values(mass, frequencies[triple], point, parameters)
            found.append(Seed(values, chi2, 8, len(frequencies) ** 3))
    score.kept["along three axes"] = tuple(found)
    return found


def _along_turned_axes(score: Score, parameters: Sequence[EffectParameter]) -> list[Seed]:
    """All triples of frequencies and rotations of the axes, at the best places found along x, y and z; then places and
    rotations on finer grids in turn."""
    frequencies, G, b = _resonances(score, parameters)
    (most, count), found = SETTINGS.turned_rad, []
    grid = np.linspace(-most, most, count)
    turns, near = grid_points(grid, grid, grid), (grid[1] - grid[0]) * np.array([-1.0, 0.0, 1.0])
    turns, step = turns[np.linalg.norm(turns, axis=1) <= most], grid_points(near, near, near)
    for seed in sorted(_along_three_axes(score, parameters), key=lambda one: -one.chi2)[: SETTINGS.turned_places]:
        point = np.array(seed.values[5:])
        chi2, mass, triple, turn = _best_turn(G, b, point, turns)
        for halving in range(1, SETTINGS.halvings + 1):
            near = about(point, 0.5**halving)
            axes = _turned(turn) @ at_points(near, "xyz", oblique=True)
            point = near[_best_point(G, b, axes, triple)]
            chi2, mass, triple, turn = _best_turn(G, b, point, turn + 0.5**halving * step)
        if mass > 0:
            values = (*_values(mass, frequencies[triple], point, parameters), *map(float, turn))
            found.append(Seed(values, chi2, 11, len(turns) * len(frequencies) ** 3))
    return found


def _best_turn(
    G: np.ndarray, b: np.ndarray, point: np.ndarray, turns: np.ndarray
) -> tuple[float, float, list[int], np.ndarray]:
    """(chi2, mass, frequency index along each axis, rotation vector (3,)) of the best of the rotations (n, 3)."""
    rows = at_points(point[None], "xyz", oblique=True)[0]
    own, along = _at_place(G, rows), b @ rows.T
    every = [(*_best_triple(_at_place(own, V), along @ V.T), turn) for turn in turns for V in [_turned(turn)]]
    return max(every, key=lambda one: one[0])


def _turned(turn: np.ndarray) -> np.ndarray:
    """(3, 6) `springs_along` axes rotated by the vector `turn` (3,)."""
    return springs_along(Rotation.from_rotvec(turn).as_matrix().T)


def _values(
    mass: float, frequencies: np.ndarray, point: np.ndarray, parameters: Sequence[EffectParameter]
) -> tuple[float, ...]:
    """Starting values of a mass along three axes, without rotation."""
    return tuple(map(float, (min(mass, 0.5 * parameters[0].high), *frequencies, SETTINGS.axes_damping, *point)))


def _resonances(score: Score, parameters: Sequence[EffectParameter]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) frequencies of a sprung mass that are searched along each of three axes, and `_at_frequencies`."""
    if "three axes" not in score.kept:
        frequencies = np.array([f for f in sorted({*parameters[1].grid, *peaks(score)}) if f > 2.0])
        G, b = _at_frequencies(score, frequencies, SETTINGS.axes_damping)
        score.kept["three axes"] = frequencies, G.astype(float), b
    frequencies, G, b = score.kept["three axes"]
    return frequencies, G, b


def _along_the_others(
    score: Score, damping: float, frequencies: Sequence[float], points: np.ndarray, axes: str
) -> tuple[tuple[float, float], np.ndarray]:
    """Frequencies along two axes, and the point (3,), with the largest joint reduction of chi-square. The two masses
    are free, because unnamed effects have absorbed part of their response."""
    G, b = _at_frequencies(score, frequencies, damping)
    best = -np.inf, (0, 0), points[0]
    for rows, point in zip(at_points(points, axes), points, strict=True):
        H, g = _at_place(G, rows), rows @ b.T
        one, other, both = np.diag(H[:, 0, :, 0])[:, None], np.diag(H[:, 1, :, 1]), H[:, 0, :, 1]
        size = one * other - both**2
        masses = np.array([other * g[0][:, None] - both * g[1], one * g[1] - both * g[0][:, None]]) / size
        reduced = np.where(np.all(masses > 0, axis=0), masses[0] * g[0][:, None] + masses[1] * g[1], 0.0)
        k, j = np.unravel_index(int(np.argmax(reduced)), reduced.shape)
        best = max(best, (float(reduced[k, j]), (int(k), int(j)), point), key=lambda found: found[0])
    return (frequencies[best[1][0]], frequencies[best[1][1]]), best[2]


def _at_frequencies(
    score: Score, frequencies: Sequence[float] | np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 21, n, 21) Gram matrix of the unit matrices at each frequency, and (n, 21) product with the residual."""
    n = len(frequencies)
    kept = np.empty((21 * n, len(score.e)), np.float32)  # large; filled one by one to limit memory
    for k, f in enumerate(frequencies):
        kept[21 * k : 21 * (k + 1)] = unit_matrices(score, partial(sprung, frequency_Hz=f, damping=damping))
    return (kept @ kept.T).reshape(n, 21, n, 21), (kept @ score.e.astype(np.float32)).reshape(n, 21)


def _at_place(G: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(n, k, n, k) Gram matrix of a mass at one place, moving along k axes; G (n, m, n, m) as of `_at_frequencies`,
    rows (k, m)."""
    n, m, k, own = *G.shape[:2], len(rows), rows.astype(G.dtype)  # otherwise G, which is large, would be copied
    return ((own @ G.reshape(n, m, -1)).reshape(n, k, n, m) @ own.T).astype(float)


def _best_triple(G: np.ndarray, b: np.ndarray) -> tuple[float, float, list[int]]:
    """(chi2, mass, frequency index along x, y, z) of the best triple at one place; G (n, 3, n, 3), b (n, 3)."""
    own = np.einsum("fafa->af", G)
    x, y, z = np.ix_(*(range(len(b)),) * 3)
    along = b[x, 0] + b[y, 1] + b[z, 2]
    size = own[0, x] + own[1, y] + own[2, z] + 2 * (G[x, 0, y, 1] + G[x, 0, z, 2] + G[y, 1, z, 2])
    chi2 = np.maximum(along, 0) ** 2 / size
    best = np.unravel_index(int(np.argmax(chi2)), chi2.shape)
    return float(chi2[best]), float(along[best] / size[best]), [int(k) for k in best]


def _best_point(G: np.ndarray, b: np.ndarray, axes: np.ndarray, triple: Sequence[int]) -> int:
    """Index of the place at which the three frequencies reduce chi-square most; axes (places, 3, 21)."""
    rows, own = axes.reshape(len(axes), -1), list(triple)
    A = G[own][:, :, own].reshape(63, 63)
    along = rows @ b[own].reshape(63)
    return int(np.argmax(np.maximum(along, 0) ** 2 / np.einsum("ni,ij,nj->n", rows, A, rows)))
