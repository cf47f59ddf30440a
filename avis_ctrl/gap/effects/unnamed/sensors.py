"""Faults of sensors and of their clock that the library has no name for."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Table
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.effects.unnamed.base import FirstOrder, Late, at, late, motion, only, pairs, timing
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.score import Part


def mix(ops: Operators, into: str, shares: Mapping[str, float]) -> None:
    """Shares of other sensors' signals in one."""
    j, gain = ops.sensor(into), ops.base.sensors.sensitivity * ops.sensor_gain
    rows = np.array(ops.rows)
    for name, share in shares.items():
        i = ops.sensor(name)
        rows[:, j] = rows[:, j] + share * gain[i] / gain[j] * ops.rows[:, i]
    ops.rows = rows


class SensorCrosstalk(FirstOrder):
    """One output holds a share of another output's signal."""

    name = "sensor_crosstalk"
    title = "a share of one sensor's signal in another's"

    def places(self, model: Table) -> tuple[str, ...]:
        return pairs(model.sensors.names)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("share", "1", "share of the other's signal", 0.0, -2.0, 2.0, 0.01),)

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        into, source = place.split("/")
        mix(ops, into, {source: values["share"]})

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        names = part.model.sensors.names
        j, i = (names.index(name) for name in place.split("/"))
        return only(part.response.Y, j, part.response.Y[:, i])

    def said(self, place: str, values: Mapping[str, float]) -> str:
        j, i = place.split("/")
        return f"a share of {i}'s signal in {j}"


class SensorCrosstalkOfAll(FirstOrder):
    """One output holds shares of all others: a common ground, or a sensor somewhere else on the payload."""

    name = "sensor_crosstalk_of_all"
    title = "shares of all sensors' signals in one"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names if len(model.sensors.names) > 2 else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"share_of_{name}", "1", f"share of {name}'s signal", 0.0, -2.0, 2.0, 0.01)
                     for name in model.sensors.names if name != place)

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        mix(ops, place, {name.removeprefix("share_of_"): share for name, share in values.items()})

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        names, Y = part.model.sensors.names, part.response.Y
        j = names.index(place)
        return np.concatenate([only(Y, j, Y[:, i]) for i in range(len(names)) if i != j])

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"shares of the other sensors' signals in {place}"


class SensorLate(Late):
    """One output is later than the others: a low pass, a delay of its own."""

    name = "sensor_late"
    title = "one sensor is later than the others (a low pass or a delay of its own)"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return timing("sensor")

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        ops.sense[:, ops.sensor(place)] *= late(ops.s, values)

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        j = part.model.sensors.names.index(place)
        return np.repeat(only(part.response.Y, j, -part.s[:, 0] * part.response.Y[:, j]), 2, axis=0)

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"a low pass or a delay of {place} alone"


class SensorResonance(FirstOrder):
    """One output holds a resonance of its sensor's holder: times 1 + share s^2/(s^2 + 2 zeta w s + w^2)."""

    name = "sensor_resonance"
    title = "a resonance of one sensor (a spurious mode, its holder)"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (EffectParameter("share", "1", "of the resonance in the output", 0.0, -5.0, 5.0, 0.01),
                EffectParameter("frequency_Hz", "Hz", "of the resonance", 0.0, 0.5, 400.0, 1.0, False,
                                tuple(np.geomspace(8.0, 90.0, 10))),
                EffectParameter("damping", "1", "its damping ratio", 0.0, 1e-3, 1.0, 0.02, False, (0.05,), True))

    @staticmethod
    def _shape(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
        return s ** 2 * receptance(s, frequency_Hz, damping)

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        shape = self._shape(ops.s, values["frequency_Hz"], values["damping"])
        ops.sense[:, ops.sensor(place)] *= 1 + values["share"] * shape

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        j = part.model.sensors.names.index(place)
        shape = self._shape(part.s[:, 0], float(point[1]), float(point[2]))
        return only(part.response.Y, j, shape * part.response.Y[:, j])

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"a resonance of {place} alone at {values['frequency_Hz']:.3g} Hz"


class _Output(FirstOrder):
    """y + strength times a signal made of the record's own y."""

    nonlinear = True
    parameter: EffectParameter

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (self.parameter,)

    @abstractmethod
    def signals(self, record: RecordMotion) -> np.ndarray:
        """(samples, n_y) in all outputs for a strength of one."""

    def _unit(self, record: RecordMotion, place: str, omega: np.ndarray) -> np.ndarray:
        every = record.kept(self.name, omega, lambda: self.signals(record))
        return at(every, record.sensors, place)

    def output_spectrum(self, record: RecordMotion, place: str, values: Mapping[str, float], omega: np.ndarray
                        ) -> np.ndarray | None:
        return values[self.parameter.name] * self._unit(record, place, omega)

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        return self._unit(motion(part), place, part.block.omega)[None, :, :, None]


class _OfOneOutput(_Output):
    """One sensor whose reading holds a power of itself, `words`."""

    law: Callable[[np.ndarray], np.ndarray]
    words: str

    def places(self, model: Table) -> tuple[str, ...]:
        known = [one for one in model.motion.values() if one.y.size]
        return model.sensors.names if known else ()

    def signals(self, record: RecordMotion) -> np.ndarray:
        return type(self).law(record.y - record.y.mean(0))

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"{place} not linear, with a term in the {self.words} of its reading"


class SensorQuadratic(_OfOneOutput):
    """y + a y^2."""

    name = "sensor_quadratic"
    title = "a sensor that is not linear (quadratic)"
    parameter = EffectParameter("per_unit", "1/[y]", "quadratic share", 0.0, -1e6, 1e6, 1e-2)
    law = staticmethod(lambda y: y ** 2)
    words = "square"


class SensorCubic(_OfOneOutput):
    """y + b y^3."""

    name = "sensor_cubic"
    title = "a sensor that is not linear (cubic)"
    parameter = EffectParameter("per_unit_2", "1/[y]^2", "cubic share", 0.0, -1e9, 1e9, 1e-2)
    law = staticmethod(lambda y: y ** 3)
    words = "cube"


class ClockRate(_Output):
    """Outputs sampled by a clock of another rate than the inputs': y(t (1 + e)), e t dy/dt to first order."""

    name = "clock_rate"
    title = "outputs and inputs run on clocks of different rate"
    parameter = EffectParameter("relative", "1", "rate of one clock over the other's, less one", 0.0, -0.01, 0.01, 1e-6)

    def places(self, model: Table) -> tuple[str, ...]:
        return ("loop",) if any(one.y.size for one in model.motion.values()) else ()

    def signals(self, record: RecordMotion) -> np.ndarray:
        t = np.arange(len(record.y)) / record.sample_rate_Hz
        return t[:, None] * np.gradient(record.y, 1 / record.sample_rate_Hz, axis=0)

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return "outputs sampled by a clock of another rate than the inputs'"
