"""Common interface of all rigs: named parameters, equations of motion, drives and sensors."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.equipment import Accelerometers, Acquisition, Ambient, Electronics, Geophones
from avis_ctrl.rigs.instruments import FloorSensor, Instrument, Sensor, Tolerances
from avis_ctrl.rigs.mounted_body import MountedBody
from avis_ctrl.rigs.rigid_body import EquationsOfMotion, point_map, tilt_row


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of a rig."""

    value: float
    unit: str
    description: str


class Place(NamedTuple):
    """A point of a drawing: position (3,) [m] relative to the geometric centre, and what is there."""

    position: np.ndarray
    kind: str


class Rig(ABC):
    """A table on its isolators.

    The coordinates q are those of the payload's geometric centre; `edge_m` is the lever arm that converts phi_x into
    a displacement of the edge along z.

    gain_per_sensor : whether the rig file has a gain for each sensor, which `with_sensor_gains` changes.
    """

    gain_per_sensor: ClassVar[bool] = False

    name: str
    geophones: Geophones | None = None
    accelerometers: Accelerometers | None = None
    acquisition: Acquisition | None = None
    ambient: Ambient | None
    tolerances: Tolerances | None
    floor_sensors: tuple[FloorSensor, ...] = ()
    electronics: Electronics = Electronics()

    @property
    @abstractmethod
    def edge_m(self) -> float:
        """Distance [m] from the phi_x axis to the edge whose displacement represents phi_x."""

    @property
    @abstractmethod
    def drive_limit_V(self) -> float:
        """Voltage limit of the actuators; the largest limit if they differ."""

    def drive_limits_V(self) -> np.ndarray:
        """(n_u,) voltage limit of each actuator."""
        return np.full(len(self.equations_of_motion().actuators), self.drive_limit_V)

    def limits_of(self, names: Sequence[str]) -> np.ndarray:
        """(n,) voltage limits [V] of the named actuators."""
        known = dict(zip(self.equations_of_motion().actuators, self.drive_limits_V().tolist(), strict=True))
        return np.array([known[name] for name in names])

    @abstractmethod
    def with_drives_limited(self, limit_V: float) -> Self:
        """The rig with all drives limited to at most this voltage; lower limits are kept."""

    def with_loop_delay(self, delay_s: float) -> Self:
        """The rig with another delay from sample to drive voltage."""
        clocked = {"acquisition" if self.acquisition else "accelerometers": replace(self._clock, loop_delay_s=delay_s)}
        return replace(self, **clocked)  # type: ignore[type-var]

    def with_electronics(self, electronics: Electronics) -> Self:
        """The rig with other electronics of its channels: offset, 1/f noise, anti-alias filter."""
        return replace(self, electronics=electronics)  # type: ignore[type-var]

    @property
    def _clock(self) -> Acquisition | Accelerometers:
        found = self.acquisition or self.accelerometers
        assert found is not None
        return found

    @property
    def sample_rate_Hz(self) -> float:
        """Sample rate of the controller."""
        return self._clock.sample_rate_Hz

    @property
    def loop_delay_s(self) -> float:
        """Delay from the sample to the actuator voltage."""
        return self._clock.loop_delay_s

    @abstractmethod
    def parameters(self) -> dict[str, Parameter]:
        """Every physical parameter by its flat name."""

    def force_constant(self, actuator: str) -> str:
        """Flat name of the parameter that is an actuator's force constant."""
        return f"actuator.{actuator}"

    @abstractmethod
    def _with_values(self, values: dict[str, float]) -> Self:
        """A new rig with these values; the names are known and the values finite."""

    @abstractmethod
    def mounted_body(self) -> MountedBody:
        """The rig as a body on mounts, described by positions."""

    @abstractmethod
    def equations_of_motion(self) -> EquationsOfMotion:
        """Linear model about rest, with floor motion."""

    @abstractmethod
    def points(self) -> dict[str, Place]:
        """Named points for a drawing."""

    @property
    @abstractmethod
    def all_instruments(self) -> tuple[Instrument, ...]:
        """Every sensor on the payload, as its rig file describes it."""

    def sensors(self) -> tuple[Sensor, ...]:
        """Every sensor on the payload, with its place and its dynamics."""
        return self._sensors

    @cached_property
    def _sensors(self) -> tuple[Sensor, ...]:
        rate, converter = self.sample_rate_Hz, self.converter
        return tuple(
            one.sensor(rate, self.ambient).with_electronics(self.electronics, one.preamplifier_gain, converter, rate)
            for one in self.all_instruments
        )

    @property
    def converter(self) -> Converter | None:
        """Converter of all sensor channels; None for unlimited resolution."""
        a = self.acquisition
        return Converter(a.adc_bits, a.adc_range_V, a.sample_rate_Hz) if a else None

    def sensor_axes(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Position (3,) [m] and unit direction (3,) of each sensor."""
        return {one.name: (np.array(one.position), np.array(one.direction)) for one in self.sensors()}

    def with_sensor_gains(self, gains: Mapping[str, float]) -> Self:
        """The rig with other gains of some sensors, in volts per unit of motion, preamplifiers included.

        Raises InputError if this kind of rig has no gain per sensor.
        """
        raise InputError(
            "a rig file of this kind has one sensitivity for all; leave these out",
            field="parameters",
            value=[f"sensor.{name}" for name in gains],
        )

    def slopes(self, name: str) -> list[tuple[str, str, np.ndarray]] | None:
        """Nonzero derivatives of the matrices with respect to a parameter: (matrix, "", (6, 6)) for "M", "C", "K",
        "C_floor" and "K_floor"; ("T" or "R", channel, (6,)) for a drive's column of T or a sensor's row of R. None if
        the rig does not provide derivatives."""
        return None

    def sensor_rows(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Sensor names and the (n, 6) matrix from q to the displacement along each sensor's axis."""
        axes = self.sensor_axes()
        return tuple(axes), np.array([direction @ point_map(place) for place, direction in axes.values()])

    def tilt_rows(self) -> np.ndarray:
        """(n, 6) from q to the apparent acceleration due to gravity of each sensor; zero for position sensors."""
        return np.array([one.inertial * tilt_row(one.direction) for one in self.sensors()])

    def with_parameters(self, changes: Mapping[str, float]) -> Self:
        """The rig with some parameters changed.

        Raises
        ------
        InputError : an unknown name, a value that is not finite, a mass matrix that is
            not positive definite.
        """
        known = self.parameters()
        for name, value in changes.items():
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else f"; there are {sorted(known)}"
                raise InputError(f"the rig {self.name} has no such parameter{hint}", field=name, value=value)
            if not np.isfinite(value):
                raise InputError("expected a finite number", field=name, value=value)
        return self._with_values({name: float(value) for name, value in changes.items()})
