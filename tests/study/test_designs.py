"""The scripts beside the design files say the same as the files."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from avis_ctrl.interface.workflow import study_inputs
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.runner import design_provenance

DESIGNS = Path(__file__).resolve().parents[2] / "designs"
NAMES = sorted(path.stem for path in DESIGNS.glob("*.toml"))


def test_every_design_file_has_its_script():
    assert NAMES == ["avis_six_axes", "avis_z_phix", "from_campaign", "halcyonics_six_axes", "halcyonics_z_phix"]
    # One axis by itself has no rig of six coordinates, hence no design file.
    assert sorted(path.stem for path in DESIGNS.glob("*.py")) == sorted([*NAMES, "single_axis"])


@pytest.mark.parametrize("path", sorted(DESIGNS.glob("*.py")), ids=lambda path: path.stem)
def test_a_script_is_short_and_imports_from_one_place(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 35
    assert {line for line in lines if "import" in line and "avis_ctrl" in line} == {"import avis_ctrl as ac"}


@pytest.mark.parametrize("name", NAMES)
def test_script_and_file_have_the_same_inputs(name):
    """Design and rig alike: the hash that the report prints as provenance is the same."""
    script = runpy.run_path(str(DESIGNS / f"{name}.py"))
    design, rig = read_study(DESIGNS / f"{name}.toml")
    own, table = study_inputs(script["rig"], **script["sections"])
    assert own == design
    by_script, by_file = (design_provenance(d, None, r, 0.0)["inputs_sha256"] for d, r in ((own, table), (design, rig)))
    assert by_script == by_file


def test_the_hash_notices_a_change_of_design_and_of_rig():
    design, rig = read_study(DESIGNS / "avis_z_phix.toml")
    hashes = {
        design_provenance(d, None, r, 0.0)["inputs_sha256"]
        for d, r in (
            (design, rig),
            (design.model_copy(update={"keep": ["phi_x", "z"]}), rig),
            (design, rig.with_parameters({"mass": rig.parameters()["mass"].value * (1 + 1e-12)})),
        )
    }
    assert len(hashes) == 3
