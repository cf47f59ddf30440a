"""Clocks of u and y that differ: simulated by a sensor signal read at other instants, of known rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gates_rig import RATE, known, multisine_campaign, noise_campaign
from scipy.interpolate import make_interp_spline

from avis_ctrl.measurement.gates import examine
from avis_ctrl.measurement.gates.sample_clock import no_constant_delay


def read_by(campaign, rates):
    """The campaign with y read at t (1 - rate): a clock of y that runs faster by this fraction."""
    records = []
    for source, rate in zip(campaign.records, rates, strict=True):
        record = source.load()
        t = np.arange(len(record.y)) / RATE
        records.append(replace(record, y=make_interp_spline(t, record.y, k=5)(np.clip(t * (1 - rate), 0, t[-1]))))
    return replace(campaign, records=tuple(records))


def clock(campaign):
    (found,) = [f for f in examine(campaign, known()) if f.gate == "sample clock"]
    return found


@pytest.fixture(scope="module", params=[multisine_campaign, lambda seed: noise_campaign(seed, 16000)])
def clean(request):
    return request.param(4)


def test_one_clock_passes(clean):
    assert clock(clean).severity == "ok" and not no_constant_delay(clean)


@pytest.mark.parametrize("sign", [1, -1])
def test_two_clocks_are_a_stop_that_states_their_rates(clean, sign):
    seconds = clean.records[0].header.duration_s
    rate = sign * 0.015 / seconds  # 15 ms at the end
    found = clock(read_by(clean, [rate] * len(clean.records)))
    assert found.severity == "stop" and not found.records
    assert ("faster" if sign > 0 else "slower") in found.sentence
    percent = float(found.sentence.split("runs about ")[1].split(" %")[0])
    assert percent == pytest.approx(100 * abs(rate), rel=0.2)
    assert no_constant_delay(read_by(clean, [rate] * len(clean.records)))


def test_other_rates_in_other_records_are_not_called_two_clocks(clean):
    seconds, n = clean.records[0].header.duration_s, len(clean.records)
    found = clock(read_by(clean, np.linspace(0.004, 0.015, n) / seconds))
    driven = [one.header.name for one in clean.records if np.any(one.load().u)]
    assert found.severity == "stop" and list(found.records) == driven
    assert "not locked" in found.sentence


def test_a_small_difference_is_a_warning(clean):
    rate = 0.0006 / clean.records[0].header.duration_s
    found = clock(read_by(clean, [rate] * len(clean.records)))
    assert found.severity == "warning" and not no_constant_delay(clean)


def test_lost_samples_that_follow_from_two_clocks_are_notes():
    campaign = noise_campaign(4)
    rate = 0.03 / campaign.records[0].header.duration_s
    found = examine(read_by(campaign, [rate] * len(campaign.records)), known())
    assert {f.gate for f in found if f.severity in ("warning", "stop")} <= {"sample clock", "channel order", "polarity"}
