"""What a model may lack of the payload: where its mass is, and what ties it to the ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from avis_ctrl.gap.effects.base import Effect, EffectParameter, Reported, Seed, register
from avis_ctrl.gap.effects.impedance import at_points, positions, project
from avis_ctrl.gap.score_algebra import reduction
from avis_ctrl.rigs.rigid_body import point_map

if TYPE_CHECKING:
    from avis_ctrl.gap.operators import Operators
    from avis_ctrl.gap.score import Score
    from avis_ctrl.gap.table_model import TableModel

PRODUCTS = {"Jxy": "J12", "Jxz": "J13", "Jyz": "J23"}
REACH_m = 2.0  # how far from the geometric centre something can be fixed to a payload


@register
class ComOffset(Effect):
    """Centre of mass beside where the rig file has it; parallel-axis terms included (equations.md)."""

    name = "com_offset"
    title = "the centre of mass is not where the model has it"
    idealised = False
    looks_like = "coupling between translations and rotations, at every frequency above the resonances too"
    confusable = ("product_of_inertia", "sensor_misalignment", "cable_stiffness")

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload",) if "com_x" in model.rig.parameters() else ()

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"offset_{axis}_m", "m", f"centre of mass beyond the model's along {axis}", 0.0,
                                     -0.5, 0.5, 0.05) for axis in "xyz")

    def rig_changes(self, model: TableModel, place: str, values: Mapping[str, float]) -> dict[str, float]:
        known = model.rig.parameters()
        return {f"com_{axis}": known[f"com_{axis}"].value + values[f"offset_{axis}_m"] for axis in "xyz"}


@register
class ProductOfInertia(Effect):
    """One entry beside the diagonal of the inertia tensor about the centre of mass: J12 = -integral of x y dm."""

    name = "product_of_inertia"
    title = "a product of inertia of the payload"
    idealised = False
    looks_like = "coupling between two rotations"
    confusable = ("com_offset", "payload_flexible_mode")

    def places(self, model: TableModel) -> tuple[str, ...]:
        return tuple(PRODUCTS) if "J12" in model.rig.parameters() else ()

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        known = model.rig.parameters()
        largest = 0.9 * min(known[name].value for name in ("J1", "J2", "J3"))
        return (EffectParameter(f"{place}_kgm2", "kg m^2", "entry of the inertia tensor beyond the model's", 0.0,
                                -largest, largest, 0.1 * largest),)

    def rig_changes(self, model: TableModel, place: str, values: Mapping[str, float]) -> dict[str, float]:
        name = PRODUCTS[place]
        return {name: model.rig.parameters()[name].value + values[f"{place}_kgm2"]}


class AtPoint(Effect):
    """Something at a point of the payload."""

    def position(self) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"{axis}_m", "m", f"its place along {axis}, from the geometric centre", 0.0,
                                     -REACH_m, REACH_m, 0.2, False, grid)
                     for axis, grid in zip("xyz", ((-0.4, 0.0, 0.4), (-0.3, 0.0, 0.3), (-0.15, 0.25)), strict=True))


def place_of(values: Mapping[str, float]) -> np.ndarray:
    return np.array([values.get(f"{axis}_m", 0.0) for axis in "xyz"])


@register
class CableStiffness(AtPoint):
    """A spring, with a little damping, from a point of the payload to the chassis: three axes, or one direction."""

    name = "cable_stiffness"
    title = "a cable or hose ties the payload to ground"
    looks_like = "stiffness at a place and height where no mount is: it shifts and couples the lowest resonances"
    confusable = ("com_offset", "leveling_loop")

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload/axes", "payload/oblique")

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        size = 0.02 * float(np.mean(np.diag(model.base.matrices.K)[:3])) / 4  # of one mount of four, on any rig
        most = 200 * size
        own = [EffectParameter(f"k_{axis}_N_per_m", "N/m", f"stiffness along {axis}", 0.0, 0.0, most, size)
               for axis in "xyz"]
        if place.endswith("oblique"):
            own += [EffectParameter(f"k_{axes}_N_per_m", "N/m", f"stiffness between {axes[0]} and {axes[1]}", 0.0,
                                    -most, most, size) for axes in ("xy", "xz", "yz")]
        return (*own, EffectParameter("damping_s", "s", "damping over stiffness", 0.0, 0.0, 0.1, 1e-3, False, (0.0,),
                                      True),
                *(replace(one, optional=True) for one in self.position()))

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        k, V = np.linalg.eigh(tie(values))
        rows = V.T @ point_map(place_of(values))
        Z = k * (1 + ops.s * values["damping_s"])[:, None]
        ops.add_impedance(Z, rows, Z)

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Over a grid of places; the stiffnesses follow, those that come out negative at zero."""
        model, found = score.model, []
        parameters = self.parameters(model, place)
        points = positions(parameters)
        G, b = project(score, lambda s: np.ones_like(s))
        n_k = 6 if place.endswith("oblique") else 3
        basis = at_points(points, "xyz", oblique=n_k == 6)
        for point, rows in zip(points, basis, strict=True):
            A, d = rows @ G @ rows.T, rows @ b
            k = reduction(A, d).coefficients
            own = k.copy()
            own[:3] = np.maximum(own[:3], 0.0)
            chi2 = float(2 * own @ d - own @ A @ own)
            if np.any(own[:3] > 0):
                found.append(Seed((*np.clip(own, [one.low for one in parameters[:n_k]],
                                            [one.high for one in parameters[:n_k]]).tolist(), 0.0, *point), chi2,
                                  n_k + 3))
        return sorted(found, key=lambda seed: -seed.chi2)

    def implausible(self, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        if not any(values[name] > 3 * std[name] for name in (f"k_{axis}_N_per_m" for axis in "xyz")):
            return "a cable that the data do not tell from none"
        if "k_xy_N_per_m" not in values:
            return ""
        k = np.linalg.eigvalsh(tie(values))
        slack = 3 * max((std[f"k_{axis}_N_per_m"] for axis in "xyz"), default=0.0)
        return f"a cable with a negative stiffness, {k[0]:.3g} N/m" if k[0] < -slack - 1e-3 * k[-1] else ""

    def reported(self, model: TableModel, place: str, values: Mapping[str, float], covariance: np.ndarray
                 ) -> dict[str, Reported]:
        """The largest principal stiffness before all others; to first order it moves by v^T dK v, v its direction."""
        k, V = np.linalg.eigh(tie(values))
        v, slope = V[:, -1], np.zeros(len(values))
        for j, name in enumerate(values):
            if name.startswith("k_"):
                a, b = "xyz".index(name[2]), "xyz".index(name[3] if name[3] != "_" else name[2])
                slope[j] = v[a] * v[b] * (1 if a == b else 2)
        std = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
        return {"stiffness_N_per_m": Reported(float(k[-1]), std, "N/m"),
                **super().reported(model, place, values, covariance)}


def tie(values: Mapping[str, float]) -> np.ndarray:
    """(3, 3) N/m: stiffness of a cable from its values by name."""
    K = np.diag([values[f"k_{axis}_N_per_m"] for axis in "xyz"])
    for a, b in ((0, 1), (0, 2), (1, 2)):
        K[a, b] = K[b, a] = values.get(f"k_{'xyz'[a]}{'xyz'[b]}_N_per_m", 0.0)
    return K
