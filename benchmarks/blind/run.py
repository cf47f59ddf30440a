"""Run a blind campaign: each case in a fresh process, one JSON line a case, safe to kill and resume.

    python -m benchmarks.blind --cases 300 --seed 1 --jobs 2 --duration 60 --out blind.jsonl [--resume] [--unseen]
                              [--cluttered 0.5]

With several jobs each one is held on a core of its own, so that `seconds` are those of a single core; with --jobs 1
the finder has all cores.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import TracebackType
from typing import Any

from avis_ctrl.errors import AvisError, InputError
from benchmarks.blind.case import Task, work
from benchmarks.blind.lines import KINDS, STRENGTHS, Line, Settings, finished

# The truth is imported as its tests do, from the folder tests/: the names of its compiled functions hang on that.
TRUTH, FINDER = "truth.cases", "avis_ctrl.study.gap"
TRUTH_PATIENCE = 10
TESTS = Path(__file__).resolve().parents[2] / "tests"
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(eq=False)
class _Running:
    """A case under way and what its worker has told so far. began : of the stage that it is in."""

    seed: int
    process: SpawnProcess
    connection: Connection
    slot: int
    began: float
    told: dict[str, Any] = field(default_factory=dict)
    stage: str = "started"

    def receive(self) -> bool:
        """Take one message; False at the end of the connection."""
        try:
            self.stage, content = self.connection.recv()
        except (EOFError, OSError):
            return False
        self.began = time.monotonic()
        self.told |= content if isinstance(content, dict) else {"truth_failed": content}
        return True


def is_cluttered(seed: int, share: float) -> bool:
    """Multiples of the golden ratio spread evenly, so that any run of seeds holds the share."""
    return (seed * 0.6180339887498949) % 1 < share


class Pool:
    """At most `jobs` cases at once, each in a process of its own, so that nothing stays from case to case.

    A worker that is killed (memory, a fault in compiled code) costs its own case only.
    """

    def __init__(self, settings: Settings, limit_s: float, truth: str, finder: str):
        self.settings, self.limit_s, self.truth, self.finder = settings, limit_s, truth, finder
        self.running: list[_Running] = []
        available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self._cores = [
            (available[k % len(available)],) if available and settings.jobs > 1 else () for k in range(settings.jobs)
        ]
        for name in THREADS:  # before a worker loads NumPy
            os.environ[name] = "1"

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for one in self.running:
            one.process.terminate()
            one.process.join()

    def start(self, seed: int) -> None:
        taken = {one.slot for one in self.running}
        slot = next(k for k in range(self.settings.jobs) if k not in taken)
        s, context = self.settings, get_context("spawn")
        task = Task(
            seed,
            s.duration_s,
            s.kind,
            s.effect,
            s.strength,
            s.unseen,
            self.truth,
            self.finder,
            self._cores[slot],
            is_cluttered(seed, s.cluttered),
        )
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=work, args=(task, theirs))
        process.start()
        theirs.close()
        self.running.append(_Running(seed, process, ours, slot, time.monotonic()))

    def ended(self) -> list[_Running]:
        """Cases that have ended, after waiting a moment for one."""
        ready = wait([one.connection for one in self.running], timeout=1.0)
        done = []
        for one in list(self.running):
            over = one.connection in ready and not one.receive()
            # Starting Python and simulating on a busy machine are no work of the finder.
            longest = self.limit_s * (1 if "simulation_seconds" in one.told else TRUTH_PATIENCE)
            if not over and time.monotonic() - one.began > longest:
                one.process.terminate()
                one.told["crash"] = f"no answer within {longest:g} s"
                over = True
            if over:
                one.process.join()
                one.connection.close()
                self.running.remove(one)
                done.append(one)
        return done


def line_of(seed: int, known: dict[str, Any], settings: Settings, exitcode: int | None = None) -> Line | None:
    """The line of an ended case from what its worker has told; None where it is the truth that failed, which is not
    the finder's fault; known["truth_failed"] then says why."""
    told = dict(known)
    if "simulation_seconds" not in told:
        return None
    if "answer" in told:
        told.pop("crash", None)  # the answer stands, whatever happened to the prediction after it
    elif "crash" not in told:
        told["crash"] = f"the worker ended with code {exitcode} before it answered"
    told.pop("truth_failed", None)
    absent: dict[str, Any] = dict.fromkeys(
        ("answer", "crash", "seconds", "cpu_seconds", "memory_MB", "unseen", "unseen_error")
    )
    content = absent | told | {"seed": seed, "settings": settings.model_dump()}
    try:
        return Line.model_validate(content)
    except ValueError as error:
        wrong = f"the answer does not keep the contract: {error}"
    try:
        # An answer that is no gap.json is a crash of the finder; a description of the truth that is wrong is not.
        return Line.model_validate(content | {"answer": None, "unseen": None, "crash": told.get("crash", wrong)})
    except ValueError as error:
        known["truth_failed"] = str(error)
        return None


def run(
    settings: Settings,
    seeds: Iterable[int],
    out: Path,
    *,
    resume: bool = False,
    limit_s: float = 900.0,
    truth: str = TRUTH,
    finder: str = FINDER,
    say: Callable[[str], None] = lambda text: None,
) -> list[int]:
    """Append the lines of all seeds to a file; returns the seeds whose truth failed, which have no line.

    Raises
    ------
    InputError : a file that is there without `resume`, or is of another campaign.
    """
    done = _done(settings, out, resume)
    waiting = [seed for seed in seeds if seed not in done]
    total, began, failed, count = len(waiting), time.monotonic(), [], 0
    if done:
        say(f"{len(done)} cases in {out} are skipped, {total} are left")
    with Pool(settings, limit_s, truth, finder) as pool, out.open("a", encoding="utf-8") as file:
        while waiting or pool.running:
            while waiting and len(pool.running) < settings.jobs:
                pool.start(waiting.pop(0))
            for one in pool.ended():
                line, count = line_of(one.seed, one.told, settings, one.process.exitcode), count + 1
                if line is None:
                    failed.append(one.seed)
                    text = one.told.get("truth_failed", one.told.get("crash", "its worker was killed")).strip()
                    # In full once: if the truth is broken, every case says the same.
                    say(
                        f"seed {one.seed}: the truth failed, no line written: "
                        f"{text if len(failed) == 1 else text.splitlines()[-1]}"
                    )
                else:
                    file.write(line.model_dump_json() + "\n")
                    file.flush()
                    os.fsync(file.fileno())
                say(progress(count, total, time.monotonic() - began, one.seed, line))
    return failed


def _done(settings: Settings, out: Path, resume: bool) -> set[int]:
    if out.exists() and not resume:
        raise InputError("expected no such file; --resume continues it", file=out)
    if not out.parent.is_dir():
        raise InputError("expected a folder to write into", file=out.parent)
    lines = finished(out)
    if lines and lines[0].settings.campaign != settings.campaign:
        raise InputError(
            f"expected the campaign that the file holds: {lines[0].settings.campaign}",
            file=out,
            field="settings",
            value=settings.campaign,
        )
    return {line.seed for line in lines}


def progress(count: int, total: int, seconds: float, seed: int, line: Line | None) -> str:
    """A line that says nothing of what is hidden."""
    rate = count / seconds
    left = (total - count) / rate
    what = "no line" if line is None else "crash" if line.crash is not None else f"{line.seconds:.1f} s"
    return (
        f"{count}/{total} cases, {60 * rate:.2f} a minute, {left // 3600:.0f} h {left % 3600 // 60:02.0f} min left "
        f"(seed {seed}: {what})"
    )


def commit() -> str:
    """Of the code, with "+" where files that are under version control differ; "" outside a repository."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + "+" * bool(git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.CalledProcessError):
        return ""


def check_modules(truth: str, finder: str, unseen: bool) -> None:
    """Before hours are spent: both modules load and have what is needed."""
    for name, needed in (
        (truth, ("draw_case", "simulate_case", "relative_change")),
        (finder, ("find_gap", "GapOptions", *(["predict"] if unseen else []))),
    ):
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            raise InputError(
                f"expected a module that loads, from the root of the repository: {error}", field="module", value=name
            ) from None
        if absent := [one for one in needed if not hasattr(module, one)]:
            raise InputError(f"expected {', '.join(absent)} in it", field="module", value=name)


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    options = argparse.ArgumentParser(
        prog="python -m benchmarks.blind", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--cases", type=int, default=300)
    options.add_argument("--seed", type=int, default=1, help="of the first case; the others follow it")
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--duration", type=float, default=60.0, help="of a record [s]")
    options.add_argument("--out", type=Path, required=True, help="file of JSON lines")
    options.add_argument("--resume", action="store_true", help="continue the file")
    options.add_argument("--unseen", action="store_true", help="also predict a campaign that the finder never saw")
    options.add_argument(
        "--cluttered",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="of the cases, by seed: the table is off its rig file in everything a little",
    )
    options.add_argument("--limit", type=float, default=900.0, help="longest that an answer may take [s]")
    options.add_argument("--kind", choices=KINDS, help="of every case; drawn otherwise")
    options.add_argument("--effect", help="of every case; drawn otherwise")
    options.add_argument("--strength", choices=STRENGTHS, help="of every case; drawn otherwise")
    options.add_argument("--truth", default=TRUTH, help="module that draws and simulates")
    options.add_argument("--finder", default=FINDER, help="module that answers")
    given = options.parse_args(words)
    for name, least in (("cases", 1), ("jobs", 1), ("seed", 0)):
        if getattr(given, name) < least:
            options.error(f"--{name} {getattr(given, name)}: expected {least} or more")
    if not 0 <= given.cluttered <= 1:
        options.error(f"--cluttered {given.cluttered:g}: expected a share from 0 to 1")
    if not 0 < given.duration <= 3600:
        options.error(f"--duration {given.duration:g}: expected seconds above 0, at most 3600")
    return given


def make_truth_importable() -> None:
    """Append its folder to the search path of modules, which workers get, too."""
    if str(TESTS) not in sys.path:
        sys.path.append(str(TESTS))


def main(words: list[str] | None = None) -> None:
    given = arguments(words)
    make_truth_importable()
    settings = Settings(
        duration_s=given.duration,
        jobs=given.jobs,
        kind=given.kind,
        effect=given.effect,
        strength=given.strength,
        unseen=given.unseen,
        cluttered=given.cluttered,
        commit=commit(),
    )
    try:
        check_modules(given.truth, given.finder, given.unseen)
        failed = run(
            settings,
            range(given.seed, given.seed + given.cases),
            given.out,
            resume=given.resume,
            limit_s=given.limit,
            truth=given.truth,
            finder=given.finder,
            say=lambda text: print(text, file=sys.stderr, flush=True),
        )
    except AvisError as error:
        print(error, file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        print(f"stopped; --resume continues {given.out}", file=sys.stderr)
        raise SystemExit(130) from None
    if failed:
        print(f"{len(failed)} cases have no line, since the truth failed: seeds {failed}", file=sys.stderr)
        raise SystemExit(3)


if __name__ == "__main__":
    main()
