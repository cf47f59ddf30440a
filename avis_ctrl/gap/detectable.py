"""How large an effect would have to be to be seen: what a verdict of none is worth.

Of an effect that is linear in its parameters near none, the directions A of the score test (whitened, with everything
that re-identification absorbs projected out) are also what a fit would know them by: the covariance of the parameters
is inv(A A^T). The search asks that a score stand out of all candidates and that the criterion fall by
`search.LEAST_FALL`, which one parameter reaches at between four and five of its deviations: five are given.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.gap.covariance import directions
from avis_ctrl.gap.effects.base import Effect, library
from avis_ctrl.gap.result import Detectable
from avis_ctrl.gap.score import LEFT, Score
from avis_ctrl.gap.search import location
from avis_ctrl.gap.table_model import active

DEVIATIONS = 5.0


def detectable(score: Score, effects: Sequence[Effect] | None = None, stretch: float = 1.0) -> tuple[Detectable, ...]:
    """For every effect, place and parameter the departure from none of five standard deviations.

    Of effects whose parameters are all linear, each parameter with the others of its effect free; of two laws of one
    effect the larger value. One effect at a time. Infinite where re-identification absorbs a parameter.

    Parameters
    ----------
    score : at the fitted model. effects : the library where None. stretch : of variances, by which the noise may be
        larger than it was taken for.
    """
    model, deviation = score.model, DEVIATIONS * np.sqrt(stretch)
    rows: dict[tuple[str, str, str], Detectable] = {}
    for effect in list(library().values()) if effects is None else effects:
        if effect.nonlinear and not model.motion:
            continue
        for place in effect.places(model):
            parameters = effect.parameters(model, place)
            if not parameters or not all(one.linear for one in parameters):
                continue
            std = _deviations(score.of_effect(active(effect, model, place, [one.none for one in parameters])))
            for one, own in zip(parameters, std, strict=True):
                row = Detectable(effect.name, location(place), one.name, float(deviation * own), one.unit)
                key = (row.name, row.location, row.parameter)
                if key not in rows or rows[key].value < row.value:
                    rows[key] = row
    return tuple(rows.values())


def _deviations(A: np.ndarray) -> np.ndarray:
    """(k,) standard deviations of the parameters behind directions A (k, N); infinite where they are not determined."""
    B = directions(A @ A.T)
    variance = np.sum(B ** 2, axis=1)
    # What moves a parameter and changes nothing: there its deviation has no bound.
    size = np.linalg.norm(A, axis=1)
    dark = np.eye(len(A)) - B @ (B.T @ (A @ A.T))
    loose = (size == 0) | (np.abs(np.diag(dark)) > LEFT)
    return np.where(loose, np.inf, np.sqrt(variance))
