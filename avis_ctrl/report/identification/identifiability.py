"""Which combinations of parameters the data determine, and what would determine the others."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Paragraph, Section, Table, headed, section, table
from avis_ctrl.report.figures import Axis, Figure, Panel, Style, level, log_limits, markers
from avis_ctrl.study.identification import Identification


def identifiability(found: Identification) -> Section:
    """Rank, the determined combinations with their standard deviations, and the others in sentences."""
    report = found.identifiability
    information = report.information
    missing = len(information.names) - report.rank
    first = Paragraph(
        f"The data determine {report.rank} of {len(information.names)} combinations of the parameters: their "
        f"relative standard deviation is below 1. The condition number of their information matrix, in "
        f"relative parameters, is {words.number(report.condition)}.",
        "verdict",
        missing == 0 or None,
    )
    none = "No further experiment that would determine the rest was computed."
    return section(
        "Identifiability",
        "identifiability",
        (first, _combinations(found), _directions(found)),
        headed("In words", Bullets(report.sentences[1:] or report.sentences)),
        headed("What would determine the rest", Bullets(found.advice)),
        Paragraph(none, "note") if missing and not found.advice else None,
    )


def _combinations(found: Identification) -> Table:
    rows = []
    for one in found.identifiability.combinations:
        if one.determined:
            value, sigma = words.with_std(one.value, one.standard_deviation)
            share = f"{words.number(100 * one.relative, 2)} %"
        else:
            value, sigma, share = words.number(one.value, 4), "not determined", ""
        rows.append((one.words, value, sigma, share, words.unit(one.unit)))
    return table(
        "Combinations of parameters that the data determine, from the joint covariance of the parameters. A "
        "parameter listed alone is determined individually.",
        ("combination", "value", "± 1 σ", "relative", "unit"),
        rows,
        "lrrrl",
    )


def _directions(found: Identification) -> Figure:
    sigma = found.identifiability.information.directions[0]
    n = len(sigma)
    shown = np.where(np.isfinite(sigma) & (sigma < 1e6), sigma, np.nan)
    lost = int(np.count_nonzero(np.isnan(shown)))
    bottom, top = log_limits(shown, 1 / 3, 3, (1e-3, 10.0))
    count = "one more direction" if lost == 1 else f"{lost} more directions"
    beyond = f" On {count} the data contain no information." if lost else ""
    curves = (
        markers(np.arange(1, n + 1, dtype=float), shown, "relative standard deviation", Style("#0072b2")),
        level(0.5, n + 0.5, 1.0, "not determined above"),
    )
    x = Axis("direction, by precision", "linear", (0.5, n + 0.5))
    y = Axis("relative standard deviation [-]", "log", (bottom, max(10.0, top)))
    return Figure(
        "directions",
        "Relative standard deviations along the principal directions of the information "
        f"matrix, the most precise first.{beyond}",
        [Panel(x, y, curves)],
    )
