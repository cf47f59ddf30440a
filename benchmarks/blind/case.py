"""One case of a blind campaign, in a process of its own: draw, simulate, ask the finder, measure what it cost.

The finder gets a campaign that is rebuilt from the samples alone, and the nominal rig. What is hidden goes to the
parent process and from there to the file; it never meets the finder.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import multiprocessing
import os
import resource
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.rigs import IsolatorTable, load_rig

# A traceback is kept from its end, where the reason is.
LONGEST_TEXT = 4000


@dataclass(frozen=True)
class Task:
    """What a worker is told. truth, finder : names of modules. cores : that it may use, empty for all."""

    seed: int
    duration_s: float
    kind: str | None
    effect: str | None
    strength: str | None
    unseen: bool
    truth: str
    finder: str
    cores: tuple[int, ...]
    clutter: bool = False


def work(task: Task, to_parent: Connection) -> None:
    """Entry of a worker; sends ("drawn" | "simulated" | "answered" | "crashed" | "unseen", what it found)."""
    _end_with_parent()
    if task.cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, task.cores)
    with threadpool_limits(1):
        try:
            _work(task, to_parent)
        except Exception:
            to_parent.send(("truth failed", traceback.format_exc()[-LONGEST_TEXT:]))
    to_parent.close()


def _work(task: Task, to_parent: Connection) -> None:
    truth = importlib.import_module(task.truth)
    case = truth.draw_case(
        task.seed,
        kind=task.kind,
        effect=task.effect,
        strength=task.strength,
        duration_s=task.duration_s,
        **({"clutter": True} if task.clutter else {}),
    )
    to_parent.send(("drawn", described(case)))
    began = time.perf_counter()
    campaign = stripped(truth.simulate_case(case))
    to_parent.send(
        (
            "simulated",
            {"simulation_seconds": time.perf_counter() - began, "relative_change": finite(truth.relative_change(case))},
        )
    )
    finder = importlib.import_module(task.finder)
    finding = _ask(finder, campaign, load_rig("avis"), to_parent)
    if finding is not None and task.unseen:
        try:
            unseen = stripped(truth.simulate_case(case, unseen=True))
            found = prediction_errors(finder, finding, unseen)
            if hasattr(truth, "best_prediction"):
                found["best"] = nrmse([record.y for record in unseen.records], truth.best_prediction(case, unseen=True))
            to_parent.send(("unseen", {"unseen": found}))
        except Exception:
            to_parent.send(("unseen", {"unseen_error": traceback.format_exc()[-LONGEST_TEXT:]}))


def _ask(finder: Any, campaign: Campaign, rig: IsolatorTable, to_parent: Connection) -> Any:
    """The finding, or None after a crash."""
    memory = PeakMemory()
    cpu, began = cpu_seconds(), time.perf_counter()
    finding, text, kind = None, {}, "answered"
    try:
        finding = finder.find_gap(campaign, rig, finder.GapOptions())
        # As the file would say it: numbers that JSON does not know, and arrays, are the finder's mistake.
        text = {"answer": json.loads(json.dumps(finding.to_json(), allow_nan=False))}
    except Exception:
        finding, kind, text = None, "crashed", {"crash": traceback.format_exc()[-LONGEST_TEXT:]}
    to_parent.send(
        (
            kind,
            text
            | {
                "seconds": time.perf_counter() - began,
                "cpu_seconds": cpu_seconds() - cpu,
                "memory_MB": memory.end_MB(),
            },
        )
    )
    return finding


def described(case: Any) -> dict:
    """What is hidden, for the scorer."""
    return {
        "kind": case.kind,
        "excitation": str(case.excitation),
        "floor_recorded": bool(case.floor_recorded),
        "hidden": [
            {
                "name": one.name,
                "location": one.location,
                "strength": one.strength,
                "parameters": plain(one.parameters),
                "variant": getattr(one, "details", {}).get("variant"),
            }
            for one in case.effects
        ],
        "cluttered": bool(getattr(case, "clutter", False)),
        "traces": [
            {
                "name": one.name,
                "location": one.location,
                "parameters": plain(one.parameters),
                "unexplained": plain(one.details["unexplained"]),
            }
            for one in getattr(case, "traces", ())
        ],
    }


def plain(value: Any) -> Any:
    """Arrays and NumPy numbers as JSON has them; what else it does not know, as text."""
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value if isinstance(value, (str, bool, int, float)) or value is None else str(value)


def finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def stripped(campaign: Campaign) -> Campaign:
    """The samples and their headers, without the notes, source and record names that could tell what is hidden."""
    records = [record.load() for record in campaign.records]
    return Campaign(
        campaign.rig,
        tuple(replace(record, header=replace(record.header, name=f"{k:02d}")) for k, record in enumerate(records)),
    )


def prediction_errors(finder: Any, finding: Any, campaign: Campaign) -> dict[str, float]:
    """nrmse of the baseline's and the updated model's prediction: `finder.predict` gives one pair a record."""
    measured = [record.load().y for record in campaign.records]
    pairs: Sequence[tuple[np.ndarray, np.ndarray]] = list(finder.predict(finding, campaign))
    return {
        "baseline": nrmse(measured, [pair[0] for pair in pairs]),
        "updated": nrmse(measured, [pair[1] for pair in pairs]),
    }


def nrmse(measured: Sequence[np.ndarray], predicted: Sequence[np.ndarray]) -> float:
    """Root of the mean over channels of (mean square error over variance), all records of (samples, channels) joined.

    Every channel counts alike, however large its signal; noise and floor motion that nobody measured are part of it.
    """
    Y, P = np.concatenate(list(measured)), np.concatenate(list(predicted))
    if Y.shape != P.shape:
        raise ValueError(f"predictions of shape {P.shape} for measurements of shape {Y.shape}")
    variance = Y.var(axis=0)
    alive = variance > 0
    return float(np.sqrt(np.mean(np.mean((Y - P) ** 2, axis=0)[alive] / variance[alive])))


def _end_with_parent() -> None:
    """A worker ends with the process that started it, also where that was killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def cpu_seconds() -> float:
    """Of this process and its ended children."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


class PeakMemory:
    """The most memory that this process and its children hold together while it is watched, every tenth of a second;
    of this process alone, the most between, too.

    Pages that forked children share with their parent count once (proportional set size, Linux). Without it, resident
    sizes are added.
    """

    def __init__(self) -> None:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # restarts the high-water mark
        self._most_MB, self._ended = held_MB(), threading.Event()
        self._watch = threading.Thread(target=self._watched, daemon=True)
        self._watch.start()

    def _watched(self) -> None:
        while not self._ended.wait(0.1):
            self._most_MB = max(self._most_MB, held_MB())

    def end_MB(self) -> float:
        """[1e6 bytes]."""
        self._ended.set()
        self._watch.join()
        return max(self._most_MB, _high_water_MB())


def held_MB() -> float:
    """By this process and all its children, now."""
    try:
        return sum(_proportional(pid) for pid in _family(os.getpid())) / 1e6
    except OSError:
        both = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(both) * (1 if sys.platform == "darwin" else 1024) / 1e6


def _high_water_MB() -> float:
    """Of this process; 0 where it is not known."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return 0.0
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) * 1024 / 1e6


def _family(pid: int) -> list[int]:
    found = [pid]
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found += [one for child in (thread / "children").read_text().split() for one in _family(int(child))]
    return found


def _proportional(pid: int) -> int:
    """Bytes; none for a process that has ended meanwhile."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        if pid == os.getpid():
            raise
        return 0
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
