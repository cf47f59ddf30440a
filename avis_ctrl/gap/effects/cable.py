"""A cable or hose between the payload and ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Reported, Table, Values, register
from avis_ctrl.gap.effects.impedance import about, at_points, positions, project
from avis_ctrl.gap.effects.line_of_action import along, best_direction, reported_line
from avis_ctrl.gap.effects.payload import AtPoint, place_of
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.score import Score, reduction
from avis_ctrl.gap.starting_values import SETTINGS, Seed
from avis_ctrl.rigs.rigid_body import point_map


@register
class CableStiffness(AtPoint):
    """A spring with a little damping, from a point of the payload to ground.

    axes : one stiffness along each of x, y and z. oblique : one direction d; the parameters are d sqrt(k).
    """

    name = "cable_stiffness"
    title = "a cable or hose ties the payload to ground"
    looks_like = "stiffness at a place and height where no mount is: it shifts and couples the lowest resonances"
    at = ("payload/axes", "payload/oblique")

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        size = 0.02 * float(np.mean(np.diag(model.base.matrices.K)[:3])) / 4  # 2 % of one mount of four, on any rig
        most = 200 * size
        own = EffectParameter("k_{}_N_per_m", "N/m", "stiffness along {}", 0.0, 0.0, most, size)
        if place.endswith("oblique"):
            words, high = "root of the stiffness times its direction's {}", float(np.sqrt(most))
            own = EffectParameter("along_{}", "sqrt(N/m)", words, 0.0, -high, high, float(np.sqrt(size)))
        return (
            *own.of_each("xyz"),
            EffectParameter.shape("damping_s", "s", "damping over stiffness", 0.0, 0.1, 1e-3, (0.0,), optional=True),
            *(replace(one, optional=True) for one in self.position()),
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        k, V = np.linalg.eigh(tie(values))
        rows = V.T @ point_map(place_of(values))
        Z = k * (1 + ops.s * values["damping_s"])[:, None]
        ops.add_impedance(Z, rows, Z)

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Seeds over a grid of places, refined near the best: the direction and stiffness that reduce chi-square most,
        or the non-negative stiffnesses along the axes."""
        parameters = self.parameters(score.model, place)
        G, b = project(score, np.ones_like, "spring")
        of = _along_one if place.endswith("oblique") else _along_axes
        found = of(G, b, positions(parameters), parameters[0].high)
        for halving in range(1, SETTINGS.halvings + 1) if found else ():
            near = about(np.array(found[0].values[-3:]), 0.5**halving)
            found = sorted(found + of(G, b, near, parameters[0].high), key=lambda seed: -seed.chi2)
        return found

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        """For one direction: stiffness, direction, and the foot of the line of action. Otherwise all stiffnesses,
        preceded by the largest."""
        found = super().reported(model, place, values, covariance)
        if "along_x" in values:
            return {**reported_line(values, covariance, "stiffness_N_per_m", "N/m"), "damping_s": found["damping_s"]}
        largest = max((found[f"k_{axis}_N_per_m"] for axis in "xyz"), key=lambda one: one.value)
        return {"stiffness_N_per_m": largest, **found}


def _along_one(G: np.ndarray, b: np.ndarray, points: np.ndarray, most: float) -> list[Seed]:
    chi2, at, d, k = best_direction(G, b, points)
    a = min(np.sqrt(max(k, 0.0)), 0.7 * most) * d
    return [Seed((*(float(x) for x in a), 0.0, *points[at]), chi2, 6)] if k > 0 else []


def _along_axes(G: np.ndarray, b: np.ndarray, points: np.ndarray, most: float) -> list[Seed]:
    found = []
    for point, rows in zip(points, at_points(points, "xyz"), strict=True):
        A, d = rows @ G @ rows.T, rows @ b
        own = np.clip(reduction(A, d).coefficients, 0.0, most)
        if np.any(own > 0):
            found.append(Seed((*own.tolist(), 0.0, *point), float(2 * own @ d - own @ A @ own), 6))
    return sorted(found, key=lambda seed: -seed.chi2)


def tie(values: Values) -> np.ndarray:
    """(3, 3) stiffness of a cable [N/m] from its values by name."""
    if "along_x" in values:
        return np.outer(along(values), along(values))
    return np.diag([values[f"k_{axis}_N_per_m"] for axis in "xyz"])
