"""The table line by line: the operators that effects change before the response is computed.

    D x = T v + F_w w + transient - internal forces,     D = s^2 M + G^T z_pp G + Z_0 + G^T z_pf G_c B (s^2 M + Z_e)
    F_w = G^T z_pf G_c H_w + Z_f,        y = S sense (rows x - against q_c) + aliases

x contains the six coordinates q of the payload and the coordinates that effects add (its modes). G (n_g, n_q) maps x to
the displacement of every mount along x, y, z at the payload, G_c that of the chassis. z_pp and z_pf (n, n_g) are the
complex stiffnesses of the mounts: force on the payload due to its own displacement, and due to that of the chassis;
they are equal without mass inside the mount. Z_0 is the dynamic stiffness of everything else that supports the payload,
Z_e its part that effects add, Z_f its part that moves with the floor. The chassis follows the floor displacement w
through H_w and recoils with B; on a stiff floor H_w is one and B is zero. A position sensor reads against the chassis,
whose displacement is q_c.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import TypeVar

import numpy as np

from avis_ctrl.identification.response import N_Q, ResponseModel, central_differences
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import point_map


@dataclass(frozen=True, eq=False)
class MountGeometry:
    """Mounts along the earth axes: names "isolator1.x", rows from q (n_g, 6) at payload and chassis, and values.

    stiffness [N/m] and damping [N s/m], (n_g,). rest_K, rest_C (6, 6): stiffness and damping of the rig without its
    mounts.
    """

    names: tuple[str, ...]
    payload: np.ndarray
    chassis: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    rest_K: np.ndarray
    rest_C: np.ndarray

    @staticmethod
    def of(rig: Rig) -> MountGeometry:
        """The mounts of a rig that has mount parameters along the earth axes; for any other rig, everything is in
        rest_K and rest_C."""
        if "isolator1.k_z" not in rig.parameters():
            eom = rig.equations_of_motion()
            none = np.zeros((0, 6))
            return MountGeometry((), none, none, np.zeros(0), np.zeros(0), eom.K, eom.C)
        body = rig.mounted_body()
        mounts = body.mounts
        return MountGeometry(
            tuple(f"{mount.name}.{axis}" for mount in mounts for axis in "xyz"),
            np.concatenate([point_map(mount.position) for mount in mounts]),
            np.concatenate([point_map(mount.chassis_point) for mount in mounts]),
            np.concatenate([np.diag(mount.stiffness) for mount in mounts]),
            np.concatenate([np.diag(mount.damping) for mount in mounts]),
            np.array(body.stiffness),
            np.array(body.damping),
        )

    def along(self, axis: str) -> np.ndarray:
        """Mask of the rows along an axis."""
        return np.array([name.endswith("." + axis) for name in self.names])

    def resonances(self, M: np.ndarray) -> np.ndarray:
        """(n_g,) rad/s: Rayleigh's quotient of the motion that a force along each row gives a free payload of mass
        matrix M (6, 6)."""
        moved = np.linalg.solve(M, self.payload.T)
        K = self.payload.T @ (self.stiffness[:, None] * self.payload) + self.rest_K
        return np.asarray(np.sqrt(np.sum(moved * (K @ moved), axis=0) / np.sum(moved * self.payload.T, axis=0)))


@dataclass(frozen=True, eq=False)
class AddedCoordinate:
    """A coordinate in addition to the six: shape at mounts (n_g,), actuators (n_u,) and sensors (n_y,), and dynamic
    stiffness (n,) without the mounts [N/m], for a displacement of 1 m where the shape is 1."""

    stiffness: np.ndarray
    at_mounts: np.ndarray
    at_actuators: np.ndarray
    at_sensors: np.ndarray


class Operators:
    """Operators of a rig on lines omega (n,) rad/s; effects modify them.

    Attributes
    ----------
    s : (n,) j omega. base : rig, sensors, actuators. mounts : their geometry.
    stiffness_factor, damping_factor : (1 or n, n_g) complex factors of the mounts' k and c.
    internal_omega, internal_damping : (n_g,) rad/s and damping ratio of the resonance of a mass inside each mount,
        infinite without a mass; the mount's own c bypasses the mass. payload_share : (n_g,) fraction of the mount's
        compliance between that mass and the payload.
    extra, extra_floor : (n, 6, 6) and (n, 6, 3) N/m, dynamic stiffness on q, and force per floor displacement.
    rows : (1 or n, n_y, 6) displacement measured by each sensor. against : (1, n_y, 6) the same of the chassis, which
        is subtracted; zero for inertial sensors. sense : (n, n_y) sensor chain and s^p, without
        sensitivity.
    sensor_gain : (n_y,) factors. drive : (1 or n, n_u) factors of the volts. delay_s,
        amplifier_corner_Hz : of the drives.
    inner : (n, 6, m) forces on q due to unit impulses on internal states of effects. decays : the same for first-order
        states, which need impulses only. ringing : index of a sensor, and (n, m) its output due to unit initial values
        of states that an effect adds to its chain.
    added : coordinates in addition to the six. recoil, follow : (n, 6, 6) B and (n, 6, 3) H_w, None for a stiff floor.
    """

    extra: np.ndarray | None = None
    extra_floor: np.ndarray | None = None
    recoil: np.ndarray | None = None
    follow: np.ndarray | None = None

    def __init__(self, base: ResponseModel, omega: np.ndarray):
        self.base, self.omega, self.s = base, omega, 1j * omega
        self.mounts = mount_geometry(base.rig)
        n_g = len(self.mounts.names)
        self.stiffness_factor, self.damping_factor = np.ones((1, n_g), complex), np.ones((1, n_g), complex)
        self.internal_omega, self.internal_damping = np.full(n_g, np.inf), np.zeros(n_g)
        self.payload_share = np.full(n_g, 0.5)
        self.rows: np.ndarray = base.matrices.R[None]
        self.against: np.ndarray = base.sensors.relative[:, None] * self.rows
        self.sense = base.sensors.sense(omega)
        self.sensor_gain = np.ones(len(base.sensors.names))
        self.drive: np.ndarray = np.ones((1, len(base.actuators)), complex)
        self.delay_s, self.amplifier_corner_Hz = base.delay_s, base.amplifier_corner_Hz
        self.added: list[AddedCoordinate] = []
        self.inner: list[np.ndarray] = []
        self.decays: list[np.ndarray] = []
        self.ringing: list[tuple[int, np.ndarray]] = []

    def sensor(self, name: str) -> int:
        """Column of a sensor."""
        return self.base.sensors.names.index(name)

    def actuator(self, name: str) -> int:
        """Column of a motor."""
        return self.base.actuators.index(name)

    def borne(self, M: np.ndarray) -> np.ndarray:
        """(n, 6, 6) force per displacement of the payload that mounts and motors supply and that reacts on a chassis:
        due to the payload's inertia and the elements that effects attach to it."""
        inertia = self.s[:, None, None] ** 2 * M
        return inertia if self.extra is None else inertia + self.extra

    def add_impedance(
        self, dynamic_stiffness: np.ndarray, rows: np.ndarray, grounded: np.ndarray | None = None
    ) -> None:
        """Add elements along rows (m, 6) of dynamic stiffness (n, m) [N/m]; grounded (n, m): the part connected to the
        floor."""
        Z = np.einsum("nm,mi,mj->nij", dynamic_stiffness, rows, rows)
        self.extra = Z if self.extra is None else self.extra + Z
        if grounded is not None:
            F = np.einsum("nm,mi,mj->nij", grounded, rows, rows[:, :3])
            self.extra_floor = F if self.extra_floor is None else self.extra_floor + F


Kept = TypeVar("Kept")


def for_recent_rigs(function: Callable[..., Kept]) -> Callable[..., Kept]:
    """Keep the results for the most recent rigs and other arguments: a fit requests the same ones many times."""
    known: list[tuple[Rig, tuple[object, ...], Kept]] = []

    @wraps(function)
    def found(rig: Rig, *others: object) -> Kept:
        for one, own, result in known:
            if one is rig and own == others:
                return result
        result = function(rig, *others)
        known.append((rig, others, result))
        del known[:-8]
        return result

    return found


mount_geometry = for_recent_rigs(MountGeometry.of)


@dataclass(frozen=True, eq=False)
class MountSlopes:
    """Derivatives of the rows of `MountGeometry`, payload and chassis (p, n_g, 6), by p parameters.

    parameters : (p,) indices of these among all free parameters.
    """

    parameters: tuple[int, ...]
    payload: np.ndarray
    chassis: np.ndarray


@for_recent_rigs
def mount_slopes(rig: Rig, names: tuple[str, ...], places: tuple[int, ...]) -> MountSlopes:
    """Derivatives by the parameters names[k] with k in `places`. The rows are linear in them, so that the derivatives
    of one rig are those of all rigs of its structure."""

    def rows(moved: Rig) -> tuple[np.ndarray, np.ndarray]:
        mounts = MountGeometry.of(moved)
        return mounts.payload, mounts.chassis

    slopes = np.array([central_differences(rows, rig, names[k]) for k in places])
    slopes = slopes.reshape(len(places), 2, *mount_geometry(rig).payload.shape)
    return MountSlopes(places, slopes[:, 0], slopes[:, 1])


class Assembled:
    """The table assembled from `Operators`, ready for its response.

    D (n, n_q, n_q) and its inverse; M (6, 6); G (n_g, n_q); z_pp, z_pf, slope_pp, slope_pf (n, n_g): the slopes are
    derivatives with respect to the mount's stiffness k; with respect to its c both are s damping_factor. T (n_q, n_u)
    N/V, without the factors of the drives.
    """

    def __init__(self, ops: Operators):
        base, mounts, s = ops.base, ops.mounts, ops.s[:, None]
        self.ops, mat = ops, base.matrices
        self.slope_pp, self.slope_pf = _with_internal_mass(s, ops)
        around = s * mounts.damping * ops.damping_factor
        self.z_pp, self.z_pf = mounts.stiffness * self.slope_pp + around, mounts.stiffness * self.slope_pf + around
        T, rows, G = mat.T.astype(complex), ops.rows, mounts.payload
        if ops.added:
            G = np.hstack([G, np.array([one.at_mounts for one in ops.added]).T])
            constants = np.linalg.norm(mat.T[:3], axis=0)  # N/V: a motor's force along its own axis
            T = np.vstack([T, np.array([one.at_actuators for one in ops.added]) * constants])
            shapes = np.array([one.at_sensors for one in ops.added]).T[None]
            rows = np.concatenate([rows, np.broadcast_to(shapes, (len(rows), *shapes.shape[1:]))], axis=2)
        n_q, M, S = G.shape[1], mat.M, s[:, :, None]
        outer = (G[:, :, None] * G[:, None, :]).reshape(len(G), n_q * n_q)
        D = (self.z_pp @ outer).reshape(-1, n_q, n_q)
        D[:, :N_Q, :N_Q] += S**2 * M + mounts.rest_K + S * mounts.rest_C
        if ops.extra is not None:
            D[:, :N_Q, :N_Q] += ops.extra
        for k, one in enumerate(ops.added):
            D[:, N_Q + k, N_Q + k] += one.stiffness
        if ops.recoil is not None:
            D[:, :, :N_Q] += (G.T @ (self.z_pf[:, :, None] * (mounts.chassis @ ops.recoil))) @ ops.borne(M)
        self.D, self.M, self.G, self.T, self.rows = D, M, G, T, rows
        self.hold, self.folded = base.sensors.driven(ops.omega, base.period_s, ops.delay_s, ops.amplifier_corner_Hz)

    @cached_property
    def inverse(self) -> np.ndarray:
        """(n, n_q, n_q) motion per force on the coordinates."""
        return np.linalg.inv(self.D)

    @cached_property
    def left(self) -> np.ndarray:
        """(n, n_y, n_q) y per force on the coordinates."""
        rows = self.rows
        if self.read_recoil is not None:
            rows = np.broadcast_to(rows, (len(self.ops.s), *rows.shape[1:])).astype(complex)
            rows[:, :, :N_Q] += self.read_recoil @ self.ops.borne(self.M)
        return self.gain * self.ops.sense[:, :, None] * (rows @ self.inverse)

    @cached_property
    def read_recoil(self) -> np.ndarray | None:
        """(n, n_y, 6) recoil of the chassis, as position sensors read it, per force on it; None without either."""
        if self.ops.recoil is None or not np.any(self.ops.against):
            return None
        return np.asarray(self.ops.against @ self.ops.recoil)

    @property
    def y_of_states(self) -> np.ndarray:
        """(n, n_y, m) y due to the unit initial states of `forces_of_states`."""
        found = self.left @ self.forces_of_states
        if self.read_recoil is not None:
            of_chassis = np.concatenate([self._chassis_states(row) for row in np.eye(found.shape[2])], axis=2)
            found = found - self.gain * self.ops.sense[:, :, None] * (self.ops.against @ of_chassis)
        return found

    @property
    def gain(self) -> np.ndarray:
        """(n_y, 1) sensitivities including the gains set by effects."""
        return (self.ops.base.sensors.sensitivity * self.ops.sensor_gain)[:, None]

    @property
    def n_q(self) -> int:
        """Number of coordinates."""
        return self.G.shape[1]

    @property
    def volts(self) -> np.ndarray:
        """(n, n_u) factors from commanded to acting volts."""
        return self.hold[:, None] * self.ops.drive

    @cached_property
    def forces_of_states(self) -> np.ndarray:
        """(n, n_q, m) forces on the coordinates due to unit initial states of internal dynamics. In this order:
        impulses on the modes, on masses inside mounts, on the chassis and on the states defined by effects
        (`Operators.inner`); steps on the same; first-order states (`Operators.decays`)."""
        ops, n = self.ops, len(self.ops.s)

        def of_body(force: np.ndarray) -> np.ndarray:
            return np.concatenate([force, np.zeros((n, self.n_q - N_Q, force.shape[2]))], axis=1)

        F = [np.broadcast_to(np.eye(self.n_q)[None, :, N_Q:], (n, self.n_q, self.n_q - N_Q)).astype(complex)]
        inside, by_mass = self._masses_inside
        if inside.size:
            F.append(self.G.T[:, inside] * by_mass[:, None, :])
        if ops.recoil is not None:
            F.append(self.G.T @ (self.z_pf[:, :, None] * (ops.mounts.chassis @ self._moves)))
        F += [of_body(one) for one in ops.inner]
        impulses = np.concatenate(F, axis=2)
        return np.concatenate([impulses, ops.s[:, None, None] * impulses, *map(of_body, ops.decays)], axis=2)

    @cached_property
    def _masses_inside(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices (i,) of mounts with a mass inside, and (n, i) force on the payload per impulse on that mass."""
        ops = self.ops
        inside = np.flatnonzero(np.isfinite(ops.internal_omega))
        w, share, s = ops.internal_omega[inside], ops.payload_share[inside], ops.s[:, None]
        g = np.broadcast_to(ops.stiffness_factor, self.z_pp.shape)[:, inside] + 2 * ops.internal_damping[inside] * s / w
        return inside, g * (1 - share) / (g + (s / w) ** 2)

    @cached_property
    def _owners(self) -> tuple[list[int], ...]:
        """What the initial states belong to, by kind, in the order of `forces_of_states`: impulses on modes (index of
        the added coordinate), masses inside mounts (of the mount), chassis (of the coordinate) and states defined by
        effects (numbered); steps on the same; first-order states (numbered)."""
        by_effects, decays = (range(sum(one.shape[2] for one in own)) for own in (self.ops.inner, self.ops.decays))
        chassis = np.flatnonzero(self._can_move)
        impulses = [list(map(int, own)) for own in (range(self.n_q - N_Q), self._masses_inside[0], chassis, by_effects)]
        return (*impulses, *impulses, list(decays))

    def _by_kind(self, inner: np.ndarray) -> list[np.ndarray]:
        """Initial states (m,) by the kinds of `_owners`."""
        return np.split(inner, np.cumsum([len(own) for own in self._owners])[:-1])

    def states_of(self, fewer: Assembled, inner: np.ndarray) -> np.ndarray:
        """(m,) initial states (`forces_of_states`) of the table before its last effect was added, in the order of this
        table; those of that effect are zero."""
        known = [
            dict(zip(own, values, strict=True))
            for own, values in zip(fewer._owners, fewer._by_kind(inner), strict=True)
        ]
        return np.array([one.get(k, 0.0) for one, own in zip(known, self._owners, strict=True) for k in own])

    def push_of_masses_inside(self, inner: np.ndarray) -> np.ndarray:
        """(n, n_g, 1) force of the mounts on the payload due to the initial states of the masses inside them
        (`forces_of_states`)."""
        inside, by_mass = self._masses_inside
        _, impulse, _, _, _, step, *_ = self._by_kind(inner)
        found = np.zeros((len(by_mass), len(self.G), 1), complex)
        found[:, inside, 0] = by_mass * (impulse + self.ops.s[:, None] * step)
        return found

    @property
    def _can_move(self) -> np.ndarray:
        """(6,) whether the chassis can move along each coordinate."""
        return np.zeros(N_Q, bool) if self.ops.recoil is None else np.any(self.ops.recoil, axis=(0, 1))

    @property
    def _moves(self) -> np.ndarray:
        """(n, 6, m) chassis displacement per unit force in the directions in which it can move."""
        assert self.ops.recoil is not None
        return self.ops.recoil[:, :, self._can_move]

    def _chassis_states(self, inner: np.ndarray) -> np.ndarray:
        """(n, 6, 1) chassis displacement due to the chassis' own part of the initial states of `forces_of_states`."""
        moves = self._moves
        _, _, impulse, _, _, _, step, *_ = self._by_kind(inner)
        return (moves @ impulse)[:, :, None] + self.ops.s[:, None, None] * (moves @ step)[:, :, None]

    def floor_force(self, w: np.ndarray) -> np.ndarray:
        """(n, n_q, m) force due to floor displacement w (n, 3, m)."""
        ops = self.ops
        chassis = self.follow(w)
        force = np.swapaxes(self.G, 0, 1) @ (self.z_pf[:, :, None] * (ops.mounts.chassis @ chassis))
        if np.any(ops.mounts.rest_K) or np.any(ops.mounts.rest_C):
            mat = ops.base.matrices
            rest_K = mat.K_floor - ops.mounts.payload.T @ (ops.mounts.stiffness[:, None] * ops.mounts.chassis)
            rest_C = mat.C_floor - ops.mounts.payload.T @ (ops.mounts.damping[:, None] * ops.mounts.chassis)
            force[:, :N_Q] += (rest_K + ops.s[:, None, None] * rest_C) @ chassis
        if ops.extra_floor is not None:
            force[:, :N_Q] += ops.extra_floor @ w
        return force

    def follow(self, w: np.ndarray) -> np.ndarray:
        """(n, 6, m) chassis displacement due to the floor alone."""
        if self.ops.follow is not None:
            moved = self.ops.follow @ w
            if self.ops.recoil is not None and self.ops.extra_floor is not None:
                moved = moved + self.ops.recoil @ (self.ops.extra_floor @ w)
            return moved
        return np.concatenate([w, np.zeros_like(w)], axis=1)

    def deflection(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """(n, n_g, m) deflection of the mounts, payload minus chassis."""
        return self.G @ x - self.ops.mounts.chassis @ self.chassis(x, w)

    def chassis(self, x: np.ndarray, w: np.ndarray, inner: np.ndarray | None = None) -> np.ndarray:
        """(n, 6, m) chassis displacement, including its recoil and its initial states (`forces_of_states`)."""
        moved = self.follow(w)
        if self.ops.recoil is not None:
            moved = moved - self.ops.recoil @ (self.ops.borne(self.M) @ x[:, :N_Q])
            if inner is not None and inner.size:
                moved = moved + self._chassis_states(inner)
        return moved


def _with_internal_mass(s: np.ndarray, ops: Operators) -> tuple[np.ndarray, np.ndarray]:
    """(n, n_g) factors of the mounts' k in z_pp and z_pf, for a mass m between springs a k and b k in series.

    With 1/a + 1/b = 1, w^2 = (a + b) k/m, and g the factor of k including the loss 2 zeta s/w of both springs,

        z_pf/k = g^2/(g + s^2/w^2),     z_pp/k = a g - (a/b) g^2/(g + s^2/w^2).
    """
    factor, w = ops.stiffness_factor, ops.internal_omega
    if not np.any(np.isfinite(w)):
        return factor, factor
    a, b = 1 / ops.payload_share, 1 / (1 - ops.payload_share)
    g = factor + 2 * ops.internal_damping * s / w
    through = g**2 / (g + (s / w) ** 2)
    return a * g - a / b * through, through
