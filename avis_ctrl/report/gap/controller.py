"""Influence of the named effects on the controller."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, level, places
from avis_ctrl.report.pieces import Bullets, Cell, Mark, Paragraph, Piece, Section, table, yes_or_no
from avis_ctrl.study.gap import GapFinding

if TYPE_CHECKING:
    from avis_ctrl.study.gap_design import DesignEffect, LoopFigures


def controller(found: GapFinding) -> Section | None:
    """The previous controller with both models, and a new one; None if no design was requested."""
    effect = found.design
    if effect is None:
        return None
    rows = [(who, model, *_figures(one)) for who, model, one in loops(effect)]
    pieces: list[Piece] = [Paragraph(effect.sentences[0])] if effect.sentences else []
    pieces += [
        table(
            "An upper bound of mu below 1 guarantees the specified performance for every table of the design's "
            "uncertainty set. Decibels are those of the largest singular value from floor to payload. Worst cases are "
            'upper bounds over the whole set; "unstable" means that the controller is not proved to stabilise every '
            "table of the set. Six: the nominal loop with all six coordinates, where the coordinates outside the "
            "design are not controlled.",
            (
                "controller",
                "on model",
                "stable",
                "stable in six",
                "mu, upper bound",
                "mu, lower bound",
                "peak",
                "worst peak",
                "worst in band",
            ),
            rows,
            "llccrrrrr",
        ),
        _bounds(effect),
    ]
    if effect.sentences[1:]:
        pieces.append(Bullets(tuple(effect.sentences[1:])))
    return Section("Effect on the controller", "controller", tuple(pieces))


def loops(effect: DesignEffect) -> list[tuple[str, str, LoopFigures]]:
    """Controller, model and results of the loops that were computed."""
    every = (
        ("previous", "re-identified", effect.before),
        ("previous", "updated", effect.after),
        ("new", "updated", effect.new),
    )
    return [(who, model, one) for who, model, one in every if one is not None]


def _figures(one: LoopFigures) -> tuple[Cell, ...]:
    decibels = [words.quantity(v, "dB") for v in (one.peak_dB, one.worst_peak_dB, one.worst_band_dB)]
    return (
        yes_or_no(one.stable),
        yes_or_no(one.stable_in_six),
        Mark(words.bound(one.mu_upper), bool(one.mu_upper < 1)),
        words.bound(one.mu_lower),
        *decibels,
    )


def _bounds(effect: DesignEffect) -> Figure:
    """Upper bound of mu of each loop as a bar; an unstable loop has no bar."""
    drawn = loops(effect)
    mu = np.array([one.mu_upper for _, _, one in drawn])
    place, axis = places([f"{who} on\n{model}" for who, model, _ in drawn])
    lost = " A loop without a bar is not stable." if not np.isfinite(mu).all() else ""
    top = 1.15 * max(1.0, float(np.max(mu[np.isfinite(mu)], initial=0.0)))
    bars = Curve(
        place, np.where(np.isfinite(mu), mu, np.nan), "upper bound of mu", Style("#8fbbdc"), line=False, bars=0.5
    )
    return Figure(
        "gap_mu",
        "Upper bound of mu (robust performance) of each controller with each model; below 1 the "
        f"specified performance is guaranteed for every table of the set.{lost}",
        (
            Panel(
                axis,
                Axis("mu, upper bound [-]", "linear", (0.0, top)),
                (bars, level(-0.5, len(mu) - 0.5, 1.0, "limit")),
            ),
        ),
        height=0.7,
    )
