"""Noise measured between the harmonics of a multisine, against the noise itself, which these records are made with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal as sg
from signal_campaigns import FS, draw, rig

from avis_ctrl.gap import campaign_spectra
from avis_ctrl.gap.campaign_spectra import all_silent, blocks_of, with_noise
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel

BAND_Hz = (0.5, 55.0)
BANDS_Hz = ((1.0, 4.0), (4.0, 8.0), (8.0, 16.0), (16.0, 32.0), (32.0, 55.0))


def estimated_over_true(
    slope: float = 0.0,
    model: TableModel | None = None,
    levels: tuple[float, ...] = (0.3, 0.3),
    floor_rms: float = 2e-6,
    where: str = "between the harmonics of periodic records",
) -> np.ndarray:
    """(bands, 6) power of the noise that the weights hold over that of the noise, under a floor that falls as
    f^-slope and is not measured."""
    campaign, driven = draw(11, levels=levels, slope=slope, floor_rms=floor_rms, noise_V=1e-5, adc=lambda y: y)
    model = model or TableModel(ResponseModel.of(rig(), ()))
    blocks, how = with_noise(blocks_of(campaign, model, BAND_Hz), campaign, campaign, model, BAND_Hz)
    assert all_silent(campaign, blocks) and f"measured {where}:" in how
    # Tapered, so that nothing leaks from where the noise is large; of all records, after the table has settled.
    noise = np.concatenate([record.y[10_000:] - driven[record.header.name][10_000:] for record in campaign.records], 1)
    f, density = sg.welch(noise, FS, ("kaiser", 14), nperseg=10_000, axis=0)
    true = np.mean(density.reshape(len(f), len(levels), 6), axis=1) * FS / 2
    assert blocks[0].noise is not None
    held = np.real(np.einsum("nii->ni", blocks[0].noise[:, 0]))
    lines = blocks[0].omega / (2 * np.pi)
    return np.array(
        [
            np.mean(held[(lines >= low) & (lines < high)], axis=0) / np.mean(true[(f >= low) & (f < high)], axis=0)
            for low, high in BANDS_Hz
        ]
    )


@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_noise_of_silent_lines_is_the_noise_in_every_band(slope):
    ratio = estimated_over_true(slope)
    assert np.all((ratio > 0.7) & (ratio < 1.4)), ratio


def stiffer() -> TableModel:
    """A model that predicts only a part of the starting transient: stiffness 5 % too large."""
    model = ResponseModel.of(rig(), default_parameters(rig()))
    factor = [1.05 if ".k_" in name else 1.0 for name in model.names]
    return TableModel(model.at(model.values * np.array(factor)))


def test_starting_transient_that_the_model_does_not_predict_is_no_noise_at_rest():
    """Between the harmonics of the driven record, its remainder is more than ten times the noise."""
    found = estimated_over_true(model=stiffer(), levels=(0.6, 0.0), floor_rms=1e-7, where="in records at rest")
    assert np.all((found > 0.6) & (found < 1.5)), found
    driven = "between the harmonics of periodic records"
    assert np.max(estimated_over_true(model=stiffer(), levels=(0.6,), floor_rms=1e-7, where=driven)) > 10


def test_weights_that_are_equal_leave_of_a_red_floor_too_much_where_it_is_low(monkeypatch):
    """Why they are not: the transient's estimate carries the noise of low frequencies over the whole band."""
    monkeypatch.setattr(campaign_spectra, "SETTINGS", replace(campaign_spectra.SETTINGS, weightings=1))
    assert np.max(estimated_over_true(3.0)[-1]) > 10
