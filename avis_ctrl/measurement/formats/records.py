"""Records from the contents of a file: the role and unit of each channel, and assumptions for what is not stated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import (
    EXCITATIONS,
    FLOOR_NAMES,
    Campaign,
    Portion,
    Record,
    RecordHeader,
    RecordSource,
    ranges,
)
from avis_ctrl.measurement.formats.common import as_number, as_text, stated_period, unit_of, units_of, within
from avis_ctrl.measurement.formats.stored import Columns, StoredRecord

ROLES = ("t", "u", "y", "floor", "sample_rate_Hz", "u_names", "y_names")
UNNAMED = "unnamed"  # rig of a campaign whose file states none

Mapped = Mapping[str, Any]


@dataclass(frozen=True)
class RecordSettings:
    """same_rate : relative difference of two sample rates below which they are from the same clock [1]: rounding of
        time stamps causes smaller differences, and the quartz clocks of two instruments differ by more.
    piece : samples of u on disk that are loaded at once: 2 MiB for each drive.
    """

    same_rate: float = 1e-6
    piece: int = 1 << 18


SETTINGS = RecordSettings()


@dataclass(frozen=True)
class Hints:
    """What the caller knows and the file may not state; a hint that is given overrides the file.

    u_unit, y_unit : unit of the numbers in the file; averages, relative_standard_deviation : of frequency responses,
    see `stated_response`.
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
            if value is not None:
                (as_text if field.name in ("excitation", "u_unit", "y_unit") else as_number)(value, field.name)
        if self.excitation is not None and self.excitation not in EXCITATIONS:
            raise InputError(f"expected one of {', '.join(EXCITATIONS)}", field="excitation", value=self.excitation)

    def completed(self, stated: Mapping[str, Any]) -> Hints:
        """Hints completed with sample_rate_Hz, excitation, level_V, start_s, period_s as a file states them for a
        record.

        Raises InputError if one of these has the wrong type.
        """
        kinds: dict[str, Any] = {"excitation": as_text, "period_s": stated_period}
        return replace(
            self,
            **{
                field: kinds.get(field, as_number)(value, field)
                for field, value in stated.items()
                if value is not None and getattr(self, field) is None
            },
        )


def hints_from(given: Mapping[str, Any]) -> Hints:
    """Hints by name.

    Raises
    ------
    InputError : an unknown name, a value of the wrong type.
    """
    known = [field.name for field in fields(Hints)]
    for name in given:
        if name not in known:
            raise InputError(f"expected one of {', '.join(known)}", field="hint", value=name)
    return Hints(**given)


def mapped(columns: Mapped | None, role: str) -> list[str] | None:
    """Names that a mapping assigns to a role; None if it does not contain the role.

    Raises
    ------
    InputError : unknown roles, names that are not text.
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
    """Raise InputError for names that are not available."""
    for name in names:
        if name not in available:
            raise InputError(
                f"not found; the file has {', '.join(available) or 'nothing'}", field=f"columns: {role}", value=name
            )


class Part(NamedTuple):
    """Channels of one role.

    unit : label of all channels, or one each; None if not stated. samples : (samples, channels), or their place in an
    HDF5 file.
    """

    names: Sequence[str]
    unit: Any
    samples: np.ndarray | Columns


def record_from(
    name: str, parts: Mapping[str, Part], rate_Hz: float, start_s: float, hints: Hints, path: str = ""
) -> tuple[RecordSource, list[str]]:
    """A record of u, y and, if measured, floor, and a note for each assumption.

    path : HDF5 file in which the samples of all parts stay.

    Raises
    ------
    InputError : parts of different lengths, a unit of another quantity, a missing period, samples that are not finite.
    """
    with within(f"record {name}"):
        record, notes = _record(name, parts, rate_Hz, start_s, hints, path)
    return record, [f"record {name}: {note}" for note in notes]


def _record(
    name: str, parts: Mapping[str, Part], rate_Hz: float, start_s: float, hints: Hints, path: str
) -> tuple[RecordSource, list[str]]:
    channels = {role: tuple(part.names) for role, part in parts.items()}
    if "floor" in channels:
        if len(channels["floor"]) != len(FLOOR_NAMES):
            raise InputError("expected three floor velocities x, y, z", field="floor", value=channels["floor"])
        channels["floor"] = FLOOR_NAMES
    lengths = {role: len(part.samples) for role, part in parts.items()}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{role} has {count}" for role, count in lengths.items())
        raise InputError(f"expected equally many samples; {text}")
    if not channels["u"] and hints.excitation not in ("rest", "floor"):
        raise InputError(
            "expected at least one input, such as a column u or u_...; assign a column of another name "
            "with columns (u=NAME); only records with excitation 'rest' or 'floor' need no input",
            field="u",
        )
    notes: list[str] = []
    units: dict[str, str] = {}
    samples: dict[str, Any] = {}
    for role, part in parts.items():
        units[role], factors, assumed = _units(role, part, hints)
        notes += assumed
        stored = part.samples
        samples[role] = replace(stored, factors=factors) if isinstance(stored, Columns) else stored * np.array(factors)
    excitation, period, level = hints.excitation, hints.period_s, hints.level_V
    stated = level is not None and (excitation is not None or period is not None)
    rms = None if stated or not channels["u"] else _root_mean_square(samples["u"], channels["u"], path)
    if excitation is None:
        excitation = "multisine" if period is not None else "noise" if rms else "rest"
        why = {"multisine": "there is a period", "rest": "u is zero", "noise": "u is not zero and no period is stated"}
        notes.append(f"excitation not stated; taken as {excitation!r}: {why[excitation]}")
    if excitation == "multisine" and period is None:
        raise InputError("missing; expected the period in s of a multisine", field="period_s")
    if level is None:
        level = rms or 0.0
        notes += [] if rms is None else [f"level_V not stated; taken as the r.m.s. of u, {level:.4g}"]
    if level < 0:
        raise InputError("expected 0 or more", field="level_V", value=level)
    start_s = start_s if hints.start_s is None else hints.start_s
    by_role: dict[str, Any] = {f"{role}_names": names for role, names in channels.items()}
    by_role |= {f"{role}_unit": unit for role, unit in units.items()}
    header = RecordHeader(
        name, rate_Hz, lengths["y"], excitation=excitation, level_V=level, start_s=start_s, period_s=period, **by_role
    )
    return StoredRecord(header, path, samples) if path else Record(header, **samples), notes


def _units(role: str, part: Part, hints: Hints) -> tuple[str, tuple[float, ...], list[str]]:
    """SI unit, factor of each channel, and a note if a unit is assumed."""
    stated = {"u": hints.u_unit, "y": hints.y_unit}.get(role) or part.unit
    default, count = "m/s" if role == "floor" else "V", len(part.names)
    if not count:
        return unit_of(stated or default, f"{role}_unit").si, (), []
    labels = list(stated) if isinstance(stated, (list, tuple, np.ndarray)) else [stated]
    notes = [f"unit of {role} not stated; taken as {default}"] if None in labels else []
    return *units_of([default if label is None else label for label in labels], role, count), notes


def _root_mean_square(u: np.ndarray | Columns, names: Sequence[str], path: str) -> float:
    """R.m.s. of samples in memory or on disk, piece by piece."""
    total = 0.0
    for start, stop in ranges(len(u), SETTINGS.piece):
        piece = u.load(path, names, "u", start, stop) if isinstance(u, Columns) else u[start:stop]
        # Scaled by a power of two, so that no square overflows.
        exponent = np.frexp(np.max(np.abs(piece)))[1]
        rms = np.ldexp(np.sqrt(np.mean(np.square(np.ldexp(piece, -exponent)))), exponent)
        total = float(np.hypot(total, rms * np.sqrt(len(piece) / len(u))))
    return total


def with_header(record: RecordSource, **changes: Any) -> RecordSource:
    """The record with changed names, units or rate; records in memory and in files are dataclasses with a header."""
    if isinstance(record, Portion):
        return Portion(with_header(record.whole, **changes), record.start, record.stop)
    return replace(record, header=replace(record.header, **changes))  # type: ignore[type-var]


def campaign_from(records: Sequence[RecordSource], notes: Sequence[str], rig: str, path: Path) -> Campaign:
    """Campaign of a file's records, which get the rate of the first if theirs differ only by the rounding of time
    stamps.
    """
    first, result, notes = records[0].header.sample_rate_Hz, [], [*notes]
    for record in records:
        rate = record.header.sample_rate_Hz
        if rate != first and abs(rate - first) <= SETTINGS.same_rate * first:
            notes.append(f"record {record.header.name}: sample rate {rate:.9g} Hz taken as {first:.9g} Hz")
            record = with_header(record, sample_rate_Hz=first)
        result.append(record)
    return Campaign(rig or UNNAMED, tuple(result), str(path), tuple(notes))
