"""Prediction error of a model on data that it was not fitted to: by frequency, whitened, with its expected size.

The transient of a record's ends is projected out as in the fit. For pure noise of covariance C_k the remaining error is
then (I - Q Q^T) w in whitened real numbers, with Q an orthonormal basis of the whitened transients: it has 2 n n_y less
the rank of Q degrees of freedom. An uncertain model adds J P J^T to the covariance of the whitened error, P the
covariance of its parameters (Pintelon and Schoukens, System Identification, 2nd ed., 2012, section 11.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.identification.maximum_likelihood import Residual, block_residual, whitened_transient, whitener
from avis_ctrl.identification.response import FrequencyModel
from avis_ctrl.identification.spectral_block import SpectralBlock


@dataclass(frozen=True, eq=False)
class PredictionError(Residual):
    """Prediction error of one block, with the noise that it is compared with.

    Attributes
    ----------
    derivative : (n_p, n, n_y, m) of the whitened model output by the parameters, transients projected out; unit as
        `white`. Empty if not requested.
    dof : real degrees of freedom of the error. output_dof : (n_y,) of each output's own error.
    """

    derivative: np.ndarray
    dof: int
    output_dof: np.ndarray

    @property
    def chi2(self) -> float:
        """Sum of `dof` squares that should be standard normal."""
        return float(2 * np.sum(np.abs(self.white) ** 2))

    @property
    def output_chi2(self) -> np.ndarray:
        """(n_y,) the same for each output separately, relative to its own variance."""
        # 1/variance of an estimate is too large by dof/(dof - 1).
        dof = self.block.dof
        variance = self._variance if np.isinf(dof) else self._variance * dof / (dof - 1)
        return np.sum(2 * np.abs(self.error) ** 2 / variance, axis=(0, 2))

    @property
    def _variance(self) -> np.ndarray:
        """(n, n_y, 1 or m) noise variance of each output."""
        assert self.block.noise is not None
        return np.real(np.einsum("kmii->kim", self.block.noise))

    def noise_share(self) -> np.ndarray:
        """(n_y,) expected sum of |noise|^2 in each output's error if it is noise only."""
        whole = np.sum(np.broadcast_to(self._variance, self.error.shape), axis=(0, 2))
        return whole * self.output_dof / (2 * self.error.shape[0] * self.error.shape[2])

    def expected(self, covariance: np.ndarray) -> float:
        """Mean of chi2 if the covariance (n_p, n_p) of the parameters explains all errors of the model."""
        J = np.sqrt(2) * self.derivative.reshape(len(covariance), -1)
        return self.dof + float(np.real(np.einsum("ik,ij,jk->", J.conj(), covariance, J, optimize=True)))


def prediction_error(model: FrequencyModel, block: SpectralBlock, derivative: bool = True) -> PredictionError:
    """Prediction error of a model on a block with known noise.

    Raises
    ------
    InputError : a noise covariance that is missing or singular.
    """
    L, (n, n_y, m) = whitener(block), block.Y.shape
    _, J, left = block_residual(model, block, L, derivative=derivative)
    lost, rank = np.zeros(n_y), 0
    if block.transient:
        basis = whitened_transient(model, block, L)[2]
        rank, lost = basis.shape[1], _lost(L, basis, block)
    slopes = _complex(J, (n, n_y, m)) / np.sqrt(2) if derivative else np.empty((0, n, n_y, m), complex)
    return PredictionError(block, left.plain, left.error, left.white, slopes, 2 * n * n_y * m - rank, 2 * n * m - lost)


def _lost(L: np.ndarray, basis: np.ndarray, block: SpectralBlock) -> np.ndarray:
    """(n_y,) degrees of freedom of each output that the transient takes."""
    assert block.noise is not None
    n, n_y = block.Y.shape[:2]
    columns = np.linalg.solve(L[:, 0], np.moveaxis(_complex(basis.T, (n, n_y, 1))[..., 0], 0, -1))
    return np.sum(2 * np.abs(columns) ** 2 / np.real(np.einsum("kii->ki", block.noise[:, 0]))[..., None], axis=(0, 2))


def _complex(real: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(..., 2 N) real numbers back to (..., *shape) complex ones."""
    half = real.shape[-1] // 2
    return (real[..., :half] + 1j * real[..., half:]).reshape(*real.shape[:-1], *shape)


def interval(expected: float, dof: float, noise_dof: float, level: float = 0.95) -> tuple[float, float]:
    """Interval that contains chi2 / dof with probability `level`, if the noise was estimated with noise_dof real
    numbers.

    It is a ratio of variances, with Fisher's F distribution, scaled to its mean `expected` (of chi2 / dof).
    """
    law = stats.f(dof, noise_dof) if np.isfinite(noise_dof) else stats.chi2(dof, scale=1 / dof)
    low, high = law.ppf([(1 - level) / 2, (1 + level) / 2]) / law.mean() * expected
    return float(low), float(high)
