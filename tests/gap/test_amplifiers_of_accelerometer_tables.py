"""Amplifiers of tables with accelerometers, which no rig file states: campaigns of an independent simulator."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from avis_ctrl import campaign
from avis_ctrl.gap.analysis import analyse
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import SETTINGS as CAMPAIGN
from benchmarks.own_tables import tables
from benchmarks.own_tables.campaign import Settings, write_campaign

RIGS = Path(__file__).parents[2] / "designs" / "rigs"
SHORT = Settings(period_s=10.0, noise_s=60.0, validation_s=40.0, rest_s=20.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "corner_Hz", "named"), [("skewed", 90.0, True), ("skewed", 300.0, False), ("twelve_sensors", None, False)]
)
def test_a_slow_amplifier_is_named_and_a_fast_one_is_no_effect(tmp_path, name, corner_Hz, named):
    """The default is 300 Hz. Two legs of the table "skewed" are at almost 45 degrees."""
    table = tables.truth(name, 3)
    table = replace(table, drives=tuple(replace(drive, corner_Hz=corner_Hz) for drive in table.drives))
    write_campaign(table, "multisine", tmp_path / "campaign.h5", seed=7, settings=SHORT)
    rig = load_rig(RIGS / f"{name}.toml")
    found = analyse(campaign(tmp_path / "campaign.h5"), rig, amplifier_corner_Hz=CAMPAIGN.amplifier_corner_Hz)
    assert [one.name for one in found.effects] == (["actuator_lag"] if named else [])
    assert found.stages[-1].chi2_per_dof < 1.1
    if named:
        told = found.effects[0].parameters["corner_Hz"]
        assert abs(told.value - corner_Hz) < 3 * told.std and told.std < 0.1
