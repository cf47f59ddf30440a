"""CSV records: a header line with channel names, lines of numbers, and comments of the form `# key = value`.

    # sample_rate_Hz = 1000         (instead of a column t)
    # excitation = noise            (also level_V, period_s, start_s, rig)
    t [s],Az1 [V],Sz1 [V]
    0.000,0.1,-0.002

Separator (comma, semicolon, tab) and decimal comma are detected. Without a column mapping, t or time is the time, u*
and A1, Ax1, ... are inputs, y* and S1, Sx1, ... are outputs, vx, vy, vz the floor.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, RecordSource, require_finite
from avis_ctrl.measurement.formats.common import INPUT_NAME, existing_file, is_number, reading, require_small, within
from avis_ctrl.measurement.formats.records import Hints, Mapped, Part, campaign_from, mapped, pick, record_from
from avis_ctrl.measurement.formats.time_axis import agreed_rate, sample_rate_from

USUAL = {"t": r"t|time|t_s|time_s", "u": INPUT_NAME, "y": r"y_?\w*|s[xyz]?\d+"}
STATED = ("sample_rate_Hz", "level_V", "start_s", "period_s", "excitation")
TIME_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}


@dataclass(frozen=True)
class CsvSettings:
    """chunk_lines : lines that are converted to numbers at once: the text of a whole file need not fit into memory.
    longest_line : length of a line [characters] from which the file is rejected: no header is that long, and binary
        data without line ends must not fill the memory.
    """

    chunk_lines: int = 1 << 16
    longest_line: int = 1 << 20


SETTINGS = CsvSettings()


@dataclass(frozen=True)
class Layout:
    """Contents of the header of a CSV file."""

    names: list[str]
    units: list[str | None]
    separator: str
    stated: dict[str, str]
    lines: int  # number of lines before the first line of numbers


def read(path: Path, columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign:
    """A CSV file (one record) or a directory of CSV files (one record each, in the order of their names).

    columns : roles t, u, y, floor to names of columns. Errors name file, line and column, or number and place of wrong
    time stamps.
    """
    files = [path]
    if path.is_dir():
        shown = [file for file in path.iterdir() if not file.name.startswith(".")]
        files = sorted(file for file in shown if file.suffix.lower() == ".csv" and file.is_file())
        if not files:
            raise InputError("expected CSV files (*.csv) in the directory; there is none", file=path)
    require_small(path, sum(file.stat().st_size for file in files))
    records, notes, rigs = [], [], []
    for file in files:
        with reading(file, "the CSV file"):
            record, assumed, stated = _record(existing_file(file), columns, hints)
        records.append(record)
        notes += assumed
        rigs.append(stated)
    return campaign_from(records, notes, rig or rigs[0], path)


def is_text(head: bytes) -> bool:
    """Whether the first bytes of a file are text."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return True
    return bool(head.strip()) and not re.search(rb"[\x00-\x08\x0e-\x19\x1b-\x1f\x7f]", head)


def _open(path: Path) -> TextIO:
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not is_text(head):
        raise InputError("expected text; the file holds binary data or nothing", file=path)
    utf16 = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return path.open(encoding="utf-16" if utf16 else "utf-8-sig", errors="replace" if utf16 else "surrogateescape")


def _lines(stream: TextIO) -> Iterator[str]:
    """Lines without line ends; bytes that are not UTF-8 are read as Latin-1, the older encoding of measurement
    software.
    """
    while line := stream.readline(SETTINGS.longest_line):
        if len(line) == SETTINGS.longest_line:
            raise InputError(f"expected lines shorter than {SETTINGS.longest_line} characters")
        line = line.rstrip("\r\n\x1a").replace('"', "")
        if not line.isascii() and any("\udc80" <= letter <= "\udcff" for letter in line):
            line = line.encode("utf-8", "surrogateescape").decode("latin-1")
        yield line


def _layout(lines: Iterator[str], numbered: bool = False) -> Layout:
    stated: dict[str, str] = {}
    count, line = 0, ""
    for line in lines:
        count += 1
        if line.strip().startswith("#"):
            key, equals, value = line.strip().lstrip("#").partition("=")
            if equals:
                stated[key.strip()] = value.strip()
        elif line.strip() and not re.fullmatch(r"\s*sep=.\s*", line):  # Excel's line with the separator
            break
    else:
        raise InputError(f"expected a header line with the names of the columns; there are {count} lines without one")
    separator = next((mark for mark in ";\t," if mark in line), ",")
    titles = [title.strip() for title in line.split(separator)]
    if titles and not titles[-1]:  # every line ends with a separator
        titles = titles[:-1]
    if all(is_number(title.replace(",", ".")) for title in titles):
        if numbered:  # no header line; the columns are given by number
            names = [str(k + 1) for k in range(len(titles))]
            return Layout(names, [None] * len(names), separator, stated, count - 1)
        message = "expected a header line with the names of the columns, found numbers"
        raise InputError(message, field=f"line {count}", value=line[:60])
    names, units = [], []
    for title in titles:
        match = re.fullmatch(r"(.*?)\s*[\[(]([^\])]*)[\])]", title)
        names.append(match[1] if match and match[1] else title)
        units.append(match[2] if match and match[1] else None)
    for name in names:
        if not name or names.count(name) > 1:
            raise InputError("expected column names that differ and are not empty", field=f"line {count}", value=name)
    return Layout(names, units, separator, stated, count)


def _numbered(columns: Mapped | None) -> bool:
    """Whether all columns are given by number."""
    names = [name for role in ("t", "u", "y", "floor") for name in mapped(columns, role) or []]
    return bool(names) and all(name.isdigit() for name in names)


def _roles(layout: Layout, columns: Mapped | None, path: Path) -> dict[str, list[str]]:
    """Names of the columns of each role, from the caller's mapping or by their usual names."""
    titles = {f"{name} [{unit}]": name for name, unit in zip(layout.names, layout.units, strict=True) if unit}
    titles |= {str(k + 1): name for k, name in enumerate(layout.names) if str(k + 1) not in layout.names}
    if columns is not None:
        roles = {}
        for role in ("t", "u", "y", "floor"):
            names = [titles.get(name, name) for name in mapped(columns, role) or []]
            pick(names, layout.names, role)
            roles[role] = names
    else:
        roles = {
            role: [name for name in layout.names if re.fullmatch(pattern, name, re.IGNORECASE)]
            for role, pattern in USUAL.items()
        }
        roles["floor"] = list(FLOOR_NAMES) if set(FLOOR_NAMES) <= set(layout.names) else []
    if len(roles["t"]) <= 1 and roles["y"]:
        return roles
    if not roles["t"] and not _followed_by_numbers(path, layout, layout.separator):
        message = (
            "expected columns separated by commas, semicolons or tabs; these are separated by spaces"
            if _followed_by_numbers(path, layout, None)
            else "not a measurement file: a text without a header line followed by lines of numbers"
        )
        raise InputError(message, field=f"line {layout.lines}", value=", ".join(layout.names)[:60])
    role, wanted = ("t", "at most one column") if len(roles["t"]) > 1 else ("y", "at least one column")
    message = (
        f"expected {wanted}; the file has {', '.join(layout.names)}; assign them with columns, on the command line "
        "--columns u=NAME+NAME,y=NAME+NAME (roles t, u, y, floor)"
    )
    raise InputError(message, field=role, value=roles[role])


def _followed_by_numbers(path: Path, layout: Layout, separator: str | None) -> bool:
    """Whether the first non-empty line below the header contains numbers. separator : None for spaces."""
    with _open(path) as stream:
        below = (line for line in islice(_lines(stream), layout.lines, None) if line.strip())
        entries = [entry.strip().replace(",", ".") for entry in next(below, "").split(separator)]
    return any(entries) and all(is_number(entry) for entry in entries if entry)


def _record(path: Path, columns: Mapped | None, hints: Hints) -> tuple[RecordSource, list[str], str]:
    with _open(path) as stream:
        lines = _lines(stream)
        layout = _layout(lines, _numbered(columns))
        if layout.names == [str(k + 1) for k in range(len(layout.names))] and _numbered(columns):
            stream.seek(0)
            lines = islice(_lines(stream), layout.lines, None)
        roles = _roles(layout, columns, path)
        use = [k for k, name in enumerate(layout.names) if any(name in names for names in roles.values())]
        table, place = _table(lines, layout, use)
    at = {layout.names[k]: i for i, k in enumerate(use)}
    unit = dict(zip(layout.names, layout.units, strict=True))
    parts = {}
    for role, names in roles.items():
        if role in ("u", "y") or (role == "floor" and names):
            samples = table[:, [at[name] for name in names]]
            require_finite(samples, names, None, place)
            parts[role] = Part(names, [unit[name] for name in names], samples)
    hints = _with_stated(hints, layout.stated)
    time = roles["t"][0] if roles["t"] else ""
    rate, start, note = _clock(table[:, at[time]] if time else None, unit.get(time), place, hints)
    record, notes = record_from(path.stem, parts, rate, start, hints)
    notes += [f"record {path.stem}: {note}"] if note else []
    unused = [name for k, name in enumerate(layout.names) if k not in use]
    if unused and columns is None:
        notes.append(f"record {path.stem}: columns without a usual name are not used: {', '.join(unused)}")
    return record, notes, layout.stated.get("rig", "")


def _with_stated(hints: Hints, stated: dict[str, str]) -> Hints:
    """Hints completed with the comments of the file."""
    texts = {field: stated[field].replace(",", ".") for field in STATED if field in stated}
    with within("comment"):
        return hints.completed({field: float(text) if is_number(text) else text for field, text in texts.items()})


def _clock(
    time: np.ndarray | None, unit: str | None, place: Callable[[int], str], hints: Hints
) -> tuple[float, float, str]:
    if time is not None:
        if unit is not None and unit not in TIME_UNITS:
            raise InputError(f"expected one of {', '.join(TIME_UNITS)}", field="unit of t", value=unit)
        factor = TIME_UNITS[unit or "s"]
        rate, start, note = sample_rate_from(time * factor, place)
        return rate if hints.sample_rate_Hz is None else agreed_rate(hints.sample_rate_Hz, rate), start, note
    if hints.sample_rate_Hz is None:
        raise InputError(
            "expected a column t (time in s) or a comment line such as '# sample_rate_Hz = 1000'", field="t"
        )
    return hints.sample_rate_Hz, 0.0, ""


def _table(lines: Iterator[str], layout: Layout, use: list[int]) -> tuple[np.ndarray, Callable[[int], str]]:
    """(rows, columns used) numbers, read chunk by chunk; and the place of a row in the file, for messages."""
    blocks, numbers, row, decimal_comma = [], [], layout.lines, None
    separators = len(layout.names) - 1
    while chunk := list(islice(lines, SETTINGS.chunk_lines)):
        if decimal_comma is None:
            decimal_comma = layout.separator != "," and any("," in line for line in chunk)
        if decimal_comma:
            chunk = [line.replace(",", ".") for line in chunk]
        for number, line in enumerate(chunk, row + 1):
            count = line.count(layout.separator)
            ends = (count, line.rstrip()[-1:]) == (separators + 1, layout.separator.strip())
            if count != separators and line.strip() and not ends:
                hint = "; with decimal commas, separate columns by ;" if layout.separator == "," else ""
                message = f"expected {separators + 1} columns, as in the header; there are {count + 1}{hint}"
                raise InputError(message, field=f"line {number}", value=line[:60])
        filled = [line for line in chunk if line.strip()]
        numbers.append(np.array([number for number, line in enumerate(chunk, row + 1) if line.strip()], dtype=int))
        try:
            if filled:
                blocks.append(np.loadtxt(filled, delimiter=layout.separator, usecols=use, ndmin=2, comments=None))
        except ValueError:
            raise _misfit(chunk, row, sum(map(len, numbers[:-1])), layout, use) from None
        row += len(chunk)
    table = np.concatenate(blocks) if blocks else np.zeros((0, len(use)))
    if len(table) < 2:
        raise InputError(f"expected at least two lines of numbers; there are {len(table)}")
    at = np.concatenate(numbers)
    return table, lambda sample: f"line {at[sample]} (sample {sample})"


def _misfit(chunk: list[str], row: int, sample: int, layout: Layout, use: list[int]) -> InputError:
    """Error with the place of the first entry that is not a number. sample : of the first line with numbers."""
    for number, line in enumerate(chunk, row + 1):
        entries = line.split(layout.separator)
        for column in use if line.strip() else ():
            if not is_number(entries[column]) or "_" in entries[column]:
                found = entries[column].strip()
                units = "; units belong in the header, such as t [s]" if sample == 0 and found.isalpha() else ""
                message = f"expected a number{units}" if found else "expected a number, found nothing"
                field = f"line {number} (sample {sample}), column {layout.names[column]}"
                return InputError(message, field=field, value=found[:40])
        sample += bool(line.strip())
    return InputError("expected numbers", field=f"lines {row + 1} to {row + len(chunk)}")
