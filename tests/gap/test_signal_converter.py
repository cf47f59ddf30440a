"""Converters coarser or clipping lower than the rig file says, on exact simulated campaigns; and repair."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from signal_campaigns import LSB, convert, draw, rig

from avis_ctrl.errors import InputError
from avis_ctrl.gap.signals.converter import inspect_converter
from avis_ctrl.gap.signals.declipping import repair
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader

SHORT = 20_000


def one_record(y: np.ndarray, u: np.ndarray | None = None, unit: str = "V") -> Campaign:
    u = np.zeros((len(y), 8)) if u is None else u
    header = RecordHeader(
        "00", 1000.0, len(y), tuple(m.name for m in rig().motors), rig().geophones.names, "rest", y_unit=unit
    )
    return Campaign("avis", (Record(header, u, y),))


@pytest.mark.parametrize("kind", ["multisine", "noise"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_clean_channels_give_no_finding_even_where_they_reach_the_nominal_limits(kind, seed):
    campaign, _ = draw(seed, kind, levels=(0.0, 0.2, 2.0), samples=SHORT)
    assert max(np.abs(r.y).max() for r in campaign.records) > 9.99
    assert inspect_converter(campaign, rig()) == ()


def test_quiet_white_noise_is_no_coarse_converter():
    """0.8 lsb r.m.s.: few codes. 300 channels and rest records."""
    found = [
        inspect_converter(one_record(convert(np.random.default_rng(k).normal(0, 1e-3, (5000, 6)))), rig())
        for k in range(50)
    ]
    assert not any(found)


def test_a_smooth_sine_is_no_coarse_converter():
    """The characteristic function of a sine is a Bessel function, which decays slowly."""
    t = np.arange(SHORT) / 1000.0
    y = np.stack([a * np.sin(2 * np.pi * 3.7 * t + a) for a in (0.02, 0.05, 0.1, 1.0, 4.0, 9.0)], 1)
    y += np.random.default_rng(1).normal(0, 1e-3, y.shape)
    assert inspect_converter(one_record(convert(y)), rig()) == ()


@settings(max_examples=25, deadline=None)
@given(step=st.floats(2.0, 250.0), offset=st.floats(-0.4, 0.4), seed=st.integers(0, 1000), again=st.booleans())
def test_a_coarse_step_is_measured_whether_or_not_the_nominal_converter_follows(step, offset, seed, again):
    q, rng = step * LSB, np.random.default_rng(seed)
    y = np.cumsum(rng.normal(0, 0.1, (SHORT, 6)), axis=0)
    y = 3 * y / np.abs(y).max() + rng.normal(0, 1e-3, y.shape)
    clean = convert(y)
    coarse = q * np.floor(y[:, 2] / q + 0.5 + offset)
    clean[:, 2] = convert(coarse) if again else coarse
    found = inspect_converter(one_record(clean), rig())
    assert [(one.channel, one.kind) for one in found] == [("Sx2", "resolution")]
    value = found[0].parameters["resolution_V"]
    assert abs(value.value - q) <= max(4 * value.std, 1e-9)
    assert value.std < 0.01 * q


@pytest.mark.parametrize("step", [3, 8.3, 16])
def test_a_coarse_step_shows_at_rest_too(step):
    def adc(y):
        z = y.copy()
        z[:, 1] = step * LSB * np.floor(z[:, 1] / (step * LSB) + 0.5)
        return convert(z)

    campaign, _ = draw(5, levels=(0.0, 0.0), samples=SHORT, adc=adc)
    found = inspect_converter(campaign, rig())
    assert [(one.channel, one.kind) for one in found] == [("Sz1", "resolution")]
    assert found[0].parameters["resolution_V"].value == pytest.approx(step * LSB, rel=0.05)


@pytest.mark.parametrize("kind", ["multisine", "noise"])
@pytest.mark.parametrize("both", [True, False])
def test_a_low_clip_level_is_measured(kind, both):
    def adc(y):
        z = y.copy()
        z[:, 3] = np.clip(z[:, 3], -1.3 if both else -99.0, 1.3)
        return convert(z)

    campaign, _ = draw(7, kind, levels=(0.1, 0.2, 0.5), samples=SHORT, adc=adc)
    found = inspect_converter(campaign, rig())
    assert [(one.channel, one.kind) for one in found] == [("Sz2", "clipping")]
    assert set(found[0].parameters) == ({"clip_low_V", "clip_high_V"} if both else {"clip_high_V"})
    for value in found[0].parameters.values():
        assert abs(abs(value.value) - 1.3) <= LSB
    clipped = sum(
        np.count_nonzero(np.abs(r.y[:, 3]) >= 1.299) if both else np.count_nonzero(r.y[:, 3] >= 1.299)
        for r in campaign.records
    )
    assert f", {clipped} samples of" in found[0].sentence


def test_repair_puts_the_prediction_beyond_the_limit_and_nowhere_else():
    def adc(y):
        z = y.copy()
        z[:, 3] = np.clip(z[:, 3], -1.3, 1.3)
        return convert(z)

    campaign, predicted = draw(7, "noise", levels=(0.1, 0.5), samples=SHORT, adc=adc)
    truth, _ = draw(7, "noise", levels=(0.1, 0.5), samples=SHORT)
    made = repair(campaign, rig(), predicted, inspect_converter(campaign, rig()))
    for before, after, true in zip(campaign.records, made.campaign.records, truth.records, strict=True):
        assert np.array_equal(np.delete(before.y, 3, 1), np.delete(after.y, 3, 1))
        changed = before.y[:, 3] != after.y[:, 3]
        assert np.all(np.abs(before.y[changed, 3]) > 1.299)
        # What the model does not know of the true sample is noise and floor, some 10 mV.
        assert np.std(after.y[:, 3] - true.y[:, 3]) < 0.01
    error = [np.std(b.y[:, 3] - t.y[:, 3]) for b, t in zip(campaign.records, truth.records, strict=True)]
    assert max(error) > 0.5
    assert made.clipped["Sz2"] > 0


def test_the_drive_is_held_at_its_limit():
    u = np.tile([-14.0, 3.0, 9.0, 10.5], (4, 2))
    made = repair(one_record(np.zeros((4, 6)), u), rig())
    assert np.array_equal(made.campaign.records[0].load().u, np.tile([-10.0, 3.0, 9.0, 10.0], (4, 2)))


def test_memory_does_not_grow_with_the_number_of_records():
    class Loaded(Record):
        """A record whose samples exist only while it is loaded."""

        def load(self, *part):
            return Record(self.header, self.u, convert(np.random.default_rng(1).normal(0, 1.0, (100_000, 6))))

    u, y = (np.broadcast_to(0.0, (100_000, channels)) for channels in (8, 6))
    header = one_record(y, u).records[0].header

    def peak(records: int) -> int:
        campaign = Campaign("avis", tuple(Loaded(replace(header, name=f"{k}"), u, y) for k in range(records)))
        tracemalloc.start()
        assert inspect_converter(campaign, rig()) == ()
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    assert peak(8) < 1.5 * peak(2)


def test_wrong_input_is_refused_by_name():
    for of_volts in (inspect_converter, repair):
        with pytest.raises(InputError, match="expected V"):
            of_volts(one_record(np.zeros((100, 6)), unit="m/s"), rig())
