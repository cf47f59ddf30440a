"""Compiled inner loop of the simulation: a few matrix-vector products and one evaluation of the table per step.

Plain loops are used throughout: slice assignments and BLAS calls would double the compilation time without a faster
run. numba's cache of compiled code checks the date of this file only: after a change in `rigs.nonlinear` or
`rigs.converter`, delete the .nbi and .nbc files of this package.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from avis_ctrl.rigs.converter import quantise
from avis_ctrl.rigs.nonlinear import payload_acceleration
from avis_ctrl.simulation.discrete import StepArrays
from avis_ctrl.simulation.sampled_loop import AntiWindup

_quantise = njit(cache=True)(quantise)


class Records(NamedTuple):
    """One row per sample: (n, 6) payload motion, (n, n_u) held and demanded volts, (n, n_s) volts at the converter."""

    q: np.ndarray
    q_dot: np.ndarray
    volts: np.ndarray
    demanded: np.ndarray
    sensed: np.ndarray


class Work(NamedTuple):
    """State and buffers that change from step to step.

    x : state of the linear part. u, w, w_end : held volts, floor velocity at the start and end of the step.
    N, N_before : excess acceleration now and one step before.
    line : (delay + 1, n_u) circular buffer of delayed voltages, by the step at which they act. excess : (n_u,) state of
        the anti-windup.
    advance_in, observe_in, sense_in, control_in : vectors multiplied by the matrices of the step; control_in also
        stores the controller's state. observed, sensed, controlled : the products.
    """

    x: np.ndarray
    u: np.ndarray
    w: np.ndarray
    w_end: np.ndarray
    N: np.ndarray
    N_before: np.ndarray
    line: np.ndarray
    excess: np.ndarray
    advance_in: np.ndarray
    observe_in: np.ndarray
    sense_in: np.ndarray
    control_in: np.ndarray
    observed: np.ndarray
    sensed: np.ndarray
    controlled: np.ndarray


def workspace(arrays: StepArrays, state: np.ndarray, delay: int) -> Work:
    """Work arrays of a loop that starts in `state` with its controller at rest; delay in steps."""
    matrices = (arrays.advance, arrays.observe, arrays.sense, arrays.control)
    n_u = arrays.observe.shape[0] - 6
    vectors = [state, np.zeros(n_u), *np.zeros((4, 6)), np.zeros((delay + 1, n_u)), np.zeros(n_u)]
    vectors += [np.zeros(matrix.shape[1]) for matrix in matrices]
    return Work(*vectors, *(np.zeros(matrix.shape[0]) for matrix in matrices[1:]))


class Run(NamedTuple):
    """A loop and the signals of its simulation.

    floor : (n + 1, 6) floor velocity at the samples; noise : (n, n_s) V; drive : (n, n_u) V added to the controller's.
    substeps : steps per period. nonlinear : whether N is computed. acceleration : whether sensors measure it.
    adc : (lsb, lower, upper) V, lsb = 0 for none. limit_V : (n_u,) of the drives. windup : (keep, feed) of the
        anti-windup.
    far : (m, rad) distance from the floor beyond which the table has diverged.
    """

    arrays: StepArrays
    work: Work
    records: Records
    floor: np.ndarray
    noise: np.ndarray
    drive: np.ndarray
    substeps: int
    nonlinear: bool
    acceleration: bool
    adc: np.ndarray
    limit_V: np.ndarray
    windup: AntiWindup
    far: np.ndarray


@njit(cache=True, fastmath={"reassoc", "contract"})
def _multiply(out: np.ndarray, A: np.ndarray, x: np.ndarray) -> None:
    for i in range(A.shape[0]):
        total = 0.0
        for j in range(A.shape[1]):
            total += A[i, j] * x[j]
        out[i] = total


@njit(cache=True)
def _put(out: np.ndarray, start: int, values: np.ndarray) -> None:
    """out[start:start + len(values)] = values"""
    for i in range(values.shape[0]):
        out[start + i] = values[i]


@njit(cache=True)
def _arrive(work: Work, floor: np.ndarray, k: int, j: int, substeps: int, step: int) -> None:
    """Floor velocity over substep j of period k, and the voltages that start to act at its beginning."""
    delay = work.line.shape[0] - 1
    for i in range(6):
        rise = (floor[k + 1, i] - floor[k, i]) / substeps
        work.w[i], work.w_end[i] = floor[k, i] + rise * j, floor[k, i] + rise * (j + 1)
    if delay > 0 and step >= delay and (step - delay) % substeps == 0:
        _put(work.u, 0, work.line[step % (delay + 1)])


@njit(cache=True)
def _excess(arrays: StepArrays, work: Work) -> None:
    """N: acceleration of the nonlinear table minus that of the linear table."""
    x, n, n_u = work.x, work.x.shape[0], work.u.shape[0]
    _put(work.observe_in, 0, x)
    _put(work.observe_in, n, work.u)
    _put(work.observe_in, n + n_u, work.w)
    _multiply(work.observed, arrays.observe, work.observe_in)
    true = payload_acceleration(x[:6], x[6:12], work.observed[:n_u], x[12:18], work.w, arrays.table)
    for i in range(6):
        work.N[i] = true[i] - work.observed[n_u + i]


@njit(cache=True)
def _sense(arrays: StepArrays, work: Work, noise: np.ndarray, adc: np.ndarray, sensed_row: np.ndarray) -> None:
    """Converter readings for the present motion and sample noise (n_s,), as the controller's input."""
    n, n_s = work.x.shape[0], work.sensed.shape[0]
    n_c = work.control_in.shape[0] - n_s
    _put(work.sense_in, 0, work.x)
    _put(work.sense_in, n, work.w)
    _put(work.sense_in, n + 6, work.N)
    _multiply(work.sensed, arrays.sense, work.sense_in)
    for i in range(n_s):
        volts = work.sensed[i] + noise[i]
        sensed_row[i] = volts
        work.control_in[n_c + i] = _quantise(volts, adc[0], adc[1], adc[2]) if adc[0] > 0 else volts


@njit(cache=True)
def _control(arrays: StepArrays, work: Work) -> None:
    """Next state and output voltages of the linear controller."""
    n_c = work.control_in.shape[0] - work.sensed.shape[0]
    _multiply(work.controlled, arrays.control, work.control_in)
    for i in range(n_c):
        work.control_in[i] = work.controlled[i]


@njit(cache=True)
def _demand(
    work: Work, step: int, drive: np.ndarray, limit_V: np.ndarray, windup: AntiWindup, demanded_row: np.ndarray
) -> None:
    """Limit the sum of the controller's voltages and `drive` (n_u,) and delay it; without delay it acts at once.

    The anti-windup (keep, feed) compares the controller's own voltages with the limits and subtracts what the limits
    cut off before.
    """
    n_u, delay = work.u.shape[0], work.line.shape[0] - 1
    n_c = work.controlled.shape[0] - n_u
    slot = (step + delay) % (delay + 1)
    for i in range(n_u):
        own = work.controlled[n_c + i] - work.excess[i]
        work.excess[i] = windup[0] * work.excess[i] + windup[1] * (own - min(max(own, -limit_V[i]), limit_V[i]))
        demanded_row[i] = own + drive[i]
        work.line[slot, i] = min(max(demanded_row[i], -limit_V[i]), limit_V[i])
        if delay == 0:
            work.u[i] = work.line[slot, i]


@njit(cache=True)
def _advance(arrays: StepArrays, work: Work) -> None:
    n, n_u = work.x.shape[0], work.u.shape[0]
    _put(work.advance_in, 0, work.x)
    _put(work.advance_in, n, work.u)
    _put(work.advance_in, n + n_u, work.w)
    _put(work.advance_in, n + n_u + 6, work.w_end)
    for i in range(6):
        work.advance_in[n + n_u + 12 + i] = work.N[i]
        work.advance_in[n + n_u + 18 + i] = work.N[i] - work.N_before[i]
        work.N_before[i] = work.N[i]
    _multiply(work.x, arrays.advance, work.advance_in)


@njit(cache=True)
def _gone(x: np.ndarray, far: np.ndarray) -> bool:
    """Whether the table has moved beyond `far` relative to the floor; non-finite values count as beyond."""
    inside = True
    for i in range(3):
        inside = inside and abs(x[i] - x[12 + i]) < far[0] and abs(x[3 + i] - x[15 + i]) < far[1]
    return not inside


@njit(cache=True)
def _sample(run: Run, k: int) -> None:
    """Start of period k: converter readings. If the sensors measure N, it is computed before them."""
    _arrive(run.work, run.floor, k, 0, run.substeps, k * run.substeps)
    if run.nonlinear and run.acceleration:
        _excess(run.arrays, run.work)
    _sense(run.arrays, run.work, run.noise[k], run.adc, run.records.sensed[k])


@njit(cache=True)
def _period(run: Run, k: int) -> bool:
    """The remainder of period k, with the voltages for its sample; whether the table has left its range."""
    work, records, substeps = run.work, run.records, run.substeps
    _demand(work, k * substeps, run.drive[k], run.limit_V, run.windup, records.demanded[k])
    _put(records.volts[k], 0, work.u)
    _put(records.q[k], 0, work.x[:6])
    _put(records.q_dot[k], 0, work.x[6:12])
    for j in range(substeps):
        if j > 0:
            _arrive(work, run.floor, k, j, substeps, k * substeps + j)
        if run.nonlinear and (j > 0 or not run.acceleration):
            _excess(run.arrays, work)
        if k == 0 and j == 0:
            _put(work.N_before, 0, work.N)
        _advance(run.arrays, work)
    return _gone(work.x, run.far)


@njit(cache=True)
def simulated(run: Run) -> int:
    """Step through the control periods; return how many were completed before the table left its range, or all."""
    for k in range(run.noise.shape[0]):
        _sample(run, k)
        _control(run.arrays, run.work)
        if _period(run, k):
            return k + 1
    return run.noise.shape[0]


def simulated_stepwise(run: Run, code: Callable[[np.ndarray], np.ndarray]) -> int:
    """`simulated` with a controller called once per sample, with its own anti-windup: code (n_s,) -> (n_u,) volts."""
    n_s, n_u = run.work.sensed.shape[0], run.work.u.shape[0]
    for k in range(len(run.noise)):
        _sample(run, k)
        run.work.controlled[run.work.controlled.shape[0] - n_u :] = code(run.work.control_in[-n_s:])
        if _period(run, k):
            return k + 1
    return len(run.noise)
