"""Sensors of every kind side by side: response, its derivatives, prediction in time, and the model with effects."""

from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.predictor import Predictor
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan

RIGS = Path(__file__).parents[2] / "designs" / "rigs"
OMEGA = 2 * np.pi * np.array([0.7, 2.0, 10.0, 50.0])
QUIET = {
    "duration_s": 2.0,
    "settle_s": 0.0,
    "amplifier_corner_Hz": 300.0,
    "ambient": {"velocity_rms_m_per_s": 0.0},
    "sensors": {"noise": False, "quantiser": False},
    "truth": {"nonlinear": False},
}


def model_of(name, *parameters):
    rig = load_rig(RIGS / f"{name}.toml")
    first, last = rig.sensors()[0].name, rig.sensors()[-1].name
    free = (
        "mass",
        "com_x",
        "isolator1.k_z",
        "isolator2.c_x",
        f"actuator.{rig.all_drives[0].name}",
        f"sensor.{first}",
        f"sensor.{last}",
        "amplifier_time_constant_s",
        *parameters,
    )
    return ResponseModel.of(rig, free, amplifier_corner_Hz=300.0)


@pytest.mark.parametrize("name", ["granite", "twelve_sensors"])
def test_derivatives_of_the_response(name, rng):
    model = model_of(name)
    U = rng.normal(size=(len(OMEGA), len(model.inputs) + 12, 1)) + 0j
    found = model.driven(OMEGA, U)
    for j, size in enumerate(model.scales()):
        step = 1e-5 * size * np.eye(len(model.names))[j]
        ends = [model.at(model.values + sign * step).driven(OMEGA, U, False).Y for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2e-5 * size)
        assert np.allclose(found.dY[j], slope, atol=2e-5 * np.abs(slope).max()), model.names[j]


@pytest.mark.parametrize("name", ["granite", "twelve_sensors", "skewed"])
@pytest.mark.parametrize("record", [{"excitation": "noise"}, {"excitation": "floor", "floor_rms_m_per_s": 1e-4}])
def test_what_is_predicted_is_what_the_simulator_reads(name, record):
    model = model_of(name)
    campaign = simulate_campaign(model.rig, CampaignPlan.model_validate(QUIET | {"record": [record]}), 3)
    one = campaign.records[0]
    y = Predictor(model).read(one.u, one.floor)
    assert np.sqrt(np.mean((y - one.y) ** 2, axis=0)).max() < 1e-9 * np.sqrt(np.mean(one.y**2))


@pytest.mark.parametrize("name", ["granite", "twelve_sensors"])
def test_the_model_with_effects_starts_as_the_model_without(name, rng):
    model = model_of(name)
    table = TableModel(model)
    U = rng.normal(size=(len(OMEGA), len(model.inputs), 2)) + 0j
    plain, with_effects = model.driven(OMEGA, U), table.driven(OMEGA, U)
    assert np.allclose(with_effects.Y, plain.Y, rtol=1e-9, atol=1e-12 * np.abs(plain.Y).max())
    for j, name_of in enumerate(model.names):
        size = np.abs(plain.dY[j]).max()
        assert np.allclose(with_effects.dY[j], plain.dY[j], atol=1e-8 * size), name_of
