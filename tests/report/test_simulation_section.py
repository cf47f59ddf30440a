"""The report's section on the simulation, and result.json, of a short simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.lti.statespace import gain
from avis_ctrl.report.content import document
from avis_ctrl.report.elements import Mark, Table
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.sections.simulation import simulation
from avis_ctrl.simulation.design_check import check_designs
from avis_ctrl.study.design_result import DesignResult, Simulated
from avis_ctrl.study.other_axes import Companion, Companions
from avis_ctrl.study.output import result_dict
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.simulation import bare_loop

LOOPS = (Companion("x", 1e3, 0.1, 100.0, 0.62), Companion("y", 2e3, 0.1, 100.0, 0.43))


@pytest.fixture(scope="module")
def simulated(fabricated: DesignResult) -> DesignResult:
    check = check_designs([bare_loop(fabricated.design, fabricated.rig, fabricated.plant, None)], 15.0)
    return replace(fabricated, loop=Simulated(Companions(LOOPS, (("phi_y", "a reason"),)), check, gain(1.0), 1.0, None))


def test_a_loop_that_misses_the_modulus_margin_is_marked(simulated: DesignResult) -> None:
    table = next(p for p in simulation(simulated).pieces if isinstance(p, Table) and "modulus margin" in p.caption)
    assert "at least 0.5 is required" in table.caption
    assert [row[-1] for row in table.rows] == [Mark("0.62", True), Mark("0.43", False), "a reason"]


@pytest.fixture(scope="module")
def limited(fabricated: DesignResult) -> DesignResult:
    """The drive Az4 may have 4 V, the others 10 V."""
    rig = fabricated.rig
    one = replace(rig.all_drives[-1], limit_V=4.0)
    assert one.name == "Az4"
    rig = replace(rig, motors=rig.motors[:-1], drives=(one,))
    plant = build_plant(fabricated.design, rig)
    loop = bare_loop(fabricated.design, rig, plant, fabricated.controller("mu").K)
    made = Simulated(Companions(()), check_designs([loop], 15.0), gain(1.0), 1.0, None)
    return replace(fabricated, rig=rig, plant=plant, loop=made)


LIMITS = "Ay1 10.0 V, Az1 10.0 V, Ax2 10.0 V, Az2 10.0 V, Ay3 10.0 V, Az3 10.0 V, Ax4 10.0 V, Az4 4.00 V"


def test_the_peak_voltage_is_that_of_the_drive_nearest_to_its_limit(limited: DesignResult) -> None:
    check = limited.loop.check
    peaks = np.max(np.abs(check.first.demanded), axis=0)
    assert 0.4 * peaks.max() < peaks[-1] < peaks.max()
    assert (check.plants[0].peak_V, check.plants[0].limit_V) == (peaks[-1], 4.0)
    table = next(p for p in simulation(limited).pieces if isinstance(p, Table) and "Every" in p.caption)
    assert f"of the drive that comes closest to its limit; {LIMITS};" in table.caption
    assert table.rows[0][4].endswith(" of 4.00 V")


def test_caption_states_the_frequencies_of_the_velocity_and_one_limit_once(simulated: DesignResult) -> None:
    table = next(p for p in simulation(simulated).pieces if isinstance(p, Table) and "Every" in p.caption)
    assert "Commanded voltages, limit 10.0 V;" in table.caption and table.rows[0][4] == "0 V"
    half_rate = simulated.rig.sample_rate_Hz / 2
    assert f"The velocity contains all frequencies from 0 to {half_rate:.0f} Hz" in table.caption


def test_each_axis_is_weighed_against_the_drive_that_reaches_its_limit_first(limited: DesignResult) -> None:
    plant, level = limited.plant, limited.design.control_effort.floor_velocity_m_per_s
    limits = limited.rig.limits_of(plant.actuators)
    for k, axis in enumerate(plant.axes):
        # At 5 Hz, between the corners for the offset and for the bandwidth.
        gain = abs(plant.full.P.select([f"effort_{axis}"], [f"command_{axis}"])(10j * np.pi)[0, 0])
        assert gain == pytest.approx(level * np.max(np.abs(plant.allocation[:, k]) / limits), rel=5e-3)
        assert plant.effort_weight(axis).meaning.startswith("at most 4 V for a floor velocity")
    curves = (
        next(
            p
            for s in document(limited).sections
            for p in s.pieces
            if isinstance(p, Figure) and p.name == "weight_effort"
        )
        .panels[0]
        .curves
    )
    assert [c.label for c in curves] == [
        text for axis in ("z", "phi_x (edge)") for text in (f"1/|W_u|, allowed, {axis}", f"mu synthesis, {axis}")
    ]
    site = next(s for s in document(limited).sections if s.anchor == "site")
    assert any(
        isinstance(p, Table) and p.caption.endswith("the limit is Az1 10.0 V, Az2 10.0 V, Az3 10.0 V, Az4 4.00 V.")
        for p in site.pieces
    )


def test_result_json_says_which_loops_miss_it(simulated: DesignResult) -> None:
    told = result_dict(simulated)["all_axes"]
    assert told["modulus_margin_asked"] == 0.5
    assert [one["modulus_margin"] for one in told["companions"]] == [0.62, 0.43]
    assert any("below the required 0.5" in note and note.endswith(": y 0.43.") for note in told["notes"])
