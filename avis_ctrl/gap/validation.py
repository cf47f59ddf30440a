"""Contribution of each effect on held-out records, and its parameters from halves of the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.gap.residual import ModelResidual
from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.likelihood import Fitted
from avis_ctrl.identification.spectral_block import SpectralBlock


@dataclass(frozen=True, eq=False)
class Power:
    """Residual power of models on held-out records over the power of y, mean over the sensors: of noise alone, and of
    the baseline."""

    noise: float
    baseline: float

    @property
    def excess(self) -> float:
        """Power of the baseline in excess of the noise; always above zero."""
        return max(self.baseline - self.noise, 1e-3 * self.noise, 1e-12)

    def share(self, power: float) -> float:
        """A power over the baseline's excess, limited to 0 .. 1."""
        return float(np.clip(power / self.excess, 0.0, 1.0))


def share_of(model: TableModel, label: str, blocks: Sequence[SpectralBlock], power: Power, with_it: float) -> float:
    """Increase of the held-out residual power when one effect is replaced by what the rig file states, without a new
    fit, over the baseline's excess. with_it : the residual power of the whole model."""
    return power.share(ModelResidual.of(model.with_law_of_rig_file(label), blocks).nrmse ** 2 - with_it)


@dataclass(frozen=True)
class Half:
    """An effect's parameters from half of the data.

    words : name of the half. chi2, dof : of the difference from the whole, and its degrees of freedom. change : largest
        relative change of a parameter that differs significantly by itself, or relative change of the effect's
        contribution to the response if that is smaller; 0 if no parameter differs.
    """

    words: str
    chi2: float
    dof: int
    change: float

    @property
    def p_value(self) -> float:
        """Probability of as large a difference by noise alone."""
        return float(stats.chi2.sf(self.chi2, self.dof))


def halves(
    fitted: Fitted,
    names: Sequence[str],
    settings: GapSettings,
    parts: Sequence[tuple[str, np.ndarray]] | None = None,
    absent: Mapping[str, float] | None = None,
) -> list[Half]:
    """An effect's parameters from halves of the data: lower and upper band, low and high levels.

    Each half gives one Gauss-Newton step from the fit to the whole. A parameter that changes with the band or the level
    refutes its law. If the law is true, the difference has the covariance P_half - P (J. A. Hausman, Econometrica 46
    (1978) 1251-1271). A parameter that hardly acts in a half (a quintic stiffness at low level, a small difference
    between mounts) may move without changing the response there.

    parts : other halves, as name and rows of the residual. absent : values at which linear parameters of the effect do
        not act, by name: changes are relative to the difference from these values, and the change of the response is
        compared with the effect's own contribution.
    """
    rows = [fitted.priors.names.index(name) for name in names if name in fitted.priors.names]
    root = np.linalg.cholesky(fitted.covariance[np.ix_(rows, rows)])
    found, whole = [], fitted.J
    for words, at in _parts(fitted, rows) if parts is None else parts:
        J, e = whole[:, at], fitted.e[at]
        P = np.linalg.inv(J @ J.T + np.eye(len(J)))
        step = np.linalg.solve(root, (P @ (J @ e - fitted.z))[rows])
        # Variances of the half over those of the whole; directions that the half hardly determines are left out.
        half = np.linalg.solve(root, np.linalg.solve(root, P[np.ix_(rows, rows)]).T)
        size, V = np.linalg.eigh((half + half.T) / 2)
        known = (size > 1 + settings.least_difference) & (size < settings.most_of_half)
        into, along = root @ V[:, known], (V.T @ step)[known]
        chi2 = float(np.sum(along**2 / (size[known] - 1)))
        difference, variance = into @ along, into**2 @ (size[known] - 1)
        change = _change(fitted, rows, difference, variance, J, absent or {}, settings)
        found.append(Half(words, chi2, max(int(known.sum()), 1), change))
    return found


def change_from(
    fitted: Fitted, other: Fitted, names: Sequence[str], settings: GapSettings, absent: Mapping[str, float]
) -> float:
    """Relative change of an effect's parameters from their values in another fit, as `Half.change`.

    A parameter that changes when other effects are left out describes them in their absence.
    """
    rows, others = (
        [one.priors.names.index(name) for name in names if name in one.priors.names] for one in (fitted, other)
    )
    difference, variance = other.z[others] - fitted.z[rows], np.diag(fitted.covariance)[rows]
    return _change(fitted, rows, difference, variance, fitted.J, absent, settings)


def _change(
    fitted: Fitted,
    rows: Sequence[int],
    difference: np.ndarray,
    variance: np.ndarray,
    J: np.ndarray,
    absent: Mapping[str, float],
    settings: GapSettings,
) -> float:
    """`Half.change` of standardised parameters (n,) with a difference and its variance; J : (all parameters, N)."""
    slope, values = fitted.priors.slopes(fitted.z)[rows], fitted.priors.values(fitted.z)[rows]
    away = np.abs(values - [absent.get(fitted.priors.names[row], 0.0) for row in rows])
    p = np.minimum(len(rows) * stats.chi2.sf(difference**2 / np.maximum(variance, 1e-300), 1), 1.0)
    change = np.abs(difference * slope) / np.maximum(away, 1e-300)
    largest = float(change.max(initial=0.0, where=p < settings.law_p_value))
    effect = _departure(fitted, absent)
    if len(effect):
        moved, own = difference @ J[rows], effect @ J
        largest = min(largest, float(np.linalg.norm(moved)) / max(float(np.linalg.norm(own)), 1e-300))
    return largest


def _departure(fitted: Fitted, absent: Mapping[str, float]) -> np.ndarray:
    """(n,) standardised parameters minus those at which an effect does not act; empty if there are none."""
    rows = [fitted.priors.names.index(name) for name in absent if name in fitted.priors.names]
    values = fitted.priors.values(fitted.z)
    values[rows] = [value for name, value in absent.items() if name in fitted.priors.names]
    found = fitted.z - fitted.priors.z(values)
    return np.asarray(found) if rows and np.all(np.isfinite(found)) else np.empty(0)


def _parts(fitted: Fitted, rows: Sequence[int]) -> list[tuple[str, np.ndarray]]:
    """Halves of the residual, by band and by level, each with about half of the information on the parameters."""
    information = np.sum(fitted.J[rows] ** 2, axis=0)
    band, level = np.empty(len(information)), np.empty(len(information))
    for group, at in fitted.rows.items():
        level[at], band[at] = group
    return [
        *by_information(band, information, "the lower part of the band", "the upper part of the band"),
        *by_information(level, information, "low levels", "high levels"),
    ]


def by_information(values: np.ndarray, information: np.ndarray, *words: str) -> list[tuple[str, np.ndarray]]:
    """Names and rows of the half with low and of that with high values (N,), each with about half of the information
    (N,); empty if all values are equal."""
    distinct, place = np.unique(values, return_inverse=True)
    if len(distinct) == 1:
        return []
    total = np.cumsum(np.bincount(place, information))
    low = place <= np.argmin(np.abs(total[:-1] - total[-1] / 2))
    return [(words[0], np.flatnonzero(low)), (words[1], np.flatnonzero(~low))]
