"""Excitation signals for measurements: their design and their files."""

from avis_ctrl.measurement.excitation.design import (
    ExcitationSignals,
    MultisineSettings,
    NoiseSettings,
    band_limited,
    choose_lines,
    multisine,
    noise,
    orthogonal_matrix,
)
from avis_ctrl.measurement.excitation.files import write_signals

__all__ = [
    "ExcitationSignals",
    "MultisineSettings",
    "NoiseSettings",
    "band_limited",
    "choose_lines",
    "multisine",
    "noise",
    "orthogonal_matrix",
    "write_signals",
]
