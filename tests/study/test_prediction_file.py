"""Errors of predictions against what was measured, by hand."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.study.prediction_file import compared, prediction_errors


@pytest.fixture
def predicted(tmp_path):
    """A campaign of two records, and a file of predictions of it, off by known shares."""
    rng, records, path = np.random.default_rng(1), [], tmp_path / "p.h5"
    with h5py.File(path, "w") as file:
        for k, (a, b) in enumerate(((0.3, 0.01), (0.5, 0.02))):
            y = rng.standard_normal((400, 2))
            y = (y - y.mean(axis=0)) * [1.0, 1e-3]
            header = RecordHeader(f"{k:02d}", 1000.0, 400, ("u1",), ("Sy1", "Sz1"), "noise", 0.1)
            records.append(Record(header, np.zeros((400, 1)), y, None))
            file[f"records/{k:02d}/y_baseline"] = (1 + a) * y + 7.0
            file[f"records/{k:02d}/y_updated"] = (1 - b) * y
    return path, Campaign("avis", tuple(records))


def test_each_channel_counts_alike_and_means_do_not(predicted):
    found = list(prediction_errors(*predicted))
    assert [one.record for one in found] == ["00", "01"]
    for one, (a, b) in zip(found, ((0.3, 0.01), (0.5, 0.02)), strict=True):
        assert one.relative == pytest.approx({"y_baseline": a, "y_updated": b})
    assert compared(found) == ""


def test_a_worse_model_and_the_same_model_are_called_so(predicted):
    path, campaign = predicted
    with h5py.File(path, "r+") as file:
        for group in file["records"].values():
            group["y_updated"][...] = 3 * group["y_baseline"][()]
    assert "larger error than the baseline" in compared(list(prediction_errors(path, campaign)))
    with h5py.File(path, "r+") as file:
        for group in file["records"].values():
            group["y_updated"][...] = group["y_baseline"][()]
    assert "the same" in compared(list(prediction_errors(path, campaign)))


def test_noise_is_what_differs_between_the_periods_after_the_first(tmp_path):
    """A period that repeats, a start that does not, and noise of a known r.m.s.: 3 % and 4 % of the channels' y."""
    rng, periods, samples = np.random.default_rng(2), 6, 2000
    wave = rng.standard_normal((samples, 2)) * [1.0, 1e-3]
    y = np.tile(wave, (periods, 1))
    noise = rng.standard_normal(y.shape) * [0.03, 0.04e-3]
    y[:samples] *= np.linspace(0, 1, samples)[:, None]
    header = RecordHeader("00", 1000.0, len(y), ("u1",), ("Sy1", "Sz1"), "multisine", 0.1, period_s=2.0)
    plain = Record(header, np.zeros((len(y), 1)), y + noise, None)
    path = tmp_path / "p.h5"
    with h5py.File(path, "w") as file:
        file["records/00/y"] = y
    (one,) = prediction_errors(path, Campaign("avis", (plain,)))
    size = np.std(plain.y, axis=0)
    assert one.noise == pytest.approx(np.sqrt(np.mean(([0.03, 0.04e-3] / size) ** 2)), rel=0.03)
    assert one.noise == pytest.approx(one.relative["y"], rel=0.05)


def test_without_periods_or_a_record_at_rest_there_is_no_noise(predicted):
    assert all(one.noise is None for one in prediction_errors(*predicted))


def test_noise_of_a_record_without_periods_is_that_at_rest(predicted):
    """Two records at rest, of 3 % and 4 % of the signals of the others in each channel: their power is averaged."""
    path, campaign = predicted
    rng, size = np.random.default_rng(3), np.std(campaign.records[0].y, axis=0)
    rest = []
    with h5py.File(path, "r+") as file:
        for name, part in (("02", 0.03), ("03", 0.04)):
            header = RecordHeader(name, 1000.0, 4000, ("u1",), ("Sy1", "Sz1"), "rest")
            y = rng.standard_normal((4000, 2)) * part * size
            rest.append(Record(header, np.zeros((4000, 1)), y, None))
            file[f"records/{name}/y_baseline"] = np.zeros_like(y)
    found = list(prediction_errors(path, Campaign("avis", (*campaign.records, *rest))))
    assert found[0].noise == pytest.approx(np.sqrt((0.03**2 + 0.04**2) / 2), rel=0.03)
    # A prediction of zero leaves the whole signal of a record at rest.
    assert found[2].relative["y_baseline"] == pytest.approx(1.0)
    assert found[2].noise == pytest.approx(np.sqrt((0.03**2 + 0.04**2) / 2) / 0.03, rel=0.03)
