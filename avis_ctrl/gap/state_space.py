"""Effects on the table's motion as state-space systems added to the rig, in any of its coordinates.

    (r, v, v_c, u)  ->  (f, d)

r is the displacement of the payload relative to the chassis, v and v_c are the velocities of payload and chassis in the
kept coordinates (rotations as displacements of the edge), and u the acting volts; f is the force that the effect adds,
d its contribution to the velocity along each sensor. All parts are passive impedances or poles and zeros of the
effects' own formulas (`gap.effects`), except the loss independent of frequency, which is approximated by a ladder of
Maxwell branches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.attached_oscillator import elements
from avis_ctrl.gap.effects.base import SETTINGS as LIBRARY
from avis_ctrl.gap.effects.base import Values, shares
from avis_ctrl.gap.effects.cable import tie
from avis_ctrl.gap.effects.chassis import of_chassis
from avis_ctrl.gap.effects.flexible_mode import modes, shape_rows
from avis_ctrl.gap.effects.mounts import campaign_clock, contacts, drift_over_stiffness, drifted, surge_omega
from avis_ctrl.gap.effects.payload import place_of
from avis_ctrl.gap.operators import mount_geometry
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.statespace import StateSpace, append, gain
from avis_ctrl.rigs.rigid_body import COORDINATES, point_map


@dataclass(frozen=True)
class RealisationSettings:
    """Settings of effects as state-space systems.

    ladder_Hz : band in which the ladder of Maxwell branches approximates the power of s [Hz], wider than that of a
        controller.
    ladder_error : its largest relative error there [1]: small compared with the uncertainty of any loss factor.
    check_Hz : lowest and highest frequency [Hz], and number of frequencies at which a realisation is compared with the
        model's response.
    """

    ladder_Hz: tuple[float, float] = (0.1, 200.0)
    ladder_error: float = 2e-3
    check_Hz: tuple[float, float, int] = (0.3, 100.0, 120)


SETTINGS = RealisationSettings()


class ReducedTable:
    """The quantities of a model that an addition needs, in its kept coordinates.

    model : with its effects. keep : coordinates that move. when : time, -0.5 .. 0.5 through the campaign.
    G (n_g, n) deflection of every mount; inertia (n, n) mass matrix; r, v, v_c, u : columns of the inputs of an
    addition; shape : numbers of its outputs and inputs.
    """

    def __init__(self, model: TableModel, keep: tuple[str, ...], when: float = 0.0):
        self.model, self.keep, self.when = model, keep, when
        self.matrices, self.mounts = model.matrices, mount_geometry(model.effective.rig)
        self.n, self.n_y, n_u = len(keep), len(model.sensors.names), len(model.actuators)
        self.r, self.v, self.v_c = (slice(k * self.n, (k + 1) * self.n) for k in range(3))
        self.u = slice(3 * self.n, 3 * self.n + n_u)
        self.shape = self.n + self.n_y, 3 * self.n + n_u
        self.G, self.inertia = self.rows(self.mounts.payload), self.rows(self.rows(self.matrices.M).T)

    def rows(self, of_q: np.ndarray) -> np.ndarray:
        """(m, n) rows in the kept coordinates, rotations as displacements of the edge [m], from rows (m, 6) in q."""
        scale = [1 / self.model.rig.edge_m if name.startswith("phi") else 1.0 for name in self.keep]
        return np.atleast_2d(of_q)[:, [COORDINATES.index(name) for name in self.keep]] * scale


Addition = Callable[[ReducedTable, str, Values], StateSpace]


def addition(table: ReducedTable, one: ActiveEffect) -> StateSpace | None:
    """An effect's contribution to the motion; None if it has none (it acts on rig parameters, sensors or drives).

    A user-defined effect provides it as a method `addition(table, place, values)`.
    """
    made: Addition | None = _MADE.get(one.effect.name) or getattr(one.effect, "addition", None)
    return None if made is None else made(table, one.place, one.by_name)


def has_addition(one: ActiveEffect) -> bool:
    """Whether an effect contributes to the motion as a state-space system."""
    return one.effect.name in _MADE or hasattr(one.effect, "addition")


def impedance(table: ReducedTable, K: np.ndarray, h: StateSpace, of: str = "r") -> StateSpace:
    """Force -K h(s) times displacement ("r") or absolute velocity ("v"), K (n, n) symmetric; the rank of K sets the
    number of states."""
    sizes, V = np.linalg.eigh(K)
    felt = np.abs(sizes) > 1e-12 * max(np.abs(sizes).max(), 1e-300)
    V, sizes = V[:, felt], sizes[felt]
    read, push = np.zeros((len(sizes), table.shape[1])), np.zeros((table.shape[0], len(sizes)))
    read[:, getattr(table, of)] = V.T
    push[: table.n] = -V * sizes
    if not len(sizes):
        return gain(np.zeros(table.shape))
    return append(*[h] * len(sizes)).scaled(push, read)


def _static(table: ReducedTable, K: np.ndarray, C: np.ndarray | None = None) -> StateSpace:
    """Force -K r - C (v - v_c)."""
    D = np.zeros(table.shape)
    D[: table.n, table.r] = -K
    if C is not None:
        D[: table.n, table.v], D[: table.n, table.v_c] = -C, C
    return gain(D)


def _relaxation(table: ReducedTable, place: str, values: Values) -> StateSpace:
    up = table.mounts.along("z")
    G, k = table.G[up], table.mounts.stiffness[up]
    h = cascade([0.0], [-2 * np.pi * values["corner_Hz"]], values["stiffness_ratio"])
    return impedance(table, G.T @ (k[:, None] * G), h)


def _structural(table: ReducedTable, place: str, values: Values) -> StateSpace:
    """The causal law, also in place of the constant complex stiffness, which no causal system has."""
    G, k = table.G, table.mounts.stiffness
    rest, corners, ratios = ladder(2 / np.pi * np.arctan(values["loss_factor"]))
    # rest - 1 + sum of ratio s/(s + w) = rest - 1 + sum(ratio) - sum of ratio w/(s + w)
    h = StateSpace(
        -np.diag(corners),
        np.sqrt(corners)[:, None],
        -(ratios * np.sqrt(corners))[None],
        np.array([[rest - 1 + ratios.sum()]]),
    )
    return impedance(table, G.T @ (k[:, None] * G), h)


def ladder(power: float) -> tuple[float, np.ndarray, np.ndarray]:
    """(s/w_ref)^power as rest + sum of ratio s/(s + w), all ratios positive: (rest, w (n,), ratio (n,)).

    The smallest number of branches, evenly spaced in log w within and beyond the band, that keeps the error below
    `ladder_error` in `ladder_Hz`. Positive ratios make it passive.
    """
    f = np.geomspace(*SETTINGS.ladder_Hz, 200)
    s = 2j * np.pi * f
    wanted = (s / (2 * np.pi * LIBRARY.loss_Hz)) ** power
    if power == 0:
        return 1.0, np.zeros(0), np.zeros(0)
    for count, reach in ((count, reach) for count in range(2, 24) for reach in (3.0, 10.0, 30.0)):
        w = 2 * np.pi * np.geomspace(SETTINGS.ladder_Hz[0] / reach, SETTINGS.ladder_Hz[1] * reach, count)
        basis = np.column_stack([np.ones(len(s)), s[:, None] / (s[:, None] + w)]) / wanted[:, None]
        found, _ = nnls(np.vstack([basis.real, basis.imag]), np.concatenate([np.ones(len(s)), np.zeros(len(s))]))
        if np.max(np.abs(basis @ found - 1)) < SETTINGS.ladder_error:
            break
    used = found[1:] > 0
    return float(found[0]), w[used], found[1:][used]


def _surge(table: ReducedTable, place: str, values: Values) -> StateSpace:
    """A mass in every vertical mount: r_m its displacement relative to the chassis, v_m its velocity.

    r_m' = v_m - v_c,  m v_m' = a k (r - r_m) + a c (v - v_m) - b k r_m - b c (v_m - v_c), and in addition to the mount
    itself f = -(a - 1) k r + a k r_m - a c (v - v_m), with c of the springs and 1/a + 1/b = 1.
    """
    up = table.mounts.along("z")
    G, stiffness = table.G[up], table.mounts.stiffness[up]
    omega, share, zeta = surge_omega(values), values["payload_share"], values["damping_ratio"]
    a, b = 1 / share, 1 / (1 - share)
    total = gain(np.zeros(table.shape))
    for g, k, w in zip(G, stiffness, omega, strict=True):
        m, c = (a + b) * k / w**2, 2 * zeta * k / w
        A = np.array([[0.0, 1.0], [-(w**2), -2 * zeta * w]])
        B, D = np.zeros((2, table.shape[1])), np.zeros(table.shape)
        B[0, table.v_c] = -g
        B[1, table.r], B[1, table.v] = a * k / m * g, a * c / m * g
        B[1, table.v_c] = b * c / m * g
        C = np.zeros((table.shape[0], 2))
        C[: table.n] = np.outer(g, [a * k, a * c])
        outer = np.outer(g, g)
        D[: table.n, table.r], D[: table.n, table.v] = -(a - 1) * k * outer, -a * c * outer
        total = total + StateSpace(A, B, C, D)
    return total


def _leveling(table: ReducedTable, place: str, values: Values) -> StateSpace:
    """Payload relative to chassis, as measured by the valves."""
    own = np.flatnonzero(table.mounts.along("z"))[: LIBRARY.leveled]
    G, k = table.G[own], table.mounts.stiffness[own] * shares(values)
    poles, size = [0.0], 2 * np.pi * values["rate_Hz"]
    if "valve_corner_Hz" in values:
        corner = 2 * np.pi * values["valve_corner_Hz"]
        poles, size = [0.0, -corner], size * corner
    return impedance(table, G.T @ (k[:, None] * G), cascade([], poles, size))


def _friction(table: ReducedTable, place: str, values: Values) -> StateSpace:
    """Motion far below the slip: a spring at every motor."""
    at_actuators, _ = shape_rows(table.model.rig, table.model.actuators, table.model.sensors.names)
    G = at_actuators @ table.G
    return _static(table, G.T @ (contacts(values)[:, None] * G))


def _drift(table: ReducedTable, place: str, values: Values) -> StateSpace:
    G, k = table.G, table.mounts.stiffness
    return _static(table, drift_at(table.model, values, table.when) * G.T @ (k[:, None] * G))


def drift_at(model: TableModel, values: Values, when: float) -> float:
    """Change of stiffness over that of the model's rig at a time -0.5 .. 0.5 of the campaign, by a drift's law."""
    begin, end = campaign_clock(model)
    through = float(drifted(np.array(when + 0.5), values.get("time_constant_s", 0.0) / (end - begin)))
    return values["relative_change"] * drift_over_stiffness(model) * through


def _cable(table: ReducedTable, place: str, values: Values) -> StateSpace:
    K = tie(values)
    G = table.rows(point_map(place_of(values)))
    return _static(table, G.T @ K @ G, values["damping_s"] * G.T @ K @ G)


def _oscillator(table: ReducedTable, place: str, values: Values) -> StateSpace:
    """m s (2 z w s + w^2)/(s^2 + 2 z w s + w^2) on the velocity at its place, along each of its directions."""
    total, zeta = gain(np.zeros(table.shape)), values["damping"]
    for row, mass, frequency in elements(place, values):
        w, g = 2 * np.pi * frequency, table.rows(row)
        poles = np.roots([1.0, 2 * zeta * w, w**2])
        h = cascade([0.0, -w / (2 * zeta)], poles, 2 * zeta * w * mass)
        total = total + impedance(table, g.T @ g, h, "v")
    return total


def _flexible(table: ReducedTable, place: str, values: Values) -> StateSpace:
    """The states are coordinates e of the modes and their velocities; mounts and motors excite the modes, which deflect
    the mounts."""
    own = [mode for mode in modes(values) if np.any(mode[2])]
    if not own:
        return gain(np.zeros(table.shape))
    shape = np.array([mode[2] for mode in own])  # (modes, n_g)
    w, zeta = (np.array([mode[k] for mode in own]) * (2 * np.pi if k == 0 else 1.0) for k in (0, 1))
    at_actuators, at_sensors = shape_rows(table.model.rig, table.model.actuators, table.model.sensors.names)
    G, k, c, n = table.G, table.mounts.stiffness, table.mounts.damping, len(own)
    constants = np.linalg.norm(table.matrices.T[:3], axis=0)
    A = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-np.diag(w**2) - (shape * k) @ shape.T, -np.diag(2 * zeta * w) - (shape * c) @ shape.T],
        ]
    )
    B, C = np.zeros((2 * n, table.shape[1])), np.zeros((table.shape[0], 2 * n))
    B[n:, table.r], B[n:, table.v], B[n:, table.v_c] = -(shape * k) @ G, -(shape * c) @ G, (shape * c) @ G
    B[n:, table.u] = (shape @ at_actuators.T) * constants
    C[: table.n, :n], C[: table.n, n:] = -G.T @ (shape * k).T, -G.T @ (shape * c).T
    C[table.n :, n:] = at_sensors @ shape.T
    return StateSpace(A, B, C, np.zeros(table.shape))


_MADE: dict[str, Addition] = {
    "mount_relaxation": _relaxation,
    "structural_damping": _structural,
    "mount_surge": _surge,
    "leveling_loop": _leveling,
    "contact_friction": _friction,
    "stiffness_drift": _drift,
    "cable_stiffness": _cable,
    "attached_oscillator": _oscillator,
    "payload_flexible_mode": _flexible,
}


def chassis(
    table: ReducedTable, values: Values, floor: list[str], accelerations: list[str], moves: list[str]
) -> StateSpace:
    """Velocity of a chassis on a soft base, from the velocity of the floor and the acceleration of the payload.

    M_c v_c' = -K_b x - C_b (v_c - v_f) - M a,  x' = v_c - v_f, with M the payload's mass matrix, in the kept
    coordinates in which the chassis moves. In the others it moves with the floor.

    Raises
    ------
    InputError : a chassis without mass.
    """
    if values["mass_kg"] <= 0:
        raise InputError("expected a chassis with a mass", field="base_compliance.mass_kg", value=values["mass_kg"])
    n = table.n
    mass, damping, stiffness = (table.rows(table.rows(of_q).T) for of_q in of_chassis(values))
    free = [
        a
        for a, name in enumerate(table.keep)
        if (f"frequency_r{name[-1]}_Hz" if name.startswith("phi") else f"frequency_{name}_Hz") in values
    ]
    own = np.ix_(free, free)
    by_mass = np.linalg.inv(mass[own]) if free else np.zeros((0, 0))
    m, follow = len(free), np.eye(n)[free]
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-by_mass @ stiffness[own], -by_mass @ damping[own]]])
    B = np.block([[-follow, np.zeros((m, n))], [by_mass @ damping[own] @ follow, -by_mass @ table.inertia[free]]])
    C = np.hstack([np.zeros((n, m)), follow.T])
    D = np.hstack([np.eye(n) - follow.T @ follow, np.zeros((n, n))])
    return StateSpace(A, B, C, D, 0.0, (*floor, *accelerations), tuple(moves))
