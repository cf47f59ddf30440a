"""Multisine phases with a low crest factor.

The peak is the limit of the p-norm. Guillaume, Schoukens, Pintelon and Kollar (IEEE Trans. Instrum. Meas. 40 (1991),
pp. 982-989) minimise the norm for p = 4, 8, 16 .. in turn, each time starting from the previous result. This module
does the same, but replaces their Gauss-Newton step by L-BFGS with a gradient computed by FFT, because their Jacobian
(samples by lines) is dense.

Only the samples are considered: with a zero-order hold there are no other voltages between them. The output of a filter
behind the hold may have a higher peak.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize


@dataclass(frozen=True)
class CrestSettings:
    """exponents : exponents of the norm, powers of two [1]: with the last one the norm is within a few per cent of the
        peak.
    steps : maximum number of iterations for each exponent: the next one continues from the result, so that none has to
        converge.
    """

    exponents: tuple[int, ...] = (4, 8, 16, 32, 64, 128, 256)
    steps: int = 60


SETTINGS = CrestSettings()


def crest_factor(u: np.ndarray) -> np.ndarray:
    """Peak over r.m.s. along the samples of u (..., samples); 0 where the signal is zero."""
    peak, rms = np.max(np.abs(u), axis=-1), np.sqrt(np.mean(np.square(u), axis=-1))
    return np.divide(peak, rms, out=np.zeros_like(peak), where=rms > 0)


def synthesise(lines: np.ndarray, amplitude: np.ndarray, phase: np.ndarray, samples: int) -> np.ndarray:
    """Sum of amplitude cos(2 pi k n / samples + phase) over the lines k, (..., samples) for phase (..., n_lines)."""
    return _sum(lines, amplitude * np.exp(1j * np.asarray(phase)), samples)


def _sum(lines: np.ndarray, phasors: np.ndarray, samples: int) -> np.ndarray:
    """(..., samples) sum of the cosines with phasors (..., n_lines)."""
    spectrum = np.zeros((*phasors.shape[:-1], samples // 2 + 1), complex)
    spectrum[..., lines] = 0.5 * samples * phasors
    return np.fft.irfft(spectrum, samples)


def low_crest_phases(
    lines: np.ndarray, amplitude: np.ndarray, phase: np.ndarray, samples: int, rotations: np.ndarray | None = None
) -> np.ndarray:
    """Phases (n_lines,) near a local minimum of the peak, starting from `phase`.

    rotations : constants [rad] added to all phases in turn. The highest peak of the resulting signals is minimised, so
        that orthogonal experiments, which rotate each input's spectrum, can use the same phases. Default: one signal.

    The result is never worse than the start: it has the lowest peak among the start and the minima of all p-norms.
    """
    turns = np.exp(1j * (np.zeros(1) if rotations is None else np.asarray(rotations)))[:, None]
    best, lowest = phase, np.inf

    def log_norm(phi: np.ndarray, p: int) -> tuple[float, np.ndarray]:
        """log of the p-norm over all samples and rotations, and its gradient."""
        phasors = amplitude * np.exp(1j * phi) * turns
        u = _sum(lines, phasors, samples)
        peak = np.max(np.abs(u))
        ratio = u / peak
        square = ratio * ratio
        factor, power = square.copy(), square.copy()  # r^2, and r^(p-2) = r^2 r^4 .. r^(p/2)
        for _ in range(p.bit_length() - 3):
            factor *= factor
            power *= factor
        total = np.vdot(power, square)
        slope = power * ratio / (total * peak)
        # d u_n / d phi_k = Re(j A_k exp(j phi_k) exp(2 pi j k n / N))
        gradient = np.real(1j * phasors * np.conj(np.fft.rfft(slope)[:, lines])).sum(axis=0)
        return float(np.log(peak) + np.log(total / u.size) / p), gradient

    for p in (0, *SETTINGS.exponents):
        if p:
            phase = minimize(
                log_norm, phase, args=(p,), jac=True, method="L-BFGS-B", options={"maxiter": SETTINGS.steps}
            ).x
        peak = float(np.max(np.abs(_sum(lines, amplitude * np.exp(1j * phase) * turns, samples))))
        if peak < lowest:
            best, lowest = phase, peak
    return best
