"""Standard deviations that hold where the model does not: the sandwich estimate of a fit's covariance.

The inverse of the information H is the covariance of an estimate only where the residual e is white noise of unit
variance. Where the model leaves something, as every real one does, the score g = J e scatters by more than H, and with
it the estimate (Huber 1967, White 1982):

    C = inv(H) S inv(H),    S = sum over clusters of a_c a_c^T,    a_c = (1 - H_c inv(H))^(-1/2) g_c

g_c and H_c are what a cluster of residuals adds to g and H. Within a cluster residuals may go together as they like;
a model's misfit does so over neighbouring lines. The factor before g_c undoes what the fit itself has taken from the
cluster's residual: without misfit C is then inv(H) on the average, however few the clusters (the second of the
corrections of Bell and McCaffrey, Survey Methodology 28, 2002).

What a law that is not quite the table's leaves of a band is alike in all records, what depends on level or time in one
of them only. So two ways to cluster are tried, the bands of all records and those of each, and of each parameter the
larger variance counts. Whole records are too few to be clusters; where their own estimates differ by more than noise
explains, the variance between them is added.

What no scatter shows is an error that all clusters share: a misfit that looks like a change of the parameter itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from avis_ctrl.gap.score import Part
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.spectra import SpectralBlock

BANDS_PER_OCTAVE = 3
# Share of the largest eigenvalue of a scaled information matrix below which there is only round-off, 1e-16 of it.
ROUND_OFF = 1e-12
# Share of a direction that must be determined without a cluster, or that cluster alone says what it is.
ALONE = 1e-6
# Records whose estimates differ less than chance does in all but this share of cases are of one mind.
CHANCE = 0.01
# Share of the information on a parameter that records must hold each by itself for their estimates to be compared.
SEPARATE = 0.25


def clustered(model: TableModel, blocks: Sequence[SpectralBlock], information: Information) -> np.ndarray:
    """(n_p, n_p) covariance of a model's free parameters at their fit to `blocks`, units as theirs.

    information : of that fit, for the parameters' sizes. Directions that the blocks do not determine are left out.
    """
    J, e, record, band = _residuals(model, blocks)
    J *= information.scale[:, None]
    C = widest([sandwich(J, e, cluster) for cluster in (record * (band.max() + 1) + band, band)])
    own = np.diag(C)
    wider = np.sqrt(1 + np.divide(between(J, e, record), own, out=np.zeros_like(own), where=own > 0))
    return C * np.outer(wider, wider) * np.outer(information.scale, information.scale)


def directions(relative: np.ndarray) -> np.ndarray:
    """(n_p, r) directions that an information matrix (n_p, n_p) determines, with unit information, B B^T its inverse.

    The diagonal is scaled away first: how well one parameter is known says nothing of what is known of another, and a
    direction that is known to a part in ten stands beside others that are known to a part in a million.
    """
    size = np.sqrt(np.maximum(np.diag(relative), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(relative / np.outer(size, size))
    known = values > ROUND_OFF * values[-1]
    return vectors[:, known] / np.sqrt(values[known]) / size[:, None]


def widest(covariances: Sequence[np.ndarray]) -> np.ndarray:
    """(n, n) with each parameter's largest variance, and the correlations of the first."""
    variances = np.max([np.diag(C) for C in covariances], axis=0)
    own = np.diag(covariances[0])
    factor = np.sqrt(np.divide(variances, own, out=np.ones_like(own), where=own > 0))
    # A parameter that the first one holds to be exact has no correlations to widen.
    rest = np.where(own > 0, 0.0, variances)
    return covariances[0] * np.outer(factor, factor) + np.diag(rest)


def sandwich(J: np.ndarray, e: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """(n_p, n_p) from J (n_p, N), e (N,) at a least-squares fit, and the cluster (N,) that each residual belongs to.

    Directions that J does not determine are left out. A cluster without which a direction is not determined adds
    nothing along it.
    """
    root = directions(J @ J.T)
    W = root.T @ J
    S = np.zeros((len(W), len(W)))
    for one in np.unique(cluster):
        own = W[:, cluster == one]
        share, along = np.linalg.eigh(own @ own.T)
        left = 1 - share
        raised = np.where(left > ALONE, 1 / np.sqrt(np.maximum(left, ALONE)), 0.0)
        a = along @ (raised * (along.T @ (own @ e[cluster == one])))
        S += np.outer(a, a)
    return root @ S @ root.T


def between(J: np.ndarray, e: np.ndarray, record: np.ndarray) -> np.ndarray:
    """(n_p,) variance of each parameter between records, beyond what noise lets single records differ.

    What depends on level makes every record ask for another value, and a fit follows the loudest. The estimate of a
    record alone is one step from the fit; of their spread about the mean, Q, what exceeds its expectation (DerSimonian
    and Laird, Controlled Clinical Trials 7, 1986), where Q is significant at CHANCE. Zero for what only records
    together determine, a drift for one.
    """
    root = directions(J @ J.T)
    W = root.T @ J
    estimates, variances = [], []
    for one in np.unique(record):
        own = W[:, record == one]
        share, along = np.linalg.eigh(own @ own.T)
        share = np.maximum(share, ROUND_OFF)
        estimates.append(root @ (along / share) @ (along.T @ (own @ e[record == one])))
        variances.append(np.sum((root @ along) ** 2 / share, axis=1))
    dof = len(estimates) - 1
    if dof < 1:
        return np.zeros(len(J))
    x, v = np.array(estimates), np.array(variances)
    w = np.divide(1.0, v, out=np.zeros_like(v), where=v > 0)
    total = np.maximum(w.sum(axis=0), np.finfo(float).tiny)
    Q = np.sum(w * (x - (w * x).sum(axis=0) / total) ** 2, axis=0)
    weight = total - np.sum(w ** 2, axis=0) / total
    # Where one record alone tells of a parameter, there is nothing to compare.
    found = np.divide(Q - dof, weight, out=np.zeros_like(Q), where=(w.sum(axis=0) > 0) & (weight > ALONE * total))
    separate = total * np.sum(root ** 2, axis=1) > SEPARATE
    differ = stats.chi2.sf(Q, dof) < CHANCE
    return np.where(separate & differ, found, 0.0)


def _residuals(model: TableModel, blocks: Sequence[SpectralBlock]
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """J (n_p, N) and e (N,), whitened and free of the transients, with record and band (N,) of each."""
    lowest = min(float(block.omega[block.omega > 0].min()) for block in blocks)
    Js, es, records, bands = [], [], [], []
    for k, block in enumerate(blocks):
        part = Part(model, block)
        es.append(part.real((block.Y - part.answer.Y)[None])[0])
        Js.append(part.real(model.answer(block, part.body, inner=part.inner).dY))
        octaves = np.log2(np.maximum(block.omega, lowest) / lowest)
        lines = np.repeat(np.floor(BANDS_PER_OCTAVE * octaves).astype(int), block.Y.shape[1] * block.Y.shape[2])
        bands.append(np.tile(lines, 2))  # real parts first, imaginary ones after
        records.append(np.full(2 * len(lines), k))
    return np.concatenate(Js, axis=1), np.concatenate(es), np.concatenate(records), np.concatenate(bands)
