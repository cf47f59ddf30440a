"""Score test of effects at a fitted model: the fall of the penalised sum of squares that a small effect would bring.

Priors are rows of their own below the residuals: e = (e, -z), J = (J, I). A direction of an effect has zeros there.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from avis_ctrl.gap.score import Part, Score
from avis_ctrl.gap.settings import SETTINGS, GapSettings
from avis_ctrl.identification.likelihood import Data, Fitted
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.weights import with_distortion


class EvidenceScore(Score):
    """`gap.score.Score` with path errors integrated out and normal priors on all parameters."""

    def __init__(self, fitted: Fitted, data: Data, settings: GapSettings = SETTINGS):
        full = fitted.model
        # What an effect fits by itself, to find where to begin, leaves the tolerances where they are.
        rig = tuple(name for name in full.base.names if name in default_parameters(full.rig))
        nominal = full.nominal and replace(full.nominal, names=rig)
        self.model, self.kept = replace(full, base=replace(full.base, names=rig), nominal=nominal), {}
        blocks = [with_distortion(block, level, fitted.variances, settings)
                  for block, level in zip(data.blocks, data.levels, strict=True)]
        self.parts = [Part(self.model, block) for block in blocks]
        self.weights = fitted.weights
        # Orthonormal rows that span the Jacobian with its priors.
        root = np.linalg.cholesky(np.linalg.inv(fitted.covariance))
        self.basis = solve_triangular(root, np.concatenate([fitted.J, np.eye(len(fitted.z))], axis=1), lower=True)
        self.e = np.concatenate([fitted.e, -fitted.z])
        self.e = self.e - self.basis.T @ (self.basis @ self.e)

    @cached_property
    def plain(self) -> Score:
        """The same against noise and distortion alone, for effects that look for their beginning by fits of their own:
        there what has no name is not taken out."""
        return Score(self.model, [part.block for part in self.parts])

    def directions(self, dY):
        A = np.concatenate([part.real(one) for part, one in zip(self.parts, dY, strict=True)], axis=1)
        A = np.concatenate([self.weights.flatten(A), np.zeros((len(A), len(self.basis)))], axis=1)
        return A - (A @ self.basis.T) @ self.basis
