"""Mains hum in residuals: false alarms, amplitudes and frequency against what was put in, masks and subtraction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from signal_campaigns import FS, draw, hum, rig

from avis_ctrl.gap.signals import hum as search
from avis_ctrl.gap.signals.hum import find_hum, polluted, subtract
from avis_ctrl.gap.signals.record_residual import RecordResidual, record_residuals
from avis_ctrl.measurement.campaign import RecordHeader


def white(seed: int, records: int = 6, samples: int = 10_000, added=0.0) -> list[RecordResidual]:
    rng = np.random.default_rng(seed)
    names = tuple(m.name for m in rig().motors), rig().geophones.names
    return [
        RecordResidual(
            RecordHeader(f"{k:02d}", FS, samples, *names, "rest"),
            np.zeros((samples, 8)),
            rng.normal(size=(samples, 6)) + added,
        )
        for k in range(records)
    ]


@pytest.mark.slow
def test_white_noise_raises_no_alarm_at_five_per_cent_in_more_than_its_share(monkeypatch):
    """60 campaigns: 3 expected at most, 10 or more have a chance of 1e-3."""
    monkeypatch.setattr(search, "SETTINGS", replace(search.SETTINGS, false_alarm=0.05))
    assert sum(find_hum(white(seed)) is not None for seed in range(60)) < 10


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multisine", "noise"])
@pytest.mark.parametrize("seed", range(4))
def test_misfit_of_the_model_is_no_hum(kind, seed):
    """10 % in gain and 1 ms: residuals of a tenth of the signal at every driven line, 50 Hz among them."""
    campaign, predicted = draw(seed, kind, levels=(0.1, 0.2, 0.4), samples=20_000)
    wrong = {name: 0.9 * np.roll(y, 1, 0) for name, y in predicted.items()}
    assert find_hum(record_residuals(campaign, wrong)) is None


@pytest.mark.parametrize("kind", ["multisine", "noise"])
@pytest.mark.parametrize(
    ("f0", "amplitudes"),
    [
        (50.013, {(0, 1): 5e-3, (1, 1): 2e-3, (0, 3): 1e-3}),
        (59.98, {(2, 2): 3e-4, (2, 3): 2e-4}),
        (50.0, {(j, 1): 3e-4 for j in range(6)}),
    ],
)
def test_lines_are_found_and_measured(kind, f0, amplitudes):
    campaign, predicted = draw(
        3, kind, levels=(0.1, 0.2, 0.4), samples=30_000, added=lambda n, rng: hum(n, f0, amplitudes, rng)
    )
    found = find_hum(record_residuals(campaign, predicted))
    assert found is not None and found.confidence > 0.999
    assert abs(found.frequency_Hz.value - f0) < 4 * found.frequency_Hz.std
    names = campaign.y_names
    assert {(names.index(line.channel), line.harmonic) for line in found.lines} == set(amplitudes)
    for line in found.lines:
        true = amplitudes[names.index(line.channel), line.harmonic]
        assert abs(line.amplitude.value - true) < 5 * line.amplitude.std
        assert line.amplitude.std < 0.1 * true


@pytest.mark.parametrize(("f0", "nominal"), [(50.012, 50.0), (59.986, 60.0)])
def test_a_harmonic_of_both_mains_does_not_hide_which_it_is(f0, nominal):
    """300 Hz is six times 50 and five times 60, and strong lines have a chance of zero in floating point."""
    n = 60_000
    lines = sum(1000 / k * np.sin(2 * np.pi * k * f0 / FS * np.arange(n) + k) for k in range(1, 7))
    found = find_hum(white(0, samples=n, added=np.tile(lines[:, None], 6)))
    assert found is not None and found.nominal_Hz == nominal
    assert abs(found.frequency_Hz.value - f0) < 5 * found.frequency_Hz.std
    assert set(found.harmonics) == {1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize(("records", "amplitude"), [(2, 0.3), (1, 0.4)])
def test_frequency_error_is_as_large_as_it_says(records, amplitude):
    """50 draws of a weak line in white noise: the pull has unit variance."""
    t, pull = np.arange(10_000) / FS, []
    for seed in range(50):
        added = np.zeros((10_000, 6))
        added[:, 2] = amplitude * np.sin(2 * np.pi * 50.07 * t + seed)
        found = find_hum(white(seed, records, added=added))
        assert found is not None
        pull.append((found.frequency_Hz.value - 50.07) / found.frequency_Hz.std)
    # Chi-square of 50: 0.6 to 1.55 hold 99.9 %.
    assert 0.6 < np.mean(np.square(pull)) < 1.55


def test_intervals_cover_the_scatter_between_few_records():
    """The frequency of the mains differs by 2 mHz r.m.s. between three records, of which one is three times as long.

    If each of 200 intervals contains the mean with a probability of 95 %, fewer than 180 do so with one of 1.2e-3."""
    inside = 0
    for seed in range(200):
        rng = np.random.default_rng([6, seed])
        records = [white(3 * seed + k, 1, samples)[0] for k, samples in enumerate((90_000, 30_000, 30_000))]
        for one, f in zip(records, 50.01 + 2e-3 * rng.standard_normal(3), strict=True):
            one.e[:, 0] += 5.0 * np.sin(2 * np.pi * f * np.arange(len(one.e)) / FS)
        found = find_hum(records)
        assert found is not None
        inside += abs(found.frequency_Hz.value - 50.01) < 1.96 * found.frequency_Hz.std
    assert inside >= 180


@pytest.mark.parametrize("records", [2, 3, 6])
@pytest.mark.parametrize("scatter", [0.0, 2.0, 10.0])
def test_intervals_cover_the_mean_of_few_records(records, scatter):
    """Two weak lines in white noise; the fundamental differs between records of 10 s by some of its standard
    deviations (1.3 mHz)."""
    t, inside, draws = np.arange(10_000) / FS, 0, 60
    for seed in range(draws):
        rng, each = np.random.default_rng([9, seed]), white(seed, records)
        for one, f in zip(each, 50.03 + 1.3e-3 * scatter * rng.standard_normal(records), strict=True):
            one.e[:, 2] += 0.4 * np.sin(2 * np.pi * f * t + seed) + 0.4 * np.sin(4 * np.pi * f * t)
        found = find_hum(each)
        assert found is not None
        inside += abs(found.frequency_Hz.value - 50.03) < 1.96 * found.frequency_Hz.std
    assert inside >= 51, inside  # if each does so with a probability of 95 %, fewer with one of 7e-4


def test_errors_cover_the_scatter_between_records():
    """Mains of 50.01 Hz that are off by a mHz, and change in amplitude, from record to record."""
    n, rng = 60_000, np.random.default_rng(3)
    f0, size = 50.01 + 1e-3 * rng.standard_normal(6), 5.0 + 0.5 * rng.standard_normal(6)
    records = white(1, samples=n)
    for one, f, A in zip(records, f0, size, strict=True):
        one.e[:, 0] += A * np.sin(2 * np.pi * f * np.arange(n) / FS)
    found = find_hum(records)
    assert found is not None
    f, amplitude = found.frequency_Hz, found.lines[0].amplitude
    assert 2e-4 < f.std < 1e-3 and abs(f.value - 50.01) < 2.5 * f.std
    assert 0.05 < amplitude.std < 0.5 and abs(amplitude.value - 5.0) < 2.5 * amplitude.std


def test_a_channel_that_is_constant_in_one_record_does_not_count():
    n = 30_000
    records = white(2, 3, n)
    for one in records[:2]:
        one.e[:, 0] += 2.0 * np.sin(2 * np.pi * 50.01 * np.arange(n) / FS)
    records[2].e[:, 0] = 0.0
    found = find_hum(records)
    assert found is not None
    assert found.frequency_Hz.value == pytest.approx(50.01, abs=1e-3)
    assert found.lines[0].amplitude.value == pytest.approx(2.0, rel=0.05)


def test_a_driven_line_among_silent_ones_is_no_hum():
    """A multisine with 50 Hz alone above 40 Hz, and a model that misses it."""
    n = 30_000
    t = np.arange(n) / FS
    header = RecordHeader("00", FS, n, ("A",), ("S",), "multisine", 1.0, 0.0, 10.0)
    line = np.sin(2 * np.pi * 50.0 * t)[:, None]
    e = 0.1 * line + np.random.default_rng(0).normal(size=(n, 1)) * 1e-3
    assert find_hum([RecordResidual(header, line, e)]) is None
    rest = RecordHeader("00", FS, n, ("A",), ("S",), "rest")
    assert find_hum([RecordResidual(rest, 0 * line, e)]) is not None


def test_subtraction_leaves_noise_and_the_driven_signal():
    amplitudes = {(0, 1): 5e-3, (4, 2): 2e-3}
    given = {"levels": (0.1, 0.2), "samples": 30_000}
    campaign, predicted = draw(4, "noise", **given, added=lambda n, rng: hum(n, 50.02, amplitudes, rng))
    found = find_hum(record_residuals(campaign, predicted))
    assert found is not None
    for record in campaign.records:
        y = record.y
        e = y - predicted[record.header.name]
        left = subtract(found, e, y, FS, campaign.y_names) - predicted[record.header.name]
        n = len(e)
        for j, k in amplitudes:
            tone = np.exp(-2j * np.pi * k * 50.02 * np.arange(n) / FS)
            assert abs(np.mean(left[:, j] * tone)) < 0.02 * abs(np.mean(e[:, j] * tone))
        untouched = [1, 2, 3, 5]
        assert np.array_equal(left[:, untouched], y[:, untouched] - predicted[record.header.name][:, untouched])


def test_the_mask_holds_the_lines_power():
    campaign, predicted = draw(
        4, "noise", levels=(0.1, 0.2), samples=30_000, added=lambda n, rng: hum(n, 50.02, {(0, 1): 5e-2}, rng)
    )
    left = record_residuals(campaign, predicted)
    found = find_hum(left)
    assert found is not None
    mask = polluted(found, 30_000, FS)
    power = np.abs(np.fft.rfft(left[0].e[:, 0])) ** 2
    near = np.abs(np.fft.rfftfreq(30_000, 1 / FS) - 50.02) < 1
    assert power[near & ~mask].sum() < 0.1 * power[near & mask].sum()
    assert 5 <= mask.sum() <= 8
