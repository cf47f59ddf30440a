"""Frequency and damping of one measured mode.

Near a lightly damped mode every entry of G is a pole with a smooth background,

    G_ij(jw) = r_ij / (jw - p) + b_ij + c_ij (w - w0),     p = w_n (-zeta + j sqrt(1 - zeta^2)),

where the background includes the complex conjugate pole and all other modes. For a given p the other unknowns are
linear, so the search is over p only (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973), weighted
by the entries' variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse


@dataclass(frozen=True)
class ResonanceSettings:
    """reach : half-widths of the bands that the fit tries, in half-power bandwidths, narrow first.
    misfit : weighted mean square residual up to which a wider band is accepted: the background is still a straight
        line.
    fewest_lines : minimum number of lines for a fit: three times the number of complex unknowns of an entry.
    search : fraction of near_Hz, on either side, within which the mode is searched: expected frequencies are off by a
        few per cent.
    false_alarm : probability that noise is taken for a mode; small, because the pole is the best of many trials.
    """

    reach: tuple[float, ...] = (1.0, 2.0, 4.0)
    misfit: float = 1.3
    fewest_lines: int = 9
    search: float = 0.05
    false_alarm: float = 1e-5


SETTINGS = ResonanceSettings()


@dataclass(frozen=True, eq=False)
class Resonance:
    """A mode: undamped natural frequency and damping with standard deviations, residues (n_y, n_u) of G in 1/s units.

    misfit : weighted mean square residual, 1 if the model explains everything but the noise; if it is larger, the
    standard deviations are multiplied by its square root. band_Hz, lines : band and number of lines of the fit.
    """

    frequency_Hz: float
    damping: float
    frequency_std_Hz: float
    damping_std: float
    residue: np.ndarray
    misfit: float
    band_Hz: tuple[float, float]
    lines: int


def resonance(response: FrequencyResponse, near_Hz: float) -> Resonance:
    """Local fit of one mode near a frequency.

    Parameters
    ----------
    near_Hz : the search starts at the largest response within 5 % of it. The fit extends over 1, 2 or 4 half-power
        bandwidths to each side of the mode, the widest for which the model still explains everything but the noise.

    Raises
    ------
    InputError : too few lines there. ComputationError : no mode inside the band.
    """
    f = response.frequency_Hz
    reach = SETTINGS.search * near_Hz
    inside = np.flatnonzero(np.abs(f - near_Hz) <= reach)
    if not f.size:
        raise InputError("expected lines", field="near_Hz", value=near_Hz)
    if not (np.isfinite(near_Hz) and near_Hz > 0) or inside.size < 3 or f.size < SETTINGS.fewest_lines:
        message = (
            f"expected at least three lines within {reach:g} Hz and {SETTINGS.fewest_lines} in all; there are lines "
            f"from {f[0]:g} to {f[-1]:g} Hz"
        )
        raise InputError(message, field="near_Hz", value=near_Hz)
    size = np.sum(np.abs(response.value) ** 2 / np.mean(np.abs(response.value[inside]) ** 2, axis=0), axis=(1, 2))
    peak = f[inside[np.argmax(size[inside])]]
    half = max(reach / 2, SETTINGS.fewest_lines / 2 * float(np.median(np.diff(f))))
    found = _fit(response, peak, half, near_Hz, reach)
    for width in SETTINGS.reach:
        wider = found
        for _ in range(4):
            half = width * 2 * wider.damping * wider.frequency_Hz
            again = _fit(response, wider.frequency_Hz, half, near_Hz, reach, wider)
            settled, wider = again.band_Hz == wider.band_Hz, again
            if settled:
                break
        if width > SETTINGS.reach[0] and wider.misfit > max(SETTINGS.misfit, found.misfit):
            break
        found = wider
    return found


def _fit(
    response: FrequencyResponse,
    centre: float,
    half: float,
    near_Hz: float,
    reach: float,
    start: Resonance | None = None,
) -> Resonance:
    use = np.flatnonzero(np.abs(response.frequency_Hz - centre) <= half)
    if use.size < SETTINGS.fewest_lines:
        nearest = np.argsort(np.abs(response.frequency_Hz - centre), kind="stable")
        use = np.sort(nearest[: SETTINGS.fewest_lines])
    f, w0 = response.frequency_Hz[use], 2 * np.pi * centre
    w, scale, band = 2 * np.pi * f, np.pi * (f[-1] - f[0]), f"from {f[0]:.6g} to {f[-1]:.6g} Hz"
    G = response.value[use].reshape(use.size, -1)
    variance = response.variance()[use].reshape(use.size, -1)
    weight = 1 / np.sqrt(np.maximum(variance, np.finfo(float).eps * np.max(np.abs(G)) ** 2))
    right = (weight * G).T[:, :, None]
    background = np.stack([np.ones(w.size), (w - w0) / scale], axis=1)

    def project(basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (entries, lines) and coefficients (entries, k) of least squares with the columns (lines, k)."""
        q, r = np.linalg.qr(weight.T[:, :, None] * basis)
        along = np.swapaxes(q.conj(), 1, 2) @ right
        return (right - q @ along)[:, :, 0], np.linalg.solve(r, along)[:, :, 0]

    def basis(x: np.ndarray) -> np.ndarray:
        """Columns for a pole w0 + scale x0 with the decay scale exp(x1)."""
        pole = -scale * np.exp(x[1]) + 1j * (w0 + scale * x[0])
        return np.column_stack([scale / (1j * w - pole), background])

    def stacked(x: np.ndarray) -> np.ndarray:
        left = project(basis(x))[0].ravel()
        return np.concatenate([left.real, left.imag])

    decays = (0.03, 0.3) if start is None else (2 * np.pi * start.damping * start.frequency_Hz / scale,)
    fits = [
        least_squares(stacked, [0.0, np.clip(np.log(decay), -13.9, 2.9)], bounds=([-1.5, -14.0], [1.5, 3.0]))
        for decay in decays
    ]
    best = min(fits, key=lambda s: s.cost)
    # F test of the pole against the background alone.
    added, free = 2 * G.shape[1] + 2, 2 * (use.size - 3) * G.shape[1] - 2
    without = float(np.sum(np.abs(project(background)[0]) ** 2) / 2)
    ratio = (without - best.cost) / added / max(best.cost / free, np.finfo(float).tiny)
    limit = float(stats.f(added, free).isf(SETTINGS.false_alarm))
    if ratio < limit:
        measured = f"a pole explains {ratio:.3g} times as much as of pure noise, {band}; {limit:.3g} is needed"
        raise _no_mode(near_Hz, measured, "hidden by noise", "a peak")
    decay, turn = scale * np.exp(best.x[1]), w0 + scale * best.x[0]
    natural = float(np.hypot(decay, turn))
    found_Hz, damping = natural / (2 * np.pi), decay / natural
    if abs(found_Hz - near_Hz) > 2 * reach or abs(best.x[0]) >= 1.5 or best.x[1] >= 3.0 or best.x[1] <= -14.0:
        measured = f"the fit ended at {found_Hz:.6g} Hz with damping {damping:.3g}, {band}"
        raise _no_mode(near_Hz, measured, "too broad or too close to another for a local fit", "a single peak")
    # E|e|^2 counts real and imaginary parts, each of half the variance.
    misfit = 2 * 2 * best.cost / free
    # The rows of the Jacobian are scaled to variance 1/2.
    covariance = np.linalg.inv(2 * best.jac.T @ best.jac) * max(misfit, 1.0)
    # Derivatives of natural and damping with respect to x: natural^2 = decay^2 + turn^2, damping = decay / natural.
    by_x = np.array(
        [
            [turn / natural * scale, decay / natural * decay],
            [-decay * turn / natural**3 * scale, decay / natural - decay**3 / natural**3],
        ]
    )
    spread = np.sqrt(np.diag(by_x @ covariance @ by_x.T))
    residue = (scale * project(basis(best.x))[1][:, 0]).reshape(response.value.shape[1:])
    ends = float(f[0]), float(f[-1])
    return Resonance(found_Hz, damping, spread[0] / (2 * np.pi), spread[1], residue, float(misfit), ends, f.size)


def _no_mode(near_Hz: float, measured: str, one: str, at: str) -> ComputationError:
    return ComputationError(
        f"no mode found near {near_Hz:g} Hz",
        measured=measured,
        cause=f"no resonance there, or one {one}",
        next_step=f"look at the response, and give near_Hz at {at}",
    )
