"""Whiteness test of what a model leaves unexplained: correlations of the whitened residual, with false-alarm limits.

The whitened residual w of a line has E|w|^2 = 1 and is independent from line to line and of the inputs, if model and
noise are correct. With n lines over a band of width B three correlations are tested, each complex normal with variance
1/n under that hypothesis (so that n |r|^2 is exponential with mean 1):

    over frequency    r(l) = 1/n sum_k w_{k+l} conj(w_k)                          transients, leakage
    over time         r(tau) = 1/n sum_k (|w_k|^2 - 1) e^{j w_k tau}              a spectrum other than the noise's
    with an input     r(tau) = 1/n sum_k w_k conj(u_k) e^{j w_k tau} / rms(u)     unmodelled dynamics

tau increases in steps of 1/B. The variance of the last correlation increases by g P g^H, g its derivative by the
parameters and P their covariance; that of the second by the scatter of the noise's own estimate. Limits are Sidak's:
over all tests of a validation together, white data exceed any limit in 1 % of the cases (Ljung, System Identification,
2nd ed., 1999, section 16.6, has the same tests individually).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.identification.prediction_error import PredictionError


@dataclass(frozen=True)
class WhitenessSettings:
    """family : probability of at least one false alarm in a validation [1], small enough to take an alarm seriously.
    line_lags : maximum lag over frequency [lines]; leakage and transients correlate neighbouring lines.
    time_lags : maximum lag over time and with an input [steps of 1/B].
    negative_lags : maximum lag before an input [steps of 1/B], for an error of the delay; nothing else precedes its
        cause.
    silent : power relative to the strongest input, below which an input counts as silent [1]: round-off.
    """

    family: float = 0.01
    line_lags: int = 20
    time_lags: int = 100
    negative_lags: int = 10
    silent: float = 1e-12


SETTINGS = WhitenessSettings()


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlations of one kind, for figures.

    what : in words. rows : labels, "Sz1" or "Sz1 with Ax2". lags : (n_l,) in lag_unit ("lines" or "s").
    value, limit : (rows, n_l) modulus of the normalised correlation, and the limit it should stay below.
    """

    what: str
    rows: tuple[str, ...]
    lags: np.ndarray
    lag_unit: str
    value: np.ndarray
    limit: np.ndarray

    @property
    def beyond(self) -> int:
        """Number of values above their limit."""
        return int(np.count_nonzero(self.value > self.limit))

    @property
    def sentence(self) -> str:
        """Result in words."""
        ratio = self.value / self.limit
        row, lag = np.unravel_index(np.argmax(ratio), ratio.shape)
        at = f"{self.lags[lag]:.3g} {self.lag_unit}"
        largest = f"{self.value[row, lag]:.3g} against a limit of {self.limit[row, lag]:.3g}, {self.rows[row]} at {at}"
        if self.beyond:
            return (
                f"{self.what}: {self.beyond} of {ratio.size} values exceed their limit (noise alone exceeds any "
                f"limit in 1 % of all validations); the largest is {largest}"
            )
        return f"{self.what}: none of {ratio.size} values exceeds its limit; the closest is {largest}"


@dataclass(frozen=True, eq=False)
class Whiteness:
    """correlations : over frequency, over time and, if an input is driven, with the inputs. sentences : one each."""

    correlations: tuple[Correlation, ...]

    @property
    def white(self) -> bool:
        """Whether no correlation exceeds its limit."""
        return not any(one.beyond for one in self.correlations)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Results in words."""
        return tuple(one.sentence for one in self.correlations)


def whiteness(
    error: PredictionError,
    outputs: Sequence[str],
    inputs: Sequence[str],
    covariance: np.ndarray,
    noise_lines: float = np.inf,
    families: int = 1,
) -> Whiteness | None:
    """Correlations of the residual of one block; None if it has too few lines.

    Parameters
    ----------
    error : with its derivative. covariance : (n_p, n_p) of the parameters.
    noise_lines : total number of lines from which the noise covariance was estimated.
    families : number of blocks that are tested, among which the false-alarm probability is divided.
    """
    omega, n = error.block.omega, len(error.block.omega)
    lines, steps = min(SETTINGS.line_lags, n // 4), min(SETTINGS.time_lags, n // 4)
    if lines < 1 or omega[-1] <= omega[0]:
        return None
    power = np.sum(np.abs(error.block.U) ** 2, axis=(0, 2))
    driven = np.flatnonzero(power > SETTINGS.silent * power.max()) if power.max() > 0 else np.empty(0, int)
    lags = np.arange(-min(SETTINGS.negative_lags, steps), steps + 1)
    n_y = len(outputs)
    tests = n_y * (lines + steps + len(driven) * len(lags))
    level = -np.log(-np.expm1(np.log1p(-SETTINGS.family / families) / tests))
    step = 2 * np.pi / (omega[-1] - omega[0])
    found = [
        _over_frequency(error, outputs, lines, level),
        _over_time(error, outputs, np.arange(1, steps + 1) * step, level, noise_lines),
    ]
    if driven.size:
        found.append(_with_inputs(error, outputs, inputs, driven, lags * step, level, covariance))
    return Whiteness(tuple(found))


def _over_frequency(error: PredictionError, outputs: Sequence[str], lines: int, level: float) -> Correlation:
    w = error.white
    value = np.stack([np.abs(np.mean(w[lag:] * np.conj(w[:-lag]), axis=(0, 2))) for lag in range(1, lines + 1)], axis=1)
    counts = np.array([(len(w) - lag) * w.shape[2] for lag in range(1, lines + 1)])
    return Correlation(
        "correlation of the residual from line to line",
        tuple(outputs),
        np.arange(1.0, lines + 1),
        "lines",
        value,
        np.broadcast_to(np.sqrt(level / counts), value.shape),
    )


def _over_time(
    error: PredictionError, outputs: Sequence[str], tau: np.ndarray, level: float, noise_lines: float
) -> Correlation:
    count = error.white.shape[0] * error.white.shape[2]
    excess = np.mean(np.abs(error.white) ** 2, axis=2)
    # Its mean is tested by chi-square.
    excess = excess - excess.mean(axis=0)
    value = np.abs(excess.T @ np.exp(1j * np.outer(error.block.omega, tau))) / len(excess)
    limit = np.sqrt(level / count * (1 + count / noise_lines))
    return Correlation(
        "correlation of the residual over time", tuple(outputs), tau, "s", value, np.full(value.shape, limit)
    )


def _with_inputs(
    error: PredictionError,
    outputs: Sequence[str],
    inputs: Sequence[str],
    driven: np.ndarray,
    tau: np.ndarray,
    level: float,
    covariance: np.ndarray,
) -> Correlation:
    turn = np.exp(1j * np.outer(error.block.omega, tau))
    # Lines and columns together as the last axis, for matrix products.
    white = np.moveaxis(error.white, 1, 0).reshape(len(outputs), -1)
    derivative = np.moveaxis(error.derivative, 2, 1).reshape(-1, white.shape[1])
    rows, values, limits = [], [], []
    for j in driven:
        u = error.block.U[:, j]
        seen = (np.conj(u)[:, :, None] * turn[:, None]).reshape(-1, len(tau)) / np.linalg.norm(u)
        r, g = white @ seen, (derivative @ seen).reshape(-1, len(outputs), len(tau))
        spread = 1 + np.real(np.einsum("pil,pq,qil->il", np.conj(g), covariance, g, optimize=True))
        root = np.sqrt(u.size)
        values.append(np.abs(r) / root)
        limits.append(np.sqrt(level * spread) / root)
        rows += [f"{output} with {inputs[j]}" for output in outputs]
    return Correlation(
        "correlation of the residual with the inputs",
        tuple(rows),
        tau,
        "s",
        np.concatenate(values),
        np.concatenate(limits),
    )
