"""Spectral blocks of records and of frequency responses, their lines and their transients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import FLOOR, N_Q, FrequencyModel, ResponseModel, kept_lines
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Record
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.response import SETTINGS as SPAN


@dataclass(frozen=True)
class SpectraSettings:
    """dense_below_Hz : frequency below which all lines have the full weight in a selection [Hz]: the resonances of a
        table are there.
    dependent : relative singular value of unit columns below which a direction is dropped [1]: states with columns this
        close are one. Its square, an eigenvalue of the Gram matrix, must be well above round-off.
    """

    dense_below_Hz: float = 8.0
    dependent: float = 1e-6


SETTINGS = SpectraSettings()


def record_block(record: Record, model: ResponseModel, band_Hz: tuple[float, float]) -> SpectralBlock:
    """Spectra of a whole record on its DFT lines in a band, scaled by 1/sqrt(samples) to preserve the variance of white
    noise.

    Raises
    ------
    InputError : a channel that the model does not have, a band without lines, a rate that is not the model's.
    """
    h = record.header
    model.require_rate(h)
    frequency = scipy.fft.rfftfreq(h.samples, 1 / h.sample_rate_Hz)
    keep = (frequency >= band_Hz[0]) & (frequency <= band_Hz[1]) & (frequency > 0)
    if not np.any(keep):
        raise InputError(
            f"expected a band with lines; record {h.name} resolves {frequency[1]:.3g} Hz up to {frequency[-1]:.4g} Hz",
            field="band_Hz",
            value=band_Hz,
        )

    def spectrum(samples: np.ndarray) -> np.ndarray:
        return scipy.fft.rfft(samples - samples.mean(0), axis=0)[keep] / np.sqrt(h.samples)

    U = np.zeros((int(keep.sum()), len(model.inputs)), complex)
    _place(U, h.u_names, model.actuators, spectrum(record.u), f"record {h.name}: u names")
    if record.floor is not None:
        _place(U, h.floor_names, FLOOR, spectrum(record.floor), f"record {h.name}: floor names", len(model.actuators))
    Y = spectrum(record.y)[:, places(model.sensors.names, h.y_names, "the record has", f"record {h.name}: y names")]
    kind = "floor measured" if record.floor is not None else "floor not measured"
    return SpectralBlock(
        h.name,
        2 * np.pi * frequency[keep],
        U[:, :, None],
        Y[:, :, None],
        transient=True,
        kind=kind,
        start_s=h.start_s,
        samples=h.samples,
    )


def response_block(
    measured: FrequencyResponse, model: ResponseModel, name: str = "frequency response"
) -> SpectralBlock:
    """A measured frequency response, weighted by its covariance.

    If neighbouring lines share data, the covariance of each is multiplied by their number, so that together they
    contain no more than the actual information. Directions that the inputs do not span on a line contain no
    information: their columns are zero.

    Raises
    ------
    InputError : channels or units that are not the model's, a Gram matrix with negative eigenvalues.
    """
    n, n_in = len(measured.frequency_Hz), len(measured.inputs)
    rows = sensor_rows(measured, model)
    if measured.entry_variance is None:
        assert measured.gram is not None and measured.noise is not None
        W = _root(measured.gram)
        noise = measured.noise[:, None][:, :, rows][:, :, :, rows]
    else:
        W = np.broadcast_to(np.eye(n_in, dtype=complex), (n, n_in, n_in))
        variance = measured.entry_variance[:, rows].swapaxes(1, 2)
        noise = variance[..., None] * np.eye(len(rows))
    U = np.zeros((n, len(model.inputs), n_in), complex)
    _place(U, measured.inputs, model.inputs, W, "inputs")
    return SpectralBlock(
        name,
        measured.omega,
        U,
        measured.value[:, rows] @ W,
        noise * measured.shared,
        measured.dof,
        kind=name,
        shared=measured.shared,
    )


def sensor_rows(measured: FrequencyResponse, model: ResponseModel) -> list[int]:
    """Rows of the model's sensors in a measured response. Raises InputError for another unit and missing sensors."""
    if measured.output_unit != model.sensors.unit:
        raise InputError(
            f"expected {model.sensors.unit}", field="unit of the response's outputs", value=measured.output_unit
        )
    return places(model.sensors.names, measured.outputs, "the response has", "outputs")


def _root(gram: np.ndarray) -> np.ndarray:
    """(n, n_u, n_u) W with W W^H = gram, which may be singular; inputs are first normalised, because units differ by
    orders of magnitude.

    Raises InputError for eigenvalues that are negative beyond round-off.
    """
    try:
        return np.linalg.cholesky(gram)
    except np.linalg.LinAlgError:
        pass
    size = np.sqrt(np.maximum(np.real(np.einsum("nii->ni", gram)), 0.0))
    safe = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(gram / (safe[:, :, None] * safe[:, None, :]))
    if np.any(values < -1e-9 * np.maximum(values[:, -1:], np.finfo(float).tiny)):
        raise InputError("expected a Gram matrix without negative eigenvalues", field="gram")
    kept = np.where(values > SPAN.gram * values[:, -1:], values, 0.0)
    return safe[:, :, None] * vectors * np.sqrt(kept)[:, None, :]


def _place(
    into: np.ndarray, names: Sequence[str], known: Sequence[str], values: np.ndarray, field: str, offset: int = 0
) -> None:
    """Write values to the entries of the named inputs."""
    into[:, [offset + k for k in places(names, known, "the model's inputs are", field)]] = values


@kept_lines
def transient_columns(model: FrequencyModel, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, n_y, n_t) columns, for real coefficients, of the transient of a record's ends in its spectra; (n_t,) norms.

    Impulse and step on the body (12), the states of the sensors' chains (`ResponseModel.sensor_transients`), and last
    the inner states of a model other than the body's. The columns have unit norm; each was divided by its original
    norm.
    """
    n, n_in = len(omega), len(model.inputs)
    U = np.zeros((n, n_in + 2 * N_Q, 2 * N_Q), complex)
    U[:, n_in:] = np.eye(2 * N_Q)
    body = model.driven(omega, U, derivative=False).Y
    columns = np.concatenate([body, model.sensor_transients(omega), model.inner_transients(omega)], axis=2)
    norms = np.linalg.norm(columns, axis=(0, 1))
    return columns / norms, norms


def transient_parts(
    x: np.ndarray, norms: np.ndarray, block: SpectralBlock, model: FrequencyModel
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 12, 1) impulses and steps on the body, and (m,) initial values of the inner states: the part of unknowns x
    (n_t,) of the columns of `transient_columns`, norms (n_t,), that depends on the model's parameters."""
    n_b, true = 2 * N_Q, x / norms
    chains = model.sensor_transients(block.omega[:1]).shape[2]
    body = np.broadcast_to(true[None, :n_b, None], (len(block.omega), n_b, 1))
    return body, true[n_b + chains :]


def span(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Q (N, r) orthonormal and X (n_t, r) with columns (N, n_t) X = Q; dependent directions are omitted.

    For dependent columns (an integrator inside a mount, in addition to impulse and step on the body) the unknowns would
    be huge, of opposite sign, and individually meaningless.
    """
    # By the Gram matrix, twice because of round-off: in a third of the time of Householder QR.
    squares, V = np.linalg.eigh(columns.T @ columns)
    kept = squares > SETTINGS.dependent**2 * squares[-1]
    X = V[:, kept] / np.sqrt(squares[kept])
    Q = columns @ X
    again = np.linalg.inv(np.linalg.cholesky(Q.T @ Q)).T
    return Q @ again, X @ again


def thinned(block: SpectralBlock, lines: int, seed: int = 0) -> SpectralBlock:
    """Subset of the lines of a block: preferably driven lines, dense where the resonances are, thinned out above."""
    n = len(block.omega)
    if n <= lines:
        return block
    rng = np.random.default_rng((seed, n))
    power = np.sum(np.abs(block.U) ** 2, axis=(1, 2))
    driven = power > 1e-3 * np.max(power)
    frequency = block.omega / (2 * np.pi)
    # Equal numbers per octave above `dense_below_Hz`, equal weights below it.
    dense = SETTINGS.dense_below_Hz
    weight = np.where(frequency < dense, 1.0, dense / frequency) * np.where(driven, 1.0, 0.05)
    keep = np.argsort(rng.exponential(size=n) / weight)[:lines]
    return block.lines(np.sort(keep))
