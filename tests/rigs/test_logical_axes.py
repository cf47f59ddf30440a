"""Actuator and sensor matrices against forces and motions at the places, and least norm against an optimiser."""

import tomllib
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import COORDINATES, load_rig
from avis_ctrl.rigs.logical_axes import actuator_axes, sensor_axes
from avis_ctrl.rigs.rig_file import rig_from

TABLES = Path(__file__).parents[2] / "designs" / "rigs"
RIGS = ["avis", "halcyonics", "halcyonics_loaded"]


@pytest.mark.parametrize("name", RIGS)
def test_allocated_voltages_make_the_force_asked_and_no_other(name, rng):
    rig = load_rig(name)
    body, axes = rig.mounted_body(), actuator_axes(rig)
    wanted = rng.normal(size=6)
    volts = axes.allocation @ wanted
    forces = [a.constant_N_per_V * v * a.direction for a, v in zip(body.actuators, volts, strict=True)]
    moments = [np.cross(a.position, f) for a, f in zip(body.actuators, forces, strict=True)]
    assert np.allclose(np.concatenate([np.sum(forces, axis=0), np.sum(moments, axis=0)]), wanted, atol=1e-12)


@pytest.mark.parametrize("name", RIGS)
def test_the_kept_axes_push_nothing_else(name):
    rig = load_rig(name)
    axes = actuator_axes(rig, ("z", "phi_x"))
    pushed = rig.equations_of_motion().T @ axes.allocation
    assert np.allclose(pushed, np.eye(6)[:, [2, 3]], atol=1e-12)


def test_allocation_is_the_one_of_least_norm(rng):
    rig, wanted = load_rig("avis"), rng.normal(size=6)
    volts = cp.Variable(8)
    cp.Problem(cp.Minimize(cp.sum_squares(volts)), [rig.equations_of_motion().T @ volts == wanted]).solve("CLARABEL")
    assert np.allclose(actuator_axes(rig).allocation @ wanted, volts.value, atol=1e-6)


@pytest.mark.parametrize("name", RIGS)
def test_sensors_decode_any_rigid_motion(name, rng):
    rig = load_rig(name)
    q = rng.normal(size=6)
    seen = [n @ (q[:3] + np.cross(q[3:], p)) for p, n in rig.sensor_axes().values()]
    assert np.allclose(sensor_axes(rig).decoding @ seen, q, atol=1e-12)
    assert np.allclose(sensor_axes(rig, ("z", "phi_x")).decoding @ seen, q[[2, 3]], atol=1e-12)


def test_condition_numbers_do_not_depend_on_units():
    """By hand for z and phi_x of four equal vertical motors at y = +-0.375: orthogonal rows, condition 1."""
    rig = load_rig("avis")
    four = ["Az1", "Az2", "Az3", "Az4"]
    assert actuator_axes(rig, ("z", "phi_x"), four).condition == pytest.approx(1.0)
    assert 1.0 < actuator_axes(rig).condition < 2.0 and 1.0 < sensor_axes(rig).condition < 3.0


def test_axes_out_of_reach_are_named():
    rig = load_rig("avis")
    with pytest.raises(InputError, match="x cannot be pushed independently by the actuators"):
        actuator_axes(rig, ("x", "z"), ["Az1", "Az2", "Az3", "Az4"])
    with pytest.raises(InputError, match="cannot be pushed independently"):
        actuator_axes(rig, ("z", "phi_x", "phi_y"), ["Az1", "Az2"])
    with pytest.raises(InputError, match="cannot be distinguished by the sensors"):
        sensor_axes(rig, COORDINATES, ["Sz1", "Sz2", "Sz3", "Sx2", "Sy1"])
    with pytest.raises(InputError, match="out of"):
        sensor_axes(rig, ("z",), ["Sz9"])
    for axes, words in ((actuator_axes, "cannot be pushed"), (sensor_axes, "cannot be distinguished")):
        with pytest.raises(InputError, match=f"x and z {words}"):
            axes(rig, ("x", "z"), [])


def test_two_motors_on_a_line_cannot_tell_z_from_the_roll():
    """Az1 and Az2 both stand at y = -0.375: z and phi_x only in the fixed ratio of the arm."""
    with pytest.raises(InputError, match="z and phi_x cannot be pushed independently"):
        actuator_axes(load_rig("avis"), ("z", "phi_x"), ["Az1", "Az2"])


def test_two_sensors_on_a_line_read_z_with_the_roll():
    """Sz1 and Sz2 both stand at y = -0.375: the mean of the two is z - 0.375 phi_x."""
    rig = load_rig("avis")
    found = sensor_axes(rig, ("z",), ["Sz1", "Sz2"])
    assert np.allclose(found.decoding, [[0.5, 0.5]], atol=1e-12)
    assert np.allclose(found.leftover[0], [0, 0, -0.375 / rig.edge_m, 0, 0], atol=1e-12)


def test_five_drives_push_what_is_asked_and_as_little_else_as_they_can():
    """Leftover of the tripod without one tangential drive, rotations at the edge, against an optimiser."""
    rig = load_rig(TABLES / "tripod.toml")
    five = ["V1", "V2", "H2", "V3", "H3"]
    found = actuator_axes(rig, ("x", "z"), five)
    T = found.matrix / np.array([1, 1, 1, *[rig.edge_m] * 3])[:, None]
    volts = cp.Variable((5, 2))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(T[[1, 3, 4, 5]] @ volts)), [T[[0, 2]] @ volts == np.eye(2)])
    problem.solve("CLARABEL")
    assert np.allclose(T[[0, 2]] @ found.allocation, np.eye(2), atol=1e-12)
    assert np.sum(found.leftover**2) == pytest.approx(problem.value, rel=1e-6) and problem.value > 0.01


def test_noisy_sensors_count_less():
    """Decoding of twelve sensors against generalised least squares with each sensor's noise as velocity, 1 to 30 Hz."""
    rig = load_rig(TABLES / "twelve_sensors.toml")
    omega = 2 * np.pi * np.geomspace(1.0, 30.0, 20)
    lsb = 20.0 / 2**16
    sigma = np.array(
        [
            np.hypot(one.noise_rms_V, lsb / np.sqrt(12))
            / one.gain
            * np.exp(-np.mean(np.log(np.abs(one.as_velocity(omega)))))
            for one in rig.sensors()
        ]
    )
    found = sensor_axes(rig)
    H = found.matrix / sigma[:, None]
    assert np.allclose(found.decoding, np.linalg.solve(H.T @ H, H.T) / sigma, atol=1e-9)


def test_position_sensors_alone_measure_all_axes_relative_to_the_chassis():
    """Three along z at the corners of a triangle, one along x, two along y."""
    content = tomllib.loads((TABLES / "granite.toml").read_text(encoding="utf-8"))
    del content["geophone"]
    where = [([1.0, 0.0, 0.0], [0.0, 0.0, 0.3])]
    where += [([0.0, 1.0, 0.0], [x, 0.0, 0.0]) for x in (-0.3, 0.3)]
    where += [([0.0, 0.0, 1.0], place) for place in ([0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [0.0, -0.3, 0.0])]
    content["position_sensor"] = [
        {**content["position_sensor"][0], "name": f"P{k}", "direction": direction, "position_m": place}
        for k, (direction, place) in enumerate(where)
    ]
    found = sensor_axes(rig_from(content))
    assert found.relative == COORDINATES and not np.any(found.inertial)
    assert np.allclose(found.decoding @ found.matrix, np.eye(6), atol=1e-12)
