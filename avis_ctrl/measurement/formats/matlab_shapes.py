"""What a .mat file's variables are as measurements: matrices and which way round they are, units, the clock."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import as_names, as_number, as_text, numbers, stated_period
from avis_ctrl.measurement.formats.matlab_tree import Matrix, Unreadable, describe, overview
from avis_ctrl.measurement.formats.records import Hints
from avis_ctrl.measurement.formats.time_axis import sample_rate_from

MUCH_LONGER = 10  # a record has at least that many times more samples than channels, where names do not say
USUAL = {"u": ("u", "U", "input"), "y": ("y", "Y", "output"), "t": ("t", "time"), "floor": ("floor",),
         "sample_rate_Hz": ("sample_rate_Hz", "fs", "Fs", "FS"), "u_names": ("u_names",), "y_names": ("y_names",)}
PERIODS = ("Ts", "dt")


def plain(value: Any) -> Any:
    """A small matrix as an array."""
    return value.read() if isinstance(value, Matrix) and math.prod(value.shape) <= 1000 else value


def empty(value: Any) -> bool:
    """Nothing, an array of no elements, an empty cell array, an empty text: how struct arrays leave a field out."""
    if isinstance(value, Matrix):
        return 0 in value.shape
    return value is None or (isinstance(value, (list, str)) and not value)


def usual(tree: Mapping[str, Any], role: str) -> list[str]:
    """The variable or field that is called what a role usually is, if there is one."""
    return [name for name in USUAL[role] if not empty(tree.get(name))][:1]


def matrix(value: Any, field: str) -> Matrix:
    """A real matrix with samples in it, or an InputError that says what it is."""
    if not isinstance(value, Matrix) or value.kind not in "fiu" or len(value.shape) != 2:
        words = f"a {value.kind}" if isinstance(value, Unreadable) else describe(value)
        raise InputError("expected a real matrix, samples by channels", field=field, value=words)
    if 0 in value.shape:
        raise InputError("expected samples, found an empty array", field=field)
    return value


def sample_count(matrices: Mapping[str, Sequence[Matrix]], channels: Mapping[str, int],
                 known: int | None = None) -> int:
    """Number of samples that all matrices share, whichever way round they are.

    channels : number of channels of a role, where names tell it; known : length of the time vector.

    Raises
    ------
    InputError : no common length; square matrices; rows and columns that could both be the samples.
    """
    shapes = {role: [item.shape for item in items] for role, items in matrices.items()}
    shown = ", ".join(f"{role} is {' and '.join('x'.join(map(str, shape)) for shape in some)}"
                      for role, some in shapes.items())
    possible = None if known is None else {known}
    for role, some in shapes.items():
        for rows, columns in some:
            lengths = {rows, columns} if min(rows, columns) > 1 else {max(rows, columns)}
            if role in channels:
                lengths = {length for length, others in ((rows, columns), (columns, rows)) if others == channels[role]}
                if not lengths:
                    raise InputError(f"expected {channels[role]} channels, as there are names; it is {rows}x{columns}",
                                     field=role)
            possible = lengths if possible is None else possible & lengths
    if not possible:
        also = "" if known is None else f", t has {known}"
        raise InputError(f"expected equally many samples; {shown}{also}")
    samples = max(possible)
    square = any(rows == columns and rows > 1 for some in shapes.values() for rows, columns in some)
    if square or (len(possible) > 1 and samples < MUCH_LONGER * min(possible)):
        raise InputError(f"rows and columns could both be the samples: {shown}; expected names of the channels or a "
                         "time vector that distinguishes them")
    return samples


def oriented(item: Matrix, samples: int, field: str) -> np.ndarray:
    """(samples, channels) float64."""
    array = numbers(item.read(), field)
    return array if array.shape[0] == samples else array.T


def with_stated(hints: Hints, tree: Mapping[str, Any]) -> Hints:
    """Hints completed by variables or fields of the same names."""
    found: dict[str, Any] = {}
    for field in ("level_V", "start_s"):
        if getattr(hints, field) is None and not empty(tree.get(field)):
            found[field] = as_number(plain(tree[field]), field)
    if hints.period_s is None and not empty(tree.get("period_s")):
        found["period_s"] = stated_period(plain(tree["period_s"]), "period_s")
    if hints.excitation is None and not empty(tree.get("excitation")):
        found["excitation"] = as_text(tree["excitation"], "excitation")
    return replace(hints, **found)


def stated_names(value: Sequence[str], tree: Mapping[str, Any], field: str, count: int | None) -> tuple[str, ...]:
    """Channel names from a variable of that name, or the names that the caller wrote instead of one."""
    if len(value) == 1 and value[0] in tree:
        return as_names(plain(tree[value[0]]), field, count)
    if len(value) == 1 and count is None:
        raise InputError("no variable of that name, and too few for names of the channels themselves (A+B+...); the "
                         f"file has {overview(tree)}", field=field, value=value[0])
    return as_names(list(value), field, count)


def clock(tree: Mapping[str, Any], chosen: Mapping[str, list[str]],
           hints: Hints) -> tuple[float, float, str, int | None]:
    """Sample rate [Hz], first time [s], note, number of samples (None where there is no time vector)."""
    start, note, known, rate = 0.0, "", None, None
    if chosen["t"]:
        name = chosen["t"][0]
        times = matrix(tree[name], name)
        if 1 not in times.shape:
            raise InputError("expected a vector of time stamps in s", field=name, value=describe(times))
        rate, start, note = sample_rate_from(numbers(times.read(), name).reshape(-1), field=name)
        known = max(times.shape)
    stated, source = hints.sample_rate_Hz, "hint sample_rate_Hz"
    if stated is None and chosen["sample_rate_Hz"]:
        source = chosen["sample_rate_Hz"][0]
        stated = as_number(plain(tree[source]), source)
    for name in PERIODS:
        if stated is None and rate is None and name in tree:
            source, period = name, as_number(plain(tree[name]), name)
            if period <= 0:
                raise InputError("expected a positive sampling period in s", field=name, value=period)
            stated = 1 / period
    if stated is not None and rate is not None and abs(stated / rate - 1) > 1e-3:
        raise InputError(f"expected {rate:.9g} Hz, as the time vector says", field=source, value=stated)
    result = stated if stated is not None else rate
    if result is None:
        raise InputError(f"expected t, fs or sample_rate_Hz; the file has {overview(tree)}", field="sample rate")
    return result, start, note, known
