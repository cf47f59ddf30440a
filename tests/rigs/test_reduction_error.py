"""The z/phi_x subsystem and the whole table against the second-order equations solved directly."""

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.reduction_error import reduction_error

KEEP = [2, 3]
OMEGA = 2 * np.pi * np.array([0.2, 1.7, 3.1, 4.9, 8.3, 30.0])


def solved(rig, moving):
    """(n_omega, 2, n + 2) response of z and phi_x to the floor and to a force on each, in units of the edge.

    moving : indices of the n coordinates that move, with the floor and relative to it.
    """
    eom, kept = rig.equations_of_motion(), [moving.index(k) for k in KEEP]
    lever = np.array([1.0, 1.0, 1.0, *[rig.edge_m] * 3])[moving]
    square = np.ix_(moving, moving)
    responses = []
    for w in OMEGA:
        dynamic = (-(w**2) * eom.M + 1j * w * eom.C + eom.K)[square]
        floor = (1j * w * eom.C_floor + eom.K_floor)[square]
        pushed = np.hstack([floor / lever, np.diag(lever)[:, kept]])
        responses.append(lever[kept, None] * np.linalg.solve(dynamic, pushed)[kept])
    return np.array(responses)


def error(found, expected):
    """Largest difference, each against the largest response to the same input."""
    return np.max(np.abs(found - expected) / np.abs(expected).max(axis=(0, 1)))


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_full_is_the_six_dof_response(name):
    rig = load_rig(name)
    found, expected = reduction_error(rig, omega=OMEGA), solved(rig, [*range(6)])
    assert error(found.full, expected[:, :, [*KEEP, 6, 7]]) < 1e-10
    assert error(found.left_out, expected[:, :, [0, 1, 4, 5]]) < 1e-10


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_reduced_is_two_equations(name):
    rig = load_rig(name)
    assert error(reduction_error(rig, omega=OMEGA).reduced, solved(rig, KEEP)) < 1e-10


def test_reduction_is_exact_where_nothing_couples():
    """Bare plate with its actuators at the height of the centre of mass: z and phi_x stand alone."""
    reduction = reduction_error(load_rig("halcyonics").with_parameters({"L6": 0.0}), omega=OMEGA)
    assert np.max(reduction.relative) < 1e-12 and np.max(np.abs(reduction.left_out)) < 1e-12


def test_reduction_error_is_the_difference_of_the_responses():
    rig = load_rig("avis")
    reduction = reduction_error(rig, omega=OMEGA)
    full = solved(rig, [*range(6)])[:, :, KEEP]
    difference = np.abs(solved(rig, KEEP)[:, :, :2] - full)
    size = np.linalg.norm(full, ord=2, axis=(1, 2))
    assert np.allclose(reduction.relative[:, :, :2], difference / size[:, None, None], rtol=1e-8, atol=1e-12)
    worst = 20 * np.log10(np.max(difference[:, 1, 1] / size))
    assert reduction.max_dB["phi_x", "floor_phi_x"] == pytest.approx(worst, abs=1e-6)
    assert reduction.rms_dB["phi_x", "floor_phi_x"] < worst
    assert reduction.dropped == ("floor_x", "floor_y", "floor_phi_y", "floor_phi_z")


def test_the_floor_motion_that_the_reduction_drops_is_shown():
    """phi_x of the AVIS answers to floor_y through the height p_z of the mounts, more than 0 dB at its resonance."""
    reduction = reduction_error(load_rig("avis"))
    roll_from_y = np.abs(reduction.left_out[:, 1, reduction.dropped.index("floor_y")])
    assert 20 * np.log10(roll_from_y.max()) > 10.0


def test_unknown_coordinates_are_refused():
    with pytest.raises(InputError, match="out of"):
        reduction_error(load_rig("avis"), ("z", "phi"))
