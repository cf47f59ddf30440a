"""Check of a v5 .mat file's elements before scipy.io reads it.

A damaged size may state millions of cells, all of which scipy.io allocates and visits before it finds that the file
ends; over some damage scipy.io 1.17 ends the process (segmentation fault). Here every element has to be of a known type
and to lie inside its variable, and cells and structs to have the parts they state. That stops most such files, not
all: with up to three bytes changed at random some still crash scipy.io within seconds of trying.
Layout: "MAT-File Format", The MathWorks, level 5.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from avis_ctrl.errors import InputError

MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, OBJECT, OPAQUE = 1, 2, 3, 16  # from 16 on: function handles and newer classes, of other structure
DEEPEST = 64
TAG = 8
TYPES = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, MATRIX, 16, 17, 18}


def check_structure(path: Path) -> None:
    """Refuse a v5 .mat file whose elements do not fit together.

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
            body = stream.read(size)
            if kind == COMPRESSED:
                body = zlib.decompressobj().decompress(body)
                kind, inside = struct.unpack(order + "II", body[:TAG])
                body = body[TAG:TAG + inside]
            if kind != MATRIX or not _plausible(memoryview(body), order, 0):
                raise InputError("its parts do not fit together; damaged or cut short?",
                                 field=f"variable at byte {at}")
            at += TAG + size


def _class(body: bytes | memoryview, order: str) -> int:
    """Array class of a matrix: the lowest byte of its flags."""
    return struct.unpack(order + "I", body[8:12])[0] & 0xFF if len(body) >= 12 else 0


def _element(body: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Type and data of the element that starts at a byte, and where the next one starts (multiples of 8)."""
    first, size = struct.unpack(order + "II", body[at:at + TAG])
    if first >> 16:  # small element: size and up to four bytes in the tag
        size, start, after = first >> 16, at + 4, at + TAG
        fits = size <= 4
    else:
        start, after = at + TAG, at + TAG + (size + 7) // 8 * 8
        fits = start + size <= len(body)
    kind = first & 0xFFFF
    return kind if fits and kind in TYPES else 0, body[start:start + size], after


def _plausible(body: memoryview, order: str, depth: int) -> bool:
    """Whether all elements of a matrix are of known types and lie inside it, and its parts are as many as it states."""
    elements, at = [], 0
    while at + TAG <= len(body):
        kind, content, at = _element(body, at, order)
        if kind == 0 or depth > DEEPEST or (kind == MATRIX and not _plausible(content, order, depth + 1)):
            return False
        elements.append((kind, content))
    if not elements:
        return len(body) == 0
    own = _class(body, order)
    if own < OPAQUE and not _well_begun(own, elements):
        return False
    if own in (CELL, STRUCT, OBJECT):
        return len(elements) > 2 and _parts(own, elements, order) == sum(kind == MATRIX for kind, _ in elements)
    return True


def _well_begun(own: int, elements: list[tuple[int, memoryview]]) -> bool:
    """Whether flags, dimensions and name come first and, of numbers and text, data after them."""
    if len(elements) < 3 or [kind for kind, _ in elements[:3]] != [6, 5, 1]:
        return False
    flags, dimensions = len(elements[0][1]), len(elements[1][1])
    return flags == 8 and dimensions >= 8 and dimensions % 4 == 0 and (own <= OBJECT or len(elements) > 3)


def _parts(own: int, elements: list[tuple[int, memoryview]], order: str) -> int:
    """Number of parts that a cell array, struct array or object states; -1 if it states none."""
    dimensions = elements[1][1]
    count = 1
    for (length,) in struct.iter_unpack(order + "i", dimensions[:len(dimensions) // 4 * 4]):
        count *= length
    if own == CELL:
        return count
    first = 3 if own == STRUCT else 4  # after flags, dimensions, name and, of an object, class name
    if len(elements) < first + 2 or len(elements[first][1]) < 4:
        return -1
    width = struct.unpack(order + "i", elements[first][1][:4])[0]
    return count * (len(elements[first + 1][1]) // width) if width > 0 else -1
