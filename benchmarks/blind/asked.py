"""What is asked of `avis gap` and what a blind campaign measured, clean and cluttered tables side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.blind.figures import of_kind, right_places
from benchmarks.blind.judge import Judged, is_trace, matches
from benchmarks.blind.parameters import parameter_errors
from benchmarks.blind.rates import Share
from benchmarks.blind.tables import Table

SURE = 0.9


def asked_table(cases: Sequence[Judged]) -> Table:
    """Two columns for clean tables and two for cluttered ones, where there are any; a crash is never a good answer."""
    head, columns = [""], []
    for k, word in enumerate(("clean", "cluttered")):
        if group := [case for case in cases if case.line.cluttered == bool(k)]:
            head += [word, "asked"]
            columns.append({name: (figure, asked[k] if asked else "") for name, figure, *asked in figures(group)})
    return Table(
        "Asked and measured",
        tuple(head),
        tuple((name, *(cell for one in columns for cell in one[name])) for name in (columns[0] if columns else ())),
        "Fractions with Wilson's 95 % interval. Traces of a cluttered table (hum, friction, stiffening, loss) are "
        "there, so their names are not false; nor is what the answer lists under its own traces. Best possible: the "
        "true table with its traces and all that is random switched off, against the same measured records.",
    )


def figures(cases: Sequence[Judged]) -> list[tuple[str, ...]]:
    """Name and figure of each row; where something is asked, also what of clean and of cluttered tables."""
    one, two = ([case for case in of_kind(cases, kind)] for kind in ("one", "two"))

    def fraction(hits: Iterable[bool]) -> str:
        return str(Share.of(list(hits)))

    closed = (closes_the_gap(case) for case in cases if case.line.kind != "outside" and case.line.unseen)
    sure = [(case, named) for case in cases for named in case.named if named.probability > SURE]
    return [
        ("cases", str(len(cases))),
        ("no effect: false names", fraction(map(_fails, of_kind(cases, "none"))), "at most 2 %", "at most 5 %"),
        (
            "one effect, clear or gross: named first",
            fraction(named_first(case) for case in one if case.line.clear),
            "97 %",
            "90 %",
        ),
        (
            "one effect, clear or gross: named first, or listed as a trace",
            fraction(named_first(case) or all_listed(case) for case in one if case.line.clear),
        ),
        ("right place, where the effect has one and its name is right", str(right_places(cases)), "97 %", "90 %"),
        ("two effects: both named", fraction(map(both_named, two)), "85 %", "70 %"),
        ("two effects: both named, as effects or as traces", fraction(map(all_listed, two))),
        ("two effects, each clear or gross: both named", fraction(both_named(case) for case in two if case.line.clear)),
        (
            "outside the library: named as something else",
            fraction(map(_fails, of_kind(cases, "outside"))),
            "at most 5 %",
            "at most 10 %",
        ),
        (
            "parameter inside its own 95 % interval",
            fraction(error.inside for error in parameter_errors(cases)[0]),
            "90 to 98 %",
            "88 to 98 %",
        ),
        (
            f"probability above {SURE:g} claimed, and right",
            fraction(case.right(named, exact=False) for case, named in sure),
            "97 %",
            "90 %",
        ),
        (
            "the same without the traces of cluttered tables",
            fraction(case.right(named, exact=False) for case, named in sure if not is_trace(named, case.line)),
        ),
        (
            "unseen record: updated within 0.1 (cluttered 0.33) of re-identified or 1.2 (1.5) of best possible",
            fraction(closed),
            "each",
            "each",
        ),
        ("unseen record: error of updated over re-identified", _spread(_ratios(cases, "baseline"))),
        ("unseen record: error of updated over best possible", _spread(_ratios(cases, "best"))),
        ("processor seconds", _spread([case.line.cpu_seconds for case in cases if case.line.cpu_seconds is not None])),
        (
            "peak memory MB",
            _spread([case.line.memory_MB for case in cases if case.line.memory_MB is not None]),
            "at most 1500",
            "at most 1500",
        ),
    ]


def both_named(case: Judged) -> bool:
    return len(case.pairs) == 2


def all_listed(case: Judged) -> bool:
    """All hidden effects are listed, perhaps as traces, because they explain little of the gap."""
    answer, hidden = case.line.answer, case.line.hidden
    return answer is not None and len(matches(hidden, [*answer.effects, *answer.traces])) == len(hidden)


def closes_the_gap(case: Judged) -> bool:
    """On the unseen record, the updated model's error is small beside the re-identified one's, or hardly larger than
    that of the best possible prediction."""
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
