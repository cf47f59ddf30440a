"""Result of the extended Kalman filter, and the consistency of its innovations with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from avis_ctrl.identification.ekf_settings import EkfSettings


@dataclass(frozen=True)
class InnovationSettings:
    """lags : samples up to which innovations are correlated [1]; with six outputs these are 300 values, of which white
    innovations have 5 +- 1.3 % beyond the bound."""

    lags: int = 50


SETTINGS = InnovationSettings()


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of one record over their predicted standard deviations: white with unit variance for a consistent
    filter.

    Attributes
    ----------
    nis : mean over time of the normalised innovation squared e^T S^-1 e; expected n_y.
    nis_interval : interval that contains 99.9 % of such means (chi-square of n n_y degrees of freedom).
    autocorrelation : (lags, n_y) at 1, 2, .. samples, each output separately.
    bound : 1.96 / sqrt(n), within which 95 % of the autocorrelations of white noise lie.
    """

    nis: float
    nis_interval: tuple[float, float]
    autocorrelation: np.ndarray
    bound: float

    @property
    def nis_per_output(self) -> float:
        """Mean normalised innovation squared per output, 1 expected."""
        return self.nis / self.autocorrelation.shape[1]

    @property
    def outside(self) -> float:
        """Fraction of the autocorrelations beyond the bound; 0.05 for white innovations."""
        return float(np.mean(np.abs(self.autocorrelation) > self.bound))

    @property
    def consistent(self) -> bool:
        """The mean normalised innovation squared lies in its interval, and at most 10 % of the lags exceed the
        bound."""
        low, high = self.nis_interval
        return low <= self.nis <= high and self.outside <= 0.10


def innovation_statistics(innovation: np.ndarray) -> Innovations:
    """Statistics of (n, n_y) innovations, each over its predicted standard deviation given the outputs before it.

    For outputs processed one by one, the squares sum to e^T S^-1 e of the whole sample.
    """
    n, n_y = innovation.shape
    low, high = chi2.ppf((0.0005, 0.9995), n * n_y) / n
    power = np.sum(innovation**2, axis=0)
    lags = range(1, min(SETTINGS.lags, n - 1) + 1)
    with np.errstate(invalid="ignore"):
        correlation = np.array([np.einsum("ij,ij->j", innovation[k:], innovation[:-k]) / power for k in lags])
    return Innovations(
        float(np.mean(np.sum(innovation**2, axis=1))),
        (float(low), float(high)),
        np.nan_to_num(correlation),
        float(1.96 / np.sqrt(n)),
    )


@dataclass(frozen=True, eq=False)
class EkfHistory:
    """time_s (m,), theta (m, n_p), lower and upper (m, n_p) ends of the +-2 sigma band, boundaries_s (records + 1,)."""

    time_s: np.ndarray
    theta: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    boundaries_s: np.ndarray


@dataclass(frozen=True, eq=False)
class EkfResult:
    """Parameters estimated by the filter.

    Attributes
    ----------
    names, units, initial, values : n_p.
    scaled_covariance : (n_p, n_p) of theta / initial.
    history : decimated. innovations : one per record.
    guarded : (n_p,) number of samples at which the lower limit held a parameter.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    initial: np.ndarray
    values: np.ndarray
    scaled_covariance: np.ndarray
    history: EkfHistory
    innovations: tuple[Innovations, ...]
    guarded: np.ndarray
    settings: EkfSettings

    @property
    def covariance(self) -> np.ndarray:
        """(n_p, n_p) in the parameters' units."""
        return self.scaled_covariance * np.outer(self.initial, self.initial)

    @property
    def sigma(self) -> np.ndarray:
        """(n_p,) standard deviations in the parameters' units."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def undetermined(self) -> tuple[np.ndarray, np.ndarray]:
        """Posterior over prior variance (k,), and orthonormal combinations (n_p, k) in relative changes, for the
        combinations that keep at least half of the prior variance. With the source's reset it refers to the last
        record."""
        values, vectors = np.linalg.eigh(self.scaled_covariance / self.settings.prior_share**2)
        return values[values >= 0.5], vectors[:, values >= 0.5]


def kinds(result: EkfResult) -> dict[str, list[int]]:
    """Parameters by figure, as in figs. 3.1 to 3.3: mass and inertia, damping, stiffness, others."""
    groups: dict[str, list[int]] = {"Mass and inertia": [], "Damping": [], "Stiffness": [], "Other parameters": []}
    for j, unit in enumerate(result.units):
        groups[
            {
                "kg": "Mass and inertia",
                "kg m^2": "Mass and inertia",
                "N s/m": "Damping",
                "N/m": "Stiffness",
                "N m s/rad": "Damping",
                "N m/rad": "Stiffness",
            }.get(unit, "Other parameters")
        ].append(j)
    return {title: index for title, index in groups.items() if index}
