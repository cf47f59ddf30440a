"""Frequency responses and noise covariances of campaigns by local models, for any excitation.

Every record, or piece of a long one, has its own transient; G is shared (`local_fit`). Nothing is assumed periodic, so
records of noise, multisines from rest and floor motion can be pooled; with a periodic excitation `best_linear`
separates nonlinear distortion as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.measurement.frequency_response.local_fit import SETTINGS, LocalFit, least_half_width
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.spectra import (
    Band,
    Channels,
    channels,
    checked_band,
    equal_pieces,
    lines,
    taking_part,
    transform,
)


@dataclass(frozen=True, eq=False)
class NoiseCovariance:
    """Covariance of the outputs' noise on one line of a transform over sqrt(samples).

    frequency_Hz : (n,); covariance : (n, n_y, n_y) Hermitian, positive definite; dof : (n,) complex degrees of
    freedom; sample_rate_Hz : a one-sided power spectral density is 2 covariance / sample_rate_Hz.
    """

    frequency_Hz: np.ndarray
    covariance: np.ndarray
    dof: np.ndarray
    outputs: tuple[str, ...]
    sample_rate_Hz: float

    @property
    def density(self) -> np.ndarray:
        """(n, n_y, n_y) one-sided cross power spectral density, squared unit of y per Hz."""
        return 2 * self.covariance / self.sample_rate_Hz


class _Spectra(NamedTuple):
    """Spectra of records or pieces of one length, (n_records, lines, n_u) and (n_records, lines, n_y)."""

    U: np.ndarray
    Y: np.ndarray
    line_Hz: np.ndarray


def local_polynomial(campaign: Campaign, *, band_Hz: Band | None = None, frequency_Hz: np.ndarray | None = None,
                     order: int = 2, half_width: int | None = None, floor: bool | None = None,
                     longest_piece: int | None = None, partial: bool = False) -> FrequencyResponse:
    """Local polynomial estimate, all records pooled (Pintelon and Schoukens 2012, section 7.2).

    The bias grows with the half width and the curvature of G: (half width / record length)^(order + 1). Nonlinear
    distortion counts as noise. Memory is one triangular factor per frequency and one piece of a record.

    Estimates whose windows overlap share lines, so that their errors are correlated: the covariance is that of each
    frequency by itself.

    Parameters
    ----------
    band_Hz : lines to use, without line 0 (sensor offsets); all by default.
    frequency_Hz : where to estimate; by default every line of the shortest piece.
    order : of the polynomials, 2 to 4 is usual.
    half_width : window of 2 half_width + 1 lines; by default the smallest that leaves 2 n_y + 4 degrees of freedom.
    floor : the floor's velocity as additional inputs; by default where every record measured it. Records with u = 0
        take part only then.
    longest_piece : samples; longer records are read and used in pieces, each with its own transient.
    partial : inputs need not be told apart, as of drives that are played together along six axes: the Gram matrix is
        then singular along what they do not span (`FrequencyResponse.along` gives what they do).

    Raises
    ------
    InputError : bands, windows or records that do not allow an estimate.
    ComputationError : inputs that cannot be distinguished, unless `partial`.
    """
    records = taking_part(campaign, floor)
    used = channels(campaign, records, floor)
    band = checked_band(band_Hz, campaign.sample_rate_Hz)
    plan = _Plan.of(campaign, records, longest_piece)
    driven, spacing, rank = _driven(records, used, band, plan)
    names = tuple(used.inputs[j] for j in driven)
    if not names:
        raise InputError("expected at least one input that is not zero in the band", field="inputs", value=used.inputs)
    n_y = len(used.outputs)
    width = half_width
    if width is None:
        width = least_half_width(plan.count, min(rank, len(names)), n_y, order, spacing)
    where = _grid(frequency_Hz, band, plan.shortest, campaign.sample_rate_Hz, width)
    fit = LocalFit(where, len(names), n_y, order, width, width * campaign.sample_rate_Hz / plan.shortest)
    for part in _spectra(records, used, driven, band, width, plan):
        fit.add(*part)
    found = fit.estimate(names, partial)
    left_out = [name for name in used.inputs if name not in names]
    method = (f"local polynomial method, order {order}, {2 * width + 1} lines, {fit.records} records or pieces"
              + (f"; not excited and left out: {', '.join(left_out)}" if left_out else ""))
    return FrequencyResponse(found.frequency_Hz, found.value, found.noise, found.gram, names, used.outputs,
                             used.input_unit, used.output_unit, float(found.dof), method=method,
                             shared=_shared(where, width, order, campaign.sample_rate_Hz / plan.shortest))


def _shared(where: np.ndarray, half_width: int, order: int, spacing_Hz: float) -> float:
    """Lines whose errors go together: the sum of the correlations of estimates from windows that overlap.

    A local polynomial is a moving average with weights h that sum to one; over all shifts its correlations sum to
    1 / sum h^2 lines, and lines that are estimated more sparsely share less.
    """
    if where.size < 2:
        return 1.0
    offsets = np.arange(-half_width, half_width + 1)
    h = np.linalg.pinv(np.vander(offsets / half_width, order + 1, increasing=True))[0]
    return max(1.0, float(1 / np.sum(h ** 2) * spacing_Hz / np.median(np.diff(where))))


def noise_covariance(campaign: Campaign, frequency_Hz: np.ndarray, *, smooth_Hz: float | None = None,
                     band_Hz: Band | None = None, order: int = 2, half_width: int | None = None,
                     floor: bool | None = None, longest_piece: int | None = None) -> NoiseCovariance:
    """Nonparametric noise covariance of the outputs: residuals of the local polynomial method, smoothed.

    Windows that do not overlap give independent estimates; those within +-smooth_Hz of a frequency are averaged, at
    least as many as make it positive definite. All records count, those at rest as well (their u is 0), so records
    should share their noise: choose them by `campaign.only`. Nonlinear distortion of driven records is part of it.

    Parameters
    ----------
    frequency_Hz : (n,) where it is wanted. smooth_Hz : half the smoothing band; one window by default.
    Others as in `local_polynomial`.

    Raises
    ------
    InputError, ComputationError : as in `local_polynomial`.
    """
    records = tuple(r for r in campaign.records if r.header.excitation != "sine")
    if not records:
        raise InputError("expected a record other than a stepped sine", field="records")
    used = channels(campaign, records, floor)
    band = checked_band(band_Hz, campaign.sample_rate_Hz)
    plan = _Plan.of(campaign, records, longest_piece)
    driven, spacing, rank = _driven(records, used, band, plan)
    n_y = len(used.outputs)
    width = half_width
    if width is None:
        width = least_half_width(plan.count, rank, n_y, order, spacing=spacing)
    step = campaign.sample_rate_Hz / plan.shortest
    every = _grid(None, band, plan.shortest, campaign.sample_rate_Hz, width)
    asked = _grid(frequency_Hz, band, plan.shortest, campaign.sample_rate_Hz, width)
    if smooth_Hz is not None and not smooth_Hz > 0:
        raise InputError("expected a positive frequency", field="smooth_Hz", value=smooth_Hz)
    centres = every[width:every.size - width:2 * width + 1]  # windows that share no line
    fit = LocalFit(centres, len(driven), n_y, order, width, width * step)
    for part in _spectra(records, used, driven, band, width, plan):
        fit.add(*part)
    # What the outputs hold beside the inputs is known whether or not these are told apart.
    found = fit.estimate(tuple(used.inputs[j] for j in driven), partial=True)
    least = min(-(-(n_y + 2) // found.dof), centres.size)
    return _smoothed(centres, found.noise, found.dof, asked, smooth_Hz or width * step, least,
                     used.outputs, campaign.sample_rate_Hz)


def _smoothed(centres: np.ndarray, noise: np.ndarray, dof: int, frequency_Hz: np.ndarray, smooth_Hz: float, least: int,
              outputs: tuple[str, ...], sample_rate_Hz: float) -> NoiseCovariance:
    """Means over the centres near each frequency, at least `least` of them."""
    low = np.searchsorted(centres, frequency_Hz - smooth_Hz)
    high = np.searchsorted(centres, frequency_Hz + smooth_Hz, side="right")
    middle = np.clip(np.rint(np.interp(frequency_Hz, centres, np.arange(centres.size))).astype(int) - least // 2, 0,
                     centres.size - least)
    few = high - low < least
    low, high = np.where(few, middle, low), np.where(few, middle + least, high)
    count = high - low
    mean = np.stack([noise[a:b].mean(axis=0) for a, b in zip(low, high, strict=True)])
    mean = (mean + np.swapaxes(mean.conj(), 1, 2)) / 2
    if least * dof < noise.shape[1]:
        raise InputError(f"expected longer records: {least * dof} degrees of freedom cannot give a definite covariance "
                         f"of {noise.shape[1]} outputs", field="records")
    return NoiseCovariance(frequency_Hz, mean, (count * dof).astype(float), outputs, sample_rate_Hz)


@dataclass(frozen=True)
class _Plan:
    """How the records are cut: pieces in all, samples of the shortest, longest allowed."""

    count: int
    shortest: int
    longest: int | None

    @staticmethod
    def of(campaign: Campaign, records: Sequence[RecordSource], longest: int | None) -> _Plan:
        if longest is not None and longest < 16:
            raise InputError("expected at least 16 samples", field="longest_piece", value=longest)
        sizes: list[int] = []
        for record in records:
            whole, period = record.header.samples, record.header.period_samples
            parts = 1 if longest is None else -(-whole // longest)
            share = -(-whole // parts)
            if parts > 1 and period:
                share = max(share // period, 1) * period
                parts = whole // share
            sizes += [share] * parts
        return _Plan(len(sizes), min(sizes), longest)


def _grid(frequency_Hz: np.ndarray | None, band: Band, samples: int, rate: float, half_width: int) -> np.ndarray:
    keep = lines(samples, rate, band)
    every = np.arange(keep.start, keep.stop) * rate / samples
    if every.size < 2 * half_width + 1:
        raise InputError(f"expected at least {2 * half_width + 1} lines for the local models; the band {band[0]:g} to "
                         f"{band[1]:g} Hz has {every.size} at {rate / samples:g} Hz: longer records, a wider band or "
                         "fewer inputs", field="band_Hz", value=band)
    if frequency_Hz is None:
        return every
    asked = np.asarray(frequency_Hz, float)
    if asked.ndim != 1 or not np.all(np.diff(asked) > 0) or not (
            asked.size and every[0] * (1 - 1e-9) <= asked[0] and asked[-1] <= every[-1] * (1 + 1e-9)):
        raise InputError(f"expected increasing frequencies from {every[0]:g} to {every[-1]:g} Hz, lines in the band",
                         field="frequency_Hz", value=asked if asked.size < 4 else f"{asked.size} values")
    return asked


def _spectra(records: Sequence[RecordSource], used: Channels, driven: list[int], band: Band, half_width: int,
             plan: _Plan) -> Iterator[_Spectra]:
    """Spectra of one length after the other; the band is widened by half a window, so that its ends are not
    extrapolated."""
    held: list[_Spectra] = []
    for record in records:
        rate = record.header.sample_rate_Hz
        for piece in equal_pieces(record, plan.longest):
            n = piece.header.samples
            margin = half_width * rate / n
            keep = lines(n, rate, (max(band[0] - margin, 0.0), min(band[1] + margin, rate / 2)))
            u, y = used.of(piece)
            new = _Spectra(transform(u[:, driven], keep)[None], transform(y, keep)[None],
                           np.arange(keep.start, keep.stop) * rate / n)
            full = sum(part.U.nbytes + part.Y.nbytes for part in held) > SETTINGS.together_bytes
            if held and (full or not np.array_equal(held[0].line_Hz, new.line_Hz)):
                yield _together(held)
                held = []
            held.append(new)
    if held:
        yield _together(held)


def _together(held: list[_Spectra]) -> _Spectra:
    return _Spectra(np.concatenate([p.U for p in held]), np.concatenate([p.Y for p in held]), held[0].line_Hz)


def _driven(records: Sequence[RecordSource], used: Channels, band: Band, plan: _Plan) -> tuple[list[int], int, int]:
    """Inputs that are not silent in the band in every record, relative to their samples; how many lines lie from one
    excited line to the next, more than one for periodic records; and how many directions the inputs span in all."""
    moving, spacing = np.zeros(len(used.inputs), bool), 1
    gram = np.zeros((len(used.inputs),) * 2, complex)
    for record in records:
        u, _ = used.of(next(equal_pieces(record, plan.longest)))
        spectrum = transform(u, lines(u.shape[0], record.header.sample_rate_Hz, band))
        gram += spectrum.conj().T @ spectrum
        U = np.abs(spectrum)
        here = np.linalg.norm(U, axis=0) > 1e-9 * np.linalg.norm(u, axis=0)
        moving |= here
        if U.size and np.any(here):
            excited = np.flatnonzero(np.any(U[:, here] > 1e-3 * U[:, here].max(axis=0), axis=1))
            spacing = max(spacing, round((excited[-1] - excited[0] + 1) / excited.size))
    kept = np.flatnonzero(moving)
    size = np.sqrt(np.real(np.diag(gram)))[kept]
    values = np.linalg.eigvalsh(gram[np.ix_(kept, kept)] / np.outer(size, size)) if kept.size else np.zeros(0)
    return [int(j) for j in kept], spacing, int(np.count_nonzero(values > SETTINGS.span_tolerance ** 2))
