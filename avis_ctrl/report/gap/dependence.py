"""Dependence on level and time, and coherence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avis_ctrl.gap.result import Gap, RecordGap
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, level
from avis_ctrl.report.gap.before_after import AFTER, BEFORE, NOISE
from avis_ctrl.report.gap.coherence import coherence
from avis_ctrl.report.gap.finding import Found
from avis_ctrl.report.pieces import Heading, Paragraph, Piece, Section


def dependence(found: Found) -> Section:
    """The residual of each record by level and by time, and fractions of power."""
    gap = found.gap
    pieces: list[Piece] = []
    if gap.records:
        pieces.append(by_record(gap))
    else:
        pieces.append(Paragraph("The residual of single records was not computed.", "note"))
    pieces.append(Heading("Coherence: what noise, nonlinearity and unmeasured inputs account for"))
    pieces += coherence(gap.shares) if gap.shares else [
        Paragraph("No fractions of power were computed: the driven records have too few lines for their inputs.",
                  "note")]
    return Section("Level, time and coherence", "dependence", tuple(pieces))


def by_record(gap: Gap) -> Figure:
    """Residual over noise of every record, by level and by time; held-out records filled."""
    panels = (_panel(gap, "By level", Axis("level of the drives, r.m.s. [V]"), lambda one: one.level_V),
              _panel(gap, "By time", Axis("start of the record, time [s]"), lambda one: one.start_s))
    return Figure("gap_records", "Residual of each record, relative to the noise. Filled: held-out records; open: "
                  "fitted. A missing linear effect gives an error in proportion to the level. An error that is the "
                  "same at every level is noise; one that grows otherwise depends on amplitude. A slope over time is "
                  "drift. The frequency lines are a random selection, dense near resonances, the same for all records: "
                  "these values differ from those of all lines in the table of stages.", panels, 2, 0.85)


def _panel(gap: Gap, title: str, x: Axis, of: Callable[[RecordGap], float]) -> Panel:
    sides = [("re-identified", BEFORE, lambda one: one.before)]
    if gap.effects:
        sides.append(("updated", AFTER, lambda one: one.after))
    curves = []
    for label, style, value in sides:
        for held, word in ((False, "fitted"), (True, "held out")):
            some = [one for one in gap.records if one.held_out == held]
            curves.append(Curve(np.array([of(one) for one in some]), np.array([value(one) for one in some]),
                                f"{label}, {word}", Style(style.colour), points=True, line=False, hollow=not held))
    low, high = _limits([of(one) for one in gap.records])
    curves.append(level(low, high, 1.0, "noise alone", NOISE))
    values = np.array([v for one in gap.records for v in (one.before, one.after)])
    values = values[np.isfinite(values) & (values > 0)]
    y = Axis("residual / noise, r.m.s. [-]", "log", (float(min(values.min(initial=1.0), 1.0)) / 1.5,
                                                     float(max(values.max(initial=1.0), 1.0)) * 1.5))
    return Panel(Axis(x.label, "linear", (low, high)), y, tuple(curves), (), title)


def _limits(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room

