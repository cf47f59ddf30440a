"""What large rotations add to the linear table: second-order terms that are there on any table, and named by nobody.

The nonlinear table of Rademakers (eqs. 2.1-2.21) less its linearisation acts as a force on the payload. Whether motors
and sensors turn with the payload the source leaves open (its forces act along earth axes, its sensors sit on the
payload): both enter with a factor that the data choose, 0 for axes fixed in space and 1 for axes fixed to the payload.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from avis_ctrl.gap.effects.base import Effect, EffectParameter
from avis_ctrl.rigs.nonlinear import payload_acceleration, rig_arrays

if TYPE_CHECKING:
    from avis_ctrl.gap.motion import RecordMotion
    from avis_ctrl.gap.table_model import TableModel


class LargeMotion(Effect):
    """Part of every model whose records are known in time; not one of the library."""

    name = "large_motion"
    title = "second-order terms of large rotations"
    idealised = False
    looks_like = "a residual that grows with the square of the level, at low frequency first"
    nonlinear = True

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload",)

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        # Little room beyond 0 and 1, and a size above it: a gap of another origin must not lead a fit astray here.
        return tuple(EffectParameter(name, "1", text, 0.0, -0.5, 1.5, 4.0) for name, text in (
            ("mounts", "second-order terms of mounts and inertia, 1 by Newton and Euler"),
            ("motors_turn", "share of the payload's rotation that turns the motors' axes"),
            ("sensors_turn", "share of it that turns the sensors' axes")))

    def force(self, record: RecordMotion, place: str, values: Mapping[str, float]) -> np.ndarray | None:
        return values["mounts"] * record.large_force + values["motors_turn"] * record.turned_force

    def reading(self, record: RecordMotion, place: str, values: Mapping[str, float]) -> np.ndarray | None:
        return values["sensors_turn"] * record.turned_reading

    def force_spectrum(self, record: RecordMotion, place: str, values: Mapping[str, float], omega: np.ndarray
                       ) -> np.ndarray | None:
        return (values["mounts"] * record.kept("large", omega, lambda: record.large_force)
                + values["motors_turn"] * record.kept("turned", omega, lambda: record.turned_force))

    def reading_spectrum(self, record: RecordMotion, place: str, values: Mapping[str, float], omega: np.ndarray
                         ) -> np.ndarray | None:
        return values["sensors_turn"] * record.kept("reading", omega, lambda: record.turned_reading)


def second_order(rig, q: np.ndarray, q_dot: np.ndarray, u: np.ndarray, sensors: tuple[str, ...]
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Second-order force of the table and of turned motors (samples, 6), and acceleration read by turned sensors.

    q, q_dot : (samples, 6) payload relative to the chassis. u : (samples, n_u) acting volts.
    """
    body, eom = rig.mounted_body(), rig.equations_of_motion()
    q_ddot = _accelerations(np.ascontiguousarray(q), np.ascontiguousarray(q_dot), np.ascontiguousarray(u),
                                  rig_arrays(body))
    large = q_ddot @ eom.M.T + q_dot @ eom.C.T + q @ eom.K.T - u @ eom.T.T
    turned = np.zeros_like(q)
    for k, motor in enumerate(body.actuators):
        force = np.cross(q[:, 3:], motor.direction) * (motor.constant_N_per_V * u[:, k])[:, None]
        turned[:, :3] += force
        turned[:, 3:] += np.cross(motor.position, force)
    axes = rig.sensor_axes()
    reading = np.empty((len(q), len(sensors)))
    for k, name in enumerate(sensors):
        place, direction = axes[name]
        acceleration = q_ddot[:, :3] + np.cross(q_ddot[:, 3:], place)
        reading[:, k] = np.einsum("ni,ni->n", np.cross(q[:, 3:], direction), acceleration)
    return large, turned, reading


@njit(cache=True)
def _accelerations(q, q_dot, u, arrays):
    out = np.empty_like(q)
    still = np.zeros(6)
    for k in range(len(q)):
        out[k] = payload_acceleration(q[k], q_dot[k], u[k], still, still, arrays)
    return out
