"""Variables of a .mat file as a tree that is the same for all versions.

A numeric array becomes a `Matrix` in MATLAB's orientation, char a str (several rows: a list of str), a cell array a
list, a struct a dict, a struct array a list of dicts. Types without a meaning here (function handles, objects, sparse
matrices, tables) become an `Unreadable`, which is rejected only where it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class TreeSettings:
    """Limits for damaged files; campaigns stay far below them.

    deepest : levels of nested structs and cells.
    most_cells : cells of one cell array, or structs of one struct array.
    most_items : variables, cells and fields of a v7.3 file: its references may be circular.
    most_dimensions : dimensions of an array in a v5 file: HDF5, and thus v7.3, has no more.
    """

    deepest: int = 8
    most_cells: int = 10_000
    most_items: int = 200_000
    most_dimensions: int = 32


SETTINGS = TreeSettings()


@dataclass(frozen=True)
class Unreadable:
    """A variable of a class that cannot contain measurements."""

    kind: str


@dataclass(frozen=True)
class Matrix:
    """A numeric array in MATLAB's orientation.

    shape : as MATLAB shows it; kind : of numpy's dtype (f, i, u, c); read : returns its values in that shape; dataset :
    its name in a v7.3 file (stored with reversed dimensions), None if it is in memory.
    """

    shape: tuple[int, ...]
    kind: str
    read: Callable[[], np.ndarray]
    dataset: str | None = None


EMPTY = Matrix((0, 0), "f", lambda: np.zeros((0, 0)))
TOO_DEEP = Unreadable("structure nested too deep")


def describe(value: Any) -> str:
    """Type and shape of a variable, in words."""
    if isinstance(value, Matrix):
        return f"{'complex ' * (value.kind == 'c')}array of {'x'.join(map(str, value.shape))}"
    if isinstance(value, Unreadable):
        return value.kind
    return "text" if isinstance(value, str) else "struct" if isinstance(value, dict) else "cell or struct array"


def overview(tree: Mapping[str, Any]) -> str:
    """Names of the variables, for messages."""
    return ", ".join(sorted(tree)[:30]) or "nothing"
