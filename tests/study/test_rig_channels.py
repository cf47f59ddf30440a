"""A measurement in the words of the rig: what is taken, what is refused, and what the refusal says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader, digest
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs import load_rig
from avis_ctrl.study.rig_channels import numbered, with_rig_names


def campaign(u_names, y_names, rig="unnamed", rate_Hz=1000.0):
    rng = np.random.default_rng(3)
    header = RecordHeader("00", rate_Hz, 50, tuple(u_names), tuple(y_names), "noise")
    return Campaign(rig, (Record(header, rng.normal(size=(50, len(u_names))), rng.normal(size=(50, len(y_names)))),))


@pytest.fixture(scope="module")
def rig():
    return load_rig("avis")


def test_numbered_channels_are_the_rigs_own_in_its_order(rig):
    raw = campaign(numbered("u", 8), numbered("qm", 6))
    with pytest.raises(InputError, match="qm1"):
        with_rig_names(rig, raw)
    taken = with_rig_names(rig, raw, {"y": ["qm"]})
    assert taken.u_names == rig.equations_of_motion().actuators and taken.y_names == rig.sensor_rows()[0]
    np.testing.assert_array_equal(taken.records[0].load().y, raw.records[0].load().y)
    assert taken.rig == "avis" and len(taken.notes) == 3
    assert all("avis" in note for note in taken.notes)
    again = with_rig_names(rig, taken)
    assert again.notes == taken.notes and digest(again) == digest(taken)


def test_what_has_names_stays_as_it_is(rig):
    stated = campaign(("Az4", "Ay1"), ("Sz3", "Sy1"), "another")
    same = with_rig_names(rig, stated)
    assert digest(same) == digest(stated) and with_rig_names(rig, same).notes == same.notes
    assert same.notes == (
        "the file has no column for the rig's drives Az1, Ax2, Az2, Ay3, Az3, Ax4",
        "the file has no column for the rig's sensors Sz1, Sx2, Sz2, Sy3",
        "the records are of the rig another, according to their file; the model is avis",
    )


@pytest.mark.parametrize("y_names", [numbered("y", 5), numbered("S", 6), ("y2", "y1", "y3", "y4", "y5", "y6")])
def test_other_channels_are_refused_with_what_to_do(rig, y_names):
    with pytest.raises(InputError, match=r"y names = .*the sensors of the rig avis are Sy1") as caught:
        with_rig_names(rig, campaign(numbered("u", 8), y_names))
    assert "--columns y_names=Sy1+Sz1+..." in str(caught.value) and "u_names" not in str(caught.value)
    assert "campaign of" not in str(caught.value)


def test_a_campaign_of_another_rig_says_so_and_both_roles_at_once(rig):
    own = campaign(rig.equations_of_motion().actuators, rig.sensor_rows()[0], "avis")
    with pytest.raises(InputError, match="the file is a campaign of avis") as caught:
        with_rig_names(load_rig("halcyonics"), own)
    for said in (
        "the actuators of the rig halcyonics are A1",
        "the sensors of the rig halcyonics are acc_A1",
        "not of halcyonics",
    ):
        assert said in str(caught.value)


@pytest.mark.parametrize(
    "rate_Hz, said", [(1.0, "time stamps in ms"), (1e6, "sample_rate_Hz in kHz"), (500.0, "change sample_rate_Hz")]
)
def test_another_sample_rate_is_refused_before_any_computation(rig, rate_Hz, said):
    own = campaign(rig.equations_of_motion().actuators, rig.sensor_rows()[0], rate_Hz=rate_Hz)
    with pytest.raises(InputError, match=f"sample_rate_Hz = {rate_Hz}: expected 1000 Hz, as in the rig file; .*{said}"):
        with_rig_names(rig, own)


def test_frequency_responses_too(rig):
    frequency = np.arange(1.0, 6.0)
    value = np.ones((5, 6, 8), complex)
    response = FrequencyResponse(
        frequency, value, None, None, numbered("u", 8), numbered("y", 6), "V", "V", entry_variance=np.ones(value.shape)
    )
    taken = with_rig_names(rig, response)
    assert taken.outputs == rig.sensor_rows()[0] and taken.inputs == rig.equations_of_motion().actuators
    assert with_rig_names(rig, replace(taken, inputs=(*taken.inputs[:7], "vz"))).inputs[-1] == "vz"
