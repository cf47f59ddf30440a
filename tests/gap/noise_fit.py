"""A table model fitted to blocks by their noise alone: least squares without tolerances and path errors."""

from __future__ import annotations

import numpy as np

from avis_ctrl.identification.maximum_likelihood import LikelihoodFit, fit


def fitted(model, blocks, iterations=20) -> LikelihoodFit:
    return fit(model, blocks, model.priors, max_iterations=iterations)


def reported(found):
    """Parameters of the first effect with standard deviations by the information of the fit."""
    one, names = found.model.effects[0], found.model.names
    size = np.sqrt(np.diag(found.information.matrix))
    w, V = np.linalg.eigh(found.information.matrix / np.outer(size, size))
    # Information below round-off is none: an inverse would give negative variances.
    whole = (V / np.maximum(w, len(w) * np.finfo(float).eps * w[-1])) @ V.T / np.outer(size, size)
    rows = [names.index(name) for name in one.names]
    return one.effect.reported(found.model, one.place, one.by_name, whole[np.ix_(rows, rows)])
