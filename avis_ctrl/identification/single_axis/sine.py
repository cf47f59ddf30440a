"""Amplitude and phase of every channel of a sine record, with the covariance of the noise near its line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from avis_ctrl.errors import ComputationError, InputError


@dataclass(frozen=True)
class SineSettings:
    """harmonics : fitted, the fundamental included, so that distortion does not count as noise; higher ones are weak.
    neighbours : lines on either side whose residual gives the noise; two dozen lines give its power to a fifth.
    largest_share : r.m.s. of the unexplained part over that of the sine, above which a channel is not a measurement of
        a sine [1].
    """

    harmonics: int = 7
    neighbours: int = 12
    largest_share: float = 0.2


SETTINGS = SineSettings()


@dataclass(frozen=True, eq=False)
class SineRecord:
    """Phasors X at one frequency; the signal is the real part of X exp(j omega t).

    frequency_Hz : fitted. phasor : (c,) complex. covariance : (c, c) complex, E[e e^H] of the phasor errors.
    harmonics : (c, h - 1) amplitudes of the second and higher harmonics over the fundamental. unexplained : (c,) r.m.s.
    of the residual of sine, harmonics and slow drift, over the r.m.s. of the sine. held : (c,) longest time for which a
    channel stays within 0.1 % of its range from its largest or smallest value, in periods.
    """

    name: str
    frequency_Hz: float
    channels: tuple[str, ...]
    phasor: np.ndarray
    covariance: np.ndarray
    harmonics: np.ndarray
    unexplained: np.ndarray
    held: np.ndarray

    def ratio(self, output: str, reference: str) -> tuple[complex, float]:
        """Y/U and its variance E|error|^2."""
        i, j = (self._index(name) for name in (output, reference))
        H = self.phasor[i] / self.phasor[j]
        row = np.zeros(len(self.channels), complex)
        row[i], row[j] = 1 / self.phasor[j], -H / self.phasor[j]
        return complex(H), float(np.real(row @ self.covariance @ row.conj()))

    def refusal(self, channel: str) -> str:
        """Why this channel is not a sine; empty if it is one."""
        i = self._index(channel)
        if self.unexplained[i] <= SETTINGS.largest_share:
            return ""
        # A sine stays within 0.1 % of its range from one end for 2 % of its period.
        stuck = (
            (
                f"; it stays at one end of its range for {100 * self.held[i]:.0f} % of a period, where a sine does "
                "for 2 %: out of range"
            )
            if self.held[i] > 0.04
            else ""
        )
        return (
            f"record {self.name}, {channel}: the residual of a sine is {100 * self.unexplained[i]:.0f} % of the "
            f"signal{stuck}"
        )

    def _index(self, channel: str) -> int:
        if channel not in self.channels:
            raise InputError(f"expected one of {', '.join(self.channels)}", field="channel", value=channel)
        return self.channels.index(channel)


def fit_sine(name: str, time: np.ndarray, channels: dict[str, np.ndarray], reference: str) -> SineRecord:
    """Fit the frequency on the reference channel (the drive), then all channels at that frequency.

    Raises
    ------
    InputError : a record too short. ComputationError : no sine in the reference, or less than three
    periods.
    """
    y = np.column_stack([*channels.values()])
    n = len(time)
    if n < 64:
        raise InputError("expected at least 64 samples", field=f"record {name}", value=n)
    period = float(time[-1] - time[0]) / (n - 1)
    t = np.arange(n) * period
    frequency = _frequency(name, t, y[:, list(channels).index(reference)])
    count = max(1, min(SETTINGS.harmonics, int(0.45 / period / frequency)))
    X = _columns(t, frequency, count)
    b = np.linalg.lstsq(X, y, rcond=None)[0]
    phasors = b[0 : 2 * count : 2] - 1j * b[1 : 2 * count : 2]
    e = y - X @ b
    amplitude = np.maximum(np.abs(phasors[0]), np.finfo(float).tiny)
    held = np.array([_longest_hold(channel) for channel in y.T]) * period * frequency
    return SineRecord(
        name,
        frequency,
        tuple(channels),
        phasors[0],
        _line_noise(e, frequency * period),
        np.abs(phasors[1:]).T / amplitude[:, None],
        e.std(0) * np.sqrt(2) / amplitude,
        held,
    )


def _frequency(name: str, t: np.ndarray, u: np.ndarray) -> float:
    n, duration = len(t), len(t) * float(t[1])
    spectrum = np.abs(np.fft.rfft((u - u.mean()) * np.hanning(n), 4 * n))
    peak = int(np.argmax(spectrum))
    f = peak / (4 * duration)
    if spectrum[peak] == 0 or f * duration < 3:
        raise ComputationError(
            f"record {name}: no sine found in the reference",
            measured=f"strongest line at {f:.3g} Hz, {f * duration:.2g} periods",
            cause="a channel that is not the drive, or a record shorter than three periods",
            next_step="map the drive's channel as the reference",
        )

    def left(frequency: float) -> float:
        X = _columns(t, frequency, 1)
        return float(np.sum((u - X @ np.linalg.lstsq(X, u, rcond=None)[0]) ** 2))

    found = minimize_scalar(
        left, bounds=(f - 0.5 / duration, f + 0.5 / duration), method="bounded", options={"xatol": 1e-7 / duration}
    )
    return float(found.x)


def _columns(t: np.ndarray, frequency: float, harmonics: int) -> np.ndarray:
    """(n, 2 h + 3) cosines, sines, and a parabola for drift."""
    angle = 2 * np.pi * frequency * t[:, None] * np.arange(1, harmonics + 1)
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=2).reshape(len(t), -1)
    drift = (2 * t / t[-1] - 1)[:, None] ** np.arange(3)
    return np.hstack([waves, drift])


def _line_noise(e: np.ndarray, cycles_per_sample: float) -> np.ndarray:
    """(c, c) covariance of the phasor errors from the spectrum of the residual on the neighbouring lines.

    The phasor error is 2/n times the Fourier transform of the noise at the frequency; the fit has removed that line.
    """
    n = len(e)
    centre = round(cycles_per_sample * n)
    lines = np.array(
        [
            k
            for k in range(max(1, centre - SETTINGS.neighbours), min(n // 2, centre + SETTINGS.neighbours + 1))
            if abs(k - cycles_per_sample * n) > 1
        ]
    )
    E = np.fft.rfft(e, axis=0)[lines]
    return 4 / n**2 * (E.T @ E.conj()) / len(lines)


def _longest_hold(y: np.ndarray) -> int:
    """Steps in the longest stretch within 0.1 % of the range from the largest or the smallest value."""
    near, longest = 1e-3 * np.ptp(y), 0
    for at in (y > y.max() - near, y < y.min() + near):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], at.astype(int), [0]])))
        longest = max(longest, int(np.max(edges[1::2] - edges[::2], initial=0)))
    return max(longest - 1, 0)
