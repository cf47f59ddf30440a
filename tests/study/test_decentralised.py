"""One loop an axis, tuned on mu, and the limit of the gain above half the sample rate: against sampled plants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import lft_lower
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.study.decentralised import tuned_loops
from avis_ctrl.study.design_file import design_from_table, read_study
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.roll_off import gain_limit
from avis_ctrl.study.runner import compare, run_design
from avis_ctrl.study.skyhooks import classical_skyhook

DESIGN = Path(__file__).resolve().parents[2] / "designs" / "avis_z_phix.toml"
HOLD = 2 / np.pi  # at half the sample rate


def table_of(**changes):
    return design_from_table(
        {
            "title": "small",
            "rig": "avis",
            "keep": ["z", "phi_x"],
            "uncertainty": {
                "parameters_percent": {"mass": 10.0},
                "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 80.0, "high_percent": 200.0},
            },
            "transmissibility": {"peak_dB": 6.0, "band_dB": -3.0, "band_Hz": [2.0, 6.0]},
            "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
            "synthesis": {"max_iterations": 1, "polish": False},
            "simulation": {"duration_s": 15.0, "random_plants": 1},
        }
        | changes
    )


def test_the_limit_keeps_the_loop_gain_of_every_sampled_plant_below_one():
    """With the largest gain allowed, and not by a wide margin."""
    design, rig = read_study(DESIGN)
    plant = build_plant(design, rig)
    limit = gain_limit(plant, rig.sample_rate_Hz)
    assert limit.omega[0] == pytest.approx(np.pi * rig.sample_rate_Hz)
    blocks, P = plant.full.blocks, plant.full.P
    M = P.select([*P.outputs[: blocks.n_z], *plant.full.y], [*P.inputs[: blocks.n_w], *plant.full.u])
    M, n_w, n_z = M.frequency_response(limit.omega), blocks.n_w, blocks.n_z
    images = np.where(limit.omega == limit.omega[0], 2.0, 1.0)  # that of half the rate falls onto it
    # Chains of full size in phase with the table are the worst; random ones beside them.
    full = blocks.assemble([np.ones((b.rows, b.cols)) if b.kind == "full" else 1.0 for b in blocks.blocks])
    gains = []
    for delta in (full, *random_perturbations(plant, 20, 0)):
        table = M[:, n_z:, n_w:] + M[:, n_z:, :n_w] @ delta @ np.linalg.solve(
            np.eye(n_z) - M[:, :n_z, :n_w] @ delta, M[:, :n_z, n_w:]
        )
        gains.append(np.linalg.norm(table, 2, (1, 2)) * limit.most * images * (2 + HOLD))
    assert np.all(np.array(gains) <= 1 + 1e-4)
    assert np.all(np.max(gains, axis=0)[:5] > 0.9)  # further up the worst phase is another one


@pytest.fixture(scope="module")
def table():
    design, rig = table_of(), load_rig("avis")
    plant = build_plant(design, rig)
    return plant, rig, classical_skyhook(plant, rig, design)


@pytest.fixture(scope="module")
def loops(table):
    plant, rig, skyhook = table
    return plant, rig, skyhook, tuned_loops(plant, rig, table_of(), skyhook.K)


@pytest.mark.slow
def test_each_axis_sees_its_own_signal_alone(loops):
    _, _, _, made = loops
    response = made.K.frequency_response(np.geomspace(0.01, 1e4, 100))
    assert np.max(np.abs(response[:, [0, 1], [1, 0]])) == 0.0
    assert np.min(np.max(np.abs(response[:, [0, 1], [0, 1]]), axis=0)) > 0
    assert made.K.nstates == 6 and made.K.is_stable()  # the skyhook that it starts from has four
    of_z, of_phi_x = (np.count_nonzero(row) for row in made.K.C)
    assert made.notes == (f"states of each axis's loop: z {of_z}, phi_x_edge {of_phi_x}",) and of_z + of_phi_x == 6


@pytest.mark.slow
def test_mu_is_below_that_of_the_skyhook_and_the_gain_below_its_limit(loops):
    """The loop is formed anew; bounds by `mu_peak`, gains on a dense grid."""
    plant, rig, skyhook, made = loops
    P, blocks = plant.synthesis.P, plant.synthesis.all_blocks
    mu, before = (mu_peak(lft_lower(P, one.K), blocks) for one in (made, skyhook))
    assert mu.guaranteed and mu.upper < 0.62 * before.lower
    limit = gain_limit(plant, rig.sample_rate_Hz)
    omega = np.geomspace(limit.omega[0], limit.omega[-1], 500)
    gain = np.linalg.norm(made.K.frequency_response(omega), 2, (1, 2))
    assert np.all(gain <= np.interp(omega, limit.omega, limit.most) * 1.02)


@pytest.mark.slow
def test_a_design_that_asks_for_the_loops_has_them(loops):
    """In the order of the report."""
    design, rig = table_of(compare_with=["loops"], keep=["z"]), load_rig("avis")
    made = run_design(design, rig)
    assert [one.name for one in made.controllers] == ["passive", "loops", "mu"] and not made.failed
    found = made.controller("loops")
    assert found.K.nstates <= 3 and found.kind == "skyhook" and found.stable
    # One axis: a loop of its own is no restriction, so that only the number of states costs.
    assert found.mu.upper <= 1.1 * made.controller("mu").mu.upper


@pytest.mark.parametrize("asked", [pytest.param([], marks=pytest.mark.slow), ["loops"]])
def test_only_a_design_that_asks_has_loops(table, monkeypatch, asked):
    """Those that cannot be made do not stop it."""

    def none(*arguments):
        raise ComputationError("no loops")

    plant, rig, skyhook = table
    monkeypatch.setattr("avis_ctrl.study.runner.tuned_loops", none)
    candidates = [replace(skyhook, name="mu", title="mu"), replace(skyhook, name="passive", K=None)]
    found = compare(table_of(compare_with=asked), plant, rig, candidates)
    assert [one.name for one in found.failed] == asked
    assert all("no loops" in one.reason for one in found.failed)
