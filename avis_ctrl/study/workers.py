"""Two processes for work that needs no exchange: analyses of controllers, simulations."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

MOST = 2


class Workers:
    """A pool where there are processors for one, else the same calls one after the other in this process."""

    def __init__(self, count: int | None = None):
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._count = min(MOST, available) if count is None else count

    def __enter__(self) -> Workers:
        # A forked child has the compiled code and the libraries already.
        method = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
        # Ctrl-C ends the children at once and silently; this process says that it was stopped.
        self._pool = (ProcessPoolExecutor(self._count, multiprocessing.get_context(method), signal.signal,
                                          (signal.SIGINT, signal.SIG_DFL)) if self._count > 1 else None)
        self._others = set(multiprocessing.active_children())
        return self

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """A future of function(*arguments); errors come out of its result()."""
        if self._pool is not None:
            return self._pool.submit(function, *arguments)
        done: Future = Future()
        try:
            done.set_result(function(*arguments))
        except Exception as error:
            done.set_exception(error)
        return done

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        if self._pool is None:
            return
        if kind is not None:
            # Nobody waits for the answers any more; without this the interpreter would, before it ends.
            for child in set(multiprocessing.active_children()) - self._others:
                child.terminate()
        self._pool.shutdown(cancel_futures=True)
