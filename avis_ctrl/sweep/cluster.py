"""Tasks on a cluster with dask.distributed: on a running scheduler, or on a new one with workers on this machine."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.sweep.points import SweepSettings
from avis_ctrl.sweep.task import Task, lost, perform


def require_distributed() -> None:
    """Raise InputError, with instructions, if dask.distributed is not installed."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(
            'expected dask.distributed: pip install "avis_ctrl[cluster]"; without --scheduler and '
            "--workers a sweep needs nothing more",
            field="--scheduler or --workers",
        ) from None


def on_cluster(
    tasks: Sequence[Task], address: str | None, workers: int, settings: SweepSettings | None = None
) -> Iterator[dict[str, Any]]:
    """Content of each point as it is finished, in any order.

    If a worker dies, its points are given to other workers.

    Parameters
    ----------
    address : of a scheduler; None starts one with `workers` processes on this machine.

    Raises
    ------
    InputError : no scheduler at the address, or none with a worker. ComputationError : the scheduler was lost.
    """
    require_distributed()
    settings = settings or SweepSettings()
    import dask
    import distributed

    library: Any = distributed  # parts of it have no types

    # A killed worker or a lost scheduler is reported in a row or in one line, not in the library's log.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        stack.enter_context(
            dask.config.set(
                {
                    "distributed.scheduler.allowed-failures": settings.deaths - 1,
                    "distributed.comm.timeouts.connect": settings.patience_s,
                }
            )
        )
        if address is None:
            with _ignored_interrupts():
                cluster = stack.enter_context(
                    library.LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        processes=True,
                        dashboard_address="127.0.0.1:0",
                        silence_logs=logging.CRITICAL,
                    )
                )
            address = cluster.scheduler_address
        client = stack.enter_context(_connected(library, address, settings.patience_s))
        # Tasks are named by their identity: a resumed sweep joins tasks that are still running.
        by_name = {f"avis-sweep-{os.fspath(task.folder)}-{task.identity}": task for task in tasks}
        futures = [client.submit(perform, task, key=name) for name, task in by_name.items()]
        for future in library.as_completed(futures, loop=client.loop):
            yield _content(future, by_name[future.key])
            future.release()


@contextlib.contextmanager
def _ignored_interrupts() -> Iterator[None]:
    """Processes started in this context ignore Ctrl-C, which a terminal sends to all of them: the parent ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _reach(library: Any, address: str, patience_s: float) -> None:
    """Open and close a connection to the scheduler; raises what `distributed.Client` would raise.

    A client that cannot connect leaves its event loop running and closes itself when it is garbage-collected. If that
    happens while another client starts, both wait for the same lock forever. So no client is made for an address that
    does not respond.
    """

    async def reach() -> None:
        tls = library.Security().get_connection_args("client")  # from the library's configuration, as in a client
        comm = await library.core.connect(address, timeout=patience_s, **tls)
        await comm.close()

    # In a thread of its own: a notebook already runs an event loop in this one.
    with ThreadPoolExecutor(1) as thread:
        thread.submit(asyncio.run, reach()).result()


@contextlib.contextmanager
def _connected(library: Any, address: str, patience_s: float) -> Iterator[Any]:
    try:
        _reach(library, address, patience_s)
        client = library.Client(address, timeout=patience_s, set_as_default=False)
    except (OSError, ValueError, TypeError, KeyError, ImportError) as error:
        raise InputError(
            f"expected the address of a dask scheduler, such as tcp://HOST:8786 "
            f"({' '.join(str(error).split()) or type(error).__name__})",
            field="--scheduler",
            value=address,
        ) from None
    try:
        try:
            client.wait_for_workers(1, timeout=patience_s)
        except TimeoutError:
            raise InputError(
                f"expected a scheduler with a worker; none came within {patience_s:g} s; start one with "
                f"dask worker {address} --nthreads 1",
                field="--scheduler",
                value=address,
            ) from None
        yield client
    finally:
        with contextlib.suppress(TimeoutError, OSError):
            client.close(timeout=5)


def _content(future: Any, task: Task) -> dict[str, Any]:
    from distributed import CancelledError, KilledWorker

    try:
        # This also waits if a worker died before its result was fetched: another worker reads the point's file.
        return future.result()
    except KilledWorker:
        return lost(task, "every process that computed it died; likely cause: memory, or a fault in compiled code")
    except CancelledError:
        raise ComputationError(
            "the scheduler was lost", next_step="run the same command again: finished points are kept"
        ) from None
    except Exception as error:  # for example, a worker that cannot load the package
        return lost(task, f"{type(error).__name__}: {' '.join(str(error).split())}")
