"""Fit of a sine to all channels of a record, and of a second-order response to a few frequencies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

KINDS = {0: "low-pass (displacement)", 1: "band-pass (velocity)", 2: "high-pass (acceleration)"}


@dataclass(frozen=True, eq=False)
class SineFit:
    """f Hz; X (channels,) complex amplitudes, u before y; residual_rms (channels,); samples."""

    record: str
    f: float
    X: np.ndarray
    residual_rms: np.ndarray
    samples: int
    t: np.ndarray
    traces: np.ndarray


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """b s^k / (s^2 + 2 damping w0 s + w0^2); misfit : median relative error over the frequencies."""

    k: int
    corner_Hz: float
    damping: float
    misfit: float


def fit_sine(record: str, x: np.ndarray, n_u: int, rate: float) -> SineFit:
    """Amplitudes of all channels at the frequency of the purest sine in the first n_u, refined by least squares."""
    n = len(x)
    t = np.arange(n) / rate
    centred = x - x.mean(axis=0)
    F = np.abs(np.fft.rfft(centred[:, :n_u] * np.hanning(n)[:, None], axis=0))
    lead = int(np.argmax(F.max(axis=0) / np.maximum(F.sum(axis=0), 1e-300)))
    start = max(int(np.argmax(F[:, lead])), 1) * rate / n

    def regressors(f: float) -> np.ndarray:
        return np.column_stack([np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t), np.ones(n)])

    def residual(f: float) -> float:
        A = regressors(f)
        c = np.linalg.solve(A.T @ A, A.T @ centred[:, lead])
        return float(np.sum((centred[:, lead] - A @ c) ** 2))

    f = float(
        minimize_scalar(
            residual,
            bounds=(max(start - rate / n, 0.1 * rate / n), start + rate / n),
            method="bounded",
            options={"xatol": 1e-6 * rate / n},
        ).x
    )
    A = regressors(f)
    c, *_ = np.linalg.lstsq(A, centred, rcond=None)
    shown = min(n, max(50, int(3 * rate / f)), 4000)
    return SineFit(record, f, c[0] - 1j * c[1], (centred - A @ c).std(axis=0), n, t[:shown], x[:shown])


def second_order(f: np.ndarray, H: np.ndarray) -> SecondOrder:
    """The best of low-pass, band-pass and high-pass, by robust least squares of relative errors from several
    corners."""
    s = 2j * np.pi * f
    found = []
    for k in KINDS:

        def errors(q: np.ndarray, k: int = k) -> np.ndarray:
            w0, damping = np.exp(q[0]), np.exp(q[1])
            G = s**k * w0 ** (2 - k) / (s * s + 2 * damping * w0 * s + w0 * w0)
            ratio = G / H
            # With the best-fitting gain (real, of either sign).
            e = ratio * (np.sum(ratio.real) / np.sum(np.abs(ratio) ** 2)) - 1
            return np.concatenate([e.real, e.imag])

        for corner in np.geomspace(f[0], f[-1], 5):
            q = least_squares(errors, [np.log(2 * np.pi * corner), np.log(0.5)], loss="soft_l1", f_scale=0.05).x
            misfit = float(np.median(np.hypot(*np.split(errors(q), 2))))
            found.append(SecondOrder(k, float(np.exp(q[0]) / (2 * np.pi)), float(np.exp(q[1])), misfit))
    return min(found, key=lambda one: one.misfit)
