"""Common result of all single-axis fits, with standard deviations that are valid for coloured residuals.

If the residual of a regression is correlated from sample to sample, its samples contain less information than their
number suggests. With J the Jacobian, e the residual and s_t = J_t e_t the scores, the covariance of the estimate is

    inv(J^T J) n S inv(J^T J),    S = sum over lags l of w_l E[s_t s_(t-l)^T]

(Newey and West, Econometrica 55 (1987) 703, Bartlett weights w_l = 1 - |l|/(L+1), which keep S non-negative). The
number of lags L follows Andrews, Econometrica 59 (1991) 817, eq. 6.4, from a first-order autoregression of each score.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from avis_ctrl import uncertain_value
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.information import Information
from avis_ctrl.summary import Shown


@dataclass(frozen=True)
class ResidualStatistics:
    """Statistics of a model's residual.

    rms : in the unit of the measured quantity. share : norm of the residual over that of the measured quantity.
    lag_one : correlation of neighbouring residuals (0: white, 1: equal). inflation : largest ratio of a reported
    standard deviation to that for a white residual. lags : L above, 0 if none were used.
    """

    rms: float
    share: float
    lag_one: float
    inflation: float
    lags: int


@dataclass(frozen=True, eq=False, repr=False)
class SingleAxisFit(Shown):
    """Parameters of a model of one axis.

    Attributes
    ----------
    model : its equation, in words.
    information : names, values, units, rank and the Cramer-Rao bound for a white residual of the estimated level.
    covariance : (n_p, n_p); accounts for the colour of the residual, or the misfit, as `covariance_method` describes.
    chi2, dof : relative to `noise`: "given" (measured beforehand), or "residual" (estimated from the residual, so that
        chi2/dof is 1 by construction and no test of the model).
    abscissa, measured, predicted : for a figure; time [s] or frequency [Hz] along axis 0.
    notes : caveats for a reader of the numbers.
    """

    model: str
    information: Information
    covariance: np.ndarray
    covariance_method: str
    chi2: float
    dof: int
    noise: str
    residual: ResidualStatistics
    abscissa: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.information.names

    @property
    def values(self) -> np.ndarray:
        """(n_p,) values of the parameters."""
        return self.information.values

    @property
    def chi2_per_dof(self) -> float:
        """Chi-square over degrees of freedom."""
        return self.chi2 / self.dof

    @property
    def standard_deviation(self) -> np.ndarray:
        """(n_p,) from `covariance`; infinite where the data do not determine the parameter by itself."""
        return np.where(self.information.known, np.sqrt(np.diag(self.covariance)), np.inf)

    def of(self, name: str) -> tuple[float, float]:
        """Value and standard deviation of a parameter."""
        if name not in self.names:
            raise InputError(f"expected one of {', '.join(self.names)}", field="parameter", value=name)
        j = self.names.index(name)
        return float(self.values[j]), float(self.standard_deviation[j])

    def derived(self, function: Callable[[np.ndarray], float]) -> tuple[float, float]:
        """Value and standard deviation of a function of the parameters, to first order."""
        slope = slopes(lambda theta: np.asarray(function(theta)), self.values, self.information.scale)
        return float(function(self.values)), float(np.sqrt(max(slope @ self.covariance @ slope, 0.0)))

    def lines(self) -> list[str]:
        """The result as text: one line for each parameter, then the residual."""
        found = [
            f"{name} = {uncertain_value.text(value, sigma, unit)}"
            for name, value, sigma, unit in zip(
                self.names, self.values, self.standard_deviation, self.information.units, strict=True
            )
        ]
        found.append(
            f"rank {self.information.rank} of {len(self.names)}; residual {100 * self.residual.share:.2f} % of the "
            f"measured signal; chi-square per degree of freedom {self.chi2_per_dof:.3g}, relative to {self.noise} noise"
        )
        return [*found, f"standard deviations: {self.covariance_method}", *self.notes]


def andrews_lags(scores: np.ndarray) -> int:
    """Number of lags of the Bartlett kernel for scores (n, p): 1.1447 (alpha(1) n)^(1/3)."""
    n = len(scores)
    now, before = scores[1:], scores[:-1]
    power = np.maximum(np.sum(before**2, axis=0), np.finfo(float).tiny)
    rho = np.clip(np.sum(now * before, axis=0) / power, -0.999, 0.999)
    sigma4 = np.mean((now - rho * before) ** 2, axis=0) ** 2
    # Each score is normalised, so that the parameters' units have no influence.
    weight = 1 / np.maximum(np.mean(scores**2, axis=0) ** 2, np.finfo(float).tiny)
    top = np.sum(weight * 4 * rho**2 * sigma4 / ((1 - rho) ** 6 * (1 + rho) ** 2))
    bottom = np.sum(weight * sigma4 / (1 - rho) ** 4)
    alpha = top / bottom if bottom > 0 else 0.0
    return int(min(np.ceil(1.1447 * (alpha * n) ** (1 / 3)), n // 4))


def long_run_covariance(scores: np.ndarray, lags: int) -> np.ndarray:
    """(p, p) S above, from scores (n, p)."""
    n = len(scores)
    total = scores.T @ scores / n
    for lag in range(1, lags + 1):
        gamma = scores[lag:].T @ scores[:-lag] / n
        total += (1 - lag / (lags + 1)) * (gamma + gamma.T)
    return total


def not_below(covariance: np.ndarray, bread: np.ndarray) -> np.ndarray:
    """The covariance with no variance below that of `bread`; correlations are kept.

    If few rows contain most of the information on a parameter (lines at a resonance, few frequencies), the fit adapts
    to them and their residuals are small, so that the scores underestimate the variance. The variance of bread is that
    for independent residuals of the same level as their neighbours.
    """
    lift = np.sqrt(np.maximum(np.diag(bread) / np.maximum(np.diag(covariance), np.finfo(float).tiny), 1.0))
    return covariance * np.outer(lift, lift)


def slopes(function: Callable[[np.ndarray], np.ndarray], theta: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(..., p) derivative of a function (...) with respect to theta (p,) of size `scale`, by central differences."""
    steps = np.diag(1e-5 * scale)
    return np.stack([(function(theta + h) - function(theta - h)) / (2 * h.sum()) for h in steps], axis=-1)


def inverse_product(Z: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(p, p) pseudo-inverse of Z^T X, (n, p) each; zero along combinations that the data do not determine."""
    size, size_z = np.linalg.norm(X, axis=0), np.linalg.norm(Z, axis=0)
    return np.linalg.pinv((Z / size_z).T @ (X / size), rcond=1e-12) / size[:, None] / size_z


def concluded(
    model: str,
    parameters: Mapping[str, str],
    theta: np.ndarray,
    e: np.ndarray,
    J: np.ndarray,
    spent: float,
    drawn: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    instruments: np.ndarray | None = None,
    lags: int | None = None,
    method: str = "",
    relative: np.ndarray | None = None,
    given_chi2: float | None = None,
    notes: tuple[str, ...] = (),
) -> SingleAxisFit:
    """Build the result of a fit from its residual.

    Parameters
    ----------
    parameters : unit by name. theta : (p,). e : (n, ..) residual of n samples or lines. J : (n, .., p) its derivative,
    of either sign. spent : degrees of freedom that the fit used, linear unknowns included.
    drawn : abscissa, measured and predicted values of the result.
    instruments : as J; used instead of J in the estimating equations.
    lags : given if e has unit variance already and is correlated over this many rows; by default the level of e is
        estimated from it, and the lags follow Andrews' rule.
    method : how the lags were chosen, in words. relative : residual for the statistics, by default measured minus
    predicted. given_chi2 : chi-square for noise that was measured beforehand.
    """
    n, p = len(e), len(theta)
    J, e = J.reshape(n, -1, p), e.reshape(n, -1)
    Z = J if instruments is None else instruments.reshape(J.shape)
    bread, dof = inverse_product(Z.reshape(-1, p), J.reshape(-1, p)), e.size - round(spent)
    level = float(np.sum(e**2)) / dof if lags is None else 1.0
    plain = bread @ np.einsum("nrp,nrq->pq", Z, Z) @ bread.T * level
    scores = np.einsum("nrp,nr->np", Z, e)
    used = andrews_lags(scores) if lags is None else min(lags, n // 4)
    # The factor allows for the degrees of freedom that the fit used.
    covariance = bread @ (n * long_run_covariance(scores, used)) @ bread.T / (1 - spent / e.size)
    if lags is not None:
        covariance = not_below(covariance, plain)
    abscissa, measured, predicted = drawn
    reference, left = (measured, measured - predicted) if relative is None else (measured / np.abs(measured), relative)
    flat = np.abs(left) ** 2
    tiny, honest, white = np.finfo(float).tiny, np.sqrt(np.diag(covariance)), np.sqrt(np.abs(np.diag(plain)))
    residual = ResidualStatistics(
        float(np.sqrt(np.mean(flat))),
        float(np.linalg.norm(left) / max(float(np.linalg.norm(reference)), tiny)),
        float(np.sum(np.real(np.conj(left[1:]) * left[:-1])) / max(float(np.sum(flat)), tiny)),
        float(np.max(honest / np.maximum(white, tiny))),
        used,
    )
    how = method or (
        f"Newey-West, {used} lags by Andrews' rule; {residual.inflation:.1f} times those of a white residual"
    )
    information = Information(
        tuple(parameters),
        theta,
        tuple(parameters.values()),
        np.einsum("nrp,nrq->pq", J, J) / level,
        np.where(theta == 0, 1.0, np.abs(theta)),
    )
    chi2 = float(np.sum(e**2)) / level if given_chi2 is None else given_chi2
    return SingleAxisFit(
        model,
        information,
        covariance,
        how,
        chi2,
        dof,
        "residual" if given_chi2 is None else "given",
        residual,
        abscissa,
        measured,
        predicted,
        notes,
    )


def regression(
    model: str,
    parameters: Mapping[str, str],
    X: np.ndarray,
    y: np.ndarray,
    time: np.ndarray,
    instruments: np.ndarray | None = None,
) -> SingleAxisFit:
    """Regression y = X theta + e for time series, by least squares or instrumental variables.

    parameters : unit by name. X, instruments : (n, p); y : (n,). Instruments Z of the same shape give the estimate
    inv(Z^T X) Z^T y, consistent if Z is uncorrelated with the noise. In a closed loop X is correlated with the noise.

    Raises
    ------
    InputError : too few samples, numbers that are not finite. ComputationError : a column of zeros.
    """
    Z = X if instruments is None else instruments
    n, p = X.shape
    if n <= 4 * p:
        raise InputError(f"expected more than {4 * p} samples", field="samples", value=n)
    if not (np.all(np.isfinite(X)) and np.all(np.isfinite(y)) and np.all(np.isfinite(Z))):
        raise InputError("expected finite numbers", field="samples")
    if lost := [name for name, x, z in zip(parameters, X.T, Z.T, strict=True) if not (np.any(x) and np.any(z))]:
        raise ComputationError(
            f"the data contain no information on {lost[0]}",
            measured="its column is zero throughout",
            cause="an axis that never moved, or a channel that was mapped wrongly",
            next_step="look at the columns, or leave the parameter out",
        )
    theta = inverse_product(Z, X) @ (Z.T @ y)
    return concluded(model, parameters, theta, y - X @ theta, X, p, (time, y, X @ theta), instruments=Z)
