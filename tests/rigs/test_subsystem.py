"""The z/phi_x subsystem against the second-order equations solved directly, for each choice about the rest."""

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import COORDINATES, load_rig
from avis_ctrl.rigs.subsystem import critical_gains, reduce_rig, reduction_error

KEEP = [2, 3]
OMEGA = 2 * np.pi * np.array([0.2, 1.7, 3.1, 4.9, 8.3, 30.0])


def six_dof(rig):
    """(n_omega, 2, 14) response of z and phi_x to voltages and floor."""
    eom = rig.equations_of_motion()
    responses = []
    for w in OMEGA:
        dynamic = -(w**2) * eom.M + 1j * w * eom.C + eom.K
        pushed = np.hstack([eom.T, 1j * w * eom.C_floor + eom.K_floor])
        responses.append(np.linalg.solve(dynamic, pushed)[KEEP])
    return np.array(responses)


def error(found, expected):
    """Largest difference, each against the largest response to the same input."""
    return np.max(np.abs(found - expected) / np.abs(expected).max(axis=(0, 1)))


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_free_is_the_six_dof_response(name):
    rig = load_rig(name)
    found = reduce_rig(rig, others="free").system.select(["z", "phi_x"]).frequency_response(OMEGA)
    assert error(found, six_dof(rig)) < 1e-10


def test_locked_is_two_equations():
    rig = load_rig("avis")
    eom, reduced = rig.equations_of_motion(), reduce_rig(rig)
    assert reduced.system.nstates == 4 and reduced.system.inputs[8:] == ("floor_z", "floor_phi_x")
    square = np.ix_(KEEP, KEEP)
    for w, G in zip(OMEGA, reduced.system.frequency_response(OMEGA), strict=True):
        dynamic = -(w**2) * eom.M[square] + 1j * w * eom.C[square] + eom.K[square]
        pushed = np.hstack([eom.T[KEEP], 1j * w * eom.C_floor[square] + eom.K_floor[square]])
        assert np.allclose(G[:2], np.linalg.solve(dynamic, pushed), rtol=1e-9, atol=1e-15)


def test_logical_inputs_are_pure_forces():
    rig = load_rig("avis")
    logical = reduce_rig(rig, others="free").logical()
    forces = rig.equations_of_motion().state_space(forces=True).select(["z", "phi_x"], ["force_z", "force_phi_x"])
    found = logical.select(["z", "phi_x"], ["force_z", "force_phi_x"]).frequency_response(OMEGA)
    assert np.allclose(found, forces.frequency_response(OMEGA), rtol=1e-9, atol=1e-18)


def test_critical_gains_give_double_poles_of_each_axis_alone():
    rig = load_rig("avis")
    eom, gains = rig.equations_of_motion(), critical_gains(rig, ("z", "phi_x"))
    assert set(gains) == {"x", "y", "phi_y", "phi_z"}
    for name, g in gains.items():
        k = COORDINATES.index(name)
        poles = np.roots([eom.M[k, k], eom.C[k, k] + g, eom.K[k, k]])
        assert np.allclose(poles, -np.sqrt(eom.K[k, k] / eom.M[k, k]), rtol=1e-6)


def test_reduction_is_exact_where_nothing_couples():
    """Bare plate with its actuators at the height of the centre of mass: z and phi_x stand alone."""
    reduction = reduction_error(load_rig("halcyonics").with_parameters({"L6": 0.0}), omega=OMEGA)
    assert np.max(reduction.relative) < 1e-12 and np.max(np.abs(reduction.left_out)) < 1e-12


def test_reduction_error_is_the_difference_of_the_responses():
    rig = load_rig("avis")
    reduction = reduction_error(rig, omega=OMEGA)
    full = six_dof(rig)[:, :, [10, 11]]  # floor_z and floor_phi_x
    locked = reduce_rig(rig).system.select(["z", "phi_x"], ["floor_z", "floor_phi_x"]).frequency_response(OMEGA)
    edge = np.array([1.0, 0.375])
    difference = np.abs(edge[:, None] * (locked - full) / edge)
    size = np.linalg.norm(edge[:, None] * full / edge, ord=2, axis=(1, 2))
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


@pytest.mark.parametrize(
    ("arguments", "expected"), [({"others": "glued"}, "locked or free"), ({"keep": ("z", "phi")}, "out of")]
)
def test_choices_that_make_no_sense_are_refused(arguments, expected):
    with pytest.raises(InputError, match=expected):
        reduce_rig(load_rig("avis"), **arguments)
