"""Smallest detectable size of each effect: how much a verdict of "none" is worth.

Consider an effect that is linear in its parameters near zero strength. The directions A of its score test (whitened,
with everything that re-identification absorbs projected out) also give the covariance that its parameters would have in
a fit: inv(A A^T). Five standard deviations are reported. The evidence for a name is reached at z standard deviations,

    z^2/2 = certain + log N + log(prior standard deviation / standard deviation),    N candidates.

On an AVIS table (N = 210) this is 4.8 for a value beyond its tolerance, and 6.3 to 6.7 for any other effect.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.result import Detectable
from avis_ctrl.gap.score import SETTINGS, Score, scaled_eigh
from avis_ctrl.gap.table_model import active


def detection_limits(score: Score, effects: Sequence[Effect] | None = None) -> tuple[Detectable, ...]:
    """Detection limits: five standard deviations of every parameter, as a difference from its value without the effect.

    One row for each effect, place and parameter of effects whose parameters are all linear. One effect at a time, with
    the other parameters of the effect free. If an effect has two laws, the larger value is given. Infinite if
    re-identification absorbs a parameter.

    Parameters
    ----------
    score : at the fitted model. effects : the library if None.
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
                row = Detectable(
                    effect.name, place.partition("/")[0], one.name, SETTINGS.detected * float(own), one.unit
                )
                key = (row.name, row.location, row.parameter)
                if key not in rows or rows[key].value < row.value:
                    rows[key] = row
    return tuple(rows.values())


def _standard_deviations(A: np.ndarray) -> np.ndarray:
    """(k,) standard deviations of the parameters with directions A (k, N); infinite for undetermined parameters."""
    size, values, vectors = scaled_eigh(A @ A.T)
    known = values > SETTINGS.least_eigenvalue * max(values[-1], 1e-300)
    variance = np.sum(vectors[:, known] ** 2 / values[known], axis=1) / size**2
    # Parameters in the null space change nothing: their standard deviation is infinite.
    loose = np.sum(vectors[:, ~known] ** 2, axis=1) > SETTINGS.least_left
    return np.where(loose, np.inf, np.sqrt(variance))
