"""Data sets 58 (functions at nodal degrees of freedom) and 164 (units) of a universal file, ASCII or binary.

Definitions: Universal Dataset Numbers 58 and 164, Structural Dynamics Research Laboratory, University of Cincinnati
(SDRC I-DEAS Test). The binary variant 58b has the same eleven header lines; its first line ends with byte order (1
little, 2 big endian), float format (2 = IEEE 754), number of header lines and number of bytes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import is_number

MARK = b"-1"
HEADER_LINES = 11
DIRECTIONS = {1: "X", 2: "Y", 3: "Z", 4: "RX", 5: "RY", 6: "RZ"}


class Axis(NamedTuple):
    """Specific data type and unit of an axis ("" if not used)."""

    kind: int
    unit: str


class Point(NamedTuple):
    """Location of a response or a reference: entity name ("" if unused), node, direction."""

    name: str
    node: int
    direction: int

    def channel(self) -> str:
        """Name of the channel: the entity name, or node and direction without one."""
        if self.name:
            return self.name
        sign = "-" if self.direction < 0 else "+"
        axis = DIRECTIONS.get(abs(self.direction))
        return f"node {self.node}" + (f" {sign}{axis}" if axis else "")


@dataclass(frozen=True)
class Function:
    """One data set 58.

    lines : the five ID lines; kind : function type (1 time response, 4 frequency response, 6 coherence, ...);
    abscissa : (n,); value : (n,) real or complex, in the file's units; axes : abscissa, ordinate, its denominator.
    length, force : factors of the preceding data set 164: file units per SI unit.
    """

    lines: tuple[str, ...]
    kind: int
    response: Point
    reference: Point
    even: bool
    abscissa: np.ndarray
    value: np.ndarray
    axes: tuple[Axis, Axis, Axis]
    length: float
    force: float
    place: str


def functions(path: Path) -> list[Function]:
    """All data sets 58 of a file; other data sets are skipped.

    Raises
    ------
    InputError : a truncated data set, or unreadable numbers; names the byte where the data set starts.
    """
    text = path.read_bytes()
    at, number = 0, 0
    found: list[Function] = []
    length = force = 1.0
    while at < len(text):
        line, after = _line(text, at)
        if not line.strip():
            at = after
            continue
        if line.strip() != MARK:
            shown = line[:40].decode("latin-1")
            raise InputError("expected a line '    -1' that opens a data set", field=f"byte {at}", value=shown)
        title, body = _line(text, after)
        number += 1
        place, kind = f"data set {number} (byte {at})", title[:6].strip()
        if title[:7].strip().lower() == b"58b" or kind == b"58":
            function, at = _function(text, title, body, (length, force), place)
            found.append(function)
            continue
        end = _closing(text, body, place)
        if kind == b"164":
            length, force = _units(text[body:end], place)
        at = _line(text, end)[1]
    return found


def _line(text: bytes, at: int) -> tuple[bytes, int]:
    """The line that starts at byte `at`, and the start of the next line."""
    end = text.find(b"\n", at)
    end = len(text) if end < 0 else end
    return text[at:end].rstrip(b"\r"), min(end + 1, len(text))


def _closing(text: bytes, at: int, place: str) -> int:
    """Position of the line '-1' that closes a data set of text."""
    while at < len(text):
        line, after = _line(text, at)
        if line.strip() == MARK:
            return at
        at = after
    raise InputError("cut short: the closing line '    -1' is missing", field=place)


def _units(body: bytes, place: str) -> tuple[float, float]:
    """Factors of length and force of data set 164."""
    text = "\n".join(body.decode("latin-1").splitlines()[1:])
    words = text.upper().replace("D", "E").split()[:2]
    factors = [float(word) for word in words if is_number(word)]
    if len(factors) < 2 or not all(0 < factor < np.inf for factor in factors):
        raise InputError("expected positive factors of length and force in data set 164", field=place, value=words)
    return factors[0], factors[1]


def _function(text: bytes, title: bytes, at: int, factors: tuple[float, float], place: str) -> tuple[Function, int]:
    header: list[str] = []
    for _ in range(HEADER_LINES):
        if at >= len(text):
            raise InputError(f"cut short: {len(header)} of {HEADER_LINES} header lines", field=place)
        line, at = _line(text, at)
        header.append(line.decode("latin-1"))
    dof, form = _words(header[5], _DOF), _words(header[6], _FORM)
    try:
        response = Point(_used(dof[4]), int(dof[5] or 0), int(dof[6] or 0))
        reference = Point(_used(dof[7]), int(dof[8] or 0), int(dof[9] or 0))
        kind, data_type, count, even = int(dof[0]), int(form[0]), int(form[1]), int(form[2]) == 1
        start, step = (_real(word) for word in form[3:5])
        axes = _axis(header[7]), _axis(header[8]), _axis(header[9])
    except (ValueError, IndexError):
        message = "expected the header of a data set 58; lines 6 to 10 cannot be read"
        raise InputError(message, field=place, value=header[6][:40]) from None
    if data_type not in (2, 4, 5, 6) or count < 1:
        message = "expected ordinate data type 2, 4, 5 or 6 and a number of values"
        raise InputError(message, field=place, value=(data_type, count))
    double, parts = data_type in (4, 6), 2 if data_type in (5, 6) else 1
    if b"b" in title[:7].lower():
        table, at = _binary(text, title, at, (count, even, double, parts), place)
    else:
        end = _closing(text, at, place)
        table, at = _ascii(text[at:end], (count, even, double, parts), place), _line(text, end)[1]
    abscissa = start + step * np.arange(count) if even else table[:, 0]
    ordinate = table if even else table[:, 1:]
    value = ordinate[:, 0] + 1j * ordinate[:, 1] if parts == 2 else ordinate[:, 0]
    if even and not (np.isfinite(start) and 0 < step < np.inf):
        raise InputError("expected a positive increment of the abscissa", field=place, value=step)
    lines = tuple(line.strip() for line in header[:5])
    return Function(lines, kind, response, reference, even, abscissa, value, axes, *factors, place), at


_DOF = (5, 10, 5, 10, 11, 10, 4, 11, 10, 4)
_FORM = (10, 10, 10, 13, 13, 13)
_AXIS = (10, 5, 5, 5, 21, 21)


def _words(line: str, widths: tuple[int, ...]) -> list[str]:
    """Fields of fixed width."""
    return [line[start:stop].strip() for start, stop in pairwise(accumulate(widths, initial=0))]


def _real(word: str) -> float:
    return float(word.replace("D", "E").replace("d", "e")) if word else 0.0


def _used(word: str) -> str:
    return "" if word.upper() == "NONE" else word


def _axis(line: str) -> Axis:
    """Axis from a header line; exponents of units and the axis label are ignored."""
    words = _words(line, _AXIS)
    return Axis(int(words[0] or 0), _used(words[5]))


Form = tuple[int, bool, bool, int]  # number of values, even spacing, double precision, 1 real or 2 complex


def _binary(text: bytes, title: bytes, at: int, form: Form, place: str) -> tuple[np.ndarray, int]:
    """(count, columns) of a data set 58b; uneven abscissae are single precision unless the size implies double."""
    count, even, double, parts = form
    words = title[:80].lower().split(b"b", 1)[1].split()
    try:
        order, floats, _, size = (int(word) for word in words[:4])
    except ValueError:
        message = "expected byte order, float format, header lines and number of bytes after '58b'"
        raise InputError(message, field=place, value=title.decode("latin-1").strip()[:60]) from None
    if order not in (1, 2) or floats != 2:
        raise InputError("expected byte order 1 or 2 and IEEE 754 floats (2)", field=place, value=(order, floats))
    width = 8 if double else 4
    types = [f"f{width}"] * parts
    if not even:
        types.insert(0, "f8" if double and size == count * width * (parts + 1) else "f4")
    layout = np.dtype([(f"c{i}", ("<" if order == 1 else ">") + kind) for i, kind in enumerate(types)])
    if size != count * layout.itemsize:
        raise InputError(f"expected {count * layout.itemsize} bytes for {count} values", field=place, value=size)
    if at + size > len(text):
        raise InputError(f"cut short: {len(text) - at} of {size} bytes of data are there", field=place)
    table = np.frombuffer(text, layout, count, at)
    closing = text[at + size : at + size + 84].lstrip(b"\r\n").split(b"\n", 1)[0]
    if closing.strip() != MARK:
        raise InputError("the closing line '    -1' does not follow the data", field=place)
    end = text.index(MARK, at + size)
    return np.stack([table[f"c{i}"].astype(float) for i in range(len(types))], axis=1), _line(text, end)[1]


def _ascii(body: bytes, form: Form, place: str) -> np.ndarray:
    """(count, columns) of a data set 58 in text; numbers that fill their fields are separated only by their signs."""
    count, even, _, parts = form
    columns = parts + (not even)
    words = re.sub(r"(?<=\d)(?=[+-])", " ", body.decode("latin-1").upper().replace("D", "E")).split()
    if len(words) < count * columns:
        raise InputError(f"cut short: {len(words)} of {count * columns} numbers are there", field=place)
    if len(words) > count * columns:
        raise InputError(f"expected {count * columns} numbers; there are {len(words)}", field=place)
    try:
        return np.array(words, dtype=float).reshape(count, columns)
    except ValueError:
        bad = next(word for word in words if not is_number(word))
        raise InputError("expected a number", field=place, value=bad[:40]) from None
