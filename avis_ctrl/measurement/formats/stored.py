"""Records that stay in an HDF5 file (also MATLAB v7.3) and are loaded in pieces."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Record, RecordHeader, RecordSource, require_finite
from avis_ctrl.measurement.formats.common import existing_file, numbers, printable, reading, short

# Exceptions of h5py on damaged files.
DAMAGE = (OSError, KeyError, IndexError, ValueError, TypeError, RuntimeError, OverflowError)


def open_hdf5(path: Path) -> h5py.File:
    """The open file; InputError if it is not HDF5."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if "truncated" in str(error):
            raise InputError(f"the HDF5 file is cut short ({short(error)})", file=path) from None
        raise InputError(f"not a readable HDF5 file ({short(error)})", file=path) from None


@contextmanager
def access(what: object) -> Iterator[None]:
    """Convert exceptions of h5py to InputError; only calls into h5py belong inside."""
    try:
        yield
    except DAMAGE as error:
        message = f"cannot be read; damaged or cut short? ({short(error)})"
        raise InputError(message, field=printable(str(what))) from error


def members(group: h5py.Group) -> list[str]:
    """Names of the members of a group."""
    with access("a group"):
        return [str(name) for name in group]


def member(group: h5py.Group, name: Any) -> Any:
    """The group or data set of that name (or reference), None if there is none."""
    with access(name if isinstance(name, str) else "a reference"):
        if isinstance(name, str) and name not in group:
            return None
        return group[name]


def attributes(item: h5py.Group | h5py.Dataset, *names: str) -> dict[str, Any]:
    """The named attributes that exist."""
    found = {}
    for name in names:
        with access(f"attribute {name}"):
            if name in item.attrs:
                found[name] = item.attrs[name]
    return found


def layout(dataset: h5py.Dataset) -> tuple[tuple[int, ...] | None, np.dtype]:
    """Shape (None if the data set is empty) and type."""
    with access("a data set"):
        return dataset.shape, dataset.dtype


def full_name(item: h5py.Group | h5py.Dataset) -> str:
    """Path of an item in its file."""
    with access("a name"):
        return str(item.name)


def values(dataset: h5py.Dataset, selection: Any = ()) -> np.ndarray:
    """Stored values, all or a selection of them."""
    with access(full_name(dataset)):
        return np.asarray(dataset[selection])


def values_in(path: str | Path, name: str, selection: Any = ()) -> np.ndarray:
    """Stored values of a data set by its name in a file, which is opened for this purpose.

    Raises
    ------
    InputError : no such data set, a file that is damaged or has changed since it was first opened.
    """
    with open_hdf5(existing_file(path)) as file:
        found = member(file, name)
        if not isinstance(found, h5py.Dataset):
            raise InputError("expected a data set; damaged, or changed since it was opened?", field=printable(name))
        return values(found, selection)


@dataclass(frozen=True)
class Columns:
    """Channels of a record in one data set.

    dataset : its name in the file; samples : number per channel; channels_first : stored as (channels, samples), as
    MATLAB v7.3 writes a matrix of (samples, channels); a one-dimensional data set is one channel; factors : to SI, one
    per channel.
    """

    dataset: str
    samples: int
    channels_first: bool = False
    factors: tuple[float, ...] = ()

    def __len__(self) -> int:
        return self.samples

    def load(self, path: str, names: Sequence[str], field: str, start: int, stop: int) -> np.ndarray:
        """(stop - start, channels) in SI units; only these rows are read.

        Raises
        ------
        InputError : samples that are not finite numbers, a file that is damaged or has changed.
        """
        rows = slice(start, stop)
        block = values_in(path, self.dataset, (..., rows) if self.channels_first else rows)
        array = numbers(block.T if self.channels_first else block, self.dataset)
        array = array[:, None] if array.ndim == 1 else array
        if array.shape != (stop - start, len(self.factors)):
            message = f"expected {stop - start} samples of {len(self.factors)} channels"
            raise InputError(message, field=self.dataset, value=array.shape)
        if set(self.factors) != {1.0}:
            array *= self.factors
        require_finite(array, names, field, lambda row: f"sample {start + row}")
        return array


@dataclass(frozen=True, eq=False)
class StoredRecord(RecordSource):
    """A record in an HDF5 file.

    The file is opened and closed for each load, so that the record can be pickled and sent to another process.

    path : the file; columns : places of "u", "y" and, if measured, "floor".
    """

    header: RecordHeader
    path: str
    columns: Mapping[str, Columns]

    def load(self, start: int = 0, stop: int | None = None) -> Record:
        """Load samples start .. stop (to the end of the record by default) into memory; only these rows are read.

        Raises
        ------
        InputError : samples that are not finite numbers, a range outside the record, a truncated file.
        """
        h, stop = self.header, self.header.samples if stop is None else stop
        if not 0 <= start < stop <= h.samples:
            message, field = f"expected 0 <= start < stop <= {h.samples}", f"record {h.name}: samples"
            raise InputError(message, file=self.path, field=field, value=(start, stop))
        names = {"u": h.u_names, "y": h.y_names, "floor": h.floor_names}
        with reading(self.path, f"record {h.name}"):
            samples = {
                role: columns.load(self.path, names[role], f"record {h.name}: {role}", start, stop)
                for role, columns in self.columns.items()
            }
            return Record(h.part(start, stop), **samples)
