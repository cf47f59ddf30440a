"""Time-domain prediction of a rig's sensor outputs for given voltages and floor motion, piece by piece.

Between samples the voltage is constant and the floor's velocity linear, so that the step of the linear table with its
sensor chains is exact (Van Loan 1978); a delay that is not a whole number of samples divides the step in two. The
second-order terms of the table's rotations are added as accelerations that are extrapolated linearly from one sample to
the next, as in the simulator (`simulation.kernel`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.identification.large_motion import SteppedTable, sensors_of, step_through, step_through_linear
from avis_ctrl.identification.response import FLOOR, ResponseModel
from avis_ctrl.identification.sample_and_hold import whole_samples
from avis_ctrl.measurement.campaign import Record
from avis_ctrl.rigs.nonlinear import rig_arrays


class Continuous(NamedTuple):
    """x' = A x + B (u, w, e), y = C x + D (u, w, e): volts u at the motors, floor velocity w (3) [m/s], and optionally
    accelerations e: of the payload (6), and added to the sensors' readings (n_y)."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


# States of the table: q, q', displacement of the floor. Number of integrations from acceleration to each motion.
TABLE, INTEGRATIONS = 15, {"displacement": 2, "velocity": 1, "acceleration": 0}


def _body(model: ResponseModel) -> np.ndarray:
    """(6, 15 + n_u + 3): acceleration of the payload by the states of the table, by volts and by floor velocity."""
    m = model.matrices
    return la.solve(m.M, np.hstack([-m.K, -m.C, m.K_floor[:, :3], m.T, m.C_floor[:, :3]]))


def continuous(model: ResponseModel, beside: bool = False) -> Continuous:
    """Model with states q, q', displacement of the floor, and those of each sensor's chain (and of each amplifier).

    beside : with inputs e. Their readings add integrators in front of the chains, as states after the amplifiers'.
    """
    n_u, rows, body = len(model.actuators), model.matrices.R, _body(model)
    sensors, gains = model.sensors.realised, model.sensors.sensitivity
    n_y, own = len(rows), _slices(TABLE, (0 if chain is None else chain.nstates for chain in sensors.chains))
    corner = 2 * np.pi * model.amplifier_corner_Hz if model.amplifier_corner_Hz else None
    n_a = n_u if corner else 0
    plain = (own[-1].stop if own else TABLE) + n_a
    # Integrators from an acceleration to a sensor's motion.
    integrators = _slices(plain, (INTEGRATIONS[motion] * beside for motion in sensors.motions))
    size, n_in, n_e = max(plain, *(one.stop for one in integrators)), n_u + 3, 6 + n_y if beside else 0
    amplifiers, volts = slice(plain - n_a, plain), slice(0, n_u)
    A, B = np.zeros((size, size)), np.zeros((size, n_in + n_e))
    A[:6, 6:12], A[6:12, :15] = np.eye(6), body[:, :15]
    B[6:12, n_u:n_in], B[12:15, n_u:n_in] = body[:, 15 + n_u :], np.eye(3)
    if beside:
        B[6:12, n_in : n_in + 6] = np.eye(6)
    if corner:
        A[6:12, amplifiers] = body[:, 15 : 15 + n_u]
        A[amplifiers, amplifiers], B[amplifiers, volts] = -corner * np.eye(n_u), corner * np.eye(n_u)
    else:
        B[6:12, volts] = body[:, 15 : 15 + n_u]
    # The motion that the sensors measure, along their axes.
    none = np.zeros((6, n_in + n_e))
    motion = {
        "displacement": (np.eye(size)[:6], none),
        "velocity": (np.eye(size)[6:12], none),
        "acceleration": (A[6:12].copy(), B[6:12].copy()),
    }
    C, D = np.zeros((n_y, size)), np.zeros((n_y, n_in + n_e))
    for k, (chain, part, added) in enumerate(zip(sensors.chains, own, integrators, strict=True)):
        seen_x, seen_e = (rows[k] @ one for one in motion[sensors.motions[k]])
        if sensors.relative[k]:
            seen_x[12:15] -= rows[k, :3]
        if added.stop > added.start:
            # A sensor's first integrator is the motion at its chain's input, the last one integrates e.
            A[added, added] = np.eye(added.stop - added.start, k=1)
            B[added.stop - 1, n_in + 6 + k] = 1.0
            seen_x[added.start] += 1.0
        elif beside:
            seen_e[n_in + 6 + k] += 1.0
        through = 1.0
        if chain is not None:
            A[part, part] = chain.A
            A[part] += np.outer(chain.B[:, 0], seen_x)
            B[part] += np.outer(chain.B[:, 0], seen_e)
            C[k, part] += gains[k] * chain.C[0]
            through = chain.D[0, 0]
        C[k] += gains[k] * through * seen_x
        D[k] = gains[k] * through * seen_e
    return Continuous(A, B, C, D)


def _slices(first: int, sizes: Iterable[int]) -> list[slice]:
    """Slices of consecutive groups of states, from index `first` on."""
    ends = first + np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


class Predictor:
    """Sensor outputs of a model that starts at rest, piece after piece.

    A floor that was not measured is taken as still. Nothing is rounded or clipped.

    large_motion : with the second-order terms of the table's rotations, with `model.turning` for motors and sensors.
    """

    def __init__(self, model: ResponseModel, large_motion: bool = False):
        if not model.period_s:
            raise InputError("expected a model with a sample time", field="period_s", value=model.period_s)
        self.model, self.system = model, continuous(model, large_motion)
        self.whole, part = whole_samples(model.delay_s, model.period_s)
        early, late = self._step(part), self._step(1 - part)
        n_u = len(model.actuators)
        self.Phi = late[0] @ early[0]
        # In the first part of a period the older voltage still acts; the floor velocity is linear over the whole
        # period.
        whole_step = self._step(1.0)
        self.old, self.new = late[0] @ early[1][:, :n_u], late[1][:, :n_u]
        self.floor, self.ramp = (step[:, n_u : n_u + 3] for step in whole_step[1:])
        self.part = part
        self.x = np.zeros(len(self.Phi))
        self.pending = np.zeros((self.whole + 1, n_u))
        self.table: SteppedTable | None = None
        if large_motion:
            held, rising = (np.ascontiguousarray(step[:, n_u + 3 :]) for step in whole_step[1:])
            self.table, self.arrays = self._stepped(held, rising), rig_arrays(model.rig.mounted_body())
            self.before, self.started = np.zeros(6 + len(model.sensors.names)), False

    def _stepped(self, held: np.ndarray, rising: np.ndarray) -> SteppedTable:
        model, m = self.model, self.model.matrices
        n_u, corner = len(model.actuators), model.amplifier_corner_Hz
        known = [one.name for one in model.rig.mounted_body().actuators]
        chains = sum(0 if chain is None else chain.nstates for chain in model.sensors.realised.chains)
        of_x, of_volts, of_floor = (
            np.ascontiguousarray(one) for one in np.split(_body(model), [TABLE, TABLE + n_u], axis=1)
        )
        place, direction = sensors_of(model.rig, model.sensors.names)
        return SteppedTable(
            np.ascontiguousarray(self.Phi),
            held,
            rising,
            of_x,
            of_volts,
            of_floor,
            TABLE + chains if corner else -1,
            np.array([known.index(name) for name in model.actuators], np.int64),
            np.ascontiguousarray(la.inv(m.M)),
            place,
            direction,
            float(model.turning.motors),
            float(model.turning.sensors),
        )

    def _step(self, fraction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step over a fraction of a period: e^(A h), and the contributions of a constant and a rising unit input."""
        A, B = self.system.A, self.system.B
        n, m = B.shape
        block, h = np.zeros((n + 2 * m, n + 2 * m)), fraction * self.model.period_s
        block[:n, :n], block[:n, n : n + m], block[n : n + m, n + m :] = A * h, B * h, np.eye(m)
        power = la.expm(block)
        return power[:n, :n], power[:n, n : n + m], power[:n, n + m :]

    def read(self, u: np.ndarray, floor: np.ndarray | None = None) -> np.ndarray:
        """(n, n_y) for commanded u (n, n_u) in the model's order and floor velocity (n, 3) or None.

        floor : with the following sample, (n + 1, 3), if it is known: the floor velocity is linear up to it.
        """
        n = len(u)
        held = np.vstack([self.pending, u])
        self.pending = held[n:]
        # At sample k the voltage u[k - whole] acts or, if the delay has a fractional part, the voltage before it.
        new, old = held[1 : n + 1], held[:n]
        drive = new @ self.new.T + old @ self.old.T
        w = np.zeros((n + 1, len(FLOOR)))
        if floor is not None:
            w[: len(floor)], w[len(floor) :] = floor, floor[-1]
            drive += w[:-1] @ self.floor.T + np.diff(w, axis=0) @ self.ramp.T
        x = np.empty((n, len(self.x)))
        acting = new if not np.any(self.old) else old
        inputs = [acting, w[:-1]]
        if self.table is None:
            step_through_linear(drive, self.x, self.Phi, x)
        else:
            beside = np.empty((n, len(self.before)))
            step_through(
                drive,
                np.ascontiguousarray(self.part * old + (1 - self.part) * new),
                w[:-1],
                self.x,
                self.before,
                self.started,
                self.table,
                self.arrays,
                x,
                beside,
            )
            self.started = self.started or n > 0
            inputs.append(beside)
        y = x @ self.system.C.T
        if np.any(self.system.D):
            y = y + np.hstack(inputs) @ self.system.D.T
        return y


def predict(model: ResponseModel, record: Record, large_motion: bool = True) -> np.ndarray:
    """(samples, n_y) output of the model in a record that starts at rest, in the unit of y.

    large_motion : with the second-order terms of the table's rotations.

    Raises
    ------
    InputError : channels or a sample rate that are not the model's.
    """
    model.require_rate(record.header)
    return Predictor(model, large_motion).read(*model_inputs(model, record))


def model_inputs(model: ResponseModel, record: Record) -> tuple[np.ndarray, np.ndarray | None]:
    """u (n, n_u) and floor (n, 3) of a record in the model's order; inputs that the record does not have are zero."""
    h = record.header
    u = np.zeros((h.samples, len(model.actuators)))
    u[:, places(h.u_names, model.actuators, "the model's actuators are", f"record {h.name}: u names")] = record.u
    if record.floor is None:
        return u, None
    floor = np.zeros((h.samples, len(FLOOR)))
    floor[:, places(h.floor_names, FLOOR, "expected", f"record {h.name}: floor names")] = record.floor
    return u, floor
