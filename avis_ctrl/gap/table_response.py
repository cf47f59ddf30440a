"""Response of an assembled table to its inputs, and the derivative with respect to the rig's parameters."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.operators import Assembled, MountSlopes
from avis_ctrl.identification.response import AMPLIFIERS, N_Q, Matrices, Operands, ResponseModel

# Parameter names of mount stiffnesses and dampings.
MOUNT = re.compile(r"isolator(\d+)\.([kc])_([xyz])")


@dataclass(frozen=True, eq=False)
class Acting:
    """Inputs of the table: U (n, n_u + 3 [+ 12], m) with the volts of n_u drives first, internal force (n, 6, m),
    displacement (n, n_y, m) that the sensors read in addition to the payload's, additional sensor output (n, n_y, m),
    and initial internal states (`TableModel.inner_transients`)."""

    U: np.ndarray
    n_u: int
    force: np.ndarray | None = None
    reading: np.ndarray | None = None
    output: np.ndarray | None = None
    inner: np.ndarray | None = None

    @cached_property
    def driven(self) -> bool:
        """Whether there are volts."""
        return bool(self.U[:, : self.n_u].any())

    @cached_property
    def floor_moves(self) -> bool:
        """Whether there is floor motion."""
        return bool(self.U[:, self.n_u : self.n_u + 3].any())


class DrivenTable:
    """Forces (n, n_q, m) on an assembled table, and its sensor outputs for a given motion."""

    def __init__(self, made: Assembled, acting: Acting):
        self.made, self.acting, self.gain = made, acting, made.gain
        U, ops, n_u = acting.U, made.ops, acting.n_u
        self.s = s = ops.s[:, None, None]
        commanded = U[:, :n_u]
        self.volts = made.volts[:, :, None] * commanded
        self.w = U[:, n_u : n_u + 3] / s
        self.folded, self.alias = commanded * ops.drive[:, :, None], made.folded[:, :, None]
        self.sense = ops.sense[:, :, None]
        total = made.T @ self.volts if acting.driven else np.zeros((len(s), made.n_q, U.shape[2]), complex)
        if acting.floor_moves:
            total = total + made.floor_force(self.w)
        if U.shape[1] > n_u + 3:
            total[:, :N_Q] += U[:, n_u + 3 : n_u + 3 + N_Q] + s * U[:, n_u + 3 + N_Q :]
        if acting.force is not None:
            total[:, :N_Q] += acting.force
        if acting.inner is not None and acting.inner.size:
            total += (made.forces_of_states @ acting.inner)[:, :, None]
        self.total = total

    def read(self, x: np.ndarray) -> np.ndarray:
        """(n, n_y, m) sensor outputs for a motion x; aliases pass the chain far above its corners."""
        base = self.made.ops.base
        moved = self.made.rows @ x
        if np.any(against := self.made.ops.against):
            moved = moved - against @ self.made.chassis(x, self.w, self.acting.inner)
        if self.acting.reading is not None:
            moved = moved + self.acting.reading
        output = self.sense * moved
        if self.acting.driven:
            output += self.alias * (base.accelerance @ self.folded)
        Y = self.gain * output
        return Y if self.acting.output is None else Y + self.acting.output


class AtMotion(DrivenTable):
    """Sensor outputs Y of an assembled table for a given motion x, and the applied minus the required force (push)."""

    def __init__(self, made: Assembled, acting: Acting, x: np.ndarray):
        super().__init__(made, acting)
        self.push, self.Y = self.total - made.D @ x, self.read(x)


class TableResponse(DrivenTable):
    """Response of an assembled table."""

    def __init__(self, made: Assembled, acting: Acting):
        super().__init__(made, acting)
        self.x = made.inverse @ self.total
        self.Y = self.read(self.x)

    @property
    def left(self) -> np.ndarray:
        """(n, n_y, n_q) y per force on the coordinates."""
        return self.made.left

    def by_rig(self, model: ResponseModel, d: Matrices, places: MountSlopes, more: int) -> np.ndarray:
        """(n_p + more, n, n_y, m) derivative with respect to the rig's free parameters, followed by zeros; d :
        derivatives of the matrices without mounts; places : of the mounts' geometry."""
        if "loop_delay_s" in model.names:
            raise InputError(
                "expected the effect loop_delay in the place of this parameter",
                field="parameters",
                value="loop_delay_s",
            )
        made, ops, s, per_force = self.made, self.made.ops, self.s, self.left
        q, chassis = self.x[:, :N_Q], made.chassis(self.x, self.w, self.acting.inner)
        own, moved = made.G @ self.x, ops.mounts.chassis @ chassis
        through = per_force @ made.G.T
        inertial = per_force[:, :, :N_Q]
        if ops.recoil is not None:
            inertial = inertial + through @ (made.z_pf[:, :, None] * (ops.mounts.chassis @ ops.recoil))
        if made.read_recoil is not None:
            inertial = inertial - self.gain * self.sense * made.read_recoil
        operands = Operands(
            ops.base.sensors,
            model.matrices,
            s,
            per_force[:, :, :N_Q],
            inertial,
            self.gain * self.sense,
            self.gain * self.alias,
            made.hold[:, None, None],
            self.folded,
            q,
            made.follow(self.w),
            chassis,
            self.Y if self.acting.output is None else self.Y - self.acting.output,
        )
        dY = operands.derivative(model.names, d, more)
        if made.n_q > N_Q:
            # A motor's force constant also acts on the coordinates that effects add.
            T = model.matrices.T[:3]
            relative = np.sum(T * d.T[:, :3], axis=1) / np.sum(T**2, axis=0)
            for row, k in zip(*np.nonzero(relative), strict=True):
                onto_added = per_force[:, :, N_Q:] @ made.T[N_Q:, k, None]
                dY[row] += relative[row, k] * onto_added * self.volts[:, k, None]
        if AMPLIFIERS in model.names and self.acting.driven and ops.amplifier_corner_Hz is not None:
            # The effect actuator_lag adds to the time constant.
            driven = replace(model, delay_s=ops.delay_s, amplifier_corner_Hz=ops.amplifier_corner_Hz)
            slope, folded = driven.drive_slopes(ops.omega, AMPLIFIERS)
            by_force, aliased = made.T @ (slope * self.folded), model.accelerance @ self.folded
            dY[model.names.index(AMPLIFIERS)] = per_force @ by_force + self.gain * folded * aliased
        rows = {name: k for k, name in enumerate(ops.mounts.names)}
        for kind in "kc":
            found = [
                (j, rows[f"isolator{match[1]}.{match[3]}"])
                for j, name in enumerate(model.names)
                if (match := MOUNT.fullmatch(name)) and match[2] == kind
            ]
            if not found:
                continue
            j, k = np.array(found).T
            if kind == "k":
                push = made.slope_pf[:, k, None] * moved[:, k] - made.slope_pp[:, k, None] * own[:, k]
            else:
                push = s * ops.damping_factor[:, k, None] * (moved[:, k] - own[:, k])
            dY.transpose(1, 3, 2, 0)[..., j] = through[:, None, :, k] * push.swapaxes(1, 2)[:, :, None]
        pull = made.z_pf[:, :, None] * moved - made.z_pp[:, :, None] * own
        if self.acting.inner is not None and self.acting.inner.size:
            pull = pull + made.push_of_masses_inside(self.acting.inner)
        for row, payload, base in zip(places.parameters, places.payload, places.chassis, strict=True):
            push = made.z_pf[:, :, None] * (base @ chassis) - made.z_pp[:, :, None] * (payload @ q)
            dY[row] += per_force[:, :, :N_Q] @ (payload.T @ pull) + through @ push
        return dY
