"""MATLAB .mat files, v5 and v7.3, in two layouts.

Layout A, the contract's: a struct array (or cell array of structs) `records` with the fields u, y and sample_rate_Hz,
and excitation, level_V, start_s, period_s (empty, 0 or NaN where not periodic), floor, u_names, y_names, u_unit,
y_unit, floor_unit, t where they are known; beside it `rig`. Records of v7.3 files stay on disk.

Layout B, flat variables of one record: u, y, t or fs (Fs, sample_rate_Hz) or Ts, optionally floor, u_names, y_names,
u_unit, y_unit, excitation, level_V, period_s, start_s, rig; a mapping of columns says which variable is what.

Rows or columns may be the samples; what cannot be told apart is refused.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record
from avis_ctrl.measurement.formats import matlab_records, matlab_v5, matlab_v73
from avis_ctrl.measurement.formats.common import as_text, existing_file, reading, require_small
from avis_ctrl.measurement.formats.flat import UNNAMED, Hints, Mapped, flat_record, mapped, pick
from avis_ctrl.measurement.formats.matlab_response import response
from avis_ctrl.measurement.formats.matlab_shapes import (
    USUAL,
    clock,
    empty,
    matrix,
    oriented,
    sample_count,
    stated_names,
    unit_label,
    usual,
    with_stated,
)
from avis_ctrl.measurement.formats.matlab_tree import overview
from avis_ctrl.measurement.frequency_response import FrequencyResponse

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
        usual_names = set(columns or ()) <= {"u_names", "y_names"}
        if "records" in tree and usual_names:
            return matlab_records.campaign(path, tree, columns, rig, hints)
        if "frequency_Hz" in tree and "H" in tree and usual_names:
            return response(tree, hints)
        record, notes = _flat(path, tree, columns, hints)
        stated = rig or (UNNAMED if empty(tree.get("rig")) else as_text(tree["rig"], "rig"))
        return Campaign(stated, (record,), str(path), tuple(notes))


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


def _flat(path: Path, tree: Mapping[str, Any], columns: Mapped | None,
          hints: Hints) -> tuple[Record, list[str]]:
    """Layout B."""
    chosen, hints = {}, with_stated(hints, tree)
    for role in USUAL:
        names = mapped(columns, role)
        if names is None:
            names = usual(tree, role)
        if not role.endswith("_names"):  # those may be the names themselves
            pick(names, list(tree), role)
        chosen[role] = names
    for role in ("u", "y"):
        if not chosen[role] and (role == "y" or hints.excitation not in ("rest", "floor")):
            raise InputError(f"which variable is it? The file has {overview(tree)}; say with columns (such as "
                             "u=vir, y=qm, t=t)", field=role)
    matrices = {role: [matrix(tree[name], name) for name in chosen[role]] for role in ("u", "y", "floor")
                if chosen[role] or role == "u"}
    require_small(path, 8 * sum(math.prod(item.shape) for items in matrices.values() for item in items))
    rate, start, note, known = clock(tree, chosen, hints)
    stated = {role: stated_names(chosen[f"{role}_names"], tree, f"{role}_names",
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
            raise InputError(f"expected {array.shape[1]} names, one per channel; there are {len(labels)}",
                             field=f"{role}_names", value=labels)
        parts[role] = (labels, [unit_label(tree, role)] * array.shape[1], array)
    record, notes = flat_record("00", parts, rate, start, hints)
    return record, notes + ([note] if note else [])


def _default_names(variables_: Sequence[str], arrays: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Variables of one channel give their own names; the columns of a matrix are numbered."""
    names: list[str] = []
    for variable, array in zip(variables_, arrays, strict=True):
        count = array.shape[1]
        names += [variable] if count == 1 else [f"{variable}{i + 1}" for i in range(count)]
    return tuple(names)
