"""Measurement campaigns simulated with the nonlinear model, in the form of a measurement on a rig.

Open loop: the drives play the planned voltages without feedback. Each record is preceded by `settle_s` with the drives
at zero on the ambient floor. A record therefore begins in stationary ambient motion but before any response to the
drives: the first period of a multisine contains a transient, as specified in the contract of a campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.checks import require_whole
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.statespace import gain
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, Record, RecordHeader
from avis_ctrl.measurement.excitation.design import (
    ExcitationSignals,
    MultisineSettings,
    NoiseSettings,
    band_limited,
    multisine,
    noise,
)
from avis_ctrl.rigs.floor_spectrum import SpectrumModel, realise, shipped_spectrum
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.campaign_plan import CampaignPlan, RecordPlan
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.sampled_loop import SampledLoop, rig_bank


@dataclass(frozen=True)
class CampaignSettings:
    """range_share : fraction of the converter's range for the response to the drives at the largest level [1], on the
        rig as specified in its file. The rest is for ambient motion, noise and the table's differences from its file.
    assumed_range_V : range of the sensors if the rig file has no converter; used for the level only, without clipping.
    level_percent : level of a record whose plan states none: the highest level of the default plan.
    amplifier_corner_Hz : corner of the amplifiers if none is stated: of rigs with accelerometers, and in design files.
    most_samples, most_samples_in_all : limits of a record and of a campaign, from memory: a record takes about 600
        bytes per sample during its simulation, and 150 afterwards.
    """

    range_share: float = 0.8
    assumed_range_V: float = 10.0
    level_percent: float = 50.0
    amplifier_corner_Hz: float = 300.0
    most_samples: int = 4_000_000
    most_samples_in_all: int = 20_000_000


SETTINGS = CampaignSettings()
# Random streams of a campaign's seed; numbered from 1, since trailing zeros do not change a seed.
_SIGNALS, _FLOOR, _NOISE, _FLOOR_SENSOR = range(1, 5)

# (u (samples, n_u) [V], floor (samples, 3) [m/s], time of the first sample [s], first and last time of the campaign
# [s]) -> (samples, n_y) [V] added to the sensor signals by effects outside the rig file
SensorChange = Callable[[np.ndarray, np.ndarray, float, tuple[float, float]], np.ndarray]
# (records done, records in all, name of the latest record)
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class _Planned:
    """A planned record: its excitation u (samples, n_u) [V], and the line of the plan that it belongs to."""

    plan: RecordPlan
    u: np.ndarray
    level_V: float
    period_s: float | None


def simulate_campaign(
    rig: Rig,
    plan: CampaignPlan,
    seed: int = 1,
    *,
    truth: Rig | None = None,
    change: SensorChange | None = None,
    progress: Progress | None = None,
) -> Campaign:
    """Simulate the records of the plan; the notes state levels, clipping and assumptions.

    Parameters
    ----------
    rig : as specified in its file; provides sensors, converter, delay, limits and levels.
    seed : of all signals, floors and noise; the same seed gives the same campaign.
    truth : the simulated table, with its sensor chains; `rig` by default (`perturbed_truth` makes one).
    change : what the effects of the plan add to the sensor signals; required if the plan has effects.

    Raises
    ------
    InputError : a plan that the rig cannot follow: a level beyond the limit, a band beyond half the sample rate, a
        multisine record shorter than two periods, no ambient motion in plan or rig, no sensors.
    ComputationError : the table goes beyond its stops.
    """
    require_whole(seed, "seed", 0)
    if plan.effect and change is None:
        raise InputError(
            "expected what the effects of the plan add to the signals, as by study.hidden_effects", field="change"
        )
    loop = open_loop(rig, plan).with_plant("truth", truth)
    if truth is not None and truth.sensors() != rig.sensors():
        loop = replace(loop, sensors=replace(loop.sensors, chains=rig_bank(truth, 1.0).chains))
    ambient = _ambient(rig, plan)
    planned = list(_signals(loop, plan, seed))
    records, notes, start_s = [], _assumptions(loop, plan, seed, ambient), 0.0
    settle = round(plan.settle_s * rig.sample_rate_Hz)
    settle_s = settle / rig.sample_rate_Hz
    ends_s = sum(settle_s + len(one.u) / rig.sample_rate_Hz for one in planned)
    for k, one in enumerate(planned):
        start_s += settle_s
        record, note = _record(loop, plan, one, ambient, (seed, k), settle, start_s, change, (settle_s, ends_s))
        records.append(record)
        notes.append(note)
        start_s += record.header.duration_s
        if progress is not None:
            progress(k + 1, len(planned), record.header.name)
    return Campaign(rig.name, tuple(records), "simulated", tuple(notes))


def open_loop(rig: Rig, plan: CampaignPlan) -> SampledLoop:
    """The rig without controller, with its sensors as specified in the plan."""
    corner = plan.amplifier_corner_Hz
    # The controller's conditioning of each channel does not affect the records. Offset and 1/f noise are omitted: a
    # campaign's noise model is white.
    bank = rig_bank(rig, 1.0).white()
    if "acceleration" in bank.quantities:
        corner = corner or SETTINGS.amplifier_corner_Hz
    bank = replace(
        bank,
        noise_rms_V=bank.noise_rms_V if plan.sensors.noise else np.zeros(len(bank.chains)),
        converter=bank.converter if plan.sensors.quantiser else None,
    )
    return SampledLoop(rig, gain(np.zeros((0, 0))), (), {}, bank, {}, amplifier_corner_Hz=corner)


def _ambient(rig: Rig, plan: CampaignPlan) -> SpectrumModel | None:
    """Spectrum of the ambient floor in each direction; None for a floor at rest."""
    rms = plan.ambient.velocity_rms_m_per_s
    if rms is None:
        if rig.ambient is None:
            raise InputError(
                f"missing; the file of the rig {rig.name} does not state its floor motion ([ambient])",
                field="ambient.velocity_rms_m_per_s",
            )
        rms = rig.ambient.floor_velocity_rms_m_per_s
    if rms == 0:
        return None
    low, high = plan.ambient.band_Hz
    return shipped_spectrum(plan.ambient.spectrum).scaled_to_rms(rms, low, high)


def _signals(loop: SampledLoop, plan: CampaignPlan, seed: int) -> Iterator[_Planned]:
    """All records of the plan in order, at their levels."""
    fs, dealt, total = loop.sample_rate_Hz, 0, 0
    for line, one in enumerate(plan.record):
        samples = round((one.duration_s or plan.duration_s) * fs)
        orthogonal = one.excitation == "multisine" and plan.multisine.scheme == "orthogonal"
        total += samples * one.records * (loop.n_drives if orthogonal else 1)
        if not 2 <= samples <= SETTINGS.most_samples or total > SETTINGS.most_samples_in_all:
            raise InputError(
                f"expected records of 2 to {SETTINGS.most_samples} samples at {fs:g} Hz, and no more than "
                f"{SETTINGS.most_samples_in_all} in all records",
                field=f"record[{line + 1}].duration_s",
                value=one.duration_s or plan.duration_s,
            )
        if one.excitation == "floor":
            _check_floor_band(one.band_Hz or plan.band_Hz, samples, fs, f"record[{line + 1}].band_Hz")
        if one.excitation in ("rest", "floor"):
            for _ in range(one.records):
                yield _Planned(one, np.zeros((samples, loop.n_drives)), 0.0, None)
            continue
        try:
            signals = _drawn(loop, plan, one, samples, dealt, int(_rng(seed, line, _SIGNALS).integers(2**63)))
            largest = largest_level(loop, signals, samples)
            percent = one.level_percent or SETTINGS.level_percent
            signals = signals.scaled_to(one.level_V or percent / 100 * largest)
        except InputError as error:
            field = {"rms_V": "level_V"}.get(error.field or "", error.field)
            raise InputError(error.expected, field=f"record[{line + 1}].{field}", value=error.value) from None
        dealt += one.records
        for u in signals.u:
            yield _Planned(one, _played(u, samples), float(np.mean(signals.rms_V)), signals.period_s)


def _check_floor_band(band_Hz: list[float], samples: int, fs: float, field: str) -> None:
    low, high = band_Hz
    if high >= fs / 2 or np.floor(high * samples / fs) < max(np.ceil(low * samples / fs), 1):
        raise InputError(
            f"expected a band below half the sample rate ({fs / 2:g} Hz) that contains a multiple of "
            f"1/duration = {fs / samples:.4g} Hz",
            field=field,
            value=band_Hz,
        )


def _drawn(
    loop: SampledLoop, plan: CampaignPlan, one: RecordPlan, samples: int, dealt: int, seed: int
) -> ExcitationSignals:
    """Signals of one line of the plan, at the largest level that the drives allow."""
    fs, names = loop.sample_rate_Hz, loop.rig.equations_of_motion().actuators
    low, high = one.band_Hz or plan.band_Hz
    limit_V = float(loop.limits_V.min())  # the same level for all drives
    if one.excitation == "noise":
        return noise(NoiseSettings(names, fs, samples / fs, (low, high), limit_V, None, one.records, seed))
    m = plan.multisine
    if samples < 2 * m.period_s * fs * (1 - 1e-9):
        raise InputError(
            f"expected at least two periods of {m.period_s:g} s: the first contains the transient",
            field="duration_s",
            value=samples / fs,
        )
    own: dict[str, Any] = {"realisations": one.records, "dealt": dealt, "seed": seed, **m.model_dump()}
    return multisine(MultisineSettings(names, fs, band_Hz=(low, high), limit_V=limit_V, **own))


def _played(u: np.ndarray, samples: int) -> np.ndarray:
    """u repeated from its start for the length of the record."""
    return np.resize(u, (samples, u.shape[1]))


def largest_level(loop: SampledLoop, signals: ExcitationSignals, samples: int) -> float:
    """Largest r.m.s. [V] at which neither drives nor converter clip, from a linear noise-free run of each record.

    Computed for the rig as specified in its file. `SETTINGS.range_share` of the converter's range is for the
    response to the drives; without a converter, its range is taken as `SETTINGS.assumed_range_V`.
    """
    most = signals.scaled_to()
    level, range_V = float(np.mean(most.rms_V)), SETTINGS.assumed_range_V
    if loop.sensors.converter is not None:
        range_V = loop.sensors.converter.limits_V[1]
    nominal, peak = replace(loop, plant=loop.rig), 0.0
    for u in most.u:
        run = _run(nominal, _played(u, samples), 0, None, (0,), False)
        peak = max(peak, float(np.max(np.abs(run.sensed))))
    return level * min(1.0, SETTINGS.range_share * range_V / peak)


def _run(
    loop: SampledLoop, u: np.ndarray, settle: int, floor: np.ndarray | None, seed: tuple[int, ...], nonlinear: bool
) -> SimulationRecord:
    """Simulate u (samples, n_u) after `settle` samples of zero voltage; without noise if floor is None."""
    samples, fs = settle + len(u), loop.sample_rate_Hz
    if floor is None:
        floor = np.zeros((samples + 1, 6))
        loop = replace(loop, sensors=replace(loop.sensors, noise_rms_V=np.zeros(len(loop.sensors.chains))))
    drive = np.concatenate([np.zeros((settle, u.shape[1])), u])
    return simulate(loop, len(u) / fs, seed, settle_s=settle / fs, nonlinear=nonlinear, floor=floor, drive=drive)


def _record(
    loop: SampledLoop,
    plan: CampaignPlan,
    one: _Planned,
    ambient: SpectrumModel | None,
    seed: tuple[int, int],
    settle: int,
    start_s: float,
    change: SensorChange | None,
    campaign_s: tuple[float, float],
) -> tuple[Record, str]:
    """One record, and a sentence on its levels."""
    fs, samples, name = loop.sample_rate_Hz, len(one.u), f"{seed[1]:02d}"
    floor = _floor(loop, plan, one, ambient, settle, _rng(*seed, _FLOOR))
    run = _run(loop, one.u, settle, floor, (*seed, _NOISE), plan.truth.nonlinear)
    if run.diverged:
        raise ComputationError(
            f"record {name}: the table moved beyond its stops",
            cause="the level or the floor motion is far too large",
            measured=f"{np.max(np.abs(run.q[-1, :3])):.3g} m from rest",
            next_step="lower the level of this record in the plan",
        )
    if change is not None:
        u = np.concatenate([np.zeros((settle, one.u.shape[1])), one.u])
        added = change(u, floor[:-1, :3], start_s - settle / fs, campaign_s)
        run = replace(run, sensed=run.sensed + added[settle:])
    converter = loop.sensors.converter
    y = converter.convert(run.sensed) if converter else run.sensed
    header = RecordHeader(
        name,
        fs,
        samples,
        loop.rig.equations_of_motion().actuators,
        loop.rig.sensor_rows()[0],
        one.plan.excitation,
        one.level_V,
        start_s,
        one.period_s,
        floor_names=FLOOR_NAMES if plan.floor_sensor.recorded else (),
    )
    measured = None
    if plan.floor_sensor.recorded:
        draw = _rng(*seed, _FLOOR_SENSOR).standard_normal((samples, 3))
        own: dict[str, float] = {
            one.axis: one.noise_rms_m_per_s for one in loop.rig.floor_sensors if plan.sensors.noise
        }
        rms = np.array([np.hypot(plan.floor_sensor.noise_rms_m_per_s, own.get(axis, 0.0)) for axis in "xyz"])
        measured = run.floor_dot[:, :3] + rms * draw
    return Record(header, run.demanded, y, measured), _levels(header, run, y)


def _floor(
    loop: SampledLoop,
    plan: CampaignPlan,
    one: _Planned,
    ambient: SpectrumModel | None,
    settle: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """(settle + samples + 1, 6) floor velocity: ambient throughout, with added shaking during the record."""
    fs, samples = loop.sample_rate_Hz, settle + len(one.u)
    velocity = np.zeros((samples + 1, 6))
    if ambient is not None:
        for axis in range(3):
            velocity[:-1, axis] = realise(ambient, samples / fs, 1 / fs, rng)
    if one.plan.floor_rms_m_per_s is not None:
        low, high = one.plan.band_Hz or plan.band_Hz
        velocity[settle:-1, :3] += one.plan.floor_rms_m_per_s * band_limited(len(one.u), fs, (low, high), 3, rng)
    velocity[-1] = velocity[-2]  # end of the step after the last sample, which is not recorded
    return velocity


def _levels(header: RecordHeader, run: SimulationRecord, y: np.ndarray) -> str:
    of_u, of_y = (np.sqrt(np.mean(one**2, axis=0)) for one in (run.demanded, y))
    converter, clipped = run.loop.sensors.converter, run.clipped_adc
    text = (
        f"Record {header.name} ({header.excitation}): u {_span(of_u)} V r.m.s., peak "
        f"{np.max(np.abs(run.demanded)):.4g} V; y {_span(of_y)} V r.m.s., peak {np.max(np.abs(run.sensed)):.4g} V"
    )
    if converter is not None:
        text += f" of {converter.limits_V[1]:.4g} V"
        if clipped:
            channels = np.flatnonzero(np.any(converter.clipped(run.sensed), axis=0))
            text += (
                f"; WARNING: {clipped} samples of y clip, in {', '.join(header.y_names[k] for k in channels)}: "
                "lower the level"
            )
    return text + "."


def _span(values: np.ndarray) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{high:.4g}" if high - low <= 1e-3 * high else f"{low:.4g} to {high:.4g}"


def _assumptions(loop: SampledLoop, plan: CampaignPlan, seed: int, ambient: SpectrumModel | None) -> list[str]:
    bank, rms = loop.sensors, plan.ambient.velocity_rms_m_per_s
    if rms is None and loop.rig.ambient is not None:
        rms = loop.rig.ambient.floor_velocity_rms_m_per_s
    table = "nonlinear" if plan.truth.nonlinear else "linear"
    low, high = plan.ambient.band_Hz
    floor = (
        f"ambient floor {rms:.4g} m/s r.m.s. from {low:g} to {high:g} Hz along each of x, y, z, shape "
        f"{plan.ambient.spectrum}"
        if ambient
        else "floor at rest"
    )
    noises = f"sensor noise {_span(bank.noise_rms_V)} V r.m.s. per sample, " + (
        f"quantisation step {bank.converter.lsb_V:.4g} V"
        if bank.converter
        else f"no quantisation, levels chosen for a range of {SETTINGS.assumed_range_V:g} V"
    )
    lag = (
        f"amplifiers with a first-order lag of {loop.amplifier_corner_Hz:g} Hz"
        if loop.amplifier_corner_Hz
        else "amplifiers without lag"
    )
    return [
        f"Simulated with the {table} table in open loop, seed {seed}: {floor}; {noises}; {lag}; delay "
        f"{loop.loop_delay_s:g} s.",
        f"Before each record the drives are silent for {plan.settle_s:g} s: the first period of a multisine "
        "contains a transient.",
    ]


def _rng(*seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)
