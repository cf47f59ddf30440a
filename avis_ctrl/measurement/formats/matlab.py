"""MATLAB .mat files, v5 and v7.3: records in the two layouts of `layouts.FORMATS`, or a frequency response.

`records` may also be a cell array of structs; floor_unit is a further optional field. A column mapping assigns flat
variables with other names. Samples of v7.3 files stay on disk. Samples may be rows or columns; ambiguous arrays are
rejected.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.files import HDF5
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats import matlab_records, matlab_v5, matlab_v73
from avis_ctrl.measurement.formats.common import as_names, reading
from avis_ctrl.measurement.formats.matlab_tree import Matrix, describe
from avis_ctrl.measurement.formats.records import Hints, Mapped
from avis_ctrl.measurement.formats.response import stated_response
from avis_ctrl.measurement.frequency_response import FrequencyResponse

# "MAT-File Format", level 4: the thousands digit is the byte order (0 little, 1 big endian), the tens digit the type of
# the numbers, the ones digit the kind of matrix (full, text, sparse).
MATRICES_V4 = {1000 * order + 10 * number + kind for order in (0, 1) for number in range(6) for kind in range(3)}


def read(path: Path, columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign | FrequencyResponse:
    """A .mat file: records, or a frequency response (variables frequency_Hz and H)."""
    with reading(path, "the .mat file"):
        tree = variables(path)
        if len(tree) == 1 and isinstance(only := next(iter(tree.values())), dict) and "records" not in tree:
            tree = only  # everything in one struct
        usual_names = set(columns or ()) <= {"u_names", "y_names"}
        if "records" in tree and usual_names:
            return matlab_records.campaign(path, tree, columns, rig, hints)
        if "frequency_Hz" in tree and "H" in tree and usual_names:
            return _response(tree, hints)
        return matlab_records.flat_campaign(path, tree, columns, rig, hints)


def variables(path: Path) -> dict[str, Any]:
    """The variables of a .mat file by name, see `matlab_tree`.

    Raises
    ------
    InputError : not of version 5 to 7.3, damaged, truncated, too large.
    """
    with path.open("rb") as stream:
        head = stream.read(128)
    if head.startswith((b"MATLAB 7.3 MAT-file", HDF5)):
        return matlab_v73.variables(path)
    if head.startswith(b"MATLAB 5.0 MAT-file") and len(head) == 128:
        return matlab_v5.variables(path)
    raise InputError("expected a .mat file of version 5 to 7.3", file=path)


def is_version_4(head: bytes) -> bool:
    """Whether a file starts with the header of a v4 matrix: type, rows, columns, imaginary, length of name, name."""
    for order in "<>" if len(head) > 20 else "":
        kind, rows, columns, imaginary, length = struct.unpack(order + "5i", head[:20])
        name = head[20 : 20 + length] if 1 < length <= 64 else b""
        if kind in MATRICES_V4 and min(rows, columns) >= 0 and imaginary in (0, 1) and name.endswith(b"\0"):
            return name[:-1].decode("latin-1").isidentifier()
    return False


def _response(tree: Mapping[str, Any], hints: Hints) -> FrequencyResponse:
    """Frequency response from the variables.

    H is (n, n_y, n_u) or, as in an frd object's ResponseData, (n_y, n_u, n); MATLAB drops trailing singleton
    dimensions.

    Raises
    ------
    InputError : a variable that is missing, has the wrong type or shape, or has ambiguous dimensions.
    """
    frequency, H = _array(tree, "frequency_Hz").reshape(-1), _array(tree, "H")
    n_y, n_u = _sizes(tree, H, len(frequency))
    fields: dict[str, Any] = {
        "input_unit": "V",
        "output_unit": "V",
        "outputs": [f"y{i + 1}" for i in range(n_y)],
        "inputs": [f"u{i + 1}" for i in range(n_u)],
    }
    fields |= {field: tree[field] for field in fields if field in tree}
    for field, count in (("outputs", n_y), ("inputs", n_u)):
        as_names(fields[field], field, count)
    for field, array in (("value", "H"), ("variance", "variance"), ("coherence", "coherence")):
        if array in tree:
            fields[field] = _lines_first(_array(tree, array), (len(frequency), n_y, n_u), array)
    if "averages" in tree:
        fields["averages"] = _array(tree, "averages")
    return stated_response({"frequency_Hz": frequency, **fields}, hints)


def _array(tree: Mapping[str, Any], name: str) -> np.ndarray:
    value = tree[name]
    if not isinstance(value, Matrix) or value.kind not in "fiuc":
        raise InputError("expected a numeric array", field=name, value=describe(value))
    return value.read()


def _sizes(tree: Mapping[str, Any], H: np.ndarray, lines: int) -> tuple[int, int]:
    """Numbers of outputs and inputs, from their names or from a three-dimensional H."""
    if "outputs" in tree and "inputs" in tree:
        return len(as_names(tree["outputs"], "outputs")), len(as_names(tree["inputs"], "inputs"))
    if H.size == lines:
        return 1, 1
    if H.ndim == 3 and (H.shape[0] == lines) != (H.shape[2] == lines):
        return H.shape[1:] if H.shape[0] == lines else H.shape[:2]
    raise InputError("expected the names inputs and outputs, which identify the dimensions", field="H", value=H.shape)


def _lines_first(array: np.ndarray, sizes: tuple[int, int, int], field: str) -> np.ndarray:
    """(n, n_y, n_u) from an array of this shape or of (n_y, n_u, n), without trailing singleton dimensions."""
    n, n_y, n_u = sizes

    def padded(shape: tuple[int, ...]) -> tuple[int, ...]:
        while len(shape) > 2 and shape[-1] == 1:
            shape = shape[:-1]
        return shape

    first = padded(array.shape) == padded((n, n_y, n_u))
    last = padded(array.shape) == padded((n_y, n_u, n))
    if n_y == n_u == 1 and array.size == n:
        return array.reshape(sizes)
    if first and last:
        message = f"the dimension of frequency is ambiguous: there are as many lines as channels ({n})"
        raise InputError(message, field=field, value=array.shape)
    if not first and not last:
        message = f"expected shape {sizes} or {(n_y, n_u, n)}: lines, outputs, inputs"
        raise InputError(message, field=field, value=array.shape)
    return array.reshape(sizes) if first else np.moveaxis(array.reshape(n_y, n_u, n), 2, 0)
