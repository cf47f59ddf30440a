"""One point as a task: it can run anywhere, its result is one file, and it is computed only if the file is missing."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

import avis_ctrl
from avis_ctrl.errors import AvisError
from avis_ctrl.files import write_whole
from avis_ctrl.study.files import as_json
from avis_ctrl.study.workers import alone

FORMAT = "avis-sweep-point"
# Status of results that are kept. A lost point (a process that died, a full disk or memory, a missing library) may
# succeed in the next run.
LASTING = ("done", "failed")
# The kernels keep module-level state: a cluster process with several threads computes one point at a time.
_one_at_a_time = threading.Lock()


@dataclass(frozen=True, eq=False)
class Job:
    """A point with everything that its result depends on; it is pickled to other processes.

    inputs : everything that the result depends on, as text.
    compute : gives figures for the table, and further content of the point's file. Raises AvisError.
    """

    inputs: str
    compute: Callable[[], tuple[dict[str, Any], dict[str, Any]]]


@dataclass(frozen=True, eq=False)
class Task:
    """A point to compute. folder : folder of the point files, as named by the machine that started the sweep."""

    identity: str
    folder: Path
    job: Job
    version: str = avis_ctrl.__version__


def identity_of(kind: str, inputs: str) -> str:
    """SHA-256 of everything that a result depends on: kind, inputs, version of the package."""
    return hashlib.sha256("\n".join((kind, avis_ctrl.__version__, inputs)).encode()).hexdigest()


def perform(task: Task) -> dict[str, Any]:
    """Compute a point and return the content of its file. The file is written first if its folder can be reached.

    Errors become the message of the content; nothing is raised.
    """
    with _one_at_a_time:
        if (kept := read_point(task.folder, task.identity)) is not None:
            return kept
        content = _computed(task)
        if content["status"] in LASTING and task.folder.is_dir():
            with contextlib.suppress(AvisError):  # the process that started the sweep also tries, and reports the error
                save_point(task.folder, content)
        return content


def _computed(task: Task) -> dict[str, Any]:
    began = time.monotonic()
    figures: dict[str, Any] = {}
    details: dict[str, Any] = {}
    status, message = "done", ""
    try:
        if task.version != avis_ctrl.__version__:
            return lost(task, f"this machine has avis_ctrl {avis_ctrl.__version__}, the sweep {task.version}")
        with threadpool_limits(1), alone():
            figures, details = task.job.compute()
    except AvisError as error:
        status, message = "failed", _one_line(error)
    except (MemoryError, OSError, ImportError) as error:
        return lost(task, f"{type(error).__name__}: {_one_line(error)}")
    except Exception as error:
        status, message = "failed", f"{type(error).__name__}: {_one_line(error)}"
    # Round trip through JSON: a computed figure equals one that was read.
    return json.loads(as_json(_content(task, status, message, time.monotonic() - began, figures) | details))


def lost(task: Task, message: str) -> dict[str, Any]:
    """Content of a point that could not be computed for a reason unrelated to the point."""
    return _content(task, "lost", message, None, {})


def _content(task: Task, status: str, message: str, seconds: float | None, figures: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": 1,
        "identity": task.identity,
        "status": status,
        "message": message,
        "seconds": seconds,
        "figures": figures,
        "computed": {
            "avis_ctrl": avis_ctrl.__version__,
            "host": platform.node(),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    }


def point_path(folder: Path, identity: str) -> Path:
    """File of a point."""
    return folder / f"{identity}.json"


def read_point(folder: Path, identity: str) -> dict[str, Any] | None:
    """Content of a finished point; None if the file is missing or invalid."""
    try:
        content = json.loads(point_path(folder, identity).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    whole = (
        isinstance(content, dict)
        and content.get("format") == FORMAT
        and content.get("identity") == identity
        and content.get("status") in LASTING
        and isinstance(content.get("figures"), dict)
    )
    return content if whole else None


def save_point(folder: Path, content: dict[str, Any]) -> None:
    """Write a point's file, unless it exists. Raises ComputationError if the disk is full."""
    if read_point(folder, content["identity"]) is None:
        write_whole(point_path(folder, content["identity"]), as_json(content))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
