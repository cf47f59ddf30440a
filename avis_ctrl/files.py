"""Atomic file output: a file is complete or absent, even if the disk is full or the process is killed."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from avis_ctrl.errors import AvisError, ComputationError, InputError

# Errors of a full or failing disk: exit code 3.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
# First bytes of an HDF5 file.
HDF5 = b"\x89HDF\r\n\x1a\n"


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file for writing (and reading) that gets its name only after all of it is on the disk.

    Until then it has no name if the system allows this (it then vanishes with the process); otherwise it has a hidden
    name in the same folder. An older file is unchanged until the end. It remains if an error is raised.

    Raises
    ------
    InputError : a path that cannot be written, or that exists and is not a regular file (a folder, a device).
    ComputationError : the disk is full.
    """
    file, name = _opened(path)
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            name = name or _named(file, path)
        os.chmod(name, 0o666 & ~_mask())  # temporary files are readable by their owner only
        os.replace(name, path)
    except OSError as error:
        raise _refused(path, error) from None
    finally:
        if name is not None:
            with contextlib.suppress(OSError):
                os.unlink(name)


def require_writable(path: Path) -> None:
    """Raise the errors of `whole_file` before a long computation."""
    file, name = _opened(path)
    file.close()
    if name is not None:
        os.unlink(name)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically. Raises as `whole_file`."""
    with whole_file(path) as file:
        file.write(content)


def write_together(folder: Path, contents: Mapping[str, bytes], old: Iterable[Path] = ()) -> list[Path]:
    """Write several files of a folder, all or none, in the given order: the last file marks the set as complete.

    All contents are written under hidden names first. Only then are the `old` files removed and the new files renamed,
    so that earlier results survive a full disk. The folder is left incomplete only if a file cannot be removed or
    renamed after that; the error then lists the missing and the new files.

    Parameters
    ----------
    contents : by name, which may contain folders: "controllers/mu.json".
    old : files to remove if they exist and are not written again, so that no old report remains beside new results.

    Raises
    ------
    ComputationError : the disk is full or fails.
    """
    removed: list[Path] = []
    placed: list[Path] = []
    try:
        with tempfile.TemporaryDirectory(dir=folder, prefix=".new.", ignore_cleanup_errors=True) as hidden:
            for name, content in contents.items():
                made = Path(hidden) / name
                made.parent.mkdir(parents=True, exist_ok=True)
                write_whole(made, content)
            for path in old:
                with contextlib.suppress(FileNotFoundError):
                    path.unlink()
                    removed.append(path)
            for name in contents:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(Path(hidden) / name, folder / name)
                placed.append(folder / name)
    except OSError as error:
        if removed or placed:
            raise _incomplete(folder, [folder / name for name in contents], removed, placed, error) from None
        raise not_written(folder, error) from None
    except ComputationError as error:
        raise ComputationError(
            f"{folder} was not written; what was there before is untouched",
            cause=error.cause,
            next_step=error.next_step,
        ) from None
    return placed


def _incomplete(
    folder: Path, asked: list[Path], removed: list[Path], placed: list[Path], error: OSError
) -> ComputationError:
    rest = [path for path in dict.fromkeys((*asked, *removed)) if path not in placed]
    states = {
        "missing": [path for path in rest if not os.path.lexists(path)],
        "new": placed,
        "of an earlier run": [path for path in rest if os.path.lexists(path)],
    }
    said = "; ".join(
        f"{state}: {', '.join(os.path.relpath(path, folder) for path in paths)}"
        for state, paths in states.items()
        if paths
    )
    return ComputationError(
        f"{folder} is incomplete, do not use what is in it ({said})",
        cause=str(error.strerror or error),
        next_step="run the command again, or choose another place with --out",
    )


def not_written(path: Path, error: OSError) -> ComputationError:
    """The error of a disk that is full or fails."""
    return ComputationError(
        f"{path} was not written; what was there before is untouched",
        cause=str(error.strerror or error),
        next_step="free some space or choose another place with --out",
    )


def _refused(path: Path, error: OSError) -> AvisError:
    if error.errno in FULL:
        return not_written(path, error)
    return InputError(f"cannot be written ({error.strerror or error})", file=path)


def _opened(path: Path) -> tuple[BinaryIO, str | None]:
    """A temporary file in the folder of `path`, and its name if it has one."""
    try:
        if path.exists() and not path.is_file():
            raise InputError("cannot be written (it exists and is not a regular file)", file=path)
        if hasattr(os, "O_TMPFILE"):
            with contextlib.suppress(OSError):  # some file systems (NFS, old overlays) do not support nameless files
                return open(os.open(path.parent, os.O_TMPFILE | os.O_RDWR, 0o600), "w+b"), None
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise _refused(path, error) from None
    return open(descriptor, "w+b"), name


def _named(file: BinaryIO, path: Path) -> str:
    """Give a nameless file a hidden name beside the target; copy it if the system cannot link it."""
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with open(descriptor, "wb") as copy:
            try:
                # os.link needs a free name: use one derived from the name that mkstemp has just reserved.
                os.link(f"/proc/self/fd/{file.fileno()}", f"{name}.", follow_symlinks=True)
                os.replace(f"{name}.", name)
            except OSError:
                file.seek(0)
                shutil.copyfileobj(file, copy)
                copy.flush()
                os.fsync(copy.fileno())
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
    return name


def _mask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
