"""Blind cases: a table drawn from a seed, with no, one or two effects of the library or one from outside it.

    case = draw_case(7)                        # the usual mixture; kind=, effect=, strength= pin it
    campaign = simulate_case(case)             # what `avis gap` sees
    fresh = simulate_case(case, unseen=True)   # the same table under other signals, noise and floor
    case = draw_case(7, clutter=True)          # a table that differs from its rig file in everything a little
    relative_change(case)                      # how far the effects stand out of noise and ambient motion

Import as `truth.cases` with the folder tests/ on the path. Only the numbers of the rig file and the containers of a
campaign are shared with the package.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, Record, RecordHeader
from avis_ctrl.rigs import IsolatorTable, load_rig

from .clutter import Pilot, add_trace, disturb, draw_traces, far, tolerances
from .effect import STRENGTHS, Draw, Effect, Hidden
from .kernel import integrate, state_size
from .library_mechanics import MECHANICS
from .library_signals import SIGNALS
from .outside import OUTSIDE
from .signals import floor_motion, multisine, noise
from .table import Plant, draw_plant, pilot
from .variants import vary

LIBRARY: dict[str, Effect] = {effect.name: effect for effect in (*SIGNALS, *MECHANICS)}
OUTSIDE_LIBRARY: dict[str, Effect] = {effect.name: effect for effect in OUTSIDE}
KINDS = {"none": 0.20, "one": 0.45, "two": 0.15, "outside": 0.20}
STRENGTH_SHARES = {"faint": 0.25, "clear": 0.45, "gross": 0.30}
UNSIZED = {"tilt_coupling"}  # given by gravity: always called clear
SETTLE_S = 12.0  # ambient motion before a record; the table's slowest mode decays by e^-3.8 within it
(_PARAMETERS, _PLAN, _EFFECTS, _SIGNAL, _FLOOR, _NOISE, _HOOKS, _PAUSES, _CLUTTER, _TRACES, _PILOT) = range(11)


@dataclass(frozen=True)
class Case:
    """Everything that a campaign follows from, with the truth.

    seed : of the table's parameters and all signals. kind : "none", "one", "two" or "outside".
    effects : the hidden ones. excitation : "multisine" or "noise". period_s : of a multisine, otherwise None.
    band_Hz, levels_V : of the excitation; levels_V one r.m.s. voltage for each record. starts_s : of the records.
    duration_s : of one record. floor_recorded : whether the campaign tells the floor's velocity.
    floor_slope : ambient floor velocity falls in amplitude as f^-slope within 0.5-60 Hz.
    """

    seed: int
    kind: str
    effects: tuple[Hidden, ...]
    excitation: str
    period_s: float | None
    band_Hz: tuple[float, float]
    levels_V: tuple[float, ...]
    starts_s: tuple[float, ...]
    duration_s: float
    floor_recorded: bool
    floor_slope: float
    clutter: bool = False
    traces: tuple[Hidden, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.effects)


@cache
def rig() -> IsolatorTable:
    """The rig file (AVIS_RIG, or the shared one)."""
    shared = Path(__file__).resolve().parents[3] / "shared" / "rigs" / "avis.toml"
    return load_rig(Path(os.environ.get("AVIS_RIG", shared)))


def _rng(seed: int, stream: int, *more: int) -> np.random.Generator:
    return np.random.default_rng([seed, stream, *more])


def _starts(rng: np.random.Generator, records: int, duration_s: float) -> tuple[float, ...]:
    pauses = np.round(rng.uniform(60.0, 900.0, records - 1))
    return (0.0, *(float(start) for start in np.cumsum(pauses + duration_s)))


def _bare_case(seed: int, duration_s: float) -> Case:
    """The plan of the experiment, with nothing hidden yet."""
    rng = _rng(seed, _PLAN)
    periodic = rng.random() < 0.6
    periods = [p for p in (20.0, 10.0) if duration_s >= 3 * p] or [p for p in (5.0, 2.0) if duration_s >= 2 * p]
    period = float(rng.choice(periods)) if periodic and periods else None
    band = (0.5, 60.0) if rng.random() < 0.5 else (0.3, 80.0)
    levels = np.repeat(np.array([0.08, 0.2, 0.5]) * rng.uniform(0.7, 1.2, 3), 2)
    if rng.random() < 0.5:
        levels = rng.permutation(levels)
    return Case(
        seed,
        "none",
        (),
        "multisine" if period else "noise",
        period,
        band,
        tuple(levels.tolist()),
        _starts(rng, 6, duration_s),
        duration_s,
        bool(rng.random() < 0.5),
        float(rng.uniform(0.0, 1.0)),
    )


def _pick(rng: np.random.Generator, kind: str) -> list[str]:
    if kind == "none":
        return []
    if kind == "outside":
        return [str(rng.choice(list(OUTSIDE_LIBRARY)))]
    first, second = rng.permutation(list(LIBRARY))[:2]
    if kind == "one":
        return [str(first)]
    while LIBRARY[first].family == LIBRARY[second].family:
        second = rng.choice(list(LIBRARY))
    return [str(first), str(second)]


def draw_case(
    seed: int,
    kind: str | None = None,
    effect: str | None = None,
    strength: str | None = None,
    duration_s: float = 60.0,
    clutter: bool = False,
    variant: str | None = None,
) -> Case:
    """A case; the same arguments give the same case.

    kind : "none", "one", "two", "outside"; drawn 20/45/15/20 by default. effect : a name of LIBRARY or
    OUTSIDE_LIBRARY (kind "one" or "outside" then). strength : "faint", "clear", "gross"; drawn 25/45/30, for each
    effect. Two effects are of different families, so that a person could in principle tell them apart.
    clutter : a table off its rig file by tolerances, with traces of effects besides, and one of the richer laws of
    VARIANTS (or `variant`) for each hidden effect of the library. Kind and names are those of the clean case.
    """
    case = replace(_bare_case(seed, duration_s), clutter=clutter)
    rng = _rng(seed, _EFFECTS)
    drawn_kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    kind = ("outside" if effect in OUTSIDE_LIBRARY else "one") if effect is not None else kind or drawn_kind
    names = [effect] if effect is not None else _pick(rng, kind)
    plant = build_plant(case)
    levels = sorted(set(case.levels_V))
    middle, high = (pilot(plant, case.band_Hz, level) for level in (levels[len(levels) // 2], levels[-1]))
    span, limits = case.starts_s[-1] + duration_s, tolerances(rig()) if clutter else {}
    hidden = []
    for name in names:
        chosen = str(rng.choice(list(STRENGTH_SHARES), p=list(STRENGTH_SHARES.values())))
        chosen = strength or chosen
        if chosen not in STRENGTHS:
            raise ValueError(f"strength = {chosen!r}: expected one of {', '.join(STRENGTHS)}")
        draw = Draw(rng, plant, middle, high, chosen, span, case.band_Hz, limits)
        location, parameters, details = (LIBRARY | OUTSIDE_LIBRARY)[name].draw(draw)
        if clutter:
            vary(name, draw, parameters, details, variant)
        hidden.append(Hidden(name, location, parameters, "clear" if name in UNSIZED else chosen, details))
    if clutter:
        quiet = Draw(_rng(seed, _TRACES), plant, middle, high, "faint", span, case.band_Hz, limits)
        case = replace(case, traces=draw_traces(quiet, _pilot_of(case), LIBRARY, tuple(names)))
    unmeasured = "ground_motion" in names
    return replace(case, kind=kind, effects=tuple(hidden), floor_recorded=case.floor_recorded and not unmeasured)


def far_values(seed: int, times: float) -> list[tuple[str, str]]:
    """(effect, place) of the values of a cluttered table that lie beyond so many tolerances without a hidden effect."""
    before, after = (draw_plant(rig(), _rng(seed, _PARAMETERS)) for _ in range(2))
    limits = tolerances(rig())
    disturb(after, limits, _rng(seed, _CLUTTER))
    return far(before, after, limits, times)


def build_plant(case: Case) -> Plant:
    """The case's table with its tolerances, traces and effects."""
    plant = draw_plant(rig(), _rng(case.seed, _PARAMETERS))
    if case.clutter:
        disturb(plant, tolerances(rig()), _rng(case.seed, _CLUTTER))
    for trace in case.traces:
        add_trace(plant, trace, LIBRARY)
    for hidden in case.effects:
        (LIBRARY | OUTSIDE_LIBRARY)[hidden.name].apply(plant, hidden)
    return plant


def _pilot_of(case: Case) -> Pilot:
    """A short record of the case's table alone, on a still floor."""

    def respond(plant: Plant, u: np.ndarray) -> np.ndarray:
        return run(plant, u, np.zeros((len(u) + 1, 9)), 0, 0.0, _rng(case.seed, _HOOKS))[0]

    return Pilot(
        lambda: build_plant(replace(case, traces=(), effects=())),
        respond,
        case.band_Hz,
        case.levels_V,
        _rng(case.seed, _PILOT),
    )


def held_voltage(
    samples: int, before: int, dt: float, delay_s: float, clock_error: float
) -> tuple[np.ndarray, np.ndarray]:
    """(first, switch) of kernel.integrate for sample intervals -before .. samples - 1.

    The voltage u[n] is held from (n + delay/dt)/(1 + clock_error) to the next one, in sample intervals.
    """
    k = np.arange(-before, samples, dtype=float)
    delay = delay_s / dt
    first = np.floor((k - delay) * (1 + clock_error) + 1e-9)
    switch = (first + 1) / (1 + clock_error) + delay - k
    switch = np.clip(switch, 0.0, 1.0)
    return first.astype(np.int64), switch


def run(
    plant: Plant,
    u: np.ndarray,
    floor: np.ndarray,
    before: int,
    start_s: float,
    rng: np.random.Generator,
    states: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Analogue sensor voltages (samples, 6) under commanded u (samples, 8), and the states if asked for.

    floor : (before + samples + 1, 9), from `before` samples ahead of the record, where the table starts at rest.
    """
    dt = 1 / plant.rig.sample_rate_Hz
    t = start_s + np.arange(len(u)) * dt
    held = np.clip(u, -plant.rig.drive_limit_V, plant.rig.drive_limit_V)
    for change in plant.drive:
        held = change(held, t, rng)
    P = plant.physics()
    x = np.zeros(state_size(P))
    x[3] = 1.0
    x[0:3], x[7:10] = floor[0, 0:3], floor[0, 3:6]
    first, switch = held_voltage(len(u), before, dt, plant.delay_s, plant.clock_error)
    if plant.jitter_s > 0:
        switch = np.clip(switch + plant.jitter_s / dt * rng.uniform(-1, 1, len(switch)), 0.0, 1.0)
    clock = start_s + np.arange(-before, len(u)) * dt
    y = np.empty((before + len(u), 6))
    trace = np.empty((len(y) if states else 0, len(x)))
    integrate(
        P,
        x,
        np.ascontiguousarray(held),
        first,
        switch,
        np.ascontiguousarray(floor),
        np.ascontiguousarray(plant.stiffness(clock), dtype=float),
        dt,
        y,
        trace,
    )
    y = y[before:]
    if not np.all(np.isfinite(y)) or np.abs(y).max() > 1e4:
        raise ArithmeticError("the simulated table is unstable")
    for change in plant.analogue:
        y = change(y, t, rng)
    return y, trace[before:]


def convert(plant: Plant, y: np.ndarray, start_s: float, rng: np.random.Generator) -> np.ndarray:
    """Noise, converter, and what happens behind it."""
    y = y + plant.noise_V * rng.standard_normal(y.shape)
    y = plant.step_V * (np.floor(y / plant.step_V + 0.5 - plant.offset_steps) + plant.offset_steps)
    y = np.clip(y, -plant.range_V * plant.rails[:, 1], plant.range_V * plant.rails[:, 0] - plant.step_V)
    t = start_s + np.arange(len(y)) / plant.rig.sample_rate_Hz
    for change in plant.digital:
        y = change(y, t, rng)
    return y


def _signals(case: Case, number: int, unseen: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """Commanded u, floor at ambient level, samples before the record."""
    rate = rig().sample_rate_Hz
    samples, before = round(case.duration_s * rate), round(SETTLE_S * rate)
    key = (number, int(unseen))
    rng, level = _rng(case.seed, _SIGNAL, *key), case.levels_V[number]
    if case.period_s is not None:
        u = multisine(rng, samples, 8, round(case.period_s * rate), case.band_Hz, rate, level)
    else:
        u = noise(rng, samples, 8, case.band_Hz, rate, level)
    floor = floor_motion(
        _rng(case.seed, _FLOOR, *key),
        before + samples + 1,
        rate,
        rig().ambient.floor_velocity_rms_m_per_s,
        case.floor_slope,
    )
    return u, floor, before


def _record(
    case: Case, plant: Plant, number: int, start_s: float, unseen: bool, *, driven: bool = True, from_rest: bool = False
) -> Record:
    """from_rest : the table starts with the record, at rest on the floor, instead of in ambient motion."""
    u, floor, before = _signals(case, number, unseen)
    if from_rest:
        floor, before = floor[before:], 0
    u, floor = u * driven, floor * np.tile(np.broadcast_to(plant.floor_factor, 3), 3)
    key = (number, int(unseen))
    y, _ = run(plant, u, floor, before, start_s, _rng(case.seed, _HOOKS, *key))
    y = convert(plant, y, start_s, _rng(case.seed, _NOISE, *key))
    names = FLOOR_NAMES if case.floor_recorded else ()
    header = RecordHeader(
        f"{number:02d}",
        plant.rig.sample_rate_Hz,
        len(u),
        plant.motors,
        plant.sensors,
        case.excitation,
        case.levels_V[number],
        start_s,
        case.period_s,
        floor_names=names,
    )
    return Record(header, u, y, floor[before:-1, 3:6] if names else None)


def best_prediction(case: Case, unseen: bool = False) -> list[np.ndarray]:
    """Of each record: what the true table would show with its traces and all that is random switched off.

    Its tolerances and hidden effects are in; traces, sensor noise, jitter, lost samples and a floor that nobody
    measured are not. Nor is what moved the table before the record: nobody measured it. No prediction from u and the
    measured floor can do better, but by modelling the traces.
    """
    plant = build_plant(replace(case, traces=()))
    plant.noise_V, plant.jitter_s, plant.digital = np.zeros(6), 0.0, []
    plant.floor_factor = plant.floor_factor if case.floor_recorded else 0.0
    return [
        np.asarray(_record(case, plant, number, start, unseen, from_rest=True).y)
        for number, start in enumerate(_starts_of(case, unseen))
    ]


def _starts_of(case: Case, unseen: bool) -> tuple[float, ...]:
    return _starts(_rng(case.seed, _PAUSES), 6, case.duration_s) if unseen else case.starts_s


def simulate_case(case: Case, unseen: bool = False) -> Campaign:
    """The campaign of a case.

    unseen : another campaign of the same table: other voltages of the same kind and levels, other floor and noise,
    other pauses. Whatever drifts starts again from its beginning.
    """
    plant = build_plant(case)
    records = tuple(
        _record(case, plant, number, start, unseen) for number, start in enumerate(_starts_of(case, unseen))
    )
    return Campaign("avis", records, source=f"truth, seed {case.seed}")


def channel_change(case: Case) -> np.ndarray:
    """(6,) r.m.s. over all records of what the effects change in each channel, over that channel's noise.

    Noise: what the undriven table without effects shows beyond a measured floor: sensor noise and rounding, and the
    ambient motion if the floor is not recorded. A table with a shift that re-identification absorbs counts fully.
    """
    bare = build_plant(replace(case, effects=()))
    full = build_plant(case)
    power = np.zeros(6)
    for number, start in enumerate(case.starts_s):
        power += np.mean(
            (_record(case, full, number, start, False).y - _record(case, bare, number, start, False).y) ** 2, axis=0
        )
    rest = _record(case, bare, 0, case.starts_s[0], False, driven=False).y
    if case.floor_recorded:
        _, floor, before = _signals(case, 0, False)
        rest = rest - run(bare, np.zeros((len(rest), 8)), floor, before, case.starts_s[0], _rng(case.seed, _HOOKS))[0]
    return np.sqrt(power / len(case.starts_s)) / rest.std(axis=0)


def relative_change(case: Case, effect: str | None = None) -> float:
    """The largest of channel_change, of all effects together or of one alone.

    Below 1 the effect hides in the noise of single samples; averaging over a campaign still may show it. Zero where
    there is no effect.
    """
    effects: tuple[Any, ...] = tuple(h for h in case.effects if effect is None or h.name == effect)
    return float(channel_change(replace(case, effects=effects)).max()) if effects else 0.0
