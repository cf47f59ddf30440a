"""Measured floor spectra from files, and the marks by which a file betrays that a part of it was drawn or copied."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avis_ctrl.rigs.floor_motion import DERIVATIVES, Quantity, band_rms, check_spectrum


@dataclass(frozen=True)
class MeasuredSpectrum:
    """A measured displacement ASD.

    Parameters
    ----------
    name : what was measured, usually the file's name.
    frequency_Hz : (n,) increasing, positive.
    displacement_asd : (n,) [m/sqrt(Hz)], positive.

    Raises
    ------
    InputError : values that are not finite and positive, or frequencies that do not increase.
    """

    name: str
    frequency_Hz: np.ndarray
    displacement_asd: np.ndarray

    def __post_init__(self) -> None:
        check_spectrum(self.frequency_Hz, self.displacement_asd, "displacement_asd")

    def asd(self, quantity: Quantity = "displacement") -> np.ndarray:
        """The ASD of that quantity, (n,)."""
        return self.displacement_asd * (2 * np.pi * self.frequency_Hz) ** DERIVATIVES[quantity]

    def rms(self, low_Hz: float, high_Hz: float, quantity: Quantity = "velocity") -> float:
        """R.m.s. in a band [m, m/s or m/s^2]."""
        return band_rms(self.frequency_Hz, self.asd(quantity), low_Hz, high_Hz)

    def between(self, low_Hz: float, high_Hz: float) -> MeasuredSpectrum:
        """The points of a band."""
        kept = (self.frequency_Hz >= low_Hz) & (self.frequency_Hz <= high_Hz)
        return MeasuredSpectrum(self.name, self.frequency_Hz[kept], self.displacement_asd[kept])


def read_floor_motion(path: Path) -> MeasuredSpectrum:
    """A displacement ASD from a text file (two columns: Hz, m/sqrt(Hz)) or an .npz with arrays `f` and `asd`."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return MeasuredSpectrum(path.stem, arrays["f"].astype(float), arrays["asd"].astype(float))
    return MeasuredSpectrum(path.stem, *np.loadtxt(path, ndmin=2).T)


def shared_points(a: MeasuredSpectrum, b: MeasuredSpectrum) -> list[tuple[float, float]]:
    """Bands [Hz] over which two files hold the very same numbers, which two measurements never do."""
    other = dict(zip(b.frequency_Hz.tolist(), b.displacement_asd.tolist(), strict=True))
    same = np.array(
        [other.get(f) == d for f, d in zip(a.frequency_Hz.tolist(), a.displacement_asd.tolist(), strict=True)]
    )
    return [(float(a.frequency_Hz[i]), float(a.frequency_Hz[j])) for i, j in _runs(same, 3)]


def drawn_lines(spectrum: MeasuredSpectrum, points: int = 6) -> list[tuple[float, float, float]]:
    """Stretches (low Hz, high Hz, slope) where the ASD is an exact power law: drawn, not measured."""
    slope = np.diff(np.log(spectrum.displacement_asd)) / np.diff(np.log(spectrum.frequency_Hz))
    straight = np.abs(np.diff(slope)) < 1e-6
    return [
        (float(spectrum.frequency_Hz[i]), float(spectrum.frequency_Hz[j + 2]), float(slope[i]))
        for i, j in _runs(straight, points - 2)
    ]


def _runs(flags: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """First and last index of each run of True at least that long."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(i), int(j) - 1) for i, j in edges.reshape(-1, 2) if j - i >= shortest]
