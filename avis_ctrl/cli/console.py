"""Output of the commands on the terminal, and Ctrl-C as a stop request."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Self


class Terminal:
    """The terminal: lines and tables. The library is imported late so that `avis --help` responds at once."""

    def __init__(self) -> None:
        from rich.console import Console

        self.console = Console(highlight=False)

    def print(self, *lines: str, **how: Any) -> None:
        """Print lines; how : options of rich."""
        for line in lines:
            self.console.print(line, **how)

    def table(self, header: Sequence[str], rows: Iterable[Sequence[str]], **how: Any) -> None:
        """Print a table; how : title, caption."""
        from rich.table import Table

        made = Table(*header, **how)
        for row in rows:
            made.add_row(*row)
        self.console.print(made)

    def files(self, files: Sequence[object], folder: Path, html: str, other: str, then: str = "") -> None:
        """State what a command has written, and which files to open first."""
        self.console.print(f"{len(files)} files in {folder}; open {folder / html} or {folder / other}{then}")


class Progress:
    """Print a line with the elapsed time at each step; on a terminal also show a spinner."""

    def __init__(self, terminal: Terminal) -> None:
        self.console, self.began = terminal.console, time.monotonic()
        self.status = self.console.status("working") if self.console.is_terminal else None

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
            "press Ctrl-C again to end without results"
        )

    def __exit__(self, *error: object) -> None:
        if self.usual is not None:
            signal.signal(signal.SIGINT, self.usual)
