"""How far each value of the rig file with a tolerance moved in a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.identification.priors import Tolerance
from avis_ctrl.report import words
from avis_ctrl.report.pieces import Fold, Paragraph, Piece, table

_HEADER = ("parameter", "value", "± 1 σ", "unit", "moved by")


@dataclass(frozen=True)
class Shown:
    """How many rows are shown at once, and from how many tolerances on a value counts as far from the rig file."""

    rows: int = 10
    far: float = 3.0


def tolerances(found: Sequence[Tolerance], shown: Shown = Shown()) -> list[Piece]:
    """Table of all values, the largest movement first; those after the first rows are folded."""
    moved = np.array([one.moved for one in found])
    far = int(np.sum(np.abs(moved) > shown.far))
    rms = words.number(float(np.sqrt(np.mean(moved ** 2))), 2)
    rows = [_row(one) for one in found]
    first, rest = rows[:shown.rows], rows[shown.rows:]
    pieces: list[Piece] = [
        Paragraph(f"{len(rows)} values of the rig file have a tolerance. The fit moved them by {rms} tolerances "
                  f"(r.m.s.), {far or 'none'} of them by more than {shown.far:g} tolerances."),
        table("The values of the rig file that moved most, in units of their tolerance.", _HEADER, first, "lrrlr")]
    if rest:
        pieces.append(Fold(f"{len(rest)} more tolerances", (table("The other values.", _HEADER, rest, "lrrlr"),)))
    return pieces


def _row(one: Tolerance) -> tuple[str, ...]:
    value, sigma = words.with_std(one.value, one.std)
    return one.parameter, value, f"± {sigma}", words.unit(one.unit), f"{one.moved:+.1f}".replace("-", "−")
