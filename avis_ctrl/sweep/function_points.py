"""Points that are calls of a user function from a Python file."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from avis_ctrl.errors import InputError
from avis_ctrl.study.files import as_json
from avis_ctrl.sweep.points import PointsFile
from avis_ctrl.sweep.task import Job


@dataclass(frozen=True, eq=False)
class FunctionBase:
    """A user function, FILE.py:NAME. Its source is sent to the workers, which need no copy of the file."""

    source: str
    path: Path
    name: str
    quantities: ClassVar[Mapping[str, str]] = {}
    pareto = None

    @classmethod
    def read(cls, file: PointsFile, folder: Path) -> FunctionBase:
        """Run the file. Raises InputError if the file or the function is missing."""
        where, _, name = file.base.partition(":")
        if not where.endswith(".py") or not name:
            raise InputError("expected FILE.py:NAME", field="base", value=file.base)
        path = (folder / where).resolve()
        try:
            made = cls(path.read_text(encoding="utf-8"), path, name)
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"expected a Python file ({getattr(error, 'strerror', None) or error})", file=path
            ) from None
        _function(made.source, path, name)
        return made

    def expand(self, key: str) -> Sequence[str]:
        """Every key is valid: it is an argument of the function."""
        return [key]

    def job(self, point: Mapping[str, Any]) -> Job:
        """The call of a point. Its inputs are the source, the name and the values."""
        values = dict(point)
        return Job(f"{self.source}\n{self.name}\n{values!r}", partial(call, self.source, self.path, self.name, values))


def call(source: str, path: Path, name: str, point: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The call NAME(point), which returns figures by name, or a pair (figures, details).

    Only the point's file keeps the details. The code runs with the user's permissions.
    """
    found = _function(source, path, name)(dict(point))
    figures, details = found if isinstance(found, tuple) and len(found) == 2 else (found, None)
    if not isinstance(figures, dict) or not all(isinstance(key, str) for key in figures):
        raise InputError("expected figures by name", field=name, value=type(figures).__name__)
    try:
        as_json({"figures": figures, "details": details})
    except (TypeError, ValueError) as error:
        raise InputError(f"expected numbers and text: {error}", field=name) from None
    return figures, {} if details is None else {"details": details}


def _function(source: str, path: Path, name: str) -> Any:
    """Run the file. Raises InputError if it fails or has no such function."""
    module = types.ModuleType(f"avis_sweep_{path.stem}")
    module.__file__ = str(path)
    try:
        exec(compile(source, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        raise InputError(
            f"expected a Python file that runs: {type(error).__name__}: {' '.join(str(error).split())}", file=path
        ) from None
    if not callable(found := getattr(module, name, None)):
        raise InputError("expected the name of a function in the file", file=path, field="base", value=name)
    return found
