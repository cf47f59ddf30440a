"""MATLAB v5 files (also written by -v6 and -v7): a strict reader of numbers, text, cells and structs.

A C reader that trusts a corrupt size can crash the process. Here every size is checked against the remaining bytes, and
dimensions against the bytes of data, before any data are used; numbers are converted on access. Inconsistent data are
rejected, not repaired.

Layout: "MAT-File Format", The MathWorks, chapter 1 (level 5): 128 bytes of header, then data elements, each with a tag
(type, number of bytes) of 8 bytes, and padded to multiples of 8; up to four bytes may be stored in the tag itself.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import require_small
from avis_ctrl.measurement.formats.matlab_tree import EMPTY, SETTINGS, TOO_DEEP, Matrix, Unreadable

HEADER, TAG = 128, 8
MATRIX, COMPRESSED = 14, 15
INT8, UINT8, INT32, UINT32, UTF8, UTF16, UTF32 = 1, 2, 5, 6, 16, 17, 18
NUMERIC = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
NAME = (INT8, UINT8, UTF8)  # miINT8 in the document; some writers use the other two
CHARACTERS = {INT8: "latin-1", UINT8: "latin-1", 4: "utf-16", UTF8: "utf-8", UTF16: "utf-16", UTF32: "utf-32"}
CELL, STRUCT, OBJECT, CHAR, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
FOREIGN = {OBJECT: "MATLAB object", SPARSE: "sparse matrix", FUNCTION: "function handle", OPAQUE: "MATLAB object"}
COMPLEX = 0x0800  # bit of the array flags
MOST_ELEMENTS = 1 << 31  # of an array in a v5 file
HIGHEST_RATIO = 1032  # maximum expansion of a zlib stream


def variables(path: Path) -> dict[str, Any]:
    """The variables of a v5 file by name, see `matlab_tree`.

    Raises
    ------
    InputError : damaged, truncated, or too large for memory; names the byte where the variable starts.
    """
    size = require_small(path)
    with path.open("rb") as stream:
        order = _order(stream.read(HEADER))
        tree: dict[str, Any] = {}
        at, held = HEADER, 0
        while at < size:
            try:
                tag = stream.read(TAG)
                if len(tag) < TAG:
                    raise _damaged(f"{len(tag)} bytes are left, no whole variable")
                kind, length = struct.unpack(order + "II", tag)
                if length > size - at - TAG:
                    raise _damaged(f"it states {length} bytes; {size - at - TAG} are left")
                body = memoryview(stream.read(length))
                if kind == COMPRESSED:
                    body = _inflated(body, order, path, held)
                elif kind != MATRIX:
                    raise _damaged(f"it is of type {kind}, not a matrix")
                held += len(body)
                name, value = _matrix(body, order, 0)
                if name in tree:
                    raise _damaged(f"the name {name!r} comes twice")
            except InputError as error:
                if error.file is not None:
                    raise
                raise InputError(error.expected, field=f"variable at byte {at}") from None
            if name:  # no name: the workspace of function handles
                tree[name] = value
            at += TAG + length
    return tree


def _order(header: bytes) -> str:
    """Byte order of the file, as a format character of struct and numpy."""
    order = {b"IM": "<", b"MI": ">"}.get(header[126:128])
    if order is None or struct.unpack(order + "H", header[124:126])[0] != 0x0100:
        message = "expected version 0x0100 and the mark MI in bytes 124 to 127 of the header; damaged?"
        raise InputError(message, field="header", value=header[124:128].hex())
    return order


def _damaged(found: str) -> InputError:
    return InputError(f"{found}; damaged or cut short?")


def _inflated(packed: memoryview, order: str, path: Path, held: int) -> memoryview:
    """The matrix in a compressed element, without its tag; no more is inflated than the tag states.

    held : number of bytes of the variables before it.
    """
    stream = zlib.decompressobj()
    try:
        tag = stream.decompress(packed, TAG)
        if len(tag) < TAG:
            raise _damaged("the compressed bytes end within the first tag")
        kind, length = struct.unpack(order + "II", tag)
        if kind != MATRIX:
            raise _damaged(f"the compressed bytes hold type {kind}, not a matrix")
        if length > HIGHEST_RATIO * len(packed):
            raise _damaged(f"{len(packed)} compressed bytes cannot hold the stated {length}")
        require_small(path, held + length)
        body = stream.decompress(stream.unconsumed_tail, length + TAG)
    except zlib.error as error:
        raise _damaged(f"its bytes cannot be decompressed ({error})") from None
    if len(body) < length or not stream.eof:
        raise _damaged(f"the compressed bytes do not end where {length} bytes are inflated")
    return memoryview(body)[:length]


class Elements:
    """Sequential reader of the data elements in the body of a matrix."""

    def __init__(self, body: memoryview, order: str):
        self.body, self.order, self.at = body, order, 0

    @property
    def left(self) -> int:
        """Number of bytes not yet read."""
        return len(self.body) - self.at

    def next(self, what: str, *kinds: int) -> tuple[int, memoryview]:
        """Type and data of the next element, which must have one of the given types."""
        if self.left < TAG:
            raise _damaged(f"{what}: missing")
        kind, size = struct.unpack_from(self.order + "II", self.body, self.at)
        start, room = self.at + TAG, self.left - TAG
        if kind >> 16:  # size and data are in the tag
            kind, size, start, room = kind & 0xFFFF, kind >> 16, self.at + 4, 4
        if size > room:
            raise _damaged(f"{what}: {size} bytes are stated, {room} are left")
        if kind not in kinds:
            raise _damaged(f"{what}: of type {kind}, not {' or '.join(map(str, kinds))}")
        self.at = min(start + (size + 7) // 8 * 8 if start == self.at + TAG else self.at + TAG, len(self.body))
        return kind, self.body[start : start + size]

    def integers(self, what: str, kind: int) -> list[int]:
        """Values of an element of 32-bit integers."""
        content = self.next(what, kind)[1]
        if len(content) % 4:
            raise _damaged(f"{what}: {len(content)} bytes, no whole number of integers")
        return np.frombuffer(content, self.order + ("i4" if kind == INT32 else "u4")).tolist()

    def text(self, what: str) -> str:
        """Name in the next element."""
        return _printable(bytes(self.next(what, *NAME)[1]), what)

    def end(self) -> None:
        """Raise InputError if another element follows."""
        if self.left >= TAG:
            raise _damaged(f"{self.left} bytes follow the last part")


def _printable(content: bytes, what: str) -> str:
    """Name of a variable or field; names appear in messages and must not contain control characters."""
    name = content.rstrip(b"\0").decode("utf-8", "replace")
    if not name.isprintable() or "\ufffd" in name:
        raise _damaged(f"{what}: {name[:40]!r} is not a name")
    return name


def _matrix(body: memoryview, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix."""
    if not len(body):
        return "", EMPTY  # an empty cell has no content
    elements = Elements(body, order)
    flags = elements.integers("array flags", UINT32)
    if len(flags) != 2:
        raise _damaged(f"array flags: {4 * len(flags)} bytes, not 8")
    own = flags[0] & 0xFF
    if own == OPAQUE:  # has no dimensions
        return elements.text("name"), Unreadable(FOREIGN[own])
    shape = _shape(elements.integers("dimensions", INT32))
    name = elements.text("name")
    if own in FOREIGN:
        return name, Unreadable(FOREIGN[own])
    if own in CLASSES:
        value: Any = _numbers(elements, shape, np.dtype(CLASSES[own]), bool(flags[0] & COMPLEX))
    elif own == CHAR:
        value = _text(elements, shape)
    elif own not in (CELL, STRUCT):
        raise _damaged(f"array flags: class {own} does not exist")
    elif depth >= SETTINGS.deepest:
        return name, TOO_DEEP
    else:
        value = _cells(elements, shape, depth) if own == CELL else _structs(elements, shape, depth)
    if not isinstance(value, Unreadable):
        elements.end()
    return name, value


def _shape(dimensions: list[int]) -> tuple[int, ...]:
    """Checked dimensions, whose product cannot overflow, even for empty arrays."""
    sane = 2 <= len(dimensions) <= SETTINGS.most_dimensions and min(dimensions) >= 0
    if not sane or math.prod(max(length, 1) for length in dimensions) > MOST_ELEMENTS:
        raise _damaged(f"dimensions: {str(dimensions)[:60]} are not possible")
    return tuple(dimensions)


def _numbers(elements: Elements, shape: tuple[int, ...], dtype: np.dtype, is_complex: bool) -> Matrix:
    """A numeric array; MATLAB stores whole numbers in the smallest type that fits them all."""
    names = ("real part", "imaginary part") if is_complex else ("real part",)
    parts = [_part(elements, math.prod(shape), dtype, name) for name in names]

    def read() -> np.ndarray:
        array = np.empty(math.prod(shape), complex if is_complex else dtype)
        with np.errstate(invalid="ignore"):  # NaN is checked where the samples are used
            if is_complex:
                array.real, array.imag = parts
            else:
                array[:] = parts[0]
        return array.reshape(shape, order="F")

    return Matrix(shape, "c" if is_complex else dtype.kind, read)


def _part(elements: Elements, count: int, dtype: np.dtype, what: str) -> np.ndarray:
    """A view of the stored numbers."""
    kind, content = elements.next(what, *NUMERIC)
    stored = np.dtype(elements.order + NUMERIC[kind])
    if len(content) != count * stored.itemsize:
        raise _damaged(f"{what}: {len(content)} bytes for {count} numbers of {stored.itemsize} bytes")
    if stored.itemsize > dtype.itemsize or (stored.kind == "f" and dtype.kind != "f"):
        raise _damaged(f"{what}: an array of {dtype} is not stored as {stored.newbyteorder('=')}")
    array = np.frombuffer(content, stored)
    if dtype.kind != "f" and count and not np.can_cast(stored, dtype):
        limits = np.iinfo(dtype)
        if int(array.min()) < limits.min or int(array.max()) > limits.max:
            raise _damaged(f"{what}: values beyond {dtype}")
    return array


def _text(elements: Elements, shape: tuple[int, ...]) -> str | list[str]:
    """Text; the rows of a char matrix are padded with blanks to equal length."""
    kind, content = elements.next("characters", *CHARACTERS)
    count = math.prod(shape)
    coding = CHARACTERS[kind]
    if coding in ("utf-16", "utf-32"):
        coding += "-le" if elements.order == "<" else "-be"
    # MATLAB counts 16-bit units; scipy.io, which writes UTF-8, counts characters.
    units = np.frombuffer(bytes(content).decode(coding, "replace").encode("utf-16-le"), "<u2")
    if len(units) != count:
        units = np.frombuffer(bytes(content).decode(coding, "replace").encode("utf-32-le"), "<u4")
    if len(units) != count:
        raise _damaged(f"characters: {len(units)} for dimensions {'x'.join(map(str, shape))}")
    if count == 0:
        return ""
    coding = f"utf-{8 * units.itemsize}-le"
    rows = [
        row.tobytes().decode(coding, "replace").strip()
        for row in units.reshape(shape, order="F").reshape(-1, shape[-1])
    ]
    return rows[0] if len(rows) == 1 else rows


def _cells(elements: Elements, shape: tuple[int, ...], depth: int) -> Any:
    """A cell array in MATLAB's linear order."""
    count = math.prod(shape)
    _require_room(elements, count)
    if count > SETTINGS.most_cells:
        return Unreadable(f"cell array of more than {SETTINGS.most_cells} cells")
    return [_inner(elements, f"cell {i + 1}", depth) for i in range(count)]


def _structs(elements: Elements, shape: tuple[int, ...], depth: int) -> Any:
    """A struct as a dict, a struct array as a list of dicts."""
    width = elements.integers("length of field names", INT32)
    content = bytes(elements.next("field names", *NAME)[1])
    if len(width) != 1 or width[0] < 1 or len(content) % width[0]:
        raise _damaged(f"field names: {len(content)} bytes in names of {str(width)[:40]}")
    names = [
        _printable(content[at : at + width[0]].split(b"\0")[0], "field names")
        for at in range(0, len(content), width[0])
    ]
    if len(set(names)) != len(names) or not all(names):
        raise _damaged("field names: empty or equal ones")
    count = math.prod(shape)
    _require_room(elements, count * len(names))
    if count != 1 and not names:
        return Unreadable("struct array without fields")
    if count > SETTINGS.most_cells:
        return Unreadable(f"struct array of more than {SETTINGS.most_cells} structs")
    items = [{name: _inner(elements, f"field {name}", depth) for name in names} for _ in range(count)]
    return items[0] if count == 1 else items


def _require_room(elements: Elements, count: int) -> None:
    """Check that `count` parts fit into the remaining bytes; each has at least a tag."""
    if count * TAG > elements.left:
        raise _damaged(f"{count} parts are stated; {elements.left} bytes are left")


def _inner(elements: Elements, what: str, depth: int) -> Any:
    return _matrix(elements.next(what, MATRIX)[1], elements.order, depth + 1)[1]
