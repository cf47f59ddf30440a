"""From a campaign to a controller with `import avis_ctrl as ac` alone, in memory and in files."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import avis_ctrl as ac
from avis_ctrl.interface.workflow import study_inputs
from avis_ctrl.study.design_file import read_study

matplotlib.use("Agg")
AVIS_DESIGN = Path(__file__).resolve().parents[2] / "designs" / "avis_z_phix.toml"
NOISE = {
    "duration_s": 20.0,
    "truth": {"perturb_percent": 5.0, "perturb_damping_percent": 20.0},
    "record": [{"excitation": "noise", "level_percent": 50.0, "records": 3, "band_Hz": [0.5, 60.0]}],
}
QUICK = {
    "compare_with": ["hinf"],
    "synthesis": {"max_iterations": 1, "polish": False},
    "simulation": {"duration_s": 15.0, "random_plants": 0},
}


@pytest.fixture(scope="module")
def identified():
    return ac.identify(ac.simulate_campaign("avis", NOISE, seed=3), "avis", starts=1)


@pytest.fixture(scope="module")
def study(identified):
    return ac.design(identified, keep=["z"], **QUICK)


def test_from_a_campaign_to_a_controller_and_its_report(study, tmp_path):
    """On one axis, with one K-step and one rival; designs/from_campaign.py has all (slow: test_from_campaign)."""
    assert [c.name for c in study.result.controllers] == ["passive", "hinf", "mu"]
    files = study.save(tmp_path / "design")
    assert {path.name for path in files} >= {"report.html", "report.pdf", "mu.json", "plant.json", "result.json"}
    stored = json.loads((tmp_path / "design" / "controllers" / "mu.json").read_text(encoding="utf-8"))
    np.testing.assert_array_equal(stored["A"], study.controller.A)
    assert study.sampled_controller is not None and study.sampled_controller.dt == pytest.approx(1e-3)
    for one in study.requirements:
        assert one.name in study.summary() and escape(one.name) in study._repr_html_()
    assert "\n" not in repr(study)
    for draw in (
        study.plot_transmissibility,
        study.plot_mu,
        study.plot_dk_history,
        study.plot_controller,
        study.plot_vibration,
    ):
        assert draw().get_ylabel()


@pytest.mark.slow
def test_what_is_designed_in_memory_is_what_the_saved_files_say(identified, tmp_path):
    identified.save(tmp_path, keep=["z"], **QUICK)
    design, rig = read_study(tmp_path / "design.toml")
    own, table = study_inputs(identified, keep=["z"], **QUICK)
    assert own == design and own.keep == ["z"] and own.synthesis.max_iterations == 1
    assert {k: v.value for k, v in table.parameters().items()} == {k: v.value for k, v in rig.parameters().items()}


def test_identified_values_come_with_their_deviation(identified):
    value, sigma, unit = identified.values["mass"]
    assert unit == "kg" and 0 < sigma < 25 and abs(value - 500) < 50
    assert "mass" in identified.summary() and "mass" in identified._repr_html_() and "\n" not in repr(identified)
    assert len(identified.plot_values().get_yticklabels()) == len(identified.values)


def test_sections_replace_those_of_a_file():
    design, _ = study_inputs(AVIS_DESIGN, transmissibility={"peak_dB": 5.0}, keep=["z"])
    from_file, _ = study_inputs(AVIS_DESIGN)
    assert design.transmissibility.peak_dB == 5.0 and design.transmissibility.band_dB == -7.0
    assert design.keep == ["z"] and design.requirement == from_file.requirement


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: ac.rig("no_such_rig"), "expected a rig file or one of"),
        (lambda: ac.campaign("no_such_file.h5"), "no_such_file.h5"),
        (lambda: ac.identify("no_such_file.h5", "avis"), "no_such_file.h5"),
        (lambda: ac.identify(None, "avis"), "expected a campaign, a frequency response or a file"),
        (lambda: ac.design("avis", keep=["z"], transmisibility={}), "transmisibility"),
        (lambda: ac.design("avis"), "title"),
        (lambda: ac.design(AVIS_DESIGN, compare_with=["hinf"]), "advantage_over_skyhook_dB compares"),
        (lambda: ac.design(AVIS_DESIGN, compare_with=["lqg"]), "compare_with"),
        (lambda: ac.simulate_campaign(3.0), "expected a rig"),
        (lambda: ac.design(3.0), "expected a rig"),
        (lambda: ac.simulate_campaign("avis", {"records": []}), "record"),
    ],
)
def test_wrong_input_is_one_line(call, words):
    with pytest.raises(ac.InputError, match=words) as error:
        call()
    assert "\n" not in str(error.value)


def test_an_option_that_does_not_exist_is_named():
    campaign = ac.simulate_campaign("avis", {**NOISE, "duration_s": 2.0, "settle_s": 0.0}, seed=3)
    for command in (ac.identify, ac.gap):
        with pytest.raises(ac.InputError, match="option = 'stars'"):
            command(campaign, "avis", stars=1)


@pytest.mark.slow
def test_gap_names_the_lag_that_was_simulated(tmp_path):
    """designs/plans/lagging_amplifiers.toml hides a lag of 120 Hz in the amplifiers; about a minute."""
    campaign = ac.simulate_campaign("avis", AVIS_DESIGN.parent / "plans" / "lagging_amplifiers.toml")
    found = ac.gap(campaign, "avis")
    assert found.verdict == "explained" and [one.name for one in found.effects] == ["actuator_lag"]
    corner = found.effects[0].parameters["corner_Hz"]
    assert abs(corner.value - 120.0) < 5 * corner.std + 0.5
    assert "lag" in found.summary() and "explained" in repr(found) and "noise alone" in found._repr_html_()
    assert len(found.plot_stages().patches) == len(found.gap.stages)
    assert {path.name for path in found.save(tmp_path)} >= {"gap.json", "gap.html", "gap.pdf", "updated.toml"}
