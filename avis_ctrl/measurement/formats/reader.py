"""One door to every measurement file: the format is told by the content, not by the name."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats import csv, hdf5, matlab, uff
from avis_ctrl.measurement.formats.common import existing_file, reading
from avis_ctrl.measurement.formats.flat import ROLES, hints_from
from avis_ctrl.measurement.formats.stored import attributes, member, members, open_hdf5
from avis_ctrl.measurement.formats.stored_response import read_frequency_response
from avis_ctrl.measurement.frequency_response import FrequencyResponse

FORMATS = """\
Measurement files, told apart by their content:
  HDF5 campaign   /records/NN with u, y, floor; or /frf with frequency_Hz, value and variance or coherence
  MATLAB .mat     v5 to v7.3: struct array `records` with `rig`; or flat variables u, y and t or fs;
                  or frequency_Hz, H and variance, or coherence with averages
  UFF 58, 58b     time responses, or frequency responses with their coherence; ASCII or binary
  CSV             header line with channel names such as "Sz1 [V]", column t or "# sample_rate_Hz = 1000";
                  a directory of CSV files is a campaign, one record each
A mapping of columns says which variable, channel or column is what: u=vir,y=qm,t=t (roles t, u, y, floor,
sample_rate_Hz, u_names, y_names; several of one role: u=A1+A2).
"""


def parse_columns(text: str) -> dict[str, list[str]]:
    """A mapping of columns from the text of a command line: "u=A1+A2,y=S1,t=time".

    Raises
    ------
    InputError : no role or no name, a role that does not exist or comes twice.
    """
    columns: dict[str, list[str]] = {}
    for part in text.split(","):
        role, equals, names = (word.strip() for word in part.partition("="))
        if not equals or role not in ROLES or role in columns or not all(name.strip() for name in names.split("+")):
            raise InputError(f"expected role=name, each role once, of {', '.join(ROLES)}; such as u=A1+A2,y=S1,t=time",
                             field="columns", value=part.strip())
        columns[role] = [name.strip() for name in names.split("+")]
    return columns


def read_measurements(path: str | Path, columns: Mapping[str, Any] | None = None, rig: str | None = None,
                      **hints: Any) -> Campaign | FrequencyResponse:
    """Measurements of whatever format: a campaign of records, or a frequency response.

    columns : roles (t, u, y, floor, ...) to names, for files of flat columns; rig : name of the rig, in the place of
    the file's; hints : what the file does not say, see `flat.Hints` (sample_rate_Hz, excitation, period_s, level_V,
    start_s, u_unit, y_unit, averages, relative_standard_deviation). A self-describing HDF5 campaign takes none of the
    hints for records: it states them.

    Raises
    ------
    InputError : one line that names the file, the field, its value and what was expected.
    """
    known = hints_from(hints)
    path = Path(path)
    with reading(path):
        if os.path.isdir(path):  # False, not an error, for names that no file can have
            return csv.read(path, columns, rig, known)
        path = existing_file(path)
        with path.open("rb") as stream:
            head = stream.read(4096)
    if head.startswith(b"MATLAB "):
        return matlab.read(path, columns, rig, known)
    if matlab.is_version_4(head):
        raise InputError("a MATLAB v4 file; expected version 5 to 7.3: load it in MATLAB and save it with -v7",
                         file=path)
    if _is_hdf5(path, head):
        return _hdf5(path, columns, rig, hints)
    if _is_uff(head):
        return uff.read(path, columns, rig, known)
    if csv.is_text(head):
        return csv.read(path, columns, rig, known)
    raise InputError("expected HDF5, MATLAB .mat (v5 to v7.3), UFF 58 or CSV; the content is none of them", file=path)


def _is_hdf5(path: Path, head: bytes) -> bool:
    """By the signature; h5py also looks behind a user block."""
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return True
    try:
        return bool(h5py.is_hdf5(path))
    except (OSError, RuntimeError, ValueError):
        return False


def _is_uff(head: bytes) -> bool:
    lines = head.lstrip().splitlines()
    return len(lines) > 1 and lines[0].strip() == b"-1" and lines[1][:6].strip().rstrip(b"bB").isdigit()


def _hdf5(path: Path, columns: Mapping[str, Any] | None, rig: str | None,
          hints: Mapping[str, Any]) -> Campaign | FrequencyResponse:
    with reading(path, "the HDF5 file"), open_hdf5(path) as file:
        names = members(file)
        matlab_classes = not attributes(file, "format") and any(
            item is not None and attributes(item, "MATLAB_class")
            for item in (member(file, name) for name in names))  # None: a broken link
        response = "frf" in names and "records" not in names
    if matlab_classes:  # a v7.3 file that lost its text header
        return matlab.read(path, columns, rig, hints_from(hints))
    used = ("averages", "relative_standard_deviation") if response else ()
    for name, value in {"columns": columns, **hints}.items():
        if value is not None and name not in used:
            raise InputError("an HDF5 campaign states this itself; expected no such argument", file=path, field=name,
                             value=value)
    if response:
        return read_frequency_response(path, **{name: hints.get(name) for name in used})
    return hdf5.read(path, rig)
