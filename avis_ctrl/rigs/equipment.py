"""Data of sensors, acquisition and site in a rig file, with its keys; their dynamics are built elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from avis_ctrl.rigs.converter import bits_of
from avis_ctrl.rigs.file_errors import Values
from avis_ctrl.rigs.key_types import Axis, NotNegative, Positive, Whole


@dataclass(frozen=True)
class Geophones(Values):
    """Geophones in the isolators, their compensation filter and preamplifier (Rademakers, section 2.1.1).

    isolator : 1-based number. axis : x, y or z. sensitivity_Vs_per_m : one value per channel.
    """

    names: tuple[str, ...]
    isolator: tuple[Whole, ...]
    axis: tuple[Axis, ...]
    sensitivity_Vs_per_m: tuple[Positive, ...]
    suspension_Hz: Positive
    suspension_damping: Positive
    compensated_Hz: Positive
    compensated_damping: Positive
    preamplifier_gain: Positive


@dataclass(frozen=True)
class Accelerometers(Values):
    """Accelerometers at actuators, along the actuators' axes, with sample rate and delay of their control loop."""

    at: Annotated[tuple[str, ...], Field(min_length=1)]
    sensitivity_Vs2_per_m: Positive
    low_corner_Hz: Positive
    noise_m_per_s2_rtHz: NotNegative
    sample_rate_Hz: Positive
    loop_delay_s: NotNegative
    drive_limit_V: Positive


@dataclass(frozen=True)
class Acquisition(Values):
    """Converter with the range +-adc_range_V. loop_delay_s : from sample to actuator voltage."""

    sample_rate_Hz: Positive
    adc_bits: Annotated[int, BeforeValidator(bits_of)]
    adc_range_V: Positive
    loop_delay_s: NotNegative


@dataclass(frozen=True)
class Ambient(Values):
    """Normal conditions on site: r.m.s. floor velocity per direction, 0.5-60 Hz, and sensor noise per channel."""

    floor_velocity_rms_m_per_s: NotNegative
    sensor_noise_rms_V: NotNegative


@dataclass(frozen=True)
class Electronics:
    """Offset, 1/f noise and anti-alias filter of the channels, the same for all channels.

    The defaults are from data sheets. Amplifier: INA128 (Texas Instruments, SBOS051), input offset typically
    10 uV + 100 uV / G at gain G; 10 nV/sqrt(Hz) at 10 Hz and 8 nV/sqrt(Hz) at 1 kHz, hence 1/f noise of
    19 nV/sqrt(Hz) at 1 Hz. Converter: offset of two codes, the maximum stated in data sheets of
    successive-approximation converters; no 1/f noise in addition to the white rounding noise.

    Attributes
    ----------
    sensor_offset_V : maximum offset of a sensor with its amplifier, at the converter, of either sign; None for the data
        sheet's value with the sensor's preamplifier gain.
    sensor_flicker_corner_Hz : frequency at which a sensor's 1/f noise density equals its white noise density; None for
        the data sheet's 1/f noise with the sensor's preamplifier gain.
    converter_offset_V : maximum offset of the converter, of either sign; None for two codes (zero without a converter).
    converter_flicker_corner_Hz : the same for the converter's 1/f noise and its rounding noise; 0 for no 1/f noise.
    anti_alias_order, anti_alias_corner_Hz : Butterworth low-pass before the converter; order 0 for none.
    """

    sensor_offset_V: float | None = None
    sensor_flicker_corner_Hz: float | None = None
    converter_offset_V: float | None = None
    converter_flicker_corner_Hz: float = 0.0
    anti_alias_order: int = 0
    anti_alias_corner_Hz: float | None = None

    def offset_V(self, preamplifier_gain: float, code_V: float) -> float:
        """Maximum offset of one channel, amplifier and converter together. code_V : volts per code."""
        sensor = 10e-6 * preamplifier_gain + 100e-6 if self.sensor_offset_V is None else self.sensor_offset_V
        return sensor + (2 * code_V if self.converter_offset_V is None else self.converter_offset_V)

    def flicker_rms_V(
        self, preamplifier_gain: float, noise_rms_V: float, rounding_rms_V: float, sample_rate_Hz: float
    ) -> float:
        """R.m.s. per sample of a white noise whose density is that of the channel's 1/f noise at 1 Hz.

        noise_rms_V, rounding_rms_V : r.m.s. per sample of the sensor's white noise and of the converter's rounding.
        """
        if self.sensor_flicker_corner_Hz is None:
            sensor = 19e-9 * preamplifier_gain * np.sqrt(sample_rate_Hz / 2)
        else:
            sensor = noise_rms_V * np.sqrt(self.sensor_flicker_corner_Hz)
        return float(np.hypot(sensor, rounding_rms_V * np.sqrt(self.converter_flicker_corner_Hz)))

    def low_pass(self) -> tuple[complex, ...]:
        """Poles of the anti-alias filter [rad/s]; its gain at zero frequency is one."""
        n = self.anti_alias_order
        angles = np.pi * (2 * np.arange(n) + n + 1) / (2 * max(n, 1))
        poles = 2 * np.pi * (self.anti_alias_corner_Hz or 0.0) * np.exp(1j * angles)
        # Exact conjugate pairs, and a real pole without round-off in its imaginary part.
        upper = [complex(pole) for pole in poles[: n // 2]]
        real = [complex(-abs(poles[n // 2]))] if n % 2 else []
        return (*upper, *real, *(pole.conjugate() for pole in upper))
