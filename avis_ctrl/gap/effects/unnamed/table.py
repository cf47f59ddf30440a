"""Physics of payload and mounts that has no name in the library."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Table, Values
from avis_ctrl.gap.effects.mounts import CubicStiffness, OfMounts, largest_rms, stiffness
from avis_ctrl.gap.effects.unnamed.base import UnnamedFault
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.record_motion import RecordMotion


class QuadraticStiffness(UnnamedFault, CubicStiffness):
    """Force -k2 d^2 at every vertical mount: an air spring is stiffer in compression than in extension."""

    name = "quadratic_stiffness"
    title = "mounts of unlike stiffness up and down"
    words = "vertical mounts with a term in the square of their deflection"
    at = ("isolators z",)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (stiffness(model, 2, "quadratic"),)

    def implausible(self, values: Values, std: Values) -> str:
        return ""


class QuadraticDrag(UnnamedFault, OfMounts):
    """Air drag: force -c |v| v on the payload at the table's centre, v its velocity relative to the chassis."""

    name = "quadratic_drag"
    title = "drag in proportion to the square of velocity"
    words = "drag on the payload in proportion to the square of velocity"
    at = ("payload",)
    nonlinear = True
    strength = "drag_Ns2_per_m2"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        size = 10.0 / max(largest_rms(model) * 10.0, 1e-9)
        return (EffectParameter("drag_Ns2_per_m2", "N s^2/m^2", "of the payload", 0.0, -1e4 * size, 1e4 * size, size),)

    def force(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        v = np.gradient(record.deflection @ np.linalg.pinv(record.rows).T, 1 / record.sample_rate_Hz, axis=0)
        force = np.zeros_like(v)
        force[:, :3] = -values["drag_Ns2_per_m2"] * np.linalg.norm(v[:, :3], axis=1, keepdims=True) * v[:, :3]
        return force


class Gyroscope(UnnamedFault):
    """Moment h x w of a rotor with angular momentum h on the payload: s W on the rotations, W skew-symmetric."""

    name = "gyroscope"
    title = "a rotor on the payload"
    words = "a rotor on the payload (moments at right angles to its tilting)"
    at = ("payload",)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return EffectParameter("h{}_Nms", "N m s", "angular momentum about {}", 0.0, -1e6, 1e6, 1.0).of_each("xyz")

    def change(self, ops: Operators, place: str, values: Values) -> None:
        x, y, z = (values[f"h{axis}_Nms"] for axis in "xyz")
        W = np.zeros((6, 6))
        W[3:, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        Z = ops.s[:, None, None] * W
        ops.extra = Z if ops.extra is None else ops.extra + Z
