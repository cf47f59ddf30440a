"""Campaigns in .mat files: the struct array `records`, or the flat variables of one record.

What a flat file may leave out, a record may leave out, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, RecordSource
from avis_ctrl.measurement.formats.common import as_text, require_small, within
from avis_ctrl.measurement.formats.hdf5 import FORMAT, VERSION, check_version
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
from avis_ctrl.measurement.formats.records import UNNAMED, Hints, Mapped, Part, mapped, one_clock, pick, record_from
from avis_ctrl.measurement.formats.stored import Columns

# What may stand beside `records` for all of them.
SHARED = ("u_names", "y_names", "u_unit", "y_unit", "floor_unit", *USUAL["sample_rate_Hz"], *PERIODS)


def campaign(path: Path, tree: Mapping[str, Any], columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign:
    """The campaign of a tree that has `records`.

    columns : u_names, y_names at most: variables beside `records`, or the names themselves; hints hold for every
    record, start_s for the first.

    Raises
    ------
    InputError : everything that is missing, of all records, in one line; a field that is wrong, with its record.
    """
    check_version(tree.get("format", FORMAT), plain(tree.get("version", VERSION)))
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
        end = built[-1].header.start_s + built[-1].header.duration_s if built else None
        with within(f"record {name}"):
            own = _own_hints(hints if not built else replace(hints, start_s=None), fields)
            record, assumed = _record(path, name, {**tree, **fields}, fields, columns, own, end)
        built.append(record)
        notes += assumed
    harmonised, assumed = one_clock(built)
    return Campaign(_rig(rig, tree), harmonised, str(path), (*notes, *assumed))


def flat_campaign(path: Path, tree: Mapping[str, Any], columns: Mapped | None, rig: str | None,
                  hints: Hints) -> Campaign:
    """The campaign of one record whose fields are the variables of the file; columns : which variable is what."""
    record, notes = _record(path, "00", tree, tree, columns, with_stated(hints, tree), None)
    return Campaign(_rig(rig, tree), (record,), str(path), tuple(notes))


def _rig(rig: str | None, tree: Mapping[str, Any]) -> str:
    return rig or (UNNAMED if empty(tree.get("rig")) else as_text(tree["rig"], "rig"))


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
        with within(f"record {name}"):
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
        words = [what if len(names) == len(records) else f"{what} (record{'s' if len(names) > 1 else ''} "
                 f"{', '.join(names)})" for what, names in missing.items()]
        held = overview({key: 0 for fields in records.values() for key in fields})
        raise InputError(f"missing: {'; '.join(words)}; the records have {held}", field="records")


def _own_hints(hints: Hints, fields: Mapping[str, Any]) -> Hints:
    """Hints completed by the record; a period that the caller gives is that of the multisines."""
    stated = with_stated(replace(hints, period_s=None), fields)
    given = hints.period_s if stated.excitation in (None, "multisine") else None
    return replace(stated, period_s=stated.period_s if given is None else given)


def _record(path: Path, name: str, tree: Mapping[str, Any], fields: Mapping[str, Any], columns: Mapped | None,
            hints: Hints, end_s: float | None) -> tuple[RecordSource, list[str]]:
    """A record, on disk where the file is v7.3 and each role has one variable, in memory otherwise.

    tree : where names of channels are looked up; end_s : of the record before, None for the first.
    """
    notes, chosen = [], _chosen(fields, columns)
    flat = fields is tree
    for role in ("u", "y"):
        if not chosen[role] and (role == "y" or hints.excitation not in ("rest", "floor")):
            raise InputError(f"which variable is it? The file has {overview(fields)}; say with columns (such as "
                             "u=vir, y=qm, t=t)", field=role)
    matrices = {role: [matrix(fields[variable], variable) for variable in chosen[role]]
                for role in ("u", "y", "floor") if chosen[role] or role == "u"}
    rate, start, note, known = clock(fields, chosen, hints)
    notes += [note] if note else []
    if not chosen["sample_rate_Hz"] and hints.sample_rate_Hz is None and chosen["t"]:
        notes.append(f"sample rate not stated; {rate:.9g} Hz by {chosen['t'][0]}")
    stated = _stated_names(matrices, chosen, tree)
    samples = sample_count(matrices, {role: len(names) for role, names in stated.items() if len(matrices[role]) == 1},
                           known)
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
            # Variables of one channel give their own names; the columns of a matrix are numbered.
            names = tuple(variable if flat and count == 1 else f"{variable if flat else role}{i + 1}"
                          for variable, count in zip(chosen[role], counts, strict=True) for i in range(count))
            notes += [] if flat else [f"{role}_names not stated; numbered {names[0]} to {names[-1]}"]
        elif len(names) != sum(counts):
            raise InputError(f"expected {sum(counts)} names, one per channel; there are {len(names)}",
                             field=f"{role}_names", value=names)
        label = plain(fields.get(f"{role}_unit"))
        place = Columns(str(items[0].dataset), samples, items[0].shape[0] == samples) if stored else np.hstack(
            [np.zeros((samples, 0)), *(oriented(item, samples, role) for item in items)])
        parts[role] = Part(names, None if empty(label) else label, place)
    record, assumed = record_from(name, parts, rate, start, hints, str(path) if stored else "")
    return record, [*(f"record {name}: {note}" for note in notes), *assumed]


def _chosen(fields: Mapping[str, Any], columns: Mapped | None) -> dict[str, list[str]]:
    """Variables of each role, as the caller mapped them or as they are usually called."""
    chosen = {}
    for role in USUAL:
        names = mapped(columns, role)
        if names is None:
            names = usual(fields, role)
        elif not role.endswith("_names"):  # those may be the names themselves
            pick(names, list(fields), role)
        chosen[role] = names
    return chosen


def _stated_names(matrices: Mapping[str, Sequence[Matrix]], chosen: Mapping[str, list[str]],
                  tree: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Names of the channels of each role, where somebody states them."""
    stated: dict[str, tuple[str, ...]] = {"floor": FLOOR_NAMES} if "floor" in matrices else {}
    for role in ("u", "y"):
        items = matrices[role]
        if items and (given := chosen[f"{role}_names"]):
            one = len(items) == 1 and 1 in items[0].shape
            stated[role] = stated_names(given, tree, f"{role}_names", 1 if one else None)
    return stated
