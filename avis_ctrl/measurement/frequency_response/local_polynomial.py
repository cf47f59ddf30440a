"""Frequency responses and noise covariances of campaigns by local models, for any excitation.

Every record, or piece of a long record, has its own transient; G is common to all (`local_fit`). Nothing is assumed to
be periodic, so records of noise, multisines from rest and floor motion can be pooled. For periodic excitation,
`best_linear` also separates nonlinear distortion.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordSource
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
    """Covariance of the output noise on one line of a transform divided by sqrt(samples).

    covariance : (n, n_y, n_y) Hermitian, positive definite; dof : (n,) complex degrees of freedom. A one-sided power
    spectral density is 2 covariance / sample rate.
    """

    covariance: np.ndarray
    dof: np.ndarray


def local_polynomial(
    campaign: Campaign,
    *,
    band_Hz: Band | None = None,
    frequency_Hz: np.ndarray | None = None,
    order: int = 2,
    half_width: int | None = None,
    floor: bool | None = None,
    longest_piece: int | None = None,
    partial: bool = False,
) -> FrequencyResponse:
    """Local polynomial estimate, all records pooled (Pintelon and Schoukens 2012, section 7.2).

    The bias grows with the half width and the curvature of G: (half width / record length)^(order + 1). Nonlinear
    distortion counts as noise. The memory needed is one triangular factor per frequency and one piece of a record.

    Estimates with overlapping windows use common lines, so their errors are correlated. The covariance is that of each
    frequency by itself.

    Parameters
    ----------
    band_Hz : band of the lines to use, without line 0 (sensor offsets); all lines by default.
    frequency_Hz : frequencies of the estimates; by default every line of the shortest piece.
    order : degree of the polynomials, usually 2 to 4.
    half_width : window of 2 half_width + 1 lines; by default the smallest with 2 n_y + 4 degrees of freedom.
    floor : use the floor velocity as additional inputs; by default if every record measured it. Records with u = 0 are
        only used in this case.
    longest_piece : maximum number of samples; longer records are used in pieces, each with its own transient.
    partial : the inputs need not be separable, such as drives that are played together along six axes. The Gram matrix
        is then singular along directions that they do not span (`FrequencyResponse.along` gives the spanned responses).

    Raises
    ------
    InputError : bands, windows or records that do not allow an estimate.
    ComputationError : inputs that cannot be distinguished, unless `partial`.
    """
    data = _Data.of(taking_part(campaign, floor), floor, band_Hz, longest_piece)
    names, used = data.names, data.used
    if not names:
        message = "expected at least one input that is not zero in the band"
        raise InputError(message, field="inputs", value=used.inputs)
    width = data.width(order) if half_width is None else half_width
    where = data.grid(frequency_Hz, width)
    fit = data.fit(where, order, width)
    found = fit.estimate(names, partial)
    method = f"local polynomial method, order {order}, {2 * width + 1} lines, {fit.records} records or pieces"
    if left_out := [name for name in used.inputs if name not in names]:
        method += f"; not excited and left out: {', '.join(left_out)}"
    return FrequencyResponse(
        found.frequency_Hz,
        found.value,
        found.noise,
        found.gram,
        **used.labels(names),
        dof=float(found.dof),
        method=method,
        shared=_shared(where, width, order, data.step_Hz),
    )


def _shared(where: np.ndarray, half_width: int, order: int, spacing_Hz: float) -> float:
    """Number of lines with correlated errors: the sum of the correlations of estimates from overlapping windows.

    A local polynomial is a moving average with weights h that sum to one. Its correlations over all shifts sum to
    1 / sum h^2 lines; the number is smaller for estimates on a coarser grid.
    """
    if where.size < 2:
        return 1.0
    offsets = np.arange(-half_width, half_width + 1)
    h = np.linalg.pinv(np.vander(offsets / half_width, order + 1, increasing=True))[0]
    return max(1.0, float(1 / np.sum(h**2) * spacing_Hz / np.median(np.diff(where))))


def noise_covariance(
    campaign: Campaign,
    frequency_Hz: np.ndarray,
    *,
    smooth_Hz: float,
    band_Hz: Band | None = None,
    order: int = 2,
    floor: bool | None = None,
    longest_piece: int | None = None,
) -> NoiseCovariance:
    """Nonparametric noise covariance of the outputs: smoothed residuals of the local polynomial method.

    Windows that do not overlap give independent estimates. Those within +-smooth_Hz of a frequency are averaged, and at
    least as many as make the result positive definite. All records are used, including records at rest (where u is 0),
    so they should have the same noise: select them with `campaign.only`. The result includes the nonlinear distortion
    of driven records.

    Parameters
    ----------
    frequency_Hz : (n,) frequencies of the result. smooth_Hz : half the smoothing band.
    Other parameters as in `local_polynomial`.

    Raises
    ------
    InputError, ComputationError : as in `local_polynomial`.
    """
    records = tuple(r for r in campaign.records if r.header.excitation != "sine")
    if not records:
        raise InputError("expected a record other than a stepped sine", field="records")
    data = _Data.of(records, floor, band_Hz, longest_piece)
    width = data.width(order)
    asked, every = data.grid(frequency_Hz, width), data.grid(None, width)
    centres = every[width : every.size - width : 2 * width + 1]  # windows without a common line
    # The residual of the outputs is known whether or not the inputs can be separated.
    found = data.fit(centres, order, width).estimate(data.names, partial=True)
    least = min(-(-(len(data.used.outputs) + 2) // found.dof), centres.size)
    return _smoothed(centres, found.noise, found.dof, asked, smooth_Hz, least)


def _smoothed(
    centres: np.ndarray, noise: np.ndarray, dof: int, frequency_Hz: np.ndarray, smooth_Hz: float, least: int
) -> NoiseCovariance:
    """Means over the centres near each frequency, at least `least` of them."""
    low = np.searchsorted(centres, frequency_Hz - smooth_Hz)
    high = np.searchsorted(centres, frequency_Hz + smooth_Hz, side="right")
    nearest = np.rint(np.interp(frequency_Hz, centres, np.arange(centres.size))).astype(int)
    middle = np.clip(nearest - least // 2, 0, centres.size - least)
    few = high - low < least
    low, high = np.where(few, middle, low), np.where(few, middle + least, high)
    count = high - low
    mean = np.stack([noise[a:b].mean(axis=0) for a, b in zip(low, high, strict=True)])
    mean = (mean + np.swapaxes(mean.conj(), 1, 2)) / 2
    if least * dof < noise.shape[1]:
        found = f"{least * dof} degrees of freedom are too few for the covariance of {noise.shape[1]} outputs"
        raise InputError(f"expected longer records: {found}", field="records")
    return NoiseCovariance(mean, (count * dof).astype(float))


@dataclass(frozen=True)
class _Data:
    """Data of an estimate.

    pieces : (record, start, stop), each with its own transient; used : channels; band : Hz; rate : sample rate, Hz;
    step_Hz : distance between the lines of the shortest record's pieces; driven : indices of the inputs that some
    record excites; spacing : lines from one excited line to the next, more than one for periodic records; rank : number
    of directions that the inputs span in total.
    """

    pieces: list[tuple[RecordSource, int, int]]
    used: Channels
    band: Band
    rate: float
    step_Hz: float
    driven: list[int]
    spacing: int
    rank: int

    @staticmethod
    def of(records: Sequence[RecordSource], floor: bool | None, band_Hz: Band | None, longest: int | None) -> _Data:
        used, rate = channels(records, floor), records[0].header.sample_rate_Hz
        band = checked_band(band_Hz, rate)
        if longest is not None and longest < 16:
            raise InputError("expected at least 16 samples", field="longest_piece", value=longest)
        cuts = [equal_pieces(record, longest) for record in records]
        shortest = min(stop - start for (start, stop), *_ in cuts)
        firsts = (record.load(*some[0]) for record, some in zip(records, cuts, strict=True))
        pieces = [(record, *one) for record, some in zip(records, cuts, strict=True) for one in some]
        return _Data(pieces, used, band, rate, rate / shortest, *_driven(firsts, used, band))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the driven inputs."""
        return tuple(self.used.inputs[j] for j in self.driven)

    def width(self, order: int) -> int:
        """Minimum half width [lines] of a window."""
        return least_half_width(len(self.pieces), self.rank, len(self.used.outputs), order, self.spacing)

    def grid(self, frequency_Hz: np.ndarray | None, half_width: int) -> np.ndarray:
        """(n,) requested frequencies, by default all lines in the band."""
        keep = lines(round(self.rate / self.step_Hz), self.rate, self.band)
        every = np.arange(keep.start, keep.stop) * self.step_Hz
        if every.size < 2 * half_width + 1:
            message = (
                f"expected at least {2 * half_width + 1} lines for the local models; the band {self.band[0]:g} to "
                f"{self.band[1]:g} Hz has {every.size} at {self.step_Hz:g} Hz: longer records, a wider band or fewer "
                "inputs"
            )
            raise InputError(message, field="band_Hz", value=self.band)
        if frequency_Hz is None:
            return every
        asked = np.asarray(frequency_Hz, float)
        low, high = every[0] * (1 - 1e-9), every[-1] * (1 + 1e-9)
        if asked.ndim != 1 or not asked.size or asked[0] < low or asked[-1] > high or not np.all(np.diff(asked) > 0):
            message = f"expected increasing frequencies from {every[0]:g} to {every[-1]:g} Hz, lines in the band"
            raise InputError(message, field="frequency_Hz", value=asked if asked.size < 4 else f"{asked.size} values")
        return asked

    def fit(self, where: np.ndarray, order: int, half_width: int) -> LocalFit:
        """Least-squares problems at (n,) Hz. The band is widened by half a window to avoid extrapolation at its ends;
        pieces of equal length are processed together.
        """
        fit = LocalFit(where, len(self.driven), len(self.used.outputs), order, half_width, half_width * self.step_Hz)
        held: list[tuple[np.ndarray, np.ndarray]] = []
        line_Hz = np.zeros(0)
        for record, start, stop in self.pieces:
            n = stop - start
            margin = half_width * self.rate / n
            keep = lines(n, self.rate, (max(self.band[0] - margin, 0.0), min(self.band[1] + margin, self.rate / 2)))
            own_Hz = np.arange(keep.start, keep.stop) * self.rate / n
            full = sum(U.nbytes + Y.nbytes for U, Y in held) > SETTINGS.together_bytes
            if held and (full or not np.array_equal(line_Hz, own_Hz)):
                fit.add(np.stack([U for U, _ in held]), np.stack([Y for _, Y in held]), line_Hz)
                held = []
            u, y = self.used.of(record.load(start, stop))
            held.append((transform(u[:, self.driven], keep), transform(y, keep)))
            line_Hz = own_Hz
        fit.add(np.stack([U for U, _ in held]), np.stack([Y for _, Y in held]), line_Hz)
        return fit


def _driven(records: Iterable[Record], used: Channels, band: Band) -> tuple[list[int], int, int]:
    """`driven`, `spacing` and `rank` of `_Data`: driven inputs are not silent in the band, relative to their
    samples."""
    moving, spacing = np.zeros(len(used.inputs), bool), 1
    gram = np.zeros((len(used.inputs),) * 2, complex)
    for record in records:
        u, _ = used.of(record)
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
    return [int(j) for j in kept], spacing, int(np.count_nonzero(values > SETTINGS.span_tolerance**2))
