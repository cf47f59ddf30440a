"""Candidates that were fitted and not named, with reasons."""

from __future__ import annotations

from avis_ctrl.report import words
from avis_ctrl.report.gap import wording
from avis_ctrl.report.pieces import Fold, Paragraph, Piece, Section, table
from avis_ctrl.study.gap import GapFinding

FIRST = 12
# Maximum number of a candidate's parameters in a row.
MOST = 4


def candidates(found: GapFinding) -> Section:
    """Candidates that were fitted but not named, the most probable first."""
    ranked = sorted(found.gap.considered, key=lambda one: (-one.probability, one.chi2_per_dof))
    if not ranked:
        return Section("Rejected candidates", "considered", (Paragraph(_none(found)),))
    header = ("candidate", "chi-square / dof", "odds", "best size", "why it was not named")
    rows = [
        (
            wording.candidate(one),
            words.number(one.chi2_per_dof, 4),
            wording.probability(one.probability),
            wording.quantities(one.parameters, MOST) or "not stated",
            one.reason,
        )
        for one in ranked
    ]
    pieces: list[Piece] = [
        table(
            "Candidates that were fitted together with all parameters of the rig, and the reason "
            "for rejection. Chi-square is that of selected lines of the held-out records, dense "
            "at the resonances, and differs from that of all lines.",
            header,
            rows[:FIRST],
            "lrrll",
        )
    ]
    if rows[FIRST:]:
        pieces.append(
            Fold(f"{len(rows) - FIRST} more candidates", (table("The others.", header, rows[FIRST:], "lrrll"),))
        )
    return Section("Rejected candidates", "considered", tuple(pieces))


def _none(found: GapFinding) -> str:
    if found.gap.verdict == "none":
        return "No candidate was fitted: the score test was significant for no effect at any place."
    return "No other candidate was fitted."
