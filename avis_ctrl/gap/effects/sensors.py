"""Effects of the sensors that a model may lack: corner, sensitivity, direction, gravity."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import SETTINGS, Effect, EffectParameter, Table, Values, register
from avis_ctrl.gap.operators import Operators
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import GRAVITY, point_map


def second_order(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """s^2 + 2 zeta w s + w^2, (n,)."""
    w = 2 * np.pi * frequency_Hz
    return s**2 + 2 * damping * w * s + w**2


def receptance(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """1/(s^2 + 2 zeta w s + w^2), (n,): receptance of a mode of unit mass."""
    return 1 / second_order(s, frequency_Hz, damping)


def sprung(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """Dynamic stiffness of a sprung mass of 1 kg, (n,)."""
    w = 2 * np.pi * frequency_Hz
    return s**2 * ((2 * damping * w * s + w**2) / second_order(s, frequency_Hz, damping))


def suspensions(rig: Rig) -> dict[str, tuple[float, float]]:
    """Corner [Hz] and damping ratio of each geophone's suspension, by name."""
    return {one.name: one.suspension for one in rig.sensors() if one.suspension is not None}


def axis_of(model: Table, sensor: str) -> str:
    """The earth axis (x, y or z) with which a sensor is aligned, within the tilt limit; empty if there is none."""
    direction = model.rig.sensor_axes()[sensor][1]
    along = np.flatnonzero(np.abs(direction) > np.cos(SETTINGS.tilted_rad))
    return "xyz"[along[0]] if len(along) else ""


class OfSensor(Effect):
    """An effect of one sensor."""

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names


@register
class GeophoneCorner(OfSensor):
    """Output times (s^2 + 2 z0 w0 s + w0^2)/(s^2 + 2 z w s + w^2): the filter assumes another corner.

    Rademakers, section 2.1.1: the geophone is S s^2/(s^2 + 2 zn wn s + wn^2), the compensation has its zeros at wn, zn.
    """

    name = "geophone_corner"
    title = "a geophone's suspension frequency is not the one that its compensation filter assumes"
    looks_like = "one output is wrong around and below the suspension frequency, by the same factor from every input"

    def places(self, model: Table) -> tuple[str, ...]:
        known = suspensions(model.rig)
        return tuple(name for name in model.sensors.names if name in known) if model.sensors.unit == "V" else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        f, z = suspensions(model.rig)[place]
        return (
            EffectParameter("corner_Hz", "Hz", "suspension frequency", f, f / 5, 5 * f, f),
            EffectParameter("damping", "1", "damping ratio of the suspension", z, z / 5, 5 * z, z),
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        # Relative to the present corner, which the tolerance fit may have moved: both then change the same parameter.
        k, (f, z) = ops.sensor(place), suspensions(ops.base.rig)[place]
        own = ops.base.sensors.suspensions
        f_own, z_own = (own[k] if own else None) or (f, z)
        changed = second_order(ops.s, f_own * values["corner_Hz"] / f, z_own * values["damping"] / z)
        ops.sense[:, k] *= second_order(ops.s, f_own, z_own) / changed


@register
class SensorGain(OfSensor):
    """One sensitivity multiplied by a factor."""

    name = "sensor_gain"
    title = "a sensor's sensitivity is not the one of the rig file"
    looks_like = "one output is wrong by the same real factor at every frequency and from every input"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("gain", "1", "sensitivity over that of the rig file", 1.0, 0.1, 10.0, 1.0),)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.sensor_gain[ops.sensor(place)] *= values["gain"]


@register
class SensorMisalignment(OfSensor):
    """Direction (e + a e1 + b e2)/norm instead of e; a, b are tangents of the tilt towards the two other earth axes."""

    name = "sensor_misalignment"
    title = "a sensor's axis is tilted, so that it sees another axis too"
    looks_like = "one output contains a fraction of the motion along another axis at its place, at every frequency"

    def places(self, model: Table) -> tuple[str, ...]:
        return tuple(name for name in model.sensors.names if axis_of(model, name))

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        one = EffectParameter("towards_{}_deg", "deg", "tilt of the axis towards {}", 0.0, -60.0, 60.0, 5.0)
        return one.of_each("xyz".replace(axis_of(model, place), ""))

    def change(self, ops: Operators, place: str, values: Values) -> None:
        position, own = ops.base.rig.sensor_axes()[place]
        direction = own.copy()
        for name, angle in values.items():
            direction = direction + np.tan(np.radians(angle)) * np.eye(3)["xyz".index(name.split("_")[1])]
        turned = (direction / np.linalg.norm(direction) - own) @ point_map(position)
        k, rows, against = ops.sensor(place), ops.rows.copy(), ops.against.copy()
        rows[:, k] += turned
        against[:, k] += ops.base.sensors.relative[k] * turned
        ops.rows, ops.against = rows, against


@register
class TiltCoupling(Effect):
    """A horizontal inertial sensor reads a - g along its axis: a_x - g phi_y, a_y + g phi_x.

    The magnitude of gravity is free: it must result as 9.8 m/s^2, with a sign given by the sensor's polarity.
    """

    name = "tilt_coupling"
    title = "gravity: the horizontal sensors read g times the tilt as an acceleration"
    looks_like = "horizontal outputs rise towards low frequency where the payload tilts, as g over frequency squared"

    def places(self, model: Table) -> tuple[str, ...]:
        horizontal = [name for name in model.sensors.names if axis_of(model, name) in ("x", "y")]
        return ("horizontal geophones",) if horizontal and model.sensors.unit in ("V", "m/s^2") else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (
            EffectParameter(
                "gravity_m_per_s2", "m/s^2", "acceleration read for a tilt of 1 rad", 0.0, -30.0, 30.0, GRAVITY
            ),
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        n = len(ops.omega)
        rows = np.broadcast_to(ops.rows, (n, *ops.rows.shape[1:])).astype(complex)
        per_tilt = values["gravity_m_per_s2"] / ops.s**2
        axes = ops.base.rig.sensor_axes()
        for k, name in enumerate(ops.base.sensors.names):
            direction = (1 - ops.base.sensors.relative[k]) * axes[name][1]  # a position sensor reads no gravity
            rows[:, k, 3] += direction[1] * per_tilt
            rows[:, k, 4] -= direction[0] * per_tilt
        ops.rows = rows

    def implausible(self, values: Values, std: Values) -> str:
        miss = abs(abs(values["gravity_m_per_s2"]) - GRAVITY)
        if miss > 0.1 * GRAVITY + 3 * std["gravity_m_per_s2"]:
            return f"gravity would have to be {values['gravity_m_per_s2']:.3g} m/s^2"
        return ""
