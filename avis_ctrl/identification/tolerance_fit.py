"""Fit of a rig's parameters together with all file values that have a tolerance, by the likelihood of `likelihood`.

The values of a rig file are never exact: if positions, directions, gains and corners are taken as exact, their errors
end up in mass, stiffness and damping, and in the residual. Here each is free within its tolerance; noise, unspecified
path errors, and distortion weight the residual. The parameters have no prior unless one is stated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from avis_ctrl.identification.fit_settings import SETTINGS
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.likelihood import Data, Fitted, first_variances, fit
from avis_ctrl.identification.maximum_likelihood import (
    LikelihoodFit,
    Prior,
    block_residual,
    transient_unknowns,
    whitener,
)
from avis_ctrl.identification.priors import beside, identified
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.rigs.isolator_table import IsolatorTable


class ToleranceFit(NamedTuple):
    """fitted : parameters and tolerances. flat : (n,) which parameters have no stated prior but a wide one about their
    start."""

    fitted: Fitted
    flat: np.ndarray


def begin(
    model: ResponseModel,
    blocks: Sequence[SpectralBlock],
    levels: Mapping[str, float],
    tolerances: Tolerances,
    stated: Mapping[str, Prior],
) -> ToleranceFit:
    """Start from parameters that were fitted with the file's values as stated, on some lines of each block.

    Parameters
    ----------
    model : with these parameters free. levels : [V] by record.
    stated : (mean, standard deviation) of parameters that have a prior.
    """
    assert isinstance(model.rig, IsolatorTable)  # each channel at its own position
    rig = model.rig.with_channels_apart()
    rest = beside(replace(model, rig=rig, names=()), model.names, tolerances)
    priors = identified(model, stated).followed_by(rest)
    apart = replace(model, rig=rig, names=priors.names)
    data = Data.of(blocks, levels, SETTINGS.lines)
    flat = np.array([name in model.names and name not in stated for name in priors.names])
    found = fit(apart, priors, priors.z(apart.values), data, first_variances(data, SETTINGS))
    return ToleranceFit(found, flat)


def end(begun: ToleranceFit, blocks: Sequence[SpectralBlock], levels: Mapping[str, float]) -> ToleranceFit:
    """Continue from there, with blocks from which the second-order terms of the fitted model were subtracted."""
    one, data = begun.fitted, Data.of(blocks, levels, SETTINGS.lines)
    priors = replace(one.priors, mean=np.where(begun.flat, one.priors.values(one.z), one.priors.mean))
    rounds = replace(SETTINGS, rounds=SETTINGS.final_rounds)
    found = fit(one.model, priors, np.where(begun.flat, 0.0, one.z), data, one.variances, rounds)
    return begun._replace(fitted=found)


def as_likelihood_fit(
    found: ToleranceFit, blocks: Sequence[SpectralBlock], first: LikelihoodFit[ResponseModel]
) -> LikelihoodFit[ResponseModel]:
    """Convert to the form of a fit by noise alone, with tolerances among the parameters; residuals on all lines of the
    blocks."""
    one, model = found.fitted, found.fitted.model
    H, g, cost = one.weights.normal_equations(one.white.J, one.white.e)
    known = np.where(found.flat, 0.0, 1.0)
    slopes = one.priors.slopes(one.z)
    information = Information(
        model.names,
        model.values,
        model.units,
        (H / one.weight_cost + np.diag(known)) / np.outer(slopes, slopes),
        model.scales(),
    )
    step = np.linalg.solve(H + np.eye(len(g)), g - one.z)
    less = int(known.sum()) - sum(transient_unknowns(block, model) for block in blocks) - information.rank
    fitted, dof = len(one.white.e) + less, sum(block.numbers for block in blocks) + less
    # The fitted lines represent all of the residuals.
    chi2 = (cost + float(known @ one.z**2)) * dof / fitted
    residuals = tuple(block_residual(model, block, whitener(block), derivative=False)[2] for block in blocks)
    return LikelihoodFit(
        model,
        information,
        chi2,
        dof,
        first.iterations + one.iterations,
        bool(step @ (g - one.z) < SETTINGS.converged * len(one.white.e)),
        residuals,
        first.starts,
        tuple(np.array(one.priors.names)[~found.flat].tolist()),
    )
