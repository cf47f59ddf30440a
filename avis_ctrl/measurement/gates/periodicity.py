"""Gate for periodic records: how many periods contain the initial transient, and whether the others repeat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, curves, percent, quoted, those, times


@dataclass(frozen=True)
class PeriodicitySettings:
    """smooth : number of lines over which the noise level is averaged.
    drift : fraction of the signal below which a steady drift over the last half of the record is accepted [1].
    """

    smooth: int = 9
    drift: float = 0.01


SETTINGS = PeriodicitySettings()


@dataclass(frozen=True, eq=False)
class _Kept:
    """T (periods, n_y): mean over lines of |difference from the reference|^2 / its variance; 1 on average for noise."""

    record: str
    period_s: float
    T: np.ndarray
    relative: np.ndarray
    lines: int
    dof: int
    drift: tuple[np.ndarray, np.ndarray] | None = None


class Periodicity(Gate):
    """Comparison of each period with the mean of the last half, line by line and channel by channel.

    Differences are Hann-windowed, which keeps low frequencies from leaking into all lines. With noise variances from
    the reference periods, smoothed over 9 lines, T is F(L, L (R - 1)) distributed for L independent lines and R
    reference periods; 1 % is divided among periods, channels and records. All periods up to the last failing one before
    the reference should be dropped: a note, because a rig that starts at rest always has a transient. If a period of
    the reference itself fails, or if the periods of the reference change steadily (slope against its residual,
    F(L, L (R - 2)), and more than 1 % of the signal), the response drifts: a warning.
    """

    name = "periodicity"

    def look(self, seen: Excerpt) -> _Kept | None:
        if not seen.periodic or not seen.driven or len(y := seen.periods("y")) < 4:
            return None
        T, relative, lines, R = compared(y)
        drift = trend(y[len(y) - R :]) if R > 2 else None
        return _Kept(seen.header.name, seen.header.period_s or 0.0, T, relative, lines, R - 1, drift)

    def conclude(self, kept: list[_Kept | None]) -> list[Finding]:
        judged = [k for k in kept if k is not None]
        if not judged:
            sentence = "Periodicity was not tested: no record is periodic with four periods or more."
            return [Finding(self.name, "ok", sentence)]
        level = FINDING.false_alarm / sum(k.T.size for k in judged)
        found: list[Finding] = []
        drops: list[tuple[int, _Kept, float, Picture]] = []
        for k in judged:
            limit = float(stats.f.isf(level, k.lines, k.lines * k.dof))
            picture = Picture(
                f"Record {k.record}: periods against the last {len(k.T) // 2}",
                "period",
                "difference by noise, power [-]",
                curves(self.campaign.y_names, np.arange(1, len(k.T) + 1), k.T, "points"),
                (Limit("1 % limit for noise", limit),),
                y_scale="log",
            )
            failed = np.flatnonzero((limit < k.T).any(axis=1))
            drop = int(failed[-1]) + 1 if len(failed) else 0
            if warned := self._unsteady(k, drop, limit, level, picture):
                found.append(warned)
            else:
                drops.append((drop, k, limit, picture))
        if not drops:
            return found
        most, k, limit, picture = max(drops, key=lambda d: d[0])
        if most:
            periods = f"{most} period{'s' if most > 1 else ''}"
            sentence = (
                f"The initial transient lasts {periods} of {k.period_s:g} s (record {k.record}: the first differs from "
                f"the last ones by {100 * k.relative[0].max():.2g} % of the signal). A fit that includes the "
                "transient, as in avis identify, needs no change; otherwise leave out the beginning of each record, "
                f"{periods}."
            )
            records = tuple(d[1].record for d in drops if d[0])
            found.append(Finding(self.name, "note", sentence, (), records, most, 0.0, picture))
        largest = k.T.max()
        sentence = (
            f"All periods repeat within the noise (largest ratio {largest:.2f}, limit for noise alone {limit:.2f})."
        )
        return found or [Finding(self.name, "ok", sentence, value=largest, limit=limit, picture=picture)]

    def _unsteady(self, k: _Kept, drop: int, limit: float, level: float, picture: Picture) -> Finding | None:
        """Finding if the periods of the reference change steadily, or differ."""
        P = len(k.T)
        bad: np.ndarray = np.zeros(len(self.campaign.y_names), bool)
        if k.drift is not None:
            T, drift = k.drift
            of_drift = float(stats.f.isf(level, k.lines, k.lines * (k.dof - 1)))
            bad = (of_drift < T) & (drift > SETTINGS.drift)
        if bad.any():
            names, largest, limit = those(self.campaign.y_names, bad), T[bad].max(), of_drift
            said = (
                f"drifts: over its last {P // 2} periods of {k.period_s:g} s {quoted(names)} change steadily by "
                f"{percent(drift[bad].max())} of the signal ({times(float(largest))} the noise power; limit for noise "
                f"alone {limit:.2f})"
            )
        elif drop > P - P // 2:
            names, largest = (
                those(self.campaign.y_names, np.any(k.T[P - P // 2 :] > limit, axis=0)),
                k.T[drop - 1].max(),
            )
            said = (
                f"has not settled after {drop} of {P} periods of {k.period_s:g} s: {quoted(names)} still differ by "
                f"{times(float(np.sqrt(largest)))} the noise, {percent(k.relative[drop - 1].max())} of the signal"
            )
        else:
            return None
        sentence = (
            f"Record {k.record} {said}. The rig drifts, or the transient is longer than the record. Wait longer before "
            "recording, or find the cause of the drift."
        )
        return Finding(self.name, "warning", sentence, names, (k.record,), largest, limit, picture)


def windowed(difference: np.ndarray) -> np.ndarray:
    """(..., lines, n_y) spectra of Hann-windowed differences (..., samples, n_y): every second line, no mean."""
    n = difference.shape[-2]
    window = np.hanning(n + 1)[:-1, None] * np.sqrt(8 / 3)
    return np.fft.rfft(difference * window, axis=-2)[..., 2:-1:2, :]


def smoothed(power: np.ndarray, width: int = SETTINGS.smooth) -> np.ndarray:
    """(lines, n_y) moving mean over lines."""
    kernel = np.ones(min(width, len(power)))
    count = np.convolve(np.ones(len(power)), kernel, "same")
    return np.stack([np.convolve(power[:, j], kernel, "same") / count for j in range(power.shape[1])], axis=1)


def compared(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, int]:
    """T (P, n_y), relative difference (P, n_y), numbers of lines and of reference periods for y (P, samples, n_y)."""
    P = len(y)
    R = P // 2
    reference = y[P - R :].mean(axis=0)
    of = windowed(y[P - R :] - reference)
    variance = smoothed(np.sum(np.abs(of) ** 2, axis=0) / (R - 1))
    rms = np.maximum((reference - reference.mean(axis=0)).std(axis=0), 1e-300)
    # A simulated record without noise repeats only up to rounding.
    variance = np.maximum(variance, (1e-9 * (rms + 1e-3 * np.abs(reference).max(axis=0))) ** 2 * y.shape[1] + 1e-300)
    T, relative = np.zeros((P, y.shape[2])), np.zeros((P, y.shape[2]))
    for p in range(P):
        others = reference if p < P - R else (reference * R - y[p]) / (R - 1)
        n = R if p < P - R else R - 1
        T[p] = np.mean(np.abs(windowed(y[p] - others)) ** 2 / (variance * (1 + 1 / n)), axis=0)
        relative[p] = (y[p] - others).std(axis=0) / rms
    return unbiased(R - 1) * T, relative, len(variance), R


def unbiased(dof: int) -> float:
    """Correction of T for the smoothed variance: F has the mean 1 / (1 - 1 / m), m = dof times lines smoothed over."""
    return 1 - 1 / (SETTINGS.smooth * dof)


def trend(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear drift over periods y (R, samples, n_y): T (n_y,) of its lines against the residual, relative size (n_y,).

    Without drift, T is F(L, L (R - 2)) distributed. The size is from the first period to the last, noise subtracted.
    """
    R = len(y)
    x = np.arange(R) - (R - 1) / 2
    slope = np.tensordot(x, y, 1) / np.sum(x * x)
    left = windowed(y - y.mean(axis=0) - x[:, None, None] * slope)
    rms = np.maximum(y.mean(axis=0).std(axis=0), 1e-300)
    floor = (1e-9 * (rms + 1e-3 * np.abs(y).max(axis=(0, 1)))) ** 2 * y.shape[1] + 1e-300
    variance = np.maximum(smoothed(np.sum(np.abs(left) ** 2, axis=0) / (R - 2)), floor) / np.sum(x * x)
    power = np.abs(windowed(slope)) ** 2
    size = np.sum(np.abs(windowed(y.mean(axis=0))) ** 2, axis=0)
    drift = np.sqrt(np.maximum(np.sum(power - variance, axis=0), 0) / np.maximum(size, 1e-300)) * (R - 1)
    return unbiased(R - 2) * np.mean(power / variance, axis=0), drift
