"""A small time-domain simulator of the AVIS for the tests of the gates, independent of the package's own simulation.

Equations of motion -> zero-order hold -> decoupled by eigenvectors -> scipy.signal.lfilter; the geophones with their
compensation as 3125 V s/m times a second-order high-pass at 0.5 Hz (bilinear); ambient floor motion and sensor noise.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy import signal

from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.gates import Expectation
from avis_ctrl.rigs.rig_file import load_rig

RATE, SENSITIVITY, LSB = 1000.0, 3125.0, 20.0 / 2**14
RIG = load_rig("avis")
U_NAMES = RIG.equations_of_motion().actuators
Y_NAMES = RIG.sensor_rows()[0]


class Simulator:
    """y of a rig from commanded volts and floor displacement, sample by sample."""

    def __init__(self, rig=RIG, rate=RATE):
        self.rig, self.rate = rig, rate
        system = rig.equations_of_motion().state_space()
        Ad, Bd, *_ = signal.cont2discrete((system.A, system.B, system.C, system.D), 1 / rate)
        self.poles, V = np.linalg.eig(Ad)
        rows = rig.sensor_rows()[1]
        self.B = np.linalg.solve(V, Bd)
        self.C, self.D = rows @ system.C[6:] @ V, rows @ system.D[6:]
        w, z = 2 * np.pi * 0.5, 0.7
        self.geophone = signal.bilinear([SENSITIVITY, 0, 0], [1, 2 * z * w, w * w], rate)

    def __call__(self, u, floor=None):
        """(samples, 6) V from (samples, 8) V and floor displacement (samples, 3) m."""
        delayed = np.vstack([np.zeros((1, u.shape[1])), u[:-1]])
        inputs = np.zeros((len(u), self.B.shape[1]))
        inputs[:, : u.shape[1]] = delayed
        if floor is not None:
            inputs[:, 8:11] = floor
        driven = inputs @ self.B.T
        states = np.stack([signal.lfilter([0, 1], [1, -p], driven[:, k]) for k, p in enumerate(self.poles)], axis=1)
        velocity = (states @ self.C.T).real + inputs @ self.D.T
        return signal.lfilter(*self.geophone, velocity, axis=0)


@lru_cache
def simulator():
    return Simulator()


def floor_motion(rng, samples, rms=2e-6, rate=RATE):
    """(samples, 3) m: velocity noise of that r.m.s. between 0.5 and 60 Hz, integrated."""
    sos = signal.butter(2, [0.5, 60], "bandpass", fs=rate, output="sos")
    velocity = signal.sosfilt(sos, rng.standard_normal((samples + 5000, 3)), axis=0)[5000:]
    return np.cumsum(velocity * rms / velocity.std(axis=0), axis=0) / rate


def multisine(rng, period, rms, low=0.5, high=80.0, channels=8, rate=RATE):
    """(period, channels) random phases, flat amplitude."""
    lines = np.arange(int(np.ceil(low * period / rate)), int(high * period / rate) + 1)
    U = np.zeros((period // 2 + 1, channels), complex)
    U[lines] = np.exp(2j * np.pi * rng.random((len(lines), channels)))
    u = np.fft.irfft(U, period, axis=0)
    return u * rms / u.std(axis=0)


def record(name, u, y, excitation, level, start, period_s=None):
    header = RecordHeader(name, RATE, len(u), U_NAMES, Y_NAMES, excitation, level, start, period_s)
    return Record(header, u, y)


def measured(rng, u, sim=None, floor_rms=2e-6, noise=1e-3):
    """(samples, 6) V as the converter reports them."""
    sim = sim or simulator()
    y = sim(u, floor_motion(rng, len(u), floor_rms)) + noise * rng.standard_normal((len(u), 6))
    return np.clip(LSB * np.round(y / LSB), -10, 10 - LSB)


def multisine_campaign(seed, period=4096, periods=6, levels=(0.2, 0.2, 0.1), sims=None, same=False):
    """Records of random-phase multisines from rest at some levels, and one at rest."""
    rng = np.random.default_rng(seed)
    records, start, shape = [], 0.0, None
    for k, level in enumerate(levels):
        if shape is None or not same:
            shape = multisine(rng, period, 1.0)
        u = np.tile(shape * level, (periods, 1))
        sim = None if sims is None else sims[k]
        records.append(record(f"{k:02d}", u, measured(rng, u, sim), "multisine", level, start, period / RATE))
        start += len(u) / RATE + 1
    u = np.zeros((period * 4, 8))
    records.append(record(f"{len(levels):02d}", u, measured(rng, u), "rest", 0.0, start))
    return Campaign("avis", tuple(records))


def noise_campaign(seed, samples=40000, levels=(0.2, 0.2, 0.1), sims=None):
    """The same with band-limited noise."""
    rng = np.random.default_rng(seed)
    sos = signal.butter(4, [0.5, 80], "bandpass", fs=RATE, output="sos")
    records, start = [], 0.0
    for k, level in enumerate(levels):
        u = signal.sosfilt(sos, rng.standard_normal((samples, 8)), axis=0)
        u *= level / u.std(axis=0)
        sim = None if sims is None else sims[k]
        records.append(record(f"{k:02d}", u, measured(rng, u, sim), "noise", level, start))
        start += samples / RATE + 1
    return Campaign("avis", tuple(records))


def changed(campaign, index, u=None, y=None, **header):
    """The campaign with u, y or header fields of one record replaced."""
    records = list(campaign.records)
    old = records[index]
    u, y = old.u if u is None else u, old.y if y is None else y
    records[index] = Record(replace(old.header, samples=len(y), **header), u[: len(y)], y)
    return replace(campaign, records=tuple(records))


def everywhere(campaign, change):
    """The campaign with (u, y) of each record replaced by change(u, y)."""
    for k, old in enumerate(campaign.records):
        u, y = change(old.u.copy(), old.y.copy())
        campaign = changed(campaign, k, u, y)
    return campaign


def response_of(rig=RIG):
    model = ResponseModel.of(rig, ())
    return lambda omega, inputs: model.response(omega)[:, :, : len(inputs)]


def known(**changes):
    """What is known of the AVIS."""
    given = {
        "y_range_V": (-10.0, 10.0 - LSB),
        "y_lsb_V": LSB,
        "drive_limits_V": dict.fromkeys(U_NAMES, 10.0),
        "sensor_noise_rms_V": 1e-3,
        "y_names": Y_NAMES,
        "response": response_of(),
    }
    return Expectation(**(given | changes))
