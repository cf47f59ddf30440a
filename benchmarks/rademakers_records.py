"""The identification experiment of Rademakers' section 3.4, simulated linearly and exactly.

Band-limited white noise on the six logical axes, sampled geophones with noise and converter, floor motion if asked.
It is the friendliest case for an identification: no nonlinearity, every chain as the rig file says.
"""

from __future__ import annotations

import numpy as np
import scipy.signal as signal

from avis_ctrl.errors import InputError
from avis_ctrl.identification.predictor import Predictor
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig import Rig

TRANSLATION_V2, ROTATION_V2 = 0.25, 0.1
FLOOR_BAND_Hz = (0.5, 60.0)


def source_campaign(
    rig: Rig,
    sets: int = 10,
    duration_s: float = 100.0,
    *,
    seed: int = 1,
    noise: bool = True,
    floor_rms_m_per_s: float = 0.0,
) -> Campaign:
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
        raise InputError("expected at least one set of two samples", field="sets, duration_s", value=(sets, duration_s))
    records = tuple(
        _record(rig, f"{k:02d}", samples, np.random.default_rng((seed, k)), noise, floor_rms_m_per_s)
        for k in range(sets)
    )
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
    u = np.clip(logical_drive(rig, samples, rng), -rig.drive_limits_V(), rig.drive_limits_V())
    floor = flat_floor(samples + 1, rig.sample_rate_Hz, floor_rms, rng) if floor_rms else np.zeros((samples + 1, 3))
    y = sensor_volts(rig, u, floor)
    if noise:
        assert rig.ambient is not None
        converter = Converter(rig.acquisition.adc_bits, rig.acquisition.adc_range_V, rig.sample_rate_Hz)
        y = converter.convert(y + rng.normal(size=y.shape) * rig.ambient.sensor_noise_rms_V)
    header = RecordHeader(
        name,
        rig.sample_rate_Hz,
        samples,
        rig.equations_of_motion().actuators,
        rig.geophones.names,
        "noise",
        float(np.sqrt(np.mean(u**2))),
    )
    return Record(header, u, y)


def sensor_volts(rig: Rig, u: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(n, n_y) volts before noise, for commanded u (n, n_u) and floor velocity (n + 1, 3), ramps between samples.

    From rest. The last floor sample ends a ramp that no reading sees.
    """
    return Predictor(ResponseModel.of(rig, ())).read(u, floor[:-1])
