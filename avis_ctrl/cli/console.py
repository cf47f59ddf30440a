"""Progress output of the commands, and Ctrl-C as a stop request."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from rich.console import Console


class Progress:
    """Print a line with the elapsed time at each step; on a terminal also show a spinner."""

    def __init__(self, console: Console) -> None:
        self.console, self.began = console, time.monotonic()
        self.status = console.status("working") if console.is_terminal else None

    def __enter__(self) -> Self:
        if self.status:
            self.status.start()
        return self

    def __call__(self, text: str) -> None:
        """Print a line with the elapsed time."""
        self.console.print(f"[dim]{time.monotonic() - self.began:6.1f} s[/]  {text}", soft_wrap=True)

    def __exit__(self, *error: object) -> None:
        if self.status:
            self.status.stop()


class StopRequest:
    """Ctrl-C as a stop request.

    From the first call of this object on, Ctrl-C lets a computation stop with the best result so far instead of ending
    the command. A second Ctrl-C ends the command as usual.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say, self.asked = say, False
        self.usual: Any = None

    def __enter__(self) -> Self:
        return self

    def __call__(self) -> bool:
        """Whether Ctrl-C was pressed since the first call."""
        if self.usual is None:
            self.usual = signal.signal(signal.SIGINT, self._heard)
        return self.asked

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, self.usual)
        self.say(
            "Ctrl-C: after this iteration the design continues with the best controller so far; "
            "again Ctrl-C to end without results"
        )

    def __exit__(self, *error: object) -> None:
        if self.usual is not None:
            signal.signal(signal.SIGINT, self.usual)
