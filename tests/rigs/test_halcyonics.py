"""The Halcyonics table against Newton's laws, one test for each misprint of the source (Beadle et al.).

Forces and moments are recomputed here from positions by force and lever arm, without the package's matrices.
"""

from dataclasses import replace

import numpy as np
import pytest
from halcyonics_transfer import transfer
from nonlinear_rig import rotation_matrix

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import load_rig

L1, L2, L3, L45, L6 = 0.348, 0.300, 0.550, 0.190, 0.054  # section 3.1 and Table 1
K_S, K_A, K_T, K_R = 11300.0, 7300.0, 37600.0, 1590.0
E_N_PER_V = np.array([6.59, 7.85, 7.07, 8.10, 7.50, 7.89, 6.65, 5.97])
R = np.sqrt(0.5)
ARM = L3 - L1 / 2
ACTUATORS = [  # place and direction of the force, from the figures' description and eq. 19
    ((ARM, -L2 / 2, 0), (0, 0, 1)),
    ((-ARM, -L2 / 2, 0), (0, 0, 1)),
    ((-ARM, L2 / 2, 0), (0, 0, 1)),
    ((ARM, L2 / 2, 0), (0, 0, 1)),
    ((-L45 / 2, -L45 / 2, -L6), (-R, R, 0)),
    ((L45 / 2, -L45 / 2, -L6), (R, R, 0)),
    ((L45 / 2, L45 / 2, -L6), (R, -R, 0)),
    ((-L45 / 2, L45 / 2, -L6), (-R, -R, 0)),
]
SPRINGS = [(sx * L1 / 2, sy * L2 / 2, 0) for sx, sy in ((1, -1), (-1, -1), (-1, 1), (1, 1))]


@pytest.fixture(scope="module")
def rig():
    return load_rig("halcyonics")


@pytest.fixture(scope="module")
def loaded():
    return load_rig("halcyonics_loaded")


def restoring_wrench(shift, turn, k_s=(K_S,) * 4):
    """Force and moment about the centre of mass that springs and held actuators exert on the displaced plate."""
    force, moment = np.array([-K_T * shift[0], -K_T * shift[1], 0.0]), np.array([0.0, 0.0, -K_R * turn[2]])
    elements = [(place, (0, 0, 1), k) for place, k in zip(SPRINGS, k_s, strict=True)]
    elements += [(place, direction, K_A) for place, direction in ACTUATORS]
    for place, direction, stiffness in elements:
        stretch = np.dot(shift + np.cross(turn, place), direction)
        push = -stiffness * stretch * np.array(direction)
        force, moment = force + push, moment + np.cross(place, push)
    return np.concatenate([force, moment])


def stiffness_from_newton(k_s=(K_S,) * 4):
    return -np.column_stack([restoring_wrench(e[:3], e[3:], k_s) for e in np.eye(6)])


def test_stiffness_is_newtons(rig):
    assert np.allclose(rig.stiffness_matrix(), stiffness_from_newton(), rtol=1e-13, atol=1e-9)


def test_stiffness_with_unequal_springs_is_newtons(rig):
    k_s = (10000.0, 12000.0, 11500.0, 13000.0)
    changed = rig.with_parameters({f"k_s{i}": k for i, k in enumerate(k_s, 1)})
    assert np.allclose(changed.stiffness_matrix(), stiffness_from_newton(k_s), rtol=1e-13, atol=1e-9)
    assert abs(changed.stiffness_matrix()[2, 3]) > 100.0


def test_actuator_matrix_is_newtons(rig):
    wrenches = [np.concatenate([d, np.cross(p, d)]) for p, d in ACTUATORS]
    assert np.allclose(rig.actuator_matrix(), np.array(wrenches).T * E_N_PER_V, rtol=1e-13, atol=1e-13)


def test_mass_matrix_is_the_kinetic_energy_of_plate_and_load(loaded, rng):
    load = loaded.load
    for _ in range(5):
        w_dot = rng.normal(size=6)
        v, omega = w_dot[:3], w_dot[3:]
        v_load = v + np.cross(omega, [load.L7, load.L8, load.L9])
        plate = 19.3 * v @ v + omega @ (np.array([0.340, 0.259, 0.500]) * omega)
        twice = plate + 10.0 * v_load @ v_load + omega @ load.inertia() @ omega
        assert w_dot @ loaded.mass_matrix() @ w_dot == pytest.approx(twice, rel=1e-12)


@pytest.mark.parametrize("name", ["halcyonics", "halcyonics_loaded"])
def test_the_rig_by_positions_gives_the_matrices_of_the_paper(name):
    rig = load_rig(name)
    paper, positions = rig.equations_of_motion(), rig.mounted_body().equations_of_motion()
    for matrix in ("M", "C", "K", "C_floor", "K_floor", "T"):
        expected = getattr(positions, matrix)
        assert np.allclose(getattr(paper, matrix), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max()), matrix


@pytest.mark.parametrize("name", ["halcyonics", "halcyonics_loaded"])
def test_matrices_are_symmetric_and_passive(name):
    eom = load_rig(name).equations_of_motion()
    for matrix in (eom.M, eom.C, eom.K):
        assert np.array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix)[0] > 0


# One test for each row of the table of misprints.


def test_eq_4_needs_second_derivatives_of_the_angles(rig, loaded):
    # phi(t) = a sin(wt), x = 0: acceleration of the load's centre of mass by differences of its position.
    r_e, a, w, t, h = np.array([-0.075, 0.075, 0.080]), np.array([1e-5, -2e-5, 3e-5]), 7.0, 0.4, 1e-3
    place = [rotation_matrix(a * np.sin(w * tau)) @ r_e for tau in (t - h, t, t + h)]
    acceleration = (place[0] - 2 * place[1] + place[2]) / h**2
    corrected = np.cross(-(w**2) * a * np.sin(w * t), r_e)
    printed = np.cross(w * a * np.cos(w * t), r_e)
    size = np.linalg.norm(acceleration)
    assert np.linalg.norm(acceleration - corrected) < 2e-4 * size
    assert np.linalg.norm(acceleration - printed) > 0.5 * size
    # The force that moves the load is what the load adds to the first three rows of M.
    added = (loaded.mass_matrix() - rig.mass_matrix())[:3, 3:]
    assert np.allclose(added @ (-(w**2) * a * np.sin(w * t)), 10.0 * acceleration, atol=2e-3 * size)


def test_eq_18_rolling_stiffness_has_the_arm_of_the_vertical_springs(rig):
    newton = -restoring_wrench(np.zeros(3), np.array([1.0, 0.0, 0.0]))[3]
    printed = (K_A + K_S) * L6**2 + 2 * K_A * L6**2
    assert rig.stiffness_matrix()[3, 3] == pytest.approx(newton, rel=1e-13)
    assert printed < 0.06 * newton


def test_eq_19_vertical_actuators_push_with_their_whole_force(rig):
    E = rig.actuator_matrix()
    force, roll, pitch = E[2, :4], E[3, :4], E[4, :4]
    places = np.array([place for place, _ in ACTUATORS[:4]], float)
    assert np.allclose(roll, places[:, 1] * force) and np.allclose(pitch, -places[:, 0] * force)
    printed = E_N_PER_V[:4] / 2
    assert np.allclose(roll / printed, 2 * places[:, 1])  # the printed force would act at twice its arm


DIMENSIONS = {
    "N": np.array([1, 1, -2]),
    "m": np.array([0, 1, 0]),
    "s": np.array([0, 0, 1]),
    "kg": np.array([1, 0, 0]),
    "rad": np.zeros(3, int),
}


def dimension(unit):
    """Exponents of (kg, m, s) of a unit such as "N m s/rad"."""
    above, _, below = unit.partition("/")
    return sum(DIMENSIONS[u] for u in above.split()) - sum((DIMENSIONS[u] for u in below.split()), np.zeros(3, int))


@pytest.mark.parametrize("name", ["d4", "d5", "d6"])
def test_table_1_rotational_damping_times_rate_is_a_moment(rig, name):
    moment, rate = dimension("N m"), dimension("rad/s")
    assert np.array_equal(dimension(rig.parameters()[name].unit) + rate, moment)
    assert not np.array_equal(dimension("N s/rad") + rate, moment)


def test_section_2_2_actuator_damping_times_velocity_is_a_force(rig):
    force, velocity = dimension("N"), dimension("m/s")
    assert np.array_equal(dimension("N s/m") + velocity, force)
    assert not np.array_equal(dimension("N m/s") + velocity, force)


def test_table_1_test_10_is_the_horizontal_damping(rig):
    assert "d7" not in rig.parameters()
    assert rig.parameters()["d1"].value == 275.0
    undamped = rig.with_parameters({"d1": 0.0}).damping_matrix()
    assert undamped[0, 0] == undamped[1, 1] == 0.0 and np.all(np.diag(undamped)[2:] > 0)


def test_table_2_totals_leave_out_the_parallel_axis_terms(loaded):
    """Of the two readings of I_xx + I^e_xx only one leaves the load an inertia that a body can have."""
    totals, plate, arms = (
        np.array([0.455, 0.374, 0.730]),
        np.array([0.340, 0.259, 0.500]),
        np.array([0.075**2 + 0.080**2, 0.075**2 + 0.080**2, 2 * 0.075**2]),
    )
    own = totals - plate
    assert np.allclose(np.diag(loaded.load.inertia()), own, atol=1e-15)
    principal = np.linalg.eigvalsh(loaded.load.inertia())
    assert principal[0] == pytest.approx(0.0, abs=1e-12)  # a slender rod: on the edge, but possible
    assert principal[2] <= principal[0] + principal[1] + 1e-12
    assert np.min(own - 10.0 * arms) < 0  # the other reading: negative moments of inertia
    assert np.allclose(np.diag(loaded.mass_matrix())[3:], totals + 10.0 * arms)


# Limits, modes, transfer functions.


def test_static_limit_the_plate_follows_the_floor(loaded):
    static = loaded.equations_of_motion().state_space().dcgain()[:6, 8:]
    assert np.allclose(static, np.eye(6), atol=1e-9)


def test_high_frequency_limit_is_free_motion(loaded):
    w = 2 * np.pi * 1e5
    eom = loaded.equations_of_motion()
    response = eom.state_space().frequency_response(np.array([w]))[0]
    assert np.allclose(-(w**2) * response[:6, :8], np.linalg.solve(eom.M, eom.T), rtol=1e-3, atol=1e-4)
    assert np.allclose(1j * w * response[:6, 8:], np.linalg.solve(eom.M, eom.C), rtol=2e-3, atol=0.1)


def test_natural_frequencies_by_hand(rig):
    """Bare plate: z and phi_z alone, (x, phi_y) and (y, phi_x) in pairs; quadratic formula."""

    def pair(m, J, k, c, kr):
        half, product = (k / m + kr / J) / 2, (k * kr - c**2) / (m * J)
        root = np.sqrt(half**2 - product)
        return [np.sqrt(half - root), np.sqrt(half + root)]

    horizontal, tilt = 2 * K_A + K_T, 2 * K_A * L6
    expected = [
        np.sqrt(4 * (K_A + K_S) / 19.3),
        np.sqrt((2 * K_A * L45**2 + K_R) / 0.5),
        *pair(19.3, 0.340, horizontal, tilt, (K_A + K_S) * L2**2 + 2 * K_A * L6**2),
        *pair(19.3, 0.259, horizontal, tilt, 4 * K_A * ARM**2 + K_S * L1**2 + 2 * K_A * L6**2),
    ]
    found = rig.equations_of_motion().natural_frequencies().frequencies_Hz
    assert np.allclose(found, np.sort(expected) / (2 * np.pi), rtol=1e-12)


def test_drive_patterns_of_tables_1_and_2_excite_what_the_source_says(rig):
    """With equal forces: test 5 turns about x, test 12 about z, test 8 of Table 2 pushes along x and tilts about y."""

    def wrench(pattern):
        volts = np.array([pattern.get(f"A{i}", 0.0) for i in range(1, 9)]) / E_N_PER_V
        return rig.actuator_matrix() @ volts

    assert np.allclose(wrench({"A1": 1, "A2": 1, "A3": -1, "A4": -1})[[0, 1, 2, 4, 5]], 0, atol=1e-14)
    assert np.allclose(wrench({"A5": 1, "A7": 1})[:5], 0, atol=1e-14)
    assert np.allclose(wrench({"A5": 1, "A8": 1})[[1, 2, 3, 5]], 0, atol=1e-14)


def test_transfer_of_eq_32_by_newton(rig, loaded):
    """Motion of M3 under A1 alone from the state space and the cross product, for a skew direction."""
    omega = 2 * np.pi * np.array([1.0, 9.0, 12.0, 30.0])
    s = np.array([1.0, -2.0, 0.5])
    for table in (rig, loaded):
        response = table.equations_of_motion().state_space().frequency_response(omega)[:, :6, 0]
        moved = response[:, :3] + np.cross(response[:, 3:], [0.0, 0.15, 0.0])
        expected = moved @ s / np.linalg.norm(s) / 6.59
        for point in ("M3", [0, 0.15, 0]):
            assert np.allclose(transfer(table, point, s, np.eye(8)[0], omega, 0), expected, rtol=1e-9)


def test_transfer_limits(rig):
    """Z_1/F_1 under A1: 1/k below, the mass line above the resonance at 9.9 Hz."""
    low, high = transfer(rig, "M1", "z", np.eye(8)[0], 2 * np.pi * np.array([1e-8, 1e4]), 0)
    assert low == pytest.approx(1 / (4 * (K_A + K_S)), rel=1e-6)
    assert high * (2 * np.pi * 1e4) ** 2 == pytest.approx(-1 / 19.3, rel=1e-3)


def test_sensors_sit_at_the_actuators_and_see_along_their_axes(rig):
    names, rows = rig.sensor_rows()
    assert names == tuple(f"acc_A{i}" for i in range(1, 9))
    assert np.allclose(rows, (rig.actuator_matrix() / E_N_PER_V).T)


def test_parameters_are_those_of_table_1_and_can_be_changed(rig, loaded):
    values = {name: p.value for name, p in loaded.parameters().items()}
    assert values["mass"] == 19.3 and values["k_s"] == values["k_s3"] == 11300.0 and values["e4"] == 8.10
    assert loaded.with_parameters(values) == loaded
    assert replace(loaded, load=None) == rig
    changed = loaded.with_parameters({"k_s": 12000.0, "k_s2": 9000.0, "load.L8": 0.05, "e8": 6.0})
    assert changed.k_s == (12000.0, 9000.0, 12000.0, 12000.0)
    assert changed.load.L8 == 0.05 and changed.e[7] == 6.0 and loaded.load.L8 == 0.075
    with pytest.raises(InputError, match=r"did you mean 'load\.mass'"):
        loaded.with_parameters({"load.mas": 1.0})
    with pytest.raises(InputError, match="positive mass"):
        rig.with_parameters({"mass": -1.0})
    with pytest.raises(InputError, match="finite"):
        rig.with_parameters({"k_a": float("nan")})
