"""The identification experiment of Rademakers' section 3.4, simulated linearly and exactly.

Band-limited white noise on the six logical axes, sampled geophones with noise and converter, floor motion if asked.
It is the friendliest case for an identification: no nonlinearity, every chain as the rig file says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.signal as signal

from avis_ctrl.errors import InputError
from avis_ctrl.identification.prefilter import delayed
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.geophone import CompensationFilter, Geophone, SensorChain
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig import Rig

TRANSLATION_V2, ROTATION_V2 = 0.25, 0.1
FLOOR_BAND_Hz = (0.5, 60.0)


class ExactStep(NamedTuple):
    """x+ = Phi x + Gamma_u u + Gamma_w w0 + Gamma_r (w1 - w0); y = C x + D w0 with w the floor velocity, a ramp."""

    Phi: np.ndarray
    held: np.ndarray
    floor: np.ndarray
    ramp: np.ndarray
    C: np.ndarray


def source_campaign(rig: Rig, sets: int = 10, duration_s: float = 100.0, *, seed: int = 1, noise: bool = True,
                    floor_rms_m_per_s: float = 0.0) -> Campaign:
    """Records of section 3.4: white noise of 0.25 V^2 on x, y, z and 0.1 V^2 on the rotations, held at the sample rate.

    One volt on a logical axis is one volt at the motor that this axis uses most. Each record starts at rest.

    Parameters
    ----------
    noise : sensor noise of `rig.ambient` and the converter; False for exact voltages.
    floor_rms_m_per_s : of each direction between 0.5 and 60 Hz, with a flat density of velocity; not recorded.

    Raises
    ------
    InputError : a rig without geophones, acquisition or (with noise) ambient numbers; no sets, no duration.
    """
    if rig.geophones is None or rig.acquisition is None or (noise and rig.ambient is None):
        raise InputError("expected a rig with geophones, acquisition and ambient noise", field="rig", value=rig.name)
    rate = rig.sample_rate_Hz
    samples = round(duration_s * rate)
    if sets < 1 or samples < 2:
        raise InputError("expected at least one set of two samples", field="sets, duration_s",
                         value=(sets, duration_s))
    records = tuple(_record(rig, f"{k:02d}", samples, np.random.default_rng((seed, k)), noise, floor_rms_m_per_s)
                    for k in range(sets))
    return Campaign(rig.name, records, notes=("simulated linearly, records from rest",))


def logical_drive(rig: Rig, samples: int, rng: np.random.Generator) -> np.ndarray:
    """(samples, n_u) voltages of the motors."""
    allocation = actuator_axes(rig).allocation
    allocation = allocation / np.max(np.abs(allocation), axis=0)
    sigma = np.sqrt([TRANSLATION_V2] * 3 + [ROTATION_V2] * 3)
    return rng.normal(size=(samples, 6)) * sigma @ allocation.T


def flat_floor(samples: int, rate: float, rms: float, rng: np.random.Generator) -> np.ndarray:
    """(samples, 3) floor velocity, white within 0.5-60 Hz (or half the rate), of that r.m.s. in the band."""
    low, high = FLOOR_BAND_Hz[0], min(FLOOR_BAND_Hz[1], 0.45 * rate)
    settle = round(20 * rate)
    sos = signal.butter(4, (low, high), "bandpass", fs=rate, output="sos")
    motion = signal.sosfilt(sos, rng.normal(size=(samples + settle, 3)), axis=0)[settle:]
    return motion * rms / np.sqrt(2 * (high - low) / rate)


def _record(rig: Rig, name: str, samples: int, rng: np.random.Generator, noise: bool, floor_rms: float) -> Record:
    assert rig.geophones is not None and rig.acquisition is not None
    u = np.clip(logical_drive(rig, samples, rng), -rig.drive_limit_V, rig.drive_limit_V)
    floor = flat_floor(samples + 1, rig.sample_rate_Hz, floor_rms, rng) if floor_rms else np.zeros((samples + 1, 3))
    y = sensor_volts(rig, u, floor)
    if noise:
        assert rig.ambient is not None
        converter = Converter(rig.acquisition.adc_bits, rig.acquisition.adc_range_V, rig.sample_rate_Hz)
        y = converter.convert(y + rng.normal(size=y.shape) * rig.ambient.sensor_noise_rms_V)
    header = RecordHeader(name, rig.sample_rate_Hz, samples, rig.equations_of_motion().actuators,
                          rig.geophones.names, "noise", float(np.sqrt(np.mean(u ** 2))))
    return Record(header, u, y)


def sensor_volts(rig: Rig, u: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(n, n_y) volts before noise, for commanded u (n, n_u) and floor velocity (n + 1, 3), ramps between samples.

    Exact where the loop delay is a whole number of samples, as it is on the AVIS.
    """
    step, delay = exact_step(rig), rig.loop_delay_s * rig.sample_rate_Hz
    drive = delayed(u, delay) @ step.held.T + floor[:-1] @ step.floor.T + np.diff(floor, axis=0) @ step.ramp.T
    x = np.empty((len(u) + 1, len(step.Phi)))
    x[0] = 0.0
    for k in range(len(u)):
        x[k + 1] = step.Phi @ x[k] + drive[k]
    return x[:-1] @ step.C.T


def exact_step(rig: Rig) -> ExactStep:
    """Table with floor displacement and sensor chains over one sample, by the matrix exponential (Van Loan 1978)."""
    A, B, C = _continuous(rig)
    n, m = B.shape
    h = 1 / rig.sample_rate_Hz
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n:n + m], block[n:n + m, n + m:] = A * h, B * h, np.eye(m)
    power = la.expm(block)
    held, ramp = power[:n, n:n + m], power[:n, n + m:]
    n_u = m - 3
    return ExactStep(power[:n, :n], held[:, :n_u], held[:, n_u:], ramp[:, n_u:], C)


def _continuous(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C of states (q, q', floor displacement, chains) and inputs (u, floor velocity)."""
    g, a = rig.geophones, rig.acquisition
    assert g is not None and a is not None
    eom, (_, rows) = rig.equations_of_motion(), rig.sensor_rows()
    corners = CompensationFilter(g.suspension_Hz, g.suspension_damping, g.compensated_Hz, g.compensated_damping)
    converter = Converter(a.adc_bits, a.adc_range_V, a.sample_rate_Hz)
    chain = SensorChain(Geophone(g.suspension_Hz, g.suspension_damping, 1.0), corners, 1.0, converter).system()
    gains = np.array(g.sensitivity_Vs_per_m) * g.preamplifier_gain
    n_c, n_y, n_u = chain.nstates, len(rows), len(eom.actuators)
    n, n_s = 15, 15 + n_c * len(rows)
    A, B, C = np.zeros((n_s, n_s)), np.zeros((n_s, n_u + 3)), np.zeros((n_y, n_s))
    A[:6, 6:12] = np.eye(6)
    A[6:12, :15] = la.solve(eom.M, np.hstack([-eom.K, -eom.C, eom.K_floor[:, :3]]))
    B[6:12] = la.solve(eom.M, np.hstack([eom.T, eom.C_floor[:, :3]]))
    B[12:15, n_u:] = np.eye(3)
    for i, row in enumerate(rows):
        s = slice(n + n_c * i, n + n_c * (i + 1))
        A[s, s] = chain.A
        A[s, 6:12] = np.outer(chain.B[:, 0], row)
        C[i, s] = gains[i] * chain.C[0]
        C[i, 6:12] = gains[i] * chain.D[0, 0] * row
    return A, B, C

