"""The records, and how they were divided."""

from __future__ import annotations

from avis_ctrl.measurement.campaign import in_short
from avis_ctrl.report import words
from avis_ctrl.report.gap.finding import Found
from avis_ctrl.report.pieces import Bullets, Heading, Piece, Section, table


def measurement(found: Found) -> Section:
    """Table of records, and what the reader says of the file."""
    campaign = found.measured
    rows = []
    for record in campaign.records:
        h = record.header
        periods = f"{h.periods} of {words.number(h.period_s)} s" if h.period_s else "none"
        quiet = h.excitation in ("rest", "floor")
        rows.append((h.name, h.excitation, "silent" if quiet else f"{words.number(h.level_V)} {h.u_unit}",
                     f"{words.number(h.start_s)} s", f"{words.number(h.duration_s)} s", periods,
                     words.yes(bool(h.floor_names))))
    source = f" ({campaign.source})" if campaign.source else ""
    how = found.gap.held_out.rstrip(".")
    divided = f" Held out: {how}." if how else ""
    pieces: list[Piece] = [table(
        f"The records{source}, sampled at {words.number(campaign.sample_rate_Hz)} Hz; {len(campaign.u_names)} drives, "
        f"{len(campaign.y_names)} outputs [{words.unit(campaign.y_unit)}]. Levels are r.m.s. of the drives.{divided}",
        ("record", "excitation", "level", "starts at", "duration", "periods", "floor measured"), rows, "llrrrrc")]
    if in_short(campaign.notes):
        pieces += [Heading("Notes on reading the file"), Bullets(tuple(in_short(campaign.notes)))]
    return Section("Measurement", "measurement", tuple(pieces))
