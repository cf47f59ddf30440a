"""Arguments and options of a command, read from the text of its help."""

from __future__ import annotations

from typing import Any

import typer


class Options:
    """Arguments and options of a command by name.

    text : an entry begins at the start of a line, "--flag METAVAR: help" for an option and "METAVAR: help" for an
        argument; further lines are indented.
    """

    def __init__(self, text: str) -> None:
        entries = text.strip().replace("\n    ", " ").splitlines()
        self._help = {head: said for head, _, said in (entry.partition(": ") for entry in entries)}

    def __call__(self, name: str, **more: Any) -> Any:
        """The declaration for the command line library. more : its further settings."""
        head = next(one for one in self._help if one == name or one.startswith(f"{name} "))
        if not name.startswith("--"):
            return typer.Argument(metavar=name, help=self._help[head], **more)
        return typer.Option(name, metavar=head.removeprefix(name).strip() or None, help=self._help[head], **more)
