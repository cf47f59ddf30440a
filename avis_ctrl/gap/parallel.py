"""Independent calculations: one after the other, or several at a time where a caller knows how."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Each(Protocol):
    """Results of independent calculations, in their order; where there are processors, several at a time."""

    def __call__(self, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]: ...


def one_by_one(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The same, one after the other."""
    return [function(item) for item in items]
