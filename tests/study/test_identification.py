"""`avis identify` as a whole on a simulated campaign: truth found, files written, another campaign predicted."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats import read_measurements, write_campaign
from avis_ctrl.measurement.frequency_response.local_polynomial import local_polynomial
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.perturbed_campaign import perturbed_campaign
from avis_ctrl.study.design_file import design_from_table
from avis_ctrl.study.file_names import DESIGN_FILE, RIG_FILE
from avis_ctrl.study.identification import Identification, IdentifyOptions, identify
from avis_ctrl.study.identification_design import assumed_weights, design_start
from avis_ctrl.study.identification_output import (
    PredictionSettings,
    read_identified,
    write_identification,
    write_predictions,
)
from avis_ctrl.study.plan_file import default_plan

FEW = IdentifyOptions(starts=1)


@pytest.fixture(scope="module")
def simulated():
    rig = load_rig("avis")
    return perturbed_campaign(rig, default_plan(rig, perturbed=True, duration_s=20.0), seed=3)


@pytest.fixture(scope="module")
def found(simulated) -> Identification:
    return identify(simulated.campaign, load_rig("avis"), FEW)


def test_the_truth_lies_within_the_standard_deviations(simulated, found):
    """Every determined direction, and each parameter that is known by itself."""
    information = found.campaign_fit.information
    truth = np.array([simulated.truth.parameters()[name].value for name in information.names])
    sigma, V = information.directions
    z = (V.T @ ((information.values - truth) / information.scale) / sigma)[information.determined]
    assert information.rank == 20
    assert np.mean(z**2) < 2.5 and np.max(np.abs(z)) < 4.5
    alone = information.known
    assert np.all(np.abs(information.values - truth)[alone] < 5 * information.standard_deviation[alone])
    start = np.array([found.start.parameters()[name].value for name in information.names])
    assert np.max(np.abs(start / truth - 1)) > 0.04


@pytest.mark.slow
def test_a_design_whose_weights_nobody_stated_says_for_which_table_they_are(found):
    text = design_start(found)[0][DESIGN_FILE]
    assert text.startswith("# No weights were specified for this table.")
    assert '\n#   shipped: "avis", 500 kg, modes from 1.94 to 5.24 Hz\n#   this table: "avis", ' in text
    stated = design_from_table(tomllib.loads(text))
    assert stated.rig == RIG_FILE
    assert not design_start(found, stated)[0][DESIGN_FILE].startswith("#")


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        (
            "designs/rigs/skewed.toml",
            (
                'shipped: "avis", 500 kg, modes from 1.94 to 5.24 Hz',
                'this table: "skewed", 120 kg, modes from 7.54 to 15.6 Hz',
            ),
        ),
        ("halcyonics", ('shipped: "halcyonics", 29.3 kg', 'this table: "halcyonics", 19.3 kg')),
    ],
)
def test_the_comparison_of_tables_is_a_comment(name, lines):
    path = Path(__file__).resolve().parents[2] / name
    text = assumed_weights(load_rig(path if path.is_file() else name))
    assert all(line in text for line in lines) and tomllib.loads(text) == {}


def test_a_result_says_what_it_is_made_of(found):
    p = found.provenance
    assert len(p["measurement_sha256"]) == 64 and p["seed"] == 1 and p["avis_ctrl"]
    assert found.split is not None and "held out" in found.split.how
    assert "%" in found.validation.verdict


def test_files_and_predictions(simulated, found, tmp_path):
    """The folder is read back, and predicts the records that it was made from down to their noise."""
    write_identification(found, tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["format"] == "avis-identification" and result["rank"] == 20
    assert result["parameters"]["mass"]["std"] > 0 and result["parameters"]["isolator1.k_x"]["std"] is None
    rig, known = read_identified(tmp_path)
    assert known.amplifier_corner_Hz is None and known.turning == (0, 0)
    assert rig.parameters()["mass"].value == pytest.approx(found.rig.parameters()["mass"].value, rel=1e-14)
    assert "+-" in (tmp_path / "rig.toml").read_text()
    one = simulated.campaign.only(("02",))
    write_predictions(tmp_path, one, tmp_path / "pred.h5")
    record = one.records[0].load()
    with h5py.File(tmp_path / "pred.h5") as file:
        y = file["records/02/y"][:]
        assert file["records/02/y"].attrs["unit"] == "V"
    left = np.std(y - record.y, axis=0) / np.std(record.y, axis=0)
    assert np.all(left < 0.02)


def test_a_long_record_is_predicted_piece_by_piece_as_in_one(simulated, found, tmp_path, monkeypatch):
    """Against an independent march over all samples at once: each piece goes on where the last one stopped."""
    write_identification(found, tmp_path)
    one = simulated.campaign.only(("02",))
    write_predictions(tmp_path, one, tmp_path / "whole.h5")
    monkeypatch.setattr("avis_ctrl.study.identification_output.SETTINGS", PredictionSettings(piece=3001))
    write_predictions(tmp_path, one, tmp_path / "pieces.h5")
    with h5py.File(tmp_path / "whole.h5") as whole, h5py.File(tmp_path / "pieces.h5") as pieces:
        y, again = whole["records/02/y"][:], pieces["records/02/y"][:]
    assert len(y) == 20000 and np.ptp(y[15000:]) > 0.1
    assert np.allclose(again, y, rtol=0, atol=1e-9 * np.ptp(y))


@pytest.mark.slow
def test_frequency_responses_serve_as_well_as_records(simulated):
    """The campaign reduced to frequency responses: a third of the lines is held out."""
    rig = load_rig("avis")
    plan = default_plan(rig, "orthogonal", perturbed=True, duration_s=20.0)
    campaign = perturbed_campaign(rig, plan, seed=5).campaign
    driven = tuple(r.header.name for r in campaign.records if r.header.excitation == "multisine")[-8:]
    measured = local_polynomial(campaign.only(driven), band_Hz=(1.0, 40.0), floor=False)
    found = identify(measured, rig, FEW)
    assert found.campaign_fit.fit.information.rank == 20
    assert found.findings == () and found.split is None


def test_hold_out_and_parameters_as_asked(simulated):
    options = IdentifyOptions(starts=1, hold_out=("03",), parameters=("mass", "J?"), band_Hz=(1.0, 20.0))
    found = identify(simulated.campaign.only(("02", "03", "04")), simulated.truth, options)
    assert [one.header.name for one in found.split.held_out.records] == ["03"]
    assert found.model.names == ("mass", "J1", "J2", "J3")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"hold_out": ("09",)}, "09"),
        ({"hold_out": ("00", "01", "02", "03", "04", "05", "06")}, "not all"),
        ({"parameters": ("weight*",)}, "weight"),
        ({"parameters": ("mass", "corner.Sz1")}, "one suspension for all"),
        ({"priors": {"weight": (1.0, 1.0)}}, "weight"),
        ({"band_Hz": (300.0, 300.001)}, "band"),
        ({"band_Hz": (200.0, 400.0)}, r"excited from [\d.]+ to \d+(\.\d)? Hz; expected a band that overlaps"),
    ],
)
def test_options_that_do_not_fit_are_answered(simulated, change, said):
    with pytest.raises(InputError, match=said) as error:
        identify(simulated.campaign, load_rig("avis"), IdentifyOptions(**({"starts": 1} | change)))
    assert "\n" not in str(error.value)


def test_another_rig_is_refused_by_name(simulated):
    with pytest.raises(InputError, match="sensors of the rig halcyonics"):
        identify(simulated.campaign, load_rig("halcyonics"), FEW)


def test_a_gate_that_says_stop_stops(simulated):
    """A dead channel; and going on all the same is possible only as far as the data allow."""
    record = simulated.campaign.named("02").load()
    y = record.y.copy()
    y[:, 1] = 0.5
    broken = Campaign("avis", (type(record)(record.header, record.u, y, record.floor),))
    with pytest.raises(InputError, match="Sz1"):
        identify(broken, load_rig("avis"), FEW)


@pytest.mark.slow
def test_a_campaign_through_a_file_gives_the_same(simulated, found, tmp_path):
    write_campaign(tmp_path / "c.h5", simulated.campaign)
    again = identify(read_measurements(tmp_path / "c.h5"), load_rig("avis"), FEW)
    assert np.array_equal(again.campaign_fit.fit.values, found.campaign_fit.fit.values)
    assert again.provenance["measurement_sha256"] == found.provenance["measurement_sha256"]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("result.json", None, "avis identify or avis gap"),
        ("result.json", "{", "JSON"),
        ("result.json", "[]", "avis-identification.*avis identify or avis gap"),
        ("rig.toml", None, "rig.toml"),
    ],
)
def test_a_folder_that_is_none_is_answered(found, tmp_path, name, content, said):
    write_identification(found, tmp_path)
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=said):
        read_identified(tmp_path)
