"""Throughput of a sweep against the number of processes: joblib, and dask workers, on this machine.

    python -m benchmarks.sweep [--points 12] [--design designs/avis_z_phix.toml]

Two tables. In the first each point is the analysis of a skyhook on a table drawn at random. In the second a point only
waits, which shows what the machinery costs, whatever else the machine does. What counts are ratios; the load is printed
beside them. The first ratio is that of whole sweeps, in which each process starts and loads compiled code; the second
that of the points after the first one of each process.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from avis_ctrl.study.workers import available
from avis_ctrl.sweep.cluster import on_cluster
from avis_ctrl.sweep.local import on_this_machine
from avis_ctrl.sweep.run import POINTS, Backend, plan_sweep, run_sweep

SKYHOOKS = """
kind = "skyhook"
base = {base!r}
[[vary]]
key = "rig_factor.isolator*.k_z"
random = {{ count = {points}, seed = 1, low = 0.8, high = 1.25, scale = "log" }}
"""
WAITS = """
kind = "function"
base = "wait.py:wait"
[[vary]]
key = "k"
values = {values}
"""
WAIT_S = 0.25
WAIT = f"""
import time

def wait(point):
    time.sleep({WAIT_S})
    return {{"k": point["k"]}}
"""


def ends_of(points: Path, backend: Backend) -> list[float]:
    """When each point of a sweep into a new folder was finished [s], from its beginning."""
    ends: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, POINTS).mkdir()
        plan = plan_sweep(points, Path(folder))
        began = time.perf_counter()
        found = run_sweep(plan, backend, lambda done, total, text: ends.append(time.perf_counter() - began))
    if wrong := [row.message for row in found.rows if row.status != "done"]:
        raise SystemExit(f"{len(wrong)} points were not done: {wrong[0]}")
    return ends[1:]  # the first call says that nothing was there


def cases() -> Iterator[tuple[str, int, Backend]]:
    """Name, processes, backend."""
    for n in (1, 2):
        yield "joblib", n, lambda tasks, n=n: on_this_machine(tasks, n)
    for n in (1, 2):
        yield "dask", n, lambda tasks, n=n: on_cluster(tasks, None, n)


def table(title: str, points: Path) -> None:
    """Times and ratios of a file of points."""
    print(f"{title}; {available()} processors, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'':8s} {'processes':>9s} {'s':>7s} {'ratio to one':>12s} {'points per min, later':>21s} "
        f"{'ratio to one':>12s} {'load':>5s}"
    )
    one: dict[str, tuple[float, float]] = {}
    for name, n, backend in cases():
        ends = ends_of(points, backend)
        whole, rate = ends[-1], 60 * (len(ends) - n) / (ends[-1] - ends[n - 1])
        first, slow = one.setdefault(name, (whole, rate))
        print(
            f"{name:8s} {n:9d} {whole:7.1f} {first / whole:12.2f} {rate:21.1f} {rate / slow:12.2f} "
            f"{os.getloadavg()[0]:5.1f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=12)
    parser.add_argument("--design", type=Path, default=Path("designs/avis_z_phix.toml"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        points = Path(folder, "points.toml")
        Path(folder, "wait.py").write_text(WAIT)
        points.write_text(WAITS.format(values=list(range(4 * given.points))))
        table(f"{4 * given.points} points of {WAIT_S:g} s that wait", points)
        points.write_text(SKYHOOKS.format(base=str(given.design.resolve()), points=given.points))
        table(f"{given.points} skyhooks of {given.design.name}", points)


if __name__ == "__main__":
    main()
