"""Two designs side by side, and a design's result as the Python interface shows it."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot as plt

from avis_ctrl.cli import app
from avis_ctrl.errors import InputError
from avis_ctrl.interface.results import DesignStudy
from avis_ctrl.study.design_comparison import compare_designs
from avis_ctrl.study.files import open_folder
from avis_ctrl.study.output import write_study

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def folders(fabricated, tmp_path_factory):
    """The same result twice; of the second the requested peak, a requirement and mu differ."""
    base = tmp_path_factory.mktemp("compared")
    design = fabricated.design.model_copy(
        update={
            "title": "softer",
            "transmissibility": fabricated.design.transmissibility.model_copy(update={"peak_dB": 6.0}),
        }
    )
    controllers = tuple(
        replace(c, mu=replace(c.mu, upper=0.71)) if c.name == "mu" else c for c in fabricated.controllers
    )
    for name, one in (("a", fabricated), ("b", replace(fabricated, design=design, controllers=controllers))):
        write_study(one, open_folder(base / name))
    return base / "a", base / "b"


def test_what_was_requested_and_found_differently(folders, fabricated):
    found = compare_designs(*folders)
    assert found.titles == (fabricated.design.title, "softer")
    assert found.requested == (("transmissibility.peak_dB", "3.5", "6"),)
    assert ("mu, upper bound", "0.93", "0.71") in found.found
    assert (
        f"{sum(r.met for r in fabricated.requirements)} of {len(fabricated.requirements)}"
        in dict((name, first) for name, first, _ in found.found)["requirements met"]
    )
    assert "requested differently (transmissibility" in found.note
    assert "softer" in found._repr_html_()


def test_a_design_is_the_same_as_itself(folders):
    found = compare_designs(folders[0], folders[0])
    assert not found.requested and not found.note and all(one == other for _, one, other in found.found)


def test_the_command_prints_both(folders):
    from typer.testing import CliRunner

    done = CliRunner().invoke(app, ["compare", *map(str, folders)], env={"COLUMNS": "160"})
    assert done.exit_code == 0 and "transmissibility.peak_dB" in done.output and "0.71" in done.output
    assert "peak transmissibility, worst case [dB]" in done.output  # no markup


def test_rigs_of_one_name_differ_by_their_values(folders, tmp_path):
    content = json.loads((folders[0] / "study.json").read_text())
    rig = tomllib.loads(content["rig"])
    assert "mass_kg" in rig["payload"] and content["rig"].count(f"mass_kg = {rig['payload']['mass_kg']}") == 1
    heavier = content["rig"].replace(f"mass_kg = {rig['payload']['mass_kg']}", "mass_kg = 999.0  # weighed")
    (tmp_path / "study.json").write_text(json.dumps({**content, "rig": heavier}))
    (tmp_path / "result.json").write_text((folders[0] / "result.json").read_text())
    found = compare_designs(folders[0], tmp_path)
    assert found.requested == (("rig file: payload.mass_kg", f"{rig['payload']['mass_kg']:.5g}", "999"),)
    assert "differently (rig file);" in found.note


def test_studies_without_a_rig_file_are_compared(folders, tmp_path):
    content = json.loads((folders[0] / "study.json").read_text())
    (tmp_path / "study.json").write_text(json.dumps({**content, "rig": None}))
    (tmp_path / "result.json").write_text((folders[0] / "result.json").read_text())
    assert "requested differently (rig file)" in compare_designs(folders[0], tmp_path).note


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda path: None, "study.json"),
        (lambda path: (path / "study.json").write_text("{"), "expected a JSON file"),
        (lambda path: (path / "study.json").write_text('{"format": "avis-study"}'), "expected a design"),
    ],
)
def test_a_folder_that_is_no_design_is_one_line(folders, tmp_path, spoil, words):
    (tmp_path / "result.json").write_text((folders[0] / "result.json").read_text())
    spoil(tmp_path)
    with pytest.raises(InputError, match=words) as error:
        compare_designs(folders[0], tmp_path)
    assert "\n" not in str(error.value)


def test_a_result_without_its_delivered_controller_is_refused(folders, tmp_path):
    (tmp_path / "study.json").write_text((folders[0] / "study.json").read_text())
    content = json.loads((folders[0] / "result.json").read_text())
    (tmp_path / "result.json").write_text(json.dumps({**content, "controllers": []}))
    with pytest.raises(InputError, match="expected a result"):
        compare_designs(tmp_path, folders[0])


def test_a_study_shows_saves_and_plots_its_result(fabricated, tmp_path):
    study = DesignStudy(fabricated)
    assert study.controller is fabricated.controller("mu").K and study.requirements == fabricated.requirements
    assert study.met == all(r.met for r in fabricated.requirements)
    text = study.summary()
    for r in fabricated.requirements:
        assert r.name in text and r.name in study._repr_html_()
    assert "\n" not in repr(study)
    assert {path.name for path in study.save(tmp_path)} >= {"report.html", "report.pdf", "result.json", "mu.json"}
    ax = study.plot_transmissibility(controllers=["passive", "mu"])
    t = fabricated.controller("mu").transmissibility
    np.testing.assert_allclose(ax.lines[1].get_data(), [t.omega / (2 * np.pi), 20 * np.log10(t.sigma)])
    with pytest.raises(InputError, match="expected some of"):
        study.plot_transmissibility(controllers=["rocket"])
    for draw in (study.plot_mu, study.plot_dk_history, study.plot_controller, study.plot_vibration):
        _, given = plt.subplots()
        assert draw(given) is given
    plt.close("all")


@pytest.mark.slow
def test_a_report_without_rivals(fabricated, tmp_path):
    """Left out on request, or failed: the report speaks of the controllers that there are."""
    alone = replace(fabricated, controllers=tuple(c for c in fabricated.controllers if c.name in ("passive", "mu")))
    study = DesignStudy(alone)
    study.save(tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "skyhook, tuned" not in page and "mu synthesis" in page
    assert len(study.plot_transmissibility().lines) == 3  # two controllers and the certified worst case
    plt.close("all")
