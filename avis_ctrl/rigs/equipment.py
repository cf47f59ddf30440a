"""The numbers of the sensors, the acquisition and the site that a rig file holds.

Only the numbers: their dynamics are built elsewhere from these.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Geophones:
    """Geophones in the isolators, their compensation filter and preamplifier (Rademakers, section 2.1.1).

    isolator is 1-based, axis one of x, y, z; sensitivity_Vs_per_m one value per channel.
    """

    names: tuple[str, ...]
    isolator: tuple[int, ...]
    axis: tuple[str, ...]
    sensitivity_Vs_per_m: tuple[float, ...]
    suspension_Hz: float
    suspension_damping: float
    compensated_Hz: float
    compensated_damping: float
    preamplifier_gain: float


@dataclass(frozen=True)
class Accelerometers:
    """Accelerometers at actuators, along the actuators' axes, with the clock of their loop."""

    at: tuple[str, ...]
    sensitivity_Vs2_per_m: float
    low_corner_Hz: float
    noise_m_per_s2_rtHz: float
    sample_rate_Hz: float
    loop_delay_s: float
    drive_limit_V: float


@dataclass(frozen=True)
class Acquisition:
    """Converter: range is +-adc_range_V; loop_delay_s from sample to actuator voltage."""

    sample_rate_Hz: float
    adc_bits: int
    adc_range_V: float
    loop_delay_s: float


@dataclass(frozen=True)
class Ambient:
    """What is normal on site: floor velocity per direction, 0.5-60 Hz, and sensor noise per channel."""

    floor_velocity_rms_m_per_s: float
    sensor_noise_rms_V: float
