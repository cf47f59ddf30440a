"""Figures as interactive graphs for the HTML report: plain JSON for plotly.js, no Python objects of plotly."""

from __future__ import annotations

import base64
import gzip
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from avis_ctrl.report.figures import Axis, Band, Curve, Figure, Panel, log_range, ticks_log

PANEL_PX, LEGEND_ROW_PX = 300, 22


def graph(figure: Figure) -> dict[str, Any]:
    """Traces and layout of a figure, as plotly.js takes them."""
    count, traces = len(figure.panels), []
    layout: dict[str, Any] = {"height": PANEL_PX * count + 90 + LEGEND_ROW_PX * (len(figure.legend()) // 3),
                              "annotations": [], "showlegend": len(figure.legend()) > 1}
    shown: set[str] = set()
    gap = 0.26 / count if count > 1 else 0.0
    for k, panel in enumerate(figure.panels):
        suffix = "" if k == 0 else str(k + 1)
        top = 1.0 - k * (1.0 + gap) / count
        domain = [max(0.0, top - (1.0 + gap) / count + gap), top]
        layout[f"xaxis{suffix}"] = {**_axis(panel.x, panel.x.range), "anchor": f"y{suffix}"}
        limits = log_range(panel) if panel.y.scale == "log" else panel.y.range
        layout[f"yaxis{suffix}"] = {**_axis(panel.y, limits), "anchor": f"x{suffix}", "domain": domain}
        if panel.title:
            layout["annotations"].append(_title(panel, domain[1]))
        things: list[Band | Curve] = [*panel.bands, *panel.curves]
        for thing in things:
            drawn = _band(thing) if isinstance(thing, Band) else [_curve(thing)]
            for trace in drawn:
                in_legend = bool(thing.label) and trace.pop("key") and thing.label not in shown
                shown.update([thing.label] if in_legend else [])
                traces.append({**trace, "xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "showlegend": in_legend})
    return {"data": traces, "layout": layout}


@cache
def library() -> str:
    """plotly.js of the installed plotly package, gzip in base64: a third of its size, unpacked by the browser."""
    code = (resources.files("plotly") / "package_data" / "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(code, 9, mtime=0)).decode()


def _numbers(values: np.ndarray) -> list[float | None]:
    """Six digits are more than a screen shows; what is not finite is a gap."""
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in np.asarray(values, float)]


def _curve(curve: Curve) -> dict[str, Any]:
    mode = "+".join(["lines"] * curve.line + ["markers"] * curve.points)
    return {"type": "scatter", "mode": mode, "x": _numbers(curve.x), "y": _numbers(curve.y), "name": _text(curve.label),
            "legendgroup": curve.label, "key": True, "marker": {"size": 6, "color": curve.style.colour},
            "line": {"color": curve.style.colour, "dash": curve.style.dash, "width": curve.style.width}}


def _band(band: Band) -> list[dict[str, Any]]:
    edge = {"type": "scatter", "mode": "lines", "x": _numbers(band.x), "line": {"width": 0, "color": band.style.colour},
            "hoverinfo": "skip", "legendgroup": band.label, "name": _text(band.label)}
    red, green, blue = (int(band.style.colour[k:k + 2], 16) for k in (1, 3, 5))
    return [{**edge, "y": _numbers(band.low), "key": False},
            {**edge, "y": _numbers(band.high), "fill": "tonexty", "key": True,
             "fillcolor": f"rgba({red},{green},{blue},0.25)"}]


def _axis(axis: Axis, limits: tuple[float, float] | None) -> dict[str, Any]:
    found: dict[str, Any] = {"title": {"text": _text(axis.label), "standoff": 6}, "type": axis.scale,
                             "automargin": True}
    if limits is not None:
        found["range"] = [float(np.log10(v)) for v in limits] if axis.scale == "log" else list(limits)
    if axis.scale == "log" and limits is not None:
        values, text = ticks_log(*limits)
        found |= {"tickvals": values, "ticktext": text, "tickmode": "array"}
    return found


def _title(panel: Panel, top: float) -> dict[str, Any]:
    return {"text": _text(panel.title), "xref": "paper", "yref": "paper", "x": 0, "y": top, "xanchor": "left",
            "yanchor": "bottom", "showarrow": False, "font": {"size": 13}}


def _text(text: str) -> str:
    """plotly.js reads a few HTML tags in its texts; none is meant."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
