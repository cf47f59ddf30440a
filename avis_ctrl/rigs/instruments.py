"""Drives and sensors by position and direction, each sensor with its own dynamics and noise.

    motion along the sensor's axis -> zeros and poles of the sensor -> volts at the converter

A geophone measures absolute velocity, an accelerometer absolute acceleration; a position sensor measures the
displacement of the payload relative to the chassis.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import cascade, second_order_roots
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.converter import Converter, white_density
from avis_ctrl.rigs.equipment import Ambient, Electronics
from avis_ctrl.rigs.file_errors import Values
from avis_ctrl.rigs.floor_motion import DERIVATIVES, Quantity
from avis_ctrl.rigs.key_types import Axis, Direction, LengthStd, Name, NotNegative, Percent, Point, Positive

Triple = tuple[float, ...]


def triple(values: Iterable[float]) -> Triple:
    """Three numbers as floats."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def _no_key(value: Any) -> None:
    # How a fit turns a direction is no property of the channel.
    raise ValueError("unknown key")


def _both(damping: float | None, info: ValidationInfo) -> float | None:
    if (damping is None) != (info.data.get("compensated_Hz") is None):
        raise ValueError("expected compensated_Hz and compensated_damping, both or neither")
    return damping


def _alone(rms_V: float | None, info: ValidationInfo) -> float | None:
    density = next((name for name, value in info.data.items() if name.endswith("_rtHz") and value is not None), None)
    if rms_V is not None and density is not None:
        raise ValueError(f"expected noise_rms_V or {density}, not both")
    return rms_V


@dataclass(frozen=True)
class Channel(Values):
    """A drive or sensor at a position [m] with a direction (unit vector with sign).

    dependent : index of the component of the direction that follows from the other two, by the unit length; None for
        the largest (`along`). It does not change while a fit turns the direction, even if another becomes the largest.
    """

    name: Name
    position: Annotated[Point, Field(alias="position_m")]
    direction: Direction
    dependent: Annotated[int | None, Field(exclude=True), BeforeValidator(_no_key)] = field(
        default=None, kw_only=True, compare=False, repr=False
    )

    @property
    def along(self) -> int:
        """Index of the dependent component."""
        return int(np.argsort(np.abs(self.direction), kind="stable")[-1]) if self.dependent is None else self.dependent

    @property
    def across(self) -> tuple[int, ...]:
        """Indices of the other two components, which are free."""
        return tuple(k for k in range(3) if k != self.along)

    def turned(self, components: Mapping[int, float]) -> Self:
        """The channel with other values of some of these two components; the sign of the dependent one is kept.

        Raises InputError for components of no unit vector.
        """
        free, along, n = list(self.across), self.along, np.array(self.direction)
        n[free] = [components.get(k, n[k]) for k in free]
        rest = 1 - float(np.sum(n[free] ** 2))
        if rest <= 0:
            raise InputError("expected components of a unit vector", field=f"direction.{self.name}", value=n.tolist())
        n[along] = np.copysign(np.sqrt(rest), n[along])
        return replace(self, direction=triple(n), dependent=along)


@dataclass(frozen=True)
class Drive(Channel):
    """A force constant_N_per_V * volts along the direction. limit_V : None for the rig's common limit."""

    constant_N_per_V: Positive
    limit_V: Positive | None = None


@dataclass(frozen=True)
class Sensor(Channel):
    """A sensor channel of any kind.

    Attributes
    ----------
    quantity : what it measures along its axis: absolute "velocity" [m/s] or "acceleration" [m/s^2] of the payload, or
        "displacement" [m] of the payload relative to the chassis.
    zeros, poles : [rad/s] of the sensor chain from this motion to volts.
    gain : volts per unit of motion in the passband: far above the high-pass corners; for a position sensor, at low
        frequency.
    noise_rms_V : r.m.s. of the white noise per sample, before the converter.
    suspension : corner [Hz] and damping ratio of a geophone's suspension; None for other kinds.
    noise_density : the same noise as motion in the passband [unit/sqrt(Hz)], if the rig file states it in this form.
    low_pass : the poles of the anti-alias filter, which are also in `poles`.
    offset_V : maximum offset of the channel, of either sign.
    flicker_rms_V : r.m.s. per sample of a white noise whose density is that of the 1/f noise at 1 Hz.
    """

    quantity: Quantity
    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    gain: float
    noise_rms_V: float
    suspension: tuple[float, float] | None = None
    noise_density: float | None = None
    low_pass: tuple[complex, ...] = ()
    offset_V: float = 0.0
    flicker_rms_V: float = 0.0

    @property
    def inertial(self) -> bool:
        """Whether it measures absolute motion, not motion relative to the chassis."""
        return self.quantity != "displacement"

    @property
    def leading(self) -> float:
        """Leading coefficient of the chain for a passband gain of one."""
        lags = self.low_pass if self.inertial else self.poles
        return float(np.prod(np.abs(lags)))

    def chain(self, gain: float | None = None) -> StateSpace:
        """Motion -> volts, with `gain` in place of the sensor's gain if it is given."""
        size = self.gain if gain is None else gain
        zeros, poles = (np.real_if_close(np.array(roots, complex)) for roots in (self.zeros, self.poles))
        return cascade(zeros, poles, self.leading * size, "motion", "voltage")

    def motion_density(self, converter: Converter | None, sample_rate_Hz: float) -> float:
        """One-sided density of sensor noise and rounding noise, as motion in the passband [unit/sqrt(Hz)]."""
        rounding = converter.noise_density_V_rtHz if converter else 0.0
        if self.noise_density is not None:
            return float(np.hypot(self.noise_density, rounding / self.gain))
        return float(np.hypot(rounding, white_density(self.noise_rms_V, sample_rate_Hz)) / self.gain)

    def flicker_density(self, sample_rate_Hz: float) -> float:
        """One-sided density of the 1/f noise at 1 Hz, as motion in the passband [unit/sqrt(Hz)]."""
        return white_density(self.flicker_rms_V, sample_rate_Hz) / self.gain

    def with_electronics(
        self, electronics: Electronics, preamplifier_gain: float, converter: Converter | None, sample_rate_Hz: float
    ) -> Sensor:
        """The sensor with the offset, 1/f noise and anti-alias filter of its channel."""
        lags = electronics.low_pass()
        code, rounding = (converter.lsb_V, converter.noise_rms_V) if converter else (0.0, 0.0)
        return replace(
            self,
            poles=(*self.poles, *lags),
            low_pass=lags,
            offset_V=electronics.offset_V(preamplifier_gain, code),
            flicker_rms_V=electronics.flicker_rms_V(preamplifier_gain, self.noise_rms_V, rounding, sample_rate_Hz),
        )

    def as_velocity(self, omega: np.ndarray) -> np.ndarray:
        """Response (n,) of the chain from velocity with unit passband gain, at omega > 0 [rad/s]."""
        s = 1j * np.asarray(omega, float)
        chain = self.leading * s ** (DERIVATIVES[self.quantity] - 1)
        for zero in self.zeros:
            chain = chain * (s - zero)
        for pole in self.poles:
            chain = chain / (s - pole)
        return chain


@dataclass(frozen=True)
class Instrument(Channel):
    """A sensor of a rig file.

    noise_rms_V : r.m.s. of its white noise per sample; None for that of its density, or the ambient noise.
    sensitivity, density : names of the fields with its sensitivity and its noise density, if it has one.
    """

    quantity: ClassVar[Quantity]
    sensitivity: ClassVar[str]
    density: ClassVar[str | None] = None
    zeros: ClassVar[tuple[complex, ...]] = ()

    preamplifier_gain: Positive = field(default=1.0, kw_only=True)
    noise_rms_V: Annotated[NotNegative | None, AfterValidator(_alone)] = field(default=None, kw_only=True)

    def poles(self) -> tuple[complex, ...]:
        """Of the sensor and its filter [rad/s]."""
        raise NotImplementedError

    @property
    def gain(self) -> float:
        """Volts per unit of motion, preamplifier included."""
        return float(getattr(self, self.sensitivity) * self.preamplifier_gain)

    def with_gain(self, gain: float) -> Self:
        """The instrument with another gain."""
        changed: dict[str, Any] = {self.sensitivity: gain / self.preamplifier_gain}
        return replace(self, **changed)

    def sensor(self, sample_rate_Hz: float, ambient: Ambient | None = None) -> Sensor:
        """The channel of this instrument."""
        density = None if self.density is None else getattr(self, self.density)
        noise = self.noise_rms_V
        if noise is None and density is not None:
            noise = float(density * self.gain * np.sqrt(sample_rate_Hz / 2))  # band-limited to half the sample rate
        elif noise is None:
            noise = ambient.sensor_noise_rms_V if ambient else 0.0
        return Sensor(
            self.name,
            self.position,
            self.direction,
            self.quantity,
            self.zeros,
            self.poles(),
            self.gain,
            noise,
            noise_density=density,
        )


@dataclass(frozen=True)
class GeophoneAt(Instrument):
    """A geophone of a rig file. compensated_Hz : None for no filter."""

    quantity = "velocity"
    sensitivity = "sensitivity_Vs_per_m"
    zeros = (0j, 0j)

    sensitivity_Vs_per_m: Positive
    suspension_Hz: Positive
    suspension_damping: Positive
    compensated_Hz: Positive | None = None
    compensated_damping: Annotated[Positive | None, Field(validate_default=True), AfterValidator(_both)] = None

    def poles(self) -> tuple[complex, ...]:
        corner, damping = self.suspension_Hz, self.suspension_damping
        if self.compensated_Hz is not None and self.compensated_damping is not None:
            # The filter is assumed to match this suspension exactly: its zeros cancel the geophone's poles.
            corner, damping = self.compensated_Hz, self.compensated_damping
        return tuple(second_order_roots(corner, damping).tolist())

    def sensor(self, sample_rate_Hz: float, ambient: Ambient | None = None) -> Sensor:
        one = super().sensor(sample_rate_Hz, ambient)
        return replace(one, suspension=(self.suspension_Hz, self.suspension_damping))


@dataclass(frozen=True)
class AccelerometerAt(Instrument):
    """A charge-amplified accelerometer of a rig file: S s/(s + w) from acceleration, with white output noise."""

    quantity = "acceleration"
    sensitivity, density = "sensitivity_Vs2_per_m", "noise_m_per_s2_rtHz"
    zeros = (0j,)

    sensitivity_Vs2_per_m: Positive
    low_corner_Hz: Positive
    noise_m_per_s2_rtHz: NotNegative | None = None

    def poles(self) -> tuple[complex, ...]:
        return (complex(-2 * np.pi * self.low_corner_Hz),)


@dataclass(frozen=True)
class PositionSensorAt(Instrument):
    """A position sensor of a rig file, payload relative to chassis. bandwidth_Hz : first-order lag, None for none."""

    quantity = "displacement"
    sensitivity, density = "sensitivity_V_per_m", "noise_m_rtHz"

    sensitivity_V_per_m: Positive
    bandwidth_Hz: Positive | None = None
    noise_m_rtHz: NotNegative | None = None

    def poles(self) -> tuple[complex, ...]:
        return () if self.bandwidth_Hz is None else (complex(-2 * np.pi * self.bandwidth_Hz),)


@dataclass(frozen=True)
class FloorSensor(Values):
    """The sensor of a floor-velocity channel of a campaign, along x, y or z of the floor.

    noise_rms_m_per_s : r.m.s. of the white noise per sample, as floor velocity.
    """

    name: Name
    axis: Axis
    noise_rms_m_per_s: NotNegative


@dataclass(frozen=True)
class Tolerances(Values):
    """Standard deviations of the values of a rig file.

    place_m : of every coordinate of isolators, drives and sensors. direction_rad : of the direction of every drive and
    sensor, about both normals.
    """

    place_m: LengthStd = 0.001
    direction_rad: NotNegative = 0.005
    actuator_gain_percent: Percent = 1.0
    sensor_gain_percent: Percent = 1.0
    sensor_corner_percent: Percent = 1.0
    sensor_damping_percent: Percent = 3.0
    centre_of_mass_m: LengthStd = 0.001
    product_of_inertia_kgm2: NotNegative = 0.2
