"""What remains, and what to measure next."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.result import Detectable, Gap, spoken
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
        pieces += [Heading("How large an effect could be told from none"), detectable(gap)]
    pieces += [Heading("What to measure next"), Paragraph(gap.next_experiment or _nothing(found))]
    return Section("What remains, and what to measure next", "remaining", tuple(pieces))


def detectable(gap: Gap) -> Table:
    """The size at which each effect would differ from none by five standard deviations; its best and worst place."""
    groups: dict[tuple[str, str, str], list[Detectable]] = {}
    for one in gap.detectable:
        groups.setdefault((one.name, one.parameter, one.unit), []).append(one)
    rows = []
    for (name, parameter, unit), members in groups.items():
        ordered = sorted(members, key=lambda one: one.value)
        where = ordered[0].location if len(ordered) == 1 else f"{ordered[0].location} (best) to {ordered[-1].location}"
        ends = [ordered[0]] if len(ordered) == 1 else [ordered[0], ordered[-1]]
        size = " to ".join(_seen(one) for one in ends)
        rows.append((wording.titled(name), where, spoken(parameter, unit), size))
    return table("An effect that is absent, by itself at its place, would differ from none by five standard "
                 "deviations of the fit at this size, at the best and at the worst of its places: about what the "
                 "search asks for before it names one of so many. What is smaller may be there. \"At no size\": "
                 "re-identification of the rig's own parameters would take it up. Effects that have a frequency or "
                 "another shape of their own are not in this table.",
                 ("effect", "place", "parameter", "seen from about"), rows, "lllr")


def _seen(one: Detectable) -> str:
    unit = "" if one.unit in ("", "1") else f" {words.unit(one.unit)}"
    return f"{words.number(one.value, 2)}{unit}" if np.isfinite(one.value) else "at no size"


def _left(gap: Gap) -> str:
    """How much remains, beside what, and how it grows."""
    if gap.raised:
        return (f"The held-out residual is the measured noise. That of {words.joined(list(gap.raised))} is above the "
                "rig file's ambient level.")
    left = gap.left
    if left is None:
        return "What remains was not computed."
    after = " with the named effects" if gap.effects else ""
    level = {True: "It grows faster than the drives: its cause is not linear.",
             False: "It does not grow faster than the drives.",
             None: "Whether it grows faster than the drives these records do not tell."}[left.grows_with_level]
    places = ("The places below hold it." if gap.remaining else
              f"No band of any channel stands out of the measured noise{after}.")
    return (f"On held-out records the updated model leaves {wording.percent(left.nrmse)} of the response, r.m.s., "
            f"{words.number(left.over_noise)} times the noise, and {wording.percent(left.share)} of the power that "
            f"the re-identified model leaves beyond noise. {level} {places}")


def _nothing(found: Found) -> str:
    gap = found.gap
    if gap.effects and any(one.indistinguishable_from for one in gap.effects):
        return "No experiment was found that would tell the inseparable effects apart."
    if gap.verdict in ("partly explained", "unexplained"):
        return "No experiment was found that would tell more."
    if gap.effects and found.design is None:
        return ("Nothing is needed to decide what is missing. What it does to the controller avis gap shows with "
                "--design; avis predict tries the updated model on a campaign that it was not found from.")
    return "Nothing is needed to decide what is asked here."
