"""MATLAB v7.3 files: HDF5, with reversed dimensions, text as character codes, cells and struct arrays by reference.

The class of a variable is stored in its attribute MATLAB_class. Numbers stay in the file until they are read.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats import stored
from avis_ctrl.measurement.formats.common import printable, reading, require_small
from avis_ctrl.measurement.formats.matlab_tree import EMPTY, SETTINGS, TOO_DEEP, Matrix, Unreadable


def variables(path: Path) -> dict[str, Any]:
    """The variables of a v7.3 file by name, see `matlab_tree`.

    Raises
    ------
    InputError : not an HDF5 file, damaged, truncated.
    """
    with reading(path, "the .mat file (v7.3)"), stored.open_hdf5(path) as file:
        tree = Tree(file, path)
        shown = [name for name in stored.members(file) if not name.startswith("#")]
        return {printable(name): tree.value(stored.member(file, name), 0) for name in shown}


class Tree:
    """Reader of the variables in one open file."""

    def __init__(self, file: h5py.File, path: Path):
        self.file, self.path, self.items = file, path, 0

    def value(self, item: Any, depth: int) -> Any:
        """Value of a group or data set."""
        self.items += 1
        if self.items > SETTINGS.most_items:
            raise InputError(f"expected at most {SETTINGS.most_items} variables, cells and fields; damaged?")
        if depth > SETTINGS.deepest:
            return TOO_DEEP
        if not isinstance(item, (h5py.Group, h5py.Dataset)):
            return Unreadable("unknown item")
        stated = stored.attributes(item, "MATLAB_class", "MATLAB_sparse", "MATLAB_empty")
        kind = stated.get("MATLAB_class", b"")
        kind = printable(kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind))
        if isinstance(item, h5py.Group):
            if kind not in ("struct", ""):
                return Unreadable("sparse matrix" if "MATLAB_sparse" in stated else f"MATLAB {kind}")
            return self._struct(item, depth)
        return self._array(item, kind, "MATLAB_empty" in stated, depth)

    def _array(self, item: h5py.Dataset, kind: str, empty: bool, depth: int) -> Any:
        shape, dtype = stored.layout(item)
        if shape is None:
            return Unreadable("unknown item")
        if kind == "char":
            return "" if empty else self._text(item, shape, dtype)
        if dtype.kind == "O":
            if kind not in ("cell", "") or not h5py.check_ref_dtype(dtype):
                return Unreadable("function handle" if kind == "function_handle" else f"MATLAB {kind or 'object'}")
            return [self._behind(reference, depth) for reference in self._references(item, shape)]
        if kind not in ("double", "single", "logical", "") and not kind.startswith(("int", "uint")):
            return Unreadable("function handle" if kind == "function_handle" else f"MATLAB {kind}")
        return EMPTY if empty else self._matrix(item, shape, dtype)

    def _text(self, item: h5py.Dataset, shape: tuple[int, ...], dtype: np.dtype) -> Any:
        """Text from UTF-16 codes; columns of the file are rows of a char matrix."""
        if dtype.kind != "u" or dtype.itemsize != 2:
            return Unreadable(f"text of type {dtype}")
        require_small(self.path, 2 * math.prod(shape))
        codes = stored.values(item)
        if not codes.size:
            return ""
        rows = codes.T if codes.ndim == 2 else codes.reshape(1, -1)
        lines = [np.ascontiguousarray(row, "<u2").tobytes().decode("utf-16-le", "replace").strip() for row in rows]
        return lines[0] if len(lines) == 1 else lines

    def _references(self, item: h5py.Dataset, shape: tuple[int, ...]) -> list[Any]:
        if math.prod(shape) > SETTINGS.most_cells:
            name = printable(stored.full_name(item))
            raise InputError(f"expected at most {SETTINGS.most_cells} cells", field=name, value=math.prod(shape))
        return list(stored.values(item).reshape(-1))  # dimensions are stored reversed: this is MATLAB's linear order

    def _behind(self, reference: Any, depth: int) -> Any:
        return self.value(stored.member(self.file, reference), depth + 1)

    def _struct(self, group: h5py.Group, depth: int) -> Any:
        """A struct, or a struct array: each of its fields has one reference per element."""
        fields = {name: stored.member(group, name) for name in stored.members(group)}
        arrays = {}
        for name, field in fields.items():
            if isinstance(field, h5py.Dataset) and not stored.attributes(field, "MATLAB_class"):
                shape, dtype = stored.layout(field)
                if shape is not None and h5py.check_ref_dtype(dtype):
                    arrays[name] = self._references(field, shape)
        if not fields or len(arrays) < len(fields):
            return {printable(name): self.value(field, depth + 1) for name, field in fields.items()}
        count = min(len(references) for references in arrays.values())
        return [
            {printable(name): self._behind(references[i], depth) for name, references in arrays.items()}
            for i in range(count)
        ]

    def _matrix(self, item: h5py.Dataset, file_shape: tuple[int, ...], dtype: np.dtype) -> Matrix:
        name, path = stored.full_name(item), self.path
        complex_parts = dtype.names == ("real", "imag")

        def read() -> np.ndarray:
            with reading(path, printable(name)):
                require_small(path, math.prod(file_shape) * dtype.itemsize)
                array = stored.values_in(path, name).T
            if array.shape == file_shape[::-1] and array.dtype == dtype:
                if not complex_parts:
                    return array
                if array["real"].dtype.kind in "fiu" and array["imag"].dtype.kind in "fiu":
                    return array["real"] + 1j * array["imag"]
            raise InputError("changed since it was opened, or holds no numbers", file=path, field=printable(name))

        shape = file_shape[::-1] if len(file_shape) != 1 else (file_shape[0], 1)
        return Matrix(shape, "c" if complex_parts else dtype.kind, read, None if complex_parts else name)
