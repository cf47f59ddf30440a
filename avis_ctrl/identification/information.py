"""Fisher information on parameters, its rank, and the Cramer-Rao bound of the determined combinations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError


@dataclass(frozen=True)
class InformationSettings:
    """undetermined : standard deviation of a direction, relative to the parameters' size, from which it is not
        determined [1]: then not even the sign is known.
    rounded : fraction of a combination that may lie in directions without any information [1]: their rotation by
        round-off is smaller.
    """

    undetermined: float = 1.0
    rounded: float = 1e-3


SETTINGS = InformationSettings()


@dataclass(frozen=True)
class Combination:
    """A combination of parameters.

    weights : derivative of its value by each parameter. value : of the expression, with its standard deviation
        (infinite if it is not determined). words : the expression, such as "isolator1.k_x + isolator2.k_x".
    """

    weights: Mapping[str, float]
    value: float
    standard_deviation: float
    unit: str
    words: str

    @property
    def relative(self) -> float:
        """Standard deviation relative to the value."""
        return self.standard_deviation / abs(self.value) if self.value else np.inf

    @property
    def determined(self) -> bool:
        """Whether the data determine the combination."""
        return bool(np.isfinite(self.standard_deviation))


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information of parameters.

    Attributes
    ----------
    names, units : n_p. values : (n_p,) at which it was computed.
    matrix : (n_p, n_p) J^T J of the whitened residuals, in the parameters' units; priors included if given.
    scale : (n_p,) size of each parameter, which defines relative units.

    Raises
    ------
    InputError : shapes that do not fit together, numbers that are not finite, scales that are not positive.
    """

    names: tuple[str, ...]
    values: np.ndarray
    units: tuple[str, ...]
    matrix: np.ndarray
    scale: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.units) != n:
            raise InputError(f"expected a unit for each of {n} parameters", field="units", value=self.units)
        for field, shape in (("values", (n,)), ("matrix", (n, n)), ("scale", (n,))):
            array = np.asarray(getattr(self, field), float)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise InputError(
                    f"expected finite numbers of shape {shape}", field=f"information: {field}", value=array.shape
                )
            object.__setattr__(self, field, array)
        if np.any(self.scale <= 0):
            raise InputError("expected positive sizes", field="information: scale", value=self.scale.tolist())

    @cached_property
    def relative(self) -> np.ndarray:
        """The matrix in relative parameters."""
        return self.matrix * np.outer(self.scale, self.scale)

    @cached_property
    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Relative standard deviations (n_p,) in ascending order, and orthonormal directions (columns).

        Infinite where the information is no more than round-off of its largest eigenvalue: a direction without any
        information in the data looks like that, however precise the rest is.
        """
        values, vectors = np.linalg.eigh((self.relative + self.relative.T) / 2)
        values, vectors = values[::-1], vectors[:, ::-1]
        floor = 4 * len(values) * np.finfo(float).eps * max(values[0], 0.0) if len(values) else 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = np.where(values > floor, 1 / np.sqrt(np.maximum(values, np.finfo(float).tiny)), np.inf)
        return sigma, vectors

    @cached_property
    def determined(self) -> np.ndarray:
        """(n_p,) which of the directions the data determine."""
        return self.directions[0] < SETTINGS.undetermined

    @cached_property
    def null_space(self) -> np.ndarray:
        """(n_p, n_p - rank) orthonormal, relative: directions that the data do not determine."""
        return self.directions[1][:, ~self.determined]

    @property
    def rank(self) -> int:
        """Number of determined combinations."""
        return int(np.count_nonzero(self.determined))

    @property
    def condition(self) -> float:
        """Condition number of the relative information on the determined directions."""
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
        """(n_p,) which parameters are determined individually."""
        return np.isfinite(self.standard_deviation)

    @cached_property
    def standard_deviation(self) -> np.ndarray:
        """(n_p,) of each parameter individually; infinite if only combinations of it are determined."""
        return np.array([self.of(row)[1] for row in np.eye(len(self.names))])

    def of(self, weights: Sequence[float] | np.ndarray) -> tuple[float, float]:
        """Value and standard deviation of a linear combination (n_p,); infinite if it is not determined.

        A small component in a weakly determined direction counts with that direction's whole uncertainty.
        """
        w = np.asarray(weights, float)
        if w.shape != (len(self.names),) or not np.any(w):
            raise InputError(f"expected {len(self.names)} weights, not all zero", field="weights", value=w.tolist())
        sigma, V = self.directions
        relative = w * self.scale
        size = float(np.linalg.norm(relative))
        along, dark = V.T @ relative, np.isinf(sigma)
        spread = float(np.linalg.norm(along[~dark] * sigma[~dark]))
        lost = np.linalg.norm(along[dark]) > SETTINGS.rounded * size or spread >= SETTINGS.undetermined * size
        return float(w @ self.values), np.inf if lost else spread

    def plus(self, other: Information) -> Information:
        """The information with that of independent data added."""
        if other.names != self.names:
            raise InputError(
                f"expected the same parameters, {', '.join(self.names)}", field="information", value=other.names
            )
        return replace(self, matrix=self.matrix + other.matrix)

    def with_priors(self, deviations: Mapping[str, float]) -> Information:
        """The information with independent knowledge of single parameters added: standard deviations in their units."""
        diagonal = np.zeros(len(self.names))
        for name, sigma in deviations.items():
            if name not in self.names:
                raise InputError(f"expected some of {', '.join(self.names)}", field="priors", value=name)
            require_positive(sigma, f"prior of {name}")
            diagonal[self.names.index(name)] = 1 / sigma**2
        return replace(self, matrix=self.matrix + np.diag(diagonal))

    def of_some(self, names: Sequence[str]) -> Information:
        """Information on some of the parameters, with the others marginalised (Schur complement)."""
        keep = np.array([self.names.index(name) for name in names], int)
        rest = np.setdiff1d(np.arange(len(self.names)), keep)
        across = self.relative[np.ix_(keep, rest)]
        left = self.relative[np.ix_(keep, keep)] - across @ np.linalg.solve(self.relative[np.ix_(rest, rest)], across.T)
        scale = self.scale[keep]
        return Information(
            tuple(names), self.values[keep], tuple(self.units[k] for k in keep), left / np.outer(scale, scale), scale
        )

    def along(self, other: Information) -> Information:
        """Information restricted to the directions that another information on the same parameters determines."""
        V = other.directions[1][:, other.determined]
        P = (V @ V.T) * np.outer(other.scale, 1 / other.scale)
        return replace(self, matrix=P.T @ self.matrix @ P)
