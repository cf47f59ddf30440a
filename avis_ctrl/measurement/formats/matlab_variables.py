"""Variables of a .mat file, v5 (scipy.io) or v7.3 (HDF5), as one kind of tree.

A numeric array becomes a `Matrix` in MATLAB's orientation, char a str, a cell array a list, a struct a dict, a struct
array a list of dicts, and what has no meaning here (function handles, objects, strings of class string, tables) an
`Unreadable` that is refused only where it is used.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
import scipy.sparse

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import reading, short
from avis_ctrl.measurement.formats.matlab_structure import check_structure
from avis_ctrl.measurement.formats.stored import open_hdf5

DEEPEST = 8  # nested structs and cells
MOST_CELLS = 10_000


@dataclass(frozen=True)
class Unreadable:
    """A variable of a class that holds no measurement."""

    kind: str


@dataclass(frozen=True)
class Matrix:
    """A numeric array in MATLAB's orientation.

    shape : as MATLAB shows it; read : its values in that shape; dataset : where it lies in a v7.3 file (stored with
    the dimensions reversed), None where it is in memory.
    """

    shape: tuple[int, ...]
    kind: str
    read: Callable[[], np.ndarray]
    dataset: str | None = None


def variables(path: Path) -> dict[str, Any]:
    """The variables of a .mat file by name.

    Raises
    ------
    InputError : no .mat file, damaged, cut short.
    """
    with path.open("rb") as stream:
        head = stream.read(128)
    if head.startswith(b"MATLAB 7.3 MAT-file") or head.startswith(b"\x89HDF\r\n\x1a\n"):
        with reading(path, "the .mat file (v7.3)"), open_hdf5(path) as file:
            return {name: _stored(file, file[name], str(path), 0) for name in file if not name.startswith("#")}
    if not head.startswith(b"MATLAB 5.0 MAT-file"):
        raise InputError("expected a .mat file of version 5 to 7.3", file=path)
    with reading(path, "the .mat file (v5)"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of variables that are written twice or cannot be read: judged where used
        check_structure(path)
        try:
            loaded = scipy.io.loadmat(path, chars_as_strings=True, struct_as_record=True, squeeze_me=False)
        except MemoryError:
            raise
        except Exception as error:  # over a damaged file scipy raises whatever comes, an UnboundLocalError too
            raise InputError(f"the .mat file (v5) cannot be read; damaged or cut short? ({short(error)})",
                             file=path) from error
        return {name: _loaded(value, 0) for name, value in loaded.items() if not name.startswith("__")}


def _loaded(value: Any, depth: int) -> Any:
    """A variable as scipy.io gives it."""
    if depth > DEEPEST:
        return Unreadable("structure nested too deep")
    if scipy.sparse.issparse(value):
        return Unreadable("sparse matrix")
    if isinstance(value, (scipy.io.matlab.MatlabFunction, scipy.io.matlab.MatlabOpaque,
                          scipy.io.matlab.MatlabObject)):
        return Unreadable({"MatlabFunction": "function handle"}.get(type(value).__name__, "MATLAB object"))
    if not isinstance(value, np.ndarray):
        return Unreadable(type(value).__name__)
    if value.dtype.names is not None:
        items = [{name: _loaded(element[name], depth + 1) for name in value.dtype.names}
                 for element in value.reshape(-1, order="F")[:MOST_CELLS]]
        return items[0] if len(items) == 1 else items
    if value.dtype.kind == "O":
        return [_loaded(element, depth + 1) for element in value.reshape(-1, order="F")[:MOST_CELLS]]
    if value.dtype.kind == "U":
        rows = [str(row).strip() for row in value.reshape(-1)]
        return rows[0] if len(rows) == 1 else rows or ""
    return Matrix(value.shape, value.dtype.kind, lambda: value)


def _stored(file: h5py.File, item: Any, path: str, depth: int) -> Any:
    """A variable of a v7.3 file."""
    if depth > DEEPEST:
        return Unreadable("structure nested too deep")
    kind = item.attrs.get("MATLAB_class", b"")
    kind = kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind)
    if isinstance(item, h5py.Group):
        if kind not in ("struct", ""):
            return Unreadable("sparse matrix" if "MATLAB_sparse" in item.attrs else f"MATLAB {kind}")
        return _stored_struct(file, item, path, depth)
    if not isinstance(item, h5py.Dataset) or item.shape is None:
        return Unreadable("unknown item")
    if kind == "char":
        if "MATLAB_empty" in item.attrs:
            return ""
        codes = np.asarray(item[()])
        rows = ["".join(map(chr, row)).strip() for row in (codes.T if codes.ndim == 2 else codes.reshape(1, -1))]
        return rows[0] if len(rows) == 1 else rows
    if item.dtype.kind == "O":
        if kind not in ("cell", "") or not h5py.check_ref_dtype(item.dtype):
            return Unreadable("function handle" if kind == "function_handle" else f"MATLAB {kind or 'object'}")
        return [_stored(file, file[reference], path, depth + 1) for reference in _references(item)]
    if kind not in ("double", "single", "logical", "") and not kind.startswith(("int", "uint")):
        return Unreadable("function handle" if kind == "function_handle" else f"MATLAB {kind}")
    if "MATLAB_empty" in item.attrs:
        return Matrix((0, 0), "f", lambda: np.zeros((0, 0)))
    return _stored_matrix(item, path)


def _references(item: h5py.Dataset) -> list[Any]:
    if item.size > MOST_CELLS:
        raise InputError(f"expected at most {MOST_CELLS} cells", field=str(item.name), value=item.size)
    return list(np.asarray(item[()]).reshape(-1))  # dimensions are stored reversed: this is MATLAB's linear order


def _stored_struct(file: h5py.File, group: h5py.Group, path: str, depth: int) -> Any:
    """A struct, or a struct array: there each field holds references, one per element."""
    names = list(group)
    arrays = {}
    for name in names:
        field = group[name]
        if isinstance(field, h5py.Dataset) and field.dtype.kind == "O" and "MATLAB_class" not in field.attrs:
            arrays[name] = _references(field)
    if not names or len(arrays) < len(names):
        return {name: _stored(file, group[name], path, depth + 1) for name in names}
    count = min(len(references) for references in arrays.values())
    return [{name: _stored(file, file[references[i]], path, depth + 1) for name, references in arrays.items()}
            for i in range(count)]


def _stored_matrix(item: h5py.Dataset, path: str) -> Matrix:
    name = str(item.name)
    complex_parts = item.dtype.names == ("real", "imag")

    def read() -> np.ndarray:
        with reading(path, name), h5py.File(path, "r") as file:
            array = file[name][()].T
        return array["real"] + 1j * array["imag"] if complex_parts else array
    shape = item.shape[::-1] if len(item.shape) != 1 else (item.shape[0], 1)
    return Matrix(shape, "c" if complex_parts else item.dtype.kind, read, None if complex_parts else name)


def describe(value: Any) -> str:
    """What a variable is, in words."""
    if isinstance(value, Matrix):
        return f"{'complex ' * (value.kind == 'c')}array of {'x'.join(map(str, value.shape))}"
    if isinstance(value, Unreadable):
        return value.kind
    return "text" if isinstance(value, str) else "struct" if isinstance(value, dict) else "cell or struct array"


def overview(tree: Mapping[str, Any]) -> str:
    """Names of the variables, for messages."""
    return ", ".join(sorted(tree)[:30]) or "nothing"
