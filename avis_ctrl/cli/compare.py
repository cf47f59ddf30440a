"""`avis compare`: two designs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def compare(
    first: Annotated[Path, typer.Argument(metavar="DESIGN_A", help="output folder of avis design")],
    second: Annotated[Path, typer.Argument(metavar="DESIGN_B", help="another one")],
) -> None:
    """Compare two designs side by side: differences of the design files, and the results."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from avis_ctrl.study.design_comparison import compare_designs

    console = Console(highlight=False)
    found = compare_designs(first, second)
    for title, rows in (("requested differently", found.requested), ("result", found.found)):
        table = Table("", *map(escape, found.titles), title=title)
        for row in rows:
            table.add_row(*map(escape, row))  # a unit in brackets is not markup
        if rows:
            console.print(table)
    if not found.requested:
        console.print("Both design files and rigs are the same.")
    if found.note:
        console.print(found.note)
