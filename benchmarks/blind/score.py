"""Score a blind campaign from its JSON lines; nothing is simulated or fitted here. The seed tells which values of a
cluttered table lie beyond three tolerances.

python -m benchmarks.blind.score blind.jsonl [--markdown blind.md] [--png blind.png]
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from avis_ctrl.errors import AvisError, InputError
from benchmarks.blind import tables
from benchmarks.blind.asked import asked_table
from benchmarks.blind.judge import WITHIN, Judged, contradiction, judge
from benchmarks.blind.lines import Line, read_lines
from benchmarks.blind.matrix import Confusion
from benchmarks.blind.parameters import parameter_errors
from benchmarks.blind.run import TRUTH, make_truth_importable
from benchmarks.blind.tables import Table


@dataclass(frozen=True, eq=False)
class Score:
    """A scored campaign.

    cases : by seed. tables : in the order of printing. remarks : what a reader must know.
    """

    cases: tuple[Judged, ...]
    tables: tuple[Table, ...]
    confusion: Confusion
    remarks: tuple[str, ...]

    def text(self) -> str:
        return "\n\n".join(
            [
                *self.remarks,
                *(one.text() for one in self.tables),
                "Hidden (rows) against answered (columns); cases with two effects left out\n" + self.confusion.text(),
            ]
        )

    def markdown(self, picture: str | None = None) -> str:
        parts = [
            "# Blind campaign",
            *self.remarks,
            *(one.markdown() for one in self.tables),
            "## Hidden (rows) against answered (columns)",
            "Cases with two effects are left out.",
            f"```text\n{self.confusion.text()}\n```",
        ]
        return "\n\n".join([*parts, *([f"![confusion matrix]({picture})"] if picture else [])]) + "\n"


def with_far_values(line: Line) -> Line:
    """The line of a cluttered table with its values beyond tolerance; any other line as it is."""
    if not line.cluttered:
        return line
    make_truth_importable()
    return line.model_copy(update={"far": importlib.import_module(TRUTH).far_values(line.seed, WITHIN)})


def score(lines: Sequence[Line]) -> Score:
    """Everything that the lines say."""
    cases = [judge(line) for line in lines]
    errors, unknown = parameter_errors(cases)
    found = [
        asked_table(cases),
        tables.verdict_table(cases),
        *tables.outcome_tables(cases),
        tables.effect_table(cases),
        tables.group_table(cases),
        tables.calibration_table(cases, exact=True),
        tables.calibration_table(cases, exact=False),
        tables.gap_table(cases),
        tables.parameter_table(errors, unknown),
        tables.excitation_table(cases),
        tables.cost_table(cases),
    ]
    return Score(tuple(cases), tuple(one for one in found if one.rows), Confusion.of(cases), tuple(remarks(cases)))


def remarks(cases: Sequence[Judged]) -> list[str]:
    """What the cases are, and what in them needs a look."""
    lines = [case.line for case in cases]
    settings, commits = lines[0].settings, sorted({line.settings.commit or "unknown" for line in lines})
    forced = [
        f"{key} {value}"
        for key, value in (("kind", settings.kind), ("effect", settings.effect), ("strength", settings.strength))
        if value is not None
    ]
    found = [
        f"{len(lines)} cases, seeds {lines[0].seed} to {lines[-1].seed}, records of {settings.duration_s:g} s; "
        f"code {', '.join(commits)}" + ("; several versions of the code are mixed" if len(commits) > 1 else "")
    ]
    if forced:
        found.append(f"Not a blind draw: {', '.join(forced)} in every case.")
    cluttered = sum(line.cluttered for line in lines)
    if cluttered:
        found.append(
            f"{cluttered} cases have a cluttered table: off its rig file in everything a little, with traces "
            "of effects besides."
        )
    if len(lines) < 300:
        found.append(f"{len(lines)} cases are fewer than the 300 asked for.")
    crashes = [line for line in lines if line.crash is not None]
    if crashes:
        found.append("Crashes:\n" + "\n".join(f"  seed {line.seed}: {_last(line.crash)}" for line in crashes))
    broken = [(line.seed, what) for line in lines if (what := contradiction(line))]
    if broken:
        found.append("Answers that contradict the contract:\n" + "\n".join(f"  seed {s}: {what}" for s, what in broken))
    unseen = [line for line in lines if line.unseen_error is not None]
    if unseen:
        found.append(
            "Predictions of the unseen campaign that failed:\n"
            + "\n".join(f"  seed {line.seed}: {_last(line.unseen_error)}" for line in unseen)
        )
    return found


def _last(text: str | None) -> str:
    return (text or "").strip().splitlines()[-1] if (text or "").strip() else "no text"


def main(words: list[str] | None = None) -> None:
    options = argparse.ArgumentParser(
        prog="python -m benchmarks.blind.score",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options.add_argument("lines", type=Path)
    options.add_argument("--markdown", type=Path, help="file to write")
    options.add_argument("--png", type=Path, help="picture of the confusion matrix; by default beside the lines")
    given = options.parse_args(words)
    try:
        result = score([with_far_values(line) for line in read_lines(given.lines)])
        print(result.text())
        picture = given.png or given.lines.with_suffix(".png")
        _write(picture, lambda: result.confusion.draw(picture))
        if given.markdown is not None:
            _write(given.markdown, lambda: given.markdown.write_text(result.markdown(picture.name), encoding="utf-8"))
    except AvisError as error:
        print(error, file=sys.stderr)
        raise SystemExit(error.exit_code) from None


def _write(path: Path, write) -> None:
    try:
        write()
    except OSError as error:
        raise InputError(f"expected a file that can be written: {error.strerror}", file=path) from None


if __name__ == "__main__":
    main()
