"""Figures of judged cases. A crash is never a good answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.blind.judge import PLACED, Judged
from benchmarks.blind.lines import Answer, Stage
from benchmarks.blind.rates import Share

NOISE_RATIO, GAP_FACTOR = 1.2, 10.0


def of_kind(cases: Sequence[Judged], kind: str) -> list[Judged]:
    return [case for case in cases if case.line.kind == kind]


def right_places(cases: Sequence[Judged]) -> Share:
    """One effect, clear or gross, whose place is a choice, named rightly: the place is right too."""
    return Share.of(
        [
            case.pairs[0].place
            for case in of_kind(cases, "one")
            if case.line.clear and case.outcome == "right" and case.pairs[0].hidden.name in PLACED
        ]
    )


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
