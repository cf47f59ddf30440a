"""MATLAB .mat files, v5 and v7.3, in two layouts.

Layout A, the contract's: a struct array (or cell array of structs) `records` with the fields sample_rate_Hz,
excitation, level_V, start_s, period_s (empty where not periodic), u, y, floor (optional), u_names, y_names, u_unit,
y_unit, floor_unit; beside it `rig`. Records of v7.3 files stay on disk.

Layout B, flat variables of one record: u, y, t or fs (Fs, sample_rate_Hz) or Ts, optionally floor, u_names, y_names,
u_unit, y_unit, excitation, level_V, period_s, start_s, rig; a mapping of columns says which variable is what.

Rows or columns may be the samples; what cannot be told apart is refused.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, Record, RecordSource
from avis_ctrl.measurement.formats import matlab_v5, matlab_v73
from avis_ctrl.measurement.formats.common import (
    as_names,
    as_number,
    as_text,
    existing_file,
    header_from,
    numbers,
    reading,
    require_finite,
    require_small,
    units_of,
)
from avis_ctrl.measurement.formats.flat import Hints, Mapped, flat_record, mapped, pick
from avis_ctrl.measurement.formats.hdf5 import FORMAT, VERSION
from avis_ctrl.measurement.formats.matlab_response import response
from avis_ctrl.measurement.formats.matlab_tree import Matrix, Unreadable, describe, overview
from avis_ctrl.measurement.formats.stored import Columns, StoredRecord
from avis_ctrl.measurement.formats.time_axis import sample_rate_from
from avis_ctrl.measurement.frequency_response import FrequencyResponse

MUCH_LONGER = 10  # a record has at least that many times more samples than channels, where names do not say
USUAL = {"u": ("u", "U", "input"), "y": ("y", "Y", "output"), "t": ("t", "time"), "floor": ("floor",),
         "sample_rate_Hz": ("sample_rate_Hz", "fs", "Fs", "FS"), "u_names": ("u_names",), "y_names": ("y_names",)}
PERIODS = ("Ts", "dt")
# "MAT-File Format", level 4: thousands are the byte order (0 little, 1 big endian), tens the type of the numbers, ones
# the kind of matrix (full, text, sparse).
MATRICES_V4 = {1000 * order + 10 * number + kind for order in (0, 1) for number in range(6) for kind in range(3)}


def read(path: str | Path, columns: Mapped | None = None, rig: str | None = None,
         hints: Hints | None = None) -> Campaign | FrequencyResponse:
    """A .mat file: records, or a frequency response (variables frequency_Hz and H).

    Raises
    ------
    InputError : names file, record or variable, and what was expected.
    """
    path, hints = existing_file(path), hints or Hints()
    with reading(path, "the .mat file"):
        tree = variables(path)
        if len(tree) == 1 and isinstance(only := next(iter(tree.values())), dict) and "records" not in tree:
            tree = only  # everything in one struct
        if "records" in tree and columns is None:
            return _campaign(path, tree, rig)
        if "frequency_Hz" in tree and "H" in tree and columns is None:
            return response(tree, hints)
        record, notes = _flat(path, tree, columns, hints)
        return Campaign(_rig(tree, rig), (record,), str(path), tuple(notes))


def variables(path: Path) -> dict[str, Any]:
    """The variables of a .mat file by name, see `matlab_tree`.

    Raises
    ------
    InputError : not of version 5 to 7.3, damaged, cut short, too large.
    """
    with path.open("rb") as stream:
        head = stream.read(128)
    if head.startswith((b"MATLAB 7.3 MAT-file", b"\x89HDF\r\n\x1a\n")):
        return matlab_v73.variables(path)
    if head.startswith(b"MATLAB 5.0 MAT-file") and len(head) == 128:
        return matlab_v5.variables(path)
    raise InputError("expected a .mat file of version 5 to 7.3", file=path)


def is_version_4(head: bytes) -> bool:
    """Whether a file begins with the header of a v4 matrix: type, rows, columns, imaginary, length of name, name."""
    for order in "<>" if len(head) > 20 else "":
        kind, rows, columns, imaginary, length = struct.unpack(order + "5i", head[:20])
        name = head[20:20 + length] if 1 < length <= 64 else b""
        if kind in MATRICES_V4 and min(rows, columns) >= 0 and imaginary in (0, 1) and name.endswith(b"\0"):
            return name[:-1].decode("latin-1").isidentifier()
    return False


def _rig(tree: Mapping[str, Any], rig: str | None) -> str:
    return rig or as_text(tree.get("rig", "unnamed"), "rig")


def _campaign(path: Path, tree: Mapping[str, Any], rig: str | None) -> Campaign:
    """Layout A."""
    stated = as_text(tree.get("format", FORMAT), "format")
    if stated != FORMAT:
        raise InputError(f"expected {FORMAT!r}", field="format", value=stated)
    if "version" in tree and (version := as_number(_plain(tree["version"]), "version")) != VERSION:
        raise InputError(f"this release reads version {VERSION}", field="version", value=version)
    if rig is None and "rig" not in tree:
        raise InputError("missing; expected the name of the rig", field="rig")
    records = tree["records"]
    records = [records] if isinstance(records, dict) else records
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise InputError("expected a struct array or a cell array of structs", field="records",
                         value=describe(tree["records"]))
    built, notes = [], []
    names = [as_text(record["name"], f"records({i + 1}).name") if "name" in record else f"{i:02d}"
             for i, record in enumerate(records)]
    for name, fields in zip(names, records, strict=True):
        if names.count(name) > 1:
            raise InputError("expected different names of records", field="records: name", value=name)
        record, assumed = _record(path, name, {**{k: tree[k] for k in ("u_names", "y_names") if k in tree}, **fields})
        built.append(record)
        notes += assumed
    return Campaign(_rig(tree, rig), tuple(built), str(path), tuple(notes))


def _plain(value: Any) -> Any:
    """A small matrix as an array."""
    return value.read() if isinstance(value, Matrix) and math.prod(value.shape) <= 1000 else value


def _record(path: Path, name: str, fields: Mapping[str, Any]) -> tuple[RecordSource, list[str]]:
    """A record of Layout A: on disk where the file is v7.3, in memory otherwise."""
    where, notes = f"record {name}", []
    present = [role for role in ("u", "y", "floor") if role != "floor" or not _empty(fields.get("floor"))]
    matrices, channels = {}, {}
    for role in present:
        if role not in fields:
            raise InputError(f"missing; the record has {overview(fields)}", field=f"{where}: {role}")
        matrices[role] = matrix(fields[role], f"{where}: {role}")
        if f"{role}_names" in fields:
            channels[role] = as_names(_plain(fields[f"{role}_names"]), f"{where}: {role}_names",
                                      1 if 1 in matrices[role].shape else None)
        elif role == "floor":
            channels[role] = FLOOR_NAMES
        else:
            raise InputError("missing; expected a cell array of the channels' names", field=f"{where}: {role}_names")
    samples = sample_count({role: [matrices[role]] for role in present}, where,
                           {role: len(names) for role, names in channels.items()})
    units, factors = {}, {}
    for role in present:
        if f"{role}_unit" not in fields:
            notes.append(f"{where}: {role}_unit not stated; taken as {'m/s' if role == 'floor' else 'V'}")
        label = _plain(fields.get(f"{role}_unit", "m/s" if role == "floor" else "V"))
        units[role], factors[role] = units_of(label, role, where, len(channels[role]))
    header = header_from({key: _plain(value) for key, value in fields.items()}, name, samples, channels, units)
    if all(item.dataset for item in matrices.values()):
        places = {role: (Columns(str(item.dataset), factors[role], channels_first=item.shape[0] == samples),)
                  for role, item in matrices.items()}
        return StoredRecord(header, str(path), places), notes
    arrays = {}
    for role, item in matrices.items():
        arrays[role] = oriented(item, samples, f"{where}: {role}") * np.array(factors[role])
        require_finite(arrays[role], channels[role], f"{where}: {role}")
    return Record(header, arrays["u"], arrays["y"], arrays.get("floor")), notes


def _empty(value: Any) -> bool:
    return value is None or (isinstance(value, Matrix) and 0 in value.shape) or (isinstance(value, list) and not value)


def matrix(value: Any, field: str) -> Matrix:
    """A real matrix with samples in it, or an InputError that says what it is."""
    if not isinstance(value, Matrix) or value.kind not in "fiu" or len(value.shape) != 2:
        words = f"a {value.kind}" if isinstance(value, Unreadable) else describe(value)
        raise InputError("expected a real matrix, samples by channels", field=field, value=words)
    if 0 in value.shape:
        raise InputError("expected samples, found an empty array", field=field)
    return value


def sample_count(matrices: Mapping[str, Sequence[Matrix]], where: str, channels: Mapping[str, int],
                 known: int | None = None) -> int:
    """Number of samples that all matrices share, whichever way round they are.

    channels : number of channels of a role, where names tell it; known : length of the time vector.

    Raises
    ------
    InputError : no common length; square matrices; rows and columns that could both be the samples.
    """
    shapes = {role: [item.shape for item in items] for role, items in matrices.items()}
    shown = ", ".join(f"{role} is {' and '.join('x'.join(map(str, shape)) for shape in some)}"
                      for role, some in shapes.items())
    possible = None if known is None else {known}
    for role, some in shapes.items():
        for rows, columns in some:
            lengths = {rows, columns} if min(rows, columns) > 1 else {max(rows, columns)}
            if role in channels:
                lengths = {length for length, others in ((rows, columns), (columns, rows)) if others == channels[role]}
                if not lengths:
                    raise InputError(f"expected {channels[role]} channels, as there are names; it is {rows}x{columns}",
                                     field=f"{where}: {role}")
            possible = lengths if possible is None else possible & lengths
    if not possible:
        also = "" if known is None else f", t has {known}"
        raise InputError(f"expected equally many samples; {shown}{also}", field=where)
    samples = max(possible)
    square = any(rows == columns and rows > 1 for some in shapes.values() for rows, columns in some)
    if square or (len(possible) > 1 and samples < MUCH_LONGER * min(possible)):
        raise InputError(f"rows and columns could both be the samples: {shown}; expected names of the channels or a "
                         "time vector that tells them apart", field=where)
    return samples


def oriented(item: Matrix, samples: int, field: str) -> np.ndarray:
    """(samples, channels) float64."""
    array = numbers(item.read(), field)
    return array if array.shape[0] == samples else array.T


def _flat(path: Path, tree: Mapping[str, Any], columns: Mapped | None,
          hints: Hints) -> tuple[Record, list[str]]:
    """Layout B."""
    chosen = {}
    for role, usual in USUAL.items():
        names = mapped(columns, role)
        if names is None:
            names = [name for name in usual if name in tree and not _empty(tree[name])][:1]
        pick(names, list(tree), role)
        chosen[role] = names
    for role in ("u", "y"):
        if not chosen[role] and (role == "y" or hints.excitation not in ("rest", "floor")):
            raise InputError(f"which variable is it? The file has {overview(tree)}; say with columns (such as "
                             "u=vir, y=qm, t=t)", field=role)
    hints = _with_stated(hints, tree)
    matrices = {role: [matrix(tree[name], name) for name in chosen[role]] for role in ("u", "y", "floor")
                if chosen[role] or role == "u"}
    require_small(path, 8 * sum(math.prod(item.shape) for items in matrices.values() for item in items))
    rate, start, note, known = _clock(tree, chosen, hints)
    stated = {role: as_names(_plain(tree[chosen[f"{role}_names"][0]]), f"{role}_names",
                             1 if len(matrices[role]) == 1 and 1 in matrices[role][0].shape else None)
              for role in ("u", "y") if chosen[f"{role}_names"] and matrices[role]}
    counts = {role: len(names) for role, names in stated.items() if len(matrices[role]) == 1}
    samples = sample_count(matrices, "flat variables", counts, known)
    parts: dict[str, tuple[Sequence[str], Sequence[str | None], np.ndarray]] = {}
    for role, items in matrices.items():
        arrays = [oriented(item, samples, name) for item, name in zip(items, chosen[role], strict=True)]
        array = np.hstack([np.zeros((samples, 0)), *arrays])
        labels = stated.get(role) or _default_names(chosen[role], arrays)
        if len(labels) != array.shape[1]:
            raise InputError(f"expected {array.shape[1]} names, one per channel", field=f"{role}_names", value=labels)
        parts[role] = (labels, [_unit(tree, role)] * array.shape[1], array)
    record, notes = flat_record("00", parts, rate, start, hints)
    return record, notes + ([note] if note else [])


def _default_names(variables_: Sequence[str], arrays: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Variables of one channel give their own names; the columns of a matrix are numbered."""
    names: list[str] = []
    for variable, array in zip(variables_, arrays, strict=True):
        count = array.shape[1]
        names += [variable] if count == 1 else [f"{variable}{i + 1}" for i in range(count)]
    return tuple(names)


def _unit(tree: Mapping[str, Any], role: str) -> str | None:
    return as_text(tree[f"{role}_unit"], f"{role}_unit") if f"{role}_unit" in tree else None


def _with_stated(hints: Hints, tree: Mapping[str, Any]) -> Hints:
    """Hints completed by variables of the same names."""
    found: dict[str, Any] = {}
    for field in ("level_V", "start_s", "period_s"):
        if getattr(hints, field) is None and not _empty(tree.get(field)):
            found[field] = as_number(_plain(tree[field]), field)
    if hints.excitation is None and "excitation" in tree:
        found["excitation"] = as_text(tree["excitation"], "excitation")
    return replace(hints, **found)


def _clock(tree: Mapping[str, Any], chosen: Mapping[str, list[str]],
           hints: Hints) -> tuple[float, float, str, int | None]:
    """Sample rate [Hz], first time [s], note, number of samples (None where there is no time vector)."""
    start, note, known, rate = 0.0, "", None, None
    if chosen["t"]:
        name = chosen["t"][0]
        times = matrix(tree[name], name)
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
    if stated is not None and rate is not None and abs(stated / rate - 1) > 1e-3:
        raise InputError(f"expected {rate:.9g} Hz, as the time vector says", field=source, value=stated)
    result = stated if stated is not None else rate
    if result is None:
        raise InputError(f"expected t, fs or sample_rate_Hz; the file has {overview(tree)}", field="sample rate")
    return result, start, note, known
