"""`avis sweep`: many designs, skyhooks, gap searches or function calls from one points file."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from avis_ctrl.cli.console import Terminal
from avis_ctrl.cli.options import Options

SWEEP = Options("""
POINTS.toml: a base design and the keys that vary (docs/sweep.md)
--out DIR: folder for table, picture and points
--scheduler ADDRESS: a dask scheduler of a cluster, such as tcp://HOST:8786
--workers N: start a dask scheduler with N workers on this machine
--jobs N: processes without dask; by default one for each processor
""")


def sweep(
    points: Annotated[Path, SWEEP("POINTS.toml")],
    out: Annotated[Path, SWEEP("--out")],
    scheduler: Annotated[str | None, SWEEP("--scheduler")] = None,
    workers: Annotated[int | None, SWEEP("--workers", min=1)] = None,
    jobs: Annotated[int | None, SWEEP("--jobs", min=1)] = None,
) -> None:
    """Compute many designs (points), and write a table and their Pareto front.

    Writes points/HASH.json as each point is finished, then sweep.csv, pareto.png, sweep.html and sweep.json into DIR.
    If the command is interrupted, the same command continues with the missing points. The row of a failed point has the
    reason.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from avis_ctrl.errors import ComputationError, InputError, UserInterruptError
    from avis_ctrl.study.files import open_folder, output_folder
    from avis_ctrl.study.workers import available
    from avis_ctrl.sweep.cluster import on_cluster, require_distributed
    from avis_ctrl.sweep.local import on_this_machine
    from avis_ctrl.sweep.output import FILES, front_of, write_sweep
    from avis_ctrl.sweep.run import POINTS, plan_sweep, run_sweep

    if sum(one is not None for one in (scheduler, workers, jobs)) > 1:
        raise InputError("give at most one of --scheduler, --workers and --jobs", field="options")
    if scheduler is not None or workers is not None:
        require_distributed()
        backend = partial(on_cluster, address=scheduler, workers=workers or 0)
    else:
        backend = partial(on_this_machine, jobs=jobs or available())
    terminal = Terminal()
    console = terminal.console
    plan = plan_sweep(points, out)
    with output_folder(out, FILES, (POINTS,)) as folder:
        open_folder(folder / POINTS)
        bar = Progress(
            TextColumn("points"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        with bar:
            shown = bar.add_task("points", total=None)

            def progress(done: int, total: int, text: str) -> None:
                bar.update(shown, completed=done, total=total)
                if text or not console.is_terminal:
                    console.print(f"[dim]{done} of {total}[/]" + (f": {text}" if text else ""), soft_wrap=True)

            try:
                found = run_sweep(plan, backend, progress)
            except KeyboardInterrupt:
                raise UserInterruptError(
                    "interrupted; finished points are kept: the same command computes the others"
                ) from None
        files = write_sweep(found, folder)
    rows, front = found.rows, front_of(found)
    count = {status: sum(row.status == status for row in rows) for status in ("done", "failed", "lost")}
    console.print(
        f"{len(rows)} points: {', '.join(f'{n} {status}' for status, n in count.items() if n)}; "
        f"{found.computed} computed now; {len(front)} on the Pareto front"
    )
    terminal.files(files, folder, "sweep.html", "sweep.csv")
    if count["lost"]:
        why = next(row.message for row in rows if row.status == "lost")
        raise ComputationError(
            f"{count['lost']} points are not finished",
            cause=why,
            next_step="run the same command again: finished points are kept",
        )
    if not count["done"]:
        raise ComputationError("every point failed", cause=rows[0].message)
