"""MATLAB .mat files, v5 and v7.3, in two layouts.

Layout A, the contract's: a struct array (or cell array of structs) `records` with the fields u, y and sample_rate_Hz,
and excitation, level_V, start_s, period_s (empty, 0 or NaN where not periodic), floor, u_names, y_names, u_unit,
y_unit, floor_unit, t where they are known; beside it `rig`.

Layout B, flat variables of one record: u, y, t or fs (Fs, sample_rate_Hz) or Ts, optionally floor, u_names, y_names,
u_unit, y_unit, excitation, level_V, period_s, start_s, rig; a mapping of columns says which variable is what.

Samples of v7.3 files stay on disk. Rows or columns may be the samples; what cannot be told apart is refused.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats import matlab_records, matlab_v5, matlab_v73
from avis_ctrl.measurement.formats.common import existing_file, reading
from avis_ctrl.measurement.formats.matlab_response import response
from avis_ctrl.measurement.formats.records import Hints, Mapped
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
        return matlab_records.flat_campaign(path, tree, columns, rig, hints)


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
