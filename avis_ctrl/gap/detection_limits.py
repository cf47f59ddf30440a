"""How large an effect would have to be to be seen: what a verdict of none is worth.

Of an effect that is linear in its parameters near none, the directions A of the score test (whitened, with everything
that re-identification absorbs projected out) are also what a fit would know them by: the covariance of the parameters
is inv(A A^T). A parameter gains the evidence that a name needs at between four and five of its standard deviations:
five are given.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.result import Detectable
from avis_ctrl.gap.score import SETTINGS, Score
from avis_ctrl.gap.table_model import active


def detection_limits(score: Score, effects: Sequence[Effect] | None = None) -> tuple[Detectable, ...]:
    """For every effect, place and parameter the departure from its value without the effect, of five standard
    deviations.

    Of effects whose parameters are all linear, each parameter with the others of its effect free; of two laws of one
    effect the larger value. One effect at a time. Infinite where re-identification absorbs a parameter.

    Parameters
    ----------
    score : at the fitted model. effects : the library where None.
    """
    model = score.model
    rows: dict[tuple[str, str, str], Detectable] = {}
    for effect in list(library().values()) if effects is None else effects:
        if effect.nonlinear and not model.motion:
            continue
        for place in effect.places(model):
            parameters = effect.parameters(model, place)
            if not parameters or not all(one.linear for one in parameters):
                continue
            std = _standard_deviations(score.of_effect(active(effect, model, place, [one.none for one in parameters])))
            for one, own in zip(parameters, std, strict=True):
                row = Detectable(effect.name, place.partition("/")[0], one.name, SETTINGS.detected * float(own),
                                 one.unit)
                key = (row.name, row.location, row.parameter)
                if key not in rows or rows[key].value < row.value:
                    rows[key] = row
    return tuple(rows.values())


def _standard_deviations(A: np.ndarray) -> np.ndarray:
    """(k,) standard deviations of the parameters behind directions A (k, N); infinite where they are not determined."""
    size = np.linalg.norm(A, axis=1)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh((A @ A.T) / np.outer(size, size))
    known = values > SETTINGS.least_eigenvalue * max(values[-1], 1e-300)
    variance = np.sum(vectors[:, known] ** 2 / values[known], axis=1) / size ** 2
    # What moves a parameter and changes nothing: there its standard deviation has no bound.
    loose = np.sum(vectors[:, ~known] ** 2, axis=1) > SETTINGS.least_left
    return np.where(loose, np.inf, np.sqrt(variance))
