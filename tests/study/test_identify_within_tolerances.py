"""`avis identify` on a table that is off its rig file in everything, by an independent simulator."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from truth.cases import build_plant, draw_case, simulate_case

from avis_ctrl.identification.predictor import predict
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.study.identification import IdentifyOptions, identify
from avis_ctrl.study.identification_output import write_identification, write_predictions

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def case():
    return draw_case(12, kind="none", duration_s=30.0, clutter=True)


@pytest.fixture(scope="module")
def campaign(case):
    return simulate_case(case)


@pytest.fixture(scope="module")
def found(campaign):
    return identify(campaign, replace(load_rig("avis"), tolerances=Tolerances()), IdentifyOptions(starts=1))


def test_parameters_lie_within_their_standard_deviations(case, found):
    """Those of the table without its traces, which are what no parameter stands for."""
    plant, information = build_plant(replace(case, traces=())), found.information
    truth = {"mass": plant.m, **{f"J{k + 1}": plant.J[k, k] for k in range(3)}}
    truth |= {
        f"isolator{k + 1}.{kind}_z": values[k, 2] for kind, values in (("k", plant.k), ("c", plant.c)) for k in range(4)
    }
    at = [information.names.index(name) for name in truth]
    error = information.values[at] - np.array(list(truth.values()))
    assert np.all(np.abs(error) < 4 * information.standard_deviation[at])
    assert np.all(information.standard_deviation[at] < 0.02 * information.values[at])


def test_the_error_on_held_out_records_falls(found):
    (held,) = found.validation.held_out
    assert held.nrms_all < 0.1 * held.nrms_all_exact
    assert any("taken as exact" in sentence for sentence in found.validation.sentences)


def test_the_folder_predicts_what_the_fitted_model_does(campaign, found, tmp_path):
    """Tolerances come back from the files, the geophones' corners among them, which no rig file has a place for."""
    write_identification(found, tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    moved = [abs(one["tolerances_moved"]) for one in told["tolerances"]]
    assert len(moved) == 114 and moved == sorted(moved, reverse=True)
    write_predictions(tmp_path, campaign.only(("02",)), tmp_path / "p.h5")
    with h5py.File(tmp_path / "p.h5") as file:
        y = file["records/02/y"][:]
    expected = predict(found.model, campaign.named("02").load())
    assert np.allclose(y, expected, rtol=0, atol=1e-8 * np.ptp(expected))


def test_a_suspension_that_its_filter_does_not_match_is_the_same_in_time_and_frequency():
    """Response of the realised chain against the model's own ratio of polynomials."""
    model = ResponseModel.of(load_rig("avis"), ("corner.Sz1", "damping.Sy3"))
    moved = model.at(model.values * [1.03, 0.9])
    omega = 2 * np.pi * np.geomspace(0.2, 100, 30)
    off = moved.sensors.sense(omega) / model.sensors.sense(omega)
    assert np.max(np.abs(off - 1)) > 0.03
    assert np.allclose(moved.sensors.realised.sense(omega), moved.sensors.sense(omega), rtol=1e-9)
