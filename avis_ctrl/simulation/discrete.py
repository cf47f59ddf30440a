"""Discretisation of the loop: the digital controller, and an exact step of everything that is linear.

Over each step the linear part (table linearised about rest, drives, sensor chains) is advanced exactly, with constant
voltages and linearly varying floor velocity. The contribution of the nonlinear table, its excess acceleration N, is
extrapolated linearly from the last two steps: the exponential Adams-Bashforth method of second order, ETD2 of Cox and
Matthews, J. Comput. Phys. 176 (2002), eq. 6. At micrometre amplitudes N is parts per million of the total acceleration,
so its second-order error is negligible, at one evaluation per step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import InputError
from avis_ctrl.lti.connect import connect
from avis_ctrl.lti.realisation import discretise, with_rate_input
from avis_ctrl.lti.statespace import StateSpace, append, gain
from avis_ctrl.rigs.logical_axes import actuator_axes, sensor_axes
from avis_ctrl.rigs.nonlinear import RigArrays, rig_arrays
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES, EquationsOfMotion
from avis_ctrl.simulation.sampled_loop import SampledLoop, lever_arms

N_Q = len(COORDINATES)


class StepArrays(NamedTuple):
    """The loop as C-contiguous arrays, for compiled code. x = (q, q', q_floor, states of drives and sensors).

    advance : (n, n + n_u + 24), x after a substep from (x, volts, floor velocity at its start and end, N, N - N before)
    observe : (n_u + 6, n + n_u + 6), volts at the motors and linear acceleration from (x, volts, floor velocity)
    sense : (n_s, n + 12), sensor volts from (x, floor velocity, N)
    control : (n_c + n_u, n_c + n_s), controller state and demanded volts from (controller state, sensor volts)
    """

    advance: np.ndarray
    observe: np.ndarray
    sense: np.ndarray
    control: np.ndarray
    table: RigArrays


def sampled(system: StateSpace, period_s: float) -> StateSpace:
    """The system discretised by Tustin's rule, or unchanged if it is already sampled with that period.

    At 50 Hz and 1 kHz sampling, Tustin's rule warps frequency by 0.8 %. This is small within the band of these loops,
    so no frequency is prewarped. A pole much faster than the sample rate becomes one near -1, which rings at half the
    sample rate: remove such controller poles beforehand (the reported fastest pole shows them).
    """
    if system.dt and abs(system.dt - period_s) > 1e-9 * period_s:
        raise InputError(f"a continuous system, or one sampled at {period_s:g} s", field="dt", value=system.dt)
    return replace(system, dt=period_s) if system.dt else discretise(system, period_s, "tustin")


def digital_controller(loop: SampledLoop) -> StateSpace:
    """Sampled controller from sensor volts to demanded drive volts: what the processor computes, without limits."""
    if loop.digital is not None:
        return loop.digital
    rig, bank, T = loop.rig, loop.sensors, loop.period_s
    names = (*loop.axes, *loop.loops)
    if not names:  # nothing is controlled; the sensors need not be decoded
        return gain(np.zeros((loop.n_drives, len(bank.chains))), dt=T)
    arms = lever_arms(rig, names)
    allocation, decoding = loop_axes(rig, loop.axes, tuple(loop.loops))
    decoding = arms[:, None] * decoding / bank.gain_V
    forces = append(*(sampled(part, T) for part in (loop.K, *loop.loops.values())))
    seen = gain(decoding, dt=T)
    if len({id(one) for one in bank.conditioning}) > 1:
        parts = [gain(1.0, dt=T) if one is None else sampled(one, T) for one in bank.conditioning]
        seen = seen @ append(*parts)
    elif bank.conditioning[0] is not None:
        # The same filter in every channel commutes with the decoding: one copy per axis is enough.
        seen = append(*[sampled(bank.conditioning[0], T)] * len(names)) @ seen
    # A force F at the edge is a moment arm * F.
    return gain(allocation * arms, dt=T) @ forces @ seen


def loop_axes(rig: Rig, axes: Sequence[str], loops: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Allocation (n_u, n) and decoding (n, n_s) of the controller's axes and of the axes with separate loops.

    If the drives and the sensors, all inertial, span all six coordinates, all axes are decoupled. Otherwise the
    controller's axes are those of its design, regardless of the separate loops, and each separate axis is decoupled as
    if it were alone.
    """
    whole = (*axes, *loops)
    together = actuator_axes(rig, whole), sensor_axes(rig, whole)
    if not loops or (_small(together[0].leftover) and _small(together[1].leftover) and np.all(together[1].inertial)):
        return together[0].allocation, together[1].decoding
    parts = [part for part in (tuple(axes), *((one,) for one in loops)) if part]
    return (
        np.hstack([actuator_axes(rig, part).allocation for part in parts]),
        np.vstack([sensor_axes(rig, part).decoding for part in parts]),
    )


def _small(leftover: np.ndarray) -> bool:
    return bool(np.all(np.abs(leftover) < 1e-9))


def linear_part(loop: SampledLoop) -> StateSpace:
    """Linearised table, drives and sensors: from volts, floor velocity [m/s, rad/s] and excess acceleration.

    Inputs "NAME_dac", "floor_C_dot", "excess_C"; outputs motor volts "NAME", "C_ddot" without the excess, "C_dot" and
    sensor volts "NAME_volt". The first states are q, q', q_floor.
    """
    eom = loop.plant.mounted_body().equations_of_motion()
    sensor_names, H = loop.plant.sensor_rows()
    tilt = loop.plant.tilt_rows() if loop.gravity else np.zeros_like(H)
    parts = {"table": _table(eom, H, tilt, sensor_names, loop.sensors.quantities)}
    # With drive coupling, the amplifier outputs are not yet the voltages that act.
    made = eom.actuators if loop.drive_coupling is None else tuple(f"{name}_alone" for name in eom.actuators)
    for name, alone, drive in zip(eom.actuators, made, loop.drives(), strict=True):
        parts[f"drive {name}"] = drive.renamed([f"{name}_dac"], [alone])
    if loop.drive_coupling is not None:
        parts["drive coupling"] = loop.drive_coupling.renamed(list(made), list(eom.actuators))
    for name, chain, kind in zip(sensor_names, loop.sensors.chains, loop.sensors.quantities, strict=True):
        chain = chain.renamed([f"{name}_motion"], [f"{name}_volt"])
        felt = loop.gravity and kind == "velocity"
        parts[f"sensor {name}"] = with_rate_input(chain, f"{name}_tilt", 1) if felt else chain
    inputs = [f"{name}_dac" for name in eom.actuators]
    inputs += [f"floor_{c}_dot" for c in COORDINATES] + [f"excess_{c}" for c in COORDINATES]
    outputs = [
        *eom.actuators,
        *(f"{c}_ddot" for c in COORDINATES),
        *(f"{c}_dot" for c in COORDINATES),
        *(f"{name}_volt" for name in sensor_names),
    ]
    return connect(parts, inputs, outputs)


def _table(
    eom: EquationsOfMotion, H: np.ndarray, tilt: np.ndarray, sensors: tuple[str, ...], quantities: tuple[str, ...]
) -> StateSpace:
    """M q'' = -C q' - K q + K_f q_f + C_f q_f' + T u + M excess, with states (q, q', q_f).

    "NAME_motion" is the motion along each sensor's axis. The apparent acceleration due to gravity, tilt q, is included
    for accelerometers and is the separate output "NAME_tilt" for velocity sensors.
    """
    n_u, zero, one = len(eom.actuators), np.zeros((N_Q, N_Q)), np.eye(N_Q)
    acceleration_x = la.solve(eom.M, np.hstack([-eom.K, -eom.C, eom.K_floor]))
    acceleration_e = np.hstack([la.solve(eom.M, np.hstack([eom.T, eom.C_floor])), zero])
    excess = np.hstack([np.zeros((N_Q, n_u + N_Q)), one])
    velocity_x = np.hstack([zero, one, zero])
    floor_e = np.hstack([np.zeros((N_Q, n_u)), one, zero])
    A = np.vstack([velocity_x, acceleration_x, np.zeros((N_Q, 3 * N_Q))])
    B = np.vstack([np.zeros_like(excess), acceleration_e + excess, floor_e])
    none = np.zeros_like(excess)
    felt = {
        "velocity": (velocity_x, none),
        "acceleration": (acceleration_x, acceleration_e + excess),
        "displacement": (np.hstack([one, zero, -one]), none),
    }
    seen = {kind: (H @ by_x, H @ by_e) for kind, (by_x, by_e) in felt.items()}
    tilted = tilt @ np.hstack([one, zero, zero])
    seen["acceleration"] = seen["acceleration"][0] + tilted, seen["acceleration"][1]
    motion_x, motion_e = (np.array([seen[kind][part][k] for k, kind in enumerate(quantities)]) for part in (0, 1))
    C = np.vstack([acceleration_x, velocity_x, motion_x, tilted])
    D = np.vstack([acceleration_e, none, motion_e, np.zeros_like(motion_e)])
    inputs = (*eom.actuators, *(f"floor_{c}_dot" for c in COORDINATES), *(f"excess_{c}" for c in COORDINATES))
    outputs = (
        *(f"{c}_ddot" for c in COORDINATES),
        *(f"{c}_dot" for c in COORDINATES),
        *(f"{name}_{kind}" for kind in ("motion", "tilt") for name in sensors),
    )
    return StateSpace(A, B, C, D, 0.0, inputs, outputs)


def held_and_ramped(A: np.ndarray, B: np.ndarray, step_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact step of x' = A x + B e: e^(A h), and the contributions of e = 1 and e = t/h over the step (Van
    Loan 1978)."""
    n, m = B.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = A * step_s, B * step_s
    block[n : n + m, n + m :] = np.eye(m)
    power = la.expm(block)
    return power[:n, :n], power[:n, n : n + m], power[:n, n + m :]


def step_arrays(loop: SampledLoop, extra_substeps: int = 1) -> StepArrays:
    """Arrays of a loop; each of its substeps is divided further by `extra_substeps`."""
    linear, controller = linear_part(loop), digital_controller(loop)
    n_u, n_s = loop.n_drives, len(loop.sensors.chains)
    volts, floor, excess = slice(0, n_u), slice(n_u, n_u + N_Q), slice(n_u + N_Q, n_u + 2 * N_Q)
    Phi, held, ramped = held_and_ramped(linear.A, linear.B, loop.period_s / (loop.substeps * extra_substeps))
    advance = np.hstack(
        [Phi, held[:, volts], held[:, floor] - ramped[:, floor], ramped[:, floor], held[:, excess], ramped[:, excess]]
    )
    observe = np.hstack([linear.C, linear.D[:, : n_u + N_Q]])[: n_u + N_Q]
    sense = np.hstack([linear.C, linear.D[:, n_u:]])[-n_s:]
    control = np.block([[controller.A, controller.B], [controller.C, controller.D]])
    packed = np.ascontiguousarray
    return StepArrays(
        packed(advance), packed(observe), packed(sense), packed(control), rig_arrays(loop.plant.mounted_body())
    )


@dataclass(frozen=True, eq=False)
class RestState:
    """Equilibrium of the linear loop with constant sensor offsets and a floor at rest.

    volts : (n_u,) demanded. state : of `linear_part`. controller : state of the digital controller.
    """

    volts: np.ndarray
    state: np.ndarray
    controller: np.ndarray


def rest_state(loop: SampledLoop) -> RestState:
    """Equilibrium of the loop with `loop.sensors.offset_V`, without limits and quantisation."""
    linear, K = linear_part(loop), digital_controller(loop)
    n_s, n_u = len(loop.sensors.chains), loop.n_drives
    free = np.r_[: 2 * N_Q, 3 * N_Q : linear.nstates]
    by_volts = -la.solve(linear.A[np.ix_(free, free)], linear.B[free, :n_u])
    sensed = linear.C[-n_s:][:, free] @ by_volts + linear.D[-n_s:, :n_u]
    kept = la.solve(np.eye(K.nstates) - K.A, K.B) if K.nstates else np.zeros((0, n_s))
    gain = K.C @ kept + K.D
    volts = la.solve(np.eye(n_u) - gain @ sensed, gain @ loop.sensors.offset_V)
    state = np.zeros(linear.nstates)
    state[free] = by_volts @ volts
    return RestState(volts, state, kept @ (loop.sensors.offset_V + sensed @ volts))


def gain_at_rest(K: StateSpace) -> np.ndarray:
    """(n_u, n_y) DC gain of a system; all entries are inf if it has a pole at zero frequency to within round-off."""
    edge = np.eye(K.nstates) - K.A if K.dt else -K.A
    if np.linalg.matrix_rank(la.matrix_balance(edge)[0]) < K.nstates:
        return np.full(K.D.shape, np.inf)
    return K.D + K.C @ np.linalg.solve(edge, K.B)


def spectral_radius(loop: SampledLoop) -> float:
    """Largest modulus of the poles of the linear loop over one control period (eigenvalues of `period_map`): stable
    below 1."""
    return float(np.max(np.abs(la.eigvals(period_map(loop)))))


def period_map(loop: SampledLoop) -> np.ndarray:
    """(n, n) map of the linear loop from one sample to the next: table, drives, sensors, controller, delayed voltages.

    The state begins with q and q'.
    """
    return disturbed_period_map(loop)[0]


def disturbed_period_map(loop: SampledLoop) -> tuple[np.ndarray, np.ndarray]:
    """`period_map`, and the (n, n_c + n_u) map of additive disturbances of the controller's next state and voltages."""
    arrays = step_arrays(loop)
    n, n_u = arrays.advance.shape[0], loop.n_drives
    n_c = arrays.control.shape[0] - n_u
    free = np.r_[: 2 * N_Q, 3 * N_Q : n]  # the loop does not act on the floor
    whole, late = divmod(loop.delay_substeps, loop.substeps)
    # State over a period: x, controller, voltages computed and not yet applied (newest first); then the disturbances.
    pending = whole + 1
    size = len(free) + n_c + n_u * pending
    unit = np.eye(size + n_c + n_u)
    x, xc = unit[: len(free)], unit[len(free) : len(free) + n_c]
    queue = [unit[len(free) + n_c + n_u * k :][:n_u] for k in range(pending)]
    Phi, Gamma = arrays.advance[np.ix_(free, free)], arrays.advance[free, n : n + n_u]
    out = arrays.control @ np.vstack([xc, arrays.sense[:, free] @ x]) + unit[size:]
    queue = [out[n_c:], *queue]
    for j in range(loop.substeps):
        x = Phi @ x + Gamma @ (queue[whole] if j >= late else queue[whole + 1])
    after = np.vstack([x, out[:n_c], *queue[:pending]])
    return after[:, :size], after[:, size:]
