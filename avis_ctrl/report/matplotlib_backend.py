"""Figures as vector graphics for the PDF."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from avis_ctrl.report.figures import Axis, Band, Curve, Figure, Panel, Style, log_range, ticks_log

WIDTH_IN, PANEL_IN, LEGEND_IN, LEGEND_COLUMNS = 6.7, 2.35, 0.2, 3
LINES = {"solid": "-", "dash": (0, (5, 2)), "dot": (0, (1, 1.5)), "dashdot": (0, (5, 1.5, 1, 1.5))}
# Same input, same bytes: element names follow from the salt, and no date is written.
SETTINGS: Any = {"svg.fonttype": "path", "svg.hashsalt": "avis_ctrl", "font.size": 8.0,
                            "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
                            "axes.unicode_minus": True, "path.simplify": True}


def svg(figure: Figure) -> str:
    """The figure as SVG."""
    with matplotlib.rc_context(SETTINGS):
        entries = figure.legend()
        rows = -(-len(entries) // LEGEND_COLUMNS) if len(entries) > 1 else 0
        height = sum(PANEL_IN + (0.15 if p.title else 0.0) for p in figure.panels) + LEGEND_IN * rows + 0.25
        canvas = Canvas(figsize=(WIDTH_IN, height), layout="constrained")
        axes = canvas.subplots(len(figure.panels), 1, squeeze=False)[:, 0]
        for ax, panel in zip(axes, figure.panels, strict=True):
            _draw(ax, panel)
        if rows:
            canvas.legend([_key(e) for e in entries], [e.label for e in entries], loc="outside lower center",
                          ncols=min(LEGEND_COLUMNS, len(entries)), frameon=False, handlelength=2.6)
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _line(style: Style) -> dict[str, Any]:
    return {"color": style.colour, "linestyle": LINES[style.dash], "linewidth": 0.75 * style.width}


def _key(entry: Curve | Band) -> Any:
    if isinstance(entry, Band):
        return Patch(facecolor=entry.style.colour, alpha=0.25)
    if not entry.line:
        return Line2D([], [], color=entry.style.colour, marker="o", markersize=3.5, linestyle="none")
    return Line2D([], [], marker="o" if entry.points else None, markersize=3, **_line(entry.style))


def _draw(ax: Any, panel: Panel) -> None:
    for band in panel.bands:
        ax.fill_between(band.x, band.low, band.high, color=band.style.colour, alpha=0.25, linewidth=0)
    for curve in panel.curves:
        look = _line(curve.style)
        if not curve.line:
            look["linestyle"] = "none"
        ax.plot(curve.x, np.where(np.isfinite(curve.y), curve.y, np.nan), marker="o" if curve.points else None,
                markersize=3, **look)
    _scale(ax, "x", panel.x, panel.x.range)
    _scale(ax, "y", panel.y, log_range(panel) if panel.y.scale == "log" else panel.y.range)
    ax.grid(True, linewidth=0.4, color="#dddddd")
    if panel.title:
        ax.set_title(panel.title, fontsize=8.5, loc="left")


def _scale(ax: Any, which: str, axis: Axis, limits: tuple[float, float] | None) -> None:
    setter, target = getattr(ax, f"set_{which}scale"), getattr(ax, f"{which}axis")
    setter(axis.scale)
    getattr(ax, f"set_{which}label")(axis.label)
    if limits is not None:
        getattr(ax, f"set_{which}lim")(*limits)
    if axis.scale == "log" and limits is not None:
        target.set_ticks(*ticks_log(*limits))
        target.set_minor_formatter(matplotlib.ticker.NullFormatter())
