"""How the shipped floor spectra (avis_ctrl/rigs/data/floor_spectra.toml) were made from measured ones."""

from __future__ import annotations

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.lti.magnitude_fit import magnitude_fit
from avis_ctrl.rigs.floor_motion import band_rms, check_spectrum
from avis_ctrl.rigs.floor_spectrum import ONE_SIDED, SpectrumModel


def smoothed(frequency_Hz: np.ndarray, asd: np.ndarray, octaves: float = 1 / 3) -> np.ndarray:
    """ASD averaged in power over a sliding band of that width: a narrow line keeps its energy, not its height.

    Bands are cut short at the ends of the data.
    """
    check_spectrum(frequency_Hz, asd)
    require_positive(octaves, "octaves")
    half = 2 ** (octaves / 2)
    lower = np.maximum(frequency_Hz / half, frequency_Hz[0])
    upper = np.minimum(frequency_Hz * half, frequency_Hz[-1])
    return np.array(
        [band_rms(frequency_Hz, asd, lo, hi) / np.sqrt(hi - lo) for lo, hi in zip(lower, upper, strict=True)]
    )


def fit_spectrum(
    frequency_Hz: np.ndarray,
    asd: np.ndarray,
    order: int,
    *,
    name: str = "",
    source: str = "",
    octaves: float = 1 / 3,
    points: int = 160,
) -> SpectrumModel:
    """Stable, minimum-phase shaping filter fitted to a displacement ASD [m/sqrt(Hz)] by its logarithm.

    The ASD is first averaged in power over `octaves` and taken at `points` frequencies evenly spaced in
    logarithm, so that every octave counts alike however finely it was sampled.

    Raises
    ------
    InputError : a spectrum that check_spectrum refuses, or an order below 2.
    """
    if not (isinstance(order, int) and order >= 2):
        raise InputError("a whole number, 2 or more", field="order", value=order)
    frequency_Hz, asd = np.asarray(frequency_Hz, float), np.asarray(asd, float)
    level = smoothed(frequency_Hz, asd, octaves)
    grid = np.geomspace(frequency_Hz[0], frequency_Hz[-1], points)
    target = np.exp(np.interp(np.log(grid), np.log(frequency_Hz), np.log(level)))
    fit = magnitude_fit(2 * np.pi * grid, target / ONE_SIDED, order, relative_degree=2, min_damping=0.05)
    return SpectrumModel(
        name, source, fit.function, float(frequency_Hz[0]), float(frequency_Hz[-1]), fit.error_rms_dB, fit.error_max_dB
    )


def fit_error_dB(model: SpectrumModel, frequency_Hz: np.ndarray, asd: np.ndarray, octaves: float = 1 / 3) -> np.ndarray:
    """Model over smoothed measurement [dB] at the measured frequencies inside the model's band."""
    inside = (frequency_Hz >= model.low_Hz * (1 - 1e-9)) & (frequency_Hz <= model.high_Hz * (1 + 1e-9))
    f, a = np.asarray(frequency_Hz, float)[inside], np.asarray(asd, float)[inside]
    return 20 * np.log10(model.asd(f) / smoothed(f, a, octaves))


def spectrum_to_table(model: SpectrumModel, digits: int = 6) -> str:
    """TOML lines from which spectrum_from_table rebuilds the model, to that many significant digits."""

    def number(x: float) -> str:
        return f"{x:.{digits}g}"

    def pairs(sections: tuple[tuple[float, float], ...]) -> str:
        return "[" + ", ".join(f"[{number(w / (2 * np.pi))}, {number(z)}]" for w, z in sorted(sections)) + "]"

    def singles(corners: tuple[float, ...]) -> str:
        return "[" + ", ".join(number(w / (2 * np.pi)) for w in sorted(corners)) + "]"

    shape = model.shape
    return "\n".join(
        [
            f'source = "{model.source}"',
            f"band_Hz = [{number(model.low_Hz)}, {number(model.high_Hz)}]",
            f"static_asd_m_rtHz = {number(float(model.asd(np.array([0.0]))[0]))}",
            f"zeros_Hz_damping = {pairs(shape.zero_pairs)}",
            f"poles_Hz_damping = {pairs(shape.pole_pairs)}",
            f"real_zeros_Hz = {singles(shape.real_zeros)}",
            f"real_poles_Hz = {singles(shape.real_poles)}",
            f"error_rms_dB = {model.error_rms_dB:.3f}",
            f"error_max_dB = {model.error_max_dB:.3f}",
        ]
    )
