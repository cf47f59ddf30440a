"""Dependence on level and time, coherence, and whatever else the finder drew."""

from __future__ import annotations

from collections.abc import Sequence

from avis_ctrl.measurement.gates.finding import Picture
from avis_ctrl.report.gap.finding import Found
from avis_ctrl.report.identification.pictures import figure_of
from avis_ctrl.report.pieces import Heading, Paragraph, Piece, Section

GROUPS = (("coherence", "Coherence: what noise, nonlinearity and unmeasured inputs account for"),
          ("level", "Dependence on level"), ("time", "Dependence on time"), ("other", "Further pictures"))
CAPTIONS = {"coherence": "How much of each output's power the inputs account for, and what accounts for the rest.",
            "level": "What depends on the level of the drive; a linear model leaves the same relative error at "
                     "every level.",
            "time": "What changes over the campaign.", "other": "What else was looked at."}
# Panels of one figure.
TOGETHER = 6


def dependence(found: Found) -> Section:
    """Pictures of the finder, by what they are about."""
    pictures = [p for p in found.gap.pictures if any(len(s.x) for s in p.series)]
    pieces: list[Piece] = []
    for group, title in GROUPS:
        own = [p for p in pictures if kind(p) == group]
        if own:
            pieces += [Heading(title), *_figures(group, own)]
    missing = [word for group, word in (("level", "level"), ("time", "time"), ("coherence", "coherence"))
               if not any(kind(p) == group for p in pictures)]
    if missing:
        pieces.append(Paragraph(f"No pictures were made of: {', '.join(missing)}.", "note"))
    return Section("Level, time and coherence", "dependence", tuple(pieces))


def kind(picture: Picture) -> str:
    """What a picture is about, by its title and axes."""
    title, x = picture.title.lower(), picture.x_label.lower()
    if "coherence" in title or "coherence" in picture.y_label.lower():
        return "coherence"
    if "level" in title or "level" in x or "amplitude" in title or "amplitude" in x:
        return "level"
    return "time" if x.startswith("time") or "drift" in title or "over time" in title else "other"


def _figures(group: str, pictures: Sequence[Picture]) -> list[Piece]:
    parts = [pictures[k:k + TOGETHER] for k in range(0, len(pictures), TOGETHER)]
    return [figure_of(f"gap_{group}_{k}", CAPTIONS[group] + (f" Part {k + 1} of {len(parts)}." if len(parts) > 1
                                                             else ""), part, 2, 0.85 if len(part) > 1 else 0.75)
            for k, part in enumerate(parts)]
