"""Drives and sensors by position and direction, each sensor with its own dynamics and noise.

    motion along the sensor's axis -> zeros and poles of the sensor -> volts at the converter

A geophone measures absolute velocity, an accelerometer absolute acceleration; a position sensor measures the
displacement of the payload relative to the chassis.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import cascade, second_order_roots
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.converter import Converter, white_density
from avis_ctrl.rigs.equipment import Acquisition, Ambient, Electronics
from avis_ctrl.rigs.floor_motion import DERIVATIVES, Quantity

Triple = tuple[float, float, float]


def triple(values: Iterable[float]) -> Triple:
    """Three numbers as floats."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def unit_vector(direction: Triple, field: str) -> Triple:
    """The direction scaled to unit length, unchanged if it has that length. Raises InputError for a zero vector."""
    length = float(np.linalg.norm(direction))
    if not (np.isfinite(length) and length > 0):
        raise InputError("expected a vector that is not zero", field=field, value=list(direction))
    if abs(length - 1.0) <= 1e-12:
        return direction
    return triple(part / length for part in direction)


@dataclass(frozen=True)
class Channel:
    """A drive or sensor at a position [m] with a direction (unit vector with sign).

    dependent : index of the component of the direction that follows from the other two, by the unit length; None for
        the largest (`along`). It does not change while a fit turns the direction, even if another becomes the largest.
    """

    name: str
    position: Triple
    direction: Triple
    dependent: int | None = field(default=None, kw_only=True, compare=False, repr=False)

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

    constant_N_per_V: float
    limit_V: float | None = None


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
class GeophoneAt(Channel):
    """A geophone of a rig file. compensated_Hz : None for no filter. noise_rms_V : None for the ambient noise."""

    sensitivity_Vs_per_m: float
    suspension_Hz: float
    suspension_damping: float
    compensated_Hz: float | None = None
    compensated_damping: float | None = None
    preamplifier_gain: float = 1.0
    noise_rms_V: float | None = None

    def sensor(self, acquisition: Acquisition, ambient: Ambient | None) -> Sensor:
        """The channel of this instrument."""
        corner, damping = self.suspension_Hz, self.suspension_damping
        if self.compensated_Hz is not None and self.compensated_damping is not None:
            # The filter is assumed to match this suspension exactly: its zeros cancel the geophone's poles.
            corner, damping = self.compensated_Hz, self.compensated_damping
        noise = _noise_rms(self.noise_rms_V, None, 1.0, acquisition, ambient)
        return Sensor(
            self.name,
            self.position,
            self.direction,
            "velocity",
            (0j, 0j),
            tuple(second_order_roots(corner, damping).tolist()),
            self.sensitivity_Vs_per_m * self.preamplifier_gain,
            noise,
            (self.suspension_Hz, self.suspension_damping),
        )


@dataclass(frozen=True)
class AccelerometerAt(Channel):
    """A charge-amplified accelerometer of a rig file: S s/(s + w) from acceleration, with white output noise."""

    sensitivity_Vs2_per_m: float
    low_corner_Hz: float
    noise_m_per_s2_rtHz: float | None = None
    preamplifier_gain: float = 1.0
    noise_rms_V: float | None = None

    def sensor(self, acquisition: Acquisition, ambient: Ambient | None = None) -> Sensor:
        """The channel of this instrument."""
        gain = self.sensitivity_Vs2_per_m * self.preamplifier_gain
        noise = _noise_rms(self.noise_rms_V, self.noise_m_per_s2_rtHz, gain, acquisition, ambient)
        return Sensor(
            self.name,
            self.position,
            self.direction,
            "acceleration",
            (0j,),
            (complex(-2 * np.pi * self.low_corner_Hz),),
            gain,
            noise,
            noise_density=self.noise_m_per_s2_rtHz,
        )


def white_rms(density: float, gain: float, sample_rate_Hz: float) -> float:
    """R.m.s. per sample [V] of a noise density of motion, band-limited to half the sample rate."""
    return float(density * gain * np.sqrt(sample_rate_Hz / 2))


def _noise_rms(
    rms_V: float | None, density: float | None, gain: float, acquisition: Acquisition, ambient: Ambient | None
) -> float:
    """Noise stated in the file for a sensor, otherwise the ambient noise of the channels."""
    if rms_V is not None:
        return rms_V
    if density is not None:
        return white_rms(density, gain, acquisition.sample_rate_Hz)
    return ambient.sensor_noise_rms_V if ambient else 0.0


@dataclass(frozen=True)
class PositionSensorAt(Channel):
    """A position sensor of a rig file, payload relative to chassis. bandwidth_Hz : first-order lag, None for none."""

    sensitivity_V_per_m: float
    bandwidth_Hz: float | None = None
    noise_m_rtHz: float | None = None
    preamplifier_gain: float = 1.0
    noise_rms_V: float | None = None

    def sensor(self, acquisition: Acquisition, ambient: Ambient | None = None) -> Sensor:
        """The channel of this instrument."""
        gain = self.sensitivity_V_per_m * self.preamplifier_gain
        poles = () if self.bandwidth_Hz is None else (complex(-2 * np.pi * self.bandwidth_Hz),)
        noise = _noise_rms(self.noise_rms_V, self.noise_m_rtHz, gain, acquisition, ambient)
        return Sensor(
            self.name,
            self.position,
            self.direction,
            "displacement",
            (),
            poles,
            gain,
            noise,
            noise_density=self.noise_m_rtHz,
        )


Instrument = GeophoneAt | AccelerometerAt | PositionSensorAt


def with_gain(instrument: Instrument, gain: float) -> Instrument:
    """The instrument with another gain, in volts per unit of motion, preamplifier included."""
    sensitivity = gain / instrument.preamplifier_gain
    if isinstance(instrument, GeophoneAt):
        return replace(instrument, sensitivity_Vs_per_m=sensitivity)
    if isinstance(instrument, AccelerometerAt):
        return replace(instrument, sensitivity_Vs2_per_m=sensitivity)
    return replace(instrument, sensitivity_V_per_m=sensitivity)


@dataclass(frozen=True)
class FloorSensor:
    """The sensor of a floor-velocity channel of a campaign, along x, y or z of the floor.

    noise_rms_m_per_s : r.m.s. of the white noise per sample, as floor velocity.
    """

    name: str
    axis: str
    noise_rms_m_per_s: float


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of the values of a rig file.

    place_m : of every coordinate of isolators, drives and sensors. direction_rad : of the direction of every drive and
    sensor, about both normals.
    """

    place_m: float = 0.001
    direction_rad: float = 0.005
    actuator_gain_percent: float = 1.0
    sensor_gain_percent: float = 1.0
    sensor_corner_percent: float = 1.0
    sensor_damping_percent: float = 3.0
    centre_of_mass_m: float = 0.001
    product_of_inertia_kgm2: float = 0.2
