"""Linear faults of single sensors and motors that have no name in the library."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Table, Values
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.effects.unnamed.base import Late, UnnamedFault, pairs
from avis_ctrl.gap.operators import Operators


def mix(ops: Operators, into: str, shares: Values) -> None:
    """Add fractions of other sensors' signals to one sensor."""
    j, gain = ops.sensor(into), ops.base.sensors.sensitivity * ops.sensor_gain
    rows = np.array(ops.rows)
    for name, share in shares.items():
        i = ops.sensor(name)
        rows[:, j] = rows[:, j] + share * gain[i] / gain[j] * ops.rows[:, i]
    ops.rows = rows


class SensorCrosstalk(UnnamedFault):
    """One output contains a fraction of another output's signal."""

    name = "sensor_crosstalk"
    title = "a fraction of one sensor's signal in another's"
    words = "a fraction of {source}'s signal in {into}"

    def places(self, model: Table) -> tuple[str, ...]:
        return pairs(model.sensors.names)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("share", "1", "fraction of the other's signal", 0.0, -2.0, 2.0, 0.01),)

    def change(self, ops: Operators, place: str, values: Values) -> None:
        into, source = place.split("/")
        mix(ops, into, {source: values["share"]})


class SensorCrosstalkOfAll(UnnamedFault):
    """One output contains fractions of all others: a common ground, or a sensor elsewhere on the payload."""

    name = "sensor_crosstalk_of_all"
    title = "fractions of all sensors' signals in one"
    words = "fractions of the other sensors' signals in {place}"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names if len(model.sensors.names) > 2 else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return tuple(
            EffectParameter(f"share_of_{name}", "1", f"share of {name}'s signal", 0.0, -2.0, 2.0, 0.01)
            for name in model.sensors.names
            if name != place
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        mix(ops, place, {name.removeprefix("share_of_"): share for name, share in values.items()})


class SensorLate(Late):
    """One output is later than the others: a low-pass filter or a delay of its own."""

    name = "sensor_late"
    title = "one sensor is later than the others (a low pass or a delay of its own)"
    words = "a low pass or a delay of {place} alone"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.sense[:, ops.sensor(place)] *= self.factor(ops.s, values)


class MotorLate(Late):
    """One motor is later than the others: a lag or a delay of its own amplifier."""

    name = "motor_late"
    title = "one motor is later than the others (a lag or a delay of its own)"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.actuators

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.drive = ops.drive * np.where(np.array(ops.base.actuators) == place, self.factor(ops.s, values)[:, None], 1)


class SensorResonance(UnnamedFault):
    """One output shows a resonance of its sensor's holder: times 1 + share s^2/(s^2 + 2 zeta w s + w^2)."""

    name = "sensor_resonance"
    title = "a resonance of one sensor (a spurious mode, its holder)"
    words = "a resonance of {place} alone at {frequency_Hz:.3g} Hz"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (
            EffectParameter("share", "1", "of the resonance in the output", 0.0, -5.0, 5.0, 0.01),
            EffectParameter.shape(
                "frequency_Hz", "Hz", "of the resonance", 0.5, 400.0, 1.0, np.geomspace(8.0, 90.0, 10)
            ),
            EffectParameter.shape("damping", "1", "its damping ratio", 1e-3, 1.0, 0.02, (0.05,), optional=True),
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        shape = ops.s**2 * receptance(ops.s, values["frequency_Hz"], values["damping"])
        ops.sense[:, ops.sensor(place)] *= 1 + values["share"] * shape
