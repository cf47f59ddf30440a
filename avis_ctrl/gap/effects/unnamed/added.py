"""Faults that add a signal computed from the record to volts or outputs, in proportion to one parameter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from avis_ctrl.gap.effects.base import Added, EffectParameter, Table, Values
from avis_ctrl.gap.effects.mounts import largest_rms
from avis_ctrl.gap.effects.unnamed.base import UnnamedFault, pairs
from avis_ctrl.gap.record_motion import RecordMotion

ALL = "all motors"


@dataclass(frozen=True)
class AddedSignal(UnnamedFault):
    """A row of `ADDED`.

    where : places on a table. parameter : the strength. signal : (samples, channels) on all channels for unit strength;
    None for subclasses. to : the signals to which it is added.
    """

    name: str
    title: str
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


def _force_law(
    name: str, title: str, term: str, unit: str, power: int, law: Callable[[np.ndarray], np.ndarray]
) -> AddedSignal:
    """Force of one motor, or of all, that is not proportional to the voltage."""
    return AddedSignal(
        name,
        title,
        f"the force of {{place}} not in proportion to voltage, with a term in {term}",
        _motors,
        lambda model: _strength(unit, term, 0.01 / largest_volts(model) ** power),
        lambda record: law(record.volts),
    )


def _by_deflection(name: str, title: str, words: str, unit: str, power: int) -> AddedSignal:
    """Force constants that depend on a power of the motors' deflection."""

    def where(model: Table) -> tuple[str, ...]:
        known = [one for one in model.motion.values() if len(one.driven_rows) == one.volts.shape[1]]
        return (ALL,) if known else ()

    return AddedSignal(
        name,
        title,
        words,
        where,
        lambda model: _strength(unit, "of the force constant by deflection", 0.01 / largest_rms(model) ** power),
        lambda record: record.volts * record.deflection[:, record.driven_rows] ** power,
    )


def _reading_law(name: str, title: str, words: str, parameter: EffectParameter, power: int) -> AddedSignal:
    """One sensor whose reading contains a power of itself."""
    return AddedSignal(
        name,
        title,
        words,
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
            "a sensor that is not linear (quadratic)",
            "{place} not linear, with a term in the square of its reading",
            EffectParameter("per_unit", "1/[y]", "quadratic share", 0.0, -1e6, 1e6, 1e-2),
            2,
        ),
        _reading_law(
            "sensor_cubic",
            "a sensor that is not linear (cubic)",
            "{place} not linear, with a term in the cube of its reading",
            EffectParameter("per_unit_2", "1/[y]^2", "cubic share", 0.0, -1e9, 1e9, 1e-2),
            3,
        ),
        AddedSignal(
            "clock_rate",
            "outputs and inputs run on clocks of different rate",
            "outputs sampled by a clock of another rate than the inputs'",
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
            "a fraction of one motor's voltage on another",
            "a fraction of {source}'s voltage on {into}",
            lambda model: pairs(model.actuators),
            lambda model: EffectParameter("share", "1", "fraction of the other's voltage", 0.0, -2.0, 2.0, 0.01),
        ),
        _force_law("drive_quadratic", "unlike force of push and pull", "u^2", "1/V", 1, lambda u: u**2),
        _force_law(
            "drive_absolute", "a force constant that depends on the voltage", "u|u|", "1/V", 1, lambda u: u * np.abs(u)
        ),
        _force_law("drive_cubic", "a force constant that depends on the voltage", "u^3", "1/V^2", 2, lambda u: u**3),
        DeadZone("dead_zone", "a dead zone of the drives", "a dead zone of {place}", _motors, _dead_zone),
        _by_deflection(
            "force_by_deflection",
            "a force constant that depends on deflection",
            "a force constant of the motors that depends on their deflection",
            "1/m",
            1,
        ),
        _by_deflection(
            "force_by_square",
            "a force constant that falls off with deflection",
            "a force constant of the motors that depends on the square of their deflection",
            "1/m^2",
            2,
        ),
        AddedSignal(
            "force_drift",
            "force constants that drift over the campaign",
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
