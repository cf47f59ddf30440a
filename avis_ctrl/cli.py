"""The `avis` command: thin, and late with its imports, so that `avis --help` answers at once."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

import avis_ctrl
from avis_ctrl.errors import AvisError

INTERRUPTED = 130  # 128 + SIGINT, as shells report it

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False,
                  help="Workbench for active vibration isolation tables.")


def _version(asked: bool) -> None:
    if asked:
        print(f"avis_ctrl {avis_ctrl.__version__}")
        raise typer.Exit()


@app.callback()
def _commands(version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True,
                                                    help="print the version")] = False) -> None:
    """Workbench for active vibration isolation tables.

    Exit codes: 0 done (read the verdict), 2 the input is wrong, 3 a computation failed.
    """


@app.command()
def design(
    file: Annotated[Path, typer.Argument(metavar="DESIGN.toml", help="what to design; start from designs/*.toml")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for controllers and report")],
) -> None:
    """From a rig to certified controllers, checks and a design report.

    Writes report.html, report.pdf, controllers/NAME.json, plant.json and result.json into DIR.
    """
    from rich.console import Console

    from avis_ctrl.study.design_file import read_study
    from avis_ctrl.study.output import open_folder

    console = Console(highlight=False)
    design, rig = read_study(file)  # before anything is imported or written that takes time
    folder = open_folder(out)
    with _Progress(console) as progress:
        from avis_ctrl.report import render_html, render_pdf
        from avis_ctrl.study.output import write_study
        from avis_ctrl.study.runner import run_design

        result = run_design(design, rig, progress, source=file)
        progress("report")
        files = write_study(result, folder, render_html(result), render_pdf(result))
    _verdict(console, result)
    console.print(f"{len(files)} files in {folder}; open {folder / 'report.html'} or {folder / 'report.pdf'}")


@app.command()
def doctor() -> None:
    """Versions, solvers, threads: what works here and what does not."""
    from rich.console import Console
    from rich.table import Table

    from avis_ctrl.study.doctor import examine

    console = Console(highlight=False)
    table = Table("check", "found", "")
    checks = examine()
    for check in checks:
        table.add_row(check.name, check.found, "[green]ok[/]" if check.works else "[red]does not work[/]")
    console.print(table)
    if not all(check.works for check in checks):
        raise typer.Exit(3)


class _Progress:
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


def _verdict(console, result) -> None:
    from rich.table import Table

    table = Table("requirement", "asked", "measured", "", title=result.design.title)
    for r in result.requirements:
        unit = f" {r.unit}" if r.unit else ""
        asked = "yes" if r.comparison == "is" else f"{r.comparison} {r.limit:.4g}{unit}"
        table.add_row(r.name, asked, f"{r.value:.4g}{unit}", "[green]met[/]" if r.met else "[red]not met[/]")
    console.print(table)
    for note in result.notes:
        console.print(note)


def main() -> None:
    """Entry point: errors of ours end in one line and their exit code."""
    # Before numpy is loaded: several BLAS threads round differently from one, and are slower on small matrices.
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        # The parser hands back the code of typer.Exit, and 130 after Ctrl-C.
        code = app(standalone_mode=False)
    except AvisError as error:
        print(f"avis: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:  # usage errors of the command line parser carry their own code
        if not (hasattr(error, "exit_code") and hasattr(error, "format_message")):
            raise
        if message := error.format_message():  # without a command the help has said it
            print(f"avis: {message}", file=sys.stderr)
        sys.exit(error.exit_code)
    if code == INTERRUPTED:
        print("avis: stopped; nothing half-written is left", file=sys.stderr)
    sys.exit(code)
