"""Files of points that call a function; every call writes a line into a log, so that executions can be counted."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

FUNCTION = """
import os
import signal
import time


def figures(point):
    with open(point["log"], "a") as log:  # one short write: whole, also from several processes
        log.write(f"began {point['k']} {os.getpid()}\\n")
    time.sleep(point.get("wait_s", 0.0))
    if point["k"] == point.get("refused"):
        raise ValueError("no value at\\nthis point")
    if point["k"] == point.get("deadly"):
        os.kill(os.getpid(), signal.SIGKILL)
    with open(point["log"], "a") as log:
        log.write(f"ended {point['k']} {os.getpid()}\\n")
    return {"cost": point["k"] ** 2, "error": 1 / (1 + point["k"])}
"""
COMMAND = [sys.executable, "-c", "from avis_ctrl.cli import main; main()", "sweep"]


def write_points(folder: Path, count: int, **constants: Any) -> Path:
    """A file of `count` points k = 0, 1, ...; constants are further keys of all of them. Returns its path."""
    (folder / "own.py").write_text(FUNCTION)
    constants = {"log": str(folder / "log"), **constants}
    axes = "".join(
        f"[[vary]]\nkey = {json.dumps(key)}\nvalues = {json.dumps(values)}\n"
        for key, values in {"k": list(range(count)), **{k: [v] for k, v in constants.items()}}.items()
    )
    path = folder / "points.toml"
    path.write_text(f'kind = "function"\nbase = "own.py:figures"\npareto = ["cost", "error"]\n{axes}')
    return path


def logged(folder: Path, word: str) -> list[int]:
    """k of each call that began or ended, in their order."""
    if not (folder / "log").exists():
        return []
    lines = (folder / "log").read_text().splitlines()
    return [int(line.split()[1]) for line in lines if line.startswith(word)]


def process_of_last(folder: Path) -> int:
    """Process of the last line of the log."""
    return int((folder / "log").read_text().splitlines()[-1].split()[2])


def environment() -> dict[str, str]:
    """One thread, no questions to a display."""
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    """The command in a process group of its own."""
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        start_new_session=True,
    )


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Points of sweep.json."""
    return json.loads((folder / "sweep.json").read_text())["points"]
