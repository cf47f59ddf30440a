"""Processor time of `avis gap` and `avis identify` over that of another version, in one run.

    python -m benchmarks.processor_time COMMIT [--seeds 1 2 3] [--cluttered] [--duration 60]

The campaigns come from the simulator in tests/truth. Each command runs on each campaign with both versions, one after
the other and in changing order, in a process of its own with one BLAS thread. The figures are user and system time of
the process and its children, and the largest memory of one process. Nothing else should run on the machine: a busy
neighbour raises the processor time of both.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from truth import cases

from avis_ctrl.measurement.formats.hdf5 import write_campaign
from benchmarks.blind.case import stripped

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("gap", "identify")
RUN = "import sys; from avis_ctrl.cli import main; sys.exit(main())"


@dataclass(frozen=True)
class Cost:
    """Exit code, processor seconds and largest memory [MB] of a process."""

    code: int
    seconds: float
    memory_MB: float


def cost_of(arguments: Sequence[str], tree: Path, log: Path) -> Cost:
    """Of a Python process that imports the package from a tree; its output goes to a file."""
    one = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    with log.open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", *arguments],
            cwd=tree,
            env={**os.environ, **one, "PYTHONPATH": str(tree)},
            stdout=out,
            stderr=subprocess.STDOUT,
        )
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return Cost(process.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.processor_time", description=__doc__.splitlines()[0])
    parser.add_argument("commit", help="commit of the other version")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="of the campaigns")
    parser.add_argument("--cluttered", action="store_true", help="tables that differ from their rig file in everything")
    parser.add_argument("--duration", type=float, default=60.0, help="of a record [s]")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        subprocess.run(
            ["git", "-C", str(ROOT), "worktree", "add", "-q", "--detach", str(other), args.commit], check=True
        )
        try:
            ratios = _compared(args, Path(folder), {"other": other, "this": ROOT})
        finally:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(other)], check=True)
    for command, found in ratios.items():
        if found:
            print(f"{command}: this over other, median {np.median(found):.2f}, largest {max(found):.2f}")
    return 0


def _compared(args: argparse.Namespace, folder: Path, trees: dict[str, Path]) -> dict[str, list[float]]:
    """Ratios of processor time by command, one for each campaign."""
    ratios: dict[str, list[float]] = {command: [] for command in COMMANDS}
    clutter = {"clutter": True} if args.cluttered else {}
    heads = ("other [s]", "this [s]", "ratio", "other [MB]", "this [MB]")
    print(f"{'seed':>6} {'command':10}" + "".join(f"{head:>12}" for head in heads))
    for k, seed in enumerate(args.seeds):
        file = folder / f"{seed}.h5"
        write_campaign(file, stripped(cases.simulate_case(cases.draw_case(seed, duration_s=args.duration, **clutter))))
        for command in COMMANDS:
            costs = {}
            for name in sorted(trees, reverse=bool(k % 2)):
                out = folder / f"{name}-{seed}-{command}"
                arguments = [RUN, command, str(file), "--rig", "avis", "--out", str(out)]
                costs[name] = cost_of(arguments, trees[name], folder / "log.txt")
            if failed := [name for name, cost in costs.items() if cost.code]:
                print(f"{seed:6d} {command:10} not counted: the {' and the '.join(failed)} version ended with an error")
                continue
            a, b = costs["other"], costs["this"]
            ratios[command].append(b.seconds / a.seconds)
            print(
                f"{seed:6d} {command:10}{a.seconds:12.1f}{b.seconds:12.1f}{b.seconds / a.seconds:12.2f}"
                f"{a.memory_MB:12.0f}{b.memory_MB:12.0f}",
                flush=True,
            )
        file.unlink()
    return ratios


if __name__ == "__main__":
    sys.exit(main())
