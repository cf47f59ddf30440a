"""Clean and cluttered tables side by side: the same figures of each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.blind.figures import of_kind, right_places
from benchmarks.blind.judge import Judged
from benchmarks.blind.parameters import parameter_errors
from benchmarks.blind.rates import Share
from benchmarks.blind.tables import Table

SURE = 0.9


def clutter_table(cases: Sequence[Judged]) -> Table:
    """One column for clean tables and one for cluttered ones, where there are any; a crash is never a good answer."""
    groups = {
        "clean": [case for case in cases if not case.line.cluttered],
        "cluttered": [case for case in cases if case.line.cluttered],
    }
    groups = {word: group for word, group in groups.items() if group}
    columns = [figures(group) for group in groups.values()]
    rows = tuple((name, *(column[name] for column in columns)) for name in columns[0]) if columns else ()
    return Table(
        "Clean and cluttered tables",
        ("", *groups),
        rows,
        "A trace of a cluttered table (hum, friction, stiffening, loss) is there, so that its name is no "
        "false one; nor is what the answer lists under its own traces. Best possible: the true table with its "
        "traces and all that is random switched off, against the same measured records.",
    )


def figures(cases: Sequence[Judged]) -> dict[str, str]:
    one = [case for case in of_kind(cases, "one") if case.line.clear]
    return {
        "cases": str(len(cases)),
        "no effect: false names": str(Share.of([_fails(case) for case in of_kind(cases, "none")])),
        "one effect, clear or gross: named first": str(Share.of([named_first(case) for case in one])),
        "right place, where the effect has one and its name is right": str(right_places(cases)),
        "two effects: both named": str(Share.of([len(case.pairs) == 2 for case in of_kind(cases, "two")])),
        "outside the library: named as something else": str(
            Share.of([_fails(case) for case in of_kind(cases, "outside")])
        ),
        "parameter inside its own 95 % interval": str(Share.of([error.inside for error in parameter_errors(cases)[0]])),
        "unseen record: error of updated over re-identified": _spread(_ratios(cases, "baseline")),
        "unseen record: error of updated over best possible": _spread(_ratios(cases, "best")),
        f"probability above {SURE:g} claimed, and right": str(
            Share.of(
                [case.right(named, exact=False) for case in cases for named in case.named if named.probability > SURE]
            )
        ),
        "processor seconds": _spread([case.line.cpu_seconds for case in cases if case.line.cpu_seconds is not None]),
    }


def named_first(case: Judged) -> bool:
    """The hidden effect stands at the head of the answer, by its own name or its group."""
    return bool(case.named) and any(pair.named is case.named[0] for pair in case.pairs)


def _fails(case: Judged) -> bool:
    return case.outcome == "crash" or bool(case.false_names)


def _ratios(cases: Sequence[Judged], below: str) -> list[float]:
    """Of the updated model's error over another one, where both are known."""
    known = [case.line.unseen for case in cases if case.line.unseen is not None]
    return [one.updated / least for one in known if (least := getattr(one, below))]


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "no case"
    return f"median {np.median(values):.3g}, 95 % {np.quantile(values, 0.95):.3g}, most {max(values):.3g}"
