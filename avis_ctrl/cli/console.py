"""What the commands say while they work."""

from __future__ import annotations

import time


class Progress:
    """A line with the time at each step; on a terminal a spinner below says that work goes on."""

    def __init__(self, console):
        self.console, self.began = console, time.monotonic()
        self.status = console.status("working") if console.is_terminal else None

    def __enter__(self):
        if self.status:
            self.status.start()
        return self

    def __call__(self, text: str) -> None:
        self.console.print(f"[dim]{time.monotonic() - self.began:6.1f} s[/]  {text}", soft_wrap=True)

    def __exit__(self, kind, value, trace) -> None:
        if self.status:
            self.status.stop()
