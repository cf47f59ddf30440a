"""Thresholds are fields of settings, which a result's provenance lists."""

from __future__ import annotations

import ast
import importlib
import json
import re
from dataclasses import asdict, is_dataclass
from pathlib import Path

import pytest

import avis_ctrl.gap
from avis_ctrl.gap.tuning_values import tuning_values

FOLDER = Path(avis_ctrl.gap.__file__).parent
FILES = sorted(FOLDER.rglob("*.py"))
# What no tuning can change: physics, mathematics, names, tables.
NO_TUNING = {
    "ADDED",
    "ALL",
    "AT_REST",
    "BEYOND",
    "BY_PHYSICS",
    "COORDINATES",
    "COUNTS",
    "DECAY",
    "DIAGONAL",
    "ENTRIES",
    "FASTER",
    "FILES",
    "FORMAT",
    "HANN_COST",
    "HANN_SHARED",
    "HIGHER",
    "MAINS_HZ",
    "MOUNT",
    "PROBLEMS",
    "PARTS",
    "PRODUCTS",
    "RAYLEIGH",
    "RELEASED",
    "SETTINGS",
    "SLOW",
    "SWEEP",
    "SYMMETRIC",
    "THREE_AXES",
    "TOGETHER",
    "UNITS",
    "VERDICTS",
    "VERSION",
    "_AT_REST",
    "_ELSEWHERE",
    "_MADE",
    "_NOTES",
}


def constants(path: Path) -> set[str]:
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        found |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return {name for name in found if re.match(r"_?[A-Z][A-Z0-9]+(_|$)", name)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(FOLDER)))
def test_no_threshold_is_a_module_constant(path):
    assert constants(path) <= NO_TUNING


def test_every_exception_is_in_use():
    assert set().union(*map(constants, FILES)) & NO_TUNING == NO_TUNING


def test_provenance_lists_every_setting():
    listed = list(tuning_values().values())
    for path in FILES:
        if "SETTINGS" not in constants(path):
            continue
        name = ".".join(["avis_ctrl.gap", *path.relative_to(FOLDER).with_suffix("").parts])
        own = importlib.import_module(name).SETTINGS
        assert is_dataclass(own) and asdict(own) in listed, name
    json.dumps(tuning_values())


@pytest.mark.parametrize(
    "path", [path for path in FILES if "SETTINGS" in constants(path)], ids=lambda path: str(path.relative_to(FOLDER))
)
def test_every_setting_is_explained(path):
    name = ".".join(["avis_ctrl.gap", *path.relative_to(FOLDER).with_suffix("").parts])
    own = type(importlib.import_module(name).SETTINGS)
    explained = "".join(base.__doc__ or "" for base in own.__mro__ if is_dataclass(base))
    heads = " ".join(re.findall(r"^ {4}([a-z][\w, ]*) : ", explained, re.MULTILINE)).replace(",", " ").split()
    assert set(own.__dataclass_fields__) <= set(heads)
