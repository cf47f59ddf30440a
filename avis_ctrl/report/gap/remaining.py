"""The residual, and what to measure next."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.result import Detectable, Gap, spoken
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Section, Table, headed, section, table
from avis_ctrl.report.gap import wording
from avis_ctrl.report.gap.places import table_of
from avis_ctrl.study.gap import GapFinding
from avis_ctrl.summary import joined


def remaining(found: GapFinding) -> Section:
    """Where the residual of the updated model lies, and the next experiment."""
    gap = found.gap
    return section(
        "Residual, and what to measure next",
        "remaining",
        Paragraph(_left(gap)),
        table_of(gap.remaining, "Where the residual of the updated model lies, on held-out data. "),
        headed("Detection limits", detectable(gap)),
        headed("What to measure next", Paragraph(next_step(found))),
    )


def detectable(gap: Gap) -> Table:
    """Size at which each effect would differ from zero by five standard deviations, at its best and worst place."""
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
    return table(
        "Detection limits: five standard deviations of each parameter, as a change from its value without the effect, "
        'at the best and at the worst place. Smaller effects may be present. "Not '
        'detectable": the re-identified parameters of the rig absorb the effect. Effects with a frequency or '
        "a shape of their own are not in this table.",
        ("effect", "place", "parameter", "detection limit"),
        rows,
        "lllr",
    )


def _seen(one: Detectable) -> str:
    return (
        f"{words.number(one.value, 2)} {words.unit(one.unit)}".rstrip() if np.isfinite(one.value) else "not detectable"
    )


def _left(gap: Gap) -> str:
    """Size of the residual relative to response and noise, and its growth with level."""
    if gap.raised:
        return (
            f"The held-out residual is the measured noise. That of {joined(list(gap.raised))} is above the "
            "rig file's ambient level."
        )
    left = gap.left
    if left is None:
        return "The residual was not computed."
    after = " with the named effects" if gap.effects else ""
    level = {
        True: "It grows faster than the drive level: its cause is not linear.",
        False: "It does not grow faster than the drive level.",
        None: "It is too small, or the records are too few, to show whether it grows faster than the drive level.",
    }[left.grows_with_level]
    places = (
        "The table below lists where it lies."
        if gap.remaining
        else f"No band of any channel exceeds the estimated noise significantly{after}."
    )
    return (
        f"On held-out records the residual of the updated model is {words.percent(left.nrmse)} of the response, "
        f"r.m.s., which is {words.number(left.over_noise)} times the estimated noise. Its power beyond noise is "
        f"{words.percent(left.share)} of that of the re-identified model. {level} {places}"
    )


def next_step(found: GapFinding) -> str:
    """The most informative next experiment, or a statement that none is needed or none was found."""
    gap = found.gap
    if gap.next_experiment:
        return words.sentence(gap.next_experiment)
    if gap.effects and any(one.indistinguishable_from for one in gap.effects):
        return "No further measurement was found that would distinguish the effects that these data confuse."
    if gap.verdict in ("partly explained", "unexplained"):
        return "No further measurement was found that would explain more."
    if gap.effects and found.design is None:
        return (
            "No further measurement is needed to name the missing effects. avis gap --design shows their influence "
            "on the controller; avis predict tests the updated model on another campaign."
        )
    return "No further measurement is suggested."
