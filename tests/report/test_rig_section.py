"""The report's section on the rig: drives and sensors of tables whose channels are not in the isolators."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from avis_ctrl.report.elements import Table
from avis_ctrl.report.sections.rig import rig as section
from avis_ctrl.rigs.reduction_error import reduction_error
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.study.identification_design import default_design

RIGS = Path(__file__).parents[2] / "designs" / "rigs"


def tables(rig) -> dict[str, dict[str, dict[str, str]]]:
    """By the caption's first word, by the name in the first column, cells by header."""
    design = default_design(rig, "rig")
    made = section(SimpleNamespace(rig=rig, design=design, reduction=reduction_error(rig, design.keep)))
    found = [p for p in made.pieces if isinstance(p, Table)]
    return {
        t.caption.split()[0].rstrip(":,"): {row[0]: dict(zip(t.header, row, strict=True)) for row in t.rows}
        for t in found
    }


def test_sensors_of_several_kinds_have_their_place_gain_corner_and_limit():
    shown = tables(load_rig(RIGS / "granite.toml"))["Sensors"]
    assert list(shown) == ["Gz1", "Gz2", "Gx1", "Gy1", "Pz1", "Pz2", "Pz3", "Px1", "Py1", "Py2"]
    assert shown["Gz2"] == {
        "name": "Gz2",
        "kind": "geophone",
        "x, y, z [m]": "1, 0.3, 0",
        "direction": "+z",
        "gain": "20000 V s/m",
        "corner": "high-pass 1.00 Hz (0.70)",
        "noise": "2.00 mV",
        "limit": "±0.500 mm/s",
    }
    assert shown["Px1"] == {
        "name": "Px1",
        "kind": "position sensor",
        "x, y, z [m]": "1.35, 0, −0.2",
        "direction": "+x",
        "gain": "20000 V/m",
        "corner": "low-pass 500 Hz",
        "noise": "0.500 mV",
        "limit": "±0.500 mm",
    }


def test_single_drives_have_their_place_direction_and_own_limit():
    rig = load_rig(RIGS / "skewed.toml")
    rig = replace(rig, drives=(*rig.drives[:-1], replace(rig.drives[-1], limit_V=4.0)))
    shown = tables(rig)
    assert list(shown["Drives"]) == ["L1", "L2", "L3", "L4", "L5", "L6"]
    assert shown["Drives"]["L1"] == {
        "name": "L1",
        "x, y, z [m]": "0.3007, 0.1094, −0.06",
        "direction": "−0.242, 0.664, 0.707",
        "force constant": "5.00 N/V",
        "limit": "±10.0 V",
        "largest force": "±50.0 N",
    }
    assert (shown["Drives"]["L6"]["limit"], shown["Drives"]["L6"]["largest force"]) == ("±4.00 V", "±20.0 N")
    accelerometer = shown["Sensors"]["A1"]
    assert (accelerometer["kind"], accelerometer["gain"], accelerometer["corner"], accelerometer["limit"]) == (
        "accelerometer",
        "100 V s²/m",
        "high-pass 0.300 Hz",
        "±0.100 m/s²",
    )
    assert tables(load_rig(RIGS / "tripod.toml"))["Drives"]["H1"]["direction"] == "−x"


@pytest.mark.parametrize(
    ("name", "sensor", "corner", "limit"),
    [
        ("avis", "Sy1", "high-pass 0.500 Hz (0.70); suspension 4.50 Hz (0.56)", "±3.20 mm/s"),
        ("halcyonics", "acc_A1", "high-pass 0.300 Hz", None),
    ],
)
def test_shipped_rigs_are_shown_alike(name, sensor, corner, limit):
    rig = load_rig(name)
    shown = tables(rig)
    assert list(shown["Drives"]) == list(rig.equations_of_motion().actuators)
    assert list(shown["Sensors"]) == list(rig.sensor_rows()[0])
    assert shown["Sensors"][sensor]["corner"] == corner and shown["Sensors"][sensor].get("limit") == limit


def test_a_position_sensor_without_lag_has_no_corner():
    rig = load_rig(RIGS / "granite.toml")
    rig = replace(
        rig, instruments=tuple(replace(one, bandwidth_Hz=None) if one.name == "Pz1" else one for one in rig.instruments)
    )
    assert tables(rig)["Sensors"]["Pz1"]["corner"] == "none"
