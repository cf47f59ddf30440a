"""The information that data hold of parameters, its rank, and the Cramer-Rao bound of what is determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

# A direction known to worse than this, as a fraction of the parameters' own size, is not determined.
UNDETERMINED = 1.0


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information of parameters.

    Attributes
    ----------
    names, units : n_p. values : (n_p,) where it was computed.
    matrix : (n_p, n_p) J^T J of the whitened residuals, in the parameters' units; priors included where given.
    scale : (n_p,) size of each parameter, which makes relative units.
    """

    names: tuple[str, ...]
    values: np.ndarray
    units: tuple[str, ...]
    matrix: np.ndarray
    scale: np.ndarray

    @cached_property
    def relative(self) -> np.ndarray:
        """The matrix in relative parameters."""
        return self.matrix * np.outer(self.scale, self.scale)

    @cached_property
    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Relative standard deviations (n_p,), best known first, and orthonormal directions (columns)."""
        values, vectors = np.linalg.eigh((self.relative + self.relative.T) / 2)
        # Round-off of the largest eigenvalue is what a zero looks like.
        values = np.maximum(values, values[-1] * 1e-15)[::-1]
        return 1 / np.sqrt(values), vectors[:, ::-1]

    @cached_property
    def determined(self) -> np.ndarray:
        """(n_p,) which of the directions the data determine."""
        return self.directions[0] < UNDETERMINED

    @property
    def rank(self) -> int:
        return int(np.count_nonzero(self.determined))

    @property
    def condition(self) -> float:
        """Of the relative information on the determined directions."""
        sigma = self.directions[0][self.determined]
        return float((sigma[-1] / sigma[0]) ** 2) if sigma.size else np.inf

    @cached_property
    def covariance(self) -> np.ndarray:
        """(n_p, n_p) Cramer-Rao bound on the determined directions; the others are held at their start."""
        sigma, V = self.directions
        kept = V[:, self.determined] * sigma[self.determined]
        return kept @ kept.T * np.outer(self.scale, self.scale)

    @cached_property
    def known(self) -> np.ndarray:
        """(n_p,) which single parameters are determined by themselves."""
        _, V = self.directions
        lost = np.sum(V[:, ~self.determined] ** 2, axis=1)
        return lost < 1e-4

    @property
    def standard_deviation(self) -> np.ndarray:
        """(n_p,) of each parameter by itself; infinite where only combinations of it are determined."""
        return np.where(self.known, np.sqrt(np.diag(self.covariance)), np.inf)

    def of(self, weights: Sequence[float] | np.ndarray) -> tuple[float, float]:
        """Value and standard deviation of a linear combination (n_p,); infinite where it is not determined."""
        w = np.asarray(weights, float)
        _, V = self.directions
        relative = w * self.scale
        lost = np.linalg.norm(V[:, ~self.determined].T @ relative) / np.linalg.norm(relative)
        sigma = np.inf if lost > 1e-2 else float(np.sqrt(w @ self.covariance @ w))
        return float(w @ self.values), sigma
