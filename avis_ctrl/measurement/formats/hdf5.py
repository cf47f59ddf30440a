"""HDF5 campaign: several records of one rig in one file, read in pieces, written completely or not at all.

Layout: attributes format = "avis-campaign", version = 1, rig; groups /records/<name> with the data sets u, y and, if
measured, floor.

A frequency response is stored in the group /frf instead of /records: the arrays of `stated_response` are data sets, its
other fields attributes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import EXCITATIONS, FLOOR_NAMES, Campaign, RecordSource, ranges
from avis_ctrl.measurement.formats import stored
from avis_ctrl.measurement.formats.common import (
    as_names,
    as_number,
    as_text,
    kind_of,
    printable,
    reading,
    require,
    require_small,
    within,
)
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.measurement.formats.records import Hints, Mapped, Part, record_from
from avis_ctrl.measurement.formats.response import COVARIANCES, stated_response
from avis_ctrl.measurement.formats.stored import Columns
from avis_ctrl.measurement.frequency_response import FrequencyResponse

FORMAT, VERSION = "avis-campaign", 1
ROLES = ("u", "y", "floor")
# Required attributes of each record.
STATED = {
    "sample_rate_Hz": "the sample rate in Hz",
    "excitation": f"one of {', '.join(EXCITATIONS)}",
    "level_V": "the r.m.s. of the driven voltages",
    "start_s": "the time of the first sample in s",
}
# Required attributes of a response, and its data sets with the allowed kinds of numbers.
NAMED = {
    "inputs": "the channels' names",
    "outputs": "the channels' names",
    "input_unit": "such as 'V'",
    "output_unit": "such as 'V'",
}
DATASETS = {
    "frequency_Hz": "fiu",
    "value": "fiuc",
    "coherence": "fiu",
    "variance": "fiu",
    **dict.fromkeys(COVARIANCES, "fiuc"),
}


@dataclass(frozen=True)
class ChunkSettings:
    """samples : samples per chunk on disk: with 128 KiB for each channel, a chunk is larger than what `WritingSettings`
    takes for metadata.
    """

    samples: int = 1 << 14


SETTINGS = ChunkSettings()


def read(path: Path, columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign | FrequencyResponse:
    """An HDF5 campaign, whose samples stay in the file until they are loaded, or its frequency response.

    columns, hints : not to be given for records, because the file states them itself. Errors name file, record and
    field.
    """
    with reading(path, "the HDF5 file"), stored.open_hdf5(path) as file:
        names = stored.members(file)
        response = "frf" in names and "records" not in names
        used = ("averages", "relative_standard_deviation") if response else ()
        for name, value in {"columns": columns, **vars(hints)}.items():
            if value is not None and name not in used:
                raise InputError("an HDF5 campaign states this itself; omit this argument", field=name, value=value)
        stated = _check_root(file)
        group = stored.member(file, "frf" if response else "records")
        if not isinstance(group, h5py.Group):
            missing = "missing; expected a group with one group per record"
            words = missing if group is None else "expected a group, found a data set"
            raise InputError(f"{words}; the file holds {_listed(file)}", field="/frf" if response else "/records")
        if response:
            with within("/frf"):
                return _response(path, group, hints)
        records = []
        for name in _in_order(group):
            with within(f"record {printable(name)}"):
                records.append(_record(group, name, str(path)))
        if not records:
            raise InputError("expected at least one record; the group is empty", field="/records")
        return Campaign(rig or stated, tuple(records), str(path))


def _listed(group: h5py.Group) -> str:
    """Names of the members of a group, for messages."""
    return ", ".join(sorted(map(printable, stored.members(group)))) or "nothing"


def _check_root(file: h5py.File) -> str:
    """Name of the rig, after format and version have been checked."""
    found = stored.attributes(file, "format", "version", "rig")
    with within("attributes of the file"):
        require(found, "format", f"{FORMAT!r}")
        require(found, "version", f"{VERSION}")
        check_version(found["format"], found["version"])
        return as_text(require(found, "rig", "the name of the rig"), "rig")


def check_version(stated: Any, version: Any) -> None:
    """Raise InputError unless format and version are those of a campaign."""
    if (name := as_text(stated, "format")) != FORMAT:
        raise InputError(f"expected {FORMAT!r}", field="format", value=name)
    if (number := as_number(version, "version")) != VERSION:
        raise InputError(f"expected {VERSION}, the version that this release reads", field="version", value=number)


def _in_order(group: h5py.Group) -> list[str]:
    """Names in the order of creation, if the file kept it; otherwise in natural order ("2" before "10")."""
    with stored.access("/records"):
        in_order = group.id.get_create_plist().get_link_creation_order()
    if in_order:
        return stored.members(group)

    def natural(name: str) -> list[tuple[bool, int, str]]:
        return [(part.isdigit(), int(part) if part.isdecimal() else 0, part) for part in re.split(r"(\d+)", name)]

    return sorted(stored.members(group), key=natural)


def _record(group: h5py.Group, name: str, path: str) -> RecordSource:
    record = stored.member(group, name)
    if not isinstance(record, h5py.Group):
        raise InputError("expected a group with u and y, found a data set")
    parts = {}
    for role in ROLES:
        dataset = stored.member(record, role)
        if dataset is not None:
            parts[role] = _part(dataset, role)
        elif role != "floor":
            message = f"missing; expected a data set (samples, channels); the record holds {_listed(record)}"
            raise InputError(message, field=role)
    if "floor" in parts and (names := tuple(parts["floor"].names)) != FLOOR_NAMES:
        raise InputError(f"expected the three velocities {', '.join(FLOOR_NAMES)}", field="floor names", value=names)
    found = stored.attributes(record, *STATED, "period_s")
    for field, expected in STATED.items():
        require(found, field, expected)
    hints = Hints().completed(found)
    assert hints.sample_rate_Hz is not None
    return record_from(name, parts, hints.sample_rate_Hz, 0.0, hints, path)[0]


def _part(dataset: Any, role: str) -> Part:
    """Channels of a data set of (samples, channels); the samples stay in the file."""
    shape, _ = _layout(dataset, role, "fiu")
    if shape is None or len(shape) not in (1, 2):
        raise InputError("expected shape (samples, channels)", field=role, value=shape)
    samples, count = shape[0], shape[1] if len(shape) == 2 else 1
    if samples == 0:
        raise InputError("expected samples; the record is empty", field=role, value=shape)
    if count > samples:
        message = (
            f"expected (samples, channels) with more samples than channels; {samples} samples of {count} channels look "
            "transposed"
        )
        raise InputError(message, field=role, value=shape)
    stated = stored.attributes(dataset, "names", "unit")
    with within(role):
        names, unit = require(stated, "names", "the channels' names"), require(stated, "unit", "such as 'V'")
    return Part(as_names(names, f"{role} names", count), unit, Columns(stored.full_name(dataset), samples))


def _layout(dataset: Any, field: str, kinds: str) -> tuple[tuple[int, ...] | None, np.dtype]:
    """Shape and type of a data set of these kinds of numbers."""
    if not isinstance(dataset, h5py.Dataset):
        raise InputError("expected a data set, found a group", field=field)
    shape, dtype = stored.layout(dataset)
    if dtype.kind not in kinds:
        message = "expected numbers" if "c" in kinds else "expected real numbers"
        raise InputError(message, field=field, value=f"data set of {kind_of(dtype)}")
    return shape, dtype


def _response(path: Path, group: h5py.Group, hints: Hints) -> FrequencyResponse:
    fields = {name: _numbers(path, group, name, kinds) for name, kinds in DATASETS.items()}
    if fields["frequency_Hz"] is None or fields["value"] is None:
        raise InputError(f"expected frequency_Hz and value; the group holds {_listed(group)}")
    stated = stored.attributes(group, *NAMED, "method", "dof", "averages")
    for field, expected in NAMED.items():
        require(stated, field, expected)
    return stated_response(fields | stated, hints)


def _numbers(path: Path, group: h5py.Group, name: str, kinds: str) -> Any:
    """Values of the data set with this name, None if there is none."""
    dataset = stored.member(group, name)
    if dataset is None:
        return None
    shape, dtype = _layout(dataset, name, kinds)
    require_small(path, math.prod(shape or ()) * dtype.itemsize)
    return stored.values(dataset)


def write_campaign(path: str | Path, campaign: Campaign, longest: int = 1 << 20) -> None:
    """Write an HDF5 campaign in pieces of at most `longest` samples; the file gets its name only when it is complete.

    Raises
    ------
    InputError : a record name that is used twice or cannot be the name of a group, a path that cannot be written, and
        any error in loading the records; an existing file is then unchanged.
    ComputationError : the disk is full; an existing file is then unchanged.
    """
    path = Path(path)
    names = [record.header.name for record in campaign.records]
    for name in names:
        if not name or "/" in name or "\0" in name or name in (".", ".."):
            raise InputError("expected a record's name without '/'", file=path, field="record", value=name)
        if names.count(name) > 1:
            raise InputError("expected different names of records", file=path, field="record", value=name)
    with replacing(path) as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "rig": campaign.rig})
        records = file.create_group("records", track_order=True)
        for record in campaign.records:
            _write_record(records.create_group(record.header.name), record, max(longest, 2))


def _write_record(group: h5py.Group, record: RecordSource, longest: int) -> None:
    header = record.header
    group.attrs.update({name: getattr(header, name) for name in STATED})
    if header.period_s is not None:
        group.attrs["period_s"] = header.period_s
    datasets = {}
    for role in ROLES if header.floor_names else ROLES[:2]:
        names, unit = getattr(header, f"{role}_names"), getattr(header, f"{role}_unit")
        shape = (header.samples, len(names))
        chunks = (min(SETTINGS.samples, header.samples), len(names)) if names else None
        datasets[role] = group.create_dataset(role, shape, np.float64, chunks=chunks)
        datasets[role].attrs["names"] = np.array(names, dtype=h5py.string_dtype())
        datasets[role].attrs["unit"] = unit
    for start, stop in ranges(header.samples, longest):
        piece = record.load(start, stop)
        for role, dataset in datasets.items():
            dataset[start:stop] = getattr(piece, role)


def write_frequency_response(path: str | Path, response: FrequencyResponse, rig: str = "unnamed") -> None:
    """Write a frequency response as an HDF5 campaign without records; the file gets its name only when it is complete.

    Raises
    ------
    InputError : a path that cannot be written; an existing file is then unchanged.
    ComputationError : the disk is full; an existing file is then unchanged.
    """
    with replacing(Path(path)) as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "rig": rig})
        group = file.create_group("frf")
        group["frequency_Hz"], group["value"] = response.frequency_Hz, np.asarray(response.value, complex)
        for field in COVARIANCES:
            if getattr(response, field) is not None:
                group[field] = getattr(response, field)
        if response.entry_variance is not None:
            group["variance"] = response.entry_variance
        for field in ("inputs", "outputs"):
            group.attrs[field] = np.array(getattr(response, field), dtype=h5py.string_dtype())
        for field in ("input_unit", "output_unit", "method", "dof"):
            group.attrs[field] = getattr(response, field)
