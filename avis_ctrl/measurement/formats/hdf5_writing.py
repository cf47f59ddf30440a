"""HDF5 files that are written completely or not at all, even if the disk becomes full.

The HDF5 library cannot handle write errors while a file is closed: it reports the error, does not free the file, and
crashes when Python exits (a segmentation fault, seen with HDF5 2.0). Therefore it gets a file object that never fails,
and the error is raised after HDF5 has released it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py

from avis_ctrl.files import whole_file


@dataclass(frozen=True)
class WritingSettings:
    """metadata_bytes : size up to which a piece may be metadata [bytes], which HDF5 reads back; chunks of data are
    larger and are not read.
    """

    metadata_bytes: int = 1 << 16


SETTINGS = WritingSettings()


class PatientFile:
    """File object for h5py: bytes go to a descriptor; after the first write error they are discarded.

    refused : first error of the disk. After it small pieces stay in memory, so that HDF5 can read its metadata back.
    """

    def __init__(self, descriptor: int):
        self.descriptor, self.at, self.end = descriptor, 0, 0
        self.refused: OSError | None = None
        self.kept: dict[int, bytes] = {}

    def write(self, data: bytes) -> int:
        """Write, or discard after an error; never fails."""
        view = memoryview(data).cast("B")
        done = 0
        try:
            while self.refused is None and done < len(view):
                done += os.pwrite(self.descriptor, view[done:], self.at + done)
        except OSError as error:
            self.refused = error
        if self.refused is not None and len(view) <= SETTINGS.metadata_bytes:
            self.kept[self.at] = bytes(view)
        self.at += len(view)
        self.end = max(self.end, self.at)
        return len(view)

    def read(self, size: int) -> bytes:
        """Bytes on the disk, with those that were kept in memory."""
        found = bytearray(size)
        of_disk = os.pread(self.descriptor, size, self.at)
        found[: len(of_disk)] = of_disk
        for start, piece in self.kept.items():
            low, high = max(start, self.at), min(start + len(piece), self.at + size)
            if low < high:
                found[low - self.at : high - self.at] = piece[low - start : high - start]
        self.at += size
        return bytes(found)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position."""
        self.at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self.at, os.SEEK_END: self.end}[whence]
        return self.at

    def tell(self) -> int:
        """The position."""
        return self.at

    def truncate(self, size: int) -> int:
        """Cut the file to a size; never fails."""
        try:
            os.ftruncate(self.descriptor, size)
        except OSError as error:
            self.refused = self.refused or error
        self.end = size
        return size

    def flush(self) -> None:
        """Does nothing: the descriptor has no buffer."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file that gets its name only when it is complete. Raises as `whole_file` does."""
    with whole_file(path) as raw:
        patient = PatientFile(raw.fileno())
        try:
            with h5py.File(patient, "w", track_order=True) as file:
                yield file
        except Exception:
            if patient.refused is None:
                raise
        if patient.refused is not None:
            raise patient.refused
