"""The cases: repeatable, mixed as asked, named as the contract names them, and free of the package's dynamics."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.measurement.formats import read_measurements, write_campaign

from .cases import LIBRARY, OUTSIDE_LIBRARY, channel_change, draw_case, relative_change, rig, simulate_case


@pytest.fixture(autouse=True)
def _needs_rig(shared: Path) -> None:
    """The rig file lies in the shared folder."""


def test_cases_repeat_and_campaigns_follow_the_contract(tmp_path):
    case = draw_case(3, kind="two", duration_s=4.0)
    assert case == draw_case(3, kind="two", duration_s=4.0)
    assert LIBRARY[case.names[0]].family != LIBRARY[case.names[1]].family
    json.dumps(asdict(case))
    one, again, fresh = simulate_case(case), simulate_case(case), simulate_case(case, unseen=True)
    for a, b, c in zip(one.records, again.records, fresh.records, strict=True):
        np.testing.assert_array_equal(a.y, b.y)
        assert a.u.std() == pytest.approx(c.u.std(), rel=0.01) and np.abs(a.u - c.u).max() > a.u.std()
    assert len(one.records) == 6 and one.records[5].header.start_s > 320
    write_campaign(tmp_path / "case.h5", one)
    back = read_measurements(tmp_path / "case.h5")
    np.testing.assert_array_equal(back.records[2].load().y, one.records[2].y)


def test_mixture_of_cases():
    cases = [draw_case(seed) for seed in range(300)]
    shares = {kind: np.mean([case.kind == kind for case in cases]) for kind in ("none", "one", "two", "outside")}
    for kind, share in (("none", 0.20), ("one", 0.45), ("two", 0.15), ("outside", 0.20)):
        assert abs(shares[kind] - share) < 4 * np.sqrt(share * (1 - share) / 300)
    assert {case.excitation for case in cases} == {"multisine", "noise"}
    assert 0.3 < np.mean([case.floor_recorded for case in cases]) < 0.7
    for case in cases:
        assert len(case.effects) == {"none": 0, "one": 1, "two": 2, "outside": 1}[case.kind]
        assert not (case.floor_recorded and "ground_motion" in case.names)
        assert all(name in (OUTSIDE_LIBRARY if case.kind == "outside" else LIBRARY) for name in case.names)


def test_names_and_places_are_those_of_the_contract(shared):
    rows = re.findall(r"^\| `(\w+)` \|[^|]*\| (.*?) \|$", (shared / "contracts" / "gap.md").read_text(), re.M)
    assert {name for name, _ in rows} == set(LIBRARY)
    names = {"sensor": rig().geophones.names, "actuator": tuple(motor.name for motor in rig().motors)}
    for name, place in rows:
        allowed = names.get(place) or tuple(re.findall(r"`([^`]+)`", place))
        for seed in range(4):
            assert draw_case(seed, effect=name, duration_s=20.0).effects[0].location in allowed


def test_relative_change_grows_with_strength():
    for effect in ("mount_relaxation", "mains_hum"):
        faint, gross = (
            relative_change(draw_case(8, effect=effect, strength=s, duration_s=2.0)) for s in ("faint", "gross")
        )
        assert 0 < faint < 0.2 * gross
    case = draw_case(8, effect="sensor_gain", strength="gross", duration_s=3.0)
    change, h = channel_change(case), case.effects[0]
    hit = rig().geophones.names.index(h.location)
    assert np.argmax(change) == hit and np.delete(change, hit).max() == 0
    assert relative_change(draw_case(8, kind="none", duration_s=3.0)) == 0


def test_no_dynamics_of_the_package():
    for file in Path(__file__).parent.glob("*.py"):
        if not file.name.startswith("test_"):
            used = set(re.findall(r"(?:from|import) avis_ctrl\.?([\w.]*)", file.read_text()))
            assert used <= {"measurement.campaign", "rigs"}, file.name
