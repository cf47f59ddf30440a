"""Models of floor motion: rational shaping filters fitted to measured spectra, and time series generated from them.

The filter maps white noise of unit intensity (E[w(t) w(t')] = delta(t - t')) to displacement [m]. Its H2 norm is the
r.m.s., and the one-sided ASD per square root of Hz is sqrt(2) |H(j 2 pi f)|.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import Rational
from avis_ctrl.rigs.floor_motion import DERIVATIVES, Quantity, band_rms

ONE_SIDED = np.sqrt(2.0)


@dataclass(frozen=True)
class SpectrumModel:
    """A rational model of floor displacement.

    Parameters
    ----------
    name, source : name of the model, and source of the measurement that it was fitted to.
    shape : unit-intensity white noise -> displacement [m]; relative degree at least 2: velocity is strictly proper.
    low_Hz, high_Hz : the band of the fit; the model is not valid outside.
    error_rms_dB, error_max_dB : error of the fit relative to the smoothed measurement.
    """

    name: str
    source: str
    shape: Rational
    low_Hz: float
    high_Hz: float
    error_rms_dB: float = 0.0
    error_max_dB: float = 0.0

    def asd(self, frequency_Hz: np.ndarray, quantity: Quantity = "displacement") -> np.ndarray:
        """One-sided ASD at the frequencies [Hz], (n,)."""
        omega = 2 * np.pi * np.asarray(frequency_Hz, float)
        return ONE_SIDED * self.shape.magnitude(omega) * omega ** DERIVATIVES[quantity]

    def rms(self, low_Hz: float, high_Hz: float) -> float:
        """R.m.s. velocity in a band."""
        frequency = np.geomspace(low_Hz, high_Hz, 4000)
        return band_rms(frequency, self.asd(frequency, "velocity"), low_Hz, high_Hz)

    def scaled_to_rms(self, rms: float, low_Hz: float, high_Hz: float) -> SpectrumModel:
        """The same shape, scaled to an r.m.s. velocity in a band."""
        require_positive(rms, "rms")
        factor = rms / self.rms(low_Hz, high_Hz)
        return replace(self, name=f"{self.name}, scaled by {factor:.4g}", shape=self.shape.scaled(factor))


def shipped_spectra() -> dict[str, SpectrumModel]:
    """The models shipped with the package, by name."""
    text = resources.files("avis_ctrl.rigs").joinpath("data/floor_spectra.toml").read_text(encoding="utf-8")
    return {name: spectrum_from_table(name, table) for name, table in tomllib.loads(text).items()}


def shipped_spectrum(name: str) -> SpectrumModel:
    """A model shipped with the package; the InputError for an unknown name lists the known ones."""
    spectra = shipped_spectra()
    if name not in spectra:
        raise InputError(f"one of {sorted(spectra)}", field="spectrum", value=name)
    return spectra[name]


def spectrum_from_table(name: str, table: dict[str, Any]) -> SpectrumModel:
    """A model from its TOML table: corner frequencies in Hz, damping ratios, static ASD."""

    def pairs(key: str) -> tuple[tuple[float, float], ...]:
        return tuple((2 * np.pi * float(f), float(z)) for f, z in table.get(key, []))

    def singles(key: str) -> tuple[float, ...]:
        return tuple(2 * np.pi * float(f) for f in table.get(key, []))

    unit = Rational(
        1.0, pairs("zeros_Hz_damping"), pairs("poles_Hz_damping"), singles("real_zeros_Hz"), singles("real_poles_Hz")
    )
    shape = unit.scaled(table["static_asd_m_rtHz"] / (ONE_SIDED * abs(complex(unit(np.array(0.0))))))
    low, high = (float(f) for f in table["band_Hz"])
    return SpectrumModel(name, table["source"], shape, low, high, table["error_rms_dB"], table["error_max_dB"])


def realise(spectrum: SpectrumModel, duration_s: float, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Velocity [m/s], (n,): Gaussian, with the spectrum of the model at every line of its Fourier transform.

    Each line k/duration has an independent complex Gaussian amplitude of variance S(f) df. Lines below the model's
    low_Hz and the Nyquist line are zero, so that there is no drift. The record is periodic in `duration_s`.

    Raises
    ------
    InputError : a record without a spectral line in the band.
    """
    n = round(duration_s / dt)
    if n < 4 or 1.0 / (n * dt) > spectrum.high_Hz or spectrum.low_Hz >= 0.5 / dt:
        raise InputError(
            f"a record with lines inside {spectrum.low_Hz:g} to {spectrum.high_Hz:g} Hz",
            field="duration_s",
            value=(duration_s, dt),
        )
    frequency = np.fft.rfftfreq(n, dt)
    active = frequency >= spectrum.low_Hz * (1 - 1e-9)
    if n % 2 == 0:
        active[-1] = False
    # x[m] = sum over k of Re(c_k exp(j 2 pi k m / n)) with E|c_k|^2 = 2 S df; irfft expects n/2 times c_k.
    line_rms = np.zeros(frequency.size)
    line_rms[active] = spectrum.asd(frequency[active]) * np.sqrt(1.0 / (n * dt))
    draw = rng.standard_normal((2, frequency.size))
    lines = 0.5 * n * line_rms * (draw[0] + 1j * draw[1])
    return np.fft.irfft(2j * np.pi * frequency * lines, n)
