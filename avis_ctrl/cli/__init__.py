"""The `avis` command. Imports are deferred so that `avis --help` responds at once."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from dataclasses import dataclass
from types import FrameType
from typing import Annotated, Any

import typer

import avis_ctrl
from avis_ctrl.cli.campaigns import convert, excite, simulate_campaign
from avis_ctrl.cli.console import Terminal
from avis_ctrl.cli.design import compare, design
from avis_ctrl.cli.export import export
from avis_ctrl.cli.gap import gap
from avis_ctrl.cli.gap_axis import gap_axis
from avis_ctrl.cli.identify import identify, predict, single_axis
from avis_ctrl.cli.new import app as new
from avis_ctrl.cli.sweep import sweep
from avis_ctrl.errors import AvisError, ComputationError, InputError, UserInterruptError
from avis_ctrl.measurement.layouts import FORMATS

# One line per paragraph: the terminal wraps them.
LAYOUTS = "\n\n".join(" ".join(part.split()) for part in FORMATS.split("\n\n"))
INTERRUPTED = UserInterruptError.exit_code


@dataclass(frozen=True)
class InterruptSettings:
    """again_s : time until an interrupt is repeated [s]: enough for clean-up after the first one."""

    again_s: float = 3.0


SETTINGS = InterruptSettings()

# Markdown: paragraphs of the help are wrapped to the terminal.
app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode="markdown")


def _version(asked: bool) -> None:
    if asked:
        print(f"avis_ctrl {avis_ctrl.__version__}")
        raise typer.Exit()


@app.callback()
def _commands(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    """Workbench for active vibration isolation tables.

    Exit codes: 0 done (read the verdict), 2 invalid input, 3 a computation failed or the designed loop is
    unstable, 130 ended by Ctrl-C.
    """


@app.command()
def doctor() -> None:
    """Check the installation: versions, solvers, threads."""
    from avis_ctrl.study.doctor import examine

    checks = examine()
    rows = [(one.name, one.found, "[green]ok[/]" if one.works else "[red]does not work[/]") for one in checks]
    Terminal().table(("check", "found", ""), rows)
    if not all(check.works for check in checks):
        raise typer.Exit(3)


for command in (
    design,
    compare,
    export,
    identify,
    gap,
    predict,
    gap_axis,
    excite,
    simulate_campaign,
    convert,
    single_axis,
    sweep,
):
    app.command(epilog=LAYOUTS if command in (identify, gap, convert) else None)(command)
app.add_typer(new, name="new")


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, and again after `again_s`: one raised inside a callback of compiled code is lost."""
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, _interrupt)
        signal.setitimer(signal.ITIMER_REAL, SETTINGS.again_s)
    raise KeyboardInterrupt


def _no_more_alarms() -> None:
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)


def _silence_lost_interrupts() -> None:
    """Suppress the traceback of a KeyboardInterrupt that was lost in a callback; the alarm raises it again."""
    usual = sys.unraisablehook

    def hook(ignored: Any) -> None:
        if not issubclass(ignored.exc_type, KeyboardInterrupt):
            usual(ignored)

    sys.unraisablehook = hook


def _refusal(error: OSError) -> str:
    """One-line message for an error of the operating system."""
    where = f"{error.filename}: " if error.filename else ""
    lines = str(error.strerror or error).splitlines() or [type(error).__name__]
    return f"{where}{lines[0]}; next: check free disk space and permissions"


def _say_unusual() -> None:
    """Print warnings about unusual rig files as one line without the source location; others remain unchanged."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *of: Any, **also: Any) -> None:
        if category.__name__ == "UnusualRig":  # compared by name: --help must not load its module
            print(f"avis: {message}", file=sys.stderr)
        else:
            usual(message, category, *of, **also)

    warnings.showwarning = show


def main() -> None:
    """Entry point: errors of avis_ctrl end in one line and an exit code."""
    _say_unusual()
    _silence_lost_interrupts()
    # Set before numpy is loaded: rounding depends on the number of BLAS threads, and more threads are slower on small
    # matrices.
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        # The parser returns the code of typer.Exit, and 130 after Ctrl-C.
        code = app(standalone_mode=False)
        sys.stdout.flush()  # fails if the output goes to a file and the disk is full
    except AvisError as error:
        _no_more_alarms()
        print(f"avis: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except OSError as error:
        print(f"avis: {_refusal(error)}", file=sys.stderr)
        # Prevents a second attempt, at exit, to write this output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(ComputationError.exit_code)
    except typer.Abort as error:
        if isinstance(error.__context__, EOFError):  # a prompt, but no more input
            print(
                "\navis: the standard input ended before all values were given; give what is missing as options "
                "(see --help)",
                file=sys.stderr,
            )
            sys.exit(InputError.exit_code)
        code = INTERRUPTED
    except KeyboardInterrupt:
        code = INTERRUPTED
    except SystemError as error:  # numba turns an interrupt into this while it loads compiled code
        reason: BaseException | None = error
        while reason is not None and not isinstance(reason, KeyboardInterrupt):
            reason = reason.__cause__ or reason.__context__
        if reason is None:
            raise
        code = INTERRUPTED
    except Exception as error:  # usage errors of the command line parser have their own exit code
        if not (hasattr(error, "exit_code") and hasattr(error, "format_message")):
            raise
        if message := error.format_message():  # empty without a command: the help was printed
            if sys.argv[1:2] == ["gap"] and "--design" in sys.argv and "extra argument" in message:
                message += " --design takes no file; a design file is given by --design-file."
            print(f"avis: {message}", file=sys.stderr)
        sys.exit(error.exit_code)
    _no_more_alarms()
    if code == INTERRUPTED:
        print("avis: interrupted; no partial results were written", file=sys.stderr)
    sys.exit(code)
