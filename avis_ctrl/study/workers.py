"""A pool of two processes for independent computations: analyses of controllers, simulations."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

from threadpoolctl import threadpool_limits


@dataclass(frozen=True)
class WorkerSettings:
    """most : maximum number of processes of a pool: the commands are made for two processors.
    watch_s : interval between checks whether the parent is alive [s].
    niceness : added to that of workers beside the main computation, so that the main computation keeps a processor.
    """

    most: int = 2
    watch_s: float = 1.0
    niceness: int = 10


SETTINGS = WorkerSettings()


def available() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def as_worker(parent: int, on_interrupt: signal.Handlers = signal.SIG_DFL, niceness: int = 0) -> None:
    """Make this process a worker: Ctrl-C, SIGTERM and the death of the parent end it at once and silently. It uses one
    BLAS thread.

    on_interrupt : SIG_IGN if the parent decides on Ctrl-C, which reaches all processes: it may continue with its
        results.
    """
    if niceness and hasattr(os, "nice"):
        os.nice(niceness)
    threadpool_limits(1)
    signal.signal(signal.SIGINT, on_interrupt)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(SETTINGS.watch_s)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


_alone = False


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Context in which `Workers` and `each` compute in this process: for one of many processes on a busy machine."""
    global _alone
    before, _alone = _alone, True
    try:
        yield
    finally:
        _alone = before


class Workers:
    """A pool if several processors are available; otherwise the same calls one after the other in this process.

    beside : this process computes as well, with priority over the workers, and decides what Ctrl-C does.
    """

    def __init__(self, count: int | None = None, beside: bool = False):
        most = 1 if _alone else SETTINGS.most
        self._count = min(most, available()) if count is None else count
        self._manners = (signal.SIG_IGN, SETTINGS.niceness) if beside else (signal.SIG_DFL, 0)

    def __enter__(self) -> Workers:
        # A forked child has the compiled code and the libraries already.
        method = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
        self._pool = (
            ProcessPoolExecutor(
                self._count, multiprocessing.get_context(method), as_worker, (os.getpid(), *self._manners)
            )
            if self._count > 1
            else None
        )
        self._others = set(multiprocessing.active_children())
        return self

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """A future of function(*arguments); its result() raises the errors of the function."""
        if self._pool is not None:
            return self._pool.submit(function, *arguments)
        done: Future[Any] = Future()
        try:
            done.set_result(function(*arguments))
        except Exception as error:
            done.set_exception(error)
        return done

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        if self._pool is None:
            return
        if kind is not None:
            # The results are no longer needed; without this the interpreter would wait for them before it exits. Not by
            # SIGTERM: a child that has just started has this process's handler of it, and would then wait for a queue
            # that a dead one has locked.
            for child in set(multiprocessing.active_children()) - self._others:
                child.kill()
        self._pool.shutdown(cancel_futures=True)


_questions: tuple[Callable[[Any], Any], list[Any]] | None = None


def each(function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Apply a function to every item, in order, two at a time if there are processors for it.

    Forked processes find the function and the items in their memory; only results are sent. Errors are raised
    unchanged.
    """
    global _questions
    items = list(items)
    if len(items) < 2 or "fork" not in multiprocessing.get_all_start_methods():
        return [function(item) for item in items]
    _questions = function, items
    try:
        with Workers() as workers:
            return [future.result() for future in [workers.submit(_answer, k) for k in range(len(items))]]
    finally:
        _questions = None


def _answer(k: int) -> Any:
    assert _questions is not None
    function, items = _questions
    return function(items[k])
