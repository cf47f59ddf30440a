"""Full refits of a candidate with all parameters of the rig, and what they leave of data that no fit has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.covariance import clustered, directions, widest
from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.maximum_likelihood import LikelihoodFit, fit
from avis_ctrl.identification.prediction_error import prediction_error
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import SpectralBlock

MOST_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Refit:
    """A model fitted to `fitted` blocks, and its chi-square on `held_out` ones.

    free : how many combinations of parameters the data determine.
    robust : (n_p, n_p) covariance of the parameters by the score's scatter (`gap.covariance`), where it was computed.
    """

    model: TableModel
    fit: LikelihoodFit
    chi2_held: float
    dof_held: int
    robust: np.ndarray | None = None

    @property
    def chi2_fit(self) -> float:
        return self.fit.chi2

    @property
    def free(self) -> int:
        return self.fit.information.rank

    @property
    def excess_fit(self) -> float:
        """Chi-square of the fitted data over what noise alone would leave of them with these parameters held."""
        return self.chi2_fit - self.fit.dof - self.free

    @property
    def excess_held(self) -> float:
        """Chi-square of the held-out data over what noise alone is expected to leave of them."""
        return self.chi2_held - self.dof_held

    @property
    def held_per_dof(self) -> float:
        return self.chi2_held / self.dof_held

    @property
    def misfit(self) -> float:
        """How many times the noise's power the model leaves, of fitted or of held-out data; one at least."""
        return max(1.0, self.fit.chi2_per_dof, self.held_per_dof)

    @property
    def criterion(self) -> float:
        """-2 log of the evidence, up to a constant: Bayesian information criterion of the fit (G. Schwarz 1978), and
        the held-out data, which need no penalty.

        Of both without their degrees of freedom: a model that holds states inside has more unknowns in the transients
        of the records' ends, and noise alone makes chi-square less by one for each.
        """
        return self.excess_fit + self.free * np.log(self.fit.dof + self.free) + self.excess_held

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(one.label for one in self.model.effects)

    @cached_property
    def _of_noise(self) -> np.ndarray:
        """(n_p, n_p) of the parameters by noise alone; directions that the data do not determine left out."""
        information = self.fit.information
        B = directions(information.relative) * information.scale[:, None]
        return B @ B.T

    @cached_property
    def covariance(self) -> np.ndarray:
        """(n_p, n_p) of the parameters, units as theirs: of noise and, where it is known, of the score's scatter."""
        return self.widened(1.0)

    def widened(self, inflation: float) -> np.ndarray:
        """The same with that of noise times a factor."""
        made = [self._of_noise * inflation]
        return widest(made if self.robust is None else [*made, self.robust])

    def covariance_of(self, effect: ActiveEffect, inflation: float = 1.0) -> np.ndarray:
        """(n, n) of an effect's parameters, zero for those that are held."""
        names, whole = self.model.names, self.widened(inflation)
        rows = [names.index(name) if name in names else -1 for name in effect.names]
        C = np.zeros((len(rows), len(rows)))
        for i, a in enumerate(rows):
            for j, b in enumerate(rows):
                if a >= 0 and b >= 0:
                    C[i, j] = whole[a, b]
        return C

    def reported(self, effect: ActiveEffect, inflation: float = 1.0) -> dict[str, Reported]:
        """Parameters of one of its effects, as a person reads them; the covariance of noise times `inflation`."""
        return effect.effect.reported(self.model, effect.place, effect.by_name, self.covariance_of(effect, inflation))

    def implausible(self) -> str:
        """Why physics forbids the values of some effect; empty where it does not."""
        return next((reason for one in self.model.effects if (reason := self.forbidden(one))), "")

    def forbidden(self, one: ActiveEffect) -> str:
        """Why physics forbids the values of an effect; empty where it does not."""
        std = np.sqrt(np.maximum(np.diag(self.covariance_of(one)), 0))
        return one.effect.implausible(one.by_name, dict(zip((p.name for p in one.parameters), std, strict=True))) or \
            at_the_edge(one)


@dataclass(frozen=True, eq=False)
class Reached:
    """A refit without its model, small enough to come back from another process; theta are its free parameters."""

    theta: np.ndarray
    fit: LikelihoodFit
    chi2_held: float
    dof_held: int

    @staticmethod
    def by(found: Refit | None) -> Reached | None:
        if found is None:
            return None
        bare = replace(found.fit, model=cast(ResponseModel, None), residuals=())
        return Reached(found.model.values, bare, found.chi2_held, found.dof_held)

    def refit(self, begin: TableModel) -> Refit:
        """With the model that was fitted, as it was before."""
        model = begin.at(self.theta)
        return Refit(model, replace(self.fit, model=cast(ResponseModel, model)), self.chi2_held, self.dof_held)


def at_the_edge(effect: ActiveEffect) -> str:
    """A shape parameter that ran to the end of what physics allows: the effect has turned into something else."""
    for parameter, value in zip(effect.parameters, effect.values, strict=True):
        span = parameter.high - parameter.low
        if not parameter.linear and not parameter.optional and (value > parameter.high - 1e-6 * span
                                                                or value < parameter.low + 1e-6 * span):
            return (f"{parameter.name} of {effect.effect.name} runs to {value:.3g} {parameter.unit}, the end of its "
                    "range")
    return ""


def refit(model: TableModel, fitted: Sequence[SpectralBlock], held_out: Sequence[SpectralBlock],
          iterations: int = MOST_ITERATIONS) -> Refit:
    """Fit all free parameters of a model from where they are.

    Raises
    ------
    InputError, ComputationError : as `fit`.
    """
    return judged(likelihood(model, fitted, iterations), held_out)


def likelihood(model: TableModel, fitted: Sequence[SpectralBlock], iterations: int) -> LikelihoodFit:
    """`identification.fit` of a table model, which has all that it asks of a `ResponseModel`."""
    return fit(cast(ResponseModel, model), fitted, model.priors, max_iterations=iterations)


def judged(found: LikelihoodFit, held_out: Sequence[SpectralBlock]) -> Refit:
    """A fit with what it leaves of held-out blocks."""
    errors = [prediction_error(found.model, block, derivative=False) for block in held_out]
    return Refit(cast(TableModel, found.model), found, sum(e.chi2 for e in errors), sum(e.dof for e in errors))


def anew(found: Refit, fitted: Sequence[SpectralBlock], held_out: Sequence[SpectralBlock]) -> Refit:
    """A refit weighed by blocks of which the noise is better known, its parameters as they are."""
    chi2 = sum(prediction_error(found.fit.model, block, derivative=False).chi2 for block in fitted)
    return judged(replace(found.fit, chi2=chi2), held_out)


def scattered(found: Refit, fitted: Sequence[SpectralBlock]) -> Refit:
    """The same with the covariance that the scatter of the score over the fitted blocks gives."""
    return replace(found, robust=clustered(found.model, fitted, found.fit.information))


def try_refit(model: TableModel, fitted: Sequence[SpectralBlock], held_out: Sequence[SpectralBlock],
              iterations: int = MOST_ITERATIONS) -> Refit | None:
    """As `refit`; None where no fit came to an end."""
    try:
        return refit(model, fitted, held_out, iterations)
    except (AvisError, np.linalg.LinAlgError, FloatingPointError):
        return None


def probabilities(refits: Sequence[Refit], stretch: float = 1.0) -> np.ndarray:
    """(n,) posterior probabilities of models, equal beforehand.

    Where even the best model leaves more than noise, its own misfit is the measure of how far a difference can be
    trusted: all criteria are divided by it, and by `stretch`, what the noise's own uncertainty adds to a difference.
    """
    criteria = np.array([one.criterion for one in refits])
    best = refits[int(np.argmin(criteria))]
    weight = np.exp(-(criteria - criteria.min()) / (2 * best.misfit * stretch))
    return weight / weight.sum()
