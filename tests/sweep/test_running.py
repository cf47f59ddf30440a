"""Sweeps on joblib and on real dask schedulers: kills, resumed runs, failures; executions are counted by a log."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers import environment, logged, process_of_last, rows_of, start, write_points

from avis_ctrl.cli.sweep import sweep
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.sweep.cluster import on_cluster
from avis_ctrl.sweep.local import on_this_machine
from avis_ctrl.sweep.output import write_sweep
from avis_ctrl.sweep.points import SweepSettings
from avis_ctrl.sweep.run import Sweep, plan_sweep, run_sweep

pytest.importorskip("distributed", reason="dask.distributed is an extra")


def wait_for(reached: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory) -> Iterator[tuple[str, Callable[[], subprocess.Popen]]]:
    """Address of a scheduler in a process of its own, and what starts a worker process."""
    folder = tmp_path_factory.mktemp("dask")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    running = []

    def process(*arguments: str) -> subprocess.Popen:
        log = (folder / f"{len(running)}.log").open("w")
        one = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
            stdout=log,
            stderr=log,
            env=environment(),
            cwd=folder,
        )
        running.append(one)
        return one

    def worker() -> subprocess.Popen:
        return process("dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")

    process("dask_scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2], "--no-dashboard")
    worker()
    yield address, worker
    for one in running:
        one.kill()
        one.wait()


def swept(folder: Path, backend, out: str = "out") -> Sweep:
    points = folder / out / "points"
    points.mkdir(parents=True, exist_ok=True)
    found = run_sweep(plan_sweep(folder / "points.toml", folder / out), backend)
    write_sweep(found, folder / out)
    return found


def without_times(rows: list[dict]) -> list[dict]:
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


def test_joblib_and_a_scheduler_agree_and_a_failed_point_says_why(scheduler, tmp_path):
    write_points(tmp_path, 6, refused=2)
    local = swept(tmp_path, lambda tasks: on_this_machine(tasks, 2), "local")
    assert Counter(logged(tmp_path, "began")) == dict.fromkeys(range(6), 1)
    swept(tmp_path, lambda tasks: on_cluster(tasks, scheduler[0], 0), "cluster")
    assert Counter(logged(tmp_path, "began")) == dict.fromkeys(range(6), 2)
    rows = rows_of(tmp_path / "local")
    assert without_times(rows) == without_times(rows_of(tmp_path / "cluster"))
    assert [row["status"] for row in rows] == ["done", "done", "failed", "done", "done", "done"]
    assert rows[2]["message"] == "ValueError: no value at this point" and rows[2]["figures"] == {}
    assert [row["figures"]["cost"] for row in rows if row["figures"]] == [0, 1, 9, 16, 25]
    # Done again, nothing is: the failed point neither.
    again = swept(tmp_path, lambda tasks: pytest.fail("nothing is left"), "local")
    assert again.computed == 0 and again.rows == local.rows


def test_points_of_a_killed_worker_go_to_the_other(scheduler, tmp_path):
    address, worker = scheduler
    write_points(tmp_path, 14, wait_s=0.2)
    other = worker()
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    killed = []

    def on_both(tasks):
        for content in on_cluster(tasks, address, 0):
            if not killed:
                other.send_signal(signal.SIGSTOP)  # so that it is where the log says when it is killed
                time.sleep(0.02)
                of_other = [
                    line for line in (tmp_path / "log").read_text().splitlines() if line.endswith(f" {other.pid}")
                ]
                if of_other and of_other[-1].startswith("began"):
                    other.kill()
                    killed.append(other.wait())
                else:
                    other.send_signal(signal.SIGCONT)
            yield content

    found = swept(tmp_path, on_both)
    assert killed == [-signal.SIGKILL]
    assert [row.status for row in found.rows] == ["done"] * 14
    # None was finished twice; only what the killed worker had begun was begun again.
    assert Counter(logged(tmp_path, "ended")) == dict.fromkeys(range(14), 1)
    assert 14 <= len(logged(tmp_path, "began")) <= 15


@pytest.mark.parametrize("how", [("--jobs", "2"), pytest.param(("--workers", "1"), marks=pytest.mark.slow)])
def test_a_killed_run_goes_on_where_it_was(how, tmp_path):
    path, out = write_points(tmp_path, 10, wait_s=0.15), tmp_path / "out"
    first = start(path, "--out", out, *how)
    try:
        wait_for(lambda: len(logged(tmp_path, "ended")) >= 5)
        first.kill()  # the command alone: its workers end by themselves
        first.communicate(timeout=30)
    finally:
        first.kill()
    time.sleep(1.5)  # a worker looks for its parent once a second
    files = {path.name for path in (out / "points").iterdir() if path.suffix == ".json"}
    began = Counter(logged(tmp_path, "began"))
    assert 3 <= len(files) < 10 and not (out / "sweep.json").exists()
    again = swept(tmp_path, lambda tasks: on_this_machine(tasks, 1))
    assert again.computed == 10 - len(files)
    rows = rows_of(out)
    assert [row["status"] for row in rows] == ["done"] * 10
    kept = [row["parameters"]["k"] for row in rows if f"{row['identity']}.json" in files]
    after = Counter(logged(tmp_path, "began"))
    assert len(kept) == len(files) and all(after[k] == began[k] for k in kept)
    # A process that is killed while it names a file leaves a hidden one.
    seen = {path.name for path in (out / "points").iterdir() if not path.name.startswith(".")}
    assert seen == {f"{row['identity']}.json" for row in rows}


def test_a_resumed_sweep_waits_for_what_a_cluster_still_computes(scheduler, tmp_path):
    path = write_points(tmp_path, 1, wait_s=4.0)
    first = start(path, "--out", tmp_path / "out", "--scheduler", scheduler[0])
    wait_for(lambda: logged(tmp_path, "began") == [0])
    first.kill()
    first.communicate()
    assert logged(tmp_path, "ended") == []
    found = swept(tmp_path, lambda tasks: on_cluster(tasks, scheduler[0], 0))
    assert [row.status for row in found.rows] == ["done"]
    assert logged(tmp_path, "began") == logged(tmp_path, "ended") == [0]


@pytest.mark.slow
def test_a_point_that_kills_its_process_is_lost_alone(tmp_path):
    write_points(tmp_path, 6, deadly=1, wait_s=0.05)
    found = swept(tmp_path, lambda tasks: on_this_machine(tasks, 2))
    assert [row.status for row in found.rows] == ["done", "lost", "done", "done", "done", "done"]
    assert "killed twice" in found.rows[1].message
    # Of the others, only the one that was under way beside it may have been begun again.
    others = Counter(k for k in logged(tmp_path, "began") if k != 1)
    assert set(others) == {0, 2, 3, 4, 5} and sum(others.values()) <= 6
    # It is not kept: next time it is computed again, and only it.
    before = Counter(logged(tmp_path, "began"))
    swept(tmp_path, lambda tasks: on_this_machine(tasks, 2))
    assert set(Counter(logged(tmp_path, "began")) - before) == {1}


def test_a_half_written_point_is_computed_again(tmp_path):
    write_points(tmp_path, 3)
    found = swept(tmp_path, lambda tasks: on_this_machine(tasks, 1))
    point = tmp_path / "out" / "points" / f"{found.rows[1].identity}.json"
    whole = json.loads(point.read_text())
    point.write_text(point.read_text()[:40])
    assert swept(tmp_path, lambda tasks: on_this_machine(tasks, 1)).computed == 1
    assert json.loads(point.read_text())["figures"] == whole["figures"]
    assert Counter(logged(tmp_path, "began")) == {0: 1, 1: 2, 2: 1}


def test_a_changed_function_is_another_point(tmp_path):
    write_points(tmp_path, 2)
    swept(tmp_path, lambda tasks: on_this_machine(tasks, 1))
    own = tmp_path / "own.py"
    own.write_text(own.read_text().replace('point["k"] ** 2', 'point["k"] ** 3 + 1'))
    assert [row.figures["cost"] for row in swept(tmp_path, lambda tasks: on_this_machine(tasks, 1)).rows] == [1, 2]


@pytest.mark.parametrize("how", [("--jobs", "2"), pytest.param(("--workers", "1"), marks=pytest.mark.slow)])
def test_an_interrupt_keeps_what_is_finished(how, tmp_path):
    path, out = write_points(tmp_path, 10, wait_s=0.15), tmp_path / "out"
    child = start(path, "--out", out, *how)
    wait_for(lambda: len(logged(tmp_path, "ended")) >= 3)  # two may not be in their files yet
    os.killpg(child.pid, signal.SIGINT)
    _, complained = child.communicate(timeout=30)
    assert child.returncode == 130 and "Traceback" not in complained
    assert complained.splitlines()[-1] == (
        "avis: interrupted; finished points are kept: the same command computes the others"
    )
    assert len(list((out / "points").glob("*.json"))) >= 1


def test_no_scheduler_and_no_worker_are_one_line(tmp_path):
    soon = SweepSettings(patience_s=0.5)
    with pytest.raises(InputError, match=r"--scheduler = 'tcp://127\.0\.0\.1:9': expected the address of a dask"):
        list(on_cluster([], "tcp://127.0.0.1:9", 0, soon))
    assert "IO loop" not in {thread.name for thread in threading.enumerate()}, "a client is still open"
    with pytest.raises(InputError, match="--scheduler = 'nonsense'"):
        list(on_cluster([], "nonsense", 0, soon))
    assert "IO loop" not in {thread.name for thread in threading.enumerate()}, "a client is still open"


def test_a_scheduler_without_workers_is_one_line():
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        pytest.raises(InputError, match=r"expected a scheduler with a worker; none came within 0\.5 s"),
    ):
        list(on_cluster([], cluster.scheduler_address, 0, SweepSettings(patience_s=0.5)))


@pytest.mark.slow
def test_a_point_that_kills_every_worker_is_lost_alone_on_a_cluster(tmp_path):
    write_points(tmp_path, 4, deadly=1)
    found = swept(tmp_path, lambda tasks: on_cluster(tasks, None, 1))
    assert [row.status for row in found.rows] == ["done", "lost", "done", "done"]
    assert "every process that computed it died" in found.rows[1].message
    assert Counter(logged(tmp_path, "began"))[1] == SweepSettings().deaths


def test_without_dask_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install \"avis_ctrl\[cluster\]\""):
        list(on_cluster([], None, 1))


def test_a_disk_that_refuses_a_point_ends_the_sweep(tmp_path, monkeypatch):
    from avis_ctrl.sweep import task

    def full(path: Path, content: bytes) -> None:
        raise ComputationError(f"{path.name} was not written", cause="No space left on device")

    write_points(tmp_path, 3)
    monkeypatch.setattr(task, "write_whole", full)
    with pytest.raises(ComputationError, match="No space left"):
        swept(tmp_path, lambda tasks: on_this_machine(tasks, 1))
    assert logged(tmp_path, "began") == [0]


def test_one_option_for_where_it_runs(tmp_path):
    path = write_points(tmp_path, 1)
    for two in ({"workers": 1, "jobs": 1}, {"scheduler": "tcp://127.0.0.1:9", "workers": 1}):
        with pytest.raises(InputError, match="one of --scheduler, --workers and --jobs"):
            sweep(path, tmp_path / "out", **two)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_helpers_count_processes(tmp_path):
    """The test of the test: the log tells calls and processes apart."""
    write_points(tmp_path, 2)
    swept(tmp_path, lambda tasks: on_this_machine(tasks, 1))
    assert logged(tmp_path, "began") == [0, 1] and process_of_last(tmp_path) == os.getpid()
    shutil.rmtree(tmp_path / "out")
    swept(tmp_path, lambda tasks: on_this_machine(tasks, 1))
    assert Counter(logged(tmp_path, "ended")) == {0: 2, 1: 2}
