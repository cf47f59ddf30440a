"""Test whether a simulated spectrum agrees with the predicted one within its random error.

Power in third-octave bands is estimated by Welch's method (Hann window, half overlap) and compared with its exact
expectation and variance for a Gaussian process of the predicted density. These include leakage, the correlation of
overlapping segments and of neighbouring lines, and resonances narrower than a line. The estimate is then taken as
chi-square distributed with matching mean and variance (Welch, IEEE Trans. Audio Electroacoust. AU-15 (1967); Percival
and Walden, Spectral Analysis for Physical Applications, 1993, section 6.10).

The simulated velocity is sampled at the controller's rate, so content above half that rate aliases. The prediction
includes the same images (`sampled_response`), so the bands may be compared up to half the sample rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal, stats

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.floor_motion import third_octave_edges, third_octave_midbands
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.loop import SimulationRecord
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.simulation.sampled_response import sampled_response


@dataclass(frozen=True)
class WelchSettings:
    """points_per_line : points of the predicted density per line of the estimate: a resonance as narrow as a line is
        still resolved.
    lines, segments : distances beyond which the Hann window's side lobes (18 dB per octave) and the correlation of
        segments are neglected.
    """

    points_per_line: int = 4
    lines: int = 8
    segments: int = 6


SETTINGS = WelchSettings()


@dataclass(frozen=True, eq=False)
class SpectrumAgreement:
    """Band powers of some axes compared with their prediction.

    Attributes
    ----------
    axes : names; midband_Hz : (n_bands,).
    estimated_rms, predicted_rms : (n_axes, n_bands) velocity in each band [m/s], rotations at the edge.
    dof : (n_axes, n_bands) equivalent degrees of freedom.
    lower, upper : (n_axes, n_bands) acceptance bounds of the ratio of powers.
    false_alarm : probability that any band falls outside if the prediction is true.
    frequency_Hz, estimated_psd, predicted_psd : Welch lines (n_f,), (n_axes, n_f) for plotting.
    """

    axes: tuple[str, ...]
    midband_Hz: np.ndarray
    estimated_rms: np.ndarray
    predicted_rms: np.ndarray
    dof: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    false_alarm: float
    frequency_Hz: np.ndarray
    estimated_psd: np.ndarray
    predicted_psd: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """(n_axes, n_bands) estimated over predicted power."""
        return (self.estimated_rms / self.predicted_rms) ** 2

    @property
    def outside(self) -> np.ndarray:
        """(n_axes, n_bands) bands whose ratio lies outside the acceptance bounds."""
        return (self.ratio < self.lower) | (self.ratio > self.upper)

    @property
    def agrees(self) -> bool:
        """Whether all bands lie within the acceptance bounds."""
        return not np.any(self.outside)

    def as_dict(self) -> dict[str, Any]:
        """Values for a file."""
        return {
            "axes": list(self.axes),
            **{name: getattr(self, name).tolist() for name in ("midband_Hz", "ratio", "lower", "upper", "dof")},
            "outside": int(np.count_nonzero(self.outside)),
            "bands": int(self.ratio.size),
            "false_alarm": self.false_alarm,
            "agrees": self.agrees,
        }


def welch_moments(psd: np.ndarray, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and covariance (n, n_d) of Welch's estimate at lines 0..n-1; column d: of lines j and j + d.

    psd : the true density at 0, 1/4, 2/4 .. lines (`SETTINGS.points_per_line`), up to `SETTINGS.lines` = n_d - 1 lines
        beyond line n-1.
    segments : number of Hann windows, which overlap by half.

    With X_m(j) the transform of segment m at line j of a Gaussian process, cov(|X_m(j)|^2, |X_n(k)|^2) = |E X_m(j) conj
    X_n(k)|^2, where E is the integral of psd(f) W(f - j) conj W(f - k) exp(i pi f (m - n)).
    """
    density = SETTINGS.points_per_line
    reach = SETTINGS.lines * density
    around = sliding_window_view(np.concatenate([np.zeros(reach), psd]), 2 * reach + 1)[::density]
    x = np.arange(-reach, reach + 1) / density
    apart, W = np.arange(SETTINGS.lines + 1), _hann_transform(x)
    pairs = W[:, None] * _hann_transform(x[:, None] - apart) / density
    covariance = np.zeros((around.shape[0], apart.size))
    for lag in range(min(SETTINGS.segments, segments)):
        share = (segments - lag) * (1 if lag == 0 else 2) / segments**2
        turned = np.exp(1j * np.pi * x * lag)[:, None] * pairs
        covariance += share * ((around @ turned.real) ** 2 + (around @ turned.imag) ** 2)
    return around @ pairs[:, 0], covariance


def _hann_transform(x: np.ndarray) -> np.ndarray:
    """Transform of the Hann window of unit energy at x lines from its centre; real, with time zero at the window's
    middle."""
    return np.sqrt(2 / 3) * (np.sinc(x) + 0.5 * (np.sinc(x - 1) + np.sinc(x + 1)))


def check_spectrum_agreement(
    record: SimulationRecord,
    band_Hz: tuple[float, float] = (1.0, 80.0),
    axes: tuple[str, ...] | None = None,
    false_alarm: float = 0.01,
    segment_s: float = 8.0,
) -> SpectrumAgreement:
    """Compare the record's payload velocity with the linear prediction of its own loop.

    Parameters
    ----------
    band_Hz : lowest and highest midband.
    axes : coordinates; those that K controls by default.
    false_alarm : probability that any band of any axis falls outside if the prediction is true (Bonferroni).
    segment_s : length of Welch's segments; a third octave at the lowest midband must contain at least one line.

    Raises
    ------
    InputError : a record shorter than one and a half segments, a band without lines or beyond half the sample rate.
    """
    loop = record.loop
    axes = loop.axes if axes is None else axes
    fs, segment = loop.sample_rate_Hz, round(segment_s * loop.sample_rate_Hz)
    segments = 2 * len(record.time) // segment - 1
    if segments < 2:
        raise InputError("a record of at least one and a half segments", field="segment_s", value=segment_s)
    line_Hz = fs / segment
    mid, first, last = _bands(band_Hz, line_Hz, fs)
    kept = [COORDINATES.index(axis) for axis in axes]
    arms = lever_arms(loop.rig)[kept]
    lines = int(last[-1]) + 1
    density = SETTINGS.points_per_line
    fine = np.arange(1, (lines + SETTINGS.lines) * density + 1) * line_Hz / density
    # The density at zero frequency is set to zero because the estimate removes each segment's mean.
    predicted = sampled_response(loop, 2 * np.pi * fine).velocity_psd()[:, kept] * arms**2
    psd = np.pad(predicted.T, ((0, 0), (1, 0)))
    estimated = np.array(
        [
            signal.welch(record.velocity(axis), fs, "hann", segment, segment // 2, detrend="constant")[1][:lines]
            for axis in axes
        ]
    )
    moments = [welch_moments(one, segments) for one in psd]
    expected = np.array([mean[:lines] for mean, _ in moments])
    power, mean = (np.add.reduceat(one, first, axis=1) for one in (estimated, expected))
    variance = np.array(
        [
            [_variance_of_sum(covariance, lo, hi) for lo, hi in zip(first, last, strict=True)]
            for _, covariance in moments
        ]
    )
    dof = 2 * mean**2 / variance
    tail = false_alarm / mean.size / 2
    shown = slice(int(first[0]), lines)
    return SpectrumAgreement(
        axes,
        mid,
        np.sqrt(power * line_Hz),
        np.sqrt(mean * line_Hz),
        dof,
        stats.chi2.ppf(tail, dof) / dof,
        stats.chi2.isf(tail, dof) / dof,
        false_alarm,
        np.arange(shown.start, shown.stop) * line_Hz,
        estimated[:, shown],
        expected[:, shown],
    )


def _variance_of_sum(covariance: np.ndarray, first: int, last: int) -> float:
    """Variance of the sum over lines first..last; each pair of different lines counts twice."""
    return float(
        sum(
            (1 if d == 0 else 2) * np.sum(covariance[first : last + 1 - d, d])
            for d in range(min(SETTINGS.lines, last - first) + 1)
        )
    )


def _bands(
    band_Hz: tuple[float, float], line_Hz: float, sample_rate_Hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Midbands and the first and last line of each band; no line belongs to two bands."""
    mid = third_octave_midbands(*band_Hz)
    lower, upper = third_octave_edges(mid)
    edges = np.ceil(np.append(lower, upper[-1]) / line_Hz).astype(int)
    first, last = edges[:-1], edges[1:] - 1
    if np.any(last < first):
        raise InputError(
            f"segments long enough for a line in every third octave from {band_Hz[0]:g} Hz",
            field="segment_s",
            value=1 / line_Hz,
        )
    if (last[-1] + SETTINGS.lines) * line_Hz >= sample_rate_Hz / 2:
        raise InputError(f"bands below half the sample rate of {sample_rate_Hz:g} Hz", field="band_Hz", value=band_Hz)
    return mid, first, last
