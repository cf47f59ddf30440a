"""Candidates that were fitted and not named, with reasons."""

from __future__ import annotations

from dataclasses import dataclass

from avis_ctrl.gap.result import Considered
from avis_ctrl.report import words
from avis_ctrl.report.gap import wording
from avis_ctrl.report.pieces import Fold, Paragraph, Piece, Section, Table, listed
from avis_ctrl.study.gap import GapFinding


@dataclass(frozen=True)
class CandidateSettings:
    """first : candidates shown at once, about a page; the others are folded. parameters : maximum number of parameters
    of a candidate in its row.
    """

    first: int = 12
    parameters: int = 4


SETTINGS = CandidateSettings()


def candidates(found: GapFinding) -> Section:
    """Candidates that were fitted but not named, the most probable first."""
    ranked = sorted(found.gap.considered, key=lambda one: (-one.probability, one.chi2_per_dof))
    caption = (
        "Candidates that were fitted together with all parameters of the rig, and the reason for rejection. Chi-square "
        "is that of selected lines of the held-out records, dense at the resonances, and differs from that of all "
        "lines."
    )
    pieces: list[Piece] = [_table(caption, ranked[: SETTINGS.first]) if ranked else Paragraph(_none(found))]
    if others := ranked[SETTINGS.first :]:
        pieces.append(Fold(f"{len(others)} more candidates", (_table("The others.", others),)))
    return Section("Rejected candidates", "considered", tuple(pieces))


def _table(caption: str, some: list[Considered]) -> Table:
    return listed(
        caption,
        some,
        {
            "candidate": wording.candidate,
            "chi-square / dof": lambda one: words.number(one.chi2_per_dof, 4),
            "probability": lambda one: wording.probability(one.probability),
            "best size": lambda one: wording.quantities(one.parameters, SETTINGS.parameters) or "not stated",
            "why it was not named": lambda one: one.reason,
        },
        "lrrll",
    )


def _none(found: GapFinding) -> str:
    if found.gap.verdict == "none":
        return "No candidate was fitted: the score test was significant for no effect at any place."
    return "No other candidate was fitted."
