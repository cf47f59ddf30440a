"""`avis design`: from a rig to certified controllers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avis_ctrl.cli.console import Progress, StopRequest

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from rich.console import Console

    from avis_ctrl.study.design_result import DesignResult


def design(
    file: Annotated[Path, typer.Argument(metavar="DESIGN.toml", help="design file; avis new design writes one")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for controllers and report")],
) -> None:
    """Design certified controllers for a rig, check them in simulation, and write a report.

    Writes report.html, report.pdf, controllers/NAME.json, sampled_controller.json (the controller for the processor,
    sensor volts to drive volts, all axes), study.json (the inputs, for avis export), plant.json and result.json into
    DIR. Ctrl-C after the line "step 0" ends the D-K iteration and continues with the best controller so far; a second
    Ctrl-C ends the command without results (exit code 130).

    The exit code is 3 if the closed loop is unstable for any simulated plant; the first sentence of the output names
    the cause.
    """
    from rich.console import Console

    from avis_ctrl.study.design_file import read_study
    from avis_ctrl.study.files import output_folder
    from avis_ctrl.study.output import FILES, FOLDERS, write_study

    console = Console(highlight=False)
    design, rig = read_study(file)  # before slow imports, and before anything is written
    with output_folder(out, FILES, FOLDERS) as folder, Progress(console) as progress:
        from avis_ctrl.report import rendered
        from avis_ctrl.report.content import document
        from avis_ctrl.study.runner import run_design
        from avis_ctrl.study.verdict import refuse_unstable

        result = run_design(design, rig, progress, source=file, stop=StopRequest(progress))
        progress("report")
        files = write_study(result, folder, *rendered(document(result)))
    _verdict(console, result)
    console.print(f"{len(files)} files in {folder}; open {folder / 'report.html'} or {folder / 'report.pdf'}")
    refuse_unstable(result)


def _verdict(console: Console, result: DesignResult) -> None:
    from rich.table import Table

    from avis_ctrl.study.verdict import all_axes, first_sentence, requirement_rows

    console.print(first_sentence(result))
    if result.stable:
        console.print(all_axes(result))
    table = Table("requirement", "limit", "result", "", title=result.design.title)
    for *row, met in requirement_rows(result):
        table.add_row(*row, "[green]met[/]" if met else "[red]not met[/]")
    console.print(table)
    for note in result.remarks:
        console.print(note, markup=False)
