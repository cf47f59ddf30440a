"""A rigid body on springs and dampers with actuators, described by positions: the model of both rigs.

The reference point (origin of all positions, and the point described by q) is the geometric centre;
the centre of mass may be offset from it. The sources do not include the weight and the preload that
supports it: the levelled body rests at q = 0 without force in its springs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.rigid_body import EquationsOfMotion, cross_matrix, freeze, point_map


@dataclass(frozen=True, eq=False)
class Mount:
    """Spring and damper along earth axes between a body point and a chassis point.

    position, chassis_point : (3,) m, relative to the reference points of payload and chassis.
    stiffness, damping : (3, 3) N/m and N s/m in earth axes.
    """

    name: str
    position: np.ndarray
    chassis_point: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray

    def __post_init__(self) -> None:
        freeze(self, position=(3,), chassis_point=(3,), stiffness=(3, 3), damping=(3, 3))


@dataclass(frozen=True, eq=False)
class PointActuator:
    """Force constant_N_per_V * u [N] at a body point (3,) [m] along a unit direction (3,) in earth axes."""

    name: str
    position: np.ndarray
    direction: np.ndarray
    constant_N_per_V: float

    def __post_init__(self) -> None:
        freeze(self, position=(3,), direction=(3,))
        length = float(np.linalg.norm(self.direction))
        if not abs(length - 1.0) <= 1e-9:
            raise InputError("expected a unit vector", field=f"direction of {self.name}", value=length)


@dataclass(frozen=True, eq=False)
class MountedBody:
    """Rigid body, its mounts and its actuators.

    Parameters
    ----------
    mass : kg, positive.
    inertia : (3, 3) kg m^2 about the centre of mass in body axes, symmetric positive definite.
    centre_of_mass : (3,) m relative to the reference point.
    mounts, actuators : point elements.
    stiffness, damping : (6, 6) additional generalised stiffness and damping between body and
        chassis, about the reference point (k_t, k_r and d1..d6 of the Halcyonics table).

    Raises
    ------
    InputError : a mass or inertia that is not positive, wrong shapes, numbers that are not finite.
    """

    mass: float
    inertia: np.ndarray
    centre_of_mass: np.ndarray
    mounts: tuple[Mount, ...]
    actuators: tuple[PointActuator, ...]
    stiffness: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    damping: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))

    def __post_init__(self) -> None:
        freeze(self, inertia=(3, 3), centre_of_mass=(3,), stiffness=(6, 6), damping=(6, 6))
        if not (np.isfinite(self.mass) and self.mass > 0):
            raise InputError("expected a positive mass in kg", field="mass", value=self.mass)
        if not np.allclose(self.inertia, self.inertia.T) or np.min(np.linalg.eigvalsh(self.inertia)) <= 0:
            raise InputError(
                "expected a symmetric positive definite inertia in kg m^2", field="inertia", value=self.inertia.tolist()
            )

    def mass_matrix(self) -> np.ndarray:
        """M, (6, 6), about the reference point, parallel-axis terms included."""
        S = cross_matrix(self.centre_of_mass)
        return np.block([[self.mass * np.eye(3), -self.mass * S], [self.mass * S, self.inertia - self.mass * S @ S]])

    def equations_of_motion(self) -> EquationsOfMotion:
        """Equations linearised about rest (Rademakers, eq. 2.36, with the chassis motion included)."""
        K, C = np.array(self.stiffness), np.array(self.damping)
        K_floor, C_floor = K.copy(), C.copy()
        for mount in self.mounts:
            G, G_chassis = point_map(mount.position), point_map(mount.chassis_point)
            K += G.T @ mount.stiffness @ G
            C += G.T @ mount.damping @ G
            K_floor += G.T @ mount.stiffness @ G_chassis
            C_floor += G.T @ mount.damping @ G_chassis
        T = np.column_stack([point_map(a.position).T @ a.direction * a.constant_N_per_V for a in self.actuators])
        return EquationsOfMotion(self.mass_matrix(), C, K, C_floor, K_floor, T, tuple(a.name for a in self.actuators))
