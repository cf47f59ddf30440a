"""Helpers shared by the plots."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError

HERTZ = 2 * np.pi


@dataclass(frozen=True)
class LegendSettings:
    """label : longest label [characters] with which a legend above the axes has two columns; two longer ones are wider
    than a figure of 6.4 inches.
    """

    label: int = 38


SETTINGS = LegendSettings()


def axes_of(given: Any, rows: int = 1) -> Any:
    """The given axes, or those of a new figure: a single one, or an array of `rows` stacked axes with a common x axis.

    Raises InputError if `rows` is larger than 1 and another number of axes is given.
    """
    if given is None:
        from matplotlib import pyplot as plt

        _, made = plt.subplots(rows, 1, sharex=True, figsize=(6.4, 2.2 + 2.2 * rows), layout="constrained")
        return made
    if rows > 1 and np.size(given) != rows:
        raise InputError(f"expected {rows} axes", field="ax", value=np.size(given))
    return given


def png(draw: Callable[[Any], Any], width: float, height: float) -> bytes:
    """A plot as the bytes of a PNG file. draw : draws into the axes that it receives. width, height : in inches."""
    from matplotlib.figure import Figure

    file, figure = io.BytesIO(), Figure(figsize=(width, height), layout="constrained")
    draw(figure.add_subplot())
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()


def finish(ax: Any, x: str, y: str, log: bool = True, above: bool = False) -> Any:
    """Add labels, a light grid and, if any curve has a label, a legend inside or above the axes."""
    if log:
        ax.set_xscale("log")
    if x:
        ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(True, which="major", linewidth=0.5, color="#d8d8d8")
    ax.set_axisbelow(True)
    if labels := ax.get_legend_handles_labels()[1]:
        columns = 2 if max(map(len, labels)) <= SETTINGS.label else 1
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": columns} if above else {}
        ax.legend(fontsize="small", framealpha=0.85, edgecolor="none", **place)
    return ax


def limit_line(ax: Any, value: float, label: str, **line: Any) -> None:
    """A thin horizontal line, red unless stated otherwise."""
    ax.axhline(value, label=label, **{"color": "#b3261e", "linewidth": 0.9, **line})


def log_if_wide(ax: Any, values: np.ndarray) -> None:
    """Make the y axis logarithmic, with labels at 1, 2 and 5 of each decade, if the values span more than a decade."""
    if values.max() <= 10 * values.min():
        return
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def whole_numbers(ax: Any) -> None:
    """Integer ticks on the x axis."""
    from matplotlib.ticker import MaxNLocator

    ax.set_xscale("linear")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
