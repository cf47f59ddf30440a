"""Figures as vector graphics for the PDF."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import matplotlib.ticker
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure as Canvas

from avis_ctrl.report.figures import NO_DATA, Axis, Figure, Heat, Panel, limits, ticks_log

WIDTH_IN, LEFT_IN, RIGHT_IN, PLOT_IN = 6.7, 0.66, 0.14, 1.75
TITLE_IN, FOOT_IN, LEGEND_IN = 0.2, 0.42, 0.18
CHARACTER_IN, KEY_IN = 0.068, 0.5
# Height of a colour bar under the panels: with its labels, and of the bar alone.
BAR_IN, BAR_HEIGHT_IN = 0.5, 0.09
# Mean width of a letter relative to the font size.
LETTER = 0.54
LINES = {"solid": "-", "dash": (0, (5, 2)), "dot": (0, (1, 1.5)), "dashdot": (0, (5, 1.5, 1, 1.5))}
# Reproducible output: element ids derive from the salt, and no date is written.
SETTINGS: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "avis_ctrl",
    "font.size": 8.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
    "path.simplify": True,
}


def svg(figure: Figure) -> str:
    """The figure as SVG."""
    with matplotlib.rc_context(SETTINGS):
        entries = figure.legend()
        # As many legend columns as the longest label allows.
        longest = max(map(len, entries), default=0)
        keys = max(1, min(len(entries), int(WIDTH_IN / (KEY_IN + CHARACTER_IN * longest))))
        heat = figure.heat()
        legend = LEGEND_IN * -(-len(entries) // keys) if len(entries) > 1 else BAR_IN if heat else 0
        places, height = _places(figure, legend)
        canvas = Canvas(figsize=(WIDTH_IN, height))
        # Fixed positions: a layout engine would take most of the computing time of the whole report.
        drawn: dict[str, Any] = {}
        for panel, place in zip(figure.panels, places, strict=True):
            drawn = _draw(canvas.add_axes(place), panel, figure, place[2] * WIDTH_IN) | drawn
        if heat:
            bar = canvas.add_axes((0.25, (BAR_IN - BAR_HEIGHT_IN) / height, 0.5, BAR_HEIGHT_IN / height))
            _colour_bar(canvas, bar, heat)
        elif legend:
            canvas.legend(
                [drawn[label] for label in entries],
                entries,
                loc="lower center",
                borderaxespad=0.1,
                ncols=keys,
                frameon=False,
                handlelength=2.6,
            )
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _places(figure: Figure, legend: float) -> tuple[list[tuple[float, float, float, float]], float]:
    """Left, bottom, width and height of each panel as fractions of the canvas, and the canvas height [in]."""
    (rows, columns), plot = figure.grid(), PLOT_IN * figure.height
    words = max((len(word) for panel in figure.panels for _, word in panel.y.ticks), default=0)
    left = max(LEFT_IN, 0.12 + CHARACTER_IN * words + (0.16 if any(p.y.label for p in figure.panels) else 0.0))
    title, foot = (0.18, 0.04) if figure.shared else (TITLE_IN, FOOT_IN)
    # Tick labels may have several rows, with the axis label below them.
    foot += LEGEND_IN * max((word.count("\n") for panel in figure.panels for _, word in panel.x.ticks), default=0)
    # Panels with shared scales have tick labels at the outer edges only.
    beside = 0.05 if figure.shared else left + RIGHT_IN
    width = (WIDTH_IN - left - RIGHT_IN - beside * (columns - 1)) / columns
    below = FOOT_IN if figure.shared else 0.0
    height = (title + plot + foot) * rows + below + legend + 0.05
    places = []
    for k in range(len(figure.panels)):
        row, column = k // columns, k % columns
        bottom = height - (title + plot) * (row + 1) - foot * row
        places.append(((left + column * (width + beside)) / WIDTH_IN, bottom / height, width / WIDTH_IN, plot / height))
    return places, height


def _colours(heat: Heat) -> dict[str, Any]:
    low, high = np.log10(heat.range)
    colours = LinearSegmentedColormap.from_list("warm", heat.colours).with_extremes(bad=NO_DATA)
    return {"cmap": colours, "norm": Normalize(low, high)}


def _colour_bar(canvas: Any, place: Any, heat: Heat) -> None:
    places, text = heat.decades
    bar = canvas.colorbar(ScalarMappable(**_colours(heat)), cax=place, orientation="horizontal", label=heat.label)
    bar.set_ticks(places, labels=text)
    bar.outline.set_linewidth(0.5)


def _draw(ax: Any, panel: Panel, figure: Figure, width: float) -> dict[str, Any]:
    """Draw a panel of the given width [in]; returns what was drawn, by label."""
    small, drawn = figure.shared, {}
    if panel.heat is not None:
        rows = np.arange(len(panel.heat.z) + 1) - 0.5
        ax.pcolormesh(
            panel.heat.x_edges,
            rows,
            np.ma.masked_invalid(panel.heat.logarithm),
            edgecolors="white",
            linewidth=0.3,
            **_colours(panel.heat),
        )
    for band in panel.bands:
        look = {"color": band.style.colour, "alpha": 0.25, "linewidth": 0}
        drawn[band.label] = ax.fill_between(band.x, band.low, band.high, **look)
    for curve in panel.curves:
        if curve.bars:
            ax.set_axisbelow(True)
            drawn[curve.label] = ax.bar(curve.x, curve.y, curve.bars, color=curve.style.colour)
            continue
        if curve.error is not None:
            error = {f"{curve.along}err": np.where(np.isfinite(curve.error), curve.error, np.nan)}
            ax.errorbar(curve.x, curve.y, **error, fmt="none", ecolor=curve.style.colour, elinewidth=0.9, capsize=1.8)
        look = {
            "color": curve.style.colour,
            "linestyle": LINES[curve.style.dash] if curve.line else "none",
            "linewidth": 0.75 * curve.style.width,
            "marker": "o" if curve.points else None,
            "markersize": 4.5 if curve.hollow else 3,
            "markerfacecolor": "none" if curve.hollow else None,
        }
        (drawn[curve.label],) = ax.plot(curve.x, np.where(np.isfinite(curve.y), curve.y, np.nan), **look)
    _scale(ax, "x", panel.x, limits(panel, "x"))
    _scale(ax, "y", panel.y, limits(panel, "y"))
    if panel.heat is None:
        ax.grid(True, linewidth=0.4, color="#dddddd")
    if panel.title:
        ax.set_title(
            panel.title,
            fontsize=_fitting(panel.title, width, 6.5 if small else 8.5),
            loc="left",
            pad=2.5 if small else None,
        )
    ax.yaxis.label.set_fontsize(_fitting(panel.y.label, PLOT_IN * figure.height + 0.2, 6.5 if small else 8.0))
    if small:
        ax.tick_params(labelsize=5.5)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_minor_locator(matplotlib.ticker.NullLocator())
    return drawn


def _fitting(text: str, room: float, most: float) -> float:
    """Font size [pt] at which a text fits into `room` inches, between 5.5 and `most`."""
    return max(5.5, min(most, 72 * room / (LETTER * max(len(text), 1))))


def _scale(ax: Any, which: str, axis: Axis, ends: tuple[float, float] | None) -> None:
    setter, target = getattr(ax, f"set_{which}scale"), getattr(ax, f"{which}axis")
    setter(axis.scale)
    getattr(ax, f"set_{which}label")(axis.label)
    if ends is not None:
        getattr(ax, f"set_{which}lim")(*ends)
    if axis.scale == "log" and ends is not None:
        target.set_ticks(*ticks_log(*ends))
        target.set_minor_formatter(matplotlib.ticker.NullFormatter())
    if axis.ticks:
        target.set_ticks(*zip(*axis.ticks, strict=True))
    if axis.silent:
        target.set_ticklabels([])
        target.label.set_visible(False)
