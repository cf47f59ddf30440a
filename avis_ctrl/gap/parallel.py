"""Run independent calculations: one after the other, or in parallel with a function that the caller provides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Mapper(Protocol):
    """Results of independent calculations, in order; computed in parallel where processors are available."""

    def __call__(self, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Results of the function, in the order of the items."""
        ...


def sequential_map(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Run the calculations one after the other."""
    return [function(item) for item in items]
