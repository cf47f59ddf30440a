"""Effects of sampling on a response: zero-order hold, loop delay, and the aliases that fall into the band.

The voltage is held between samples and delayed; y is sampled. With H(s) from voltage to y, the sampled response is

    G(e^{jwT}) = sum over k of H(jw + jk ws) h(jw + jk ws),    h(s) = (1 - e^{-sT}) / (sT) e^{-s tau}.

The term k = 0 is the continuous response times hold and delay. In the other terms, at half the sample rate and above, a
table behaves as a pure mass: H is 1/s (a velocity per force and mass) or 1 (an acceleration), times amplifier and
anti-alias filter, and their sum is known in closed form. The remaining error is of the order of the damping over mass
and frequency, below 1e-4 of the response in the band of a table (a test compares it with the exact discretisation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Motion = Literal["displacement", "velocity", "acceleration"]


@dataclass(frozen=True)
class AliasSettings:
    """apart : relative separation of the poles of successive lags [1], because partial fractions need distinct poles.
    The error of the result is about as large, plus round-off divided by it if two poles were equal."""

    apart: float = 1e-6


SETTINGS = AliasSettings()


def hold(omega: np.ndarray, period_s: float, delay_s: float = 0.0) -> np.ndarray:
    """h(jw), (n,): zero-order hold with unit DC gain, and delay."""
    half = np.asarray(omega, float) * period_s / 2
    return np.sinc(half / np.pi) * np.exp(-1j * omega * (period_s / 2 + delay_s))


def whole_samples(delay_s: float, period_s: float) -> tuple[int, float]:
    """A delay in whole samples and the remaining fraction of a sample."""
    whole, part = divmod(delay_s / period_s, 1.0)
    return (int(whole), part) if part <= 1 - 1e-9 else (int(whole) + 1, 0.0)


def sampled_pole(omega: np.ndarray, period_s: float, delay_s: float, pole: complex) -> np.ndarray:
    """Exact sampled response, (n,), of 1/(s - pole) after hold and delay (modified z-transform); real part <= 0."""
    whole, part = whole_samples(delay_s, period_s)
    z = np.exp(1j * np.asarray(omega, float) * period_s)

    def integral(low: float, high: float) -> complex:
        """Integral of e^(pole t) from low to high sample periods."""
        if pole == 0:
            return (high - low) * period_s
        return (np.exp(pole * high * period_s) - np.exp(pole * low * period_s)) / pole

    new, old = integral(0, 1 - part), integral(1 - part, 1)
    return z**-whole * (new + old / z) / (z - np.exp(pole * period_s))


def aliases(
    omega: np.ndarray,
    period_s: float,
    delay_s: float,
    motion: Motion,
    amplifier_corner_Hz: float | None = None,
    low_pass: Sequence[complex] = (),
) -> np.ndarray:
    """(n,) contribution of the terms k != 0 to the motion per force and mass: exact sampled response minus the term k =
    0.

    displacement : taken as zero, because it decreases with the square of the frequency. acceleration : without
        amplifier and anti-alias filter the force jumps at the sampling instant; the sample is taken just after it.
    low_pass : poles [rad/s] of the anti-alias filter, whose DC gain is one.
    """
    omega = np.asarray(omega, float)
    if motion == "displacement":
        return np.zeros(omega.shape, complex)
    lags = np.array([*low_pass, *([-2 * np.pi * amplifier_corner_Hz] if amplifier_corner_Hz else [])], complex)
    lags *= 1 + SETTINGS.apart * np.arange(lags.size)
    poles = np.append(lags, 0.0) if motion == "velocity" else lags
    gain = np.prod(-lags)
    with np.errstate(divide="ignore", invalid="ignore"):
        continuous = hold(omega, period_s, delay_s) * gain / np.prod(1j * omega[:, None] - poles, axis=1)
        exact = np.exp(-1j * omega * period_s * np.ceil(delay_s / period_s - 1e-9))
        if poles.size:
            residues = [gain / np.prod(pole - np.delete(poles, k)) for k, pole in enumerate(poles)]
            exact = sum(
                residue * sampled_pole(omega, period_s, delay_s, pole)
                for residue, pole in zip(residues, poles, strict=True)
            )
        # At zero frequency both integrators are infinite with a finite difference, but no velocity is measured there.
        return np.where(omega == 0, 0.0, exact - continuous)
