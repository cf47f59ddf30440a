"""Effect of the rounding in the code on the payload.

Standard model of floating-point arithmetic (Higham, Accuracy and Stability of Numerical Algorithms, 2002, sec. 3.1):
the error of a sum of n products is at most n eps / (1 - n eps) times the sum of the magnitudes. For the largest inputs
and states at the site, each step thus adds at most e to the states and voltages. For any such errors, the payload
velocity in the closed loop stays within

    sum over k of |C Phi^k Gamma| e,

the l1 norm of the sampled linear loop: a worst-case bound, not a standard deviation. The magnitudes are those that a
Gaussian signal exceeds once in ten minutes (`peak_factor` of `study.analysis` times the r.m.s. of floor and sensor
noise).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError
from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.discrete import N_Q, disturbed_period_map, gain_at_rest
from avis_ctrl.simulation.sampled_loop import SampledLoop, lever_arms
from avis_ctrl.simulation.sampled_response import open_response
from avis_ctrl.study.analysis import SETTINGS as ANALYSIS


def rounding_noise(
    controller: SampledController, loop: SampledLoop, points: int = 1500, steps: int = 100_000
) -> np.ndarray:
    """(6,) bound of the payload velocity due to rounding, rotations at the edge [m/s].

    loop : its `digital` is the controller's system. points : number of frequencies for the signals' r.m.s. values.
    steps : samples summed one by one; the rest is bounded by the loop's modes.

    Raises
    ------
    ComputationError : the loop is not stable.
    """
    Phi, Gamma = disturbed_period_map(loop)
    y, x = _levels(loop, points)
    K, eps = controller.system, float(np.finfo(controller.dtype).eps) / 2

    def errors(by_state: np.ndarray, by_input: np.ndarray) -> np.ndarray:
        # One more rounding when the inputs are read.
        terms = np.count_nonzero(by_state, axis=1) + by_input.shape[1] + 1
        return terms * eps / (1 - terms * eps) * (np.abs(by_state) @ x + np.abs(by_input) @ y)

    e = np.concatenate([errors(K.A, K.B), errors(K.C, K.D)])
    rows = np.zeros((N_Q, Phi.shape[0]))
    rows[:, N_Q : 2 * N_Q] = np.diag(lever_arms(loop.rig))
    return _peak_gain(Phi, Gamma, rows, steps) @ e


def _peak_gain(Phi: np.ndarray, Gamma: np.ndarray, rows: np.ndarray, steps: int) -> np.ndarray:
    """(rows, columns of Gamma) sum over k of |rows Phi^k Gamma|."""
    values, vectors = la.eig(Phi)
    size = np.abs(values)
    if np.max(size) >= 1:
        raise ComputationError(
            "the loop of all axes is unstable with the exported controller",
            measured=f"spectral radius {np.max(size):.6g}",
        )
    total = np.zeros((rows.shape[0], Gamma.shape[1]))
    for _ in range(steps):
        total += np.abs(rows @ Gamma)
        rows = rows @ Phi
    # The rest from the modes: |rows V| |lambda|^k |inv(V) Gamma|, a geometric series.
    return total + np.abs(rows @ vectors) / (1 - size) @ np.abs(np.linalg.solve(vectors, Gamma.astype(complex)))


def _levels(loop: SampledLoop, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Peak magnitudes of the inputs (n_y,) and of the controller's states (n,) at the design's site."""
    assert loop.digital is not None
    lowest = min((one.low_Hz for one in loop.floor.values()), default=0.01)
    omega = 2 * np.pi * np.geomspace(lowest, 0.499 / loop.period_s, points)
    G, K = open_response(loop, omega), loop.digital
    closed = np.linalg.inv(np.eye(K.ninputs) - G.sensed_volts @ K.frequency_response(omega))
    floor = np.zeros((omega.size, N_Q))
    for name, spectrum in loop.floor.items():
        floor[:, COORDINATES.index(name)] = spectrum.asd(omega / (2 * np.pi), "velocity")
    noise = np.sqrt(loop.sensors.noise_psd(omega / (2 * np.pi), loop.period_s))
    y = np.concatenate([closed @ (G.sensed_floor * floor[:, None, :]), closed * noise[:, None, :]], axis=2)
    states = np.linalg.solve(np.exp(1j * omega * loop.period_s)[:, None, None] * np.eye(K.nstates) - K.A, K.B @ y)

    def peak(density: np.ndarray) -> np.ndarray:
        return ANALYSIS.peak_factor * np.sqrt(
            np.trapezoid(np.sum(np.abs(density) ** 2, axis=2), omega / (2 * np.pi), axis=0)
        )

    # In addition the offsets of the channels, of either sign; at rest only position sensors are fed back.
    offset = np.array([one.offset_V for one in loop.rig.sensors()])
    to_states = replace(K, C=np.eye(K.nstates), D=np.zeros((K.nstates, K.ninputs)), outputs=(), states=())
    held = np.abs(gain_at_rest(to_states)) @ offset
    return peak(y) + offset, peak(states) + held
