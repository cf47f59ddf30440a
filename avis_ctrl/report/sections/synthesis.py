"""History of the mu synthesis."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, level, numbered
from avis_ctrl.report.pieces import Paragraph, Section, table
from avis_ctrl.study.design_result import DesignResult


def synthesis(result: DesignResult) -> Section:
    """Each iteration of the mu synthesis."""
    history = result.dk_history
    if not history:
        return Section("D-K iteration", "synthesis", (Paragraph("No iteration was run."),))
    rows = [
        (
            str(h.iteration),
            h.kind,
            words.bound(h.gamma, 4),
            words.bound(h.mu_upper, 4),
            str(h.order),
            str(h.d_order),
            f"{words.number(100 * h.d_fit_error, 2)} %",
            f"{words.number(h.seconds, 2)} s",
        )
        for h in history
    ]
    steps = np.array([h.iteration for h in history], float)
    marked = Axis("iteration", "linear", (steps[0] - 0.5, steps[-1] + 0.5))
    gamma, mu = np.array([h.gamma for h in history]), np.array([h.mu_upper for h in history])
    both = np.concatenate([gamma, mu])
    both = both[np.isfinite(both) & (both > 0)]
    low, top = float(np.min(both, initial=1.0)), float(np.max(both, initial=1.0))
    # The first gamma, before any scaling, is often a hundred times the final one.
    shown = (
        Axis("gamma, mu", "log", (0.7 * low, 1.5 * top))
        if top > 8 * low
        else Axis("gamma, mu", "linear", (0.0, 1.1 * top))
    )
    values = Panel(
        marked,
        shown,
        (
            Curve(steps, gamma, "gamma of the scaled loop", numbered(1), points=True),
            Curve(steps, mu, "peak of the upper bound of mu", STYLES["mu"], points=True),
            level(steps[0] - 0.5, steps[-1] + 0.5, 1.0, "limit 1"),
        ),
    )
    order = np.array([h.order for h in history], float)
    orders = Panel(
        marked,
        Axis("states", "linear", (0.0, 1.15 * float(order.max()))),
        (
            Curve(steps, order, "states of the controller", STYLES["plain"], points=True),
            Curve(
                steps, np.array([h.d_order for h in history], float), "states of the scalings", numbered(3), points=True
            ),
        ),
    )
    total = sum(h.seconds for h in history)
    caption = (
        f"Course of the mu synthesis: {len(history)} iterations in {words.number(total)} s. gamma is the norm "
        "of the scaled loop, an upper bound of mu with every block taken as complex."
    )
    return Section(
        "D-K iteration",
        "synthesis",
        (
            table(
                'The iterations. Kind: "H-infinity", "nominal" (plant without uncertainty) and "given" (a controller '
                "for comparison) are initial controllers. Each later step is an H-infinity synthesis with scalings D: "
                '"D-K" fits them to the last loop, "start" restarts from the best constant ones, "descent" changes '
                'them so that gamma falls, "growth" does so with scalings of higher order. Fit: by how much '
                "the rational scalings D(s) raise the bound, compared with the best scalings at each frequency. The "
                "controller with the smallest mu is used.",
                ("step", "kind", "gamma", "mu upper", "order", "order of D", "fit", "time"),
                rows,
                "rlrrrrrr",
            ),
            Figure("dk_history", caption, (values, orders), 2),
        ),
    )
