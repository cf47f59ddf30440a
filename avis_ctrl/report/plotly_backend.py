"""Interactive figures of the HTML report as plain JSON for plotly.js, without Python objects of plotly."""

from __future__ import annotations

import base64
import gzip
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from avis_ctrl.report.figures import Axis, Band, Curve, Figure, Heat, Panel, limits, ticks_log

PANEL_PX, LEGEND_ROW_PX = 300, 22


def graph(figure: Figure) -> dict[str, Any]:
    """Traces and layout of a figure for plotly.js; `narrow` is the layout for a narrow screen."""
    traces: list[dict[str, Any]] = []
    shown: set[str] = set()
    for k, panel in enumerate(figure.panels):
        suffix = "" if k == 0 else str(k + 1)
        if panel.heat is not None:
            traces.append({**_heat(panel), "xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "showlegend": False})
        things: list[Band | Curve] = [*panel.bands, *panel.curves]
        for thing in things:
            drawn = _band(thing) if isinstance(thing, Band) else [_curve(thing)]
            for trace in drawn:
                in_legend = bool(thing.label) and trace.pop("key") and thing.label not in shown
                shown.update([thing.label] if in_legend else [])
                traces.append({**trace, "xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "showlegend": in_legend})
    rows, columns = figure.grid()
    found = {"data": traces, "layout": _layout(figure, rows, columns)}
    narrow = columns > 1 and not figure.shared
    return found | {"narrow": _layout(figure, len(figure.panels), 1)} if narrow else found


def _layout(figure: Figure, rows: int, columns: int) -> dict[str, Any]:
    layout: dict[str, Any] = {
        "height": round(PANEL_PX * figure.height * rows) + 90 + LEGEND_ROW_PX * (len(figure.legend()) // 3),
        "annotations": [],
        "showlegend": len(figure.legend()) > 1,
    }
    if (heat := figure.heat()) is not None:
        layout["coloraxis"] = _colour_bar(heat)
    # Room for title and tick labels: the same number of pixels whatever the height of the panels.
    gap = (0.14 if figure.shared else 0.26 / figure.height) / rows if rows > 1 else 0.0
    between = 0.0 if columns == 1 else 0.012 if figure.shared else 0.11
    width = (1.0 - between * (columns - 1)) / columns
    for k, panel in enumerate(figure.panels):
        suffix, row, column = "" if k == 0 else str(k + 1), k // columns, k % columns
        top = 1.0 - row * (1.0 + gap) / rows
        domain = [max(0.0, top - (1.0 + gap) / rows + gap), top]
        side = {} if columns == 1 else {"domain": [column * (width + between), column * (width + between) + width]}
        small = {"tickfont": {"size": 9}} if figure.shared else {}
        bars = {"barmode": "overlay"} if any(c.bars for c in panel.curves) else {}
        layout |= bars
        layout[f"xaxis{suffix}"] = {**_axis(panel.x, limits(panel, "x")), "anchor": f"y{suffix}", **side, **small}
        layout[f"yaxis{suffix}"] = {
            **_axis(panel.y, limits(panel, "y")),
            "anchor": f"x{suffix}",
            "domain": domain,
            **small,
        }
        room = PANEL_PX * figure.height * (1.0 if rows == 1 else 0.75)
        if len(panel.y.label) * 7 > room:
            layout[f"yaxis{suffix}"]["title"]["font"] = {"size": 10}
        if panel.title:
            layout["annotations"].append(_title(panel, domain[1], side.get("domain", [0])[0], figure.shared))
    return layout


@cache
def library() -> str:
    """plotly.js of the installed plotly package, gzipped and base64-encoded to a third of its size."""
    code = (resources.files("plotly") / "package_data" / "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(code, 9, mtime=0)).decode()


def _numbers(values: np.ndarray) -> list[float | None]:
    """Values to six digits, more than a screen resolves; None, a gap, for values that are not finite."""
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in np.asarray(values, float)]


def _curve(curve: Curve) -> dict[str, Any]:
    colour = {"color": curve.style.colour}
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "+".join(["lines"] * curve.line + ["markers"] * curve.points),
        "x": _numbers(curve.x),
        "y": _numbers(curve.y),
        "name": _text(curve.label),
        "legendgroup": curve.label,
        "key": True,
        "marker": {"size": 6, **colour},
        "line": {"dash": curve.style.dash, "width": curve.style.width, **colour},
    }
    if curve.hollow:
        trace["marker"] = {"size": 8, "symbol": "circle-open", "line": {"width": 1.6}, **colour}
    if curve.error is not None:
        trace[f"error_{curve.along}"] = {
            "type": "data",
            "array": _numbers(curve.error),
            "thickness": 1.3,
            "width": 3,
            **colour,
        }
    if curve.bars:
        trace |= {"type": "bar", "width": curve.bars, "marker": colour}
    return trace


def _band(band: Band) -> list[dict[str, Any]]:
    edge = {
        "type": "scatter",
        "mode": "lines",
        "x": _numbers(band.x),
        "line": {"width": 0, "color": band.style.colour},
        "hoverinfo": "skip",
        "legendgroup": band.label,
        "name": _text(band.label),
    }
    red, green, blue = (int(band.style.colour[k : k + 2], 16) for k in (1, 3, 5))
    return [
        {**edge, "y": _numbers(band.low), "key": False},
        {
            **edge,
            "y": _numbers(band.high),
            "fill": "tonexty",
            "key": True,
            "fillcolor": f"rgba({red},{green},{blue},0.25)",
        },
    ]


def _heat(panel: Panel) -> dict[str, Any]:
    heat = panel.heat
    assert heat is not None
    names = dict(panel.y.ticks)
    cells = [
        [
            f"{_text(names.get(float(row), str(row)))}, {low:.3g} to {high:.3g} Hz: {value:.3g}"
            for low, high, value in zip(heat.x_edges[:-1], heat.x_edges[1:], values, strict=True)
        ]
        for row, values in enumerate(heat.z)
    ]
    return {
        "type": "heatmap",
        "x": _numbers(heat.x_edges),
        "y": [k - 0.5 for k in range(len(heat.z) + 1)],
        "z": [_numbers(row) for row in heat.logarithm],
        "coloraxis": "coloraxis",
        "text": cells,
        "hovertemplate": "%{text}<extra></extra>",
        "xgap": 1,
        "ygap": 1,
        "hoverongaps": False,
    }


def _colour_bar(heat: Heat) -> dict[str, Any]:
    places, text = heat.decades
    low, high = (float(np.log10(v)) for v in heat.range)
    bar = {
        "title": {"text": _text(heat.label), "side": "right"},
        "thickness": 14,
        "tickvals": places,
        "ticktext": text,
        "outlinewidth": 0.5,
    }
    return {"cmin": low, "cmax": high, "colorscale": [list(stop) for stop in heat.colours], "colorbar": bar}


def _axis(axis: Axis, ends: tuple[float, float] | None) -> dict[str, Any]:
    found: dict[str, Any] = {
        "title": {"text": _text(axis.label), "standoff": 6},
        "type": axis.scale,
        "automargin": True,
    }
    if ends is not None:
        found["range"] = [float(np.log10(v)) for v in ends] if axis.scale == "log" else list(ends)
    if axis.scale == "log" and ends is not None:
        values, text = ticks_log(*ends)
        found |= {"tickvals": values, "ticktext": text, "tickmode": "array"}
    if axis.ticks:
        found |= {
            "tickvals": [place for place, _ in axis.ticks],
            "tickmode": "array",
            # Line breaks inside a name are kept; leading ones, which stagger the names, are not needed here.
            "ticktext": [_text(word.strip("\n")).replace("\n", "<br>") for _, word in axis.ticks],
        }
    if axis.silent:
        found |= {"showticklabels": False, "title": {"text": ""}}
    return found


def _title(panel: Panel, top: float, left: float, small: bool) -> dict[str, Any]:
    return {
        "text": _text(panel.title),
        "xref": "paper",
        "yref": "paper",
        "x": left,
        "y": top,
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 11 if small else 13},
    }


def _text(text: str) -> str:
    """Text with HTML escaped, since plotly.js interprets a few tags."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
