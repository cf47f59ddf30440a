"""Table of the records of a measurement campaign, the same in all reports."""

from __future__ import annotations

from collections.abc import Mapping

from avis_ctrl.measurement.campaign import Campaign, RecordHeader, in_short
from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Piece, Table, headed, listed


def records(campaign: Campaign, use: Mapping[str, str], divided: str) -> Table:
    """One row per record. use : purpose of each record by name. divided : how the records were divided."""

    def level(h: RecordHeader) -> str:
        return "silent" if h.excitation in ("rest", "floor") else f"{words.number(h.level_V)} {h.u_unit}"

    return listed(
        f"The records{f' ({campaign.source})' if campaign.source else ''}, sampled at "
        f"{words.number(campaign.sample_rate_Hz)} Hz; {len(campaign.u_names)} drives, "
        f"{len(campaign.y_names)} sensors. Levels are r.m.s. values of the drive voltages; in records at rest "
        f"or with a shaken floor the drives are silent.{f' {words.sentence(divided)}' if divided else ''}",
        [record.header for record in campaign.records],
        {
            "record": lambda h: h.name,
            "excitation": lambda h: h.excitation,
            "level": level,
            "starts at": lambda h: f"{words.number(h.start_s)} s",
            "duration": lambda h: f"{words.number(h.duration_s)} s",
            "periods": lambda h: f"{h.periods} of {words.number(h.period_s)} s" if h.period_s else "none",
            "floor measured": lambda h: words.yes(bool(h.floor_names)),
            "used as": lambda h: use.get(h.name, "not used"),
        },
        "llrrrrcl",
    )


def remarks(campaign: Campaign) -> tuple[Piece, ...]:
    """Assumptions made in reading the file; empty if there are none."""
    return headed("Notes on the measurement file", Bullets(tuple(in_short(campaign.notes))))
