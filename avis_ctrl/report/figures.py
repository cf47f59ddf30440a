"""Figures described as data, so that all backends draw the same curves with the same labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Dash = Literal["solid", "dash", "dot", "dashdot"]
Scale = Literal["linear", "log"]


@dataclass(frozen=True)
class Style:
    """Line style. The colours are those of Okabe and Ito, which colour-blind readers can distinguish."""

    colour: str
    dash: Dash = "solid"
    width: float = 1.6


STYLES: dict[str, Style] = {
    "passive": Style("#7a7a7a", "dot", 1.8),
    "skyhook_classical": Style("#56b4e9", "dashdot"),
    "skyhook": Style("#e69f00", "dash", 2.0),
    "loops": Style("#d55e00", "dash"),
    "hinf": Style("#009e73", "dashdot", 1.8),
    "mu": Style("#0072b2", "solid", 2.4),
    "limit": Style("#b3261e", "dash", 1.4),
    "filter": Style("#cc79a7", "solid", 1.6),
    "plain": Style("#222222", "solid", 1.6),
    "faint": Style("#9a9a9a", "solid", 0.9),
}


def controller_style(name: str) -> Style:
    """Style of a controller, the same in every figure."""
    return STYLES.get(name, STYLES["plain"])


PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#222222", "#7a7a7a")
DASHES: tuple[Dash, ...] = ("solid", "dash", "dashdot", "dot")


def numbered(k: int) -> Style:
    """Style of the k-th of several similar curves."""
    return Style(PALETTE[k % len(PALETTE)], DASHES[k % len(DASHES)], 1.6)


@dataclass(frozen=True)
class Axis:
    """An axis: label with unit, scale and range (None: from the data).

    ticks : (position, text) in place of numbers. silent : no labels, only grid lines; a neighbouring panel has them.
    """

    label: str
    scale: Scale = "linear"
    range: tuple[float, float] | None = None
    ticks: tuple[tuple[float, str], ...] = ()
    silent: bool = False


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve x, y (n,). Values that are not finite leave a gap; a curve with an empty label is not in the legend.

    error : (n,) half-lengths of the error bars in the direction `along`. bars : width of bars drawn from the axis, 0
    for none. hollow : open markers.
    """

    x: np.ndarray
    y: np.ndarray
    label: str
    style: Style
    points: bool = False
    line: bool = True
    error: np.ndarray | None = None
    along: Literal["x", "y"] = "y"
    bars: float = 0.0
    hollow: bool = False


def markers(x: np.ndarray, y: np.ndarray, label: str, style: Style, **more: Any) -> Curve:
    """A curve of markers without a line; more : further fields."""
    return Curve(x, y, label, style, points=True, line=False, **more)


def bars(x: np.ndarray, y: np.ndarray, label: str, style: Style, width: float) -> Curve:
    """Bars drawn from the axis; a value that is not finite has none."""
    return Curve(x, np.where(np.isfinite(y), y, np.nan), label, style, line=False, bars=width)


@dataclass(frozen=True, eq=False)
class Band:
    """The area between low and high over x (n,)."""

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    label: str
    style: Style


@dataclass(frozen=True, eq=False)
class Heat:
    """A heat map on a logarithmic colour scale; cells that are not finite and positive are grey.

    x_edges : (n + 1,). z : (rows, n), the rows at y = 0, 1, 2 ... label : of the colour bar. range : (lowest, highest)
    value of the colours, blue and dark brown, the same in all panels of a figure; 1 is drawn in white.
    """

    x_edges: np.ndarray
    z: np.ndarray
    label: str
    range: tuple[float, float]

    @property
    def logarithm(self) -> np.ndarray:
        """(rows, n) log10 z; nan where z is not finite and positive."""
        known = np.isfinite(self.z) & (self.z > 0)
        return np.where(known, np.log10(np.where(known, self.z, 1.0)), np.nan)

    @property
    def colours(self) -> list[tuple[float, str]]:
        """Stops of the colour scale: position on the logarithmic scale, 0 to 1, and colour."""
        low, high = (float(np.log10(v)) for v in self.range)
        white = -low / (high - low)
        return [
            (0.0, "#9ecae1"),
            (white, "#ffffff"),
            *((white + share * (1 - white), colour) for share, colour in WARM),
        ]

    @property
    def decades(self) -> tuple[list[float], list[str]]:
        """Ticks of the colour bar in log10 z, and their labels."""
        places, text = ticks_log(*self.range)
        return [float(np.log10(p)) for p in places], text


# Fractions of the way from white to the top of the colour scale. Lightness falls steadily: it also works in grey.
WARM = ((0.25, "#fed98e"), (0.5, "#fe9929"), (0.75, "#cc4c02"), (1.0, "#662506"))
NO_DATA = "#d9d9d9"


@dataclass(frozen=True, eq=False)
class Panel:
    """One pair of axes."""

    x: Axis
    y: Axis
    curves: Sequence[Curve]
    bands: Sequence[Band] = ()
    title: str = ""
    heat: Heat | None = None


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels in at most `columns` columns, filled row by row, with one legend and a caption.

    height : of a panel, relative to the default. shared : the panels of a row or column have the same scales and are
    placed close together.
    """

    name: str
    caption: str
    panels: Sequence[Panel]
    columns: int = 1
    height: float = 1.0
    shared: bool = False

    def grid(self) -> tuple[int, int]:
        """Number of rows and columns of panels."""
        columns = min(self.columns, len(self.panels))
        return -(-len(self.panels) // columns), columns

    def legend(self) -> list[str]:
        """Labels of the legend, each once, in order."""
        labels: dict[str, None] = {}
        for panel in self.panels:
            labels |= dict.fromkeys([curve.label for curve in panel.curves] + [band.label for band in panel.bands])
        return [label for label in labels if label]

    def heat(self) -> Heat | None:
        """The first heat map, whose colour bar applies to all panels."""
        return next((panel.heat for panel in self.panels if panel.heat is not None), None)


def hertz(range_Hz: tuple[float, float] | None = None) -> Axis:
    """Logarithmic frequency axis over a range [Hz], by default that of the data."""
    return Axis("frequency [Hz]", "log", range_Hz)


def places(names: Sequence[str], label: str = "") -> tuple[np.ndarray, Axis]:
    """Positions 0, 1, 2 ... (n,) of names, and the axis labelled with the names."""
    x = np.arange(len(names), dtype=float)
    return x, Axis(label, "linear", (-0.6, len(names) - 0.4), tuple(zip(x.tolist(), names, strict=True)))


def steps(edges: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) of the bands between edges (n + 1,) as a staircase curve."""
    return np.repeat(edges, 2)[1:-1], np.repeat(np.asarray(values, float), 2)


def level(low: float, high: float, value: float, label: str, style: Style = STYLES["limit"]) -> Curve:
    """A horizontal line from x = low to high."""
    return Curve(np.array([low, high]), np.array([value, value]), label, style)


def ticks_log(low: float, high: float) -> tuple[list[float], list[str]]:
    """Ticks and labels of a logarithmic axis: decades, with 2 and 5 if there are few decades."""
    first, last = int(np.floor(np.log10(low) + 1e-9)), int(np.ceil(np.log10(high) - 1e-9))
    steps = (1, 2, 5) if last - first <= 2 else (1,)
    stride = 1 if last - first <= 8 else 2
    places = [m * 10.0**d for d in range(first, last + 1, stride) for m in steps]
    shown = [p for p in places if low * (1 - 1e-9) <= p <= high * (1 + 1e-9)]
    return shown, [f"{p:g}" if 1e-3 <= p <= 1e4 else f"{p:.0e}".replace("e-0", "e-").replace("e+0", "e") for p in shown]


def log_limits(
    values: np.ndarray, below: float, above: float, default: tuple[float, float] = (0.1, 10.0), quantile: float = 0.0
) -> tuple[float, float]:
    """Range of a logarithmic axis for the positive values; `default` without any.

    below : factor on the smallest value, or on a quantile of the values. above : factor on the largest value.
    """
    kept = values[np.isfinite(values) & (values > 0)]
    return (below * float(np.quantile(kept, quantile)), above * float(kept.max())) if kept.size else default


def limits(panel: Panel, which: Literal["x", "y"]) -> tuple[float, float] | None:
    """Range of an axis of a panel; of a logarithmic one without a range, that of the data: y with a margin, x without.

    None : the renderer chooses the range.
    """
    axis: Axis = getattr(panel, which)
    if axis.range is not None or axis.scale == "linear":
        return axis.range
    if which == "x":
        return log_limits(values_of(panel, "x"), 1.0, 1.0)
    return log_limits(values_of(panel, "y"), 1 / 1.3, 1.3)


def values_of(panel: Panel, which: Literal["x", "y"]) -> np.ndarray:
    """All values of the curves, error bars and bands of a panel along an axis."""
    values = [getattr(curve, which) for curve in panel.curves]
    for c in panel.curves:
        if c.error is not None and c.along == which:
            values += [getattr(c, which) - c.error, getattr(c, which) + c.error]
    for band in panel.bands:
        values += [band.x] if which == "x" else [band.low, band.high]
    values += [panel.heat.x_edges] if panel.heat is not None and which == "x" else []
    return np.concatenate([np.asarray(v, float) for v in values] or [np.zeros(0)])
