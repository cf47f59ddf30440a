"""The linear AVIS against Newton's laws recomputed from positions (Rademakers, eqs. 2.8-2.21)."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_writer import rig_toml

PX, PY, PZ = 0.475, 0.375, 0.175  # Table 3.1
PLACES = [(-PX, -PY, -PZ), (PX, -PY, -PZ), (PX, PY, -PZ), (-PX, PY, -PZ)]


@pytest.fixture(scope="module")
def rig():
    return load_rig("avis")


@pytest.fixture(scope="module")
def skew(rig):
    """Offset centre of mass, products of inertia: everything that the symmetric table hides."""
    return rig.with_parameters({"com_x": 0.05, "com_y": -0.03, "com_z": 0.12, "J12": 3.0, "J13": -2.0, "J23": 4.0})


def wrench_of_mounts(rig, key, motion, floor):
    """Force and moment about the geometric centre of the springs ("k") or dampers ("c")."""
    values, force, moment = rig.parameters(), np.zeros(3), np.zeros(3)
    for i, place in enumerate(PLACES, 1):
        k = np.array([values[f"isolator{i}.{key}_{axis}"].value for axis in "xyz"])
        stretch = (motion[:3] + np.cross(motion[3:], place)) - (floor[:3] + np.cross(floor[3:], place))
        force, moment = force - k * stretch, moment - np.cross(place, k * stretch)
    return np.concatenate([force, moment])


def test_stiffness_damping_and_floor_matrices_are_newtons(rig):
    eom, none = rig.equations_of_motion(), np.zeros(6)
    for key, own, floor in (("k", eom.K, eom.K_floor), ("c", eom.C, eom.C_floor)):
        by_hand = np.column_stack([wrench_of_mounts(rig, key, e, none) for e in np.eye(6)])
        from_floor = np.column_stack([wrench_of_mounts(rig, key, none, e) for e in np.eye(6)])
        assert np.allclose(own, -by_hand, rtol=1e-13, atol=1e-9)
        assert np.allclose(floor, from_floor, rtol=1e-13, atol=1e-9)


def test_actuators_push_where_eq_2_18_says(rig):
    layout = {
        "Ay1": (0, 1),
        "Az1": (0, 2),
        "Ax2": (1, 0),
        "Az2": (1, 2),
        "Ay3": (2, 1),
        "Az3": (2, 2),
        "Ax4": (3, 0),
        "Az4": (3, 2),
    }
    eom = rig.equations_of_motion()
    assert eom.actuators == tuple(layout)  # the order of u, eq. 2.24
    for column, (isolator, axis) in zip(eom.T.T, layout.values(), strict=True):
        force = 2.0 * np.eye(3)[axis]
        assert np.allclose(column, np.concatenate([force, np.cross(PLACES[isolator], force)]))


def test_mass_matrix_with_offset_is_the_kinetic_energy(skew, rng):
    c, J = np.array([0.05, -0.03, 0.12]), np.array([[28.5, 3.0, -2.0], [3.0, 42.7, 4.0], [-2.0, 4.0, 61.0]])
    M = skew.equations_of_motion().M
    for _ in range(5):
        v = rng.normal(size=6)
        centre = v[:3] + np.cross(v[3:], c)
        assert v @ M @ v == pytest.approx(500.0 * centre @ centre + v[3:] @ J @ v[3:], rel=1e-12)


def test_matrices_are_symmetric_and_passive(skew):
    eom = skew.equations_of_motion()
    for matrix in (eom.M, eom.C, eom.K):
        assert np.allclose(matrix, matrix.T, rtol=1e-14) and np.linalg.eigvalsh(matrix)[0] > 0


def test_static_and_high_frequency_limits(skew):
    eom = skew.equations_of_motion()
    system = eom.state_space()
    assert np.allclose(system.dcgain()[:6, 8:], np.eye(6), atol=1e-9)  # the payload follows the floor
    w = 2 * np.pi * 1e4
    high = system.frequency_response(np.array([w]))[0]
    assert np.allclose(-(w**2) * high[:6, :8], np.linalg.solve(eom.M, eom.T), rtol=1e-3, atol=1e-6)


def test_natural_frequencies_of_the_symmetric_table_by_hand(rig):
    """Equal isolators: z and phi_z alone, (x, phi_y) and (y, phi_x) in pairs; quadratic formula."""
    kx, ky, kz = 21e3, 20e3, 46e3
    equal = rig.with_parameters(
        {f"isolator{i}.k_{a}": k for i in range(1, 5) for a, k in zip("xyz", (kx, ky, kz), strict=True)}
    )

    def pair(J, k, kr):
        half, product = (k / 500.0 + kr / J) / 2, (k * kr - (k * PZ) ** 2) / (500.0 * J)
        root = np.sqrt(half**2 - product)
        return [np.sqrt(half - root), np.sqrt(half + root)]

    expected = [
        np.sqrt(4 * kz / 500.0),
        np.sqrt(4 * (kx * PY**2 + ky * PX**2) / 61.0),
        *pair(42.7, 4 * kx, 4 * (kz * PX**2 + kx * PZ**2)),
        *pair(28.5, 4 * ky, 4 * (kz * PY**2 + ky * PZ**2)),
    ]
    found = equal.equations_of_motion().natural_frequencies().frequencies_Hz
    assert np.allclose(found, np.sort(expected) / (2 * np.pi), rtol=1e-12)


def test_resonances_lie_in_the_range_of_section_2_1_1(rig):
    """The source states 1.5 Hz to 5 Hz; the assumed numbers reach 5.24 Hz, 5 % beyond it."""
    found = rig.equations_of_motion().natural_frequencies().frequencies_Hz
    assert found[0] > 1.5 and found[-1] < 1.05 * 5.0


def test_unequal_vertical_stiffness_couples_z_phi_x_and_phi_y(rig):
    K, k = rig.equations_of_motion().K, [45e3, 47e3, 42e3, 50e3]
    assert K[2, 3] == pytest.approx(sum(ki * p[1] for ki, p in zip(k, PLACES, strict=True)))
    assert K[2, 4] == pytest.approx(-sum(ki * p[0] for ki, p in zip(k, PLACES, strict=True)))


def test_parameters_by_the_names_of_the_source(rig):
    values = {name: p.value for name, p in rig.parameters().items()}
    assert values["isolator2.k_z"] == 47e3 and values["isolator4.c_x"] == 98.0 and values["actuator.Az1"] == 2.0
    assert rig.with_parameters(values) == rig
    changed = rig.with_parameters({"isolator2.k_z": 54e3, "actuator.Az3": 2.2, "J2": 40.0})
    assert changed.isolators[1].stiffness == (21.5e3, 20e3, 54e3) and changed.inertia[1] == 40.0
    assert changed.parameters()["actuator.Az3"].value == 2.2
    assert rig.edge_m == 0.375
    with pytest.raises(InputError, match=r"did you mean 'isolator2\.k_z'"):
        rig.with_parameters({"isolator2.kz": 1.0})
    with pytest.raises(InputError, match="positive definite"):
        rig.with_parameters({"J12": 50.0})


def test_geophones_see_along_their_axes_at_their_isolators(rig):
    names, rows = rig.sensor_rows()
    assert names == ("Sy1", "Sz1", "Sx2", "Sz2", "Sy3", "Sz3")
    q = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    moved = {i: q[:3] + np.cross(q[3:], PLACES[i - 1]) for i in (1, 2, 3)}
    assert np.allclose(rows @ q, [moved[1][1], moved[1][2], moved[2][0], moved[2][2], moved[3][1], moved[3][2]])


def test_points_for_the_drawing(rig):
    kinds = {name: place.kind for name, place in rig.points().items()}
    assert kinds["isolator3"] == "isolator" and kinds["Az4"] == "actuator" and kinds["Sx2"] == "sensor"


def test_a_direction_turns_past_the_point_where_another_component_is_the_largest():
    """A leg at about 45 degrees: which component follows from the other two must not change during a fit."""
    rig = load_rig(Path(__file__).parents[2] / "designs" / "rigs" / "skewed.toml")
    leg = "direction.L5."
    assert {name for name in rig.parameters() if name.startswith(leg)} == {leg + "x", leg + "y"}
    turned = rig.with_parameters({leg + "x": 0.75, leg + "y": -0.1})
    assert turned.parameters().keys() == rig.parameters().keys()
    back = turned.with_parameters({leg + "x": 0.6964, leg + "y": -0.1228})
    force = np.array([drive.direction for drive in back.all_drives])
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), 1.0, rtol=1e-9)
    np.testing.assert_allclose(force, [drive.direction for drive in rig.all_drives], atol=1e-4)
    assert turned.all_drives[4].direction[2] == pytest.approx(np.sqrt(1 - 0.75**2 - 0.1**2))
    # The file has the direction only; a model file names the two components that were free.
    read = rig_from(tomllib.loads(rig_toml(turned)))
    assert leg + "z" in read.parameters()
    assert read.with_directions_by(turned.parameters()).parameters().keys() == rig.parameters().keys()


@pytest.mark.parametrize("apart", [False, True])
def test_slopes_of_all_matrices_are_those_of_differences(skew, apart):
    """By every parameter; a chassis attachment beside the payload's, motors and geophones in the isolators or apart."""
    first = replace(skew.isolators[0], chassis_offset=(0.02, -0.01, -0.1))
    rig = replace(skew, isolators=(first, *skew.isolators[1:]))
    if apart:
        rig = rig.with_channels_apart().with_parameters({"direction.Ay1.x": 0.3, "direction.Sz1.y": -0.2})

    def matrices(rig):
        eom, (_, R) = rig.equations_of_motion(), rig.sensor_rows()
        return {"M": eom.M, "C": eom.C, "K": eom.K, "C_floor": eom.C_floor, "K_floor": eom.K_floor, "T": eom.T, "R": R}

    channels = {"T": rig.equations_of_motion().actuators, "R": rig.sensor_rows()[0]}
    for name, parameter in rig.parameters().items():
        found = {which: np.zeros_like(matrix) for which, matrix in matrices(rig).items()}
        for which, channel, slope in rig.slopes(name):
            place = found[which].T if which == "T" else found[which]
            place[channels[which].index(channel) if channel else slice(None)] = slope
        # Directions alone are no polynomials of second degree, and ask for a small step.
        step = 1e-5 if name.startswith("direction.") else 0.1 * abs(parameter.value) or 1e-3
        up, down = (matrices(rig.with_parameters({name: parameter.value + sign * step})) for sign in (1, -1))
        size = max(1.0, *(np.max(np.abs(slope)) for slope in found.values()))
        for which, slope in found.items():
            np.testing.assert_allclose(slope, (up[which] - down[which]) / (2 * step), atol=2e-9 * size, err_msg=name)
