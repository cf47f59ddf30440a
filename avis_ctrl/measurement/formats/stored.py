"""Records that stay in an HDF5 file (also MATLAB v7.3) and are loaded in pieces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Record, RecordHeader, RecordSource
from avis_ctrl.measurement.formats.common import existing_file, numbers, reading, require_finite, short


def open_hdf5(path: Path) -> h5py.File:
    """The open file; InputError if it is no HDF5."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if "truncated" in str(error):
            raise InputError(f"the HDF5 file is cut short ({short(error)})", file=path) from None
        raise InputError(f"not a readable HDF5 file ({short(error)})", file=path) from None


@dataclass(frozen=True)
class Columns:
    """Channels of a record in one data set.

    dataset : its name in the file; factors : to SI, one per channel; channels_first : stored as (channels, samples),
    as MATLAB v7.3 writes a matrix of (samples, channels); a one-dimensional data set holds one channel.
    """

    dataset: str
    factors: tuple[float, ...]
    channels_first: bool = False

    def rows(self, file: h5py.File, start: int, stop: int) -> np.ndarray:
        """(stop - start, channels) in SI units; only these rows are read."""
        stored = file[self.dataset]
        if stored.ndim == 1:
            block = stored[start:stop][:, None]
        else:
            block = stored[:, start:stop].T if self.channels_first else stored[start:stop]
        array = numbers(block, self.dataset)
        if array.shape != (stop - start, len(self.factors)):
            raise InputError(f"expected {stop - start} samples of {len(self.factors)} channels", field=self.dataset,
                             value=array.shape)
        if any(factor != 1.0 for factor in self.factors):
            array = array * np.array(self.factors)
        return array


@dataclass(frozen=True, eq=False)
class StoredRecord(RecordSource):
    """A record in an HDF5 file.

    The file is opened for each load and closed again, so that the record can be pickled and sent to another process.

    path : the file; columns : where "u", "y" and, where measured, "floor" lie; several data sets stand side by side.
    """

    header: RecordHeader
    path: str
    columns: Mapping[str, tuple[Columns, ...]]

    def load(self, start: int = 0, stop: int | None = None) -> Record:
        """Samples start .. stop (end of the record by default) in memory; reads only these rows.

        Raises
        ------
        InputError : samples that are not finite numbers, a range outside the record, a file that ends early.
        """
        stop = self.header.samples if stop is None else stop
        if not 0 <= start < stop <= self.header.samples:
            raise InputError(f"expected 0 <= start < stop <= {self.header.samples}", file=self.path,
                             field=f"record {self.header.name}: samples", value=(start, stop))
        header = replace(self.header, samples=stop - start,
                         start_s=self.header.start_s + start / self.header.sample_rate_Hz)
        with reading(self.path, f"record {self.header.name}"), open_hdf5(existing_file(self.path)) as file:
            arrays = {role: self._role(file, role, start, stop) for role in self.columns}
            return Record(header, arrays["u"], arrays["y"], arrays.get("floor"))

    def _role(self, file: h5py.File, role: str, start: int, stop: int) -> np.ndarray:
        blocks = [columns.rows(file, start, stop) for columns in self.columns[role]]
        array = blocks[0] if len(blocks) == 1 else np.hstack([np.zeros((stop - start, 0)), *blocks])
        names = {"u": self.header.u_names, "y": self.header.y_names, "floor": self.header.floor_names}[role]
        require_finite(array, names, f"record {self.header.name}: {role}", start)
        return array
