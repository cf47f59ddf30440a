"""What a rig's sensors read for given voltages and floor motion: simulation in time, record by record, piece by piece.

Between samples the voltage is held and the floor's velocity is a straight line, so that the step of the linear table
with its sensor chains is exact (Van Loan 1978); a delay that is no whole number of samples divides the step in two.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import FLOOR, ResponseModel, SensorModel
from avis_ctrl.measurement.campaign import Record


class Continuous(NamedTuple):
    """x' = A x + B (u, w), y = C x + D (u, w): volts u at the motors, floor velocity w (3) [m/s]."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


def continuous(model: ResponseModel) -> Continuous:
    """States q, q', displacement of the floor, and those of each sensor's chain (and of each amplifier)."""
    m, n_u, rows = model.matrices, len(model.actuators), model.matrices.R
    body = la.solve(m.M, np.hstack([-m.K, -m.C, m.K_floor[:, :3], m.T, m.C_floor[:, :3]]))
    sensors, gains = model.sensors, model.sensors.sensitivity
    n_y, own = len(rows), chain_states(sensors)
    corner = 2 * np.pi * model.amplifier_corner_Hz if model.amplifier_corner_Hz else None
    n_a = n_u if corner else 0
    size = 15 + own[-1].stop - own[0].start + n_a if own else 15 + n_a
    amplifiers, volts = slice(size - n_a, size), slice(0, n_u)
    A, B = np.zeros((size, size)), np.zeros((size, n_u + 3))
    A[:6, 6:12], A[6:12, :15] = np.eye(6), body[:, :15]
    B[6:12, n_u:], B[12:15, n_u:] = body[:, 15 + n_u:], np.eye(3)
    if corner:
        A[6:12, amplifiers] = body[:, 15:15 + n_u]
        A[amplifiers, amplifiers], B[amplifiers, volts] = -corner * np.eye(n_u), corner * np.eye(n_u)
    else:
        B[6:12, volts] = body[:, 15:15 + n_u]
    # The motion that the sensors take in, along their axes.
    none = np.zeros((6, n_u + 3))
    motion = {"displacement": (np.eye(size)[:6], none), "velocity": (np.eye(size)[6:12], none),
              "acceleration": (A[6:12].copy(), B[6:12].copy())}
    C, D = np.zeros((n_y, size)), np.zeros((n_y, n_u + 3))
    for k, (chain, part) in enumerate(zip(sensors.chains, own, strict=True)):
        seen_x, seen_e = (rows[k] @ one for one in motion[sensors.motions[k]])
        if sensors.relative[k]:
            seen_x[12:15] -= rows[k, :3]
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


def chain_states(sensors: SensorModel) -> list[slice]:
    """Of each sensor's chain, behind the 15 states of the table."""
    ends = 15 + np.cumsum([0, *(0 if chain is None else chain.nstates for chain in sensors.chains)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


class Predictor:
    """Reads of the sensors of a model that starts at rest, piece after piece.

    A floor that was not measured counts as still. Nothing is rounded or clipped.
    """

    def __init__(self, model: ResponseModel):
        if not model.period_s:
            raise InputError("expected a model with a sample time", field="period_s", value=model.period_s)
        self.model, self.system = model, continuous(model)
        whole, part = divmod(model.delay_s / model.period_s, 1.0)
        if part > 1 - 1e-9:
            whole, part = whole + 1, 0.0
        self.whole = int(whole)
        early, late = self._step(part), self._step(1 - part)
        n_u = len(model.actuators)
        self.Phi = late[0] @ early[0]
        # In the first part of a period the older voltage still acts; the floor's line runs over the whole of it.
        whole_step = self._step(1.0)
        self.old, self.new = late[0] @ early[1][:, :n_u], late[1][:, :n_u]
        self.floor, self.ramp = whole_step[1][:, n_u:], whole_step[2][:, n_u:]
        self.x = np.zeros(len(self.Phi))
        self.pending = np.zeros((self.whole + 1, n_u))

    def _step(self, fraction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Over a fraction of a period: e^(A h), and what a constant and a rising unit line add."""
        A, B = self.system.A, self.system.B
        n, m = B.shape
        block, h = np.zeros((n + 2 * m, n + 2 * m)), fraction * self.model.period_s
        block[:n, :n], block[:n, n:n + m], block[n:n + m, n + m:] = A * h, B * h, np.eye(m)
        power = la.expm(block)
        return power[:n, :n], power[:n, n:n + m], power[:n, n + m:]

    def read(self, u: np.ndarray, floor: np.ndarray | None = None) -> np.ndarray:
        """(n, n_y) for commanded u (n, n_u) in the model's order and floor velocity (n, 3) or None."""
        n = len(u)
        held = np.vstack([self.pending, u])
        self.pending = held[n:]
        # While sample k is taken, the voltage u[k - whole] acts, or with a part of a sample more, the one before.
        new, old = held[1:n + 1], held[:n]
        drive = new @ self.new.T + old @ self.old.T
        w = np.zeros((n + 1, len(FLOOR)))
        if floor is not None:
            w[:-1], w[-1] = floor, floor[-1]
            drive += w[:-1] @ self.floor.T + np.diff(w, axis=0) @ self.ramp.T
        x = np.empty((n, len(self.x)))
        for k in range(n):
            x[k] = self.x
            self.x = self.Phi @ self.x + drive[k]
        acting = new if not np.any(self.old) else old
        y = x @ self.system.C.T
        if np.any(self.system.D):
            y = y + np.hstack([acting, w[:-1]]) @ self.system.D.T
        return y


def predict(model: ResponseModel, record: Record) -> np.ndarray:
    """(samples, n_y) what the model reads in a record that starts at rest, in the unit of y.

    Raises
    ------
    InputError : channels or a sample rate that are not the model's.
    """
    h = record.header
    if abs(h.sample_rate_Hz * model.period_s - 1) > 1e-6:
        raise InputError(f"expected the rig's own {1 / model.period_s:g} Hz", value=h.sample_rate_Hz,
                         field=f"record {h.name}: sample_rate_Hz")
    return Predictor(model).read(*model_inputs(model, record))


def model_inputs(model: ResponseModel, record: Record) -> tuple[np.ndarray, np.ndarray | None]:
    """u (n, n_u) and floor (n, 3) of a record in the model's order; inputs that it does not name are zero."""
    h = record.header
    u = np.zeros((h.samples, len(model.actuators)))
    for names, known, values, into in ((h.u_names, model.actuators, record.u, u),):
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"the model's actuators are {', '.join(known)}", field=f"record {h.name}: u names",
                             value=unknown)
        for k, name in enumerate(names):
            into[:, known.index(name)] = values[:, k]
    if record.floor is None:
        return u, None
    if unknown := [name for name in h.floor_names if name not in FLOOR]:
        raise InputError(f"expected {', '.join(FLOOR)}", field=f"record {h.name}: floor names", value=unknown)
    floor = np.zeros((h.samples, len(FLOOR)))
    for k, name in enumerate(h.floor_names):
        floor[:, FLOOR.index(name)] = record.floor[:, k]
    return u, floor
