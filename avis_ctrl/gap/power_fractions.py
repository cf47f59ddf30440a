"""Decomposition of each output's power into model, model error, noise, nonlinearity and unmeasured inputs.

In a window of lines, the outputs of all records of one level are decomposed. With G the linear part of the model,

    y = G u + (model's nonlinear terms) + e,    e_lin = y - G u = A c + r,    e = A c' + r'

where A has the columns G_kj u_j, constant and, with enough lines, linear over the window: c is a relative error of each
path. If the residual exceeds the noise, a common denominator is tried, for poles that differ from the model's (local
rational method; McKelvey and Guerin, IFAC Proc. 45-16 (2012) 424-429). r is the incoherent part: no response near the
model's, linear in the measured inputs, explains it. Its fraction of the power is one minus the multiple coherence
(Bendat and Piersol, Random Data, 4th ed., 2010, section 7.3). It is due to noise, unmeasured inputs and nonlinearity.
Each squared residual is divided by one minus its leverage, so that fitted unknowns do not bias the power (MacKinnon and
White, J. Econometrics 29 (1985) 305-325).

Noise does not depend on the drives. It is measured where these are silent. Without such lines, the residual at the
lowest level, after subtraction of the model's nonlinear terms, counts as noise: any increase at a higher level is
nonlinear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy import stats
from scipy.linalg import orth

from avis_ctrl.gap.result import PowerShares
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.campaign_fit import SETTINGS as FIT
from avis_ctrl.identification.campaign_fit import of_one_level
from avis_ctrl.identification.prediction_error import PredictionError
from avis_ctrl.measurement.campaign import RecordHeader


@dataclass(frozen=True)
class PowerSettings:
    """Settings of the decomposition of each output's power.

    bands_per_octave : bands per octave.
    least_lines : minimum number of lines of a band per unknown of its regression: with fewer, the leverage leaves no
        residual.
    linear_lines : the same for an error that is linear over the window.
    most_leverage : maximum leverage [1]: a line above it carries no information on the noise.
    alarm : probability that an error of the model is detected in a window of noise alone [1].
    scatter : probability that nonlinearity is detected in a band of noise alone [1].
    excess : residual power over noise power above which an error of a pole is considered [1].
    gained : fraction to which the residual power must fall for the new poles to be accepted [1].
    pole_rounds : iterations of the fit of the poles, each of them linear.
    nearest_pole : minimum magnitude of its denominator, which is one in the middle of the window [1]: a closer pole
        fits a single line.
    """

    bands_per_octave: int = 3
    least_lines: int = 3
    linear_lines: int = 8
    most_leverage: float = 0.9
    alarm: float = 1e-3
    scatter: float = 0.05
    excess: float = 1.5
    gained: float = 0.8
    pole_rounds: int = 4
    nearest_pole: float = 0.01


SETTINGS = PowerSettings()


@dataclass(frozen=True, eq=False)
class Lines:
    """Driven lines of the records of one level, sorted by frequency.

    frequency_Hz (n,); Y, left, beyond (n, n_y): outputs, residual of the whole model, residual of its linear part;
    columns (n, n_y, n_u): G_kj u_j; noise (n, n_y): measured power.
    """

    frequency_Hz: np.ndarray
    Y: np.ndarray
    left: np.ndarray
    beyond: np.ndarray
    columns: np.ndarray
    noise: np.ndarray

    def some(self, keep: np.ndarray) -> Lines:
        """Some of the lines."""
        return Lines(*(getattr(self, one.name)[keep] for one in fields(self)))


@dataclass(frozen=True, eq=False)
class Split:
    """Power per line, (n_bands, n_y) each: of the output; incoherent in the error of the linear part and in that of the
    model; coherent in the model's error; measured noise. lines (n_bands,): number of lines; effective (n_bands, n_y):
    number of lines of equal power with the same scatter."""

    whole: np.ndarray
    incoherent: np.ndarray
    left_incoherent: np.ndarray
    missing: np.ndarray
    noise: np.ndarray
    lines: np.ndarray
    effective: np.ndarray


def power_shares(
    errors: Sequence[PredictionError],
    headers: Mapping[str, RecordHeader],
    model: TableModel,
    silent_noise: bool,
    sensors_rms: Mapping[str, float] | None,
) -> tuple[PowerShares, ...]:
    """Decomposition for each level, the lowest first; empty if no record drives the actuators on enough lines.

    Parameters
    ----------
    errors : residuals of `model` on each block. headers : of the blocks' records by name.
    silent_noise : the blocks' noise was measured where the drives are silent.
    sensors_rms : sensor noise of each output's channel (white at the sample rate), unit of y; None if not known.
    """
    found = []
    for group in _levels(errors, headers):
        own = [headers[e.block.name] for e in group]
        found.append((own, lines_of(group, model)))
    if not found:
        return ()
    edges = bands([lines for _, lines in found])
    if len(edges) < 2:
        return ()
    splits = [split(lines, edges) for _, lines in found]
    names = model.sensors.names
    sensors = None if sensors_rms is None else np.array([sensors_rms.get(name, 0.0) for name in names]) ** 2
    several = len({own[0].excitation for own, _ in found}) == 1 and len(found) > 1
    how: Literal["silent", "levels", "one level"] = "silent" if silent_noise else "levels" if several else "one level"
    lowest = splits[0].left_incoherent
    made = []
    for (own, _), one in zip(found, splits, strict=True):
        noise = one.noise if how == "silent" else lowest if how == "levels" else one.left_incoherent
        parts, power = attributed(one, noise, sensors), one.whole * one.lines[:, None]
        whole = {key: np.sum(value * power, axis=0) / np.sum(power, axis=0) for key, value in parts.items()}
        level, records = float(np.mean([h.level_V for h in own])), tuple(sorted(h.name for h in own))
        made.append(PowerShares(level, own[0].excitation, records, edges, names, parts, whole, how))
    return tuple(made)


def attributed(one: Split, noise: np.ndarray, sensors: np.ndarray | None) -> dict[str, np.ndarray]:
    """Fractions (n_bands, n_y) that add up to one; noise : power per line, sensors : (n_y,) the part due to sensor
    noise, None if not known."""
    incoherent = np.minimum(one.incoherent, one.whole)
    missing = np.minimum(one.missing, one.whole - incoherent)
    # Within its scatter the incoherent part counts as noise, with the effective number of lines as degrees of freedom.
    scatter = incoherent < stats.f.isf(SETTINGS.scatter, 2 * one.effective, 2 * one.effective) * noise
    noise = np.where(scatter, incoherent, np.minimum(noise, incoherent))
    own = np.zeros_like(noise) if sensors is None else np.minimum(noise, sensors)
    parts = {
        "model": one.whole - missing - incoherent,
        "missing": missing,
        "nonlinear": incoherent - noise,
        "unmeasured": noise - own,
    } | ({} if sensors is None else {"sensors": own})
    return {key: value / one.whole for key, value in parts.items()}


def _levels(errors: Sequence[PredictionError], headers: Mapping[str, RecordHeader]) -> list[list[PredictionError]]:
    """Driven records grouped by level and excitation; the lowest level first."""

    def kind_and_level(e: PredictionError) -> tuple[str, float]:
        return headers[e.block.name].excitation, headers[e.block.name].level_V

    groups = of_one_level([e for e in errors if kind_and_level(e)[0] not in ("rest", "floor")], kind_and_level)
    return sorted(groups, key=lambda group: headers[group[0].block.name].level_V)


def lines_of(errors: Sequence[PredictionError], model: TableModel) -> Lines:
    """Lines of several records that the drives excite."""
    n_a = len(model.actuators)
    known: dict[bytes, np.ndarray] = {}
    made = []
    for e in errors:
        block = e.block
        key = block.omega.tobytes()
        if key not in known:
            known[key] = model.response(block.omega)
        columns = known[key] * block.U[:, None, :, 0]
        predicted = (block.Y - e.plain)[:, :, 0]
        residual = e.error[:, :, 0]
        power = np.sum(np.abs(block.U[:, :n_a, 0]) ** 2, axis=1)
        assert block.noise is not None
        noise = np.real(np.einsum("nkk->nk", block.noise[:, 0]))
        Y = predicted + residual
        every = Lines(block.omega / (2 * np.pi), Y, residual, Y - columns.sum(axis=2), columns, noise)
        made.append(every.some(power > FIT.silent_line**2 * power.max(initial=0.0)))
    joined = Lines(*(np.concatenate([getattr(one, field.name) for one in made]) for field in fields(Lines)))
    return joined.some(np.argsort(joined.frequency_Hz, kind="stable"))


def bands(groups: Sequence[Lines]) -> np.ndarray:
    """Band edges [Hz]: `bands_per_octave`, merged where a level has too few lines for its number of unknowns."""
    low = min(float(one.frequency_Hz[0]) for one in groups if len(one.frequency_Hz))
    high = max(float(one.frequency_Hz[-1]) for one in groups if len(one.frequency_Hz)) * (1 + 1e-9)
    grid = np.geomspace(low, high, max(int(np.ceil(SETTINGS.bands_per_octave * np.log2(high / low))), 1) + 1)
    least = [SETTINGS.least_lines * _unknowns(one.columns) for one in groups]

    def enough(a: float, b: float) -> bool:
        return all(
            np.searchsorted(one.frequency_Hz, b) - np.searchsorted(one.frequency_Hz, a) >= n
            for one, n in zip(groups, least, strict=True)
        )

    edges = [low]
    for edge in grid[1:]:
        if enough(edges[-1], edge):
            edges.append(float(edge))
    if len(edges) > 1:
        edges[-1] = high
    return np.array(edges)


def _unknowns(columns: np.ndarray) -> int:
    return int(np.count_nonzero(np.any(columns, axis=(0, 1))))


def split(lines: Lines, edges: np.ndarray) -> Split:
    """Power per line by band; a band with many lines is divided into windows, each with its own regression."""
    n_y = lines.Y.shape[1]
    found = np.zeros((5, len(edges) - 1, n_y))
    count, alike = np.zeros(len(edges) - 1), np.ones((len(edges) - 1, n_y))
    for b, (low, high) in enumerate(pairwise(np.searchsorted(lines.frequency_Hz, edges))):
        count[b] = high - low
        least = SETTINGS.linear_lines * _unknowns(lines.columns[low:high])
        for at in np.array_split(np.arange(low, high), max((high - low) // max(least, 1), 1)):
            found[:, b] += _window(lines, at)
        found[:, b] /= max(count[b], 1)
        noise = lines.noise[low:high]
        alike[b] = np.sum(noise, axis=0) ** 2 / np.sum(noise**2, axis=0)
    return Split(found[0], found[1], found[2], found[3], found[4], count, alike)


def _window(lines: Lines, at: np.ndarray) -> np.ndarray:
    """(5, n_y) sums of power over the lines of a window."""
    f = lines.frequency_Hz[at]
    x = 2 * (f - f.mean()) / max(float(np.ptp(f)), 1e-12)
    sums = np.zeros((5, lines.Y.shape[1]))
    for k in range(lines.Y.shape[1]):
        A = lines.columns[at, k]
        A, model = A[:, np.any(A, axis=0)], A.sum(axis=1)
        sigma = np.sqrt(lines.noise[at, k])
        sums[0, k] = np.sum(np.abs(lines.Y[at, k]) ** 2)
        sums[4, k] = np.sum(sigma**2)
        for row, e in ((1, lines.beyond[at, k]), (2, lines.left[at, k])):
            error, leverage = _smooth(A, e, x, sigma)
            if np.sum(np.abs(error / sigma) ** 2 / (1 - leverage)) > SETTINGS.excess * len(at):
                error, leverage = _with_poles(A, model + e, x, sigma, (error, leverage))
            apart = np.abs(error) ** 2 / (1 - leverage)
            sums[row, k] = np.sum(apart)
            if row == 2:
                sums[3, k] = max(np.sum(np.abs(e - error) ** 2 - leverage * apart), 0.0)
    return sums


def _smooth(A: np.ndarray, e: np.ndarray, x: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual (n,) of e after subtraction of a smooth relative error of each column of A, and leverage (n,) of each
    line; e itself if that error is not significant."""
    if len(e) >= SETTINGS.linear_lines * A.shape[1]:
        A = np.hstack([A, A * x[:, None]])
    Q = _basis(A / sigma[:, None])
    white, p = e / sigma, Q.shape[1]
    inside = Q.conj().T @ white
    power, whole = float(np.sum(np.abs(inside) ** 2)), float(np.sum(np.abs(white) ** 2))
    rest = len(e) - p
    if p == 0 or rest <= 0 or power / p < stats.f.isf(SETTINGS.alarm, 2 * p, 2 * rest) * (whole - power) / rest:
        return e, np.zeros(len(e))
    return e - sigma * (Q @ inside), _leverage(Q)


def _with_poles(
    A: np.ndarray, y: np.ndarray, x: np.ndarray, sigma: np.ndarray, plain: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """As `_smooth`, for a response whose poles differ from the model's: y = A b(x) / a(x), a of second degree.

    Iterated linear least squares (Sanathanan and Koerner, IEEE Trans. Autom. Control 8 (1963) 56-58). Returns `plain`
    if the improvement is no larger than the additional unknowns explain, or if there are too few lines.
    """
    unknowns = 2 * A.shape[1] + 2
    if len(y) < 2 * unknowns:
        return plain
    numerator = np.hstack([A, A * x[:, None]])
    powers = np.stack([x, x**2], axis=1)
    a = np.ones(len(x), complex)
    best, least = plain, SETTINGS.gained * np.sum(np.abs(plain[0] / sigma) ** 2 / (1 - plain[1]))
    for _ in range(SETTINGS.pole_rounds):
        weight = 1 / (sigma * np.abs(a))
        K = np.hstack([numerator, -powers * y[:, None]]) * weight[:, None]
        size = np.linalg.norm(K, axis=0)
        found = np.linalg.lstsq(K / size, y * weight, rcond=1e-10)[0] / size
        a = 1 + powers @ found[-2:]
        if np.min(np.abs(a)) < SETTINGS.nearest_pole:
            break
        error = y - (numerator @ found[:-2]) / a
        leverage = _leverage(_basis(K))
        chi2 = np.sum(np.abs(error / sigma) ** 2 / (1 - leverage))
        if chi2 < least:
            best, least = (error, leverage), chi2
    return best


def _leverage(Q: np.ndarray) -> np.ndarray:
    return np.minimum(np.sum(np.abs(Q) ** 2, axis=1), SETTINGS.most_leverage)


def _basis(A: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the span of the columns, each normalised first, without directions at round-off level."""
    return orth(A / np.linalg.norm(A, axis=0), rcond=1e-10) if A.size else np.zeros((len(A), 0), complex)
