"""X_ps / F_r of eq. 32 of Beadle et al.: a motion of the Halcyonics table over the force of one of its actuators."""

from __future__ import annotations

import numpy as np

from avis_ctrl.rigs.rigid_body import point_map


def transfer(rig, point, direction, volts, omega, reference):
    """(n,) complex [m/N].

    point : a name of `rig.points()`, or a position (3,). direction : (3,), or "x", "y", "z". volts : (8,) of the
    actuators. omega : (n,) rad/s. reference : the actuator whose force is divided by, from 0.
    """
    place = rig.points()[point].position if isinstance(point, str) else np.asarray(point, float)
    s = np.eye(3)["xyz".index(direction)] if isinstance(direction, str) else np.asarray(direction, float)
    eom, w = rig.equations_of_motion(), np.asarray(omega, float)[:, None, None]
    W = np.linalg.solve(-(w**2) * eom.M + 1j * w * eom.C + eom.K, (eom.T @ volts)[:, None])[:, :, 0]
    return W @ point_map(place).T @ s / (np.linalg.norm(s) * rig.e[reference])
