"""An exact discrete-time model of the AVIS for tests: matrix exponential of table and sensor chains, delay by samples.

A code path of its own: no frequency response, no aliases, no transient model.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
import scipy.signal as sg
from numba import njit

from avis_ctrl.lti.statespace import append
from avis_ctrl.measurement.campaign import Record, RecordHeader
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.simulation.sampled_loop import rig_bank


def discrete_avis(rig: IsolatorTable, period_s: float = 1e-3) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C, D from (8 volts, floor velocity of 6 coordinates), both held over a period, to the sensors' volts."""
    chains = append(*[chain.renamed([f"in{k}"], [f"out{k}"]) for k, chain in enumerate(rig_bank(rig, 1.0).chains)])
    table, R = rig.equations_of_motion().state_space(), rig.sensor_rows()[1]
    C, D = R @ table.C[6:], R @ table.D[6:, :14]
    n, n_c = len(table.A), len(chains.A)
    A = np.block([[table.A, np.zeros((n, n_c))], [chains.B @ C, chains.A]])
    B = np.vstack([table.B[:, :14], chains.B @ D])
    C, D = np.hstack([chains.D @ C, chains.C]), chains.D @ D
    # Floor velocity in, displacement as a state.
    A = np.block([[A, B[:, 8:]], [np.zeros((6, n + n_c + 6))]])
    B = np.block([[B[:, :8], np.zeros((n + n_c, 6))], [np.zeros((6, 8)), np.eye(6)]])
    C, D = np.hstack([C, D[:, 8:]]), np.zeros((6, 14))
    size = len(A)
    power = la.expm(np.block([[A, B], [np.zeros((14, size + 14))]]) * period_s)
    return tuple(np.ascontiguousarray(X) for X in (power[:size, :size], power[:size, size:], C, D))


@njit
def _run(A, driven, C):
    x, y = np.zeros(len(A)), np.zeros((len(driven), len(C)))
    for k in range(len(driven)):
        y[k] = C @ x
        x = A @ x + driven[k]
    return y


def multisine(
    rng: np.random.Generator,
    level_V: float,
    period: int = 10_000,
    periods: int = 6,
    band_Hz: tuple[float, float] = (0.5, 60.0),
    n_u: int = 8,
) -> np.ndarray:
    """(samples, n_u) V, random phases, r.m.s. level_V."""
    frequency = np.fft.rfftfreq(period, 1e-3)
    U = np.zeros((len(frequency), n_u), complex)
    inside = (frequency >= band_Hz[0]) & (frequency <= band_Hz[1])
    U[inside] = np.exp(2j * np.pi * rng.uniform(size=(np.count_nonzero(inside), n_u)))
    u = np.fft.irfft(U, period, axis=0)
    return np.tile(u * level_V / np.sqrt(np.mean(u**2)), (periods, 1))


def floor_velocity(rng: np.random.Generator, samples: int, rms: float = 2e-6) -> np.ndarray:
    """(samples, 3) m/s, 0.5-60 Hz."""
    band = sg.butter(2, [0.5, 60.0], "band", fs=1000.0, output="sos")
    v = sg.sosfilt(band, rng.normal(size=(samples + 5000, 3)), axis=0)[5000:]
    return v * rms / np.std(v)


def record(
    rig: IsolatorTable,
    u: np.ndarray,
    floor: np.ndarray,
    rng: np.random.Generator,
    name: str = "00",
    excitation: str = "multisine",
    period_s: float | None = None,
    floor_known: bool = False,
    noise_V: float = 1e-3,
    quantised: bool = True,
) -> Record:
    """A record from rest: voltage held, one sample late; noise and converter as the rig's file says."""
    A, B, C, _ = discrete_avis(rig)
    held = np.zeros((len(u), 14))
    held[1:, :8], held[:, 8:11] = u[:-1], floor
    y = _run(A, held @ B.T, C) + noise_V * rng.normal(size=(len(u), 6))
    if quantised:
        lsb = 20.0 / 2**14
        y = np.clip(lsb * np.floor(y / lsb + 0.5), -10.0, 10.0 - lsb)
    header = RecordHeader(
        name,
        1000.0,
        len(u),
        tuple(m.name for m in rig.motors),
        rig.geophones.names,
        excitation,
        float(np.sqrt(np.mean(u**2))),
        0.0,
        period_s,
        floor_names=("vx", "vy", "vz") if floor_known else (),
    )
    return Record(header, u, y, floor if floor_known else None)
