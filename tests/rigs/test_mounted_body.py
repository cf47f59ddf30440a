"""A body on mounts: known small cases by hand, and what it refuses."""

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.mounted_body import Mount, MountedBody, PointActuator

NONE, Z = np.zeros((3, 3)), np.diag([0.0, 0.0, 1.0])


def beam(centre=(0.0, 0.0, 0.0), inertia=None):
    """Two vertical springs at x = -1 and x = 1 m under a body of 4 kg."""
    mounts = tuple(
        Mount(f"spring{i}", [x, 0, 0], [x, 0, 0], k * Z, NONE) for i, (x, k) in enumerate(((-1.0, 300.0), (1.0, 500.0)))
    )
    push = PointActuator("push", [2.0, 0, 0], [0, 0, 1.0], 0.5)
    return MountedBody(4.0, np.eye(3) if inertia is None else inertia, centre, mounts, (push,))


def test_bounce_and_pitch_of_a_beam_by_hand():
    """z at (x, 0, 0) is z - x phi_y: K_zz = k1 + k2, K_z,phi_y = k1 - k2, K_phi_y = k1 + k2."""
    eom = beam().equations_of_motion().restricted(("z", "phi_y"))
    assert np.allclose(eom.K, [[800.0, -200.0], [-200.0, 800.0]])
    assert np.allclose(eom.K_floor, eom.K)
    assert np.allclose(eom.T[:, 0], [0.5, -1.0])
    assert np.allclose(eom.M, np.diag([4.0, 1.0]))


def test_parallel_axis_terms_by_hand():
    """Centre of mass at x = 0.5 m: pitch inertia 1 + 4 * 0.25 about the reference point, coupling -m x."""
    M = beam(centre=(0.5, 0.0, 0.0)).mass_matrix()
    assert M[4, 4] == pytest.approx(2.0) and M[2, 4] == pytest.approx(-2.0) and M[1, 5] == pytest.approx(2.0)
    assert M[3, 3] == pytest.approx(1.0)


def test_what_no_body_can_have_is_refused():
    with pytest.raises(InputError, match="positive definite inertia"):
        beam(inertia=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match="positive definite inertia"):
        beam(inertia=np.array([[1.0, 0.5, 0], [0, 1.0, 0], [0, 0, 1.0]]))
    with pytest.raises(InputError, match="positive mass"):
        MountedBody(0.0, np.eye(3), np.zeros(3), (), ())
    with pytest.raises(InputError, match="unit vector"):
        PointActuator("push", [0, 0, 0], [0, 1.0, 1.0], 1.0)
    with pytest.raises(InputError, match="finite numbers of shape"):
        Mount("spring", [0, 0, np.nan], [0, 0, 0], Z, NONE)
    with pytest.raises(InputError, match="finite numbers of shape"):
        Mount("spring", [0, 0, 0], [0, 0, 0], [1.0, 2.0, 3.0], NONE)
