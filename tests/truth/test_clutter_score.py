"""Clean and cluttered cases in the scorer of blind campaigns: which names are false, and what stands in the table."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.blind.asked import asked_table
from benchmarks.blind.case import described
from benchmarks.blind.judge import judge
from benchmarks.blind.lines import Line, Settings
from benchmarks.blind.run import arguments, is_cluttered
from benchmarks.blind.score import score

from . import clutter
from .cases import draw_case

SETTINGS = {"duration_s": 60.0, "jobs": 1, "unseen": True, "cluttered": 0.5}
TRACES = [
    {"name": name, "location": "anywhere", "parameters": {}, "unexplained": 0.002}
    for name in ("mains_hum", "contact_friction", "cubic_stiffness", "structural_damping")
]


def line(
    seed: int,
    kind: str,
    named: tuple[str, ...],
    hidden: tuple[str, ...] = (),
    cluttered: bool = True,
    unseen: tuple[float, float, float] | None = None,
    probability: float = 0.95,
    verdict: str = "explained",
) -> Line:
    def given(name: str) -> dict:
        return {
            "name": name,
            "location": "payload",
            "parameters": {},
            "probability": probability,
            "indistinguishable_from": [],
        }

    answer = {
        "format": "avis-gap",
        "version": 1,
        "verdict": verdict,
        "effects": list(map(given, named)),
        "gap": [],
        "where": [],
        "next_experiment": None,
        "seconds": 1.0,
        "traces": [given("loop_delay")],
    }
    return Line.model_validate(
        {
            "seed": seed,
            "kind": kind,
            "excitation": "noise",
            "floor_recorded": True,
            "relative_change": 1.0,
            "hidden": [{"name": name, "location": "payload", "parameters": {}, "strength": "clear"} for name in hidden],
            "answer": answer,
            "crash": None,
            "seconds": 1.0,
            "cpu_seconds": 10.0 + seed,
            "memory_MB": 1.0,
            "simulation_seconds": 1.0,
            "unseen_error": None,
            "settings": SETTINGS,
            "cluttered": cluttered,
            "unseen": dict(zip(("baseline", "updated", "best"), unseen, strict=True)) if unseen else None,
            "traces": TRACES if cluttered else [],
        }
    )


def cell(table, row: str, column: str) -> str:
    found = next(cells for cells in table.rows if cells[0].startswith(row))
    return found[table.head.index(column)]


def test_a_trace_is_no_false_name_but_no_hidden_effect_either():
    there, false = judge(line(0, "none", ("mains_hum",))), judge(line(1, "none", ("mains_hum", "com_offset")))
    assert there.outcome == "quiet" and not there.false_names
    assert false.outcome == "false name" and [one.name for one in false.false_names] == ["com_offset"]
    assert judge(line(2, "none", ("mains_hum",), cluttered=False)).outcome == "false name"
    assert judge(line(3, "none", (), verdict="unexplained")).outcome == "alarm without a name"
    assert judge(line(4, "outside", ("contact_friction",), ("air_drag",))).outcome == "refused"
    assert judge(line(5, "outside", ("loop_delay",), ("air_drag",))).outcome == "named as something else"
    one = judge(line(6, "one", ("com_offset", "mains_hum"), ("com_offset",)))
    assert one.outcome == "right" and all(one.right(named, exact=True) for named in one.named)
    assert judge(line(7, "one", ("mains_hum",), ("com_offset",))).outcome == "refused"


def test_clean_and_cluttered_stand_apart():
    lines = [
        line(0, "none", (), verdict="none", cluttered=False),
        line(1, "none", ("com_offset",)),
        line(2, "one", ("com_offset",), ("com_offset",), cluttered=False, unseen=(0.1, 0.02, 0.01)),
        line(3, "one", ("mains_hum", "com_offset"), ("com_offset",), unseen=(0.1, 0.05, 0.01)),
        line(4, "two", ("com_offset", "loop_delay"), ("loop_delay", "com_offset")),
        line(5, "outside", ("loop_delay",), ("air_drag",), probability=0.91),
    ]
    result = score(lines)
    table = next(one for one in result.tables if one.title == "Asked and measured")
    assert table.head == ("", "clean", "asked", "cluttered", "asked")
    for row, clean, cluttered in (
        ("cases", "2", "4"),
        ("no effect", "0.0 % (0/1", "100.0 % (1/1"),
        ("one effect", "100.0 %", "0.0 % (0/1"),
        ("two effects: both", "no case", "100.0 % (1/1"),
        ("two effects, each", "no case", "100.0 % (1/1"),
        ("outside", "no case", "100.0 % (1/1"),
        ("unseen record: error of updated over re", "median 0.2", "median 0.5"),
        ("unseen record: error of updated over best", "median 2", "median 5"),
        ("probability above 0.9", "100.0 % (1/1", "66.7 % (4/6"),
        ("processor", "median 11", "median 13.5"),
    ):
        assert cell(table, row, "clean").startswith(clean), row
        assert cell(table, row, "cluttered").startswith(cluttered), row
    assert asked_table([judge(one) for one in lines if one.cluttered]).head == ("", "cluttered", "asked")


def test_any_run_of_seeds_holds_the_share():
    for share in (0.0, 0.25, 0.5, 1.0):
        for first in (1, 77, 1000):
            drawn = [is_cluttered(seed, share) for seed in range(first, first + 60)]
            assert abs(np.mean(drawn) - share) < 0.05
    assert arguments(["--cluttered", "0.5", "--out", "x"]).cluttered == 0.5
    with pytest.raises(SystemExit):
        arguments(["--cluttered", "1.5", "--out", "x"])


def test_a_cluttered_case_goes_into_a_line(monkeypatch):
    monkeypatch.setattr(clutter, "PILOT_S", 1.0)
    case = draw_case(5, effect="mount_relaxation", clutter=True, duration_s=2.0)
    text = described(case)
    content = line(0, "none", ()).model_dump() | text | {"settings": Settings(duration_s=2.0, jobs=1, cluttered=1.0)}
    back = Line.model_validate(content)
    assert back.cluttered and back.hidden[0].variant == case.effects[0].details["variant"]
    assert [one.name for one in back.traces] == [one.name for one in case.traces]
    assert sum(one.unexplained**2 for one in back.traces) ** 0.5 < 0.0101
    clean = Line.model_validate(content | described(draw_case(5, kind="none")))
    assert not clean.cluttered and not clean.traces
