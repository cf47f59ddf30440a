"""Second-order terms of large rotations, which every table has; they are never named as a missing effect.

As in `identification.large_motion`, with three factors that the data determine: for all terms of mounts and inertia,
for the motors, and for the sensors.
"""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import Added, Effect, EffectParameter, Table, Values
from avis_ctrl.gap.record_motion import RecordMotion


class LargeMotion(Effect):
    """Part of every model whose records are known in time; not in the library."""

    name = "large_motion"
    title = "second-order terms of large rotations"
    looks_like = "a residual that grows with the square of the level, at low frequency first"
    at = ("payload",)
    nonlinear = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        # Little room beyond 0 and 1, and a larger size: a gap with another cause must not affect the fit here.
        return tuple(
            EffectParameter(name, "1", text, 0.0, -0.5, 1.5, 4.0)
            for name, text in (
                ("mounts", "second-order terms of mounts and inertia, 1 by Newton and Euler"),
                ("motors_turn", "fraction of the payload's rotation that turns the motors' axes"),
                ("sensors_turn", "fraction of it that turns the sensors' axes"),
            )
        )

    def force(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        return values["mounts"] * record.large_force + values["motors_turn"] * record.turned_force

    def reading(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        return values["sensors_turn"] * record.turned_reading

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        force = values["mounts"] * record.kept("large", omega, lambda: record.large_force) + values[
            "motors_turn"
        ] * record.kept("turned", omega, lambda: record.turned_force)
        reading = values["sensors_turn"] * record.kept("reading", omega, lambda: record.turned_reading)
        return Added(force=force, reading=reading)
