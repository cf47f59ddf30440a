"""How a search runs: its settings, its progress, and independent calculations one by one or in parallel."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from avis_ctrl.gap.settings import SETTINGS, GapSettings

Progress = Callable[[str], None]
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


def between_stages(progress: Progress) -> Progress:
    """Report progress and return freed memory to the operating system: glibc keeps some hundred MB of it otherwise."""

    def reported(text: str) -> None:
        with contextlib.suppress(OSError, AttributeError, TypeError):  # only glibc has this function
            ctypes.CDLL(None).malloc_trim(0)
        progress(text)

    return reported


@dataclass(frozen=True)
class Run:
    """How a search runs: settings, progress in words, and a function for independent calculations."""

    settings: GapSettings = SETTINGS
    progress: Progress = lambda text: None
    each: Mapper = sequential_map
