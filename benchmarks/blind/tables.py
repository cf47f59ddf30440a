"""The tables of a score, each as a title, a head, rows of text and a note."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.blind.figures import GAP_FACTOR, NOISE_RATIO, closed, gap_factor, named_answers, noise_ratio, of_kind
from benchmarks.blind.judge import LIBRARY, OUTCOMES, PLACED, Judged
from benchmarks.blind.lines import KINDS, STRENGTHS
from benchmarks.blind.parameters import Error
from benchmarks.blind.rates import Share, brier, log_score, reliability

VERDICTS = ("none", "explained", "partly explained", "unexplained", "crash")


@dataclass(frozen=True)
class Table:
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def text(self) -> str:
        wide = [max(map(len, column)) for column in zip(self.head, *self.rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, wide, strict=True)).rstrip()
            for row in (self.head, *self.rows)
        ]
        return "\n".join([self.title, *("  " + line for line in lines), *([self.note] if self.note else [])])

    def markdown(self) -> str:
        rows = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in (self.head, *self.rows)]
        return "\n".join(
            [
                f"## {self.title}",
                "",
                rows[0],
                "|" + "---|" * len(self.head),
                *rows[1:],
                *(["", self.note] if self.note else []),
            ]
        )


def verdict_table(cases: Sequence[Judged]) -> Table:
    counts = {kind: Counter(case.verdict for case in of_kind(cases, kind)) for kind in KINDS}
    return Table(
        "Verdicts by what is hidden",
        ("hidden", *VERDICTS, "cases"),
        tuple(
            (kind, *(str(counts[kind][verdict]) for verdict in VERDICTS), str(counts[kind].total())) for kind in KINDS
        ),
    )


def outcome_tables(cases: Sequence[Judged]) -> list[Table]:
    """Per kind the outcomes, by the strength of the weakest hidden effect."""
    titles = {
        "none": "No effect",
        "one": "One effect",
        "two": "Two effects, by the strength of the weaker one",
        "outside": "Outside the library",
    }
    notes = {
        "one": "refused: unexplained, or a gap without a name; missed: verdict none. A truth in the declared "
        "inseparable group of the named effect is right.",
        "outside": "refused: no effect named, verdict unexplained or partly explained; missed: verdict none, "
        "which is no wrong name and may be right where the effect is faint.",
    }
    return [_outcomes(titles[kind], of_kind(cases, kind), OUTCOMES[kind], notes.get(kind, "")) for kind in KINDS]


def _outcomes(title: str, cases: Sequence[Judged], outcomes: Sequence[str], note: str) -> Table:
    groups = [(strength, [case for case in cases if case.line.strength == strength]) for strength in STRENGTHS]
    groups = [(name, group) for name, group in groups if group]
    rows = [
        (name, *(str(Share.of([case.outcome == outcome for case in group])) for outcome in outcomes))
        for name, group in [*groups, ("all", list(cases))]
    ]
    return Table(title, ("", *outcomes), tuple(rows), note)


def effect_table(cases: Sequence[Judged]) -> Table:
    """Per library effect: how often it is found, alone by strength and as one of two."""
    one, rows = of_kind(cases, "one"), []
    names = {hidden.name for case in cases if case.line.kind in ("one", "two") for hidden in case.line.hidden}
    for name in sorted(names, key=lambda name: (LIBRARY.index(name) if name in LIBRARY else len(LIBRARY), name)):
        own = [case for case in one if case.line.hidden[0].name == name]
        right = [case for case in own if case.outcome == "right"]
        strength = [Share.of([case.outcome == "right" for case in own if case.line.strength == s]) for s in STRENGTHS]
        wrong = Counter(case.answered for case in own if case.outcome != "right")
        rows.append(
            (
                name,
                *(f"{s.hits}/{s.trials}" for s in strength),
                _count(case.pairs[0].place for case in right) if name in PLACED else "",
                _count(not case.pairs[0].exact for case in right),
                _count(_found_in_two(cases, name)),
                ", ".join(f"{word} {count}" for word, count in wrong.most_common()),
            )
        )
    return Table(
        "Each effect: rightly named",
        ("effect", *STRENGTHS, "place right", "by group", "as one of two", "answered instead"),
        tuple(rows),
        "place right, by group: of those rightly named alone; by group: only its inseparable group holds it.",
    )


def _count(answers) -> str:
    share = Share.of(list(answers))
    return f"{share.hits}/{share.trials}" if share.trials else ""


def _found_in_two(cases: Sequence[Judged], name: str) -> list[bool]:
    """Of each hidden effect of that name in a pair: whether a named one stands for it."""
    return [
        any(pair.hidden is hidden for pair in case.pairs)
        for case in of_kind(cases, "two")
        for hidden in case.line.hidden
        if hidden.name == name
    ]


def group_table(cases: Sequence[Judged]) -> Table:
    """How much of the score rests on declared groups."""
    right = [case for case in of_kind(cases, "one") if case.outcome == "right"]
    named = [one for case in cases for one in case.named]
    sizes = Counter(len(one.indistinguishable_from) for one in named)
    return Table(
        "Declared inseparable groups",
        ("", ""),
        (
            ("rightly named by the effect's own name", str(Share.of([case.pairs[0].exact for case in right]))),
            (
                "others in the group of a named effect",
                ", ".join(f"{size}: {count}" for size, count in sorted(sizes.items())) or "no named effect",
            ),
            (
                "named with others, and a next experiment is said",
                str(
                    Share.of(
                        [
                            bool(case.line.answer and case.line.answer.next_experiment)
                            for case in cases
                            if any(one.indistinguishable_from for one in case.named)
                        ]
                    )
                ),
            ),
        ),
    )


def calibration_table(cases: Sequence[Judged], *, exact: bool) -> Table:
    """Claimed probabilities of all named effects against how many are hidden."""
    pairs = [(one.probability, case.right(one, exact=exact)) for case in cases for one in case.named]
    kind = "own name" if exact else "name or group"
    title = f"Probabilities of named effects, right by {kind}"
    if not pairs:
        return Table(title, ("",), (("no effect is named",),))
    p, right = [one[0] for one in pairs], [one[1] for one in pairs]
    bins = reliability(p, right)
    return Table(
        title,
        ("probability", "named", "mean claimed", "right"),
        tuple(
            (f"{one.low:g} to {one.high:g}", str(one.right.trials), f"{one.mean:.3f}", str(one.right)) for one in bins
        ),
        f"Brier score {brier(p, right):.4f}, logarithmic score {log_score(p, right):.4f} nat, "
        f"{len(p)} named effects; mean claimed {np.mean(p):.3f}, right {np.mean(right):.3f}.",
    )


def gap_table(cases: Sequence[Judged]) -> Table:
    """The finder's own held-out figures, and predictions of a campaign that it never saw."""
    answers = named_answers(cases)
    staged = [answer for answer in answers if answer.gap]
    rows = [
        ("one or two effects, something named", str(len(answers))),
        (
            f"last stage within {NOISE_RATIO:g} of the noise floor",
            str(Share.of([bool(one.gap) and noise_ratio(one.gap[-1]) <= NOISE_RATIO for one in answers])),
        ),
        (
            f"nrmse down by a factor of {GAP_FACTOR:g}",
            str(Share.of([bool(one.gap) and gap_factor(one) >= GAP_FACTOR for one in answers])),
        ),
        ("either", str(Share.of([closed(one) for one in answers]))),
        (
            "the same, rightly named only",
            str(
                Share.of(
                    [
                        closed(case.line.answer)
                        for case in cases
                        if case.outcome in ("right", "both right") and case.line.answer is not None
                    ]
                )
            ),
        ),
        (
            "either, of all cases with one or two clear effects",
            str(
                Share.of(
                    [
                        bool(case.named) and case.line.answer is not None and closed(case.line.answer)
                        for case in cases
                        if case.line.kind in ("one", "two") and case.line.clear
                    ]
                )
            ),
        ),
    ]
    if staged:
        rows.append(
            (
                "residual over noise, median of the last stage",
                f"{np.median([noise_ratio(one.gap[-1]) for one in staged]):.3f}",
            )
        )
        rows.append(("nrmse re-identified over last, median", f"{np.median([gap_factor(one) for one in staged]):.3g}"))
    return Table(
        "Gap on held-out data after naming",
        ("", ""),
        tuple(rows + _unseen_rows(cases)),
        "Residual over noise is the square root of chi-square per degree of freedom, so 1.2 is 1.44 there. "
        "But for the unseen campaign, figures are the finder's own, on data that no fit of it has seen.",
    )


def _unseen_rows(cases: Sequence[Judged]) -> list[tuple[str, str]]:
    asked = [case for case in cases if case.line.settings.unseen and case.line.answer is not None]
    if not asked:
        return []
    known = [(case, case.line.unseen) for case in asked if case.line.unseen is not None]
    rows = [("unseen campaign: predicted", str(Share(len(known), len(asked))))]
    for word, group in (
        ("named", [u for case, u in known if case.named]),
        ("nothing named", [u for case, u in known if not case.named]),
    ):
        if group:
            ratio = [u.updated / u.baseline if u.baseline else 1.0 for u in group]
            rows += [
                (
                    f"unseen campaign, {word}: nrmse baseline, updated, median",
                    f"{np.median([u.baseline for u in group]):.4g}, {np.median([u.updated for u in group]):.4g}",
                ),
                (
                    f"unseen campaign, {word}: updated over baseline, median and most",
                    f"{np.median(ratio):.3g}, {max(ratio):.3g}",
                ),
                (
                    f"unseen campaign, {word}: updated worse by more than 1 %",
                    str(Share.of([one > 1.01 for one in ratio])),
                ),
            ]
    return rows


def parameter_table(errors: Sequence[Error], unknown: Sequence[str]) -> Table:
    """Errors in units of their own standard deviation; 0.674 is the median of a normal one."""
    rows = []
    for key in sorted({(one.effect, one.parameter) for one in errors}):
        own = [one for one in errors if (one.effect, one.parameter) == key]
        rows.append(
            (
                ".".join(key),
                str(len(own)),
                str(Share.of([one.inside for one in own])),
                f"{np.median([one.deviations for one in own]):.3g}",
            )
        )
    if errors:
        rows.append(
            (
                "all",
                str(len(errors)),
                str(Share.of([one.inside for one in errors])),
                f"{np.median([one.deviations for one in errors]):.3g}",
            )
        )
    left = ", ".join(f"{name} {count}" for name, count in sorted(Counter(unknown).items()))
    head = ("parameter", "compared", "inside its 95 %", "median |error|/std")
    return Table(
        "Parameters of rightly named effects",
        head,
        tuple(rows),
        f"{len(errors)} compared; {len(unknown)} have no truth under a known name or no standard "
        f"deviation{': ' + left if left else ''}. 0.674 is the median of a normal error.",
    )


def excitation_table(cases: Sequence[Judged]) -> Table:
    """Good outcomes by how the table was excited, and whether the floor was measured."""
    good = ("quiet", "right", "both right", "refused")
    keys = sorted({(case.line.excitation, case.line.floor_recorded) for case in cases})
    rows = []
    for excitation, floor in keys:
        own = [case for case in cases if (case.line.excitation, case.line.floor_recorded) == (excitation, floor)]
        rows.append(
            (
                excitation,
                "measured" if floor else "not measured",
                *(
                    str(
                        Share.of(
                            [
                                case.outcome in good if kind in ("none", "outside") else case.outcome in good[1:3]
                                for case in of_kind(own, kind)
                            ]
                        )
                    )
                    for kind in KINDS
                ),
            )
        )
    return Table(
        "Best outcome by excitation",
        ("excitation", "floor", *KINDS),
        tuple(rows),
        "none: quiet; one: right; two: both right; outside: refused.",
    )


def cost_table(cases: Sequence[Judged]) -> Table:
    rows = []
    for word, values in (
        ("seconds", [case.line.seconds for case in cases]),
        ("processor seconds", [case.line.cpu_seconds for case in cases]),
        ("peak memory MB", [case.line.memory_MB for case in cases]),
    ):
        known = [one for one in values if one is not None]
        rows.append(
            (
                word,
                *(
                    (f"{np.median(known):.4g}", f"{np.quantile(known, 0.95):.4g}", f"{max(known):.4g}")
                    if known
                    else ("", "", "")
                ),
                str(len(known)),
            )
        )
    jobs = sorted({case.line.settings.jobs for case in cases})
    return Table(
        "Cost of one campaign",
        ("", "median", "95 %", "most", "cases"),
        tuple(rows),
        f"{' or '.join(map(str, jobs))} cases at once"
        + (", each on a single core" if max(jobs) > 1 else "")
        + "; the truth's simulation is not counted.",
    )
