"""What a file may leave out: struct arrays ask no more than flat files, and the caller can say the rest."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io
from refusals import refused
from test_formats_matlab import Matlab73, both, cells, save

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Portion, in_short
from avis_ctrl.measurement.formats import parse_columns, read_measurements, write_campaign
from avis_ctrl.measurement.formats.records import with_header
from avis_ctrl.measurement.formats.stored import StoredRecord


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mat"


def record(rng, samples=200, **more):
    return {
        "u": rng.normal(size=(samples, 2)),
        "y": rng.normal(size=(samples, 3)),
        "t": np.arange(samples)[:, None] / 100.0,
    } | more


@both
def test_records_of_u_y_and_t_are_enough(path, rng, version):
    one, two = record(rng), record(rng, u=np.zeros((200, 2)))
    save(path, version, {"records": [one, two]})
    campaign = read_measurements(path)
    first, second = (r.header for r in campaign.records)
    assert campaign.rig == "unnamed" and campaign.sample_rate_Hz == 100.0
    assert campaign.u_names == ("u1", "u2") and campaign.y_names == ("y1", "y2", "y3") and campaign.y_unit == "V"
    assert (first.excitation, second.excitation, first.period_s) == ("noise", "rest", None)
    assert (first.start_s, second.start_s) == (0.0, 2.0)
    assert first.level_V == pytest.approx(np.sqrt(np.mean(one["u"] ** 2)), rel=1e-12) and second.level_V == 0.0
    assert isinstance(campaign.records[0], StoredRecord) == (version == "v7.3")
    np.testing.assert_array_equal(campaign.records[0].load().y, one["y"])
    for said in (
        "rig not stated",
        "u_names not stated",
        "unit of y not stated; taken as V",
        "100 Hz by t",
        "'rest': u is zero",
        "it follows the record before it",
    ):
        assert any(said in note for note in campaign.notes), said
    assert read_measurements(path, rig="avis").rig == "avis"


@both
@pytest.mark.parametrize("period", [0.0, np.nan, np.zeros((0, 0))], ids=["0", "NaN", "empty"])
def test_no_period_however_it_is_said(path, rng, version, period):
    save(path, version, {"records": [record(rng, period_s=period), record(rng, period_s=0.5)]})
    first, second = (r.header for r in read_measurements(path).records)
    assert (first.excitation, first.period_s) == ("noise", None)
    assert (second.excitation, second.period_s) == ("multisine", 0.5)


@both
def test_stated_starts_and_what_all_records_share(path, rng, version):
    one, two = record(rng, start_s=7.0), record(rng, start_s=50.0)
    del one["t"], two["t"]
    save(path, version, {"records": [one, two], "Fs": 50.0, "y_names": cells(["a", "b", "c"]), "y_unit": "mm/s"})
    campaign = read_measurements(path)
    assert [r.header.start_s for r in campaign.records] == [7.0, 50.0]
    assert campaign.sample_rate_Hz == 50.0 and campaign.y_names == ("a", "b", "c") and campaign.y_unit == "m/s"
    np.testing.assert_allclose(campaign.records[1].load().y, 1e-3 * two["y"], rtol=1e-15)


@both
def test_hints_hold_for_every_record(path, rng, version):
    one, two = record(rng, excitation=np.zeros((0, 0))), record(rng, excitation="noise")
    save(path, version, {"records": [one, two]})
    campaign = read_measurements(path, period_s=0.5, y_unit="mV", start_s=3.0)
    first, second = (r.header for r in campaign.records)
    assert (first.excitation, first.period_s, second.excitation, second.period_s) == ("multisine", 0.5, "noise", None)
    assert (first.start_s, second.start_s) == (3.0, 5.0)
    np.testing.assert_allclose(campaign.records[0].load().y, 1e-3 * one["y"], rtol=1e-15)


def test_level_of_a_long_record_on_disk_is_that_of_all_its_pieces(path, rng, monkeypatch):
    from avis_ctrl.measurement.formats import records

    monkeypatch.setattr(records, "SETTINGS", records.RecordSettings(piece=37))
    long = record(rng)
    long["u"][100:] *= 30
    Matlab73(path, {"records": long})
    assert read_measurements(path).records[0].header.level_V == pytest.approx(np.sqrt(np.mean(long["u"] ** 2)))
    long["u"][150, 1] = np.nan
    Matlab73(path, {"records": long})
    refused(r"record 00: u = nan: .* the first at sample 150 of channel u2", path)


@both
def test_everything_that_is_missing_is_said_at_once(path, rng, version):
    empty = np.zeros((0, 0))
    one = record(rng, t=empty, excitation="multisine")
    two = record(rng, y=empty, excitation="noise")
    save(path, version, {"records": [one, two]})
    with pytest.raises(InputError) as caught:
        read_measurements(path)
    assert str(caught.value).startswith(f"{path}: records: missing: ") and "\n" not in str(caught.value)
    for said in (
        "fs or a time vector t (record 00)",
        "y, the sensor signals (record 01)",
        "period_s, the period in s of a multisine (not 0 or NaN) (record 00)",
    ):
        assert said in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.zeros((200, 1))}, "record 00: t: expected increasing time stamps"),
        ({"sample_rate_Hz": 99.0}, "record 00: sample_rate_Hz = 99.0: expected 100 Hz, the rate of the time stamps"),
        ({"period_s": -1.0}, "record 00: period_s = -1.0: expected a positive period"),
        ({"excitation": "chirp"}, "record 00: excitation = 'chirp': expected one of multisine"),
        ({"y": np.zeros((100, 3))}, "record 00: expected equally many samples; u is 200x2, y is 100x3, t has 200"),
    ],
    ids=["time", "rate", "period", "excitation", "length"],
)
def test_what_is_wrong_is_still_refused(path, rng, change, message):
    scipy.io.savemat(path, {"records": record(rng, **change)})
    refused(message, path)


NAMES = parse_columns("u_names=A+B,y_names=p+q+r")


@pytest.mark.parametrize("kind", ["flat", "records", "csv", "hdf5"])
def test_channels_named_by_the_caller(tmp_path, rng, kind):
    one = record(rng)
    path = tmp_path / {"csv": "a.csv", "hdf5": "a.h5"}.get(kind, "a.mat")
    if kind == "csv":
        np.savetxt(
            path, np.hstack([one["t"], one["u"], one["y"]]), delimiter=",", comments="", header="t,u1,u2,y1,y2,y3"
        )
    else:
        scipy.io.savemat(tmp_path / "a.mat", one if kind == "flat" else {"records": one})
    if kind == "hdf5":
        write_campaign(path, read_measurements(tmp_path / "a.mat"))
    campaign = read_measurements(path, NAMES)
    assert campaign.u_names == ("A", "B") and campaign.y_names == ("p", "q", "r")
    np.testing.assert_allclose(campaign.records[0].load().y, one["y"], rtol=1e-15)
    refused("names", path, parse_columns("y_names=p+q"))


def test_a_variable_of_the_names_goes_before_the_names_themselves(path, rng):
    one = record(rng, labels=cells(["p", "q", "r"]))
    scipy.io.savemat(path, one)
    assert read_measurements(path, {"y_names": "labels"}).y_names == ("p", "q", "r")
    refused("y_names = 'lables': neither a variable nor a list of channel names", path, {"y_names": "lables"})


def test_a_part_of_a_record_can_be_renamed(path, rng):
    scipy.io.savemat(path, record(rng))
    part = Portion(read_measurements(path).records[0], 50, 150)
    renamed = with_header(part, y_names=("p", "q", "r"))
    assert renamed.header.y_names == renamed.load(10, 20).header.y_names == ("p", "q", "r")
    np.testing.assert_array_equal(renamed.load().y, part.load().y)


def test_names_tell_which_way_round_a_matrix_is(path, rng):
    u, y = rng.normal(size=(2, 4, 6))
    scipy.io.savemat(path, {"u": u, "y": y, "fs": 10.0, "rig": ""})
    np.testing.assert_array_equal(read_measurements(path, parse_columns("y_names=a+b+c+d")).records[0].load().y, y.T)
    np.testing.assert_array_equal(read_measurements(path, parse_columns("y_names=a+b+c+d+e+f")).records[0].load().y, y)


def test_frequency_responses_get_names_too(path, rng):
    scipy.io.savemat(
        path, {"frequency_Hz": np.arange(1.0, 8.0), "H": rng.normal(size=(7, 3, 2)), "variance": np.ones((7, 3, 2))}
    )
    response = read_measurements(path, NAMES)
    assert response.inputs == ("A", "B") and response.outputs == ("p", "q", "r")


def test_notes_that_say_the_same_of_several_records_are_one():
    notes = ("record 00: no unit", "taken as V", "record 01: no unit", "record 02: late", "y: no unit")
    assert in_short(notes) == ("records 00, 01: no unit", "taken as V", "record 02: late", "y: no unit")


@pytest.mark.parametrize("name", ["a.py", "a.md", "a.M", "a.txt", "a"])
def test_texts_that_are_no_measurements(tmp_path, name):
    path = tmp_path / name
    path.write_text("import h5py, numpy\n\nprint(1, 2)\n")
    refused("not a measurement file", path)


def test_a_table_whose_columns_have_other_names_is_one(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("volts;force\n0,1;2,0\n0,2;3,0\n")
    refused(r"y = .*: expected at least one column; the file has volts, force", path)
