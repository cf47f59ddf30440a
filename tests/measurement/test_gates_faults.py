"""Gates for clipping below the known range, wrong units, spikes, levels, coherence, and what follows from what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gates_rig import LSB, RATE, changed, everywhere, known, multisine_campaign, noise_campaign
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.gates import examine
from avis_ctrl.measurement.gates.clipping import repeated_extreme
from avis_ctrl.measurement.gates.spikes import spikes
from avis_ctrl.report.identification.gates import figure_of
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.study.identification import IdentifyOptions, start_model
from avis_ctrl.study.record_checks import check_campaign

SEVERE = ("warning", "stop")
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def clean():
    return multisine_campaign(1)


@pytest.fixture(
    scope="module",
    params=[multisine_campaign, pytest.param(lambda seed: noise_campaign(seed, 24000), marks=pytest.mark.slow)],
)
def either(request):
    return request.param(1)


def alarms(campaign, gate=None, **changes):
    found = [f for f in examine(campaign, known(**changes)) if f.severity in SEVERE]
    return [f for f in found if gate is None or f.gate == gate]


def limited(campaign, part, noise=0.0):
    """Sz1 of the first record clipped at a part of its peak, and how many samples that are."""
    y = campaign.records[0].y.copy()
    level = LSB * round(part * np.abs(y[:, 1]).max() / LSB)
    hit = int(np.count_nonzero(np.abs(y[:, 1]) >= level))
    y[:, 1] = np.clip(y[:, 1], -level, level)
    if noise:
        y[:, 1] += LSB * np.round(noise * np.random.default_rng(2).standard_normal(len(y)) / LSB)
    return changed(campaign, 0, y=y), level, hit


@pytest.mark.parametrize("part", [0.6, 0.8])
def test_clipping_below_the_known_range(either, part):
    campaign, level, hit = limited(either, part)
    (found,) = alarms(campaign, "clipping")
    assert (found.channels, found.records) == (("Sz1",), ("00",))
    assert found.value == pytest.approx(hit, abs=0.03 * hit + 3)
    assert f"{level:.4g}"[:4] in found.sentence and "below the end of the known range" in found.sentence


@pytest.mark.parametrize("samples", [1, 2])
def test_two_samples_at_the_end_of_the_range_are_clipped_and_one_is_not(samples):
    campaign = everywhere(noise_campaign(1, 8000, (0.2,) * 4), lambda u, y: (u, 0.1 * y))
    y = campaign.records[0].y.copy()
    y[:, 1] *= 10
    k, top = int(np.argmax(y[:, 1])), float(np.max(y[:, 1]))
    y[k : k + samples, 1] = top
    found = examine(changed(campaign, 0, y=y), known(y_range_V=(-10.0, top), response=None))
    (said,) = [f for f in found if f.gate == "clipping"]
    assert said.severity == ("ok" if samples == 1 else "warning")
    assert samples == 1 or (said.value, said.channels) == (2, ("Sz1",))


def test_clipping_before_the_noise_of_the_converter(either):
    """A flat top that is rounded by noise of one step."""
    (found,) = alarms(limited(either, 0.7, noise=1e-3)[0], "clipping")
    assert found.channels == ("Sz1",)


def test_a_level_in_all_records_is_said_once_for_each_channel(clean):
    level = 0.6 * np.abs(clean.records[0].y).max(axis=0)
    campaign = everywhere(clean, lambda u, y: (u, np.clip(y, -level, level)))
    found = alarms(campaign, "clipping")
    assert len({f.channels for f in found}) == len(found) and any({"00", "01"} <= set(f.records) for f in found)


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(2, 60), st.floats(0.2, 30.0), st.floats(0.0, 2.0))
def test_smooth_tops_are_no_flat_tops(seed, periods, slow, noise):
    """Multisines repeated without and with noise, of few and of many samples for each wave, rounded finely or not."""
    rng = np.random.default_rng(seed)
    n, lines = 1024, np.arange(1, max(2, min(500, int(200 / slow))))
    U = np.zeros(n // 2 + 1, complex)
    U[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    x = np.tile(np.fft.irfft(U, n), periods)
    x = np.round(x / x.std() * 10 ** rng.uniform(0.5, 3) + noise * rng.standard_normal(len(x)))
    for sign in (1, -1):
        assert repeated_extreme(sign * x, periods)[1] > 1e-6


@given(seeds, st.floats(0.05, 5.0), st.floats(-1, 1))
def test_a_few_codes_are_no_flat_top(seed, codes, offset):
    x = np.round(codes * np.random.default_rng(seed).standard_normal(5000) + offset)
    assert repeated_extreme(x)[1] > 1e-6


def test_millivolts_are_a_wrong_unit(clean):
    found = alarms(everywhere(clean, lambda u, y: (u, 1000 * y)))
    assert [f.gate for f in found] == ["clipping"] and len(found[0].channels) == 6
    assert "mV" in found[0].sentence and "unit or scale is probably wrong" in found[0].sentence
    assert "Channels concerned: 'Sy1', 'Sz1'" in found[0].sentence
    (alone,) = alarms(everywhere(clean, lambda u, y: (u, y * np.where(np.arange(6) == 1, 1000, 1))), "clipping")
    assert alone.channels == ("Sz1",) and "concerned: 'Sz1'. The unit" in alone.sentence


@pytest.mark.parametrize("sample", [4, 12345, -5])
def test_a_single_spike_is_named(either, sample):
    y = either.records[1].y.copy()
    sample %= len(y)
    y[sample, 3] += 3.0
    (found,) = alarms(changed(either, 1, y=y))
    assert (found.gate, found.channels, found.records) == ("spikes", ("Sz2",), ("01",))
    assert f"sample {sample}" in found.sentence and f"{sample / RATE:.6g} s" in found.sentence


def test_a_spike_in_a_later_piece_has_its_place_in_the_record():
    campaign = noise_campaign(1, 24000, (0.2,))
    y = campaign.records[0].y.copy()
    y[21000, 3] += 3.0
    found = examine(changed(campaign, 0, y=y), known(), longest=16000)
    (said,) = [f for f in found if f.gate == "spikes"]
    assert "at 21 s (sample 21000)" in said.sentence


def test_a_drive_that_never_moves_is_noted(clean):
    (said,) = [f for f in examine(clean, known()) if f.gate == "dead channel"]
    assert said.severity == "ok"
    idle = everywhere(clean, lambda u, y: (u * (np.arange(8) != 2), y))
    (said,) = [f for f in examine(idle, known(response=None)) if f.gate == "dead channel"]
    assert (said.severity, said.channels) == ("note", ("Ax2",))
    assert "'Ax2' is constant in every driven record" in said.sentence


def test_false_alarms_of_spikes():
    """A million samples each of white noise, of noise that grows 4 times, and of a step."""
    rng = np.random.default_rng(7)
    white = rng.standard_normal(1 << 20)
    ramp = white * np.linspace(1, 4, len(white))
    for x in (white, np.round(white), np.round(0.2 * white), ramp, np.repeat([0.0, 5.0], 5000) + white[:10000] / 10):
        assert not len(spikes(x)[0])


@given(seeds, st.floats(30, 1000), st.integers(10, 4000))
def test_spikes_are_found_above_the_limit(seed, size, at):
    x = np.random.default_rng(seed).standard_normal(4096)
    x[at] += size
    assert at in spikes(x)[0]


def test_levels_close_to_each_other_are_not_compared():
    (said,) = [f for f in examine(multisine_campaign(4, levels=(0.2, 0.22)), known()) if f.gate == "level dependence"]
    assert said.severity == "ok" and "was not tested" in said.sentence


def test_records_of_different_kinds_are_not_compared(clean):
    other = noise_campaign(2, levels=(0.5,)).records[0]
    header = clean.records[0].header
    campaign = type(clean)("avis", (clean.records[0], type(other)(other.header, other.u, other.y)))
    assert header.excitation != other.header.excitation
    for f in examine(campaign, known()):
        if f.gate in ("level dependence", "repeatability"):
            assert f.severity == "ok" and "not tested" in f.sentence


def test_coherence_says_what_its_picture_shows(either):
    noisy = everywhere(either, lambda u, y: (u, y + 0.3 * np.random.default_rng(1).standard_normal(y.shape)))
    for campaign in (either, noisy):
        found = [f for f in examine(campaign, known()) if f.gate == "coherence"]
        curves = found[0].picture.series
        drawn = {s.name: float(s.y.min()) for s in curves}
        assert min(f.value for f in found) == pytest.approx(min(drawn.values()))
        low = {name for name, least in drawn.items() if least < 0.5}
        assert low == {n for f in found for n in f.channels} and all((f.severity == "ok") != bool(low) for f in found)
        first = min(s.x.min() for s in curves)
        assert first < 1 or all(f"Below {first:.3g} Hz, down to 0." in f.sentence for f in found)


def test_one_lost_sample_is_one_alarm(clean):
    y = np.delete(clean.records[0].y, 11003, axis=0)
    found = examine(changed(clean, 0, y=y), known())
    assert {f.gate for f in found if f.severity in SEVERE} == {"missing samples"}
    said = [f for f in found if "likely a consequence" in f.sentence]
    assert said and all(f.severity == "note" and "record 00" in f.sentence for f in said)


def test_a_stop_is_said_once_and_without_a_second_full_stop(clean):
    campaign = limited(clean, 0.6)[0]
    lines: list[str] = []
    with pytest.raises(InputError) as error:
        check_campaign(campaign, start_model(campaign, load_rig("avis"), IdentifyOptions()), False, lines.append)
    assert ".;" not in str(error.value) and "--despite-gates" in str(error.value)
    assert not [line for line in lines if "stop:" in line]


def test_a_rig_without_sensor_noise_is_checked_all_the_same(clean):
    """A rig file of a simulated table may state no noise; then there is no noise to compare with."""
    rig = load_rig("avis")
    quiet = replace(rig, ambient=replace(rig.ambient, sensor_noise_rms_V=0.0))
    lines: list[str] = []
    check_campaign(clean, start_model(clean, quiet, IdentifyOptions()), False, lines.append)
    assert not [line for line in lines if "noise of" in line]


def test_figures_name_the_channels(clean):
    """Ticks are names, and no curve that stands alone is in the legend."""
    (said,) = [f for f in examine(clean, known()) if f.gate == "clipping"]
    figure = figure_of("a", "b", [said.picture])
    names = (*clean.u_names, *clean.y_names)
    assert [word.strip() for _, word in figure.panels[0].x.ticks] == list(names)
    assert figure.legend() == ["converter"]
