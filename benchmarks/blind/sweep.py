"""Blind cases as points of `avis sweep`: on a cluster, and resumable there.

    avis sweep blind.toml --out DIR --scheduler tcp://HOST:8786
    python -m benchmarks.blind.sweep DIR --out blind.jsonl
    python -m benchmarks.blind.score blind.jsonl

where blind.toml is, with an absolute path if it lies elsewhere (workers need the checkout under the same path):

    kind = "function"
    base = "benchmarks/blind/sweep.py:case"
    [[vary]]
    key = "seed"
    values = [1, 2, 3]
    [[vary]]
    key = "cluttered"
    values = [0.5]

Beside `seed` a point may have duration_s, kind, effect, strength, unseen, cluttered, truth and finder. Other than
`python -m benchmarks.blind`, cases run in one process one after the other, so that memory is that of its largest case
so far, and no case is ended after a time. A point's identity is not that of the code of the checkout: take a new folder
for another commit.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
for folder in (ROOT, ROOT / "tests"):
    if str(folder) not in sys.path:
        sys.path.append(str(folder))

from avis_ctrl.errors import InputError  # noqa: E402
from avis_ctrl.files import write_whole  # noqa: E402
from benchmarks.blind.case import Task, work  # noqa: E402
from benchmarks.blind.lines import Line, Settings  # noqa: E402
from benchmarks.blind.run import FINDER, TRUTH, commit, is_cluttered, line_of  # noqa: E402


class _Told:
    """What `work` sends, gathered."""

    def __init__(self) -> None:
        self.content: dict[str, Any] = {}

    def send(self, message: tuple[str, Any]) -> None:
        content = message[1]
        self.content |= content if isinstance(content, dict) else {"truth_failed": content}

    def close(self) -> None:
        """As a connection has it."""


def case(point: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of a blind case, and its line for the scorer. Raises InputError where the truth failed."""
    given = {"duration_s": 60.0} | point
    seed, truth, finder = given.pop("seed"), given.pop("truth", TRUTH), given.pop("finder", FINDER)
    settings = Settings(jobs=1, commit=commit(), **given)
    told = _Told()
    work(
        Task(
            seed,
            settings.duration_s,
            settings.kind,
            settings.effect,
            settings.strength,
            settings.unseen,
            truth,
            finder,
            (),
            is_cluttered(seed, settings.cluttered),
        ),
        told,
    )
    line = line_of(seed, told.content, settings)
    if line is None:
        raise InputError(
            f"the truth failed: {str(told.content.get('truth_failed')).strip().splitlines()[-1]}",
            field="seed",
            value=seed,
        )
    figures = {
        "truth": line.kind,
        "hidden": "; ".join(one.name for one in line.hidden),
        "named": "; ".join(one.name for one in line.answer.effects) if line.answer else "crash",
        "verdict": line.answer.verdict if line.answer else "",
        "finder_seconds": line.seconds,
    }
    return figures, line.model_dump()


def lines_of(folder: Path) -> list[Line]:
    """Lines of a sweep's finished cases. Raises InputError for a folder that is none, or holds several campaigns."""
    try:
        points = json.loads((folder / "sweep.json").read_text(encoding="utf-8"))["points"]
        names = [one["identity"] for one in points if one["status"] == "done"]
        kept = [json.loads((folder / "points" / f"{name}.json").read_text(encoding="utf-8")) for name in names]
        lines = [Line.model_validate(one["details"]) for one in kept]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"expected the folder of a sweep of blind cases ({' '.join(str(error).split())})", file=folder
        ) from None
    if len({line.settings.campaign for line in lines}) > 1 or len({line.settings.commit for line in lines}) > 1:
        raise InputError("expected one campaign and one commit", file=folder)
    return lines


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(words)
    try:
        lines = lines_of(given.folder)
        write_whole(given.out, "".join(line.model_dump_json() + "\n" for line in lines).encode())
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()
