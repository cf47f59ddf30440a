"""Prediction of another record by an identified axis: the motion of an oscillator from its input alone, integrated in
time, or the force of a drive from its motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numba
import numpy as np
from scipy import signal

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.axis.mass_effects import Scale, drive_effects, oscillator_effects
from avis_ctrl.gap.axis.model import Effect
from avis_ctrl.gap.axis.records import Lines, Motion, Signals
from avis_ctrl.gap.axis.settings import SETTINGS


def predicted(model: Mapping[str, Any], which: str, record: Signals, rate: float) -> np.ndarray:
    """(n,) force of a drive, or position of an oscillator, predicted by the model "baseline" or "updated".

    Raises
    ------
    InputError : a kind without simulation, an effect outside the library. ComputationError : the motion diverges.
    """
    kind, own = str(model["kind"]), model[which]
    if kind not in ("drive", "oscillator"):
        raise InputError(
            "expected a drive or an oscillator: other kinds are responses, which predict no record",
            field="kind",
            value=kind,
        )
    scale = Scale(**{**model["scale"], "pitches": tuple(model["scale"]["pitches"])})
    library = {one.label: one for one in (drive_effects if kind == "drive" else oscillator_effects)(scale)}
    strange = [one["label"] for one in own["effects"] if one["label"] not in library]
    if strange:
        raise InputError(
            "expected effects of the library: an effect of the user's own is not in the model file",
            field="effects",
            value=strange,
        )
    effects = [(library[one["label"]], np.array(one["values"])) for one in own["effects"]]
    if kind == "drive":
        return _force(own["base"], effects, record, rate, float(model["cutoff_Hz"]))
    return _motion(own["base"], effects, record, rate, scale)


def _lines(n: int, rate: float) -> np.ndarray:
    """(n + 1,) j omega [rad/s] of the lines of n samples followed by their mirror image."""
    return 2j * np.pi * np.fft.rfftfreq(2 * n, 1 / rate)


def _filtered(x: np.ndarray, H: np.ndarray) -> np.ndarray:
    """A signal (n,) after a filter with response H on `_lines`; the mirror image avoids a step from end to start."""
    n = len(x)
    return np.fft.irfft(np.fft.rfft(np.r_[x, x[::-1]]) * H, 2 * n)[:n]


def _shaped(one: Effect, p: np.ndarray, motion: Motion) -> np.ndarray:
    """The force of an effect."""
    n = len(one.shapes)
    return sum((c * shape(motion, *p[n:]) for c, shape in zip(p[:n], one.shapes, strict=True)), np.zeros_like(motion.q))


def _force(
    base: Mapping[str, float],
    effects: Sequence[tuple[Effect, np.ndarray]],
    record: Signals,
    rate: float,
    cutoff_Hz: float,
) -> np.ndarray:
    lines = Lines([record], rate, "force", (0.0, cutoff_Hz), cutoff_Hz, SETTINGS)
    motion, over = lines.motion[0], lines.over
    s = _lines(len(motion.q), over * rate)
    found = base["M"] * np.gradient(motion.v, 1 / (over * rate)) + base["Fv"] * motion.v
    for one, p in effects:
        found = found + _shaped(one, p, motion)
        if one.dynamics:
            found = found + _filtered(motion.q - motion.middle, one.dynamics(s, p))
    for one, p in effects:
        if one.path:
            found = _filtered(found, 1 / one.path(s, p))
    low = signal.butter(4, 2 * cutoff_Hz / (over * rate), output="sos")
    return signal.sosfiltfilt(low, found)[::over]


def _motion(
    base: Mapping[str, float], effects: Sequence[tuple[Effect, np.ndarray]], record: Signals, rate: float, scale: Scale
) -> np.ndarray:
    """Runge-Kutta integration from the measured initial state; static forces are interpolated from a table."""
    over, u = 2 * SETTINGS.oversampled, record.force
    for one, p in effects:
        if one.location == "input" and one.shapes:
            u = u - _shaped(one, p, Motion(0 * u, 0 * u, record.force, 0.0, 1.0, 1.0))
        if one.path:
            u = _filtered(u, one.path(_lines(len(u), rate), p))
    fine = signal.resample_poly(np.r_[u, u[-1], u[-1]], 2 * over, 1, window=("kaiser", 8.0), padtype="line")
    reach, speed = 4 * scale.reach, 4 * max(scale.speed, 1e-300)
    q, v = np.meshgrid(*(np.linspace(-end, end, SETTINGS.table) for end in (reach, speed)), indexing="ij")
    flat = Motion(q.ravel(), v.ravel(), 0 * q.ravel(), 0.0, 1.0, 1.0)
    table, slip, sprung = np.zeros(q.size), np.array([0.0, 1.0]), np.zeros(3)
    for one, p in effects:
        if one.name == "hysteresis":
            slip = np.array([p[0], p[1]])
        elif one.dynamics:
            sprung = np.array([p[0], 2 * np.pi * p[1], p[2]])
        elif one.location != "input":
            table = table + _shaped(one, p, flat)
    start = np.array([record.position[0], (record.position[1] - record.position[0]) * rate])
    found = _integrated(
        fine,
        over,
        len(record.force),
        1 / (rate * over),
        base["m"],
        base["d"],
        base["k"],
        table.reshape(q.shape),
        reach,
        speed,
        slip,
        sprung,
        start,
    )
    if not np.all(np.isfinite(found)):
        raise ComputationError(
            "the motion diverges",
            measured=f"record {record.name}",
            cause="an input beyond the levels that the model was fitted to",
            next_step="predict a record of the same level",
        )
    return found


@numba.njit(cache=True)
def _integrated(
    u: np.ndarray,
    over: int,
    n: int,
    h: float,
    m: float,
    d: float,
    k: float,
    table: np.ndarray,
    reach: float,
    speed: float,
    slip: np.ndarray,
    sprung: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:  # pragma: no cover
    x = np.zeros(5)  # q, v, displacement and velocity of the sprung mass, state of the friction
    x[0], x[1], x[2], x[3] = start[0], start[1], start[0], start[1]
    found = np.empty(n)
    last, rates, half = table.shape[0] - 1, np.zeros((4, 5)), np.array([0.0, 0.5, 0.5, 1.0])
    for i in range(n):
        found[i] = x[0]
        for j in range(over):
            at = 2 * (i * over + j)
            for stage in range(4):
                z = x.copy()
                if stage > 0:
                    z += half[stage] * h * rates[stage - 1]
                a = min(max((z[0] / reach + 1) / 2 * last, 0.0), last - 1e-9)
                b = min(max((z[1] / speed + 1) / 2 * last, 0.0), last - 1e-9)
                ia, ib = int(a), int(b)
                fa, fb = a - ia, b - ib
                force = (1 - fa) * ((1 - fb) * table[ia, ib] + fb * table[ia, ib + 1]) + fa * (
                    (1 - fb) * table[ia + 1, ib] + fb * table[ia + 1, ib + 1]
                )
                w, pull = sprung[1], 0.0
                if sprung[0] > 0:
                    pull = 2 * sprung[2] * w * (z[1] - z[3]) + w * w * (z[0] - z[2])
                drive = u[min(at + (0 if stage == 0 else 1 if stage < 3 else 2), len(u) - 1)]
                rates[stage, 0] = z[1]
                rates[stage, 1] = (drive - d * z[1] - k * z[0] - force - slip[0] * z[4] - sprung[0] * pull) / m
                rates[stage, 2] = z[3]
                rates[stage, 3] = pull
                rates[stage, 4] = (z[1] - z[4] * abs(z[1])) / slip[1]
            x = x + h / 6 * (rates[0] + 2 * rates[1] + 2 * rates[2] + rates[3])
        if not np.isfinite(x[0]):
            found[i:] = np.nan
            break
    return found
