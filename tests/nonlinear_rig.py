"""The nonlinear model for Python callers, and the energy of its motion."""

from __future__ import annotations

import numpy as np

from avis_ctrl.rigs.mounted_body import MountedBody
from avis_ctrl.rigs.nonlinear import payload_acceleration, rig_arrays
from avis_ctrl.rigs.rigid_body import cross_matrix


def rotation_matrix(angles: np.ndarray) -> np.ndarray:
    """Body to earth axes for the 3-2-1 angles (phi_x, phi_y, phi_z) [rad], (3, 3)."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [c3 * c2, s1 * s2 * c3 - c1 * s3, c1 * s2 * c3 + s1 * s3],
            [s3 * c2, s1 * s2 * s3 + c1 * c3, c1 * s2 * s3 - s1 * c3],
            [-s2, s1 * c2, c1 * c2],
        ]
    )


def body_rate_map(angles: np.ndarray) -> np.ndarray:
    """W, (3, 3), with angular velocity in body axes = W(angles) angles'."""
    (c1, c2, _), (s1, s2, _) = np.cos(angles), np.sin(angles)
    return np.array([[1.0, 0.0, -s2], [0.0, c1, s1 * c2], [0.0, -s1, c1 * c2]])


class NonlinearRig:
    """The nonlinear model for Python callers; state = (q, q') of length 12."""

    def __init__(self, body: MountedBody):
        self.body = body
        self.arrays = rig_arrays(body)

    def derivative(
        self,
        state: np.ndarray,
        u: np.ndarray | None = None,
        q_ch: np.ndarray | None = None,
        q_ch_dot: np.ndarray | None = None,
    ) -> np.ndarray:
        """d/dt (q, q') for voltages u (n_u,) and chassis motion (6,); each absent input is zero.

        Complex arguments are taken as they are, for complex-step differentiation.
        """
        given = (state, u, q_ch, q_ch_dot)
        kind = complex if any(np.iscomplexobj(part) for part in given if part is not None) else float
        sizes = (12, len(self.body.actuators), 6, 6)
        # Copies: a read-only array is another type to numba, and would be compiled for anew.
        state, u, q_ch, q_ch_dot = (
            np.zeros(n, kind) if part is None else np.array(part, dtype=kind)
            for part, n in zip(given, sizes, strict=True)
        )
        q, q_dot = state[:6], state[6:]
        return np.concatenate([q_dot, payload_acceleration(q, q_dot, u, q_ch, q_ch_dot, self.arrays)])

    def energy(self, state: np.ndarray, q_ch: np.ndarray | None = None) -> float:
        """Kinetic plus elastic energy [J]; conserved without damping, voltage and chassis motion."""
        q, q_dot = np.asarray(state[:6], float), np.asarray(state[6:], float)
        q_ch = np.zeros(6) if q_ch is None else np.asarray(q_ch, float)
        R, R_ch = rotation_matrix(q[3:]), rotation_matrix(q_ch[3:])
        omega = body_rate_map(q[3:]) @ q_dot[3:]
        speed = q_dot[:3] + R @ cross_matrix(omega) @ self.body.centre_of_mass
        total = self.body.mass * speed @ speed + omega @ self.body.inertia @ omega
        for mount in self.body.mounts:
            stretch = q[:3] + (R - np.eye(3)) @ mount.position - q_ch[:3] - (R_ch - np.eye(3)) @ mount.chassis_point
            total += stretch @ mount.stiffness @ stretch
        return 0.5 * float(total + (q - q_ch) @ self.body.stiffness @ (q - q_ch))
