"""Loops of the axes that a design does not keep, on a table that the classical rule makes unstable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.errors import ComputationError
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.instability_cause import find_cause
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.simulation.sampled_response import sampled_response
from avis_ctrl.study.analysis import analyse
from avis_ctrl.study.design_file import design_from_table
from avis_ctrl.study.design_result import Candidate
from avis_ctrl.study.other_axes import CompanionSettings, design_companions, until_stable
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.simulation import bare_loop
from avis_ctrl.study.skyhooks import SETTINGS, classical_skyhook, critical_gains

RIG = Path(__file__).with_name("three_legs.toml")
# Few candidates: the search is the same.
QUICK = CompanionSettings(
    gain_factors=(0.1, 0.2, 0.5), tilt_corners_Hz=(0.1, 0.5), roll_offs_Hz=(20.0, 100.0), points=200
)


@pytest.fixture(scope="module")
def table():
    design = design_from_table(
        {
            "title": "three legs",
            "rig": "three_legs.toml",
            "keep": ["z", "phi_x"],
            "uncertainty": {"parameters_percent": {"mass": 10.0}},
            "transmissibility": {"peak_dB": 6.0, "band_dB": -3.0, "band_Hz": [2.0, 6.0]},
            "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
        }
    )
    rig = load_rig(RIG)
    return design, rig, build_plant(design, rig)


@pytest.fixture(scope="module")
def bare(table):
    design, rig, plant = table
    return bare_loop(design, rig, plant, None)


@pytest.fixture(scope="module")
def companions(bare):
    return design_companions(bare, settings=QUICK)


@pytest.fixture(scope="module")
def classical(bare):
    axes = ("x", "y", "phi_y", "phi_z")
    loops = Skyhook(axes, critical_gains(bare.rig, axes), *SETTINGS.corners_Hz)
    return replace(bare, loops={axis: loops.loop(axis) for axis in axes})


def test_the_classical_rule_is_unstable_with_1_Hz_geophones_and_x_and_y_are_named(bare, classical):
    culprit = find_cause(classical)
    assert culprit.kind == "companions" and set(culprit.loops) <= {"x", "y"} and culprit.growth_per_s > 0
    without = {axis: loop for axis, loop in classical.loops.items() if axis not in culprit.loops}
    assert spectral_radius(replace(classical, loops=without)) < 1 <= culprit.radius
    # The nonlinear simulation, which shares no eigenvalue with this, grows at that rate until the drives saturate.
    record = simulate(classical, 16.0, seed=1, settle_s=0.0)
    early, late = (
        np.sqrt(np.mean(record.velocity("x")[part] ** 2)) for part in (slice(4000, 6000), slice(14000, None))
    )
    assert np.log(late / early) / 10.0 == pytest.approx(culprit.growth_per_s, rel=0.3)


def test_designed_loops_keep_the_gain_margins_that_their_modulus_margin_implies(bare, companions):
    assert [one.axis for one in companions.loops] == ["x", "y", "phi_y", "phi_z"] and not companions.passive
    for one in companions.loops:
        assert one.modulus_margin >= QUICK.modulus_margin
        # |1 + L| >= m keeps the loop stable for every gain factor between 1/(1 + m) and 1/(1 - m).
        for factor in (1.01 / (1 + one.modulus_margin), 0.99 / (1 - one.modulus_margin)):
            loops = companions.systems() | {one.axis: replace(one, gain=factor * one.gain).loop()}
            assert spectral_radius(replace(bare, loops=loops)) < 1


def test_designed_loops_lower_the_motion_along_their_axes(bare, companions):
    omega = 2 * np.pi * np.geomspace(0.5, 60.0, 300)
    rms = [
        np.sqrt(np.trapezoid(sampled_response(loop, omega).velocity_psd()[:, :2], omega, axis=0))
        for loop in (bare, replace(bare, loops=companions.systems()))
    ]
    assert np.all(rms[1] < 0.8 * rms[0])


def test_gains_are_lowered_until_every_plant_is_stable(bare, companions):
    late = replace(bare, name="late", loop_delay_s=0.02)
    strong = companions.scaled(4.0)
    assert spectral_radius(replace(late, loops=strong.systems())) >= 1
    lowered = until_stable(strong, [bare, late])
    assert lowered.notes and lowered.loops[0].gain < strong.loops[0].gain
    assert all(spectral_radius(replace(plant, loops=lowered.systems())) < 1 for plant in (bare, late))


def test_a_modulus_margin_below_the_one_asked_is_told(bare, companions):
    assert not companions.below_margin() and not companions.remarks()
    strong = until_stable(companions.scaled(2.0), [bare])
    low = strong.below_margin()
    assert [one.axis for one in low] == ["y", "phi_y", "phi_z"] and strong.loops[0].modulus_margin > 0.5
    (said,) = strong.remarks()
    assert "below the required 0.5" in said
    assert said.endswith(": " + ", ".join(f"{one.axis} {one.modulus_margin:.2f}" for one in low) + ".")
    # Were the margins those before the gains were doubled, a loop could not be made unstable within them.
    worst = min(low, key=lambda one: one.modulus_margin)
    before = next(one for one in companions.loops if one.axis == worst.axis).modulus_margin
    loops = strong.systems() | {worst.axis: replace(worst, gain=0.99 * worst.gain / (1 - before)).loop()}
    assert spectral_radius(replace(bare, loops=loops)) >= 1


def test_lowered_loops_carry_their_own_margins(bare, companions):
    lowered = until_stable(companions.scaled(4.0), [bare, replace(bare, name="late", loop_delay_s=0.02)])
    assert lowered.below_margin() and len(lowered.remarks()) == 2 and lowered.remarks()[0] == lowered.notes[0]
    assert until_stable(replace(lowered, notes=()), [bare]).loops == lowered.loops


def test_an_unstable_rival_says_so_instead_of_ending_the_command(table):
    design, rig, plant = table
    K = classical_skyhook(plant, rig, design).K.scaled(left=40.0)
    with pytest.raises(ComputationError, match=r"unstable with the nominal plant.*closed-loop pole at .* Hz"):
        analyse(design, plant, Candidate("skyhook", "skyhook", "skyhook", K), np.zeros((0, 0, 0)))
