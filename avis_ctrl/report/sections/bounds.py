"""Bounds of mu over frequency, robust stability, and the worst plants in physical terms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Mark, Paragraph, Section, Table, listed, section, table, yes_or_no
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, controller_style, hertz, level
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.design_result import Bound, ControllerResult, DesignResult
from avis_ctrl.summary import digits_apart

BoundOf = Callable[[ControllerResult], Bound]


def bounds(result: DesignResult) -> Section:
    """mu of the weighted performance and of stability alone, and the perturbations that attain the lower bounds."""
    figures = (
        _figure(
            "mu_performance",
            result,
            lambda c: c.mu,
            "mu, performance",
            "mu of the weighted performance",
            "If it is below 1 (dashed line) at all frequencies, every plant of the uncertainty set meets every "
            "weighted requirement.",
        ),
        _figure(
            "mu_stability",
            result,
            lambda c: c.stability,
            "mu, stability",
            "mu of the uncertainty alone",
            "Below 1 the loop is stable for every plant of the set. The inverse of the peak of the upper bound is a "
            "guaranteed factor by which the uncertainty may grow.",
        ),
    )
    tables = (_stability(result), _worst(result))
    return section("Bounds of mu", "bounds", certificate(result), Paragraph(result.limits), figures, tables)


def certificate(result: DesignResult) -> Paragraph:
    """Both bounds of mu, and whether the upper one is guaranteed between the computed frequencies."""
    mu = result.controller("mu").mu
    gap = 100 * (1 - mu.lower / mu.upper) if np.isfinite(mu.upper) and mu.upper > 0 else np.nan
    between = (
        "The upper bound is guaranteed at every frequency, also between the computed points."
        if mu.guaranteed
        else "The upper bound holds at the computed frequencies; between them it is not "
        "guaranteed, although the grid was refined near every local peak."
    )
    reached = (
        f" The lower bound is attained: with uncertainties {words.number(1 / mu.lower, 4)} times as large as declared, "
        f"there is a plant whose weighted gain is {words.lower(mu.lower, 4)}."
        if np.isfinite(mu.lower) and mu.lower > 0
        else ""
    )
    return Paragraph(
        f"With the mu controller the peak of mu is between {words.lower(mu.lower, 4)} and "
        f"{words.upper(mu.upper, digits_apart(mu.upper, 1.0, 4))}, at {words.hertz(mu.omega)}"
        + (f", {words.number(gap, 2)} % apart" if np.isfinite(gap) else "")
        + f". If mu is below 1, every plant of the uncertainty set meets every weighted requirement. {between}{reached}"
    )


def _figure(name: str, result: DesignResult, bound_of: BoundOf, label: str, what: str, meaning: str) -> Figure:
    curves = []
    for c in sorted(result.controllers, key=lambda c: c.name == "passive"):
        b, style = bound_of(c), controller_style(c.name)
        order = np.argsort(b.frequencies)
        f = b.frequencies[order] / (2 * np.pi)
        curves.append(Curve(f, b.upper_curve[order], c.title, style))
        if c.name != "passive":
            curves.append(Curve(f, b.lower_curve[order], "", Style(style.colour, "dot", 0.9)))
    curves.append(level(*SETTINGS.loop_Hz, 1.0, "mu = 1"))
    finite = [float(np.max(c.y[np.isfinite(c.y)], initial=1.0)) for c in curves]
    y = Axis(label, "log", (0.05, min(max(finite) * 1.3, 30.0)))
    caption = f"Upper bounds (thick) and lower bounds (thin, dotted) of {what}. {meaning}"
    return Figure(name, caption, [Panel(hertz(SETTINGS.loop_Hz), y, curves)])


def _stability(result: DesignResult) -> Table:
    def margin(c: ControllerResult) -> str:
        upper = c.stability.upper
        return words.lower(1 / upper) if c.stable and np.isfinite(upper) and upper > 0 else "none"

    return listed(
        "Robust stability. The margin is the factor by which the whole uncertainty set may grow before the "
        "upper bound of mu reaches 1.",
        result.controllers,
        {
            "controller": lambda c: c.title,
            "mu upper": lambda c: words.upper(c.stability.upper, 4),
            "mu lower": lambda c: words.lower(c.stability.lower, 4),
            "peak at": lambda c: words.hertz(c.stability.omega),
            "margin": margin,
            "stable for the set": stable_for_the_set,
        },
        "lrrrrc",
    )


def stable_for_the_set(c: ControllerResult) -> Mark:
    """Robust stability of the loop: yes, no, or not shown if the bounds of mu do not decide."""
    if not c.stable or c.stability.lower >= 1:
        return yes_or_no(False)
    return yes_or_no(True) if c.stability.upper < 1 and c.stability.guaranteed else Mark("not shown", False)


def _worst(result: DesignResult) -> Table:
    tuned = [c for name in ("mu", "skyhook", "loops", "hinf") for c in result.controllers if c.name == name]
    cases = [
        case
        for c in tuned
        for case in (
            (f"{c.title}: mu of the weighted performance", c.mu, words.lower(c.mu.lower, 4)),
            (f"{c.title}: stability", c.stability, words.lower(c.stability.lower, 4)),
            (f"{c.title}: peak transmissibility", c.worst_peak, words.decibel(c.worst_peak.lower, "lower")),
        )
    ]
    return table(
        "The worst perturbations found, in physical terms. Each attains the lower bound beside it. Perturbations for "
        "mu have the size 1/mu: if mu is below 1, they exceed the declared uncertainty. Perturbations for the "
        "transmissibility are within it.",
        ("worst case of", "reaches", "at", "perturbation"),
        [(what, value, words.hertz(b.omega), "; ".join(b.words) or "none was found") for what, b, value in cases],
        "lrrl",
    )
