"""What remains, and what to measure next."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.result import Gap
from avis_ctrl.report import words
from avis_ctrl.report.gap import wording
from avis_ctrl.report.gap.finding import Found
from avis_ctrl.report.gap.places import table_of
from avis_ctrl.report.pieces import Heading, Paragraph, Piece, Section, Table, table


def remaining(found: Found) -> Section:
    """Places of what the updated model leaves, and the next experiment."""
    gap = found.gap
    pieces: list[Piece] = [Paragraph(_left(gap))]
    if gap.remaining:
        pieces.append(table_of(gap.remaining, "Places of what the updated model leaves on held-out data. "))
    if gap.detectable:
        pieces += [Heading("What would have been seen"), detectable(gap)]
    pieces += [Heading("What to measure next"), Paragraph(gap.next_experiment or _nothing(gap))]
    return Section("What remains, and what to measure next", "remaining", tuple(pieces))


def detectable(gap: Gap) -> Table:
    """From which size on each effect of the library would have been seen."""
    rows = []
    for one in gap.detectable:
        unit = "" if one.unit in ("", "1") else f" {words.unit(one.unit)}"
        size = f"{words.number(one.value, 2)}{unit}" if np.isfinite(one.value) else "at no size"
        rows.append((wording.titled(one.name), one.location, wording.parameter(one.parameter), size))
    return table("An effect that is absent, by itself at its place, would have been seen from this size on: three "
                 "standard deviations of the fit. What is smaller may be there. \"At no size\": re-identification of "
                 "the rig's own parameters would take it up.", ("effect", "place", "parameter", "seen from"), rows,
                 "lllr")


def _left(gap: Gap) -> str:
    if gap.verdict in ("none", "explained"):
        after = " with the named effects" if gap.effects else ""
        return (f"Nothing beyond the measured noise was found{after}." if not gap.remaining else
                f"The held-out residual{after} counts as noise as a whole; the places below stand out by themselves.")
    what = "What the named effects leave" if gap.effects else "The whole gap"
    return (f"{what} is significant, and nothing in the library accounts for it."
            + (" The places below hold it." if gap.remaining else " Its places were not stated."))


def _nothing(gap: Gap) -> str:
    if gap.effects and any(one.indistinguishable_from for one in gap.effects):
        return "No experiment was found that would tell the inseparable effects apart."
    if gap.verdict in ("partly explained", "unexplained"):
        return "No experiment was found that would tell more."
    return "Nothing is needed to decide what is asked here."
