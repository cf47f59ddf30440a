"""Output folders of the commands, and JSON. Atomic file output is in `avis_ctrl.files`."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.files import FULL, HDF5, not_written, require_writable


def open_folder(folder: str | Path, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Path:
    """Create the output folder and check that it is writable, before hours of computation.

    Raises InputError if it is a file, read-only, below such a path, or contains a folder in place of a file;
    ComputationError if the disk is full.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        if error.errno in FULL:
            raise not_written(path, error) from None
        raise InputError(
            f"expected a writable folder ({error.strerror or error})", field="--out", value=str(path)
        ) from None
    for name, is_folder in (*((name, True) for name in folders), *((name, False) for name in files)):
        if (path / name).exists() and (path / name).is_dir() != is_folder:
            raise InputError(
                f"expected a {'folder' if is_folder else 'file'} at {path / name}, or nothing",
                field="--out",
                value=str(path),
            )
    return path


@contextlib.contextmanager
def output_folder(folder: str | Path, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Iterator[Path]:
    """`open_folder` as a context manager; an error removes new folders that are still empty. Raises as it does."""
    path = Path(folder)
    made = [one for one in (path, *path.parents) if not one.exists()]
    try:
        yield open_folder(path, files, folders)
    except BaseException:
        with contextlib.suppress(OSError):  # not empty
            for one in made:
                one.rmdir()
        raise


def require_output(out: Path, *inputs: Path | str | None) -> None:
    """Raise InputError if the file cannot be written, or is one of the input files: a measurement is never
    overwritten."""
    for one in inputs:
        with contextlib.suppress(OSError):
            if one is not None and out.samefile(one):
                raise InputError("expected a file other than the input file", field="--out", value=str(out))
    require_writable(out)


def require_hdf5_output(out: Path, *inputs: Path | str | None) -> None:
    """`require_output`; raises InputError also if the file exists and is no HDF5 file, such as a rig file named by a
    slip."""
    require_output(out, *inputs)
    if out.is_file() and out.stat().st_size:
        with out.open("rb") as file:
            if file.read(len(HDF5)) != HDF5:
                raise InputError(
                    "this file exists and is no HDF5 file: give another name, or delete it",
                    field="--out",
                    value=str(out),
                )


def as_json(value: dict[str, Any]) -> bytes:
    """JSON with floats in full precision, infinities and nan as null (JSON has neither)."""
    return json.dumps(_plain(value), indent=1, allow_nan=False).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def values_of(one: object, *names: str) -> dict[str, Any]:
    """Some attributes of an object by name."""
    return {name: getattr(one, name) for name in names}
