"""Records from flat columns (CSV, MATLAB variables, UFF functions): which column is what, and what nobody stated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import EXCITATIONS, FLOOR_NAMES, Record, RecordHeader, RecordSource
from avis_ctrl.measurement.formats.common import as_number, as_text, numbers, require_finite, unit_of, units_of

ROLES = ("t", "u", "y", "floor", "sample_rate_Hz", "u_names", "y_names")
UNNAMED = "unnamed"  # rig of a campaign whose file does not say
SAME_RATE = 1e-6  # relative difference below which two records' time stamps mean one clock

Mapped = Mapping[str, Any]


@dataclass(frozen=True)
class Hints:
    """What the caller knows and the file may not say; a hint that is given overrides the file.

    u_unit, y_unit : unit in which the file's numbers are; averages, relative_standard_deviation : of frequency
    responses, see `response_from`.
    """

    sample_rate_Hz: float | None = None
    excitation: str | None = None
    level_V: float | None = None
    start_s: float | None = None
    period_s: float | None = None
    u_unit: str | None = None
    y_unit: str | None = None
    averages: float | None = None
    relative_standard_deviation: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            if field.name in ("excitation", "u_unit", "y_unit"):
                as_text(value, field.name)
            else:
                as_number(value, field.name)
        if self.excitation is not None and self.excitation not in EXCITATIONS:
            raise InputError(f"expected one of {', '.join(EXCITATIONS)}", field="excitation", value=self.excitation)


def hints_from(given: Mapping[str, Any]) -> Hints:
    """Hints by name.

    Raises
    ------
    InputError : an unknown name, a value of the wrong kind.
    """
    known = [field.name for field in fields(Hints)]
    for name in given:
        if name not in known:
            raise InputError(f"expected one of {', '.join(known)}", field="hint", value=name)
    return Hints(**given)


def mapped(columns: Mapped | None, role: str) -> list[str] | None:
    """Names that a mapping gives a role; None where it does not speak of it.

    Raises
    ------
    InputError : roles that do not exist, names that are no text.
    """
    if columns is None:
        return None
    for key in columns:
        if key not in ROLES:
            raise InputError(f"expected the roles {', '.join(ROLES)}", field="columns", value=key)
    names = columns.get(role)
    if names is None:
        return None
    names = [names] if isinstance(names, str) else list(names)
    if not names or not all(isinstance(name, str) and name for name in names):
        raise InputError("expected a name or a list of names", field=f"columns: {role}", value=names)
    if len(set(names)) != len(names):
        raise InputError("expected different names", field=f"columns: {role}", value=names)
    return names


def pick(names: Sequence[str], available: Sequence[str], role: str) -> None:
    """Refuse names that are not there."""
    for name in names:
        if name not in available:
            raise InputError(f"not there; the file has {', '.join(available) or 'nothing'}", field=f"columns: {role}",
                             value=name)


def flat_header(name: str, samples: int, rate_Hz: float, start_s: float, channels: Mapping[str, tuple[str, ...]],
                units: Mapping[str, str], rms: float | None, hints: Hints) -> tuple[RecordHeader, list[str]]:
    """Header of a record of which the file says little, and a note for each assumption.

    rms : of u, from which level and rest are told; None where there is no input.
    """
    notes = []
    excitation, period = hints.excitation, hints.period_s
    if excitation is None:
        excitation = "multisine" if period is not None else "noise" if rms else "rest"
        why = {"multisine": "there is a period", "rest": "u is zero", "noise": "u is not zero and no period is stated"}
        notes.append(f"record {name}: excitation not stated; taken as {excitation!r}: {why[excitation]}")
    if excitation == "multisine" and period is None:
        raise InputError("missing; expected the period in s of a multisine", field=f"record {name}: period_s")
    level = hints.level_V
    if level is None:
        level = rms or 0.0
        if rms is not None:
            notes.append(f"record {name}: level_V not stated; taken as the r.m.s. of u, {level:.4g}")
    header = RecordHeader(name, rate_Hz, samples, channels["u"], channels["y"], excitation, level,
                          start_s if hints.start_s is None else hints.start_s, period, units["u"], units["y"],
                          channels.get("floor", ()), units.get("floor", "m/s"))
    return header, notes


def root_mean_square(u: np.ndarray) -> float:
    """Scaled by a power of two, so that no square overflows."""
    exponent = np.frexp(np.max(np.abs(u)))[1]
    return float(np.ldexp(np.sqrt(np.mean(np.square(np.ldexp(u, -exponent)))), exponent))


def flat_units(role: str, labels: Sequence[str | None], hints: Hints, where: str) -> tuple[str, np.ndarray, list[str]]:
    """SI unit, factor of each channel, and notes, from the labels of the channels (None: not stated)."""
    hint = {"u": hints.u_unit, "y": hints.y_unit, "floor": None}[role]
    default = "m/s" if role == "floor" else "V"
    if hint is not None:
        labels = [hint] * len(labels)
    unstated = sum(label is None for label in labels)
    notes = [f"{where}: unit of {role} not stated; taken as {default}"] if unstated else []
    if not labels:
        return unit_of(hint or default, f"{role}_unit").si, np.ones(0), notes
    si, factors = units_of([label or default for label in labels], role, where, len(labels))
    return si, np.array(factors), notes


def flat_record(name: str, parts: Mapping[str, tuple[Sequence[str], Sequence[str | None], np.ndarray]],
                rate_Hz: float, start_s: float, hints: Hints) -> tuple[Record, list[str]]:
    """A record in memory from its columns.

    parts : for u, y and, where measured, floor: channel names, unit labels (None: not stated), (samples, channels).
    """
    where, notes = f"record {name}", []
    channels, units, arrays = {}, {}, {}
    for role, (names, labels, array) in parts.items():
        array = numbers(array, f"{where}: {role}")
        require_finite(array, names, f"{where}: {role}")
        units[role], factors, assumed = flat_units(role, labels, hints, where)
        channels[role], arrays[role] = tuple(names), array * factors
        notes += assumed
    if "floor" in channels:
        if len(channels["floor"]) != 3:
            raise InputError("expected three floor velocities x, y, z", field=f"{where}: floor",
                             value=channels["floor"])
        channels["floor"] = FLOOR_NAMES
    lengths = {role: len(array) for role, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{role} has {count}" for role, count in lengths.items())
        raise InputError(f"expected equally many samples; {text}", field=where)
    if not channels["u"] and hints.excitation not in ("rest", "floor"):
        raise InputError("expected at least one input, a column u or u_...; where it has another name, columns says so "
                         "(u=NAME); only a record with excitation 'rest' or 'floor' has none",
                         field=f"{where}: u")
    rms = root_mean_square(arrays["u"]) if arrays["u"].size else None
    header, assumed = flat_header(name, lengths["y"], rate_Hz, start_s, channels, units, rms, hints)
    return Record(header, arrays["u"], arrays["y"], arrays.get("floor")), notes + assumed


def with_header(record: RecordSource, **changes: Any) -> RecordSource:
    """The record with some fields of its header changed; records of every kind are dataclasses with a header."""
    return replace(record, header=replace(record.header, **changes))  # type: ignore[type-var]


def one_clock(records: Sequence[RecordSource]) -> tuple[tuple[RecordSource, ...], list[str]]:
    """Records whose time stamps leave sample rates that differ by rounding only get the rate of the first."""
    first, notes, result = records[0].header.sample_rate_Hz, [], []
    for record in records:
        rate = record.header.sample_rate_Hz
        if rate != first and abs(rate - first) <= SAME_RATE * first:
            notes.append(f"record {record.header.name}: sample rate {rate:.9g} Hz taken as {first:.9g} Hz")
            record = with_header(record, sample_rate_Hz=first)
        result.append(record)
    return tuple(result), notes
