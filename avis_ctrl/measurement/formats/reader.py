"""Common entry point for all measurement files: the format is recognised by the content, not by the name."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py

from avis_ctrl.errors import InputError
from avis_ctrl.files import HDF5
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats import csv, hdf5, matlab, uff
from avis_ctrl.measurement.formats.common import existing_file, reading
from avis_ctrl.measurement.formats.records import ROLES, hints_from, mapped, with_header
from avis_ctrl.measurement.formats.stored import attributes, member, members, open_hdf5
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.layouts import FORMATS

__all__ = ["FORMATS", "parse_columns", "read_measurements"]

NAMING = ("u_names", "y_names")
# Suffixes of text files that could be taken for CSV.
NO_MEASUREMENT = {".py", ".m", ".md", ".rst", ".toml", ".json", ".yaml", ".yml", ".html", ".ipynb", ".tex", ".sh"}


def parse_columns(text: str) -> dict[str, list[str]]:
    """Column mapping from a command-line text such as "u=A1+A2,y=S1,t=time".

    Raises
    ------
    InputError : no role or no name, an unknown or repeated role.
    """
    columns: dict[str, list[str]] = {}
    for part in text.split(","):
        role, equals, names = (word.strip() for word in part.partition("="))
        listed = [name.strip() for name in names.split("+")]
        if not equals or role not in ROLES or role in columns or not all(listed):
            roles = ", ".join(ROLES)
            message = f"expected role=name, each role once, such as u=A1+A2,y=S1,t=time; the roles are {roles}"
            raise InputError(message, field="columns", value=part.strip())
        columns[role] = listed
    return columns


def read_measurements(
    path: str | Path, columns: Mapping[str, Any] | None = None, rig: str | None = None, **hints: Any
) -> Campaign | FrequencyResponse:
    """Read measurements in any supported format: a campaign of records, or a frequency response.

    columns : roles (t, u, y, floor, ...) to names, for files of flat columns; u_names and y_names to the name of a
    MATLAB variable or, in any format, to the channel names themselves in the order of the file; rig : name of the rig,
    which replaces that of the file; hints : what the file does not state, see `records.Hints`. A self-describing HDF5
    campaign accepts no hints for records, because it states them itself.

    Raises
    ------
    InputError : one line with the file, the field, its value and what was expected.
    """
    known, path = hints_from(hints), Path(path)
    naming = {role: names for role in NAMING if (names := mapped(columns, role))}
    plain = {role: names for role, names in (columns or {}).items() if role not in NAMING} or None
    with reading(path):
        if os.path.isdir(path):  # False, not an error, for impossible file names
            return renamed(csv.read(path, plain, rig, known), naming)
        path = existing_file(path)
        if path.suffix.lower() in NO_MEASUREMENT:
            raise InputError(f"not a measurement file ({path.suffix}); expected HDF5, MATLAB .mat, UFF 58 or CSV")
        with path.open("rb") as stream:
            head = stream.read(4096)
        kind = _format(path, head)
        if kind == "matlab":
            measured = matlab.read(path, columns, rig, known)
            if isinstance(measured, Campaign):
                return measured  # the names are already used, e.g. to find the orientation of a matrix
        else:
            measured = {"hdf5": hdf5.read, "uff": uff.read, "csv": csv.read}[kind](path, plain, rig, known)
        return renamed(measured, naming)


def _format(path: Path, head: bytes) -> str:
    """Name of the reader for a file, by its content."""
    if head.startswith(b"MATLAB "):
        return "matlab"
    if matlab.is_version_4(head):
        raise InputError("a MATLAB v4 file; expected version 5 to 7.3: load it in MATLAB and save it with -v7")
    if _is_hdf5(path, head):
        with open_hdf5(path) as file:
            # A v7.3 file that lost its text header.
            items = () if attributes(file, "format") else [member(file, name) for name in members(file)]
            found = any(item is not None and attributes(item, "MATLAB_class") for item in items)  # None: a broken link
        return "matlab" if found else "hdf5"
    lines = head.lstrip().splitlines()
    if len(lines) > 1 and lines[0].strip() == b"-1" and lines[1][:6].strip().rstrip(b"bB").isdigit():
        return "uff"
    if csv.is_text(head):
        return "csv"
    raise InputError("expected HDF5, MATLAB .mat (v5 to v7.3), UFF 58 or CSV; the content is none of them")


def _is_hdf5(path: Path, head: bytes) -> bool:
    """By the signature; h5py also finds it behind a user block."""
    if head.startswith(HDF5):
        return True
    try:
        return bool(h5py.is_hdf5(path))
    except (OSError, RuntimeError, ValueError):
        return False


def renamed(measured: Campaign | FrequencyResponse, naming: Mapping[str, list[str]]) -> Campaign | FrequencyResponse:
    """The same measurements with other channel names; naming : u_names, y_names to names in the order of the file.

    Raises
    ------
    InputError : a number of names that differs from the number of channels.
    """
    response = isinstance(measured, FrequencyResponse)
    fields = {"u_names": "inputs", "y_names": "outputs"} if response else {"u_names": "u_names", "y_names": "y_names"}
    changes: dict[str, Any] = {}
    for role, names in naming.items():
        old = getattr(measured, fields[role])
        if len(names) != len(old):
            message = f"expected {len(old)} names, for the channels {', '.join(old)}; there are {len(names)}"
            raise InputError(message, field=f"columns: {role}", value="+".join(names))
        changes[fields[role]] = tuple(names)
    if not changes:
        return measured
    if isinstance(measured, FrequencyResponse):
        return replace(measured, **changes)
    return replace(measured, records=tuple(with_header(record, **changes) for record in measured.records))
