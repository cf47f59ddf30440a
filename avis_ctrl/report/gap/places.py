"""Where model and measurement disagree: a map of channels and frequencies, and a table of the main places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.gap.result import Gap, HeatMap, Where
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Section, Table, listed, section
from avis_ctrl.report.figures import Axis, Figure, Heat, Panel, hertz
from avis_ctrl.report.gap import wording
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.gap import GapFinding


def places(found: GapFinding) -> Section:
    """Heat map before and after adding effects, and table of the places before."""
    gap = found.gap
    return section(
        "Where they disagree",
        "where",
        heat_map(gap.heat, bool(gap.effects)) if gap.heat is not None else None,
        table_of(
            gap.where, "Bands and channels with the largest error after re-identification, before any effect is added. "
        ),
        None if gap.where else Paragraph(_nowhere(gap)),
    )


def _nowhere(gap: Gap) -> str:
    if gap.verdict == "none":
        return (
            "No effect is named. The bands in which the residual exceeds the noise are listed in the section on "
            "the residual."
            if gap.remaining
            else "No band of any channel exceeds the noise significantly."
        )
    return "After re-identification, no band of any channel by itself exceeds the noise significantly."


def heat_map(heat: HeatMap, named: bool) -> Figure:
    """Residual by channel and frequency of the re-identified and the updated model, on one colour scale."""
    known = np.concatenate([heat.before.ravel(), heat.after.ravel()])
    known = known[np.isfinite(known) & (known > 0)]
    top = float(10 ** np.ceil(np.log10(known.max(initial=SETTINGS.map_top)) - 1e-9))
    edges, n = heat.bands_Hz, len(heat.columns)
    y = Axis("", "linear", (n - 0.5, -0.5), tuple((float(k), _short(name)) for k, name in enumerate(heat.columns)))

    def panel(title: str, values: np.ndarray) -> Panel:
        z = np.asarray(values, float).T
        return Panel(
            hertz(), y, (), (), title, Heat(edges, z, "residual / noise power [-]", (SETTINGS.map_lowest, top))
        )

    panels = [panel("After re-identification", heat.before)]
    if named:
        panels.append(panel("With the named effects", heat.after))
    return Figure(
        "heat_map",
        "Power of the residual on held-out data relative to that of the measured noise, by "
        "channel and frequency band. White: noise alone. Blue: below the estimated noise. Grey: no data. Logarithmic "
        "colours.",
        panels,
        len(panels),
        max(0.75, min(2.4, 0.085 * n + 0.25)),
    )


def _short(name: str) -> str:
    """A name shortened to fit beside a map."""
    return name if len(name) <= SETTINGS.map_letters else f"{name[: SETTINGS.map_letters - 1]}…"


def table_of(places: Sequence[Where], caption: str) -> Table:
    """Table of bands and paths with their fraction of the residual power beyond noise."""
    return listed(
        f"{caption}The largest places, each with the drive that is most coherent with the residual, if there is one. "
        "Fraction: of the total residual power beyond noise, each line divided by its noise. Power / noise: residual "
        "power in this band divided by noise power. p-value: probability of such a residual by noise alone, "
        "corrected for the number of places tested (family-wise).",
        places,
        {
            "place": wording.place,
            "fraction": lambda one: words.percent(one.share),
            "power / noise": lambda one: words.number(one.excess),
            "p-value": lambda one: "< 1e−6" if one.p_value < 1e-6 else words.number(one.p_value, 2),
        },
    )
