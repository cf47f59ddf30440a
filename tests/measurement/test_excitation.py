"""Excitation signals against their definitions, Schroeder's phases and what files give back."""

import csv
import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal, stats
from scipy.io import loadmat

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.excitation.crest_factor import crest_factor, low_crest_phases, synthesise
from avis_ctrl.measurement.excitation.design import (
    MultisineSettings,
    NoiseSettings,
    choose_lines,
    multisine,
    noise,
    orthogonal_matrix,
)
from avis_ctrl.measurement.excitation.files import write_signals


def wanted(n_u=3, **changes) -> MultisineSettings:
    names = tuple(f"A{k}" for k in range(1, n_u + 1))
    return replace(MultisineSettings(names, 500.0, 2.0, (1.0, 60.0), 10.0, 0.5), **changes)


def spectrum(u: np.ndarray) -> np.ndarray:
    """(records, lines, n_u) Fourier coefficients."""
    return np.fft.rfft(u, axis=1) / u.shape[1]


@pytest.mark.parametrize("samples", [32, 33])
def test_a_multisine_is_the_sum_of_its_cosines(rng, samples):
    """Up to the last line below half the sample rate, two sets of phases at once."""
    lines, n = np.array([1, 4, 7, 14, 15]), np.arange(samples)
    amplitude, phase = rng.uniform(0.5, 2.0, 5), rng.uniform(0, 6, (2, 5))
    sums = (amplitude * np.cos(2 * np.pi * lines * n[:, None] / samples + phase[:, None])).sum(axis=2)
    np.testing.assert_allclose(synthesise(lines, amplitude, phase, samples), sums, atol=1e-12)


def schroeder_phases(n):
    """Of n equal lines (Schroeder, IEEE Trans. Inf. Theory 16 (1970), eq. 11)."""
    k = np.arange(1, n + 1)
    return -np.pi * k * (k - 1) / n


def test_flat_spectra_of_schroeders_phases_have_a_crest_factor_near_1_7():
    """The independent comparison: Schroeder's closed form, over continuous time, and the iteration beats it."""
    for n in (20, 60, 150):
        lines, one = np.arange(1, n + 1), np.ones(n)
        by_formula = crest_factor(synthesise(lines, one, schroeder_phases(n), 32 * n))
        assert 1.6 < by_formula < 1.8
        drawn = np.random.default_rng(n).uniform(0, 2 * np.pi, n)
        at_random = crest_factor(synthesise(lines, one, drawn, 32 * n))
        best = crest_factor(synthesise(lines, one, low_crest_phases(lines, one, drawn, 32 * n), 32 * n))
        assert best < 1.5 < by_formula < at_random


@settings(max_examples=15, deadline=None)
@given(n=st.integers(2, 12), seed=st.integers(0, 2**32 - 1))
def test_crest_factor_is_never_worse_than_at_the_start(n, seed):
    rng = np.random.default_rng(seed)
    lines, amplitude = np.sort(rng.choice(np.arange(1, 30), n, replace=False)), rng.uniform(0.1, 3.0, n)
    drawn = rng.uniform(0, 2 * np.pi, n)
    turns = rng.uniform(0, np.pi, 3)
    found = low_crest_phases(lines, amplitude, drawn, 128, turns)
    peaks = [
        max(np.max(np.abs(synthesise(lines, amplitude, phase + turn, 128))) for turn in turns)
        for phase in (found, drawn)
    ]
    assert peaks[0] <= peaks[1]


@pytest.mark.parametrize("n_u", [1, 2, 3, 5, 6, 8])
def test_experiments_are_orthogonal_at_every_line_and_silent_elsewhere(n_u):
    signals = multisine(wanted(n_u, realisations=2))
    assert signals.u.shape == (2 * n_u, 1000, n_u)
    U = spectrum(signals.u)
    lines = signals.settings.grid()
    assert np.array_equal(lines, np.arange(2, 121))
    for r in range(2):
        of_one = np.moveaxis(U[r * n_u : (r + 1) * n_u, lines], 0, -1)  # (lines, inputs, experiments)
        gram = of_one @ np.conj(np.swapaxes(of_one, 1, 2))
        power = 0.5**2 / lines.size / 2  # of each input's line: rms^2 = 2 sum |U|^2
        assert np.allclose(gram, n_u * power * np.eye(n_u), atol=1e-9 * power)
    assert np.max(np.abs(np.delete(U, lines, axis=1))) < 1e-12
    assert np.allclose(signals.rms_V, 0.5) and np.all(signals.peak_V <= 10.0)
    assert np.all(signals.crest <= signals.crest_before * (1 + 1e-9))
    assert np.max(signals.crest) < (1.5 if n_u in (1, 2, 8) else 1.75)


def test_orthogonal_matrices():
    for n in range(1, 13):
        T = orthogonal_matrix(n)
        assert np.allclose(T @ T.conj().T, n * np.eye(n)) and np.allclose(np.abs(T), 1)


def test_odd_lines_and_detection_lines():
    odd = choose_lines(wanted(lines="odd"), np.random.default_rng(1))[0]
    assert np.array_equal(odd, np.arange(3, 121, 2))
    lines, left_out = choose_lines(wanted(lines="odd_detection", group=4), np.random.default_rng(1))
    assert np.array_equal(np.sort(np.concatenate([lines, left_out])), odd)
    for start in range(0, odd.size - 3, 4):
        assert np.isin(odd[start : start + 4], left_out).sum() == 1
    assert len({int(np.flatnonzero(odd == k)[0]) % 4 for k in left_out}) > 1
    u = multisine(wanted(lines="odd_detection")).u
    # Only odd lines: the second half of the period is the first with its sign changed.
    assert np.allclose(u[:, :500], -u[:, 500:], atol=1e-12)
    wide = choose_lines(wanted(spacing=4, lines="odd"), np.random.default_rng(1))[0]
    assert np.array_equal(wide, np.arange(4, 121, 8))


def test_zippered_lines_belong_to_one_input_each_and_to_all_in_turn():
    signals = multisine(wanted(3, scheme="zippered", realisations=3))
    power = np.abs(spectrum(signals.u)) ** 2
    owner = power > 1e-6 * power.max()
    lines = signals.settings.grid()
    assert signals.u.shape == (3, 1000, 3)
    assert np.all(owner[:, lines].sum(axis=2) == 1) and owner.sum() == 3 * lines.size
    assert np.all(owner[:, lines].sum(axis=0) == 1)
    on = np.abs(spectrum(multisine(wanted(3, scheme="zippered", dealt=2)).u)) ** 2
    assert np.array_equal(on[0] > 1e-6 * on.max(), owner[2])
    assert np.allclose(signals.rms_V, 0.5)


def test_the_held_voltage_is_flat_where_the_hold_is_compensated():
    # The held voltage on a grid 200 times as fine, by brute force; the sum stands for the integral to
    # (pi f T / 200)^2 / 6, 7e-6 at 200 Hz.
    for compensated in (True, False):
        signals = multisine(wanted(2, compensate_hold=compensated, band_Hz=(1.0, 200.0)))
        fine = np.repeat(signals.u[0, :, 1], 200)
        held = np.abs(np.fft.rfft(fine))[signals.settings.grid()]
        assert np.allclose(held / held[0], 1.0, rtol=1e-5) if compensated else held[-1] < 0.8 * held[0]
    again = multisine(signals.settings)
    assert np.array_equal(again.u, signals.u)  # the settings reproduce the signals


def test_levels_and_limits():
    most = multisine(wanted(3, rms_V=None, limit_V=2.0))
    assert np.max(most.peak_V) == pytest.approx(2.0, rel=1e-12) and np.max(most.peak_V) <= 2.0
    assert np.allclose(most.rms_V, most.rms_V[0, 0])
    largest = most.rms_V[0, 0]
    with pytest.raises(InputError) as caught:
        multisine(wanted(3, rms_V=1.01 * largest, limit_V=2.0))
    assert f"at most {largest:.6g} V r.m.s." in str(caught.value) and "\n" not in str(caught.value)
    assert np.allclose(multisine(wanted(3, rms_V=0.99 * largest, limit_V=2.0)).rms_V, 0.99 * largest)
    with pytest.raises(InputError, match="limit of 1 V"):
        noise(NoiseSettings(("a",), 1000.0, 10.0, (1.0, 100.0), 1.0, 0.5))


def test_noise_is_gaussian_flat_in_its_band_and_independent():
    signals = noise(NoiseSettings(("a", "b"), 1000.0, 100.0, (5.0, 100.0), 10.0, 1.0, records=2, seed=4))
    assert signals.u.shape == (2, 100000, 2) and np.allclose(signals.rms_V, 1.0)
    frequency = np.fft.rfftfreq(100000, 1e-3)
    power = np.abs(np.fft.rfft(signals.u, axis=1)) ** 2
    inside = (frequency > 4.999) & (frequency < 100.001)
    assert np.max(power[:, ~inside]) < 1e-20 * np.max(power)
    # Each line's power is exponentially distributed about one mean.
    lines = power[:, inside].ravel()
    assert stats.kstest(lines / lines.mean(), "expon").pvalue > 1e-3
    _, coherence = signal.coherence(signals.u[0, :, 0], signals.u[0, :, 1], 1000.0, nperseg=1000)
    assert np.mean(coherence[6:100]) < 3 / 199 * 2
    assert abs(np.corrcoef(signals.u[0, :, 0], signals.u[1, :, 0])[0, 1]) < 5 / np.sqrt(2 * 95 * 100)


def test_a_seed_gives_one_signal():
    for make, given_ in (
        (multisine, wanted(2, lines="odd_detection")),
        (noise, NoiseSettings(("a",), 1000.0, 5.0, (1.0, 100.0), 10.0, 1.0)),
    ):
        first, again, other = (make(replace(given_, seed=seed)) for seed in (3, 3, 4))
        assert np.array_equal(first.u, again.u) and not np.array_equal(first.u, other.u)


def test_files_give_back_the_samples_the_seed_and_the_settings(tmp_path):
    signals = multisine(wanted(2, realisations=1, seed=9))
    thrice = np.tile(signals.u, (1, 3, 1))
    for name in ("u.h5", "u.csv", "u.mat"):
        write_signals(signals, tmp_path / name, periods=3, rig="mine")
    with h5py.File(tmp_path / "u.h5") as file:
        assert file.attrs["format"] == "avis-excitation" and file.attrs["rig"] == "mine" and file.attrs["seed"] == 9
        assert json.loads(file.attrs["settings"])["band_Hz"] == [1.0, 60.0]
        assert list(file["records"]) == ["00", "01"] and "y" not in file["records/00"]
        for k in range(2):
            group = file[f"records/{k:02d}"]
            assert np.array_equal(group["u"][:], thrice[k]) and group.attrs["period_s"] == 2.0
            assert group.attrs["excitation"] == "multisine" and group.attrs["sample_rate_Hz"] == 500.0
            assert group.attrs["level_V"] == pytest.approx(0.5) and list(group["u"].attrs["names"]) == ["A1", "A2"]
    lines = (tmp_path / "u.csv").read_text().splitlines()
    assert "# seed = 9" in lines and '# rig = "mine"' in lines
    header, *rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    table = np.array(rows, float)
    assert header == ["record", "time_s", "A1", "A2"]
    assert np.array_equal(table[:, 2:], thrice.reshape(-1, 2)) and table[3000, 0] == 1 and table[1, 1] == 0.002
    content = loadmat(tmp_path / "u.mat", simplify_cells=True)
    assert np.array_equal(np.moveaxis(content["u"], -1, 0), thrice) and content["seed"] == 9
    assert list(content["names"]) == ["A1", "A2"] and json.loads(content["settings"])["lines"] == "full"
    for name, periods, expected in (
        ("u.txt", 1, "ends in"),
        ("u.h5", 0, "periods"),
        ("no/such/u.h5", 1, "written"),
        ("no/such/u.csv", 1, "written"),
        ("no/such/u.mat", 1, "written"),
    ):
        with pytest.raises(InputError, match=expected):
            write_signals(signals, tmp_path / name, periods=periods)
    with pytest.raises(InputError, match="fit into memory"):
        NoiseSettings(("a",), 1000.0, 1e9, (1.0, 100.0), 10.0, 1.0)
    with pytest.raises(InputError, match=r"write \.h5 instead"):
        write_signals(signals, tmp_path / "u.mat", periods=10**9)
    one = noise(NoiseSettings(("a",), 1000.0, 5.0, (1.0, 100.0), 10.0, 1.0))
    with pytest.raises(InputError, match="not periodic"):
        write_signals(one, tmp_path / "n.h5", periods=2)
    write_signals(one, tmp_path / "n.mat")
    assert np.isnan(loadmat(tmp_path / "n.mat")["period_s"])


WRONG = [
    ({"inputs": ()}, "inputs"),
    ({"inputs": ("a", "a")}, "inputs"),
    ({"sample_rate_Hz": -1.0}, "sample_rate_Hz"),
    ({"period_s": np.nan}, "period_s"),
    ({"period_s": 1.0001}, "whole number of samples"),
    ({"band_Hz": (0.0, 10.0)}, "band_Hz"),
    ({"band_Hz": (20.0, 10.0)}, "band_Hz"),
    ({"band_Hz": (1.0, 250.0)}, "below half the sample rate"),
    ({"band_Hz": (1.1, 1.2)}, "at least 1 line"),
    ({"band_Hz": (1.0, 1.5), "scheme": "zippered"}, "at least 3 lines"),
    ({"lines": "even"}, "lines"),
    ({"scheme": "none"}, "scheme"),
    ({"spacing": 0}, "spacing"),
    ({"dealt": -1}, "dealt"),
    ({"period_s": 1e6}, "fit into memory"),
    ({"realisations": 10**9}, "fit into memory"),
    ({"group": 1}, "group"),
    ({"realisations": 1.5}, "realisations"),
    ({"seed": -1}, "seed"),
    ({"rms_V": 0.0}, "rms_V"),
    ({"limit_V": np.inf}, "limit_V"),
]


@pytest.mark.parametrize(("changes", "expected"), WRONG, ids=[str(k) for k in range(len(WRONG))])
def test_wrong_settings_are_answered_in_one_line(changes, expected):
    with pytest.raises(InputError, match=expected) as caught:
        multisine(wanted(3, **changes))
    assert "\n" not in str(caught.value)
    for name in {"sample_rate_Hz", "band_Hz", "inputs", "seed"} & set(changes):
        if changes.get("scheme") is None and changes[name] != (1.1, 1.2):
            with pytest.raises(InputError, match=name):
                noise(replace(NoiseSettings(("a",), 500.0, 5.0, (1.0, 100.0), 10.0, 1.0), **{name: changes[name]}))


def test_the_gradient_of_the_norm_leads_to_a_stationary_peak():
    """Three lines: the least peak over all phases, by brute force over a grid, is found from one start in some."""
    lines, one = np.array([1, 2, 3]), np.ones(3)
    turn = np.linspace(0, 2 * np.pi, 181)
    # A shift in time takes the first phase to zero.
    grid = np.stack(np.meshgrid([0.0], turn, turn, indexing="ij"), -1).reshape(-1, 3)
    least = np.abs(synthesise(lines, one, grid, 96)).max(axis=1).min()
    found = [
        np.abs(synthesise(lines, one, low_crest_phases(lines, one, start, 96), 96)).max()
        for start in np.random.default_rng(2).uniform(0, 2 * np.pi, (8, 3))
    ]
    # The last norm, p = 256, still differs from the peak by up to 96^(1/256) - 1 = 1.8 %.
    assert min(found) < 1.018 * least
