"""A payload on isolators that act along the earth axes, with drives and sensors in the isolators or anywhere else.

An example is the air-mount AVIS (Rademakers, TU/e 2005), with eight linear motors and six geophones in four isolators.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.equipment import Acquisition, Ambient, Electronics, Geophones
from avis_ctrl.rigs.file_errors import Values
from avis_ctrl.rigs.instruments import Drive, FloorSensor, GeophoneAt, Instrument, Tolerances, Triple, triple
from avis_ctrl.rigs.key_types import DampingVector, Point, PositiveVector
from avis_ctrl.rigs.mounted_body import Mount, MountedBody, PointActuator
from avis_ctrl.rigs.rig import Parameter, Place, Rig
from avis_ctrl.rigs.rigid_body import EquationsOfMotion, point_map

AXES = ("x", "y", "z")
# Maximum distance from a mount's attachment [m] and maximum angle to an earth axis [rad] of a drive or sensor in the
# mount: many tolerances of position and direction, but much less than the distance between mounts.
IN_MOUNT_m, IN_MOUNT_rad = 0.03, 0.3
# Derivative (3, 6) of `point_map` with respect to each coordinate of the point.
_ARM = tuple(point_map(unit) - point_map(np.zeros(3)) for unit in np.eye(3))
INERTIA = ("J1", "J2", "J3", "J12", "J13", "J23")
_ISOLATOR_PARAMETER = re.compile(r"isolator(\d+)\.(k|c|p)_([xyz])")
_UNITS = {"k": "N/m", "c": "N s/m", "p": "m"}
_WORDS = {"k": "stiffness", "c": "damping", "p": "position of the attachment"}


def _from_attachment(point: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
    return triple(np.subtract(point, info.data.get("position", point)))


@dataclass(frozen=True)
class Isolator(Values):
    """Air mount: spring and damper along each earth axis (eqs. 2.15-2.16).

    position [m] : attachment p_i on the payload, relative to its geometric centre.
    stiffness [N/m], damping [N s/m] : along x, y, z.
    chassis_offset [m] : c_i - p_i, attachment on the chassis relative to that on the payload; zero in the
        source (Table 3.1).
    """

    position: Annotated[Point, Field(alias="position_m")]
    stiffness: Annotated[PositiveVector, Field(alias="stiffness_N_per_m")]
    damping: Annotated[DampingVector, Field(alias="damping_Ns_per_m")]
    chassis_offset: Annotated[Point, Field(alias="chassis_point_m"), AfterValidator(_from_attachment)] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LinearMotor:
    """Actuator in isolator `isolator` (1-based) along `axis`, force constant in N/V (eqs. 2.17-2.18)."""

    name: str
    isolator: int
    axis: str
    constant_N_per_V: float


@dataclass(frozen=True)
class IsolatorTable(Rig):
    """A table on isolators.

    inertia : (J1, J2, J3, J12, J13, J23) [kg m^2] about the centre of mass; the last three are the
        entries of the inertia tensor itself, J12 = -integral of x y dm.
    centre_of_mass : [m] relative to the geometric centre.
    motors, geophones : in the isolators, at the isolators' positions. drives, instruments : at any positions.
        `all_drives` and `sensors` return both kinds, in this order.
    limit_V : voltage limit of all drives without an individual limit.
    """

    gain_per_sensor: ClassVar[bool] = True

    name: str
    mass: float
    inertia: tuple[float, ...]
    centre_of_mass: tuple[float, ...]
    isolators: tuple[Isolator, ...]
    motors: tuple[LinearMotor, ...]
    limit_V: float
    geophones: Geophones | None
    acquisition: Acquisition
    ambient: Ambient | None = None
    drives: tuple[Drive, ...] = ()
    instruments: tuple[Instrument, ...] = ()
    floor_sensors: tuple[FloorSensor, ...] = ()
    tolerances: Tolerances | None = None
    electronics: Electronics = field(default_factory=Electronics)

    def __post_init__(self) -> None:
        self.mounted_body()  # raises for a mass or an inertia that is not positive

    @property
    def edge_m(self) -> float:
        """Half width of the isolators' rectangle, p_y of Table 3.1."""
        return max(abs(isolator.position[1]) for isolator in self.isolators)

    @property
    def drive_limit_V(self) -> float:
        return float(max(self.drive_limits_V()))

    @cached_property
    def all_drives(self) -> tuple[Drive, ...]:
        """Motors of the isolators, then the drives at other positions."""
        motors = (
            Drive(motor.name, self._at(motor.isolator), _unit(motor.axis), motor.constant_N_per_V)
            for motor in self.motors
        )
        return (*motors, *self.drives)

    def drive_limits_V(self) -> np.ndarray:
        return np.array([drive.limit_V or self.limit_V for drive in self.all_drives])

    def with_drives_limited(self, limit_V: float) -> IsolatorTable:
        drives = tuple(replace(one, limit_V=min(one.limit_V, limit_V)) if one.limit_V else one for one in self.drives)
        return replace(self, limit_V=min(self.limit_V, limit_V), drives=drives)

    def inertia_matrix(self) -> np.ndarray:
        """(3, 3) about the centre of mass."""
        J1, J2, J3, J12, J13, J23 = self.inertia
        return np.array([[J1, J12, J13], [J12, J2, J23], [J13, J23, J3]])

    def parameters(self) -> dict[str, Parameter]:
        """mass, J1.., com_x.., isolator1.k_x.. (k, c, p; 1-based), actuator.NAME, place.NAME.x.., direction.NAME.x.."""
        return dict(self._parameters)

    @cached_property
    def _parameters(self) -> dict[str, Parameter]:
        found = {"mass": Parameter(self.mass, "kg", "mass of the payload")}
        for name, value in zip(INERTIA, self.inertia, strict=True):
            found[name] = Parameter(value, "kg m^2", "inertia about the centre of mass")
        for axis, value in zip(AXES, self.centre_of_mass, strict=True):
            found[f"com_{axis}"] = Parameter(value, "m", "centre of mass from the geometric centre")
        for number, isolator in enumerate(self.isolators, 1):
            for kind, values in (("k", isolator.stiffness), ("c", isolator.damping), ("p", isolator.position)):
                for axis, value in zip(AXES, values, strict=True):
                    found[f"isolator{number}.{kind}_{axis}"] = Parameter(
                        value, _UNITS[kind], f"{_WORDS[kind]} of isolator {number} along {axis}"
                    )
        for drive in self.all_drives:
            found[f"actuator.{drive.name}"] = Parameter(drive.constant_N_per_V, "N/V", "force constant")
        for one in (*self.drives, *self.instruments):
            for axis, place in zip(AXES, one.position, strict=True):
                found[f"place.{one.name}.{axis}"] = Parameter(place, "m", f"position of {one.name} along {axis}")
            for k in one.across:
                found[f"direction.{one.name}.{AXES[k]}"] = Parameter(
                    one.direction[k], "", f"component of the unit direction of {one.name} along {AXES[k]}"
                )
        return found

    def slopes(self, name: str) -> list[tuple[str, str, np.ndarray]] | None:
        kind, _, rest = name.partition(".")
        if kind == "actuator":
            return [("T", rest, point_map((one := self._by_name[rest]).position).T @ one.direction)]
        if kind in ("place", "direction"):
            return self._channel_slope(kind, *rest.rsplit(".", 1))
        if match := _ISOLATOR_PARAMETER.fullmatch(name):
            return self._isolator_slopes(int(match[1]), match[2], AXES.index(match[3]))
        G = point_map(self.centre_of_mass)
        if name in INERTIA:
            i, j = int(name[1]) + 2, int(name[-1]) + 2
            M = np.zeros((6, 6))
            M[i, j] = M[j, i] = 1.0
        elif name == "mass":
            M = G.T @ G
        else:
            half = self.mass * _ARM[AXES.index(name[-1])].T @ G
            M = half + half.T
        return [("M", "", M)]

    def _channel_slope(self, kind: str, channel: str, axis: str) -> list[tuple[str, str, np.ndarray]]:
        """Derivative with respect to a coordinate of a channel's position or a component of its direction."""
        one, k = self._by_name[channel], AXES.index(axis)
        if kind == "place":
            slope = _ARM[k].T @ one.direction
        else:
            turn = np.eye(3)[k] - np.eye(3)[one.along] * one.direction[k] / one.direction[one.along]
            slope = point_map(one.position).T @ turn
        drive = isinstance(one, Drive)
        return [("T" if drive else "R", channel, slope * one.constant_N_per_V if drive else slope)]

    def _isolator_slopes(self, number: int, kind: str, k: int) -> list[tuple[str, str, np.ndarray]]:
        """Derivatives with respect to stiffness, damping or position of an isolator with its motors and geophones."""
        one, arm = self.isolators[number - 1], _ARM[k]
        G, G_c = point_map(one.position), point_map(np.add(one.position, one.chassis_offset))
        if kind != "p":
            which = kind.upper()
            return [(which, "", np.outer(G[k], G[k])), (f"{which}_floor", "", np.outer(G[k], G_c[k]))]
        found = []
        for which, values in (("K", np.diag(one.stiffness)), ("C", np.diag(one.damping))):
            half = arm.T @ values @ G
            found += [(which, "", half + half.T), (f"{which}_floor", "", arm.T @ values @ G_c + G.T @ values @ arm)]
        found += [
            ("T", motor.name, arm[AXES.index(motor.axis)] * motor.constant_N_per_V)
            for motor in self.motors
            if motor.isolator == number
        ]
        g = self.geophones
        at = zip(g.names, g.isolator, g.axis, strict=True) if g else ()
        return found + [("R", sensor, arm[AXES.index(axis)]) for sensor, own, axis in at if own == number]

    @cached_property
    def _by_name(self) -> dict[str, Any]:
        return {one.name: one for one in (*self.all_drives, *self.instruments)}

    def mount_of(self, channel: str) -> tuple[str, float] | None:
        """Mount and earth axis ("isolator1.x") of a drive or sensor, and the sign of its direction along the axis; None
        if it is not in a mount."""
        found, inside = self._nearest_mounts[channel]
        return found if inside else None

    def nearest_mount(self, channel: str) -> tuple[str, float]:
        """As `mount_of`, but of the nearest mount at any distance: a fit may move a channel out of its mount."""
        return self._nearest_mounts[channel][0]

    @cached_property
    def _nearest_mounts(self) -> dict[str, tuple[tuple[str, float], bool]]:
        at = np.array([one.position for one in self.isolators])
        found: dict[str, tuple[tuple[str, float], bool]] = {}
        for one in (*self.all_drives, *self.all_instruments):
            away, k = np.linalg.norm(at - one.position, axis=1), int(np.argmax(np.abs(one.direction)))
            nearest, along = int(np.argmin(away)), one.direction[k]
            inside = away[nearest] < IN_MOUNT_m and abs(along) > np.cos(IN_MOUNT_rad)
            found[one.name] = (f"isolator{nearest + 1}.{AXES[k]}", float(np.sign(along))), bool(inside)
        return found

    def with_channels_apart(self) -> IsolatorTable:
        """The same table with motors and geophones at positions that do not move with the isolators."""
        return replace(self, motors=(), drives=self.all_drives, geophones=None, instruments=self.all_instruments)

    def with_directions_by(self, names: Collection[str]) -> IsolatorTable:
        """The same table, with the direction of each channel given by the two components that are among these names of
        parameters, if two are."""

        def named(one: Any) -> Any:
            free = {k for k in range(3) if f"direction.{one.name}.{AXES[k]}" in names}
            return replace(one, dependent=({0, 1, 2} - free).pop()) if len(free) == 2 else one

        drives, instruments = (tuple(map(named, some)) for some in (self.drives, self.instruments))
        return replace(self, drives=drives, instruments=instruments)

    def _with_values(self, values: dict[str, float]) -> IsolatorTable:
        get = values.get
        tables = {
            "k": [list(i.stiffness) for i in self.isolators],
            "c": [list(i.damping) for i in self.isolators],
            "p": [list(i.position) for i in self.isolators],
        }
        for name, value in values.items():
            if match := _ISOLATOR_PARAMETER.fullmatch(name):
                number, kind, axis = match.groups()
                tables[kind][int(number) - 1][AXES.index(axis)] = value
        isolators = tuple(
            replace(old, stiffness=tuple(k), damping=tuple(c), position=tuple(p))
            for old, k, c, p in zip(self.isolators, tables["k"], tables["c"], tables["p"], strict=True)
        )
        motors = tuple(replace(m, constant_N_per_V=get(f"actuator.{m.name}", m.constant_N_per_V)) for m in self.motors)
        drives = tuple(replace(d, constant_N_per_V=get(f"actuator.{d.name}", d.constant_N_per_V)) for d in self.drives)
        drives, instruments = (tuple(_moved(one, values) for one in some) for some in (drives, self.instruments))
        inertia = tuple(get(name, old) for name, old in zip(INERTIA, self.inertia, strict=True))
        com = tuple(get(f"com_{axis}", old) for axis, old in zip(AXES, self.centre_of_mass, strict=True))
        return replace(
            self,
            mass=get("mass", self.mass),
            inertia=inertia,
            centre_of_mass=com,
            isolators=isolators,
            motors=motors,
            drives=drives,
            instruments=instruments,
        )

    def mounted_body(self) -> MountedBody:
        return self._body

    # Cached, because a fit uses the same table many times.
    @cached_property
    def _body(self) -> MountedBody:
        mounts = tuple(
            Mount(
                f"isolator{number}",
                np.array(one.position),
                np.add(one.position, one.chassis_offset),
                np.diag(one.stiffness),
                np.diag(one.damping),
            )
            for number, one in enumerate(self.isolators, 1)
        )
        actuators = tuple(
            PointActuator(one.name, np.array(one.position), np.array(one.direction), one.constant_N_per_V)
            for one in self.all_drives
        )
        return MountedBody(self.mass, self.inertia_matrix(), np.array(self.centre_of_mass), mounts, actuators)

    def equations_of_motion(self) -> EquationsOfMotion:
        """Eq. 2.36 with the chassis motion included, about the geometric centre."""
        return self._equations

    @cached_property
    def _equations(self) -> EquationsOfMotion:
        return self._body.equations_of_motion()

    def points(self) -> dict[str, Place]:
        found = {f"isolator{k}": Place(np.array(one.position), "isolator") for k, one in enumerate(self.isolators, 1)}
        found |= {one.name: Place(np.array(one.position), "actuator") for one in self.all_drives}
        found |= {one.name: Place(np.array(one.position), "sensor") for one in self.sensors()}
        return found | {"centre of mass": Place(np.array(self.centre_of_mass), "centre of mass")}

    @cached_property
    def all_instruments(self) -> tuple[Instrument, ...]:
        """The geophones in the isolators (fig. 2.2), then the instruments at other positions."""
        if (g := self.geophones) is None:
            return self.instruments
        chain = (g.suspension_Hz, g.suspension_damping, g.compensated_Hz, g.compensated_damping)
        attached = (
            GeophoneAt(name, self._at(isolator), _unit(axis), volts, *chain, preamplifier_gain=g.preamplifier_gain)
            for name, isolator, axis, volts in zip(g.names, g.isolator, g.axis, g.sensitivity_Vs_per_m, strict=True)
        )
        return (*attached, *self.instruments)

    def with_sensor_gains(self, gains: Mapping[str, float]) -> IsolatorTable:
        g = self.geophones
        if g is not None:
            volts = (
                gains[name] / g.preamplifier_gain if name in gains else old
                for name, old in zip(g.names, g.sensitivity_Vs_per_m, strict=True)
            )
            g = replace(g, sensitivity_Vs_per_m=tuple(volts))
        return replace(
            self,
            geophones=g,
            instruments=tuple(one.with_gain(gains[one.name]) if one.name in gains else one for one in self.instruments),
        )

    def _at(self, isolator: int) -> Triple:
        if not 1 <= isolator <= len(self.isolators):
            raise InputError(f"expected an isolator from 1 to {len(self.isolators)}", field="isolator", value=isolator)
        return triple(self.isolators[isolator - 1].position)


def _moved(one: Any, values: Mapping[str, float]) -> Any:
    """A drive or instrument with its position and direction changed."""
    place = tuple(values.get(f"place.{one.name}.{axis}", old) for axis, old in zip(AXES, one.position, strict=True))
    if place != one.position:
        one = replace(one, position=place)
    names = {k: f"direction.{one.name}.{AXES[k]}" for k in one.across}
    turns = {k: values[name] for k, name in names.items() if name in values}
    return one.turned(turns) if turns else one


def _unit(axis: str) -> Triple:
    return triple(axis == one for one in AXES)
