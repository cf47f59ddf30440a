"""Design and rig of a study as a file in its folder, so that later commands need only the folder."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.file_errors import read_json, validated
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.study.design_file import Design, design_from_table
from avis_ctrl.study.uncertainty_file import UncertaintyFile

STUDY = "study.json"


def study_dict(design: Design, rig: Rig) -> dict[str, Any]:
    """The inputs of a study; the rig as the text of a rig file. Raises InputError for a rig without a file format."""
    return {
        "format": "avis-study",
        "version": 1,
        "design": design.model_dump(),
        "rig": rig_toml(rig),
        "loaded": getattr(rig, "load", None) is not None,
    }


def read_saved(folder: Path) -> tuple[Design, Rig]:
    """Design and rig of a study's folder. Raises InputError in one line if the file is invalid."""
    path = folder / STUDY
    content = read_json(path, "avis-study")
    try:
        table = dict(content["design"])
        known = dict(table.get("uncertainty") or {})
        if isinstance(known.get("identified"), dict):
            known["identified"] = validated(UncertaintyFile, known["identified"])
            table["uncertainty"] = known
        design = design_from_table({key: value for key, value in table.items() if value is not None})
        rig = rig_from(tomllib.loads(content["rig"]), bool(content.get("loaded")))
    except InputError as error:
        raise error.in_file(path) from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"expected a design and a rig as avis design writes them; {error!r}", file=path) from None
    return design, rig
