"""Campaigns with faults of the signals added by hand: an exact discrete-time AVIS, floor, noise, hum and converters."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np
import scipy.signal as sg

from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.rigs import load_rig

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "identification"))
from exact import _run, discrete_avis, floor_velocity, multisine

FS, LSB = 1000.0, 20.0 / 2**14
LEVELS = (0.1, 0.1, 0.25, 0.25, 0.5, 0.5)


@cache
def rig():
    return load_rig("avis")


@cache
def _matrices():
    return discrete_avis(rig())


def response(u: np.ndarray, floor: np.ndarray | None = None) -> np.ndarray:
    """(samples, 6) V before noise and converter, from rest; u one sample late."""
    A, B, C, _ = _matrices()
    held = np.zeros((len(u), 14))
    held[1:, :8] = u[:-1]
    if floor is not None:
        held[:, 8:11] = floor
    return _run(A, held @ B.T, C)


def convert(y: np.ndarray, lsb: float = LSB, low: float = -10.0, high: float = 10.0 - LSB) -> np.ndarray:
    return np.clip(lsb * np.floor(y / lsb + 0.5), low, high)


def noise_drive(rng: np.random.Generator, level_V: float, samples: int, band_Hz=(0.5, 60.0)) -> np.ndarray:
    u = sg.sosfilt(sg.butter(4, band_Hz, "band", fs=FS, output="sos"), rng.normal(size=(samples, 8)), axis=0)
    return u * level_V / u.std()


def power_law_floor(rng: np.random.Generator, samples: int, rms: float, slope: float) -> np.ndarray:
    """(samples, 3) m/s of r.m.s. `rms` in 0.5-60 Hz, ASD of velocity as f^-slope there, nothing outside."""
    f = np.fft.rfftfreq(samples, 1 / FS)
    inside = (f >= 0.5) & (f <= 60)
    shape = np.where(inside, np.maximum(f, 0.5) ** -slope, 0.0)[:, None]
    V = shape * (rng.normal(size=(len(f), 3)) + 1j * rng.normal(size=(len(f), 3)))
    v = np.fft.irfft(V, samples, axis=0)
    # The scale is that of the ensemble, not of the draw.
    return v * rms / np.sqrt(np.sum(4 * shape**2) / samples**2)


def hum(samples: int, f0: float, amplitudes: dict[tuple[int, int], float], rng: np.random.Generator) -> np.ndarray:
    """(samples, 6) V: (channel, harmonic) -> peak."""
    t, y = np.arange(samples) / FS, np.zeros((samples, 6))
    for (channel, k), a in amplitudes.items():
        y[:, channel] += a * np.sin(2 * np.pi * k * f0 * t + rng.uniform(0, 2 * np.pi))
    return y


def draw(
    seed: int,
    kind: str = "multisine",
    levels=LEVELS,
    samples: int = 60_000,
    *,
    slope: float | None = 0.0,
    floor_rms: float = 2e-6,
    noise_V=1e-3,
    added=None,
    distort=None,
    adc=convert,
    filtered_floor: bool = False,
    floor_known: bool = False,
) -> tuple[Campaign, dict[str, np.ndarray]]:
    """A campaign and the noise-free prediction of each record from u (and the floor, where it is known).

    added(samples, rng) : (samples, 6) V before the converter; distort(y0, u) : replaces the driven part of y.
    """
    rng = np.random.default_rng(seed)
    records, predicted = [], {}
    for k, level in enumerate(levels):
        excitation = "rest" if level == 0 else kind
        if level == 0:
            u = np.zeros((samples, 8))
        elif kind == "multisine":
            u = multisine(rng, level, periods=samples // 10_000)
        else:
            u = noise_drive(rng, level, samples)
        floor = (
            floor_velocity(rng, samples, floor_rms)
            if filtered_floor
            else power_law_floor(rng, samples, floor_rms, slope or 0.0)
        )
        driven = response(u)
        moved = response(np.zeros_like(u), floor)
        y = (driven if distort is None else distort(driven, u)) + moved
        y = y + np.asarray(noise_V) * rng.normal(size=y.shape)
        if added is not None:
            y = y + added(samples, rng)
        name = f"{k:02d}"
        header = RecordHeader(
            name,
            FS,
            samples,
            tuple(m.name for m in rig().motors),
            rig().geophones.names,
            excitation,
            level,
            70.0 * k,
            10.0 if excitation == "multisine" else None,
            floor_names=("vx", "vy", "vz") if floor_known else (),
        )
        records.append(Record(header, u, adc(y), floor if floor_known else None))
        predicted[name] = driven + (moved if floor_known else 0.0)
    return Campaign("avis", tuple(records)), predicted
