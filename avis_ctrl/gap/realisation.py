"""Realisation of the linear part of a model with effects as one state-space system, and its error.

Exact in state space: rig parameters, gains, directions and corners of sensors, gravity, amplifiers, added masses,
springs, dampers and modes. Not exact: delay and hold (Pade), loss independent of frequency (a ladder), aliases of
sampling (left out), effects that depend on amplitude (at rest) or on time (at one moment). `Realised` contains the
largest difference from `TableModel.response`, computed on a grid of frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.drives import lags
from avis_ctrl.gap.effects.sensors import suspensions
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.state_space import SETTINGS, ReducedTable, addition, chassis, has_addition
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.response import FLOOR
from avis_ctrl.identification.sample_and_hold import hold
from avis_ctrl.lti.connect import connect
from avis_ctrl.lti.rational import cascade, second_order_roots
from avis_ctrl.lti.statespace import StateSpace, append, gain
from avis_ctrl.rigs.delay_models import pade_delay, zero_order_hold
from avis_ctrl.rigs.rigid_body import COORDINATES, GRAVITY
from avis_ctrl.uncertainty.uncertain_rig import edge_name, uncertain_rig

# Effects that act through rig parameters, sensors, drives or the chassis; they need no addition.
_ELSEWHERE = {
    "com_offset",
    "product_of_inertia",
    "geophone_corner",
    "sensor_gain",
    "sensor_misalignment",
    "tilt_coupling",
    "actuator_gain",
    "actuator_lag",
    "loop_delay",
    "base_compliance",
}
# Effects that vanish in a linear loop about rest.
_AT_REST = {
    "cubic_stiffness": "no effect at rest: left out",
    "actuator_saturation": "no effect below its limit: left out",
}
_NOTES = {
    "contact_friction": "without slip: a spring at every drive",
    "structural_damping": "a causal ladder of passive branches",
}


@dataclass(frozen=True, eq=False)
class Realised:
    """A realisation and its error.

    Attributes
    ----------
    system : (actuators [V], "vx" "vy" "vz" floor [m/s]) to (velocity "COORD_dot" of each coordinate [m/s], rotations at
        the edge, and the sensors in their own unit).
    error : maximum over `omega` (n,) [rad/s] of |G_realised - G| / |G|, Frobenius norms over the sensors and over the
        actuators or the floor's axes, whichever is larger; G with delay and hold but without aliases, and without the
        effects that depend on amplitude or time, which `TableModel.response` leaves out.
    aliases : largest relative contribution of aliases to G, in the same norm; zero for a model that is not sampled.
    notes : approximations and omissions.
    """

    system: StateSpace
    omega: np.ndarray
    error: float
    aliases: float
    notes: tuple[str, ...]


def not_realised(model: TableModel) -> dict[str, str]:
    """Effects that the realisation does not contain, by label, and why; a loop with the realisation ignores them."""
    found = {}
    for one in model.effects:
        name = one.effect.name
        if name in _AT_REST:
            found[one.label] = _AT_REST[name]
        elif not (name in _ELSEWHERE or has_addition(one) or one.effect.rig_changes(model, one.place, one.by_name)):
            found[one.label] = "has no realisation in state space: left out"
    return found


def notes_on(model: TableModel) -> tuple[str, ...]:
    """Approximations and omissions in a realisation of a model's effects."""
    left_out, found = not_realised(model), []
    for one in model.effects:
        name = one.effect.name
        if one.label in left_out:
            found.append(f"{one.label}: {left_out[one.label]}")
        elif name in _NOTES:
            found.append(f"{one.label}: {_NOTES[name]}")
        if name == "structural_damping" and one.place.endswith("complex"):
            found.append(
                f"{one.label}: no causal system has a constant loss at every frequency; the causal law "
                "with the same loss is in its place"
            )
    return tuple(found)


def with_effects(rig: StateSpace, model: TableModel, keep: Sequence[str], when: float = 0.0) -> StateSpace:
    """The state space of a rig with the effects of a model.

    Parameters
    ----------
    rig : from `uncertain_rig` for the same rig (`model.effective.rig`) and coordinates; its perturbations are kept.
    when : time at which drifting parameters are evaluated, -0.5 .. 0.5 from the start to the end of the campaign.

    Returns
    -------
    StateSpace : inputs of the rig (w, actuators, floor and forces); outputs z, COORD_rel, COORD_dot, COORD_ddot, and
        for every sensor "deviation_NAME", the velocity that it measures minus the nominal row times COORD_dot, and
        "tilt_NAME" [m/s^3], the rate of the gravity component of its acceleration.

    Raises
    ------
    InputError : impossible values (a chassis without mass).
    """
    table = ReducedTable(model, tuple(keep), when)
    names = [edge_name(name) for name in keep]
    sensors, actuators = model.sensors.names, list(model.actuators)
    parts = {"rig": _rig_part(rig, names, actuators), "additions": _additions(table, names)}
    floor = [f"floor_{a}_dot" for a in names]
    base = [one for one in model.effects if one.effect.name == "base_compliance"]
    moves = [f"chassis_{a}_dot" for a in names]
    parts["chassis"] = (
        chassis(table, base[0].by_name, floor, [f"{a}_ddot" for a in names], moves)
        if base
        else gain(np.eye(len(names)), floor, moves)
    )
    parts["drives"] = append(
        *(drive.renamed([name], [f"acting_{name}"]) for name, drive in zip(actuators, _drives(model), strict=True))
    )
    n = len(names)
    parts["forces"] = gain(
        np.hstack([np.eye(n), np.eye(n)]),
        [f"force_{a}" for a in names] + [f"added_{a}" for a in names],
        [f"total_{a}" for a in names],
    )
    parts["sensors"] = _sensors(table, names)
    outputs = [name for name in rig.outputs if name.startswith("z:")]
    outputs += [f"{a}_{kind}" for kind in ("rel", "dot", "ddot") for a in names]
    outputs += [f"{kind}_{name}" for kind in ("deviation", "tilt") for name in sensors]
    return connect(parts, [name for name in rig.inputs if not name.startswith(tuple(moves))], outputs)


def _rig_part(rig: StateSpace, names: list[str], actuators: list[str]) -> StateSpace:
    """The rig with chassis motion in place of floor motion, acting volts and total forces as inputs; other drives are
    unchanged."""
    new = {f"floor_{a}_dot": f"chassis_{a}_dot" for a in names} | {f"force_{a}": f"total_{a}" for a in names}
    new |= {name: f"acting_{name}" for name in actuators}
    outputs = [n for n in rig.outputs if n.startswith("z:")] + [
        f"{a}_{k}" for k in ("rel", "dot", "ddot") for a in names
    ]
    return rig.select(outputs, None).renamed(new)


def _additions(table: ReducedTable, names: list[str]) -> StateSpace:
    total = gain(np.zeros(table.shape))
    for one in table.model.effects:
        made = addition(table, one)
        if made is not None:
            total = total + made
    inputs = [f"{a}_rel" for a in names] + [f"{a}_dot" for a in names] + [f"chassis_{a}_dot" for a in names]
    return total.renamed(
        [*inputs, *(f"acting_{name}" for name in table.model.actuators)],
        [*(f"added_{a}" for a in names), *(f"bent_{name}" for name in table.model.sensors.names)],
    )


def _drives(model: TableModel) -> list[StateSpace]:
    """Commanded to acting volts, one system per actuator; the mean lag and all delay are part of the loop."""
    factors, added = dict.fromkeys(model.actuators, 1.0), [gain([[1.0]])] * len(model.actuators)
    for one in model.effects:
        if one.effect.name == "actuator_gain":
            factors[one.place] *= one.by_name["gain"]
        if one.effect.name == "actuator_lag" and len(one.values) > 1:
            tau = max(model.base.amplifier_time_constant_s + one.by_name["time_constant_s"], 1e-9)
            poles = np.maximum(lags(model.base, one.by_name), 1e-9)
            each = np.broadcast_to(poles, (len(poles), len(model.actuators))).T
            added = [cascade([-1 / tau], list(-1 / own), tau / float(np.prod(own))) for own in each]
    return [lag.scaled(factors[name]) for lag, name in zip(added, model.actuators, strict=True)]


def _sensors(table: ReducedTable, names: list[str]) -> StateSpace:
    """(velocities, modal velocities) -> difference of each sensor from its nominal row, and rate of its gravity
    component."""
    model, n, n_y = table.model, table.n, table.n_y
    ops = _changed_by(model, "sensor_gain", "sensor_misalignment")
    nominal, actual = table.rows(table.matrices.R), table.rows(ops.rows[0].real)
    tilt = _tilt_rows(table)
    filters = append(*_sensor_filters(model, ops.sensor_gain))
    sees = filters.scaled(1.0, np.hstack([actual, np.eye(n_y)]))
    total = sees + gain(np.hstack([-nominal, np.zeros((n_y, n_y))]))
    feels = gain(np.zeros((n_y, n + n_y)))
    if np.any(tilt):
        feels = filters.scaled(1.0, np.hstack([tilt, np.zeros((n_y, n_y))]))
    both = append(total, feels).scaled(1.0, np.vstack([np.eye(n + n_y)] * 2))
    sensors = model.sensors.names
    return both.renamed(
        [*(f"{a}_dot" for a in names), *(f"bent_{name}" for name in sensors)],
        [*(f"deviation_{name}" for name in sensors), *(f"tilt_{name}" for name in sensors)],
    )


def _changed_by(model: TableModel, *names: str) -> Operators:
    """The table at 1 rad/s with some of the model's effects, for quantities that do not depend on frequency."""
    ops = Operators(model.effective, np.ones(1))
    for one in model.effects:
        if one.effect.name in names:
            one.effect.change(ops, one.place, one.by_name)
    return ops


def _tilt_rows(table: ReducedTable) -> np.ndarray:
    """(n_y, n) rate of the gravity component of each sensor's acceleration per velocity."""
    model, of_q = table.model, np.zeros((table.n_y, len(COORDINATES)))
    strength = sum(one.by_name["gravity_m_per_s2"] for one in model.effects if one.effect.name == "tilt_coupling")
    axes = model.rig.sensor_axes()
    for k, name in enumerate(model.sensors.names):
        direction = axes[name][1]
        of_q[k, 3], of_q[k, 4] = strength * direction[1], -strength * direction[0]
    return table.rows(of_q)


def _sensor_filters(model: TableModel, factors: np.ndarray) -> list[StateSpace]:
    """Each sensor relative to the nominal one: gain, and the corner that its filter does not cancel."""
    found = [gain([[float(factor)]]) for factor in factors]
    sensors = model.base.sensors
    for k, (assumed, own) in enumerate(zip(sensors.assumed, sensors.suspensions, strict=False)):
        if assumed is not None and own is not None and own != assumed:
            found[k] = cascade(second_order_roots(*assumed), second_order_roots(*own), 1.0) @ found[k]
    known = suspensions(model.rig)
    for one in model.effects:
        if one.effect.name == "geophone_corner" and one.place in known:
            k = sensors.names.index(one.place)
            actual = second_order_roots(one.by_name["corner_Hz"], one.by_name["damping"])
            found[k] = cascade(second_order_roots(*known[one.place]), actual, 1.0) @ found[k]
    return found


def realise(model: TableModel, pade_order: int | None = None, when: float = 0.0) -> Realised:
    """One state-space system of a model, including drives and sensors.

    pade_order : of delay and hold (1-10); by default the order that keeps the delay's error below 1e-3 up to the
        highest frequency of the settings' `check_Hz`, or 10. when : as in `with_effects`.

    Raises
    ------
    InputError : sensors of displacement or acceleration; mounts whose chassis points differ from the payload's.
    """
    if (motion := model.sensors.common[0]) != "velocity":
        raise InputError("expected sensors of velocity", field="sensors", value=motion)
    omega = 2 * np.pi * np.geomspace(*SETTINGS.check_Hz)
    order = pade_order or sufficient_order(loop_lag(model)[0], float(omega.max()), 1e-3, 10)[0]
    effective, names = model.effective, [edge_name(name) for name in COORDINATES]
    parts = {
        "table": with_effects(uncertain_rig(effective.rig, [], COORDINATES).system, model, COORDINATES, when),
        "chains": _chains(ReducedTable(model, COORDINATES, when), names),
        "loop": _loop(model, order),
        "floor": gain(np.eye(len(names), 3), FLOOR, [f"floor_{a}_dot" for a in names]),
        "no force": gain(np.zeros((len(names), 3)), FLOOR, [f"force_{a}" for a in names]),
    }
    unused = [name for name in effective.rig.equations_of_motion().actuators if name not in model.actuators]
    if unused:
        parts["at rest"] = gain(np.zeros((len(unused), 3)), FLOOR, unused)
    system = connect(
        parts,
        [*(f"{name}_command" for name in model.actuators), *FLOOR],
        [*(f"{a}_dot" for a in names), *model.sensors.names],
    ).renamed({f"{name}_command": name for name in model.actuators})
    if model.nonlinear:
        same = realise(model.linear, pade_order, when)
        error, folded = same.error, same.aliases
    else:
        sensors, n_u = list(model.sensors.names), len(model.actuators)
        asked, without = model.response(omega), _without_aliases(model, omega)
        error = _distance(system.select(sensors, None).frequency_response(omega), without, n_u)
        folded = _distance(asked, without, n_u)
    return Realised(system, omega, error, folded, notes_on(model))


def sufficient_order(delay_s: float, omega: float, tolerance: float, largest: int, least: int = 2) -> tuple[int, float]:
    """Lowest order of a delay's Pade approximant with an error below the tolerance up to omega [rad/s], and its error.

    The largest order if none is sufficient. The approximant is all-pass: the error is a phase error that grows with
    frequency.
    """
    error = 0.0
    for order in range(least, largest + 1):
        made = pade_delay(delay_s, order).frequency_response(np.array([omega]))[0, 0, 0]
        # Where the approximant is useful, its phase differs from that of the delay by less than one turn.
        error = float(abs(made - np.exp(-1j * omega * delay_s)))
        if error < tolerance and omega * delay_s < np.pi * order:
            return order, error
    return largest, error if omega * delay_s < np.pi * largest else 2.0


def loop_lag(model: TableModel) -> tuple[float, float | None]:
    """Delay [s] and (mean) amplifier corner [Hz] of a model, including its effects."""
    ops = _changed_by(model, "actuator_lag", "loop_delay")
    return ops.delay_s, ops.amplifier_corner_Hz


def _loop(model: TableModel, order: int) -> StateSpace:
    """Digital command to volts: hold, delay, amplifier."""
    delay, corner = loop_lag(model)
    one = pade_delay(delay, order)
    if model.period_s:
        one = zero_order_hold(model.period_s, order) @ one
    if corner:
        one = cascade([], [-2 * np.pi * corner], 2 * np.pi * corner) @ one
    return append(*(one.renamed([f"{name}_command"], [name]) for name in model.actuators))


def _chains(table: ReducedTable, names: list[str]) -> StateSpace:
    """Velocities, differences and gravity rates to the sensors' own unit; the two zeros at the origin cancel s^-2."""
    model, n_y = table.model, table.n_y
    nominal, (_, chain, poles) = table.rows(table.matrices.R), model.sensors.common
    if chain is None and np.any(_tilt_rows(table)):
        raise InputError(
            "expected sensors with a high-pass: ideal ones would integrate gravity twice",
            field="tilt_coupling",
            value=GRAVITY,
        )
    S, tilt = np.diag(model.sensors.sensitivity), gain([[0.0]])
    if chain is None:
        chain = gain([[1.0]])
    else:
        # Without the zeros at the origin: from the rate of acceleration to the output of the chain.
        tilt = cascade([], list(np.roots(poles[::-1])), float(np.prod(np.abs(model.sensors.low_pass))))
    motion = append(*[chain] * n_y).scaled(S, np.hstack([nominal, np.eye(n_y), np.zeros((n_y, n_y))]))
    felt = append(*[tilt] * n_y).scaled(S, np.hstack([np.zeros((n_y, len(names) + n_y)), np.eye(n_y)]))
    sensors = model.sensors.names
    return (motion + felt).renamed(
        [*(f"{a}_dot" for a in names), *(f"deviation_{k}" for k in sensors), *(f"tilt_{k}" for k in sensors)], sensors
    )


def _without_aliases(model: TableModel, omega: np.ndarray) -> np.ndarray:
    """The response with the hold but without aliases."""
    if not model.period_s:
        return model.response(omega)
    G = replace(model, base=replace(model.base, period_s=0.0)).response(omega)
    G[:, :, : len(model.actuators)] *= hold(omega, model.period_s)[:, None, None]
    return G


def _distance(found: np.ndarray, asked: np.ndarray, n_u: int) -> float:
    """Largest relative difference over frequency, of the responses to the actuators and to the floor."""
    worst = 0.0
    for part in (slice(0, n_u), slice(n_u, None)):
        size = np.linalg.norm(asked[:, :, part], axis=(1, 2))
        away = np.linalg.norm((found - asked)[:, :, part], axis=(1, 2))
        worst = max(worst, float(np.max(away / size)))
    return worst
