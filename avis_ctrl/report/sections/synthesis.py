"""History of the mu synthesis."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Section, listed, section
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, level, log_limits, numbered
from avis_ctrl.study.design_result import DesignResult


def synthesis(result: DesignResult) -> Section:
    """Each iteration of the mu synthesis."""
    history = result.dk_history
    iterations = listed(
        'The iterations. Kind: "H-infinity", "nominal" (plant without uncertainty) and "given" (a controller '
        "for comparison) are initial controllers. Each later step is an H-infinity synthesis with scalings D: "
        '"D-K" fits them to the last loop, "start" restarts from the best constant ones, "descent" changes '
        'them so that gamma falls, "growth" does so with scalings of higher order. Fit error: increase of the upper '
        "bound caused by fitting rational scalings D(s) to the best scalings at each frequency. The controller with "
        "the smallest mu is used.",
        history,
        {
            "step": lambda h: str(h.iteration),
            "kind": lambda h: h.kind,
            "gamma": lambda h: words.bound(h.gamma, 4),
            "mu upper": lambda h: words.upper(h.mu_upper, 4),
            "order": lambda h: str(h.order),
            "order of D": lambda h: str(h.d_order),
            "fit error": lambda h: f"{words.number(100 * h.d_fit_error, 2)} %",
            "time": lambda h: f"{words.number(h.seconds, 2)} s",
        },
        "rlrrrrrr",
    )
    steps, gamma, mu, order, d_order = (
        np.array([getattr(h, name) for h in history], float)
        for name in ("iteration", "gamma", "mu_upper", "order", "d_order")
    )
    ends = (steps[0] - 0.5, steps[-1] + 0.5)
    low, top = log_limits(np.append(gamma, mu), 1.0, 1.0, (1.0, 1.0))
    low, top = min(low, 1.0), max(top, 1.0)
    # The first gamma, before any scaling, is often a hundred times the final one.
    wide = top > 8 * low
    values = Panel(
        Axis("iteration", "linear", ends),
        Axis("gamma, mu", "log", (0.7 * low, 1.5 * top)) if wide else Axis("gamma, mu", "linear", (0.0, 1.1 * top)),
        (
            Curve(steps, gamma, "gamma of the scaled loop", numbered(1), points=True),
            Curve(steps, mu, "peak of the upper bound of mu", STYLES["mu"], points=True),
            level(*ends, 1.0, "limit 1"),
        ),
    )
    orders = Panel(
        Axis("iteration", "linear", ends),
        Axis("states", "linear", (0.0, 1.15 * float(order.max()))),
        (
            Curve(steps, order, "states of the controller", STYLES["plain"], points=True),
            Curve(steps, d_order, "states of the scalings", numbered(3), points=True),
        ),
    )
    caption = (
        f"Course of the mu synthesis: {len(history)} iterations in {words.number(sum(h.seconds for h in history))} s. "
        "gamma is the norm of the scaled loop, an upper bound of mu with every block taken as complex."
    )
    course = Figure("dk_history", caption, (values, orders), 2)
    return section("D-K iteration", "synthesis", iterations, course)
