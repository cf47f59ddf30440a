"""Lines of a record that hold noise alone, whatever the drives do and whatever the model lacks.

Periodic records: lines at least two away from every harmonic of the period, which a Hann window keeps free of all that
responds to u periodically, nonlinear or not. Records at rest: all lines. Others: what a local linear regression of the
residual on u leaves, jointly over the records, with a response that is a parabola in frequency over each window
(Pintelon and Schoukens 2012, section 7.2), so that dynamics that the model lacks are not taken for noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from avis_ctrl.gap.signals.record_residual import RecordResidual


@dataclass(frozen=True)
class QuietLineSettings:
    """Of the lines that hold noise alone.

    least_periods : periods from which lines between the harmonics are used: with fewer, none is two lines away from
        every harmonic.
    narrow : window of the local regression where modes are [lines]: their response is a parabola over it.
    wide : window far above the modes [lines]: many data for each parameter.
    order : order of the response over a narrow window [1].
    least_left : a line counts if the regression leaves this fraction of its noise at least [1]: below, its level
        hangs on the model of the window.
    rounds : rounds of weighting records by their noise: louder ones must not spoil the others.
    smoothed : windows over which that weight is averaged.
    outlier : power of a line over the median of its window above which it is no noise [1]: exponential noise is
        once in 1e12.
    """

    least_periods: int = 4
    narrow: int = 15
    wide: int = 120
    order: int = 2
    least_left: float = 0.2
    rounds: int = 2
    smoothed: int = 9
    outlier: float = 40.0


SETTINGS = QuietLineSettings()


@dataclass(frozen=True, eq=False)
class QuietLines:
    """Noise of one record: e (n, n_y) at frequency_Hz (n,), with E[e e^H] = left C of the noise; left (n,) from 0 to 1.

    level : r.m.s. of u [V], over its channels.
    """

    level: float
    frequency_Hz: np.ndarray
    e: np.ndarray
    left: np.ndarray

    @property
    def power(self) -> np.ndarray:
        """(n, n_y) unbiased for the noise's variance, white noise of variance s^2 having s^2."""
        return np.abs(self.e) ** 2 / self.left[:, None]


def quiet_lines(left: Sequence[RecordResidual], band_Hz: tuple[float, float], narrow: bool,
                polluted: Sequence[np.ndarray] | None = None) -> tuple[QuietLines, ...]:
    """Of each record, in a band.

    narrow : windows for the band of the modes; otherwise wide ones.
    polluted : masks (lines,) of lines to leave out, one a record.
    """
    found: dict[int, QuietLines] = {}
    regressed: dict[tuple[int, float], list[int]] = {}
    inside = []
    for k, one in enumerate(left):
        keep = (one.frequency_Hz >= band_Hz[0]) & (one.frequency_Hz <= band_Hz[1])
        if polluted is not None:
            keep &= ~polluted[k]
        inside.append(keep)
        if one.silent:
            found[k] = _plain(one, keep)
        elif one.periods >= SETTINGS.least_periods:
            away = np.arange(len(keep)) % one.periods
            found[k] = _plain(one, keep & (away >= 2) & (away <= one.periods - 2))
        else:
            regressed.setdefault((len(keep), one.header.sample_rate_Hz), []).append(k)
    for ks in regressed.values():
        for k, made in zip(ks, _regression([left[k] for k in ks], [inside[k] for k in ks], narrow), strict=True):
            found[k] = made
    return tuple(found[k] for k in range(len(left)))


def _plain(one: RecordResidual, keep: np.ndarray) -> QuietLines:
    return QuietLines(_level(one), one.frequency_Hz[keep], one.E[keep], np.ones(int(keep.sum())))


def _level(one: RecordResidual) -> float:
    return float(np.sqrt(np.mean(one.u ** 2)))


def _regression(left: Sequence[RecordResidual], keep: Sequence[np.ndarray], narrow: bool) -> list[QuietLines]:
    """Residuals of e on u, (1, x, x^2) u over each window of lines common to the records, with what they are left."""
    lines = np.flatnonzero(np.any(keep, axis=0))
    n_u, R = left[0].u.shape[1], len(left)
    order = SETTINGS.order if narrow else 1
    width = SETTINGS.narrow if narrow else SETTINGS.wide
    # One parameter in two data at most, so that noise is left.
    width = max(width, int(np.ceil(2 * (order + 1) * n_u / R)))
    blocks = len(lines) // width
    if not blocks:
        return [_plain(one, np.zeros(len(one.E), bool)) for one in left]
    at = lines[:blocks * width].reshape(blocks, width)
    x = np.linspace(-1, 1, width)[:, None] ** np.arange(order + 1)
    U = np.stack([one.U[at] for one in left], axis=1)
    # Scaled line by line only by powers that all records share, so that columns of silent bands stay harmless.
    A = (U[:, :, :, None, :] * x[None, None, :, :, None]).reshape(blocks, R * width, -1)
    A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
    E = np.stack([one.E[at] for one in left], axis=1).reshape(blocks, R * width, -1)
    size, lines_of_noise = np.ones((blocks, R)), np.ones((blocks, R, width), bool)
    # Records that clip or distort are louder: weighted by what they leave, they do not spoil the others.
    for _ in range(SETTINGS.rounds):
        weight = np.where(lines_of_noise, 1 / size[:, :, None], 1e-4 / size[:, :, None]).reshape(blocks, -1)
        rest, share = _residual(A, E, weight, R)
        line = np.sum(np.abs(rest) ** 2, axis=3)
        # Lines of machines or mains would be spread over their window.
        lines_of_noise &= line <= SETTINGS.outlier * np.median(line, axis=2, keepdims=True)
        power = np.sum(line * lines_of_noise, axis=2) / np.maximum(np.sum(share * lines_of_noise, axis=2), 1e-3 * width)
        size = np.sqrt(uniform_filter1d(power, SETTINGS.smoothed, axis=0, mode="nearest")) + 1e-300
    made = []
    for k, one in enumerate(left):
        good = (share[:, k] > SETTINGS.least_left) & keep[k][at] & lines_of_noise[:, k]
        made.append(QuietLines(_level(one), one.frequency_Hz[at[good]], rest[:, k][good], share[:, k][good]))
    return made


def _residual(A: np.ndarray, E: np.ndarray, weight: np.ndarray, records: int) -> tuple[np.ndarray, np.ndarray]:
    """What a weighted regression leaves, (blocks, records, width, n_y), and the part of the noise left in each."""
    Q, _ = np.linalg.qr(A * weight[:, :, None])
    W = E * weight[:, :, None]
    adjoint = np.conj(Q.swapaxes(1, 2))
    rest = (W - Q @ (adjoint @ W)) / weight[:, :, None]
    # Diagonal of (I - P) Sigma (I - P), P = Q Q^H: the window makes neighbouring lines of noise alike as it does those
    # of u, so that a regression takes more of the noise than its number of parameters says.
    SQ = _hann_covariance(Q.reshape(len(A), records, -1, Q.shape[2])).reshape(Q.shape)
    middle = adjoint @ SQ
    share = 1 - 2 * np.real(np.sum(SQ * np.conj(Q), axis=2)) + np.real(np.sum((Q @ middle) * np.conj(Q), axis=2))
    return rest.reshape(len(A), records, -1, E.shape[2]), share.reshape(len(A), records, -1)


def _hann_covariance(Q: np.ndarray) -> np.ndarray:
    """Sigma Q along the lines (axis 2): white noise under a Hann window, -2/3 one line apart and 1/6 two."""
    out = Q.copy()
    for lag, rho in ((1, -2 / 3), (2, 1 / 6)):
        out[:, :, lag:] += rho * Q[:, :, :-lag]
        out[:, :, :-lag] += rho * Q[:, :, lag:]
    return out
