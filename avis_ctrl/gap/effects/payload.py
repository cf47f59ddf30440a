"""Effects of the payload that a model may lack: offset of its centre of mass, products of inertia."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avis_ctrl.gap.effects.base import SETTINGS, Effect, EffectParameter, Table, Values, register

PRODUCTS = {"Jxy": "J12", "Jxz": "J13", "Jyz": "J23"}


@register
class ComOffset(Effect):
    """Offset of the centre of mass from that of the rig file; parallel-axis terms included (docs/theory/plant.md)."""

    name = "com_offset"
    title = "the centre of mass is not where the model has it"
    looks_like = "coupling between translations and rotations, also at all frequencies above the resonances"

    def places(self, model: Table) -> tuple[str, ...]:
        return ("payload",) if "com_x" in model.rig.parameters() else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        words = "centre of mass beyond the model's along {}"
        return EffectParameter("offset_{}_m", "m", words, 0.0, -0.5, 0.5, 0.05).of_each("xyz")

    def rig_changes(self, model: Table, place: str, values: Values) -> dict[str, float]:
        known = model.rig.parameters()
        return {f"com_{axis}": known[f"com_{axis}"].value + values[f"offset_{axis}_m"] for axis in "xyz"}


@register
class ProductOfInertia(Effect):
    """One off-diagonal entry of the inertia tensor about the centre of mass: J12 = -integral of x y dm."""

    name = "product_of_inertia"
    title = "a product of inertia of the payload"
    looks_like = "coupling between two rotations"

    def places(self, model: Table) -> tuple[str, ...]:
        return tuple(PRODUCTS) if "J12" in model.rig.parameters() else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        known = model.rig.parameters()
        most = 0.9 * min(known[name].value for name in ("J1", "J2", "J3"))
        words = "entry of the inertia tensor beyond the model's"
        return (EffectParameter(f"{place}_kgm2", "kg m^2", words, 0.0, -most, most, 0.1 * most),)

    def rig_changes(self, model: Table, place: str, values: Values) -> dict[str, float]:
        name = PRODUCTS[place]
        return {name: model.rig.parameters()[name].value + values[f"{place}_kgm2"]}


class AtPoint(Effect):
    """An effect at a point of the payload."""

    def position(self) -> tuple[EffectParameter, ...]:
        most, words = SETTINGS.reach_m, "its place along {}, from the geometric centre"
        each = EffectParameter.shape("{}_m", "m", words, -most, most, 0.2, ()).of_each("xyz")
        grids = (-0.4, 0.0, 0.4), (-0.3, 0.0, 0.3), (-0.15, 0.25)
        return tuple(replace(one, grid=grid) for one, grid in zip(each, grids, strict=True))


def place_of(values: Values) -> np.ndarray:
    """(3,) place of an effect at a point of the payload [m]."""
    return np.array([values.get(f"{axis}_m", 0.0) for axis in "xyz"])
