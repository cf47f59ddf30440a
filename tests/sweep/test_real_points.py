"""Real points: what a sweep says is what the study says of the controller in the point's file."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
from helpers import COMMAND, environment, rows_of
from test_points import SMALL

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.measurement.formats import write_campaign
from avis_ctrl.rigs import load_rig
from avis_ctrl.robust.mu_peak import mu_peak, worst_case_gain
from avis_ctrl.simulation.perturbed_campaign import perturbed_campaign
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.plan_file import read_plan
from avis_ctrl.study.plant import build_plant
from avis_ctrl.sweep.local import on_this_machine
from avis_ctrl.sweep.run import plan_sweep, run_sweep

SHORT = "\n[synthesis]\nmax_iterations = 2\n[simulation]\nduration_s = 15.0\nrandom_plants = 0\n"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["design", "skyhook"])
def test_figures_are_those_of_the_controller_kept(kind, tmp_path):
    (tmp_path / "small.toml").write_text(SMALL + SHORT)
    (tmp_path / "points.toml").write_text(f"""
kind = "{kind}"
base = "small.toml"
[[vary]]
key = "transmissibility.band_dB"
values = [-6.0, 9.0]
[[vary]]
key = "rig_factor.mass"
values = [1.1]
""")
    done = subprocess.run(
        [*COMMAND, str(tmp_path / "points.toml"), "--out", str(tmp_path / "out"), "--workers", "1"],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    row, refused = rows_of(tmp_path / "out")
    assert refused["status"] == "failed" and "below peak_dB" in refused["message"]
    assert row["status"] == "done", row["message"]
    kept = json.loads((tmp_path / "out" / "points" / f"{row['identity']}.json").read_text())
    c = kept["controller"]
    assert len(c["A"]) == row["figures"]["order"]
    # The same study by hand: its plant, closed with the controller of the file.
    (tmp_path / "by_hand.toml").write_text((SMALL + SHORT).replace("band_dB = -3.0", "band_dB = -6.0"))
    design, rig = read_study(tmp_path / "by_hand.toml")
    plant = build_plant(design, rig.with_parameters({"mass": 1.1 * rig.parameters()["mass"].value}))
    K = StateSpace(c["A"], c["B"], c["C"], c["D"], inputs=c["inputs"], outputs=c["outputs"])
    peak = mu_peak(plant.synthesis.closed(K), plant.synthesis.all_blocks)
    # Bounds enclose the same number, whatever slack each was computed with.
    assert row["figures"]["mu_lower"] <= peak.upper * (1 + 1e-6)
    assert peak.lower <= row["figures"]["mu_upper"] * (1 + 1e-6)
    assert row["figures"]["mu_upper"] == pytest.approx(peak.upper, rel=0.01)
    motion = plant.full.restricted([*plant.floor_velocities], [*plant.velocities]).closed(K)
    worst = 20 * np.log10(worst_case_gain(motion, plant.synthesis.blocks).upper)
    assert row["figures"]["worst_case_peak_transmissibility_dB"] == pytest.approx(worst, abs=0.1)


LAG_HZ = 120.0
PLAN = f"""
duration_s = 25.0
settle_s = 5.0
band_Hz = [0.5, 60.0]
amplifier_corner_Hz = {LAG_HZ}
[floor_sensor]
recorded = false
[[record]]
excitation = "noise"
level_V = 0.08
records = 2
[[record]]
excitation = "noise"
level_V = 0.3
records = 2
"""


@pytest.mark.slow
def test_the_gap_of_a_simulated_lag(tmp_path):
    """Named where the sweep's point does not know of it, and not where it does."""
    table = load_rig("avis")
    (tmp_path / "plan.toml").write_text(PLAN)
    write_campaign(tmp_path / "campaign.h5", perturbed_campaign(table, read_plan(tmp_path / "plan.toml"), 1).campaign)
    (tmp_path / "points.toml").write_text(f"""
kind = "gap"
base = "campaign.h5"
rig = "avis"
[[point]]
seed = 1
[[point]]
amplifier_corner_Hz = {LAG_HZ}
""")
    (tmp_path / "out" / "points").mkdir(parents=True)
    plan = plan_sweep(tmp_path / "points.toml", tmp_path / "out")
    found = run_sweep(plan, lambda tasks: on_this_machine(tasks, 1))
    assert [row.status for row in found.rows] == ["done", "done"], [row.message for row in found.rows]
    unknown, known = (row.figures for row in found.rows)
    assert "actuator_lag" in unknown["effects"] and "actuator_lag" not in known["effects"]
    assert unknown["nrmse"] < 0.5 * unknown["nrmse_identified"]
