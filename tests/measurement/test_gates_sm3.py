"""The gates on a real stepped-sine calibration (SM-3 seismometer, tychoaussie/Sigcal_v1).

Known of it beforehand: the column "Current" holds the signal coil, and one of the records is bad.
"""

from __future__ import annotations

import numpy as np
import pytest
from sm3 import sm3_campaign

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.gates import examine


@pytest.fixture(scope="module")
def findings(data):
    return examine(sm3_campaign(data / "seismometer_sm3"))


def of(findings, gate):
    return [f for f in findings if f.gate == gate]


def test_the_bad_record_is_named_with_its_reason(findings):
    bad = [f for f in findings if f.severity == "stop" and f.records and len(f.records) == 1]
    assert {f.records for f in bad} == {("0_2Hz",)}
    assert {f.gate for f in bad} == {"clipping", "stepped sine"}
    assert all(f.channels == ("Laser",) for f in bad)
    (clipped,) = of(findings, "clipping")
    assert "out of range" in clipped.sentence


def test_its_numbers_are_those_of_the_file(findings, data):
    """Counted without the gate: the laser leaves its range once per cycle of 5 s."""
    laser = np.genfromtxt(data / "seismometer_sm3" / "0_2Hz.csv", delimiter=",", skip_header=1, usecols=4)
    out = laser > 7.4e6
    (clipped,) = of(findings, "clipping")
    assert clipped.value == pytest.approx(out.sum(), abs=5)
    assert np.count_nonzero(np.diff(out.astype(int)) == 1) == 20
    assert "20 bursts" in clipped.sentence


def test_the_mislabelled_column_is_found_by_its_response(findings):
    (label,) = [f for f in of(findings, "stepped sine") if "is a sensor's output" in f.sentence]
    assert label.channels == ("Current", "SM-3 Z")
    assert "band-pass" in label.sentence


def test_the_silent_channel_is_dead(findings):
    dead = [f for f in of(findings, "dead channel") if f.severity == "stop"]
    assert [f.channels for f in dead] == [("SM-3 Z",)]


def test_nothing_else_is_alarming(findings):
    assert {f.gate for f in findings if f.severity in ("warning", "stop")} == {
        "clipping",
        "dead channel",
        "stepped sine",
    }


def test_good_records_alone_have_no_bad_one(data):
    campaign = sm3_campaign(data / "seismometer_sm3")
    good = campaign.only(tuple(r.header.name for r in campaign.records if r.header.name != "0_2Hz"))
    assert not [f for f in examine(good) if f.records and f.severity in ("warning", "stop") and len(f.records) == 1]


def test_reader_names_the_missing_column(tmp_path):
    (tmp_path / "1_0Hz.csv").write_text("Pt#,FuncGen,Seconds\n1,2,3\n2,3,4\n")
    with pytest.raises(InputError, match="SM-3 Z"):
        sm3_campaign(tmp_path)
