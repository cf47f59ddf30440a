"""Tasks on the processors of this machine, with joblib."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from avis_ctrl.study.workers import as_worker
from avis_ctrl.sweep.task import Task, lost, perform

_parent: int | None = None


def on_this_machine(tasks: Sequence[Task], jobs: int) -> Iterator[dict[str, Any]]:
    """Content of each point as it is finished, in any order.

    If a process is killed, the points in progress are computed again, one at a time. A point is lost only if its
    process is killed a second time.
    """
    if jobs == 1:
        yield from map(perform, tasks)
        return
    waiting, suspects = list(tasks), list[Task]()
    while waiting or suspects:
        batch = waiting or [suspects.pop(0)]
        handed_out: list[Task] = []
        finished: set[str] = set()
        try:
            for content in _parallel(batch, jobs, handed_out):
                finished.add(content["identity"])
                yield content
            waiting = []
        except TerminatedWorkerError:
            if not waiting:
                yield lost(batch[0], "its process was killed twice; likely cause: memory, or a fault in compiled code")
                continue
            suspects += [task for task in handed_out if task.identity not in finished]
            waiting = waiting[len(handed_out) :]


def _parallel(tasks: Sequence[Task], jobs: int, handed_out: list[Task]) -> Iterator[dict[str, Any]]:
    def calls() -> Iterator[Any]:
        for task in tasks:
            handed_out.append(task)
            yield joblib.delayed(_in_worker)(task, os.getpid())

    # Each process gets one task at a time, and only when it is free: the tasks in progress are known.
    parallel = joblib.Parallel(
        jobs, backend="loky", return_as="generator_unordered", batch_size=1, pre_dispatch=jobs, max_nbytes=None
    )
    yield from parallel(calls())


def _in_worker(task: Task, parent: int) -> dict[str, Any]:
    """`perform` in a process that ends with its parent."""
    global _parent
    if _parent != parent:
        as_worker(parent)
        _parent = parent
    return perform(task)
