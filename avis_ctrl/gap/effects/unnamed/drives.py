"""Faults of the drives that the library has no name for."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter, Table
from avis_ctrl.gap.effects.mounts import largest_rms
from avis_ctrl.gap.effects.unnamed.base import FirstOrder, Late, at, by_volts, late, motion, pairs, timing
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.score import Part

ALL = "all motors"


class MotorLate(Late):
    """One motor is later than the others: a lag or a delay of its own amplifier."""

    name = "motor_late"
    title = "one motor is later than the others (a lag or a delay of its own)"

    def places(self, model: Table) -> tuple[str, ...]:
        return model.actuators

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return timing("motor")

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        drive = np.array(np.broadcast_to(ops.drive, (len(ops.omega), ops.drive.shape[1])))
        drive[:, ops.actuator(place)] *= late(ops.s, values)
        ops.drive = drive

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        k = part.model.actuators.index(place)
        dY = by_volts(part)[:, :, k] * (-part.s[:, 0] * part.block.U[:, k])
        return np.repeat(dY[None, :, :, None], 2, axis=0)

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"a lag or a delay of {place} alone"


class _Drive(FirstOrder):
    """Volts that act in addition, in proportion to a strength."""

    nonlinear = True

    @abstractmethod
    def strength_of(self, model: Table, place: str) -> EffectParameter: ...

    def added(self, record: RecordMotion) -> np.ndarray:
        """(samples, n_u) V on all motors for a strength of one."""
        raise NotImplementedError

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        return (self.strength_of(model, place),)

    def volts_spectrum(self, record: RecordMotion, place: str, values: Mapping[str, float], omega: np.ndarray
                       ) -> np.ndarray | None:
        (strength,) = values.values()
        plain = record.kept("volts", omega, lambda: record.volts)
        return plain + strength * self._unit(record, place, omega)

    def _unit(self, record: RecordMotion, place: str, omega: np.ndarray) -> np.ndarray:
        every = record.kept(self.name, omega, lambda: self.added(record))
        return at(every, record.actuators, place)

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        added = self._unit(motion(part), place, part.block.omega)
        return (by_volts(part) @ added[:, :, None])[None]


class DriveCrosstalk(_Drive):
    """One motor gets a share of another one's voltage."""

    name = "drive_crosstalk"
    title = "a share of one motor's voltage on another"

    def places(self, model: Table) -> tuple[str, ...]:
        return pairs(model.actuators)

    def strength_of(self, model: Table, place: str) -> EffectParameter:
        return EffectParameter("share", "1", "share of the other's voltage", 0.0, -2.0, 2.0, 0.01)

    def _unit(self, record: RecordMotion, place: str, omega: np.ndarray) -> np.ndarray:
        k, i = (record.actuators.index(name) for name in place.split("/"))
        out = np.zeros((len(omega), len(record.actuators)), complex)
        out[:, k] = record.kept("volts", omega, lambda: record.volts)[:, i]
        return out

    def first_order(self, part: Part, place: str, point: np.ndarray) -> np.ndarray:
        k, i = (part.model.actuators.index(name) for name in place.split("/"))
        return (by_volts(part)[:, :, k] * part.block.U[:, i])[None, :, :, None]

    def said(self, place: str, values: Mapping[str, float]) -> str:
        k, i = place.split("/")
        return f"a share of {i}'s voltage on {k}"


class _DriveLaw(_Drive):
    """Force of one motor, or of all, that is not in proportion to its voltage."""

    words = ""
    unit = ""
    power = 0

    def places(self, model: Table) -> tuple[str, ...]:
        return (ALL, *model.actuators)

    def law(self, u: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def added(self, record: RecordMotion) -> np.ndarray:
        return self.law(record.volts)

    def strength_of(self, model: Table, place: str) -> EffectParameter:
        size = 0.01 / largest_volts(model) ** self.power
        return EffectParameter("strength", self.unit, self.words, 0.0, -1e3 * size, 1e3 * size, size)

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"the force of {place} not in proportion to voltage, with a term in {self.words}"


def largest_volts(model: Table) -> float:
    """Largest r.m.s. of a voltage in any record; one where none is known."""
    return max((one.largest_volts for one in model.motion.values()), default=1.0) or 1.0


class DriveQuadratic(_DriveLaw):
    """u + a u^2."""

    name, title, words, unit, power = ("drive_quadratic", "unlike force of push and pull", "u^2", "1/V", 1)

    def law(self, u: np.ndarray) -> np.ndarray:
        return u ** 2


class DriveAbsolute(_DriveLaw):
    """u + a u|u|."""

    name, title, words, unit, power = ("drive_absolute", "a force constant that depends on the voltage", "u|u|", "1/V",
                                       1)

    def law(self, u: np.ndarray) -> np.ndarray:
        return u * np.abs(u)


class DriveCubic(_DriveLaw):
    """u + a u^3."""

    name, title, words, unit, power = ("drive_cubic", "a force constant that depends on the voltage", "u^3", "1/V^2", 2)

    def law(self, u: np.ndarray) -> np.ndarray:
        return u ** 3


class DeadZone(_DriveLaw):
    """No force within +-w, sign(u) (|u| - w) beyond: u less u clipped at w."""

    name = "dead_zone"
    title = "a dead zone of the drives"

    def strength_of(self, model: Table, place: str) -> EffectParameter:
        size = 0.01 * largest_volts(model)
        return EffectParameter("half_width_V", "V", "half width of the dead zone", 0.0, 0.0, 300 * size, size)

    def law(self, u: np.ndarray) -> np.ndarray:
        return -np.sign(u)

    def volts_spectrum(self, record: RecordMotion, place: str, values: Mapping[str, float], omega: np.ndarray
                       ) -> np.ndarray | None:
        w = values["half_width_V"]
        k = slice(None) if place == ALL else slice(record.actuators.index(place), record.actuators.index(place) + 1)
        plain = np.array(record.kept("volts", omega, lambda: record.volts))
        plain[:, k] -= record.spectrum(np.clip(record.volts[:, k], -w, w), omega)
        return plain

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"a dead zone of {place}"


class _OfDeflection(_Drive):
    power = 1

    def places(self, model: Table) -> tuple[str, ...]:
        known = [one for one in model.motion.values() if len(one.driven_rows) == one.volts.shape[1]]
        return (ALL,) if known else ()

    def strength_of(self, model: Table, place: str) -> EffectParameter:
        size = 0.01 / largest_rms(model) ** self.power
        return EffectParameter("strength", "1/m" if self.power == 1 else "1/m^2", "of the force constant by deflection",
                               0.0, -1e3 * size, 1e3 * size, size)

    def added(self, record: RecordMotion) -> np.ndarray:
        return record.volts * record.deflection[:, record.driven_rows] ** self.power

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return f"a force constant of the motors that depends on {'the square of ' * (self.power - 1)}their deflection"


class ForceByDeflection(_OfDeflection):
    """u (1 + a d)."""

    name, title = "force_by_deflection", "a force constant that depends on deflection"


class ForceBySquare(_OfDeflection):
    """u (1 + b d^2)."""

    name, title, power = "force_by_square", "a force constant that falls off with deflection", 2


class ForceDrift(_Drive):
    """All force constants times 1 + change (t - middle)/(length of the campaign)."""

    name = "force_drift"
    title = "force constants that drift over the campaign"

    def places(self, model: Table) -> tuple[str, ...]:
        return (ALL,)

    def strength_of(self, model: Table, place: str) -> EffectParameter:
        return EffectParameter("relative_change", "1", "of every force constant over the campaign", 0.0, -0.9, 0.9,
                               0.01)

    def added(self, record: RecordMotion) -> np.ndarray:
        begin, end = record.campaign_s
        return record.volts * ((record.time_s - (begin + end) / 2) / (end - begin))[:, None]

    def said(self, place: str, values: Mapping[str, float]) -> str:
        return "force constants that drift over the campaign"
