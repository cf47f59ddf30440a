"""Lines of a record that contain noise alone, whatever the drives do and whatever the model lacks.

Periodic records: lines at least two lines away from every harmonic of the period, which a Hann window keeps free of all
periodic response to u, linear or not. Records at rest: all lines. Others: what remains of the residual after a local
linear regression on u, jointly over the records, with a response that is a parabola in frequency over each window
(Pintelon and Schoukens 2012, section 7.2), so that missing dynamics do not count as noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from avis_ctrl.gap.signals.record_residual import RecordResidual


@dataclass(frozen=True)
class QuietLineSettings:
    """Settings of the lines that contain noise alone.

    least_periods : number of periods from which lines between the harmonics are used: with fewer, no line is two lines
        away from every harmonic.
    narrow : window of the local regression in the band of the modes [lines]: their response is a parabola over it.
    wide : window far above the modes [lines]: many data for each parameter.
    order : order of the response over a narrow window [1].
    least_left : minimum fraction of a line's noise that must remain after the regression for the line to count [1]:
        below, its level depends on the model of the window.
    rounds : iterations in which records are weighted by their noise: louder records must not spoil the others.
    smoothed : number of windows over which that weight is averaged.
    at_once : number of windows whose regressions are computed together, to limit memory.
    outlier : power of a line over the median of its window above which it is not noise [1]: exponential noise exceeds
        it with probability 1e-12.
    """

    least_periods: int = 4
    narrow: int = 15
    wide: int = 120
    order: int = 2
    least_left: float = 0.2
    rounds: int = 2
    smoothed: int = 9
    at_once: int = 32
    outlier: float = 40.0


SETTINGS = QuietLineSettings()


@dataclass(frozen=True, eq=False)
class QuietLines:
    """Noise of one record: e (n, n_y) at frequency_Hz (n,), with E[e e^H] = left C, C that of the noise; left (n,) from
    0 to 1.

    level : r.m.s. of u [V], over its channels.
    """

    level: float
    frequency_Hz: np.ndarray
    e: np.ndarray
    left: np.ndarray

    @property
    def power(self) -> np.ndarray:
        """(n, n_y) unbiased estimates of the noise variance; white noise of variance s^2 has s^2."""
        return np.abs(self.e) ** 2 / self.left[:, None]


def quiet_lines(
    residuals: Sequence[RecordResidual],
    band_Hz: tuple[float, float],
    narrow: bool,
    polluted: Sequence[np.ndarray] | None = None,
) -> tuple[QuietLines, ...]:
    """Quiet lines of each record, in a band.

    narrow : use narrow windows, for the band of the modes; otherwise wide ones.
    polluted : masks (lines,) of lines to leave out, one per record.
    """
    found: dict[int, QuietLines] = {}
    regressed: dict[tuple[int, float], list[int]] = {}
    inside = []
    for k, one in enumerate(residuals):
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
        for k, made in zip(ks, _regression([residuals[k] for k in ks], [inside[k] for k in ks], narrow), strict=True):
            found[k] = made
    return tuple(found[k] for k in range(len(residuals)))


def _plain(one: RecordResidual, keep: np.ndarray) -> QuietLines:
    return QuietLines(_level(one), one.frequency_Hz[keep], one.E[keep], np.ones(int(keep.sum())))


def _level(one: RecordResidual) -> float:
    return float(np.sqrt(np.mean(one.u**2)))


def _regression(residuals: Sequence[RecordResidual], keep: Sequence[np.ndarray], narrow: bool) -> list[QuietLines]:
    """Residuals of e after regression on (1, x, x^2) u over each window of lines common to the records, and the
    fraction of noise that remains in them."""
    lines = np.flatnonzero(np.any(keep, axis=0))
    n_u, R = residuals[0].u.shape[1], len(residuals)
    order = SETTINGS.order if narrow else 1
    width = SETTINGS.narrow if narrow else SETTINGS.wide
    # At most one parameter for two data, so that noise remains.
    width = max(width, int(np.ceil(2 * (order + 1) * n_u / R)))
    blocks = len(lines) // width
    if not blocks:
        return [_plain(one, np.zeros(len(one.E), bool)) for one in residuals]
    at = lines[: blocks * width].reshape(blocks, width)
    x = np.linspace(-1, 1, width)[:, None] ** np.arange(order + 1)
    U = np.stack([one.U[at] for one in residuals], axis=1)
    # Columns are normalised over all records together; columns of silent bands stay harmless.
    A = (U[:, :, :, None, :] * x[None, None, :, :, None]).reshape(blocks, R * width, -1)
    A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
    E = np.stack([one.E[at] for one in residuals], axis=1).reshape(blocks, R * width, -1)
    size, lines_of_noise = np.ones((blocks, R)), np.ones((blocks, R, width), bool)
    # Records that clip or distort are louder: weighted by their residual, they do not spoil the others.
    for _ in range(SETTINGS.rounds):
        weight = np.where(lines_of_noise, 1 / size[:, :, None], 1e-4 / size[:, :, None]).reshape(blocks, -1)
        some = [slice(start, start + SETTINGS.at_once) for start in range(0, blocks, SETTINGS.at_once)]
        parts = [_residual(A[one], E[one], weight[one], R) for one in some]
        rest, share = (np.concatenate(one) for one in zip(*parts, strict=True))
        line = np.sum(np.abs(rest) ** 2, axis=3)
        # Machine or mains lines would otherwise be spread over their window.
        lines_of_noise &= line <= SETTINGS.outlier * np.median(line, axis=2, keepdims=True)
        power = np.sum(line * lines_of_noise, axis=2) / np.maximum(np.sum(share * lines_of_noise, axis=2), 1e-3 * width)
        size = np.sqrt(uniform_filter1d(power, SETTINGS.smoothed, axis=0, mode="nearest")) + 1e-300
    made = []
    for k, one in enumerate(residuals):
        good = (share[:, k] > SETTINGS.least_left) & keep[k][at] & lines_of_noise[:, k]
        made.append(QuietLines(_level(one), one.frequency_Hz[at[good]], rest[:, k][good], share[:, k][good]))
    return made


def _residual(A: np.ndarray, E: np.ndarray, weight: np.ndarray, records: int) -> tuple[np.ndarray, np.ndarray]:
    """Residual of a weighted regression, (blocks, records, width, n_y), and the fraction of the noise that remains in
    each line."""
    Q, _ = np.linalg.qr(A * weight[:, :, None])
    W = E * weight[:, :, None]
    adjoint = np.conj(Q.swapaxes(1, 2))
    rest = (W - Q @ (adjoint @ W)) / weight[:, :, None]
    # Diagonal of (I - P) Sigma (I - P), P = Q Q^H: the window correlates neighbouring lines of the noise as it does
    # those of u, so that a regression removes more of the noise than its number of parameters suggests.
    SQ = _hann_covariance(Q.reshape(len(A), records, -1, Q.shape[2])).reshape(Q.shape)
    middle = adjoint @ SQ
    share = 1 - 2 * np.real(np.sum(SQ * np.conj(Q), axis=2)) + np.real(np.sum((Q @ middle) * np.conj(Q), axis=2))
    return rest.reshape(len(A), records, -1, E.shape[2]), share.reshape(len(A), records, -1)


def _hann_covariance(Q: np.ndarray) -> np.ndarray:
    """Sigma Q along the lines (axis 2): white noise under a Hann window, with correlation -2/3 one line apart and 1/6
    two."""
    out = Q.copy()
    for lag, rho in ((1, -2 / 3), (2, 1 / 6)):
        out[:, :, lag:] += rho * Q[:, :, :-lag]
        out[:, :, :-lag] += rho * Q[:, :, lag:]
    return out
