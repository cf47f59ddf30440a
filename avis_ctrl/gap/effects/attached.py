"""A sprung mass on the payload: along one direction, or along three axes with a frequency each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Reported, Seed, register, told_from_none
from avis_ctrl.gap.effects.impedance import at_points, peaks, positions, project, unit_matrices
from avis_ctrl.gap.effects.line_of_action import best_direction, told
from avis_ctrl.gap.effects.payload import AtPoint, place_of
from avis_ctrl.gap.effects.sensors import second_order
from avis_ctrl.rigs.rigid_body import point_map

if TYPE_CHECKING:
    from avis_ctrl.gap.operators import Operators
    from avis_ctrl.gap.score import Score
    from avis_ctrl.gap.table_model import TableModel

# Damping ratios at which seeds are looked for, and how often the step between frequencies is halved about the best.
DAMPINGS, HALVINGS = (0.03, 0.15), 3


@register
class AttachedOscillator(AtPoint):
    """A mass m on a spring and damper at a point: m s^2 (2 z w s + w^2)/(s^2 + 2 z w s + w^2) along its directions.

    oblique : one direction d; the parameters are d sqrt(m), of either sign. axes : the same mass along x, y and z, each
    with its own frequency. "z", "xy" .. : the same mass and frequency along these axes, for values given by hand.
    """

    name = "attached_oscillator"
    title = "a sprung mass on the payload"
    looks_like = "a pair of peak and dip at its own frequency, in every channel that moves its place"
    confusable = ("payload_flexible_mode", "mount_surge", "base_compliance")
    holds_states = True

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload/oblique", "payload/axes")

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        mass = model.rig.mounted_body().mass
        frequency = EffectParameter("frequency_Hz", "Hz", "of the mass on its spring", 0.0, 0.3, 300.0, 10.0, False,
                                    tuple(np.geomspace(1.2, 90.0, 28)))
        damping = EffectParameter("damping", "1", "damping ratio", 0.0, 1e-3, 2.0, 0.05, False, (0.05,), True)
        own = EffectParameter("mass_kg", "kg", "sprung mass", 0.0, 0.0, mass, 0.01 * mass)
        variant = place.partition("/")[2]
        if variant == "oblique":
            most = float(np.sqrt(mass))
            along = [EffectParameter(f"along_{axis}", "sqrt(kg)", f"root of the mass times its direction's {axis}", 0.0,
                                     -most, most, 0.1 * most, group="along") for axis in "xyz"]
            return (*along, frequency, damping, *self.position())
        if variant == "axes":
            each = [replace(frequency, name=f"frequency_{axis}_Hz", description=f"of the mass along {axis}")
                    for axis in "xyz"]
            return (own, *each, damping, *self.position())
        across = [one for one in self.position() if len(variant) > 1 or one.name != f"{variant}_m"]
        return (own, frequency, damping, *across)

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        for row, mass, frequency in elements(place, values):
            Z = mass * sprung(ops.s, frequency, values["damping"])
            ops.add_impedance(Z[:, None], row[None])
            # What each mass starts with rings at its own frequency.
            ops.inner.append(row[:, None] / second_order(ops.s, frequency, values["damping"])[:, None, None])

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Over frequency, damping, places and directions; the mass follows."""
        parameters = self.parameters(score.model, place)
        found = _along_three_axes(score, parameters) if place.endswith("axes") else _along_one(score, parameters)
        return sorted(found, key=lambda seed: -seed.chi2)

    def implausible(self, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        names = [name for name in values if name.startswith("along_")] or ["mass_kg"]
        return "" if told_from_none(values, std, names) else "a sprung mass that the data do not tell from none"

    def reported(self, model: TableModel, place: str, values: Mapping[str, float], covariance: np.ndarray
                 ) -> dict[str, Reported]:
        """Of one direction: mass, direction, and the point nearest to the geometric centre on the line of action, for
        along that line a place makes no difference."""
        found = super().reported(model, place, values, covariance)
        a = np.array([values.get(f"along_{axis}", 0.0) for axis in "xyz"])
        if not np.any(a):
            return found
        line = told(values, covariance, "mass_kg", "kg")
        return {"mass_kg": line.pop("mass_kg"), "frequency_Hz": found["frequency_Hz"], "damping": found["damping"],
                **line}


def elements(place: str, values: Mapping[str, float]) -> list[tuple[np.ndarray, float, float]]:
    """(row over q (6,), mass, frequency in Hz) along each direction in which the mass can move."""
    variant, rows = place.partition("/")[2], point_map(place_of(values))
    if variant == "oblique":
        a = np.array([values[f"along_{axis}"] for axis in "xyz"])
        mass = float(a @ a)
        return [(a / np.sqrt(mass) @ rows, mass, values["frequency_Hz"])] if mass > 0 else []
    axes = "xyz" if variant == "axes" else variant
    return [(rows["xyz".index(axis)], values["mass_kg"],
             values[f"frequency_{axis}_Hz" if variant == "axes" else "frequency_Hz"]) for axis in axes]


def oscillator(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """Force of a sprung mass over the force of the same mass fixed, (n,)."""
    w = 2 * np.pi * frequency_Hz
    return (2 * damping * w * s + w ** 2) / second_order(s, frequency_Hz, damping)


def sprung(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """Dynamic stiffness of a sprung mass of 1 kg, (n,)."""
    return s ** 2 * oscillator(s, frequency_Hz, damping)


def _along_one(score: Score, parameters: Sequence[EffectParameter]) -> list[Seed]:
    """Best place and direction at each frequency of the grid and of the residual's peaks; refined about the best."""
    points = positions(parameters)
    most = parameters[0].high

    def at(f: float, zeta: float) -> Seed | None:
        G, b = project(score, partial(sprung, frequency_Hz=f, damping=zeta), ("sprung", f, zeta))
        chi2, k, d, mass = best_direction(G, b, points)
        a = min(np.sqrt(max(mass, 0.0)), 0.7 * most) * d
        return Seed((*a, f, zeta, *points[k]), chi2, 7, len(parameters[3].grid) * len(DAMPINGS)) if mass > 0 else None

    grid = parameters[3].grid
    found = [seed for f in grid for zeta in DAMPINGS if (seed := at(f, zeta))]
    found += [seed for f in peaks(score) for zeta in (0.01, 0.05) if (seed := at(f, zeta))]
    if not found:
        return []
    best, step = max(found, key=lambda seed: seed.chi2), np.sqrt(grid[1] / grid[0])
    for _ in range(HALVINGS):
        f, zeta = best.values[3:5]
        near = [seed for one, other in ((f * step, zeta), (f / step, zeta), (f, zeta / 2))
                if (seed := at(one, other))]
        found += near
        best, step = max([best, *near], key=lambda seed: seed.chi2), np.sqrt(step)
    return found


def _along_three_axes(score: Score, parameters: Sequence[EffectParameter]) -> list[Seed]:
    """Three frequencies at once: all triples at a place, then all places at the best triple, and again."""
    points, zeta = positions(parameters), 0.05
    frequencies = sorted({*parameters[1].grid, *peaks(score)})
    frequencies = [f for f in frequencies if f > 2.0]
    kept = [unit_matrices(score, partial(sprung, frequency_Hz=f, damping=zeta)).astype(np.float32)
            for f in frequencies]
    axes = at_points(points, "xyz")
    e, found = score.e.astype(np.float32), []
    for begin in _first_points(kept, e, axes):
        k, before = begin, -1.0
        for _ in range(3):
            chi2, mass, triple = _best_triple(kept, e, axes[k])
            if mass <= 0 or chi2 <= before * (1 + 1e-6):
                break
            before = chi2
            own = [frequencies[j] for j in triple]
            values = (min(mass, 0.5 * parameters[0].high), *own, zeta, *points[k])
            found.append(Seed(values, chi2, 8, len(frequencies) ** 3))
            k = _best_point(kept, e, axes, triple)
    return found


def _first_points(kept: list[np.ndarray], e: np.ndarray, axes: np.ndarray) -> list[int]:
    """Places at which equal frequencies take most, and at which the axes by themselves do in sum."""
    together, alone = np.zeros(len(axes)), np.zeros((len(axes), 3))
    for A in kept:
        G, b = (A @ A.T).astype(float), (A @ e).astype(float)
        sum_of = axes.sum(1)
        own, size = sum_of @ b, np.einsum("ni,ij,nj->n", sum_of, G, sum_of)
        together = np.maximum(together, np.maximum(own, 0) ** 2 / size)
        own, size = axes @ b, np.einsum("nai,ij,naj->na", axes, G, axes)
        alone = np.maximum(alone, np.maximum(own, 0) ** 2 / size)
    return list(dict.fromkeys((int(np.argmax(together)), int(np.argmax(alone.sum(1))))))


def _best_triple(kept: list[np.ndarray], e: np.ndarray, rows: np.ndarray) -> tuple[float, float, tuple[int, int, int]]:
    """(chi2, mass, index of the frequency along x, y, z) at one place; rows (3, 21)."""
    A = np.array([rows.astype(np.float32) @ one for one in kept])  # (n, 3, N)
    n = len(A)
    flat = np.swapaxes(A, 0, 1).reshape(3 * n, -1)
    G, b = (flat @ flat.T).astype(float).reshape(3, n, 3, n), (flat @ e).astype(float).reshape(3, n)
    own = np.einsum("anan->an", G)
    x, y, z = np.ix_(range(n), range(n), range(n))
    along = b[0, x] + b[1, y] + b[2, z]
    size = own[0, x] + own[1, y] + own[2, z] + 2 * (G[0, x, 1, y] + G[0, x, 2, z] + G[1, y, 2, z])
    chi2 = np.maximum(along, 0) ** 2 / size
    best = np.unravel_index(int(np.argmax(chi2)), chi2.shape)
    return float(chi2[best]), float(along[best] / size[best]), (int(best[0]), int(best[1]), int(best[2]))


def _best_point(kept: list[np.ndarray], e: np.ndarray, axes: np.ndarray, triple: tuple[int, int, int]) -> int:
    """Place at which three frequencies take most."""
    A = np.concatenate([kept[j] for j in triple])
    G, b = (A @ A.T).astype(float), (A @ e).astype(float)
    rows = axes.reshape(len(axes), -1)
    along = rows @ b
    return int(np.argmax(np.maximum(along, 0) ** 2 / np.einsum("ni,ij,nj->n", rows, G, rows)))
