"""HDF5 campaign: several records of one rig in one file, read in pieces, written whole or not at all.

Layout: attributes format = "avis-campaign", version = 1, rig; groups /records/<name> with the data sets u, y and,
where it was measured, floor. A frequency response lies in the group /frf (see `stored_response`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, RecordHeader, RecordSource, ranges
from avis_ctrl.measurement.formats.common import (
    as_names,
    as_number,
    as_text,
    existing_file,
    header_from,
    kind_of,
    printable,
    reading,
    require,
    units_of,
)
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.measurement.formats.stored import (
    Columns,
    StoredRecord,
    access,
    attributes,
    full_name,
    layout,
    member,
    members,
    open_hdf5,
)

FORMAT, VERSION = "avis-campaign", 1
ROLES = ("u", "y", "floor")
CHUNK = 1 << 14  # samples of a record that lie together on disk


def read(path: str | Path, rig: str | None = None) -> Campaign:
    """An HDF5 campaign; its samples stay in the file until they are loaded.

    rig : name of the rig, in the place of the file's.

    Raises
    ------
    InputError : not such a file, a missing or wrong attribute or data set; names file, record and field.
    """
    path = existing_file(path)
    with reading(path, "the HDF5 file"), open_hdf5(path) as file:
        stated = check_root(file)
        group = member(file, "records")
        if group is None:
            raise InputError(f"missing; expected a group with one group per record; the file holds {listed(file)}",
                             field="/records")
        if not isinstance(group, h5py.Group):
            raise InputError("expected a group, found a data set", field="/records")
        records = tuple(_record(group, name, str(path)) for name in _in_order(group))
        if not records:
            raise InputError("expected at least one record; the group is empty", field="/records")
        return Campaign(rig or stated, records, str(path))


def listed(group: h5py.Group) -> str:
    """What a group holds, in words."""
    return ", ".join(sorted(map(printable, members(group)))) or "nothing"


def check_root(file: h5py.File) -> str:
    """Name of the rig, after format and version were checked."""
    found = attributes(file, "format", "version", "rig")
    stated = as_text(require(found, "format", "attributes of the file", f"{FORMAT!r}"), "attribute format")
    if stated != FORMAT:
        raise InputError(f"expected {FORMAT!r}", field="attribute format", value=stated)
    version = as_number(require(found, "version", "attributes of the file", f"{VERSION}"), "attribute version")
    if version != VERSION:
        raise InputError(f"expected {VERSION}, the version that this release reads", field="attribute version",
                         value=version)
    return as_text(require(found, "rig", "attributes of the file", "the name of the rig"), "attribute rig")


def _in_order(group: h5py.Group) -> list[str]:
    """Names in the order they were written, where the file kept it; otherwise "2" before "10"."""
    with access("/records"):
        in_order = group.id.get_create_plist().get_link_creation_order()
    if in_order:
        return members(group)
    return sorted(members(group), key=lambda name: [(part.isdigit(), int(part) if part.isdecimal() else 0, part)
                                           for part in re.split(r"(\d+)", name)])


def _record(group: h5py.Group, name: str, path: str) -> StoredRecord:
    where, record = f"record {printable(name)}", member(group, name)
    if not isinstance(record, h5py.Group):
        raise InputError("expected a group with u and y, found a data set", field=where)
    channels: dict[str, tuple[str, ...]] = {}
    units: dict[str, str] = {}
    columns: dict[str, tuple[Columns, ...]] = {}
    samples = {}
    for role in ROLES:
        dataset = member(record, role)
        if dataset is None:
            if role == "floor":
                continue
            raise InputError(f"missing; expected a data set (samples, channels); the record holds {listed(record)}",
                             field=f"{where}: {role}")
        samples[role], count = _shape(dataset, f"{where}: {role}")
        stated = attributes(dataset, "names", "unit")
        channels[role] = as_names(require(stated, "names", f"{where}: {role}", "the channels' names"),
                                  f"{where}: {role} names", count)
        units[role], factors = units_of(require(stated, "unit", f"{where}: {role}", "such as 'V'"), role, where,
                                        count)
        columns[role] = (Columns(full_name(dataset), factors),)
    require_one_length(samples, where)
    stated = attributes(record, "sample_rate_Hz", "excitation", "level_V", "start_s", "period_s")
    return StoredRecord(header_from(stated, name, samples["u"], channels, units), path, columns)


def require_one_length(samples: dict[str, int], where: str) -> None:
    """All parts of a record are equally long."""
    if len(set(samples.values())) > 1:
        lengths = ", ".join(f"{role} has {count}" for role, count in samples.items())
        raise InputError(f"expected equally many samples; {lengths}", field=where)


def _shape(dataset: Any, field: str) -> tuple[int, int]:
    """(samples, channels) of a data set of real numbers."""
    if not isinstance(dataset, h5py.Dataset):
        raise InputError("expected a data set, found a group", field=field)
    shape, dtype = layout(dataset)
    if dtype.kind not in "fiu":
        raise InputError("expected real numbers", field=field, value=f"data set of {kind_of(dtype)}")
    if shape is None or len(shape) not in (1, 2):
        raise InputError("expected shape (samples, channels)", field=field, value=shape)
    samples, count = shape[0], shape[1] if len(shape) == 2 else 1
    if count > samples:
        raise InputError(f"expected (samples, channels) with more samples than channels; {samples} samples of "
                         f"{count} channels look transposed",
                         field=field, value=shape)
    return samples, count


def write_campaign(path: str | Path, campaign: Campaign, longest: int = 1 << 20) -> None:
    """Write an HDF5 campaign, in pieces of at most `longest` samples and under its name only when complete.

    Raises
    ------
    InputError : a record's name that is used twice or cannot be a group's, a place that cannot be written, and
        whatever loading the records raises; the file is then as it was.
    ComputationError : the disk refuses; the file is then as it was.
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
    group.attrs.update({"sample_rate_Hz": header.sample_rate_Hz, "excitation": header.excitation,
                        "level_V": header.level_V, "start_s": header.start_s})
    if header.period_s is not None:
        group.attrs["period_s"] = header.period_s
    datasets = {}
    for role, names, unit in _roles(header):
        shape = (header.samples, len(names))
        chunks = (min(CHUNK, header.samples), len(names)) if names else None
        datasets[role] = group.create_dataset(role, shape, np.float64, chunks=chunks)
        datasets[role].attrs["names"] = np.array(names, dtype=h5py.string_dtype())
        datasets[role].attrs["unit"] = unit
    for start, stop in ranges(header.samples, longest):
        piece = record.load(start, stop)
        for role, dataset in datasets.items():
            dataset[start:stop] = getattr(piece, role)


def _roles(header: RecordHeader) -> list[tuple[str, tuple[str, ...], str]]:
    roles = [("u", header.u_names, header.u_unit), ("y", header.y_names, header.y_unit)]
    return roles + ([("floor", header.floor_names, header.floor_unit)] if header.floor_names else [])
