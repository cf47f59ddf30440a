"""The nonlinear Newton-Euler model of a mounted body (Rademakers, eqs. 2.1-2.21), compiled.

Large 3-2-1 rotations of payload and chassis; springs, dampers and actuators act along earth axes at
body-fixed points; full inertia and an offset centre of mass. The source does not include gravity: the
levelled payload rests at q = 0 without force in its mounts, and its weight exerts no moment.

`payload_acceleration` works on plain arrays so that a compiled closed loop can call it at each step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from avis_ctrl.rigs.mounted_body import MountedBody


class RigArrays(NamedTuple):
    """A `MountedBody` as C-contiguous float arrays, for compiled code (accepted by numba).

    mass : float, kg
    centre_of_mass : (3,) m, body axes, relative to the reference point
    inertia_ref : (3, 3) kg m^2 about the reference point, body axes
    inverse_mass : (6, 6) inverse of [[m I, -m S(c)], [m S(c), inertia_ref]], constant in body axes
    mount_position, mount_chassis : (n_mounts, 3) m
    mount_stiffness, mount_damping : (n_mounts, 3, 3) N/m and N s/m, earth axes
    stiffness, damping : (6, 6) generalised, on the differences q - q_ch and q' - q_ch'
    actuator_position : (n_u, 3) m, body axes
    actuator_force : (n_u, 3) N/V, earth axes
    """

    mass: float
    centre_of_mass: np.ndarray
    inertia_ref: np.ndarray
    inverse_mass: np.ndarray
    mount_position: np.ndarray
    mount_chassis: np.ndarray
    mount_stiffness: np.ndarray
    mount_damping: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    actuator_position: np.ndarray
    actuator_force: np.ndarray


def rig_arrays(body: MountedBody) -> RigArrays:
    """Pack a body for `payload_acceleration`."""
    mounts, actuators = body.mounts, body.actuators
    M = body.mass_matrix()

    def stack(rows: list[np.ndarray], *shape: int) -> np.ndarray:
        return np.ascontiguousarray(np.reshape(rows, (-1, *shape)), dtype=float)

    return RigArrays(
        float(body.mass),
        np.array(body.centre_of_mass),
        np.ascontiguousarray(M[3:, 3:]),
        np.ascontiguousarray(np.linalg.inv(M)),
        stack([m.position for m in mounts], 3),
        stack([m.chassis_point for m in mounts], 3),
        stack([m.stiffness for m in mounts], 3, 3),
        stack([m.damping for m in mounts], 3, 3),
        np.array(body.stiffness),
        np.array(body.damping),
        stack([a.position for a in actuators], 3),
        stack([a.direction * a.constant_N_per_V for a in actuators], 3),
    )


@njit(cache=True)
def rotation(angles: np.ndarray) -> np.ndarray:
    """Body to earth axes for the 3-2-1 angles (phi_x, phi_y, phi_z) [rad], (3, 3): R3(phi_z) R2(phi_y) R1(phi_x).

    The matrix of Rademakers' eq. 2.4. Eq. 2.3 there reads like a transformation from earth to body axes, but the
    matrix transforms the components of a vector from body to earth axes.
    """
    c1, c2, c3 = np.cos(angles[0]), np.cos(angles[1]), np.cos(angles[2])
    s1, s2, s3 = np.sin(angles[0]), np.sin(angles[1]), np.sin(angles[2])
    R = np.empty((3, 3), angles.dtype)
    R[0, 0], R[0, 1], R[0, 2] = c3 * c2, s1 * s2 * c3 - c1 * s3, c1 * s2 * c3 + s1 * s3
    R[1, 0], R[1, 1], R[1, 2] = s3 * c2, s1 * s2 * s3 + c1 * c3, c1 * s2 * s3 - s1 * c3
    R[2, 0], R[2, 1], R[2, 2] = -s2, s1 * c2, c1 * c2
    return R


@njit(cache=True)
def _cross(out: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def body_rates(omega: np.ndarray, angles: np.ndarray, rates: np.ndarray) -> None:
    """Angular velocity in body axes from the rates of the angles (Rademakers, eq. 2.5), written to omega.

    The source states eq. 2.5 "with respect to" the earth frame; its components are in body axes.
    """
    c1, s1, c2, s2 = np.cos(angles[0]), np.sin(angles[0]), np.cos(angles[1]), np.sin(angles[1])
    omega[0] = rates[0] - s2 * rates[2]
    omega[1] = c1 * rates[1] + s1 * c2 * rates[2]
    omega[2] = -s1 * rates[1] + c1 * c2 * rates[2]


@njit(cache=True)
def _point_motion(
    place: np.ndarray,
    speed: np.ndarray,
    R: np.ndarray,
    omega: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    q_dot: np.ndarray,
) -> None:
    """Displacement and velocity of the body-fixed point p in earth axes."""
    # Scalars, not small arrays: this runs for every mount at every step.
    t0, t1, t2 = omega[1] * p[2] - omega[2] * p[1], omega[2] * p[0] - omega[0] * p[2], omega[0] * p[1] - omega[1] * p[0]
    for i in range(3):
        place[i] = q[i] - p[i] + R[i, 0] * p[0] + R[i, 1] * p[1] + R[i, 2] * p[2]
        speed[i] = q_dot[i] + R[i, 0] * t0 + R[i, 1] * t1 + R[i, 2] * t2


@njit(cache=True)
def _add_force(wrench: np.ndarray, arm: np.ndarray, R: np.ndarray, force: np.ndarray) -> None:
    """Add a force in earth axes at the body point `arm` to force and moment in body axes."""
    f0 = R[0, 0] * force[0] + R[1, 0] * force[1] + R[2, 0] * force[2]
    f1 = R[0, 1] * force[0] + R[1, 1] * force[1] + R[2, 1] * force[2]
    f2 = R[0, 2] * force[0] + R[1, 2] * force[1] + R[2, 2] * force[2]
    wrench[0] += f0
    wrench[1] += f1
    wrench[2] += f2
    wrench[3] += arm[1] * f2 - arm[2] * f1
    wrench[4] += arm[2] * f0 - arm[0] * f2
    wrench[5] += arm[0] * f1 - arm[1] * f0


@njit(cache=True)
def _mount_wrench(
    wrench: np.ndarray,
    R: np.ndarray,
    omega: np.ndarray,
    q: np.ndarray,
    q_dot: np.ndarray,
    q_ch: np.ndarray,
    q_ch_dot: np.ndarray,
    arrays: RigArrays,
) -> None:
    """Force and moment of the springs and dampers of eqs. 2.15-2.16, in body axes about the reference point."""
    R_ch, omega_ch = rotation(q_ch[3:]), np.empty_like(omega)
    body_rates(omega_ch, q_ch[3:], q_ch_dot[3:])
    place, speed, place_ch, speed_ch = (
        np.empty_like(omega),
        np.empty_like(omega),
        np.empty_like(omega),
        np.empty_like(omega),
    )
    force = np.empty_like(omega)
    for k in range(arrays.mount_position.shape[0]):
        p = arrays.mount_position[k]
        _point_motion(place, speed, R, omega, p, q, q_dot)
        _point_motion(place_ch, speed_ch, R_ch, omega_ch, arrays.mount_chassis[k], q_ch, q_ch_dot)
        for i in range(3):
            force[i] = 0.0
            for j in range(3):
                force[i] -= arrays.mount_stiffness[k, i, j] * (place[j] - place_ch[j]) + arrays.mount_damping[
                    k, i, j
                ] * (speed[j] - speed_ch[j])
        _add_force(wrench, p, R, force)


@njit(cache=True)
def _generalised_wrench(
    wrench: np.ndarray,
    R: np.ndarray,
    q: np.ndarray,
    q_dot: np.ndarray,
    q_ch: np.ndarray,
    q_ch_dot: np.ndarray,
    arrays: RigArrays,
) -> None:
    """Generalised forces of the 6 x 6 stiffness and damping, converted to body axes by inv(W)^T."""
    Q = np.empty_like(wrench)
    for i in range(6):
        Q[i] = 0.0
        for j in range(6):
            Q[i] -= arrays.stiffness[i, j] * (q[j] - q_ch[j]) + arrays.damping[i, j] * (q_dot[j] - q_ch_dot[j])
    c1, s1, c2, s2 = np.cos(q[3]), np.sin(q[3]), np.cos(q[4]), np.sin(q[4])
    yaw = (Q[5] + s2 * Q[3]) / c2
    for i in range(3):
        wrench[i] += R[0, i] * Q[0] + R[1, i] * Q[1] + R[2, i] * Q[2]
    wrench[3] += Q[3]
    wrench[4] += c1 * Q[4] + s1 * yaw
    wrench[5] += c1 * yaw - s1 * Q[4]


@njit(cache=True)
def _accelerations(
    wrench: np.ndarray, R: np.ndarray, omega: np.ndarray, q: np.ndarray, q_dot: np.ndarray, arrays: RigArrays
) -> np.ndarray:
    """Newton-Euler equations about the reference point in body axes, eqs. 2.8-2.14; returns q''."""
    c = arrays.centre_of_mass
    turning, momentum = np.empty_like(omega), np.empty_like(omega)
    centrifugal, gyroscopic = np.empty_like(omega), np.empty_like(omega)
    _cross(turning, omega, c)
    _cross(centrifugal, omega, turning)
    for i in range(3):
        momentum[i] = (
            arrays.inertia_ref[i, 0] * omega[0]
            + arrays.inertia_ref[i, 1] * omega[1]
            + arrays.inertia_ref[i, 2] * omega[2]
        )
    _cross(gyroscopic, omega, momentum)
    body = np.empty_like(wrench)
    for i in range(6):
        body[i] = 0.0
        for j in range(3):
            body[i] += arrays.inverse_mass[i, j] * (wrench[j] - arrays.mass * centrifugal[j]) + arrays.inverse_mass[
                i, 3 + j
            ] * (wrench[3 + j] - gyroscopic[j])

    c1, s1, c2, s2 = np.cos(q[3]), np.sin(q[3]), np.cos(q[4]), np.sin(q[4])
    a1, a2, a3 = q_dot[3], q_dot[4], q_dot[5]
    # W a'' = alpha - W' a'
    r1 = body[3] + c2 * a2 * a3
    r2 = body[4] + s1 * a1 * a2 - (c1 * c2 * a1 - s1 * s2 * a2) * a3
    r3 = body[5] + c1 * a1 * a2 + (s1 * c2 * a1 + c1 * s2 * a2) * a3
    out = np.empty_like(wrench)
    for i in range(3):
        out[i] = R[i, 0] * body[0] + R[i, 1] * body[1] + R[i, 2] * body[2]
    out[5] = (s1 * r2 + c1 * r3) / c2
    out[4] = c1 * r2 - s1 * r3
    out[3] = r1 + s2 * out[5]
    return out


@njit(cache=True)
def payload_acceleration(
    q: np.ndarray, q_dot: np.ndarray, u: np.ndarray, q_ch: np.ndarray, q_ch_dot: np.ndarray, arrays: RigArrays
) -> np.ndarray:
    """q'' (6,) of the payload.

    Parameters
    ----------
    q, q_dot : (6,) displacement of the reference point [m] and 3-2-1 angles [rad], and rates.
    u : (n_u,) actuator voltages [V], in the order of the body's actuators.
    q_ch, q_ch_dot : (6,) motion of the chassis, same coordinates.
    arrays : `RigArrays`.

    All arrays are contiguous, writable float64 (complex128 in all but `arrays`, for complex-step Jacobians, is compiled
    at the first call).
    Singular at phi_y = +-90 degrees, as all 3-2-1 angles are.
    """
    R = rotation(q[3:])
    omega = np.empty_like(q[3:])
    body_rates(omega, q[3:], q_dot[3:])
    wrench = np.zeros_like(q)
    _mount_wrench(wrench, R, omega, q, q_dot, q_ch, q_ch_dot, arrays)
    _generalised_wrench(wrench, R, q, q_dot, q_ch, q_ch_dot, arrays)
    force = np.empty_like(omega)
    for k in range(u.shape[0]):
        for i in range(3):
            force[i] = arrays.actuator_force[k, i] * u[k]
        _add_force(wrench, arrays.actuator_position[k], R, force)
    return _accelerations(wrench, R, omega, q, q_dot, arrays)
