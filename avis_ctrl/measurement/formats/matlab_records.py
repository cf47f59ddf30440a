"""Struct array `records` of a .mat file: a campaign. What a flat file may leave out, a record may leave out, too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, Record, RecordSource, ranges
from avis_ctrl.measurement.formats.common import as_names, as_number, as_text, require_finite, units_of
from avis_ctrl.measurement.formats.flat import UNNAMED, Hints, Mapped, flat_header, mapped, one_clock, root_mean_square
from avis_ctrl.measurement.formats.hdf5 import FORMAT, VERSION
from avis_ctrl.measurement.formats.matlab_shapes import (
    PERIODS,
    USUAL,
    clock,
    empty,
    matrix,
    oriented,
    plain,
    sample_count,
    stated_names,
    usual,
    with_stated,
)
from avis_ctrl.measurement.formats.matlab_tree import Matrix, describe, overview
from avis_ctrl.measurement.formats.stored import Columns, StoredRecord, open_hdf5

# What may stand beside `records` for all of them.
SHARED = ("u_names", "y_names", "u_unit", "y_unit", "floor_unit", *USUAL["sample_rate_Hz"], *PERIODS)
PIECE = 1 << 18  # samples of u that are looked at together


def campaign(path: Path, tree: Mapping[str, Any], columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign:
    """The campaign of a tree that has `records`.

    columns : u_names, y_names at most: variables beside `records`, or the names themselves; hints hold for every
    record, start_s for the first.

    Raises
    ------
    InputError : everything that is missing, of all records, in one line; a field that is wrong, with its record.
    """
    _check_version(tree)
    records = _structs(tree)
    names = [as_text(record["name"], f"records({i + 1}).name") if not empty(record.get("name")) else f"{i:02d}"
             for i, record in enumerate(records)]
    for name in names:
        if names.count(name) > 1:
            raise InputError("expected different names of records", field="records: name", value=name)
    beside = {key: tree[key] for key in SHARED if not empty(tree.get(key))}
    complete = [beside | {key: value for key, value in record.items() if not empty(value)} for record in records]
    _require(dict(zip(names, complete, strict=True)), hints)
    built: list[RecordSource] = []
    notes = [] if rig or not empty(tree.get("rig")) else [f"rig not stated; taken as {UNNAMED!r}"]
    for name, fields in zip(names, complete, strict=True):
        with _within(f"record {name}"):
            naming = {role: given for role in ("u", "y") if (given := mapped(columns, f"{role}_names"))}
            end = built[-1].header.start_s + built[-1].header.duration_s if built else None
            own = hints if not built else replace(hints, start_s=None)
            record, assumed = _record(path, name, {**tree, **fields}, fields, naming, own, end)
        built.append(record)
        notes += assumed
    harmonised, assumed = one_clock(built)
    stated = rig or (UNNAMED if empty(tree.get("rig")) else as_text(tree["rig"], "rig"))
    return Campaign(stated, harmonised, str(path), (*notes, *assumed))


def _check_version(tree: Mapping[str, Any]) -> None:
    stated = as_text(tree.get("format", FORMAT), "format")
    if stated != FORMAT:
        raise InputError(f"expected {FORMAT!r}", field="format", value=stated)
    if "version" in tree and (version := as_number(plain(tree["version"]), "version")) != VERSION:
        raise InputError(f"expected {VERSION}, the version that this release reads", field="version", value=version)


def _structs(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    records = tree["records"]
    records = [records] if isinstance(records, dict) else records
    if not isinstance(records, list) or not records or not all(isinstance(record, dict) for record in records):
        raise InputError("expected a struct array or a cell array of structs", field="records",
                         value=describe(tree["records"]))
    return records


def _require(records: Mapping[str, Mapping[str, Any]], hints: Hints) -> None:
    """Refuse what no reader can assume: all of it at once, so that one look at the file mends it."""
    missing: dict[str, list[str]] = {}
    for name, fields in records.items():
        excitation = hints.excitation or (fields.get("excitation") if isinstance(fields.get("excitation"), str) else "")
        with _within(f"record {name}"):
            period = with_stated(hints, {"period_s": fields.get("period_s")}).period_s
        timed = hints.sample_rate_Hz or any(key in fields for key in (*USUAL["t"], *USUAL["sample_rate_Hz"], *PERIODS))
        for what, there in (("u, the voltages played (zeros at rest)", usual(fields, "u")),
                            ("y, what the sensors gave", usual(fields, "y")),
                            ("sample_rate_Hz, fs or a time vector t", timed),
                            ("period_s, the period in s of a multisine (not 0 or NaN)",
                             period or excitation != "multisine")):
            if not there:
                missing.setdefault(what, []).append(name)
    if missing:
        everywhere = len(records)
        words = [what if len(names) == everywhere else f"{what} (record{'s' if len(names) > 1 else ''} "
                 f"{', '.join(names)})" for what, names in missing.items()]
        held = overview({key: 0 for fields in records.values() for key in fields})
        raise InputError(f"missing: {'; '.join(words)}; the records have {held}", field="records")


@contextmanager
def _within(where: str) -> Iterator[None]:
    """Refusals inside name the record."""
    try:
        yield
    except InputError as error:
        if error.file is not None or (error.field or "").startswith(where):
            raise
        raise InputError(error.expected, field=f"{where}: {error.field}" if error.field else where,
                         value=error.value) from None


def _record(path: Path, name: str, tree: Mapping[str, Any], fields: Mapping[str, Any], naming: Mapping[str, list[str]],
            hints: Hints, end_s: float | None) -> tuple[RecordSource, list[str]]:
    """A record, on disk where the file is v7.3, in memory otherwise.

    tree : where the names that the caller gives are looked up; end_s : of the record before, None for the first.
    """
    where, notes = f"record {name}", []
    chosen = {role: usual(fields, role) for role in USUAL}
    matrices = {role: matrix(fields[chosen[role][0]], role) for role in ("u", "y", "floor") if chosen[role]}
    rate, start, note, known = clock(fields, chosen, hints)
    notes += [f"{where}: {note}"] if note else []
    if not chosen["sample_rate_Hz"] and hints.sample_rate_Hz is None and chosen["t"]:
        notes.append(f"{where}: sample rate not stated; {rate:.9g} Hz by {chosen['t'][0]}")
    channels = _channels(matrices, tree, fields, naming)
    samples = sample_count({role: [item] for role, item in matrices.items()}, where,
                           {role: len(some) for role, some in channels.items()}, known)
    for role, item in matrices.items():
        if role not in channels:
            count = item.shape[1] if item.shape[0] == samples else item.shape[0]
            channels[role] = tuple(f"{role}{i + 1}" for i in range(count))
            notes.append(f"{where}: {role}_names not stated; numbered {role}1 to {role}{count}")
    units, factors = {}, {}
    for role in matrices:
        label: Any = {"u": hints.u_unit, "y": hints.y_unit}.get(role) or plain(fields.get(f"{role}_unit"))
        if label is None:
            label = "m/s" if role == "floor" else "V"
            notes.append(f"{where}: {role}_unit not stated; taken as {label}")
        units[role], factors[role] = units_of(label, role, where, len(channels[role]))
    hints = _own_hints(hints, fields)
    if hints.start_s is None and end_s is not None and (not chosen["t"] or start < end_s):
        start = end_s
        notes.append(f"{where}: start_s not stated; it follows the record before it")
    if all(item.dataset for item in matrices.values()):
        places = {role: (Columns(str(item.dataset), factors[role], channels_first=item.shape[0] == samples),)
                  for role, item in matrices.items()}
        rms = _stored_rms(path, places["u"][0], channels["u"], samples, hints)
        header, assumed = flat_header(name, samples, rate, start, channels, units, rms, hints)
        return StoredRecord(header, str(path), places), notes + assumed
    arrays = {}
    for role, item in matrices.items():
        arrays[role] = oriented(item, samples, role) * np.array(factors[role])
        require_finite(arrays[role], channels[role], role)
    header, assumed = flat_header(name, samples, rate, start, channels, units, root_mean_square(arrays["u"]), hints)
    return Record(header, arrays["u"], arrays["y"], arrays.get("floor")), notes + assumed


def _channels(matrices: Mapping[str, Matrix], tree: Mapping[str, Any], fields: Mapping[str, Any],
              naming: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Names of the channels of each role, where somebody states them."""
    channels: dict[str, tuple[str, ...]] = {}
    for role, item in matrices.items():
        count = 1 if 1 in item.shape else None
        if role == "floor":
            channels[role] = FLOOR_NAMES
        elif role in naming:
            channels[role] = stated_names(naming[role], tree, f"{role}_names", count)
        elif f"{role}_names" in fields:
            channels[role] = as_names(plain(fields[f"{role}_names"]), f"{role}_names", count)
    return channels


def _own_hints(hints: Hints, fields: Mapping[str, Any]) -> Hints:
    """Hints completed by the record; a period that the caller gives is that of the multisines."""
    stated = with_stated(replace(hints, period_s=None), fields)
    given = hints.period_s if stated.excitation in (None, "multisine") else None
    return replace(stated, period_s=stated.period_s if given is None else given)


def _stored_rms(path: Path, place: Columns, names: Sequence[str], samples: int, hints: Hints) -> float | None:
    """R.m.s. of u on disk, piece by piece; None where nobody asks for it."""
    if hints.level_V is not None and (hints.excitation is not None or hints.period_s is not None):
        return None
    total = 0.0
    with open_hdf5(path) as file:
        for start, stop in ranges(samples, PIECE):
            u = place.rows(file, start, stop)
            require_finite(u, names, "u", start)
            total = float(np.hypot(total, root_mean_square(u) * np.sqrt((stop - start) / samples)))
    return total
