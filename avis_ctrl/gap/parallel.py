"""How independent questions are answered: one after the other, or several at a time where a caller knows how."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class Each(Protocol):
    """Answers to independent questions, in their order; where there are processors, several at a time."""

    def __call__(self, function: Callable[[Item], Answer], items: Sequence[Item]) -> list[Answer]: ...


def one_by_one(function: Callable[[Item], Answer], items: Sequence[Item]) -> list[Answer]:
    """The same, one after the other."""
    return [function(item) for item in items]
