"""A real nonlinear 3x3 system at two levels: noise and distortion apart, and its modes.

Figures below were measured with this package. The modes' frequencies near 805, 921, 1315, 1671 and 2274 Hz are the
data's own description (Floren et al. 2024); that the gain and the 805 Hz mode depend on the level, too.
"""

from __future__ import annotations

import numpy as np
import pytest
from fine_steering_mirror import mirror

from avis_ctrl.measurement.frequency_response.best_linear import best_linear_approximation
from avis_ctrl.measurement.frequency_response.local_polynomial import local_polynomial
from avis_ctrl.measurement.frequency_response.resonance import resonance

MODES_HZ = (805.0, 921.0, 1315.0, 1671.0, 2274.0)


@pytest.fixture(scope="module")
def measured(data):
    """Both levels; recorded in the steady state, so there is no transient to remove."""
    return {
        level: best_linear_approximation(mirror(data, level), band_Hz=(2, 3000), transient="none")
        for level in (100, 300)
    }


def power(covariance):
    """Mean over lines and sum over outputs."""
    return np.real(np.einsum("nii->", covariance)) / len(covariance)


def test_two_realisations_of_three_orthogonal_experiments_are_found(measured):
    for got in measured.values():
        assert "6 experiments of 2 periods" in got.method
        assert got.value.shape == (3837, 3, 3)  # all lines from 2.34 to 2999.2 Hz
        assert got.dof == 15  # 6 - 3 on each of five lines


@pytest.mark.parametrize(
    ("level", "band", "expected_dB"),
    [
        (100, (100, 750), 10.7),
        (100, (750, 850), 15.9),
        (100, (900, 2400), 4.8),
        (300, (2, 100), 22.2),
        (300, (100, 750), 23.3),
        (300, (750, 850), 15.5),
        (300, (900, 2400), 19.5),
    ],
)
def test_distortion_stands_above_noise(measured, level, band, expected_dB):
    """Measured ratios of distortion to noise of the mean of two periods. Below 100 Hz at 100 mV noise hides it."""
    got = measured[level].between(*band)
    assert 10 * np.log10(power(got.distortion) / power(got.measurement_noise)) == pytest.approx(expected_dB, abs=0.5)


def test_distortion_grows_faster_than_the_signal(measured):
    """100 to 750 Hz: +12.8 dB where the input grows by 9.5 dB; a cubic term alone would give 28.6 dB."""
    distortion = [power(measured[level].between(100, 750).distortion) for level in (100, 300)]
    assert 11.5 < 10 * np.log10(distortion[1] / distortion[0]) < 14.5


def test_noise_where_only_the_sensors_make_it(measured):
    """100 to 750 Hz: the same at both levels within 1 dB (measured: 0.1 dB)."""
    noise = [power(measured[level].between(100, 750).measurement_noise) for level in (100, 300)]
    assert abs(10 * np.log10(noise[1] / noise[0])) < 1.0


def test_two_records_at_the_low_level_were_disturbed(data):
    """Their periods differ five times as much as the others' do: why the noise at 100 mV is above that at 300 mV."""
    records = mirror(data, 100).records
    change = np.array([np.std(np.diff(r.y.reshape(2, -1, 3), axis=0)) for r in records])
    assert sorted(np.argsort(change)[-2:].tolist()) == [1, 2]
    assert change[[1, 2]].min() > 3 * change[[0, 3, 4, 5]].max()


def test_gain_at_low_frequency_grows_with_the_level(measured):
    """Piezo hysteresis: +3.6 to +11.4 % on each of the nine paths from 100 to 300 mV; the weak ones by two standard
    deviations, all together by more than twenty."""
    low = {level: m.between(20, 60) for level, m in measured.items()}
    gain = {level: np.abs(m.value.mean(axis=0)) for level, m in low.items()}
    assert np.all(gain[300] / gain[100] > 1.03) and np.all(gain[300] / gain[100] < 1.13)
    spread = np.sqrt(sum(m.variance().mean(axis=0) / len(m.value) for m in low.values()))
    assert np.all(gain[300] - gain[100] > 1.5 * spread)
    assert np.sum(gain[300] - gain[100]) > 20 * np.sqrt(np.sum(spread**2))


def test_the_first_mode_falls_with_the_level(measured):
    """814.11(5) Hz at 100 mV, 806.29(6) Hz at 300 mV: stiffness -1.9 %."""
    modes = {level: resonance(m, 805.0) for level, m in measured.items()}
    assert modes[100].frequency_Hz == pytest.approx(814.1, abs=0.3)
    assert modes[300].frequency_Hz == pytest.approx(806.3, abs=0.3)
    for mode in modes.values():
        assert mode.misfit < 1.3 and mode.frequency_std_Hz < 0.1
        assert 0.011 < mode.damping < 0.013


@pytest.mark.parametrize("near", MODES_HZ)
def test_modes_are_where_the_source_says(measured, near):
    """At 300 mV 806.3, 921.4, 1316.1, 1679.1 and 2275.5 Hz; all within 0.5 %. At 100 mV up to 2.1 % higher."""
    assert resonance(measured[300], near).frequency_Hz == pytest.approx(near, rel=0.005)
    above = resonance(measured[100], near).frequency_Hz / near - 1
    assert 0.0 < above < 0.022


@pytest.mark.parametrize("near", MODES_HZ[:3])
def test_the_local_polynomial_method_finds_the_same_modes(measured, data, near):
    """It knows nothing of periods."""
    other = local_polynomial(mirror(data, 300), band_Hz=(near - 100, near + 100))
    a, b = resonance(measured[300], near), resonance(other, near)
    assert abs(a.frequency_Hz - b.frequency_Hz) < 5 * np.hypot(a.frequency_std_Hz, b.frequency_std_Hz)
    assert a.damping == pytest.approx(b.damping, rel=0.05)
