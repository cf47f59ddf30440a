"""What is asked of `avis gap` and what a blind campaign measured, clean and cluttered tables side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.blind.figures import of_kind, right_places
from benchmarks.blind.judge import Judged
from benchmarks.blind.parameters import parameter_errors
from benchmarks.blind.rates import Share
from benchmarks.blind.tables import Table

SURE = 0.9
# Row: what is asked of clean and of cluttered tables.
ASKED = {
    "no effect: false names": ("at most 2 %", "at most 5 %"),
    "one effect, clear or gross: named first": ("97 %", "90 %"),
    "right place, where the effect has one and its name is right": ("97 %", "90 %"),
    "two effects: both named": ("85 %", "70 %"),
    "outside the library: named as something else": ("at most 5 %", "at most 10 %"),
    "parameter inside its own 95 % interval": ("90 to 98 %", "88 to 98 %"),
    f"probability above {SURE:g} claimed, and right": ("97 %", "90 %"),
    "unseen record: updated within 0.1 (cluttered 0.33) of re-identified or 1.2 (1.5) of best possible": (
        "each",
        "each",
    ),
}


def asked_table(cases: Sequence[Judged]) -> Table:
    """Two columns for clean tables and two for cluttered ones, where there are any; a crash is never a good answer."""
    groups = [[case for case in cases if case.line.cluttered == cluttered] for cluttered in (False, True)]
    words = [("clean", "asked"), ("cluttered", "asked")]
    found = [figures(group) for group in groups if group]
    present = [k for k, group in enumerate(groups) if group]
    rows: list[tuple[str, ...]] = []
    for name in found[0] if found else ():
        limits = ASKED.get(name, ("", ""))
        rows.append((name, *sum(((one[name], limits[k]) for k, one in zip(present, found, strict=True)), ())))
    return Table(
        "Asked and measured",
        ("", *sum((words[k] for k in present), ())),
        tuple(rows),
        "Fractions with Wilson's 95 % interval. Traces of a cluttered table (hum, friction, stiffening, loss) are "
        "there, so their names are not false; nor is what the answer lists under its own traces. Best possible: the "
        "true table with its traces and all that is random switched off, against the same measured records.",
    )


def figures(cases: Sequence[Judged]) -> dict[str, str]:
    one, two = ([case for case in of_kind(cases, kind)] for kind in ("one", "two"))
    return {
        "cases": str(len(cases)),
        "no effect: false names": str(Share.of([_fails(case) for case in of_kind(cases, "none")])),
        "one effect, clear or gross: named first": str(
            Share.of([named_first(case) for case in one if case.line.clear])
        ),
        "right place, where the effect has one and its name is right": str(right_places(cases)),
        "two effects: both named": both_named(two),
        "two effects, each clear or gross: both named": both_named([case for case in two if case.line.clear]),
        "outside the library: named as something else": str(
            Share.of([_fails(case) for case in of_kind(cases, "outside")])
        ),
        "parameter inside its own 95 % interval": str(Share.of([error.inside for error in parameter_errors(cases)[0]])),
        f"probability above {SURE:g} claimed, and right": str(
            Share.of(
                [case.right(named, exact=False) for case in cases for named in case.named if named.probability > SURE]
            )
        ),
        "unseen record: updated within 0.1 (cluttered 0.33) of re-identified or 1.2 (1.5) of best possible": str(
            Share.of([closes_the_gap(case) for case in cases if case.line.kind != "outside" and case.line.unseen])
        ),
        "unseen record: error of updated over re-identified": _spread(_ratios(cases, "baseline")),
        "unseen record: error of updated over best possible": _spread(_ratios(cases, "best")),
        "processor seconds": _spread([case.line.cpu_seconds for case in cases if case.line.cpu_seconds is not None]),
    }


def both_named(cases: Sequence[Judged]) -> str:
    return str(Share.of([len(case.pairs) == 2 for case in cases]))


def closes_the_gap(case: Judged) -> bool:
    """The updated model's error on the unseen record is small beside the re-identified one's, or close to the least."""
    unseen, (part, least) = case.line.unseen, (1 / 3, 1.5) if case.line.cluttered else (0.1, 1.2)
    assert unseen is not None
    return unseen.updated <= part * unseen.baseline or (
        unseen.best is not None and unseen.updated <= least * unseen.best
    )


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
