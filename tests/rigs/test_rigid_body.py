"""Kinematics against scipy's rotations and difference quotients; state space against the second-order equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import COORDINATES, load_rig
from avis_ctrl.rigs.nonlinear import body_rates, rotation
from avis_ctrl.rigs.rigid_body import EquationsOfMotion, cross_matrix, point_map

angle = st.floats(-1.4, 1.4)
angles3 = st.tuples(angle, angle, angle).map(np.array)
vector3 = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)


@given(vector3, vector3)
def test_cross_matrix_is_the_cross_product(r, a):
    assert np.allclose(cross_matrix(r) @ a, np.cross(r, a), atol=1e-12)


@settings(deadline=None)  # the first call compiles
@given(angles3)
def test_rotation_is_yaw_then_pitch_then_roll_from_body_to_earth(angles):
    # scipy: intrinsic z-y'-x'' sequence, an independent implementation of the 3-2-1 convention.
    expected = Rotation.from_euler("ZYX", angles[::-1]).as_matrix()
    assert np.allclose(rotation(angles), expected, atol=1e-14)


@settings(deadline=None)
@given(angles3, vector3)
def test_body_rates_are_those_of_the_rotation(angles, rates):
    h = 1e-6
    R_dot = (rotation(angles + h * rates) - rotation(angles - h * rates)) / (2 * h)
    omega = np.empty(3)
    body_rates(omega, angles, rates)
    assert np.allclose(R_dot, rotation(angles) @ cross_matrix(omega), atol=1e-8 * (1 + rates @ rates) ** 1.5)


@settings(deadline=None)
@given(vector3, vector3, vector3)
def test_point_map_is_the_small_motion_of_a_body_point(p, shift, turn):
    h = 1e-7
    moved = h * shift + rotation(h * turn) @ p - p
    assert np.allclose(moved / h, point_map(p) @ np.concatenate([shift, turn]), atol=1e-4)


@pytest.mark.parametrize("name", ["avis", "halcyonics", "halcyonics_loaded"])
def test_momentum_form_needs_no_floor_velocity_and_is_the_same_system(name):
    eom = load_rig(name).equations_of_motion()
    system = eom.state_space(forces=True)
    omega = 2 * np.pi * np.array([0.3, 2.0, 5.1, 40.0])
    response = system.frequency_response(omega)
    for w, G in zip(omega, response, strict=True):
        dynamic = -(w**2) * eom.M + 1j * w * eom.C + eom.K
        pushed = np.hstack([eom.T, 1j * w * eom.C_floor + eom.K_floor, np.eye(6)])
        q = np.linalg.solve(dynamic, pushed)
        expected = np.vstack([q, 1j * w * q])
        assert np.allclose(G, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    assert system.inputs[8:14] == tuple(f"floor_{c}" for c in COORDINATES)
    assert system.outputs == (*COORDINATES, *(f"{c}_dot" for c in COORDINATES))


def test_natural_frequencies_of_two_masses_by_hand():
    # m = 1 kg twice on springs 1, 1, 1 N/m in a row: 1 and sqrt(3) rad/s, shapes (1, 1) and (1, -1).
    K = np.array([[2.0, -1.0], [-1.0, 2.0]])
    none = np.zeros((2, 0))
    eom = EquationsOfMotion(np.eye(2), np.zeros((2, 2)), K, none, none, none, (), ("x", "y"), ())
    modes = eom.natural_frequencies()
    assert np.allclose(modes.frequencies_Hz * 2 * np.pi, [1.0, np.sqrt(3.0)])
    assert np.allclose(np.abs(modes.shapes), np.sqrt(0.5))


def test_an_unstable_mode_has_a_negative_frequency():
    none = np.zeros((1, 0))
    eom = EquationsOfMotion([[1.0]], [[0.0]], [[-4.0]], none, none, none, (), ("x",), ())
    assert eom.natural_frequencies().frequencies_Hz[0] == pytest.approx(-2.0 / (2 * np.pi))


def test_restriction_strikes_rows_and_columns():
    eom = load_rig("avis").equations_of_motion()
    part = eom.restricted(("z", "phi_x"), floor=("y", "z", "phi_x"))
    assert np.array_equal(part.K, eom.K[2:4, 2:4]) and np.array_equal(part.K_floor, eom.K_floor[2:4, 1:4])
    assert part.state_space().inputs[8:] == ("floor_y", "floor_z", "floor_phi_x")
    with pytest.raises(InputError, match="different names out of"):
        eom.restricted(("z", "phi_w"))


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="finite"):
        EquationsOfMotion(np.eye(6), np.eye(6), np.full((6, 6), np.nan), np.eye(6), np.eye(6), np.zeros((6, 1)), ("a",))
