"""`avis design`: from a rig to certified controllers; `avis compare`: two designs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avis_ctrl.cli.console import Progress, StopRequest, Terminal

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from avis_ctrl.study.design_result import DesignResult


def design(
    file: Annotated[Path, typer.Argument(metavar="DESIGN.toml", help="design file; avis new design writes one")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for controllers and report")],
) -> None:
    """Design certified controllers for a rig, check them in simulation, and write a report.

    Writes report.html, report.pdf, controllers/NAME.json, sampled_controller.json (the controller for the processor,
    sensor volts to drive volts, all axes), study.json (the inputs, for avis export), plant.json and result.json into
    DIR. Ctrl-C after the line "step 0", during the D-K iteration, ends it and continues with the best controller so
    far; at any other time, or if pressed again, it ends the command without results (exit code 130).

    The exit code is 3 if the closed loop is unstable for any simulated plant; the first sentence of the output names
    the cause.
    """
    from avis_ctrl.study.design_file import read_study
    from avis_ctrl.study.files import output_folder
    from avis_ctrl.study.output import FILES, FOLDERS, write_study

    terminal = Terminal()
    design, rig = read_study(file)  # before slow imports, and before anything is written
    with output_folder(out, FILES, FOLDERS) as folder, Progress(terminal) as progress:
        from avis_ctrl.report import rendered
        from avis_ctrl.report.content import document
        from avis_ctrl.study.runner import run_design
        from avis_ctrl.study.verdict import refuse_unstable

        result = run_design(design, rig, progress, source=file, stop=StopRequest(progress))
        progress("report")
        files = write_study(result, folder, *rendered(document(result)))
    _verdict(terminal, result)
    terminal.files(files, folder, "report.html", "report.pdf")
    refuse_unstable(result)


def _verdict(terminal: Terminal, result: DesignResult) -> None:
    from avis_ctrl.study.verdict import all_axes, first_sentence, requirement_rows

    terminal.print(first_sentence(result))
    if result.stable:
        terminal.print(all_axes(result))
    rows = [(*row, "[green]met[/]" if met else "[red]not met[/]") for *row, met in requirement_rows(result)]
    terminal.table(("requirement", "limit", "result", ""), rows, title=result.design.title)
    terminal.print(*result.remarks, markup=False)


def compare(
    first: Annotated[Path, typer.Argument(metavar="DESIGN_A", help="output folder of avis design")],
    second: Annotated[Path, typer.Argument(metavar="DESIGN_B", help="output folder of another design")],
) -> None:
    """Compare two designs side by side: differences of the design files, and the results."""
    from rich.markup import escape

    from avis_ctrl.study.design_comparison import compare_designs

    terminal, found = Terminal(), compare_designs(first, second)
    header = ("", *map(escape, found.titles))  # a unit in brackets is not markup
    for title, rows in (("requested differently", found.requested), ("result", found.found)):
        if rows:
            terminal.table(header, [tuple(map(escape, row)) for row in rows], title=title)
    if not found.requested:
        terminal.print("Both design files and rigs are the same.")
    if found.note:
        terminal.print(found.note)
