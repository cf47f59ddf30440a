"""Campaigns in .mat files: the struct array `records`, or the flat variables of one record.

Fields that are optional in a flat file are also optional in a record.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, RecordSource
from avis_ctrl.measurement.formats.common import as_names, as_number, as_text, numbers, require_small, within
from avis_ctrl.measurement.formats.hdf5 import FORMAT, VERSION, check_version
from avis_ctrl.measurement.formats.matlab_tree import Matrix, Unreadable, describe, overview
from avis_ctrl.measurement.formats.records import UNNAMED, Hints, Mapped, Part, campaign_from, mapped, pick, record_from
from avis_ctrl.measurement.formats.stored import Columns
from avis_ctrl.measurement.formats.time_axis import agreed_rate, sample_rate_from


@dataclass(frozen=True)
class MatlabSettings:
    """much_longer : minimum ratio of samples to channels if no names distinguish them [1]: an array closer to a square
    can be read either way.
    """

    much_longer: float = 10.0


SETTINGS = MatlabSettings()
USUAL = {
    "u": ("u", "U", "input"),
    "y": ("y", "Y", "output"),
    "t": ("t", "time"),
    "floor": ("floor",),
    "sample_rate_Hz": ("sample_rate_Hz", "fs", "Fs", "FS"),
    "u_names": ("u_names",),
    "y_names": ("y_names",),
}
PERIODS = ("Ts", "dt")
# Variables next to `records` that apply to all of them.
SHARED = ("u_names", "y_names", "u_unit", "y_unit", "floor_unit", *USUAL["sample_rate_Hz"], *PERIODS)


def campaign(path: Path, tree: Mapping[str, Any], columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign:
    """The campaign of a tree with `records`.

    columns : only u_names and y_names: variables next to `records`, or the names themselves; hints apply to every
    record, start_s to the first.

    Raises
    ------
    InputError : everything that is missing in any record, in one line; a wrong field, with its record.
    """
    check_version(tree.get("format", FORMAT), _plain(tree.get("version", VERSION)))
    records = _structs(tree)
    names = [
        as_text(record["name"], f"records({i + 1}).name") if not _empty(record.get("name")) else f"{i:02d}"
        for i, record in enumerate(records)
    ]
    for name in names:
        if names.count(name) > 1:
            raise InputError("expected different names of records", field="records: name", value=name)
    beside = {key: tree[key] for key in SHARED if not _empty(tree.get(key))}
    complete = [beside | {key: value for key, value in record.items() if not _empty(value)} for record in records]
    _require(dict(zip(names, complete, strict=True)), hints)
    built: list[RecordSource] = []
    notes = [] if rig or not _empty(tree.get("rig")) else [f"rig not stated; taken as {UNNAMED!r}"]
    for name, fields in zip(names, complete, strict=True):
        end = built[-1].header.start_s + built[-1].header.duration_s if built else None
        with within(f"record {name}"):
            own = _own_hints(hints if not built else replace(hints, start_s=None), fields)
            record, assumed = _record(path, name, {**tree, **fields}, fields, columns, own, end)
        built.append(record)
        notes += assumed
    return campaign_from(built, notes, _rig(rig, tree), path)


def flat_campaign(
    path: Path, tree: Mapping[str, Any], columns: Mapped | None, rig: str | None, hints: Hints
) -> Campaign:
    """Campaign of one record, whose fields are the variables of the file; columns : roles to variables."""
    record, notes = _record(path, "00", tree, tree, columns, _with_stated(hints, tree), None)
    return Campaign(_rig(rig, tree), (record,), str(path), tuple(notes))


def _rig(rig: str | None, tree: Mapping[str, Any]) -> str:
    return rig or (UNNAMED if _empty(tree.get("rig")) else as_text(tree["rig"], "rig"))


def _structs(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    records = tree["records"]
    records = [records] if isinstance(records, dict) else records
    if not isinstance(records, list) or not records or not all(isinstance(record, dict) for record in records):
        found = describe(tree["records"])
        raise InputError("expected a struct array or a cell array of structs", field="records", value=found)
    return records


def _require(records: Mapping[str, Mapping[str, Any]], hints: Hints) -> None:
    """Raise InputError for fields that cannot be assumed, all in one message so that the file can be repaired
    at once."""
    missing: dict[str, list[str]] = {}
    for name, fields in records.items():
        excitation = hints.excitation or (fields.get("excitation") if isinstance(fields.get("excitation"), str) else "")
        with within(f"record {name}"):
            period = _with_stated(hints, {"period_s": fields.get("period_s")}).period_s
        timed = hints.sample_rate_Hz or any(key in fields for key in (*USUAL["t"], *USUAL["sample_rate_Hz"], *PERIODS))
        for what, there in (
            ("u, the commanded voltages (zeros at rest)", _usual(fields, "u")),
            ("y, the sensor signals", _usual(fields, "y")),
            ("sample_rate_Hz, fs or a time vector t", timed),
            ("period_s, the period in s of a multisine (not 0 or NaN)", period or excitation != "multisine"),
        ):
            if not there:
                missing.setdefault(what, []).append(name)
    if missing:
        words = [
            what if len(names) == len(records) else f"{what} (record{'s' if len(names) > 1 else ''} {', '.join(names)})"
            for what, names in missing.items()
        ]
        held = overview({key: 0 for fields in records.values() for key in fields})
        raise InputError(f"missing: {'; '.join(words)}; the records have {held}", field="records")


def _own_hints(hints: Hints, fields: Mapping[str, Any]) -> Hints:
    """Hints completed with the record's fields; a period given by the caller applies to multisines."""
    stated = _with_stated(replace(hints, period_s=None), fields)
    given = hints.period_s if stated.excitation in (None, "multisine") else None
    return replace(stated, period_s=stated.period_s if given is None else given)


def _record(
    path: Path,
    name: str,
    tree: Mapping[str, Any],
    fields: Mapping[str, Any],
    columns: Mapped | None,
    hints: Hints,
    end_s: float | None,
) -> tuple[RecordSource, list[str]]:
    """A record, on disk if the file is v7.3 and each role has one variable, otherwise in memory.

    tree : where names of channels are looked up; end_s : end of the previous record, None for the first.
    """
    notes, chosen = [], _chosen(fields, columns)
    flat = fields is tree
    for role in ("u", "y"):
        if not chosen[role] and (role == "y" or hints.excitation not in ("rest", "floor")):
            message = (
                f"no variable has a usual name; the file has {overview(fields)}; assign the variables with columns "
                "(such as u=vir, y=qm, t=t)"
            )
            raise InputError(message, field=role)
    matrices = {
        role: [_matrix(fields[variable], variable) for variable in chosen[role]]
        for role in ("u", "y", "floor")
        if chosen[role] or role == "u"
    }
    rate, start, note, known = _clock(fields, chosen, hints)
    notes += [note] if note else []
    if not chosen["sample_rate_Hz"] and hints.sample_rate_Hz is None and chosen["t"]:
        notes.append(f"sample rate not stated; {rate:.9g} Hz by {chosen['t'][0]}")
    stated = _stated_names(matrices, chosen, tree)
    channels = {role: len(names) for role, names in stated.items() if len(matrices[role]) == 1}
    samples = _sample_count(matrices, channels, known)
    if hints.start_s is None and end_s is not None and (not chosen["t"] or start < end_s):
        start = end_s
        notes.append("start_s not stated; it follows the record before it")
    stored = all(len(items) == 1 and items[0].dataset for items in matrices.values())
    if not stored:
        require_small(path, 8 * sum(math.prod(item.shape) for items in matrices.values() for item in items))
    parts = {}
    for role, items in matrices.items():
        counts = [math.prod(item.shape) // samples for item in items]
        names = stated.get(role)
        if names is None:
            # Variables with one channel give their names to the channels; the columns of a matrix are numbered.
            names = tuple(
                variable if flat and count == 1 else f"{variable if flat else role}{i + 1}"
                for variable, count in zip(chosen[role], counts, strict=True)
                for i in range(count)
            )
            notes += [] if flat else [f"{role}_names not stated; numbered {names[0]} to {names[-1]}"]
        elif len(names) != sum(counts):
            message = f"expected {sum(counts)} names, one per channel; there are {len(names)}"
            raise InputError(message, field=f"{role}_names", value=names)
        label = _plain(fields.get(f"{role}_unit"))
        if stored:
            place: Columns | np.ndarray = Columns(str(items[0].dataset), samples, items[0].shape[0] == samples)
        else:
            place = np.hstack([np.zeros((samples, 0)), *(_oriented(item, samples, role) for item in items)])
        parts[role] = Part(names, None if _empty(label) else label, place)
    record, assumed = record_from(name, parts, rate, start, hints, str(path) if stored else "")
    return record, [*(f"record {name}: {note}" for note in notes), *assumed]


def _chosen(fields: Mapping[str, Any], columns: Mapped | None) -> dict[str, list[str]]:
    """Variables of each role, from the caller's mapping or by their usual names."""
    chosen = {}
    for role in USUAL:
        names = mapped(columns, role)
        if names is None:
            names = _usual(fields, role)
        elif not role.endswith("_names"):  # may be the names themselves
            pick(names, list(fields), role)
        chosen[role] = names
    return chosen


def _stated_names(
    matrices: Mapping[str, Sequence[Matrix]], chosen: Mapping[str, list[str]], tree: Mapping[str, Any]
) -> dict[str, tuple[str, ...]]:
    """Names of the channels of each role, if stated."""
    stated: dict[str, tuple[str, ...]] = {"floor": FLOOR_NAMES} if "floor" in matrices else {}
    for role in ("u", "y"):
        items = matrices[role]
        if items and (given := chosen[f"{role}_names"]):
            one = len(items) == 1 and 1 in items[0].shape
            stated[role] = _names(given, tree, f"{role}_names", 1 if one else None)
    return stated


def _plain(value: Any) -> Any:
    """A small matrix as an array."""
    return value.read() if isinstance(value, Matrix) and math.prod(value.shape) <= 1000 else value


def _empty(value: Any) -> bool:
    """Whether a value is None, or an empty array, cell array or text, as struct arrays store absent fields."""
    if isinstance(value, Matrix):
        return 0 in value.shape
    return value is None or (isinstance(value, (list, str)) and not value)


def _usual(tree: Mapping[str, Any], role: str) -> list[str]:
    """The variable or field with a usual name of a role, if there is one."""
    return [name for name in USUAL[role] if not _empty(tree.get(name))][:1]


def _matrix(value: Any, field: str) -> Matrix:
    """The value as a real matrix with samples; otherwise an InputError that describes it."""
    if not isinstance(value, Matrix) or value.kind not in "fiu" or len(value.shape) != 2:
        words = f"a {value.kind}" if isinstance(value, Unreadable) else describe(value)
        raise InputError("expected a real matrix, samples by channels", field=field, value=words)
    if 0 in value.shape:
        raise InputError("expected samples, found an empty array", field=field)
    return value


def _sample_count(
    matrices: Mapping[str, Sequence[Matrix]], channels: Mapping[str, int], known: int | None = None
) -> int:
    """Number of samples common to all matrices, in either orientation.

    channels : number of channels of a role, if known from names; known : length of the time vector.

    Raises
    ------
    InputError : no common length; square matrices; rows and columns that could both be the samples.
    """
    shapes = {role: [item.shape for item in items] for role, items in matrices.items()}
    shown = ", ".join(
        f"{role} is {' and '.join('x'.join(map(str, shape)) for shape in some)}" for role, some in shapes.items()
    )
    possible = None if known is None else {known}
    for role, some in shapes.items():
        for rows, columns in some:
            lengths = {rows, columns} if min(rows, columns) > 1 else {max(rows, columns)}
            if role in channels:
                lengths = {length for length, others in ((rows, columns), (columns, rows)) if others == channels[role]}
                if not lengths:
                    message = f"expected {channels[role]} channels, as many as names; it is {rows}x{columns}"
                    raise InputError(message, field=role)
            possible = lengths if possible is None else possible & lengths
    if not possible:
        also = "" if known is None else f", t has {known}"
        raise InputError(f"expected equally many samples; {shown}{also}")
    samples = max(possible)
    square = any(rows == columns and rows > 1 for some in shapes.values() for rows, columns in some)
    if square or (len(possible) > 1 and samples < SETTINGS.much_longer * min(possible)):
        raise InputError(
            f"rows and columns could both be the samples: {shown}; expected channel names or a time "
            "vector, which distinguish them"
        )
    return samples


def _oriented(item: Matrix, samples: int, field: str) -> np.ndarray:
    """(samples, channels) float64."""
    array = numbers(item.read(), field)
    return array if array.shape[0] == samples else array.T


def _with_stated(hints: Hints, tree: Mapping[str, Any]) -> Hints:
    """Hints completed with variables or fields of the same names."""
    names = [name for name in ("level_V", "start_s", "period_s", "excitation") if not _empty(tree.get(name))]
    return hints.completed({name: _plain(tree[name]) for name in names})


def _names(value: Sequence[str], tree: Mapping[str, Any], field: str, count: int | None) -> tuple[str, ...]:
    """Channel names from a variable with this name, or the names themselves if the caller gave them instead."""
    if len(value) == 1 and value[0] in tree:
        return as_names(_plain(tree[value[0]]), field, count)
    if len(value) == 1 and count is None:
        message = f"neither a variable nor a list of channel names (A+B+...); the file has {overview(tree)}"
        raise InputError(message, field=field, value=value[0])
    return as_names(list(value), field, count)


def _clock(
    tree: Mapping[str, Any], chosen: Mapping[str, list[str]], hints: Hints
) -> tuple[float, float, str, int | None]:
    """Sample rate [Hz], first time [s], note, number of samples (None without a time vector)."""
    start, note, known, rate = 0.0, "", None, None
    if chosen["t"]:
        name = chosen["t"][0]
        times = _matrix(tree[name], name)
        if 1 not in times.shape:
            raise InputError("expected a vector of time stamps in s", field=name, value=describe(times))
        rate, start, note = sample_rate_from(numbers(times.read(), name).reshape(-1), field=name)
        known = max(times.shape)
    stated, source = hints.sample_rate_Hz, "hint sample_rate_Hz"
    if stated is None and chosen["sample_rate_Hz"]:
        source = chosen["sample_rate_Hz"][0]
        stated = as_number(_plain(tree[source]), source)
    for name in PERIODS:
        if stated is None and rate is None and name in tree:
            source, period = name, as_number(_plain(tree[name]), name)
            if period <= 0:
                raise InputError("expected a positive sampling period in s", field=name, value=period)
            stated = 1 / period
    if stated is not None:
        rate = stated if rate is None else agreed_rate(stated, rate, source)
    if rate is None:
        raise InputError(f"expected t, fs or sample_rate_Hz; the file has {overview(tree)}", field="sample rate")
    return rate, start, note, known
