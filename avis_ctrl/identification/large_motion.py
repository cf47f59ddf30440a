"""Second-order terms of large rotations, which every table has in addition to its linear model.

They are the nonlinear table of Rademakers (eqs. 2.1-2.21, `rigs.nonlinear`) minus its linearisation, as an acceleration
of the payload. The source does not specify whether motors and sensors turn with the payload (its forces act along earth
axes, its sensors are on the payload): `Turning` specifies it for each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from avis_ctrl.rigs.nonlinear import RigArrays, payload_acceleration, rig_arrays
from avis_ctrl.rigs.rig import Rig


class Turning(NamedTuple):
    """Fraction of the payload's rotation by which the axes of the motors and of the sensors turn: 0 for axes fixed in
    space, as in the simulator of this package, and 1 for axes fixed to the payload."""

    motors: float = 0.0
    sensors: float = 0.0

    @property
    def sentence(self) -> str:
        """Description in words."""

        def of(share: float) -> str:
            return "turn with the table" if share > 0.5 else "keep their direction in space"

        return (
            f"the model includes second-order terms of the table's rotations, in which the motors' axes "
            f"{of(self.motors)} and the sensors' axes {of(self.sensors)}"
        )


AS_SIMULATED = Turning()


def sensors_of(rig: Rig, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n_y, 3) [m] and directions (n_y, 3) of the named sensors on the payload."""
    axes = rig.sensor_axes()
    place, direction = (np.array([axes[name][k] for name in names], float).reshape(-1, 3) for k in (0, 1))
    return place, direction


def second_order(
    rig: Rig, q: np.ndarray, q_dot: np.ndarray, u: np.ndarray, sensors: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Second-order force of the table (samples, 6), force added by turned motors (samples, 6), and acceleration
    (samples, n_y) added to the readings of turned sensors.

    q, q_dot : (samples, 6) payload relative to the chassis. u : (samples, n_u) acting volts.
    """
    body, eom = rig.mounted_body(), rig.equations_of_motion()
    arrays = rig_arrays(body)
    q, q_dot, u = (np.ascontiguousarray(one, float) for one in (q, q_dot, u))
    q_ddot, turned = _along(q, q_dot, u, arrays)
    large = q_ddot @ eom.M.T + q_dot @ eom.C.T + q @ eom.K.T - u @ eom.T.T
    place, direction = sensors_of(rig, sensors)
    return large, turned, _turned_readings(q, q_dot, q_ddot, place, direction)


@njit(cache=True)
def _along(q: np.ndarray, q_dot: np.ndarray, u: np.ndarray, arrays: RigArrays) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations (n, 6), and forces (n, 6) added by turned motors."""
    acceleration, turned = np.empty_like(q), np.empty_like(q)
    still = np.zeros(6)
    for k in range(len(q)):
        acceleration[k] = payload_acceleration(q[k], q_dot[k], u[k], still, still, arrays)
        turned_force(turned[k], q[k], u[k], arrays)
    return acceleration, turned


@njit(cache=True)
def _turned_readings(
    q: np.ndarray, q_dot: np.ndarray, q_ddot: np.ndarray, place: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    out = np.empty((len(q), len(place)))
    for k in range(len(q)):
        turned_reading(out[k], q[k], q_dot[k], q_ddot[k], place, direction)
    return out


@njit(cache=True)
def turned_force(out: np.ndarray, q: np.ndarray, u: np.ndarray, arrays: RigArrays) -> None:
    """out (6,): force added by the motors when their axes turn by the payload's small rotation."""
    for i in range(6):
        out[i] = 0.0
    for k in range(u.shape[0]):
        f, p = arrays.actuator_force[k], arrays.actuator_position[k]
        x = (q[4] * f[2] - q[5] * f[1]) * u[k]
        y = (q[5] * f[0] - q[3] * f[2]) * u[k]
        z = (q[3] * f[1] - q[4] * f[0]) * u[k]
        out[0] += x
        out[1] += y
        out[2] += z
        out[3] += p[1] * z - p[2] * y
        out[4] += p[2] * x - p[0] * z
        out[5] += p[0] * y - p[1] * x


@njit(cache=True)
def turned_reading(
    out: np.ndarray, q: np.ndarray, q_dot: np.ndarray, q_ddot: np.ndarray, place: np.ndarray, direction: np.ndarray
) -> None:
    """out (n_y,): acceleration that sensors on the payload measure in addition to the linear one: their axes turn by
    its rotation, and their positions move with its square (3-2-1 angles, as in `rigs.nonlinear`)."""
    a, v, w = q[3:], q_dot[3:], q_ddot[3:]
    # Second derivatives of the products of angles in the rotation matrix.
    s11, s22, s33 = 2 * (w[0] * a[0] + v[0] ** 2), 2 * (w[1] * a[1] + v[1] ** 2), 2 * (w[2] * a[2] + v[2] ** 2)
    s12 = w[0] * a[1] + 2 * v[0] * v[1] + a[0] * w[1]
    s13 = w[0] * a[2] + 2 * v[0] * v[2] + a[0] * w[2]
    s23 = w[1] * a[2] + 2 * v[1] * v[2] + a[1] * w[2]
    for k in range(place.shape[0]):
        p, d = place[k], direction[k]
        a0 = q_ddot[0] + q_ddot[4] * p[2] - q_ddot[5] * p[1]
        a1 = q_ddot[1] + q_ddot[5] * p[0] - q_ddot[3] * p[2]
        a2 = q_ddot[2] + q_ddot[3] * p[1] - q_ddot[4] * p[0]
        out[k] = (
            (q[4] * d[2] - q[5] * d[1]) * a0
            + (q[5] * d[0] - q[3] * d[2]) * a1
            + (q[3] * d[1] - q[4] * d[0]) * a2
            + d[0] * (s12 * p[1] + s13 * p[2] - (s22 + s33) / 2 * p[0])
            + d[1] * (s23 * p[2] - (s11 + s33) / 2 * p[1])
            - d[2] * (s11 + s22) / 2 * p[2]
        )


class SteppedTable(NamedTuple):
    """A sampled table with its second-order terms, from sample to sample.

    Phi (N, N); held, ramp (N, 6 + n_y): contributions over a period of constant and rising accelerations of the
    payload, and of those added to the sensors' readings. body (6, 15), of_volts (6, n_u), of_floor (6, 3): acceleration
    of the linear table. amplifiers : index of the first of their states, -1 for none. order : (n_u,) indices of the
    model's actuators among the body's. inverse (6, 6) of the mass matrix.
    """

    Phi: np.ndarray
    held: np.ndarray
    ramp: np.ndarray
    body: np.ndarray
    of_volts: np.ndarray
    of_floor: np.ndarray
    amplifiers: int
    order: np.ndarray
    inverse: np.ndarray
    place: np.ndarray
    direction: np.ndarray
    motors: float
    sensors: float


@njit(cache=True, fastmath={"reassoc", "contract"})
def step_through(
    drive: np.ndarray,
    volts: np.ndarray,
    floor: np.ndarray,
    x: np.ndarray,
    before: np.ndarray,
    started: bool,
    table: SteppedTable,
    arrays: RigArrays,
    states: np.ndarray,
    beside: np.ndarray,
) -> None:
    """Step through a piece of a record.

    drive : (n, N) contribution of the inputs to the state over a period. volts (n, n_u), floor (n, 3): acting at its
        start.
    x : (N,) state at the start, modified. before : (6 + n_y,) second-order terms of the previous sample, modified;
        started : whether there is one. states (n, N), beside (n, 6 + n_y), the second-order terms : outputs.
    """
    N, n_u, n_e = x.shape[0], volts.shape[1], before.shape[0]
    q, q_dot, floor_q, floor_v = np.empty(6), np.empty(6), np.zeros(6), np.zeros(6)
    u, full = np.empty(n_u), np.zeros(arrays.actuator_position.shape[0])
    force, linear, total, read = np.empty(6), np.empty(6), np.empty(6), np.empty(n_e - 6)
    after = np.empty(N)
    for k in range(drive.shape[0]):
        for i in range(6):
            q[i], q_dot[i] = x[i], x[6 + i]
        for i in range(3):
            floor_q[i], floor_v[i] = x[12 + i], floor[k, i]
        for i in range(n_u):
            u[i] = volts[k, i] if table.amplifiers < 0 else x[table.amplifiers + i]
            full[table.order[i]] = u[i]
        true = payload_acceleration(q, q_dot, full, floor_q, floor_v, arrays)
        turned_force(force, q, full, arrays)
        for i in range(6):
            sum_ = 0.0
            for j in range(15):
                sum_ += table.body[i, j] * x[j]
            for j in range(n_u):
                sum_ += table.of_volts[i, j] * u[j]
            for j in range(3):
                sum_ += table.of_floor[i, j] * floor_v[j]
            linear[i] = sum_
        for i in range(6):
            more = 0.0
            for j in range(6):
                more += table.inverse[i, j] * force[j]
            beside[k, i] = true[i] - linear[i] + table.motors * more
            total[i] = linear[i] + beside[k, i]
        turned_reading(read, q, q_dot, total, table.place, table.direction)
        for i in range(n_e - 6):
            beside[k, 6 + i] = table.sensors * read[i]
        for i in range(N):
            states[k, i] = x[i]
            sum_ = drive[k, i]
            for j in range(N):
                sum_ += table.Phi[i, j] * x[j]
            for j in range(n_e):
                rise = beside[k, j] - before[j] if started else 0.0
                sum_ += table.held[i, j] * beside[k, j] + table.ramp[i, j] * rise
            after[i] = sum_
        for i in range(N):
            x[i] = after[i]
        for j in range(n_e):
            before[j] = beside[k, j]
        started = True


@njit(cache=True, fastmath={"reassoc", "contract"})
def step_through_linear(drive: np.ndarray, x: np.ndarray, Phi: np.ndarray, states: np.ndarray) -> None:
    """`step_through` for the linear table."""
    N = x.shape[0]
    after = np.empty(N)
    for k in range(drive.shape[0]):
        for i in range(N):
            states[k, i] = x[i]
            sum_ = drive[k, i]
            for j in range(N):
                sum_ += Phi[i, j] * x[j]
            after[i] = sum_
        for i in range(N):
            x[i] = after[i]
