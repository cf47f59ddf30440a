"""Standard deviations for residuals that are correlated within an octave or a level (cluster-robust covariance).

A model that differs from the real table leaves residuals that are correlated over neighbouring lines and bands, or over
the records of a level. With the residual e, its derivative J and the covariance P of all parameters at the estimate, a
cluster c of data shifts the estimate by

    delta_c = P J_c (I - J_c^T P J_c)^(-1/2) e_c

and V = P^2 + sum_c delta_c delta_c^T has the expectation P if the model is correct, for any clusters; P^2 is the
contribution of the priors (R. M. Bell, D. F. McCaffrey, Survey Methodology 28 (2002) 169-181, with priors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.identification.variances import Group


def cluster_moves(
    P: np.ndarray, J: np.ndarray, e: np.ndarray, clusters: Sequence[np.ndarray], least_elsewhere: float = 0.0
) -> np.ndarray:
    """(n_c, n) shift delta of each cluster.

    P : (n, n) covariance of standardised parameters, inv(J J^T + I). J : (n, N) negative derivative of e (N,).
    clusters : entries of e of each. least_elsewhere : minimum fraction of the information on a direction that lies
        outside the cluster; below it the direction is not counted, because there is nothing to compare it with.
    """
    L, found = np.linalg.cholesky(P), []
    for at in clusters:
        X = L.T @ J[:, at]
        size, vectors = np.linalg.eigh(X @ X.T)
        elsewhere = np.maximum(1 - size, np.finfo(float).eps)
        along = np.where(elsewhere > least_elsewhere, vectors.T @ (X @ e[at]) / np.sqrt(elsewhere), 0.0)
        found.append(L @ (vectors @ along))
    return np.array(found)


def widening(ratio: float | np.ndarray, clusters: float) -> np.ndarray:
    """Factor of the model's variance, for the ratio of the variance from clusters to it: 1 plus the excess, times the
    square of the 97.5 % quantile of Student's t over that of the normal distribution, because a variance from a few
    clusters is itself uncertain."""
    t = stats.t.ppf(0.975, max(clusters - 1, 1)) / stats.norm.ppf(0.975)
    return np.asarray(1 + t**2 * np.maximum(np.asarray(ratio) - 1, 0.0))


@dataclass(frozen=True, eq=False)
class ClusterCovariance:
    """Covariance (n, n) of all parameters from the differences between clusters, and their number."""

    covariance: np.ndarray
    clusters: float

    def covering(self, A: np.ndarray, rows: Sequence[int]) -> np.ndarray:
        """(k, k) covariance of some parameters, at least as large as A in every direction: A, increased by
        `widening`. A : (k, k), positive definite."""
        L = np.linalg.cholesky(A)
        B = self.covariance[np.ix_(rows, rows)]
        ratio, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, B).T))
        root = L @ (vectors * np.sqrt(widening(ratio, self.clusters)))
        return np.asarray(root @ root.T)


def clusterings(groups: Sequence[Group], bands_per_octave: int) -> tuple[list[list[list[Group]]], list[list[Group]]]:
    """Clusters of groups (level, band): by octave, once for each band at which octaves may begin; and by level."""
    by_octave, bands_per_octave = [], max(bands_per_octave, 1)
    for first in range(bands_per_octave):
        octaves: dict[int, list[Group]] = {}
        for group in groups:
            octaves.setdefault((group[1] - first) // bands_per_octave, []).append(group)
        by_octave.append(list(octaves.values()))
    levels: dict[float, list[Group]] = {}
    for group in groups:
        levels.setdefault(group[0], []).append(group)
    return by_octave, list(levels.values())
