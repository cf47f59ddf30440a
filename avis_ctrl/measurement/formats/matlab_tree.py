"""Variables of a .mat file as one kind of tree, whatever its version.

A numeric array becomes a `Matrix` in MATLAB's orientation, char a str (several rows: a list of str), a cell array a
list, a struct a dict, a struct array a list of dicts, and what has no meaning here (function handles, objects, sparse
matrices, tables) an `Unreadable` that is refused only where it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

DEEPEST = 8  # nested structs and cells
MOST_CELLS = 10_000  # of one cell or struct array


@dataclass(frozen=True)
class Unreadable:
    """A variable of a class that holds no measurement."""

    kind: str


@dataclass(frozen=True)
class Matrix:
    """A numeric array in MATLAB's orientation.

    shape : as MATLAB shows it; kind : of numpy's dtype (f, i, u, c); read : its values in that shape; dataset : where
    it lies in a v7.3 file (stored with the dimensions reversed), None where it is in memory.
    """

    shape: tuple[int, ...]
    kind: str
    read: Callable[[], np.ndarray]
    dataset: str | None = None


EMPTY = Matrix((0, 0), "f", lambda: np.zeros((0, 0)))
TOO_DEEP = Unreadable("structure nested too deep")


def describe(value: Any) -> str:
    """What a variable is, in words."""
    if isinstance(value, Matrix):
        return f"{'complex ' * (value.kind == 'c')}array of {'x'.join(map(str, value.shape))}"
    if isinstance(value, Unreadable):
        return value.kind
    return "text" if isinstance(value, str) else "struct" if isinstance(value, dict) else "cell or struct array"


def overview(tree: Mapping[str, Any]) -> str:
    """Names of the variables, for messages."""
    return ", ".join(sorted(tree)[:30]) or "nothing"
