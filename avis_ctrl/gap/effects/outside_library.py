"""Physics and faults that have no name in the library, fitted in competition with its candidates.

The library is finite; the faults that a table can have are not. An unnamed fault resembles some named effect: crosstalk
of two sensors resembles a tilted sensor, a dead zone a lower force constant. With candidates from the library alone,
the closest one would win and be named in place of the fault. This module contains the faults that an engineer would
consider beyond the library, in few parameters. If one of them explains the data better, nothing is named, and the
verdict describes how the table behaves. They are never named and never part of an exported model.

They act on the table as all effects do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from avis_ctrl.gap.effects.base import Added, Effect, EffectParameter, Table, Values
from avis_ctrl.gap.effects.mounts import CubicStiffness, OfMounts, largest_rms, stiffness
from avis_ctrl.gap.effects.sensors import OfSensor, receptance
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.starting_values import Seed
from avis_ctrl.gap.table_model import active


class UnnamedFault(Effect):
    """A fault that is never named. words : for a sentence, with {place}, {into} and {source} of a pair, and values."""

    outside = True
    title = "a fault that has no name in the library"
    looks_like = "not in the library"
    words: str

    def described(self, place: str, values: Values) -> str:
        into, _, source = place.partition("/")
        return self.words.format(place=place, into=into, source=source, **values)


class Late(UnnamedFault):
    """exp(-s T)/(1 + s tau) of one channel."""

    words = "a lag or a delay of {place} alone"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        what = "drive" if place in model.actuators else "sensor"
        return (
            EffectParameter("delay_s", "s", f"delay of this {what} beside the others", 0.0, 0.0, 0.1, 1e-3),
            EffectParameter("time_constant_s", "s", f"first-order lag of this {what} alone", 0.0, 0.0, 0.3, 1e-3),
        )

    def factor(self, s: np.ndarray, values: Values) -> np.ndarray:
        return np.exp(-s * values["delay_s"]) / (1 + s * values["time_constant_s"])

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Half of the total delay each, because delay and lag are equal to first order. It cannot be negative."""
        took = score.reduction(score.of_effect(active(self, score.model, place))[:1])
        half = float(took.coefficients[0]) / 2
        return [Seed((half, half), took.chi2, took.rank)] if half > 0 else []


def pairs(names: tuple[str, ...]) -> tuple[str, ...]:
    """All ordered pairs of channels, as "into/source"."""
    return tuple(f"{a}/{b}" for a in names for b in names if a != b)


def mix(ops: Operators, into: str, shares: Values) -> None:
    """Add fractions of other sensors' signals to one sensor."""
    j, gain = ops.sensor(into), ops.base.sensors.sensitivity * ops.sensor_gain
    rows, against = np.array(ops.rows), np.array(ops.against)
    for name, share in shares.items():
        i = ops.sensor(name)
        rows[:, j] = rows[:, j] + share * gain[i] / gain[j] * ops.rows[:, i]
        against[:, j] = against[:, j] + share * gain[i] / gain[j] * ops.against[:, i]
    ops.rows, ops.against = rows, against


class SensorCrosstalk(UnnamedFault):
    """One output contains a fraction of another output's signal."""

    name = "sensor_crosstalk"
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
    words = "fractions of the other sensors' signals in {place}"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.sensors.names if len(model.sensors.names) > 2 else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return tuple(
            EffectParameter(f"share_of_{name}", "1", f"fraction of {name}'s signal", 0.0, -2.0, 2.0, 0.01)
            for name in model.sensors.names
            if name != place
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        mix(ops, place, {name.removeprefix("share_of_"): share for name, share in values.items()})


class SensorLate(OfSensor, Late):
    """One output is later than the others: a low-pass filter or a delay of its own."""

    name = "sensor_late"
    words = "a low-pass filter or a delay in {place} only"

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.sense[:, ops.sensor(place)] *= self.factor(ops.s, values)


class MotorLate(Late):
    """One drive is later than the others: a lag or a delay of its own amplifier."""

    name = "motor_late"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.actuators

    def change(self, ops: Operators, place: str, values: Values) -> None:
        ops.drive = ops.drive * np.where(np.array(ops.base.actuators) == place, self.factor(ops.s, values)[:, None], 1)


class SensorResonance(OfSensor, UnnamedFault):
    """One output shows a resonance of its sensor's holder: times 1 + share s^2/(s^2 + 2 zeta w s + w^2)."""

    name = "sensor_resonance"
    words = "a resonance of {place} alone at {frequency_Hz:.3g} Hz"

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (
            EffectParameter("share", "1", "of the resonance in the output", 0.0, -5.0, 5.0, 0.01),
            EffectParameter.shape(
                "frequency_Hz", "Hz", "of the resonance", 0.5, 400.0, 1.0, np.geomspace(8.0, 90.0, 10)
            ),
            EffectParameter.shape("damping", "1", "its damping ratio", 1e-3, 1.0, 0.02, (0.05,), optional=True),
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        k, mode = ops.sensor(place), receptance(ops.s, values["frequency_Hz"], values["damping"])
        ops.ringing.append((k, np.stack([mode, ops.s * mode], axis=1)))
        ops.sense[:, k] *= 1 + values["share"] * ops.s**2 * mode


class QuadraticStiffness(UnnamedFault, CubicStiffness):
    """Force -k2 d^2 at every vertical mount: an air spring is stiffer in compression than in extension."""

    name = "quadratic_stiffness"
    words = "vertical mounts with a term in the square of their deflection"
    at = ("isolators z",)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (stiffness(model, 2, "quadratic"),)

    def implausible(self, values: Values, std: Values) -> str:
        return ""


class QuadraticDrag(UnnamedFault, OfMounts):
    """Air drag: force -c |v| v on the payload at the table's centre, v its velocity relative to the chassis."""

    name = "quadratic_drag"
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
    words = "a rotor on the payload (gyroscopic moments)"
    at = ("payload",)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return EffectParameter("h{}_Nms", "N m s", "angular momentum about {}", 0.0, -1e6, 1e6, 1.0).of_each("xyz")

    def change(self, ops: Operators, place: str, values: Values) -> None:
        x, y, z = (values[f"h{axis}_Nms"] for axis in "xyz")
        W = np.zeros((6, 6))
        W[3:, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        Z = ops.s[:, None, None] * W
        ops.extra = Z if ops.extra is None else ops.extra + Z


ALL = "all drives"


@dataclass(frozen=True)
class AddedSignal(UnnamedFault):
    """A row of `ADDED`.

    where : places on a table. parameter : the strength. signal : (samples, channels) on all channels for unit strength;
    None for subclasses. to : the signals to which it is added.
    """

    name: str
    words: str
    where: Callable[[Table], tuple[str, ...]]
    parameter: Callable[[Table], EffectParameter]
    signal: Callable[[RecordMotion], np.ndarray] | None = None
    to: Literal["volts", "output"] = "volts"
    time_varying: bool = False
    nonlinear = True

    def __reduce__(self) -> tuple[Any, ...]:
        # Results pass between processes by name, because the functions of a row cannot be pickled.
        return _row, (self.name,)

    def places(self, model: Table) -> tuple[str, ...]:
        return self.where(model)

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (self.parameter(model),)

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        """In one channel, or in all of them if the place is not a channel."""
        assert self.signal is not None
        signal, names = self.signal, record.actuators if self.to == "volts" else record.sensors
        own = np.array(names) == place if place in names else 1.0
        (strength,) = values.values()
        return Added(**{self.to: strength * own * record.kept(self.name, omega, lambda: signal(record))})


class DriveCrosstalk(AddedSignal):
    """A fraction of one motor's voltage acts on another motor."""

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        k, i = (record.actuators.index(name) for name in place.split("/"))
        volts = np.zeros((len(omega), len(record.actuators)), complex)
        volts[:, k] = values["share"] * record.kept("volts", omega, lambda: record.volts)[:, i]
        return Added(volts=volts)


class DeadZone(AddedSignal):
    """No force within +-w, sign(u) (|u| - w) beyond: u minus u clipped at w."""

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        w, k = values["half_width_V"], [place in (ALL, name) for name in record.actuators]
        beside = np.zeros((len(omega), len(k)), complex)
        beside[:, k] = -record.spectrum(np.clip(record.volts[:, k], -w, w), omega)
        return Added(volts=beside)


def largest_volts(model: Table) -> float:
    """Largest r.m.s. voltage in any record; 1 if none is known."""
    return max((one.largest_volts for one in model.motion.values()), default=1.0) or 1.0


def _motors(model: Table) -> tuple[str, ...]:
    return (ALL, *model.actuators)


def _read(model: Table) -> bool:
    return any(one.y.size for one in model.motion.values())


def _strength(unit: str, words: str, size: float) -> EffectParameter:
    return EffectParameter("strength", unit, words, 0.0, -1e3 * size, 1e3 * size, size)


def _force_law(name: str, term: str, unit: str, power: int, law: Callable[[np.ndarray], np.ndarray]) -> AddedSignal:
    """Force of one motor, or of all, that is not proportional to the voltage."""
    return AddedSignal(
        name,
        f"a nonlinear force of {{place}}, with a term in {term} of the voltage",
        _motors,
        lambda model: _strength(unit, term, 0.01 / largest_volts(model) ** power),
        lambda record: law(record.volts),
    )


def _by_deflection(name: str, term: str, unit: str, power: int) -> AddedSignal:
    """Force constants that depend on a power of the drives' deflection."""

    def where(model: Table) -> tuple[str, ...]:
        known = [one for one in model.motion.values() if len(one.driven_rows) == one.volts.shape[1]]
        return (ALL,) if known else ()

    return AddedSignal(
        name,
        f"a force constant of the drives that depends on {term}",
        where,
        lambda model: _strength(unit, "of the force constant by deflection", 0.01 / largest_rms(model) ** power),
        lambda record: record.volts * record.deflection[:, record.driven_rows] ** power,
    )


def _reading_law(name: str, term: str, parameter: EffectParameter, power: int) -> AddedSignal:
    """One sensor whose reading contains a power of itself."""
    return AddedSignal(
        name,
        f"a nonlinear {{place}}, with a term in the {term} of its reading",
        lambda model: model.sensors.names if _read(model) else (),
        lambda model: parameter,
        lambda record: (record.y - record.y.mean(0)) ** power,
        "output",
    )


def _dead_zone(model: Table) -> EffectParameter:
    size = 0.01 * largest_volts(model)
    return EffectParameter("half_width_V", "V", "half width of the dead zone", 0.0, 0.0, 300 * size, size)


def _drift(record: RecordMotion) -> np.ndarray:
    """Volts times (t - middle)/(length of the campaign): a drift of all force constants."""
    begin, end = record.campaign_s
    return record.volts * ((record.time_s - (begin + end) / 2) / (end - begin))[:, None]


def _other_clock(record: RecordMotion) -> np.ndarray:
    """t dy/dt, the first-order change in y(t (1 + e))."""
    t = np.arange(len(record.y)) / record.sample_rate_Hz
    return t[:, None] * np.gradient(record.y, 1 / record.sample_rate_Hz, axis=0)


ADDED: dict[str, AddedSignal] = {
    one.name: one
    for one in (
        _reading_law(
            "sensor_quadratic",
            "square",
            EffectParameter("per_unit", "1/[y]", "quadratic share", 0.0, -1e6, 1e6, 1e-2),
            2,
        ),
        _reading_law(
            "sensor_cubic", "cube", EffectParameter("per_unit_2", "1/[y]^2", "cubic share", 0.0, -1e9, 1e9, 1e-2), 3
        ),
        AddedSignal(
            "clock_rate",
            "outputs sampled by a clock whose rate differs from that of the inputs",
            lambda model: ("loop",) if _read(model) else (),
            lambda model: EffectParameter(
                "relative", "1", "rate of one clock over the other's, less one", 0.0, -0.01, 0.01, 1e-6
            ),
            _other_clock,
            "output",
            True,
        ),
        DriveCrosstalk(
            "drive_crosstalk",
            "a fraction of {source}'s voltage on {into}",
            lambda model: pairs(model.actuators),
            lambda model: EffectParameter("share", "1", "fraction of the other's voltage", 0.0, -2.0, 2.0, 0.01),
        ),
        _force_law("drive_quadratic", "u^2", "1/V", 1, lambda u: u**2),
        _force_law("drive_absolute", "u|u|", "1/V", 1, lambda u: u * np.abs(u)),
        _force_law("drive_cubic", "u^3", "1/V^2", 2, lambda u: u**3),
        DeadZone("dead_zone", "a dead zone of {place}", _motors, _dead_zone),
        _by_deflection("force_by_deflection", "their deflection", "1/m", 1),
        _by_deflection("force_by_square", "the square of their deflection", "1/m^2", 2),
        AddedSignal(
            "force_drift",
            "force constants that drift over the campaign",
            lambda model: (ALL,),
            lambda model: EffectParameter(
                "relative_change", "1", "of every force constant over the campaign", 0.0, -0.9, 0.9, 0.01
            ),
            _drift,
            time_varying=True,
        ),
    )
}


def _row(name: str) -> AddedSignal:
    return ADDED[name]


def unnamed_faults() -> dict[str, UnnamedFault]:
    """All unnamed faults by name."""
    every = (
        SensorCrosstalk(),
        SensorCrosstalkOfAll(),
        SensorLate(),
        SensorResonance(),
        MotorLate(),
        *ADDED.values(),
        QuadraticStiffness(),
        QuadraticDrag(),
        Gyroscope(),
    )
    return {one.name: one for one in every}
