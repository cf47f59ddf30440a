"""The examples of CONTRIBUTING.md work as they stand, and its map has every package."""

from __future__ import annotations

import importlib
import re
from dataclasses import replace
from pathlib import Path

import gap_stand_in
import numpy as np
import pytest

from avis_ctrl.measurement.gates import Expectation
from avis_ctrl.report import content, html, pdf

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()


@pytest.fixture(scope="module")
def examples() -> dict:
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", TEXT, re.S):
        exec(compile(code, "CONTRIBUTING.md", "exec"), names)
    return names


def test_the_map_has_every_package():
    there = {
        path.name.removesuffix(".py")
        for path in (ROOT / "avis_ctrl").iterdir()
        if (path.suffix == ".py" or (path / "__init__.py").is_file()) and path.stem != "__init__"
    }
    first = " ".join(re.findall(r"^\| (`.*?) \|", TEXT, re.M))
    assert set(re.findall(r"`(\w+)`", first)) == there


def test_the_gate_finds_an_offset_and_no_other(examples, monkeypatch):
    gates = importlib.import_module("avis_ctrl.measurement.gates.examine")  # the package has a function of this name
    monkeypatch.setattr(gates, "GATES", (examples["Offset"],))
    campaign = gap_stand_in.records()
    known = Expectation(y_range_V=(-10.0, 10.0))
    [clean] = gates.examine(campaign, known)
    assert clean.severity == "ok"
    record = campaign.records[0].load()
    off = replace(record, y=record.y + np.eye(record.y.shape[1])[1] * 5.0)
    [found] = gates.examine(replace(campaign, records=(off, *campaign.records[1:])), known)
    assert found.severity == "warning" and found.channels == (campaign.y_names[1],)
    assert found.value == pytest.approx(5.0, abs=0.2) and found.limit == 2.5


def test_the_section_is_drawn_in_both(examples, fabricated, monkeypatch):
    monkeypatch.setattr(content, "SECTIONS", (*content.SECTIONS, examples["drives"]))
    document = content.document(fabricated)
    assert [s.title for s in document.sections[-2:]] == ["Drives", "Provenance"]
    assert b"Largest voltage, once in ten minutes." in html.render(document)
    assert pdf.render(document).startswith(b"%PDF")
