"""Candidates that were fitted and not named, with reasons."""

from __future__ import annotations

from avis_ctrl.gap.result import Considered
from avis_ctrl.report import words
from avis_ctrl.report.elements import Fold, Paragraph, Section, Table, listed, section, shown
from avis_ctrl.report.gap import wording
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.gap import GapFinding


def candidates(found: GapFinding) -> Section:
    """Candidates that were fitted but not named, the most probable first."""
    ranked = sorted(found.gap.considered, key=lambda one: (-one.probability, one.chi2_per_dof))
    caption = (
        "Candidates that were fitted together with all parameters of the rig, and the reason for rejection. "
        "Chi-square is that of selected lines of the held-out records, dense at the resonances, and differs from "
        "that of all lines. Steps are numbered in the order in which effects were added. Form: law of the effect, or "
        "its number of modes. The probability uses the smaller of two odds (section on the method), so its order may "
        "differ from that of the log evidence."
    )
    others = ranked[SETTINGS.candidates :]
    return section(
        "Rejected candidates",
        "considered",
        _table(caption, ranked[: SETTINGS.candidates]) if ranked else Paragraph(_none(found)),
        Fold(f"{len(others)} more candidates", shown(_table("More candidates.", others))),
    )


def _table(caption: str, some: list[Considered]) -> Table:
    return listed(
        caption,
        some,
        {
            "candidate": wording.candidate,
            "chi-square / dof": lambda one: words.number(one.chi2_per_dof, 4),
            "probability": lambda one: wording.probability(one.probability),
            "fitted": lambda one: wording.quantities(one.parameters, SETTINGS.candidate_parameters) or "not stated",
            "why it was not named": lambda one: one.reason,
        },
        "lrrll",
    )


def _none(found: GapFinding) -> str:
    if found.gap.verdict == "none":
        return "No candidate raises the evidence enough to be accepted."
    return "No other candidate was fitted."
