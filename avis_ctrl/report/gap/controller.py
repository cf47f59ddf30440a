"""What the named effects do to the controller."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, hertz, level, numbered
from avis_ctrl.report.gap.finding import EffectOnController, Found, LoopOnModel
from avis_ctrl.report.pieces import Cell, Mark, Paragraph, Piece, Section, table


def controller(found: Found) -> Section | None:
    """Yesterday's controller on the updated model beside a new one; None where no design was asked for."""
    effect = found.design
    if effect is None:
        return None
    rows = [(one.controller, one.model, _yes(one.stable), _mu(one.stability_upper), _mu(one.mu_upper),
             _stated(one.modulus_margin, one.stable), _decibel(one.peak_dB, one.stable)) for one in effect.loops]
    pieces: list[Piece] = [table(
        f"Controllers of the design {effect.design}. Upper bounds of mu: below 1 the whole uncertainty set is stable "
        "(robust stability), or also performs as asked (robust performance). Margin: smallest distance of the loop "
        "from instability, 1 / max sigma(S) at the actuators. Peak: of the nominal transmissibility.",
        ("controller", "on model", "stable", "mu, stability", "mu, performance", "margin [-]", "peak [dB]"), rows,
        "llcrrrr")]
    pieces += [curves] if (curves := _curves(effect)) is not None else []
    pieces += [Paragraph(note, "note") for note in effect.notes]
    return Section("Effect on the controller", "controller", tuple(pieces))


def _curves(effect: EffectOnController) -> Figure | None:
    drawn: list[tuple[LoopOnModel, tuple[np.ndarray, np.ndarray]]] = [
        (one, one.mu_curve) for one in effect.loops if one.mu_curve is not None]
    if not drawn:
        return None
    curves = [Curve(f, mu, f"{one.controller} on the {one.model}", numbered(k))
              for k, (one, (f, mu)) in enumerate(drawn)]
    low, high = (float(pick(np.concatenate([f for _, (f, _) in drawn]))) for pick in (np.min, np.max))
    return Figure("gap_mu", "Upper bound of mu, robust performance; below 1 every plant of the set performs as asked.",
                  (Panel(hertz(low, high), Axis("mu, upper bound [-]", "log"),
                         (*curves, level(low, high, 1.0, "limit", STYLES["limit"]))),))


def _yes(stable: bool) -> Mark:
    return Mark("yes", True) if stable else Mark("NO", False)


def _mu(value: float) -> Cell:
    if np.isnan(value):
        return "not computed"
    return Mark(words.bound(value), bool(value < 1))


def _stated(value: float, stable: bool) -> str:
    return words.number(value) if stable else "none"


def _decibel(value: float, stable: bool) -> str:
    if not stable:
        return "none"
    return "not computed" if np.isnan(value) else f"{value:+.1f}".replace("-", "−")
