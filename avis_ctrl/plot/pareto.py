"""Pareto front of points with two figures, both to be minimised."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from avis_ctrl.plot.axes import axes_of, finish

POINT, FRONT = "#56b4e9", "#0072b2"


def pareto_front(values: np.ndarray) -> np.ndarray:
    """Indices of the non-dominated points of (n, 2), sorted by the first figure.

    Equal points are all part of the front; points with a nan are not.
    """
    known = np.flatnonzero(np.all(np.isfinite(values), axis=1))
    order = known[np.lexsort(values[known].T[::-1])]
    best, last, front = np.inf, None, []
    for k in order:
        if values[k, 1] < best or (last is not None and np.array_equal(values[k], last)):
            front.append(k)
            best, last = values[k, 1], values[k]
    return np.array(front, dtype=int)


def pareto(
    values: np.ndarray, labels: Sequence[str], names: Sequence[str] = (), ax: Any = None, title: str = ""
) -> Any:
    """Plot the points (n, 2), the front as a line, and the names of the points on the front.

    labels : of both axes, with units. names : (n,) of the points. Returns the axes.
    """
    ax = axes_of(ax)
    values = np.asarray(values, dtype=float)
    front = pareto_front(values)
    known = int(np.sum(np.all(np.isfinite(values), axis=1)))
    ax.plot(*values.T, "o", markersize=4, color=POINT, label=f"{known} points")
    look = {"where": "post", "markersize": 5, "linewidth": 1.2, "color": FRONT}
    ax.step(*values[front].T, "o-", label=f"Pareto front, {front.size}", **look)
    ax.margins(0.08)
    middle = (np.nanmin(values[:, 0]) + np.nanmax(values[:, 0])) / 2 if front.size else np.nan
    for k in front if len(names) else ():
        # There are no points below and to the left of the front; near the left edge there is no room for a label.
        late = values[k, 0] > middle
        place = {"xytext": (-6, -4), "ha": "right", "va": "top"} if late else {"xytext": (6, 5)}
        ax.annotate(names[k], values[k], textcoords="offset points", fontsize="x-small", color=FRONT, **place)
    if title:
        ax.set_title(title, fontsize="medium")
    return finish(ax, labels[0], labels[1], log=False)
