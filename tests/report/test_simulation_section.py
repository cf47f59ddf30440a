"""The report's section on the simulation, and result.json, of a short simulation."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avis_ctrl.lti.statespace import gain
from avis_ctrl.report.pieces import Mark, Table
from avis_ctrl.report.sections.simulation import simulation
from avis_ctrl.simulation.campaign import check_designs
from avis_ctrl.study.companions import Companion, Companions
from avis_ctrl.study.model import DesignResult, Simulated
from avis_ctrl.study.output import result_dict
from avis_ctrl.study.simulation import bare_loop

LOOPS = (Companion("x", 1e3, 0.1, 100.0, 0.62), Companion("y", 2e3, 0.1, 100.0, 0.43))


@pytest.fixture(scope="module")
def simulated(fabricated: DesignResult) -> DesignResult:
    check = check_designs([bare_loop(fabricated.design, fabricated.rig, fabricated.plant, None)], 15.0)
    return replace(fabricated, loop=Simulated(Companions(LOOPS, (("phi_y", "a reason"),)), check, gain(1.0), 1.0, None))


def test_a_loop_that_misses_the_modulus_margin_is_marked(simulated: DesignResult) -> None:
    table = next(p for p in simulation(simulated).pieces if isinstance(p, Table) and "modulus margin" in p.caption)
    assert "at least 0.5 was asked" in table.caption
    assert [row[-1] for row in table.rows] == [Mark("0.62", True), Mark("0.43", False), "a reason"]


def test_result_json_says_which_loops_miss_it(simulated: DesignResult) -> None:
    told = result_dict(simulated)["all_axes"]
    assert told["modulus_margin_asked"] == 0.5
    assert [one["modulus_margin"] for one in told["companions"]] == [0.62, 0.43]
    assert any("below the 0.5 that was asked" in note and note.endswith(": y 0.43.") for note in told["notes"])
