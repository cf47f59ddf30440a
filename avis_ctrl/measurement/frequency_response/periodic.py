"""Periods of periodic records: when they have settled, their mean, and the covariance of their noise.

A record starts from rest, so its first periods contain a transient. Either these periods are dropped (`settled_after`),
or the transient is removed (`average(..., remove=True)`): on the lines of the whole record between the harmonics of the
period there is only transient and noise. The transient is smooth over frequency, so it can be interpolated on the
harmonics with local polynomials through these lines (Pintelon and Schoukens, System Identification, 2nd ed., 2012,
section 7.3, robust local polynomial method), or with rational functions near a sharp mode. The residuals give the noise
covariance with many more degrees of freedom than the differences of a few periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft, stats

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.measurement.frequency_response.spectra import Channels


@dataclass(frozen=True)
class PeriodicSettings:
    """Settings of the methods for periodic records, here and in `best_linear` and `distortion_lines`.

    block : number of lines over which the power of an output is summed before periods are compared: 16 degrees of
        freedom per record.
    false_alarm : probability of dropping a settled period, over all blocks and outputs; small, because it costs data.
    degree : degree of the transient's polynomials, that of the local polynomial method.
    same_level : relative difference of r.m.s. levels up to which two records count as having the same level: the levels
        of realisations scatter.
    excited_power, excited_over_noise : a line is excited if the mean power of an input exceeds this fraction of its
        largest value (-60 dB), and this many times its noise (noise alone does so with a probability of at most e^-30).
    excited_amplitude : ratio of amplitudes that corresponds to `excited_power`, for a single record whose noise is not
        known.
    repeated : power of the difference between the inputs of two experiments, relative to their power, below which they
        are repetitions of one experiment; for inputs with independent phases the value is 2.
    dependent : eigenvalue of the inputs' Gram matrix, scaled to unit diagonal, below which the responses cannot be
        separated: they would have 10^4 times the noise.
    """

    block: int = 8
    false_alarm: float = 1e-3
    degree: int = 2
    same_level: float = 0.05
    excited_power: float = 1e-6
    excited_over_noise: float = 30.0
    excited_amplitude: float = 1e-3
    repeated: float = 1e-2
    dependent: float = 1e-8


SETTINGS = PeriodicSettings()


@dataclass(frozen=True, eq=False)
class PeriodMean:
    """Mean period of inputs and outputs on harmonics of the period.

    Z : (n, n_u + n_y) transform of the mean period divided by sqrt(samples of a period), inputs first.
    covariance : (n, n_z, n_z) noise covariance of Z, or None for a single period; dof : its degrees of freedom;
    periods : number of periods averaged.
    """

    Z: np.ndarray
    covariance: np.ndarray | None
    dof: int
    periods: int


def periodic_records(campaign: Campaign, level_V: float | None) -> tuple[RecordSource, ...]:
    """Records with multisine excitation, of one period and one level.

    Raises
    ------
    InputError : no such record, several periods, several levels without a choice (a best linear approximation is valid
        for one level).
    """
    found = [r for r in campaign.records if r.header.excitation == "multisine" and r.header.periods >= 1]
    if not found:
        message = "expected multisine records of at least one period; use local_polynomial for other records"
        raise InputError(message, field="records", value=[r.header.excitation for r in campaign.records])
    if level_V is not None:
        levels = sorted({r.header.level_V for r in found})
        found = [r for r in found if abs(r.header.level_V - level_V) <= SETTINGS.same_level * abs(level_V)]
        if not found:
            raise InputError(f"expected one of the levels {levels}", field="level_V", value=level_V)
    levels = sorted({r.header.level_V for r in found})
    if levels[-1] - levels[0] > SETTINGS.same_level * levels[-1]:
        message = (
            "the records have several levels, and the response of a nonlinear rig depends on the level: choose one"
        )
        raise InputError(message, field="level_V", value=levels)
    periods = sorted({r.header.period_s for r in found if r.header.period_s is not None})
    if len(periods) > 1:
        message = "expected records of one period; select them with Campaign.only"
        raise InputError(message, field="period_s", value=periods)
    return tuple(found)


def periods_of(record: RecordSource, used: Channels) -> np.ndarray:
    """(periods, samples, n_u + n_y) whole periods; samples after the last whole period are left out."""
    n, count = record.header.period_samples or 0, record.header.periods
    return np.hstack(used.of(record.load(0, n * count))).reshape(count, n, -1)


def settled_after(records: Sequence[RecordSource], used: Channels, keep: slice) -> tuple[int, bool]:
    """Number of periods to drop before the outputs repeat, and whether the others are settled.

    The power of the difference of consecutive periods, over blocks of 8 lines and all records, is compared with that of
    the last two periods by an F test (0.1 % over all blocks and outputs). At least two periods are kept. With fewer
    than three periods no comparison is possible: (0, False).
    """
    n_u, count = len(used.inputs), min(record.header.periods for record in records)
    if count < 3:
        return 0, False
    power: np.ndarray | float = 0.0
    for record in records:
        Y = fft.rfft(periods_of(record, used)[:count, :, n_u:], axis=1)[:, keep]
        square = np.abs(np.diff(Y, axis=0)) ** 2
        starts = np.arange(0, max(square.shape[1] - SETTINGS.block, 0) + 1, SETTINGS.block)
        power = power + np.add.reduceat(square, starts, axis=1)
    power = np.asarray(power)
    dof = 2 * SETTINGS.block * len(records)
    limit = stats.f(dof, dof).isf(SETTINGS.false_alarm / power[0].size)
    moving = [bool(np.any(p > limit * power[-1] + 1e-24 * power.max())) for p in power[:-1]]
    if not any(moving):
        return 0, True
    last = max(p for p, yes in enumerate(moving) if yes)
    # If even the last testable difference is significant, the reference may contain a transient too.
    return last + 1, last + 1 < count - 2


def average(record: RecordSource, used: Channels, keep: slice, drop: int, remove: bool) -> PeriodMean:
    """Mean period on the harmonics `keep` after some periods are dropped, with its noise covariance.

    Raises
    ------
    InputError : no period remains; removal of the transient with fewer than two periods or too few harmonics.
    """
    x = periods_of(record, used)[drop:]
    count, n = x.shape[:2]
    if count < 1 or (remove and count < 2):
        also = " and the removal of a transient needs two" if remove else ""
        raise record.header.error("periods", f"expected at least {drop + 1 + remove} periods: {drop} are dropped{also}")
    if remove:
        return _without_transient(x.reshape(count * n, -1), count, keep, len(used.inputs), record.header.name)
    X = fft.rfft(x, axis=1)[:, keep] / np.sqrt(n)
    mean = X.mean(axis=0)
    if count == 1:
        return PeriodMean(mean, None, 0, 1)
    E = np.moveaxis(X - mean, 0, 1)
    return PeriodMean(mean, np.swapaxes(E, 1, 2) @ E.conj() / ((count - 1) * count), count - 1, count)


def _without_transient(x: np.ndarray, count: int, keep: slice, n_u: int, name: str) -> PeriodMean:
    """Mean period minus the transient, from polynomials over `side` harmonics of whole-record lines on each side."""
    X = fft.rfft(x, axis=0) / np.sqrt(x.shape[0])
    n_z, last = X.shape[1], (X.shape[0] - 1) // count
    side = 1
    while 2 * side * (count - 1) < SETTINGS.degree + 1 + max(4, n_z // 2):
        side += 1
    harmonic = np.arange(keep.start, keep.stop)
    if 2 * side > last:
        message = f"expected at least {2 * side} harmonics of the period below half the sample rate"
        raise InputError(message, field=f"record {name}: period_s", value=last)
    base = np.clip(harmonic, side, last - side)
    offset = np.array([j for j in range(-side * count + 1, side * count) if j % count])
    span = offset / (side * count)
    basis = np.vander(span, SETTINGS.degree + 1, increasing=True)
    shift = (harmonic - base) / side
    weight = np.vander(shift, SETTINGS.degree + 1, increasing=True) @ np.linalg.pinv(basis)
    around = X[count * base[:, None] + offset]
    free = np.eye(offset.size) - basis @ np.linalg.pinv(basis)
    around, a = _times_denominator(around, span, free, n_u, shift == 0)
    transient = np.einsum("nj,njz->nz", weight, around)
    E = free @ around
    dof = offset.size - SETTINGS.degree - 1
    # The residual is a V instead of V, and has two degrees of freedom less for all outputs together.
    rows = dof * (n_z - n_u)
    shrink = np.mean(np.abs(a) ** 2, axis=1) * np.where(np.all(a == 1, axis=1), 1.0, (rows - 2) / rows)
    E[:, :, n_u:] /= np.sqrt(shrink)[:, None, None]
    leverage = 1 + np.sum(weight**2, axis=1)
    covariance = np.swapaxes(E, 1, 2) @ E.conj() * (leverage / (dof * count))[:, None, None]
    return PeriodMean((X[count * harmonic] - transient) / np.sqrt(count), covariance, dof, count)


def _times_denominator(
    around: np.ndarray, span: np.ndarray, free: np.ndarray, n_u: int, centred: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Outputs around each harmonic, multiplied by a(d) = 1 + a1 d + a2 d^2 where this makes the transient a polynomial.

    Near a sharp mode the transient is a rational function; all outputs have the same pole. The denominator is found by
    least squares. On noise alone it reduces the residual to 4/9 on average (1 - 5/3 d^2). It is therefore used only
    where the reduction is significantly larger, and not at the ends of the band, where the harmonic is not at d = 0.

    Returns the lines (n, m, n_z) and a (n, m), 1 where it is not used.
    """
    Y = around[:, :, n_u:]
    plain = free @ Y
    size = np.sqrt(np.mean(np.abs(plain) ** 2, axis=1))
    size = np.where(size > 0, size, 1.0)[:, None, :]
    first, second = (free @ (Y * (span**s)[:, None]) / size for s in (1, 2))
    n = len(Y)
    K = np.stack([first.reshape(n, -1), second.reshape(n, -1)], axis=2)
    right = (plain / size).reshape(n, -1, 1)
    q, r = np.linalg.qr(K)
    solvable = np.abs(r[:, 1, 1]) > 1e-12 * np.abs(r[:, 0, 0])
    r = np.where(solvable[:, None, None], r, np.eye(2))
    along = np.swapaxes(q.conj(), 1, 2) @ right
    unknown = -np.linalg.solve(r, along)[:, :, 0]
    left = np.sum(np.abs(right - q @ along) ** 2, axis=(1, 2))
    spare = (free.shape[0] - SETTINGS.degree - 1) * Y.shape[2] - 2
    if spare < 1:
        return around, np.ones((n, span.size), complex)
    limit = 4 / 9 / stats.f(2 * spare, 2 * spare).isf(0.01)
    use = centred & solvable & (left < limit * np.sum(np.abs(right) ** 2, axis=(1, 2)))
    a = np.where(use[:, None], 1 + unknown[:, :1] * span + unknown[:, 1:] * span**2, 1.0 + 0j)
    return np.concatenate([around[:, :, :n_u], Y * a[:, :, None]], axis=2), a
