"""Rig files written and read back."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_writer import rig_toml

NAMES = ("avis", "halcyonics", "halcyonics_loaded")


def read_back(rig):
    return rig_from(tomllib.loads(rig_toml(rig)), loaded=getattr(rig, "load", None) is not None)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_rigs_come_back(name, tmp_path):
    rig = load_rig(name)
    path = tmp_path / "mine.toml"
    path.write_text(rig_toml(rig, header="one\ntwo"), encoding="utf-8")
    assert load_rig(path, loaded=name.endswith("loaded")) == rig
    assert path.read_text().startswith("# one\n# two\nname = ")


@settings(max_examples=100, deadline=None)
@given(name=st.sampled_from(NAMES), data=st.data())
def test_any_parameters_come_back_with_all_digits(name, data):
    rig = load_rig(name)
    known = [one for one in rig.parameters() if one != "k_s"]
    chosen = data.draw(st.lists(st.sampled_from(known), unique=True, max_size=8))
    # Inertia only so far that there is a body that has it.
    factors = {
        one: data.draw(st.floats(0.995, 1.005) if "I" in one or "J" in one else st.floats(0.5, 2.0)) for one in chosen
    }
    changed = rig.with_parameters(
        {one: rig.parameters()[one].value * factor for one, factor in factors.items() if not one.startswith("load.I")}
    )
    again = read_back(changed)
    values, found = changed.parameters(), again.parameters()
    for one in values:
        # The load's inertia is stored in a sum with the plate's: the last digit of the sum is what comes back.
        slack = np.spacing(1.0) if one.startswith("load.I") else 0.0
        assert abs(found[one].value - values[one].value) <= slack, one
    if changed.name == "avis":
        assert again == changed


def test_what_only_some_rigs_have(tmp_path):
    avis = load_rig("avis")
    offset = replace(avis.isolators[1], chassis_offset=(0.01, -0.003, -0.1))
    moved = replace(
        avis,
        isolators=(avis.isolators[0], offset, *avis.isolators[2:]),
        ambient=None,
        name='a "quoted" \\ name\x7f of \u00b5m',
    )
    assert np.allclose(read_back(moved).isolators[1].chassis_offset, offset.chassis_offset, rtol=0, atol=1e-16)
    assert read_back(moved).ambient is None and read_back(moved).name == moved.name
    loaded = load_rig("halcyonics_loaded")
    other = replace(
        loaded,
        load=replace(loaded.load, Izz=0.1875, Ixy=0.01, Ixz=-0.02, Iyz=0.003),
        k_s=(1e4, 1.1e4, 1.2e4, 1.3e4),
        M2_arm=0.21,
        ambient=avis.ambient,
    )
    assert read_back(other) == other


def test_comments_stand_behind_their_lines():
    text = rig_toml(
        load_rig("avis"),
        {
            "mass": "500 +- 3 kg",
            "isolator2.k_x": "fixed",
            "isolator2.k_z": "free",
            "isolator[3].damping_Ns_per_m": "guess # not measured",
        },
    )
    lines = text.splitlines()
    assert "mass_kg = 500.0  # 500 +- 3 kg" in lines
    assert "stiffness_N_per_m = [21500.0, 20000.0, 47000.0]  # fixed; free" in lines
    assert "damping_Ns_per_m = [92.0, 98.0, 150.0]  # guess # not measured" in lines
    assert rig_from(tomllib.loads(text)) == load_rig("avis")
    assert "k_s_N_per_m = 11300.0  # all four" in rig_toml(load_rig("halcyonics"), {"k_s3": "all four"})


@pytest.mark.parametrize("comments", [{"isolator9.k_x": "no"}, {"mass": "two\nlines"}, {"mass": "bell\a"}])
def test_comments_that_cannot_be_written(comments):
    with pytest.raises(InputError, match="comments"):
        rig_toml(load_rig("avis"), comments)
    with pytest.raises(InputError, match="expected an IsolatorTable"):
        rig_toml(object())
