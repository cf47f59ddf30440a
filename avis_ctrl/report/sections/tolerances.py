"""Changes, in a fit, of the values of the rig file that have a tolerance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.identification.priors import Tolerance
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Piece, headed, table
from avis_ctrl.report.settings import SETTINGS


def tolerances(found: Sequence[Tolerance]) -> tuple[Piece, ...]:
    """Changes of the values: a summary of all, and a table of the largest."""
    if not found:
        return ()
    moved = np.array([one.moved for one in found])
    far = int(np.sum(np.abs(moved) > SETTINGS.far))
    rms = words.number(float(np.sqrt(np.mean(moved**2))), 2)
    rows = [
        (one.parameter, *words.with_std(one.value, one.std), words.unit(one.unit), f"{one.moved:+.2f}")
        for one in found[: SETTINGS.tolerances]
    ]
    return headed(
        "Tolerances",
        Paragraph(
            f"{len(found)} values of the rig file have a tolerance. The fit moved them by {rms} tolerances "
            f"(r.m.s.), {far or 'none'} of them by more than {SETTINGS.far:g} tolerances."
        ),
        table(
            f"The {len(rows)} values of the rig file that moved most, in units of their tolerance. The JSON file of "
            "results lists all.",
            ("parameter", "value", "± 1 σ", "unit", "moved by"),
            rows,
            "lrrlr",
        ),
    )
