"""What issue 4 asks for, and what a blind campaign measured. A crash is never a good answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.blind.judge import PLACED, Judged
from benchmarks.blind.lines import Answer, Stage
from benchmarks.blind.parameters import Error
from benchmarks.blind.rates import Share

NOISE_RATIO, GAP_FACTOR = 1.2, 10.0
MOST_SECONDS, MOST_MB = 60.0, 2000.0


@dataclass(frozen=True)
class Asked:
    """A row of the table of figures; met is None where nothing could be measured."""

    what: str
    asked: str
    measured: str
    met: bool | None

    @property
    def word(self) -> str:
        return "not measured" if self.met is None else "met" if self.met else "missed"


def at_least(what: str, share: Share, limit: float) -> Asked:
    return Asked(what, f"at least {100 * limit:g} %", str(share), share.value >= limit if share.trials else None)


def at_most(what: str, share: Share, limit: float) -> Asked:
    return Asked(what, f"at most {100 * limit:g} %", str(share), share.value <= limit if share.trials else None)


def of_kind(cases: Sequence[Judged], kind: str) -> list[Judged]:
    return [case for case in cases if case.line.kind == kind]


def false_alarms(cases: Sequence[Judged]) -> Share:
    """Answers other than "none" where nothing is hidden, named or not."""
    return Share.of([case.outcome != "quiet" for case in of_kind(cases, "none")])


def right_names(cases: Sequence[Judged]) -> Share:
    """One effect, clear or gross: exactly one is named, and rightly (or by its group)."""
    return Share.of([case.outcome == "right" for case in of_kind(cases, "one") if case.line.clear])


def right_places(cases: Sequence[Judged]) -> Share:
    """One effect, clear or gross, whose place is a choice, named rightly: the place is right too."""
    return Share.of(
        [
            case.pairs[0].place
            for case in of_kind(cases, "one")
            if case.line.clear and case.outcome == "right" and case.pairs[0].hidden.name in PLACED
        ]
    )


def both_right(cases: Sequence[Judged]) -> Share:
    return Share.of([case.outcome == "both right" for case in of_kind(cases, "two")])


def misnamed_outside(cases: Sequence[Judged]) -> Share:
    """A crash counts as misnamed: it is no refusal."""
    return Share.of([case.outcome in ("named as something else", "crash") for case in of_kind(cases, "outside")])


def noise_ratio(stage: Stage) -> float:
    """Residual over noise, both r.m.s.: the square root of chi-square per degree of freedom."""
    return float(np.sqrt(stage.chi2_per_dof))


def gap_factor(answer: Answer) -> float:
    """Held-out nrmse of the re-identified model over that of the last stage; infinite where nothing is left."""
    before = next((one for one in answer.gap if one.stage == "re-identified"), answer.gap[0])
    last = answer.gap[-1].nrmse
    return before.nrmse / last if last else float("inf")


def closed(answer: Answer) -> bool:
    """The last stage is within 1.2 of the noise floor, or its nrmse down by a factor of 10."""
    return bool(answer.gap) and (noise_ratio(answer.gap[-1]) <= NOISE_RATIO or gap_factor(answer) >= GAP_FACTOR)


def named_answers(cases: Sequence[Judged]) -> list[Answer]:
    """Of cases with one or two effects of the library, where something is named."""
    return [
        case.line.answer
        for case in cases
        if case.line.kind in ("one", "two") and case.line.answer is not None and case.named
    ]


def closed_gaps(cases: Sequence[Judged]) -> Share:
    return Share.of([closed(answer) for answer in named_answers(cases)])


def asked_table(cases: Sequence[Judged], errors: Sequence[Error]) -> list[Asked]:
    """The rows of the issue's table; real data are measured elsewhere."""
    inside = Share.of([one.inside for one in errors])
    return [
        at_most("no effect: false alarms", false_alarms(cases), 0.02),
        at_least("one effect, clear or gross: right name", right_names(cases), 0.95),
        at_least("right place, where the effect has one and its name is right", right_places(cases), 0.95),
        at_least("two effects: both right", both_right(cases), 0.80),
        at_most("outside the library: named as something else", misnamed_outside(cases), 0.10),
        # Asked of every campaign: one that stays apart is a miss, and how many do is printed.
        Asked(
            "held-out gap after naming: within 1.2 of the noise floor or down by a factor of 10",
            "every campaign",
            str(closed_gaps(cases)),
            _all(closed_gaps(cases)),
        ),
        Asked(
            "parameter inside its own 95 % interval",
            "90 to 98 %",
            str(inside),
            0.90 <= inside.value <= 0.98 if inside.trials else None,
        ),
        cost("seconds of one campaign", [case.line.seconds for case in cases], MOST_SECONDS, "s"),
        cost("peak memory", [case.line.memory_MB for case in cases], MOST_MB, "MB"),
    ]


def _all(share: Share) -> bool | None:
    return share.hits == share.trials if share.trials else None


def cost(what: str, values: Sequence[float | None], limit: float, unit: str) -> Asked:
    """Median, 95 % quantile and the most; asked of the most. A case that gave no figure (its worker died) is a miss."""
    known = [one for one in values if one is not None]
    absent = len(values) - len(known)
    if not known:
        return Asked(what, f"under {limit:g} {unit}", "no case", None)
    median, high, most = np.median(known), np.quantile(known, 0.95), max(known)
    text = f"median {median:.4g}, 95 % {high:.4g}, most {most:.4g} {unit}"
    return Asked(
        what,
        f"under {limit:g} {unit}",
        text + (f"; {absent} without a figure" if absent else ""),
        bool(most < limit and not absent),
    )
