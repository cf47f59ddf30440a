"""Check of a v5 .mat file's cells and structs before scipy.io reads it.

A damaged size may state millions of cells; scipy.io then allocates and visits all of them before it finds that the file
ends. Here the number of parts of each cell or struct array is held against the bytes that are there: a part takes at
least its tag of 8 bytes. Layout: "MAT-File Format", The MathWorks, level 5.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from avis_ctrl.errors import InputError

MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, OBJECT = 1, 2, 3
DEEPEST = 64
HEADER = 4096  # bytes that hold flags, dimensions and name of a variable
TAG = 8


def check_structure(path: Path) -> None:
    """Refuse a v5 .mat file whose cells or structs state more parts than their bytes can hold.

    Numeric variables are passed over without being read.

    Raises
    ------
    InputError : such a file; names the byte at which the variable starts.
    """
    with path.open("rb") as stream:
        head = stream.read(128)
        order = ">" if head[126:128] == b"MI" else "<"
        at = 128
        while len(tag := stream.read(TAG)) == TAG:
            kind, size = struct.unpack(order + "II", tag)
            body = stream.read(min(size, HEADER))
            if kind == COMPRESSED:
                body = zlib.decompressobj().decompress(body, HEADER)
                kind, size_inside = struct.unpack(order + "II", body[:TAG])
                body = body[TAG:]
            if kind == MATRIX and _class(body, order) in (CELL, STRUCT, OBJECT):
                stream.seek(at + TAG)
                body = stream.read(size)
                if tag[:4] == struct.pack(order + "I", COMPRESSED):
                    body = zlib.decompressobj().decompress(body, size_inside + TAG)[TAG:]
                if not _plausible(memoryview(body), order, 0):
                    raise InputError("states more cells or structs than its bytes can hold; damaged?",
                                     field=f"variable at byte {at}")
            at += TAG + size
            stream.seek(at)


def _class(body: bytes | memoryview, order: str) -> int:
    """Array class of a matrix: the lowest byte of its flags."""
    return struct.unpack(order + "I", body[8:12])[0] & 0xFF if len(body) >= 12 else 0


def _element(body: memoryview, at: int, order: str) -> tuple[memoryview, int]:
    """Data of the element that starts at a byte, and where the next one starts (multiples of 8)."""
    first, size = struct.unpack(order + "II", body[at:at + TAG])
    if first >> 16:  # small element: size and up to four bytes in the tag
        return body[at + 4:at + 4 + (first >> 16)], at + TAG
    return body[at + TAG:at + TAG + size], at + TAG + (size + 7) // 8 * 8


def _plausible(body: memoryview, order: str, depth: int) -> bool:
    """Whether a matrix and what lies in it can hold as many parts as they state."""
    kind = _class(body, order)
    if kind not in (CELL, STRUCT, OBJECT):
        return True
    if depth > DEEPEST:
        return False
    _, at = _element(body, 0, order)
    dimensions, at = _element(body, at, order)
    count = 1
    for (length,) in struct.iter_unpack(order + "i", dimensions[:len(dimensions) // 4 * 4]):
        count *= length
    _, at = _element(body, at, order)  # name
    if kind == OBJECT:
        _, at = _element(body, at, order)
    if kind != CELL:
        width, at = _element(body, at, order)
        names, at = _element(body, at, order)
        each = struct.unpack(order + "i", width[:4])[0]
        count *= max(len(names) // each, 1) if each > 0 else 1
    if not 0 <= count <= (len(body) - at) // TAG:
        return False
    for _ in range(count):
        part, after = _element(body, at, order)
        if not _plausible(part, order, depth + 1):
            return False
        at = after
    return True
