"""Influence of the named effects on the controller."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Mark, Paragraph, Section, listed, section, yes_or_no
from avis_ctrl.report.figures import Axis, Figure, Panel, Style, bars, level, places

if TYPE_CHECKING:
    from avis_ctrl.study.gap_design import DesignEffect, LoopFigures


def controller(effect: DesignEffect) -> Section:
    """The controller designed on the re-identified model, with both models; that designed on the updated model."""
    judged = listed(
        "An upper bound of mu below 1 guarantees the specified performance for every table of the design's "
        "uncertainty set. Decibels are those of the largest singular value from floor to payload. Worst cases are "
        'upper bounds over the whole set; "no bound" means that the controller is not proved to stabilise every '
        "table of the set. All axes: the nominal loop with all six coordinates, where the coordinates outside the "
        "design are not controlled.",
        loops(effect),
        {
            "controller designed on": lambda loop: loop.controller,
            "with model": lambda loop: loop.model,
            "stable": lambda loop: yes_or_no(loop.figures.stable),
            "stable, all axes": lambda loop: yes_or_no(loop.figures.stable_in_six),
            "mu, upper bound": lambda loop: Mark(words.upper(loop.figures.mu_upper), bool(loop.figures.mu_upper < 1)),
            "mu, lower bound": lambda loop: words.lower(loop.figures.mu_lower),
            "peak": lambda loop: words.quantity(loop.figures.peak_dB, "dB"),
            "worst peak": lambda loop: words.quantity(loop.figures.worst_peak_dB, "dB", side="upper"),
            "worst in band": lambda loop: words.quantity(loop.figures.worst_band_dB, "dB", side="upper"),
        },
        "llccrrrrr",
    )
    first, further = map(Paragraph, effect.sentences[:1]), Bullets(effect.sentences[1:])
    return section("Influence on the controller", "controller", first, judged, _bounds(effect), further)


class Loop(NamedTuple):
    """The model that the controller was designed on, the model in the loop, and the figures of this loop."""

    controller: str
    model: str
    figures: LoopFigures


def loops(effect: DesignEffect) -> list[Loop]:
    """The loops that were computed."""
    every = (
        ("re-identified", "re-identified", effect.before),
        ("re-identified", "updated", effect.after),
        ("updated", "updated", effect.new),
    )
    return [Loop(who, model, one) for who, model, one in every if one is not None]


def _bounds(effect: DesignEffect) -> Figure:
    """Upper bound of mu of each loop as a bar; an unstable loop has no bar."""
    drawn = loops(effect)
    mu = np.array([one.figures.mu_upper for one in drawn])
    place, axis = places([f"{one.controller},\nwith {one.model}" for one in drawn])
    lost = (
        " A loop without a bar has no finite bound: its stability is not proved for the whole set."
        if not np.isfinite(mu).all()
        else ""
    )
    top = 1.15 * max(1.0, float(np.max(mu[np.isfinite(mu)], initial=0.0)))
    limit = level(-0.5, len(mu) - 0.5, 1.0, "limit")
    drawn_mu = bars(place, mu, "upper bound of mu", Style("#8fbbdc"), 0.5)
    return Figure(
        "gap_mu",
        "Upper bound of mu (robust performance) of each loop: the model that the controller was designed on, "
        "with the model in the loop; below 1 the "
        f"specified performance is guaranteed for every table of the set.{lost}",
        [Panel(axis, Axis("mu, upper bound [-]", "linear", (0.0, top)), [drawn_mu, limit])],
        height=0.7,
    )
