"""The pages of docs/contracts name every key that the files have: keys are read off files, not off the pages."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gap_stand_in
import h5py
import pytest
from pydantic import BaseModel

from avis_ctrl.gap.model_files import ModelFile
from avis_ctrl.measurement.formats.hdf5 import write_campaign
from avis_ctrl.study.output import controller_dict, result_dict
from avis_ctrl.study.uncertainty_file import UncertaintyFile

PAGES = Path(__file__).resolve().parents[2] / "docs" / "contracts"
# Keyed by names of the table or of the study; what is inside `simulation` and `provenance` is for people.
OPEN = {
    "parameters",
    "simulation",
    "provenance",
    "worst_cases",
    "values",
    "companions",
    "culprit",
    "design",
    "matrix",
    "gamma_slicot",
}


def named(page: str) -> set[str]:
    """Words in code on a page; what all files have is on the first one."""
    text = (PAGES / page).read_text() + (PAGES / "README.md").read_text()
    return {word for code in re.findall(r"`([^`]+)`", text) for word in re.findall(r"\w+", code)}


def keys(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inside in value.items():
            yield key
            if key not in OPEN:
                yield from keys(inside)
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from keys(one)


def fields(model: type[BaseModel]) -> Iterator[str]:
    yield from model.model_fields


def test_design(fabricated):
    content = result_dict(fabricated)
    written = {*keys(content), *keys(fabricated.plant.synthesis.as_dict())}
    written |= set(keys(controller_dict("mu", fabricated.controller("mu").K)))
    assert written - {"modulus_margin_asked", "notes"} <= named("design.md")
    assert f"`{content['format']}` version {content['version']}" in (PAGES / "design.md").read_text()


def test_gap():
    gap = gap_stand_in.explained(gap_stand_in.records())
    assert set(keys(gap.to_json())) <= named("gap.md")
    assert {*fields(ModelFile)} - {"fixed"} <= named("gap.md")


def test_uncertainty():
    assert set(fields(UncertaintyFile)) <= named("identification.md")


def test_campaign(tmp_path):
    write_campaign(tmp_path / "c.h5", gap_stand_in.records())
    with h5py.File(tmp_path / "c.h5") as file:
        record = next(iter(file["records"].values()))
        written = {*file.attrs, *record.attrs, *record, *(name for data in record.values() for name in data.attrs)}
    assert len(written) > 8 and written <= named("campaign.md")


@pytest.mark.parametrize("page", sorted(path.name for path in PAGES.glob("*.md")))
def test_every_page_is_in_the_list(page):
    assert page == "README.md" or f"({page})" in (PAGES / "README.md").read_text()
