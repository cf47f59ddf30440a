"""Tables of a user's own: drives and sensors anywhere, any number of mounts; the files in designs/rigs."""

import copy
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.logical_axes import drivable
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.rigs.sensing import conditioning

RIGS = Path(__file__).parents[2] / "designs" / "rigs"
NAMES = ("tripod", "four_vertical", "twelve_sensors", "skewed", "granite")


def content_of(name):
    return tomllib.loads((RIGS / f"{name}.toml").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_a_table_is_written_and_read_back_the_same(name):
    rig = load_rig(RIGS / f"{name}.toml")
    assert rig_from(tomllib.loads(rig_toml(rig))) == rig


@pytest.mark.parametrize("name", NAMES)
def test_forces_and_readings_are_those_of_places_and_directions_in_the_file(name, rng):
    """A drive makes c d and the moment p x c d; a sensor reads n (t + r x p). Directions of any length."""
    content = content_of(name)
    for one in (*content["drive"], *content.get("geophone", [])):
        one["direction"] = [3.0 * part for part in one["direction"]]
    rig = rig_from(content)
    q, T = rng.normal(size=6), rig.equations_of_motion().T
    for column, one in zip(T.T, content["drive"], strict=True):
        d = np.array(one["direction"]) / np.linalg.norm(one["direction"]) * one["constant_N_per_V"]
        assert np.allclose(column, [*d, *np.cross(one["position_m"], d)])
    names, rows = rig.sensor_rows()
    sensors = [one for kind in ("geophone", "accelerometer", "position_sensor") for one in content.get(kind, [])]
    assert names == tuple(one["name"] for one in sensors)
    for seen, one in zip(rows @ q, sensors, strict=True):
        n = np.array(one["direction"]) / np.linalg.norm(one["direction"])
        assert seen == pytest.approx(n @ (q[:3] + np.cross(q[3:], one["position_m"])))


def test_each_sensor_has_its_own_dynamics():
    """By the formulas of the three kinds, at three frequencies."""
    omega = 2 * np.pi * np.array([0.3, 3.0, 200.0])
    s = 1j * omega
    twelve = {one.name: one for one in load_rig(RIGS / "twelve_sensors.toml").sensors()}
    granite = {one.name: one for one in load_rig(RIGS / "granite.toml").sensors()}
    w, b = 2 * np.pi * 0.4, 2 * np.pi * 500.0
    expected = {
        ("velocity", twelve["Gv1"]): 60.0 * 200.0 * s**2 / (s**2 + 2 * 0.7 * w * s + w**2),
        ("acceleration", twelve["Az1"]): 100.0 * s / (s + 2 * np.pi * 0.3),
        ("velocity", granite["Gz1"]): 100.0 * 200.0 * s**2 / (s**2 + 1.4 * 2 * np.pi * s + (2 * np.pi) ** 2),
        ("displacement", granite["Pz1"]): 2e4 * b / (s + b),
    }
    for (quantity, sensor), response in expected.items():
        assert sensor.quantity == quantity
        assert np.allclose(sensor.chain().frequency_response(omega)[:, 0, 0], response, rtol=1e-9)
        of_velocity = response * s ** {"displacement": -1, "velocity": 0, "acceleration": 1}[quantity]
        assert np.allclose(sensor.gain * sensor.as_velocity(omega), of_velocity, rtol=1e-9)
        white = 1e-3 * np.sqrt(2 / 1000.0) / sensor.gain
        assert replace(sensor, noise_rms_V=1e-3).motion_density(None, 1000.0) == pytest.approx(white)


def test_attached_and_placed_channels_are_one_table():
    """The shipped AVIS with one motor and one geophone written as placed ones is the same table."""
    avis = load_rig("avis")
    content = tomllib.loads(rig_toml(avis))
    for section, kind in (("actuators", "drive"), ("geophones", "geophone")):
        lists = content[section]
        last = {key: value.pop() for key, value in lists.items() if isinstance(value, list)}
        isolator = content["isolator"][last.pop("isolator") - 1]
        name, axis = last.pop("names"), "xyz".index(last.pop("axis"))
        shared = {key: value for key, value in lists.items() if not isinstance(value, list) and key != "limit_V"}
        content[kind] = [
            {
                "name": name,
                "position_m": isolator["position_m"],
                "direction": np.eye(3)[axis].tolist(),
                **last,
                **shared,
            }
        ]
    other = rig_from(content)
    assert np.array_equal(other.equations_of_motion().T, avis.equations_of_motion().T)
    assert other.sensors() == avis.sensors()
    known = other.parameters()
    assert {name: known[name] for name in avis.parameters()} == avis.parameters()
    assert {name.split(".")[1] for name in known.keys() - avis.parameters().keys()} == {"Az4", "Sz3"}
    louder = other.with_sensor_gains({"Sz3": 100.0, "Sy1": 50.0})
    assert [one.gain for one in louder.sensors()] == pytest.approx([50.0, 3125, 3125, 3125, 3125, 100.0])


def test_limits_of_single_drives_are_kept():
    content = content_of("tripod")
    content["drive"][1]["limit_V"] = 4.0
    rig = rig_from(content)
    assert rig.drive_limits_V().tolist() == [10.0, 4.0, 10.0, 10.0, 10.0, 10.0] and rig.drive_limit_V == 10.0


def test_tolerances_are_read_and_written_back():
    shared = Path(__file__).parents[3] / "shared" / "rigs" / "avis_tolerances.toml"
    content = tomllib.loads(rig_toml(load_rig("avis"))) | {"tolerances": {"place_m": 0.00115}}
    assert rig_from(content).tolerances.place_m == 0.00115 and rig_from(content).tolerances.direction_rad == 0.005
    if shared.exists():
        rig = load_rig(shared)
        assert rig.tolerances.product_of_inertia_kgm2 == 0.17
        assert rig_from(tomllib.loads(rig_toml(rig))) == rig
    with pytest.raises(InputError, match=r"tolerances.place_m = -1.0"):
        rig_from(content | {"tolerances": {"place_m": -1.0}})


def changed(change):
    content = copy.deepcopy(content_of("granite"))
    change(content)
    return content


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c: c["drive"][0].update(direction=[0.0, 0.0, 0.0]), r"drive\[1\].direction.*a vector that is not zero"),
        (lambda c: c["drive"][0].update(direction=[0.0, 1.0]), r"drive\[1\].direction.*at least 3 items"),
        (lambda c: c["drive"][3].update(name="X1"), r"drive = 'X1': expected different names"),
        (lambda c: c["geophone"][0].update(name="Pz1"), r"'Pz1': expected different names"),
        (lambda c: c["geophone"][1].update(compensated_Hz=0.5), r"geophone\[2\].compensated_damping.*both or neither"),
        (lambda c: c["position_sensor"][0].update(noise_m_rtHz=1e-9), r"position_sensor\[1\].noise_rms_V.*not both"),
        (lambda c: c.update(drive=[]), "drive: expected at least one drive"),
        (lambda c: [c.pop(kind) for kind in ("geophone", "position_sensor")], "expected at least one geophone"),
        (lambda c: c.pop("actuators"), r"drive\[1\].limit_V: this key is missing"),
        (lambda c: c["drive"][0].update(name="a drive"), r"drive\[1\].name"),
        (
            lambda c: c["drive"][0].update(position_mm=1.0),
            "position_mm.*unit in this key is wrong; expected position_m",
        ),
    ],
)
def test_what_is_wrong_is_named(change, message):
    with pytest.raises(InputError, match=message):
        rig_from(changed(change))


@pytest.mark.parametrize(("tilt_rad", "driven"), [(0.0, ("z",)), (0.01, ("z",)), (0.04, ()), (0.1, ())])
def test_a_drive_that_stands_askew_drives_no_coordinate_by_itself(tilt_rad, driven):
    """One drive at the centre of mass: drawings give directions to 0.005 rad, beyond 0.02 rad it is meant."""
    content = content_of("four_vertical")
    content["drive"] = [
        {
            **content["drive"][0],
            "position_m": [0.0, 0.0, 0.0],
            "direction": [float(np.sin(tilt_rad)), 0.0, float(np.cos(tilt_rad))],
        }
    ]
    assert drivable(rig_from(content)) == driven


@pytest.mark.parametrize("name", NAMES)
def test_every_conditioned_channel_shows_velocity_alike(name):
    """Motion in space above one common corner of second order, motion against the chassis below the
    differentiator's."""
    rig, f = load_rig(RIGS / f"{name}.toml"), np.array([1e-3, 1e-2, 0.05, 1.0, 10.0, 50.0])
    shown = {True: [], False: []}
    for sensor, own in zip(rig.sensors(), conditioning(rig, 0.1), strict=True):
        s = 2j * np.pi * f
        digital = (
            own.leading
            * np.prod([s - zero for zero in own.zeros], axis=0)
            / np.prod([s - pole for pole in own.poles], axis=0)
        )
        shown[sensor.inertial].append(sensor.as_velocity(2 * np.pi * f) * digital)
    for inertial, alike in shown.items():
        if alike:
            assert np.allclose(alike, alike[0], rtol=1e-9)
            assert alike[0][-1 if inertial else 2] == pytest.approx(1.0, abs=0.05)
            assert abs(alike[0][1] / alike[0][0]) == pytest.approx(100.0 if inertial else 1.0, rel=0.02)
