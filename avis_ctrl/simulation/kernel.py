"""The compiled inner loop of the simulation: a few matrix-vector products and one evaluation of the table a step."""

from __future__ import annotations

import numpy as np
from numba import njit

from avis_ctrl.rigs.converter import quantise
from avis_ctrl.rigs.nonlinear import payload_acceleration

_quantise = njit(cache=True)(quantise)


@njit(cache=True)
def _excess(out, x, w, u, arrays, s_observe, observed):
    """N: the nonlinear table's acceleration less the linear one's."""
    n, n_u = x.shape[0], u.shape[0]
    s_observe[:n], s_observe[n:n + n_u], s_observe[n + n_u:] = x, u, w
    np.dot(arrays.observe, s_observe, observed)
    true = payload_acceleration(x[:6], x[6:12], observed[:n_u], x[12:18], w, arrays.table)
    for i in range(6):
        out[i] = true[i] - observed[n_u + i]


@njit(cache=True)
def _gone(x, far_m, far_rad):
    """Whether the table has left the range in which it can move at all."""
    # Written so that a number that is not finite counts as gone.
    inside = True
    for i in range(3):
        inside = inside and abs(x[i]) < far_m and abs(x[3 + i]) < far_rad
    return not inside


@njit(cache=True)
def run(arrays, floor, noise, substeps, delay, nonlinear, acceleration, adc, limit_V, far, state, records):
    """Steps through the control periods; returns how many were completed before divergence.

    floor : (n + 1, 6) floor velocity at the samples; noise : (n, n_s) V.
    substeps, delay : steps a period, and delay in steps. nonlinear, acceleration : flags.
    adc : (lsb, lower, upper), lsb = 0 for none. far : (m, rad) beyond which the table has diverged.
    state : initial x, overwritten by the final one.
    records : (q, q', volts, demanded volts, sensor volts), rows at the samples.
    """
    x, w = state, np.zeros(6)
    n, n_u, n_s = x.shape[0], arrays.observe.shape[0] - 6, arrays.sense.shape[0]
    n_c = arrays.control.shape[0] - n_u
    q_out, v_out, volts_out, demand_out, sensed_out = records
    s, s_observe, s_sense = np.zeros(n + n_u + 24), np.zeros(n + n_u + 6), np.zeros(n + 12)
    observed, sensed = np.zeros(n_u + 6), np.zeros(n_s)
    s_control, controlled = np.zeros(n_c + n_s), np.zeros(n_c + n_u)
    N, N_before, started = np.zeros(6), np.zeros(6), False
    line = np.zeros((delay + 1, n_u))  # voltages on their way, by substep of arrival
    u = np.zeros(n_u)
    step = 0
    for k in range(floor.shape[0] - 1):
        for j in range(substeps):
            fraction = j / substeps
            for i in range(6):
                w[i] = floor[k, i] + (floor[k + 1, i] - floor[k, i]) * fraction
            slot = step % (delay + 1)
            if delay > 0 and (step >= delay) and (step - delay) % substeps == 0:
                u[:] = line[slot]
            if nonlinear and acceleration:
                _excess(N, x, w, u, arrays, s_observe, observed)
            if j == 0:
                s_sense[:n], s_sense[n:n + 6], s_sense[n + 6:] = x, w, N
                np.dot(arrays.sense, s_sense, sensed)
                for i in range(n_s):
                    sensed[i] += noise[k, i]
                    sensed_out[k, i] = sensed[i]
                    if adc[0] > 0:
                        sensed[i] = _quantise(sensed[i], adc[0], adc[1], adc[2])
                s_control[n_c:] = sensed
                np.dot(arrays.control, s_control, controlled)
                s_control[:n_c] = controlled[:n_c]
                arrival = (step + delay) % (delay + 1)
                for i in range(n_u):
                    demand_out[k, i] = controlled[n_c + i]
                    line[arrival, i] = min(max(controlled[n_c + i], -limit_V), limit_V)
                if delay == 0:
                    u[:] = line[0]
                q_out[k], v_out[k], volts_out[k] = x[:6], x[6:12], u
            if nonlinear and not acceleration:
                _excess(N, x, w, u, arrays, s_observe, observed)
            if not started:
                N_before[:], started = N, True
            s[:n], s[n:n + n_u], s[n + n_u:n + n_u + 6] = x, u, w
            for i in range(6):
                s[n + n_u + 6 + i] = floor[k, i] + (floor[k + 1, i] - floor[k, i]) * (j + 1) / substeps
                s[n + n_u + 12 + i] = N[i]
                s[n + n_u + 18 + i] = N[i] - N_before[i]
                N_before[i] = N[i]
            np.dot(arrays.advance, s, x)
            step += 1
        if _gone(x, far[0], far[1]):
            return k + 1
    return floor.shape[0] - 1
