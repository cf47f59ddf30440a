"""Analogue-to-digital converter: quantisation, clipping and quantisation noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError


def quantise(voltage: float, lsb: float, lower: float, upper: float) -> float:
    """One sample through a mid-tread quantiser [V]: clipped to [lower, upper], rounded to a multiple of lsb.

    Scalar and free of Python objects, so that numba.njit(quantise) can be used in a compiled simulation.
    """
    if voltage >= upper:
        return upper
    if voltage <= lower:
        return lower
    return lsb * np.floor(voltage / lsb + 0.5)


def bits_of(value: object) -> int:
    """A valid number of bits, 1 to 32 (no real converter has more). Raises ValueError otherwise."""
    if isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 32:
        return value
    raise ValueError("expected a whole number of bits from 1 to 32")


@dataclass(frozen=True)
class Converter:
    """An n-bit two's-complement converter over +-range_V, sampled at sample_rate_Hz.

    Raises
    ------
    InputError : bits other than a whole number from 1 to 32, or a range or rate that is not positive.
    """

    bits: int
    range_V: float
    sample_rate_Hz: float

    def __post_init__(self) -> None:
        try:
            bits_of(self.bits)
        except ValueError as error:
            raise InputError(str(error), field="bits", value=self.bits) from None
        for field in ("range_V", "sample_rate_Hz"):
            require_positive(getattr(self, field), field)

    @property
    def lsb_V(self) -> float:
        """Voltage of one code step, the least significant bit."""
        return 2.0 * self.range_V / 2**self.bits

    @property
    def limits_V(self) -> tuple[float, float]:
        """Voltages of the lowest and highest code; two's complement has one code less on the positive side."""
        return -self.range_V, self.range_V - self.lsb_V

    def convert(self, voltage: np.ndarray) -> np.ndarray:
        """Voltages as the converter reports them, same shape."""
        lower, upper = self.limits_V
        return np.clip(self.lsb_V * np.floor(np.asarray(voltage, float) / self.lsb_V + 0.5), lower, upper)

    def clipped(self, voltage: np.ndarray) -> np.ndarray:
        """Which samples lie outside the range."""
        lower, upper = self.limits_V
        voltage = np.asarray(voltage)
        return (voltage > upper + self.lsb_V / 2) | (voltage < lower - self.lsb_V / 2)

    @property
    def noise_rms_V(self) -> float:
        """R.m.s. quantisation error lsb / sqrt(12) of a signal that varies by several codes (Widrow 1956)."""
        return self.lsb_V / np.sqrt(12.0)

    @property
    def noise_density_V_rtHz(self) -> float:
        """One-sided density of the quantisation error, white from 0 to half the sample rate."""
        return white_density(self.noise_rms_V, self.sample_rate_Hz)


def white_density(rms: float, sample_rate_Hz: float) -> float:
    """One-sided density [unit/sqrt(Hz)] of white noise with this r.m.s. from 0 to half the sample rate."""
    return float(rms * np.sqrt(2.0 / sample_rate_Hz))
