"""Floor motion: measured files as they are, integrals against independent ones, realisations against the model."""

from __future__ import annotations

import tomllib

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from measured_floor import MeasuredSpectrum, drawn_lines, read_floor_motion, shared_points
from scipy import stats
from scipy.integrate import quad

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import Rational
from avis_ctrl.rigs.floor_motion import band_rms, third_octave_edges, third_octave_midbands, third_octave_rms
from avis_ctrl.rigs.floor_spectrum import SpectrumModel, realise, shipped_spectra, shipped_spectrum, spectrum_from_table
from benchmarks.floor_spectra import fit_error_dB, fit_spectrum, smoothed, spectrum_to_table

FILES = {
    "kamioka_quiet": "kamiokaQuiet.txt",
    "kamioka_stormy": "kamiokaNoisy.txt",
    "clio_shield_horizontal": "CLIOshieldHoriz.txt",
    "clio_shield_vertical": "CLIOshieldVert.txt",
    "ligo_livingston": "seismic_mean.npz",
}


@pytest.fixture
def measured(data):
    return {name: read_floor_motion(data / "floor_motion" / file) for name, file in FILES.items()}


@pytest.fixture
def model():
    """Two resonances and a roll-off, 0.1 to 100 Hz."""
    w = 2 * np.pi
    shape = Rational(1e-4, ((w * 2.0, 0.3),), ((w * 0.2, 0.25), (w * 15.0, 0.2)))
    return SpectrumModel("test", "written here", shape, 0.1, 100.0)


def test_what_the_measured_files_hold_and_what_was_drawn_or_copied(measured):
    assert {name: s.frequency_Hz.size for name, s in measured.items()} == {
        "kamioka_quiet": 261,
        "kamioka_stormy": 261,
        "clio_shield_horizontal": 923,
        "clio_shield_vertical": 923,
        "ligo_livingston": 1024,
    }
    for name in ("kamioka_quiet", "kamioka_stormy"):
        [(low, high, slope)] = drawn_lines(measured[name])
        assert (low, high, slope) == pytest.approx((21.0, 1000.0, -1.0))
    assert not drawn_lines(measured["clio_shield_horizontal"]) and not drawn_lines(measured["ligo_livingston"])
    [same] = shared_points(measured["kamioka_quiet"], measured["kamioka_stormy"])
    assert same == pytest.approx((21.0, 1000.0))
    copied = shared_points(measured["clio_shield_horizontal"], measured["kamioka_stormy"])
    assert copied[0] == pytest.approx((0.0021185, 0.0843393), rel=1e-4)
    twins = shared_points(measured["clio_shield_horizontal"], measured["clio_shield_vertical"])
    assert twins[-1] == pytest.approx((100.1, 1000.0), rel=1e-6)


def test_the_stormy_day_is_louder_at_the_microseism(measured):
    assert measured["kamioka_stormy"].rms(0.1, 0.5) > 4 * measured["kamioka_quiet"].rms(0.1, 0.5)


@pytest.mark.parametrize("name", FILES)
def test_shipped_models_have_the_error_they_state(measured, name):
    model, data = shipped_spectrum(name), measured[name]
    inside = data.between(model.low_Hz * (1 - 1e-5), model.high_Hz * (1 + 1e-5))
    # The errors were stated at 160 points evenly spaced in logarithm.
    grid = np.geomspace(inside.frequency_Hz[0], inside.frequency_Hz[-1], 160)
    level = np.exp(
        np.interp(
            np.log(grid), np.log(inside.frequency_Hz), np.log(smoothed(inside.frequency_Hz, inside.displacement_asd))
        )
    )
    error = 20 * np.log10(model.asd(grid) / level)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(model.error_rms_dB, abs=0.01)
    assert np.max(np.abs(error)) == pytest.approx(model.error_max_dB, abs=0.02)


@pytest.mark.parametrize("name", FILES)
def test_shipped_models_keep_the_velocity_rms_within_1_dB(measured, name):
    model, data = shipped_spectrum(name), measured[name]
    high = min(60.0, 0.99 * model.high_Hz)
    assert abs(20 * np.log10(model.rms(0.5, high) / data.rms(0.5, high))) < 1.0


def test_refitting_finds_the_shipped_model(measured):
    data, shipped = measured["kamioka_quiet"].between(0.05, 21.0), shipped_spectrum("kamioka_quiet")
    again = fit_spectrum(data.frequency_Hz, data.displacement_asd, 8)
    assert again.error_rms_dB <= shipped.error_rms_dB + 0.01
    error = fit_error_dB(shipped, data.frequency_Hz, data.displacement_asd)
    assert np.sqrt(np.mean(error**2)) < 1.5 * shipped.error_rms_dB


def test_a_fit_recovers_a_rational_spectrum(model):
    frequency = np.geomspace(0.1, 100, 400)
    narrow = 1e-3
    fitted = fit_spectrum(frequency, model.asd(frequency), 4, octaves=narrow)
    assert fitted.error_max_dB < 0.01
    np.testing.assert_allclose(np.sort_complex(fitted.shape.poles()), np.sort_complex(model.shape.poles()), rtol=5e-3)


def test_tables_round_trip(model):
    rebuilt = spectrum_from_table("test", tomllib.loads(spectrum_to_table(model, 15)))
    f = np.geomspace(0.01, 1000, 50)
    np.testing.assert_allclose(rebuilt.asd(f), model.asd(f), rtol=1e-10)


def test_shipped_models_are_stable_minimum_phase_and_well_scaled():
    for model in shipped_spectra().values():
        assert 0 < model.low_Hz < model.high_Hz
        assert model.shape.relative_degree >= 2  # otherwise the velocity has no finite r.m.s.
        system = model.shape.system()
        assert system.is_stable() and np.all(model.shape.zeros().real < 0)
        f = np.geomspace(model.low_Hz, model.high_Hz, 60)
        np.testing.assert_allclose(
            np.sqrt(2) * np.abs(system.frequency_response(2 * np.pi * f)[:, 0, 0]), model.asd(f), rtol=1e-9
        )
        assert np.linalg.cond(system.A) < 1e7


def test_h2_norm_of_the_shaping_filter_is_the_rms(model):
    total, _ = quad(
        lambda x: np.exp(x) * model.asd(np.array([np.exp(x)]))[0] ** 2, np.log(1e-5), np.log(1e5), limit=400, epsabs=0
    )
    assert control.norm(model.shape.system().to_control(), 2) == pytest.approx(np.sqrt(total), rel=1e-4)


def test_scaling_to_the_floor_velocity_of_the_rig():
    scaled = shipped_spectrum("ligo_livingston").scaled_to_rms(2e-6, 0.5, 60.0)
    power, _ = quad(lambda f: scaled.asd(np.array([f]), "velocity")[0] ** 2, 0.5, 60.0, limit=400, epsabs=0)
    assert np.sqrt(power) == pytest.approx(2e-6, rel=1e-4)


@given(slope=st.floats(-4, 2), level=st.floats(1e-12, 1e-3), low=st.floats(0.01, 10), ratio=st.floats(1.01, 100))
@settings(max_examples=60, deadline=None)
def test_band_rms_of_a_power_law_is_its_integral(slope, level, low, ratio):
    frequency = np.geomspace(0.005, 2000, 30)
    exact, _ = quad(lambda x: np.exp(x) * (level * np.exp(slope * x)) ** 2, np.log(low), np.log(low * ratio), epsabs=0)
    assert band_rms(frequency, level * frequency**slope, low, low * ratio) == pytest.approx(np.sqrt(exact), rel=1e-8)


def test_band_rms_of_one_over_root_f_is_logarithmic():
    frequency = np.geomspace(1, 100, 7)
    assert band_rms(frequency, frequency**-0.5, 2.0, 50.0) == pytest.approx(np.sqrt(np.log(25.0)), rel=1e-12)


def test_third_octaves_are_base_ten_and_add_up(model):
    # IEC 61260-1:2014: nominal 1.25, 8, 31.5 and 80 Hz are exactly 10^(0.1), 10^(0.9), 10^(1.5), 10^(1.9) Hz.
    bands = third_octave_midbands(1.0, 80.0)
    assert bands.size == 20
    np.testing.assert_allclose(bands[[1, 9, 15, 19]], 10.0 ** np.array([0.1, 0.9, 1.5, 1.9]))
    lower, upper = third_octave_edges(bands)
    np.testing.assert_allclose(lower[1:], upper[:-1], rtol=1e-12)
    frequency = np.geomspace(0.5, 200, 2000)
    rms = third_octave_rms(frequency, model.asd(frequency, "velocity"), bands)
    exact = [
        np.sqrt(quad(lambda f: model.asd(np.array([f]), "velocity")[0] ** 2, lo, hi, epsabs=0)[0])
        for lo, hi in zip(lower, upper, strict=True)
    ]
    np.testing.assert_allclose(rms, exact, rtol=1e-4)
    assert np.sum(rms**2) == pytest.approx(model.rms(lower[0], upper[-1]) ** 2, rel=1e-4)


def test_realisation_has_the_spectrum_of_the_model(model):
    # Averaged over independent records each band sum is chi-square with two degrees of freedom a line and record.
    rng, records, T, dt = np.random.default_rng(5), 20, 50.0, 0.002
    n = round(T / dt)
    frequency = np.fft.rfftfreq(n, dt)
    power = np.mean([2 * dt / n * np.abs(np.fft.rfft(realise(model, T, dt, rng))) ** 2 for _ in range(records)], axis=0)
    for lower, upper in zip(*third_octave_edges(third_octave_midbands(0.5, 80.0)), strict=True):
        lines = (frequency >= lower) & (frequency < upper)
        count = np.sum(lines)
        degrees = 2 * records * count
        statistic = degrees * np.mean(power[lines] / model.asd(frequency[lines], "velocity") ** 2)
        # 23 bands, two sides, 99.9 % together.
        assert stats.chi2.ppf(1e-3 / 46, degrees) < statistic < stats.chi2.ppf(1 - 1e-3 / 46, degrees)


def test_realised_samples_are_gaussian_and_seeded(model):
    velocity = realise(model, 400.0, 0.01, np.random.default_rng(3))
    again = realise(model, 400.0, 0.01, np.random.default_rng(3))
    np.testing.assert_array_equal(velocity, again)
    thinned = velocity[::400] / np.std(velocity)
    assert stats.kstest(thinned, "norm").pvalue > 1e-3
    assert abs(np.mean(velocity)) < 1e-12 * np.std(velocity) + 1e-20


def test_parseval_of_one_record(model):
    velocity = realise(model, 20.0, 0.005, np.random.default_rng(2))
    lines = np.fft.rfft(velocity)
    energy = (np.abs(lines[0]) ** 2 + 2 * np.sum(np.abs(lines[1:-1]) ** 2) + np.abs(lines[-1]) ** 2) / 4000
    assert np.sum(velocity**2) == pytest.approx(energy, rel=1e-12)
    assert np.all(np.abs(lines[np.fft.rfftfreq(4000, 0.005) < 0.0999]) < 1e-12 * np.max(np.abs(lines)))


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda m: m.scaled_to_rms(-1.0, 1, 2), "rms"),
        (lambda m: realise(m, -1.0, 0.01, np.random.default_rng(0)), "duration_s"),
        (lambda m: realise(m, 0.001, 0.0005, np.random.default_rng(0)), "duration_s"),
        (lambda m: shipped_spectrum("mars"), "spectrum"),
        (lambda m: fit_spectrum(np.arange(1, 9.0), np.ones(8), 1), "order"),
        (lambda m: band_rms(np.arange(1, 9.0), np.ones(8), 0.5, 2.0), "band_Hz"),
        (lambda m: third_octave_rms(np.array([1.0, 1.01]), np.ones(2), np.array([1.0])), "band_Hz"),
        (lambda m: MeasuredSpectrum("x", np.arange(3.0), np.ones(3)), "frequency_Hz"),
    ],
)
def test_wrong_input_is_refused_by_name(model, call, field):
    with pytest.raises(InputError, match=field):
        call(model)
