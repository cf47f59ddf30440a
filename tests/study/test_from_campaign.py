"""From a simulated campaign to a certified controller, judged on the table that the identification was not told."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.response_error import kept_axes
from avis_ctrl.lti.norms import hinf_norm
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.perturbed_campaign import perturbed_truth
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.other_axes import design_companions
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.simulation import bare_loop

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).resolve().parents[2] / "designs" / "from_campaign.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The script's own run: some 40 s."""
    folder = tmp_path_factory.mktemp("from_campaign")
    runpy.run_path(str(SCRIPT))["main"](str(folder))
    return folder


@pytest.fixture(scope="module")
def truth():
    """The table that moved; the script's seed."""
    return perturbed_truth(load_rig("avis"), 5.0, 20.0, 3)


@pytest.fixture(scope="module")
def study(folder):
    design, rig = read_study(folder / "identified" / "design.toml")
    return design, rig, build_plant(design, rig)


def controller(folder) -> StateSpace:
    stored = json.loads((folder / "design" / "controllers" / "mu.json").read_text(encoding="utf-8"))
    return StateSpace(
        *(np.array(stored[key]) for key in "ABCD"), 0.0, tuple(stored["inputs"]), tuple(stored["outputs"])
    )


def test_every_requirement_is_met(folder):
    result = json.loads((folder / "design" / "result.json").read_text(encoding="utf-8"))
    names = [row["name"] for row in result["requirements"]]
    assert len(names) == 4 + 3 and sum("offset" in name for name in names) == 1
    assert result["simulation"]["passed"]
    report = (folder / "design" / "report.html").read_text(encoding="utf-8")
    assert "Uncertainty from the identification" in report
    assert not [row["name"] for row in result["requirements"] if not row["met"]]


def test_the_true_table_lies_inside_the_spread_at_every_frequency(study, truth):
    """In the kept coordinates and in six degrees of freedom; outside the measured band too."""
    _, rig, plant = study
    weight, omega = plant.weights["identified response"], 2 * np.pi * np.geomspace(0.1, 200, 400)
    models = [ResponseModel.of(one, ()) for one in (rig, truth)]
    A, D = kept_axes(rig, ("z", "phi_x"), models[0].actuators, models[0].sensors.names)
    own, true = (D @ one.response(omega)[:, :, :8] @ A for one in models)
    L = np.linalg.norm(np.linalg.solve(own, true - own), ord=2, axis=(1, 2))
    assert np.all(weight.magnitude(omega) >= L)
    # The rig file that the identification began with does not.
    start = D @ ResponseModel.of(load_rig("avis"), ()).response(omega)[:, :, :8] @ A
    assert np.any(np.linalg.norm(np.linalg.solve(own, start - own), ord=2, axis=(1, 2)) > weight.magnitude(omega))


def test_the_true_parameters_lie_inside_the_directions(study, truth):
    design, rig, plant = study
    content, found = design.uncertainty.identification, plant.identified.found
    known, true = rig.parameters(), truth.parameters()
    step = np.array([true[name].value - known[name].value for name in content.names])
    white = np.linalg.pinv(content.factor() / content.scale[:, None]) @ (step / content.scale)
    # Standard normal numbers, as many as are determined: within the 99.9 % interval of their sum of squares.
    assert white @ white < chi2.ppf(0.999, len(white))
    assert np.all(found.rest < 1e-3) and np.all(found.rest_floor < 1e-3)


def test_the_certified_controller_keeps_its_promise_on_the_true_table(folder, study, truth):
    """Stable, and below its certified worst cases; in six degrees of freedom stable with the other loops closed."""
    design, rig, _ = study
    K = controller(folder)
    bare = design.model_copy(update={"uncertainty": type(design.uncertainty)()})
    plant = build_plant(bare, truth)
    motion = plant.full.restricted(plant.floor_velocities, plant.velocities).closed(K)
    assert motion.is_stable()
    result = json.loads((folder / "design" / "result.json").read_text(encoding="utf-8"))
    promised = {row["name"]: row["value"] for row in result["requirements"]}
    peak = 20 * np.log10(hinf_norm(motion).gain)
    low, high = design.transmissibility.band_Hz
    omega = 2 * np.pi * np.geomspace(low, high, 200)
    band = 20 * np.log10(np.linalg.norm(motion.frequency_response(omega), ord=2, axis=(1, 2)).max())
    assert peak <= promised["worst-case peak transmissibility"]
    assert band <= promised["worst-case transmissibility over 1 to 10 Hz"]
    alone = bare_loop(design, rig, plant, K)
    loops = design_companions(alone, plant.weights.get("actuator chain *"), design.floor.band_Hz).systems()
    loop = replace(alone, loops=loops).with_plant("truth", truth)
    assert spectral_radius(loop) < 1.0
