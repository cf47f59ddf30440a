"""Design folders to export from: the shipped AVIS design, and a quick one with the classical skyhook."""

from __future__ import annotations

from pathlib import Path

import pytest

from avis_ctrl.export.compiled import compiler
from avis_ctrl.export.design_folder import open_design
from avis_ctrl.study.controllers import mu_optimal
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.files import as_json
from avis_ctrl.study.other_axes import design_companions
from avis_ctrl.study.output import controller_dict
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.runner import design_provenance
from avis_ctrl.study.simulation import bare_loop
from avis_ctrl.study.skyhooks import classical_skyhook
from avis_ctrl.study.study_file import study_dict

DESIGNS = Path(__file__).resolve().parents[2] / "designs"


def write_folder(path: Path, design_name: str, make) -> Path:
    """The files of a design that export reads, with the one controller that make(design, plant, rig) returns."""
    source = DESIGNS / f"{design_name}.toml"
    design, rig = read_study(source)
    plant = build_plant(design, rig)
    made = make(design, plant, rig)
    loop = bare_loop(design, rig, plant, made.K)
    companions = design_companions(loop, plant.weights.get("actuator chain *"), design.floor.band_Hz)
    (path / "controllers").mkdir(parents=True)
    (path / "study.json").write_bytes(as_json(study_dict(design, rig)))
    (path / "controllers" / f"{made.name}.json").write_bytes(as_json(controller_dict(made.name, made.K)))
    rows = [
        {
            "axis": one.axis,
            "gain": one.gain,
            "tilt_corner_Hz": one.tilt_corner_Hz,
            "roll_off_Hz": one.roll_off_Hz,
            "modulus_margin": one.modulus_margin,
        }
        for one in companions.loops
    ]
    (path / "result.json").write_bytes(
        as_json(
            {
                "format": "avis-design",
                "version": 1,
                "stable": True,
                "verdict": "",
                "controllers": [
                    {"name": made.name, "file": f"controllers/{made.name}.json"},
                    {"name": "passive", "file": None},
                ],
                "all_axes": {"companions": rows},
                "provenance": design_provenance(design, source, rig, 0.0),
            }
        )
    )
    return path


@pytest.fixture(scope="session")
def skyhook_dir(tmp_path_factory) -> Path:
    return write_folder(
        tmp_path_factory.mktemp("skyhook") / "design",
        "avis_z_phix",
        lambda design, plant, rig: classical_skyhook(plant, rig, design),
    )


@pytest.fixture(scope="session")
def skyhook(skyhook_dir):
    return open_design(skyhook_dir)


@pytest.fixture(scope="session")
def shipped_dir(tmp_path_factory) -> Path:
    """The shipped AVIS design with the mu controller after four D-K iterations, which takes half as long as all."""

    def early(design, plant, rig):
        few = design.synthesis.model_copy(update={"max_iterations": 4})
        return mu_optimal(design.model_copy(update={"synthesis": few}), plant, rig)[0]

    return write_folder(tmp_path_factory.mktemp("shipped") / "design", "avis_z_phix", early)


@pytest.fixture(scope="session")
def shipped(shipped_dir):
    return open_design(shipped_dir)


@pytest.fixture(scope="session")
def gcc() -> str:
    found = compiler()
    if found is None:
        pytest.skip("gcc is not installed: the C code is not compiled")
    return found


@pytest.fixture(scope="session")
def make_folder():
    return write_folder
