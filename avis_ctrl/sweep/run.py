"""A complete sweep: read the points, reuse the finished ones, compute the others, make a table."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.study.provenance import provenance
from avis_ctrl.sweep.local import on_this_machine
from avis_ctrl.sweep.points import Point, PointsFile, points_of, read_points_file
from avis_ctrl.sweep.task import LASTING, Job, Task, identity_of, read_point, save_point

Backend = Callable[[Sequence[Task]], Iterator[dict[str, Any]]]
# Arguments: number of finished points, number of all points, message about the last one.
Progress = Callable[[int, int, str], None]
POINTS = "points"


class Base(Protocol):
    """The common part of the points of a sweep."""

    @property
    def quantities(self) -> Mapping[str, str]:
        """Labels, with units, of the figures."""

    @property
    def pareto(self) -> tuple[str, str] | None:
        """The two quantities of the plot; None without a natural choice."""

    def expand(self, key: str) -> Sequence[str]:
        """The keys that match a key. Raises InputError for an unknown key."""

    def job(self, point: Mapping[str, Any]) -> Job:
        """The base with the values of a point. Raises InputError for values that do not fit."""


def open_base(file: PointsFile, folder: Path) -> Base:
    """The base of a points file in a folder. Raises InputError if it is missing or invalid."""
    # Late imports: a process that computes one kind does not load the others.
    if file.kind == "gap":
        from avis_ctrl.sweep.gap_points import GapBase

        return GapBase.read(file, folder)
    if file.kind == "function":
        from avis_ctrl.sweep.function_points import FunctionBase

        return FunctionBase.read(file, folder)
    from avis_ctrl.sweep.design_points import DesignBase

    return DesignBase.read(file, folder)


@dataclass(frozen=True)
class Row:
    """A point of the table. status : done, failed (reason in the message), lost (computed again in the next run)."""

    identity: str
    point: Point
    status: str
    message: str
    seconds: float | None
    figures: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Sweep:
    """All rows in the order of the points file.

    quantities : labels of the figures. pareto : the two quantities of the plot, or None. computed : number of points
        computed in this run; the others were finished before.
    """

    file: PointsFile
    rows: tuple[Row, ...]
    quantities: Mapping[str, str]
    pareto: tuple[str, str] | None
    computed: int
    provenance: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Plan:
    """A checked points file: a task for each point, or the error that prevents it. sha256 : of the file as read."""

    path: Path
    file: PointsFile
    base: Base
    points: tuple[Point, ...]
    tasks: tuple[Task | InputError, ...]
    sha256: str

    @property
    def wrong(self) -> list[InputError]:
        """The errors of points with values that do not fit."""
        return [one for one in self.tasks if isinstance(one, InputError)]


def plan_sweep(path: Path, folder: Path) -> Plan:
    """Check a points file before anything is computed or written.

    Raises InputError: an invalid file, base or key; values from which not a single point can be made.
    """
    file = read_points_file(path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        base = open_base(file, path.parent)
    except InputError as error:
        if error.file is None:
            raise error.in_file(path) from None
        raise InputError(str(error), file=path, field="base", value=file.base) from None
    try:
        points = points_of(file, base.expand)
    except InputError as error:
        raise error.in_file(path) from None
    known = [*base.quantities, *dict.fromkeys(key for point in points for key in point)]
    if base.quantities and (wrong_names := [name for name in file.pareto or () if name not in known]):
        raise InputError(f"expected some of {', '.join(known)}", file=path, field="pareto", value=wrong_names[0])
    where = (folder / POINTS).absolute()
    tasks: list[Task | InputError] = []
    for point in points:
        try:
            job = base.job(point)
            tasks.append(Task(identity_of(file.kind, job.inputs), where, job))
        except InputError as error:
            tasks.append(error)
    plan = Plan(path, file, base, tuple(points), tuple(tasks), sha256)
    if len(plan.wrong) == len(tasks):
        raise plan.wrong[0].in_file(plan.wrong[0].file or path)
    return plan


def run_sweep(
    plan: Plan,
    backend: Backend = lambda tasks: on_this_machine(tasks, 1),
    progress: Progress = lambda done, total, text: None,
) -> Sweep:
    """Compute the unfinished points, each into its file, and collect all points.

    The folder of the points must exist. If the process is killed at any time, the same call continues with the
    unfinished points.

    Raises ComputationError: a point's file could not be written, a cluster was lost.
    """
    began = time.monotonic()
    known: dict[str, dict[str, Any]] = {}
    tasks = {task.identity: task for task in plan.tasks if isinstance(task, Task)}
    for identity, task in tasks.items():
        if (kept := read_point(task.folder, identity)) is not None:
            known[identity] = kept
    waiting = [task for identity, task in tasks.items() if identity not in known]
    if wrong := plan.wrong:  # before minutes of computation
        progress(
            len(known),
            len(tasks),
            f"{len(wrong)} of {len(plan.points)} points have values that do not fit and "
            f"are not computed; the first: {wrong[0]}",
        )
    progress(len(known), len(tasks), f"{len(known)} were finished before" if known else "")
    for content in backend(waiting) if waiting else ():
        if content["status"] in LASTING:
            save_point(tasks[content["identity"]].folder, content)
        known[content["identity"]] = content
        progress(len(known), len(tasks), content["message"])
    rows = tuple(_row(plan, k, known) for k in range(len(plan.points)))
    pareto = plan.file.pareto
    about = provenance(
        None,
        "".join(tasks),
        None,
        time.monotonic() - began,
        ("numpy", "scipy", "numba", "joblib"),
        points_file=plan.path.name,
        points_sha256=plan.sha256,
    )
    return Sweep(
        plan.file,
        rows,
        plan.base.quantities,
        (pareto[0], pareto[1]) if pareto else plan.base.pareto,
        len(waiting),
        about,
    )


def _row(plan: Plan, k: int, known: Mapping[str, dict[str, Any]]) -> Row:
    task, point = plan.tasks[k], plan.points[k]
    if isinstance(task, AvisError):
        return Row("", point, "failed", str(task), None, {})
    found = known[task.identity]
    return Row(task.identity, point, found["status"], found["message"], found["seconds"], found["figures"])
