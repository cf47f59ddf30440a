"""Modes of an identified rig, with their uncertainty, and modes measured without its equations.

Model: complex eigenvalues of lambda^2 M + lambda C + K. With right and left eigenvectors x, y, the derivative by any
parameter is

    d lambda = - y^T (lambda^2 dM + lambda dC + dK) x / (y^T (2 lambda M + C) x)

(Lancaster, Lambda-matrices and Vibrating Systems, 1966, chapter 7), and the parameters' covariance gives the standard
deviations of frequency and damping (delta method).

Measured: the same number of common poles and free residues from every input to every output,

    y_i = s_i(w) (jw)^p sum_k (b_ijk + jw c_ijk) / (w_k^2 - w^2 + 2 j zeta_k w_k w) u_j,

behind the known sensor chains and the hold: 2 numbers per mode to search for, the rest linear (variable projection,
with Kaufman's Jacobian). Masses, stiffnesses and geometry are used only to start the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg as la
from scipy.optimize import least_squares

from avis_ctrl.errors import ComputationError
from avis_ctrl.identification.response import N_Q, ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs.rigid_body import COORDINATES


@dataclass(frozen=True)
class ModeSettings:
    """named_share : minimum fraction of the mode's kinetic energy for a coordinate to be named [1]; smaller ones do not
        characterise a shape.
    reach : band of the fit of measured modes, relative to the lowest and to the highest mode [1]; further away the
        response hardly depends on the poles.
    most_lines : maximum number of lines of that fit, to limit memory and time.
    fewest_per_unknown : minimum number of real data per unknown [1]; with fewer, the misfit would be known poorly.
    """

    named_share: float = 0.05
    reach: tuple[float, float] = (0.5, 3.0)
    most_lines: int = 30_000
    fewest_per_unknown: float = 2.0


SETTINGS = ModeSettings()


@dataclass(frozen=True, eq=False)
class Modes:
    """frequency_Hz (undamped), damping : (n,), ascending; covariance : (2 n, 2 n) of frequencies, then dampings."""

    frequency_Hz: np.ndarray
    damping: np.ndarray
    covariance: np.ndarray

    @property
    def columns(self) -> tuple[np.ndarray, ...]:
        """(n,) each: frequencies and their standard deviations, damping ratios and theirs."""
        std = np.split(np.sqrt(np.diag(self.covariance)), 2)
        return self.frequency_Hz, std[0], self.damping, std[1]


@dataclass(frozen=True, eq=False)
class ModelModes(Modes):
    """shapes : (6, n) complex. words : each shape by its coordinates' fractions of the kinetic energy."""

    shapes: np.ndarray
    words: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MeasuredModes(Modes):
    """The poles of the data alone; misfit : mean square of the whitened residual, 1 if the poles explain all but the
    noise (standard deviations are multiplied by its root if it is larger)."""

    misfit: float
    lines: int
    band_Hz: tuple[float, float]


@dataclass(frozen=True)
class ModeRow:
    """A line of the mode table; *_sigma : difference, model minus measured, over its standard deviation. NaN : not
    measured."""

    shape: str
    frequency_Hz: float
    frequency_std_Hz: float
    damping: float
    damping_std: float
    start_frequency_Hz: float
    start_damping: float
    measured_frequency_Hz: float
    measured_frequency_std_Hz: float
    measured_damping: float
    measured_damping_std: float
    frequency_sigma: float
    damping_sigma: float


def model_modes(model: ResponseModel, covariance: np.ndarray | None = None) -> ModelModes:
    """Oscillating modes; covariance (n_p, n_p) of the model's parameters, None for no uncertainty.

    Raises
    ------
    ComputationError : a rig with modes that do not oscillate.
    """
    M, C, K = model.matrices.M, model.matrices.C, model.matrices.K
    A = np.block([[np.zeros((N_Q, N_Q)), np.eye(N_Q)], [-la.solve(M, K), -la.solve(M, C)]])
    poles, vectors = la.eig(A)
    keep = np.flatnonzero(poles.imag > 1e-9 * np.abs(poles))
    if len(keep) < N_Q:
        raise ComputationError(
            "not every mode of the rig oscillates",
            measured=f"{len(keep)} of {N_Q} modes do",
            cause="damping above critical, or a stiffness that is not positive",
            next_step="check damping and stiffness of the rig",
        )
    keep = keep[np.argsort(np.abs(poles[keep]))]
    poles, X = poles[keep], vectors[:N_Q, keep]
    words = tuple(_in_words(M, x) for x in X.T)
    if covariance is None:
        return ModelModes(np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles), np.zeros((2 * N_Q,) * 2), X, words)
    d = model.derivative_matrices
    dpoles = np.zeros((len(model.names), N_Q), complex)
    for k, (pole, x) in enumerate(zip(poles, X.T, strict=True)):
        D = pole**2 * M + pole * C + K
        y = la.svd(D)[0][:, -1].conj()  # y^T D = 0
        dD = pole**2 * d.M + pole * d.C + d.K
        dpoles[:, k] = -np.einsum("i,pij,j->p", y, dD, x) / (y @ (2 * pole * M + C) @ x)
    size = np.abs(poles)
    dsize = np.real(np.conj(poles) * dpoles) / size
    ddamping = -dpoles.real / size + poles.real * dsize / size**2
    gradient = np.concatenate([dsize / (2 * np.pi), ddamping], axis=1)
    return ModelModes(size / (2 * np.pi), -poles.real / size, gradient.T @ covariance @ gradient, X, words)


def _in_words(M: np.ndarray, x: np.ndarray) -> str:
    """Coordinates by their fraction of the kinetic energy."""
    share = np.real(np.conj(x) * (M @ x))
    share = share / share.sum()
    order = np.argsort(-share)
    others = [f"{COORDINATES[i]} {100 * share[i]:.0f} %" for i in order[1:] if share[i] >= SETTINGS.named_share]
    return COORDINATES[order[0]] + (f" with {', '.join(others)}" if others else "")


def mode_table(
    model: ResponseModel, covariance: np.ndarray, start: ResponseModel, measured: MeasuredModes | None
) -> tuple[ModeRow, ...]:
    """The model's modes with the start's and the measured ones, lowest first."""
    found, before = model_modes(model, covariance), model_modes(start)
    n = len(found.damping)
    beside = [np.full(n, np.nan)] * 6
    if measured is not None:
        total = np.sqrt(np.diag(found.covariance) + np.diag(measured.covariance))
        frequency, damping = found.frequency_Hz - measured.frequency_Hz, found.damping - measured.damping
        beside = [*measured.columns, frequency / total[:n], damping / total[n:]]
    columns = [*found.columns, before.frequency_Hz, before.damping, *beside]
    return tuple(ModeRow(shape, *map(float, row)) for shape, *row in zip(found.words, *columns, strict=True))


def measured_modes(blocks: Sequence[SpectralBlock], model: ResponseModel) -> MeasuredModes:
    """Poles of data with known noise, as many as the model has, searched from the model's.

    Raises
    ------
    ComputationError : too few lines for free residues, or a search that does not converge.
    """
    start = model_modes(model)
    model, blocks = _of_one_kind(model, blocks)
    low, high = SETTINGS.reach[0] * start.frequency_Hz[0], SETTINGS.reach[1] * start.frequency_Hz[-1]
    kept: list[SpectralBlock] = []
    for block in blocks:
        near = (block.omega >= 2 * np.pi * low) & (block.omega <= 2 * np.pi * high)
        if np.any(near) and sum(len(b.omega) for b in kept) + near.sum() <= SETTINGS.most_lines:
            kept.append(block.lines(near))
    problem = _Poles(kept, model, len(start.damping))
    x = np.concatenate([np.log(start.frequency_Hz), np.log(np.maximum(start.damping, 1e-4))])
    n = len(start.damping)
    reach = np.concatenate([np.full(n, 0.2), np.full(n, 2.0)])
    best = least_squares(
        lambda z: problem.evaluate(tuple(z))[0],
        x,
        lambda z: problem.evaluate(tuple(z))[1],
        bounds=(x - reach, x + reach),
        x_scale="jac",
        ftol=1e-10,
        xtol=1e-8,
        max_nfev=40,
    )
    if np.any(np.abs(best.x - x) > 0.99 * reach) or not best.success:
        raise ComputationError(
            "the fit of the measured modes did not converge",
            measured=f"modes at {np.round(np.exp(best.x[:n]), 3).tolist()} Hz",
            cause="modes hidden by noise, or not excited",
            next_step="check the responses",
        )
    frequency, damping = np.exp(best.x[:n]), np.exp(best.x[n:])
    misfit = 2 * best.cost / (best.fun.size - problem.unknowns - 2 * n)
    scale = np.concatenate([frequency, damping])
    covariance = problem.covariance(tuple(best.x)) * max(misfit, 1.0) * np.outer(scale, scale)
    f = np.concatenate([block.omega for block in kept]) / (2 * np.pi)
    return MeasuredModes(frequency, damping, covariance, float(misfit), f.size, (float(f.min()), float(f.max())))


def _of_one_kind(model: ResponseModel, blocks: Sequence[SpectralBlock]) -> tuple[ResponseModel, list[SpectralBlock]]:
    """Model and blocks with the largest group of sensors with one chain, preferably sensors of motion in space."""
    sensors = model.sensors
    if sensors.alike:
        return model, list(blocks)
    kinds = list(zip(sensors.relative.tolist(), sensors.motions, map(id, sensors.chains), strict=True))
    best = max(dict.fromkeys(kinds), key=lambda kind: (not kind[0], kinds.count(kind)))
    own = [k for k, kind in enumerate(kinds) if kind == best]
    chosen = replace(sensors.picked(own), relative=np.zeros(len(own), bool))
    free = tuple(
        name for name in model.names if not name.startswith("sensor.") or name.removeprefix("sensor.") in chosen.names
    )
    return replace(model, names=free, sensors=chosen), [
        replace(block, Y=block.Y[:, own], noise=None if block.noise is None else block.noise[..., own, :][..., own])
        for block in blocks
    ]


class _Poles:
    """Residual of common poles with the best residues, output by output, each weighted by its own noise.

    Rows are the lines of all blocks and experiments. weight, Y : (n_y, rows). correlation : (rows, n_y, n_y) of the
    noise. through : (rows, columns) signals that the poles filter, inputs and one impulse per record, behind the
    sensors' chain; beside : (rows, columns) regressors without poles.
    """

    def __init__(self, blocks: Sequence[SpectralBlock], model: ResponseModel, modes: int):
        self.modes, self.n_y = modes, len(model.sensors.names)
        if not blocks:
            raise ComputationError(
                "the modes cannot be measured",
                measured="no lines near them",
                cause="a band that does not contain the modes",
                next_step="use a wider band",
            )
        total = np.sum([np.sum(np.abs(block.U) ** 2, axis=(0, 2)) for block in blocks], axis=0)
        driven = np.flatnonzero(total > 1e-12 * total.max())
        parts = [_rows(block, model, driven) for block in blocks]
        self.omega, self.Y, self.weight, self.correlation = (
            np.concatenate([part[k] for part in parts], axis=axis) for k, axis in ((0, 0), (1, 1), (2, 1), (3, 0))
        )
        self.through = np.hstack([np.concatenate([part[4] for part in parts]), la.block_diag(*[p[5] for p in parts])])
        self.beside = np.hstack([np.concatenate([part[6] for part in parts]), la.block_diag(*[p[7] for p in parts])])
        columns = 2 * modes * self.through.shape[1] + self.beside.shape[1]
        if 2 * len(self.omega) < SETTINGS.fewest_per_unknown * columns:
            raise ComputationError(
                "the modes cannot be measured without the rig's equations",
                measured=f"{2 * len(self.omega)} numbers per output for {columns} unknown residues",
                cause="too few lines near the modes for so many inputs",
                next_step="longer records",
            )
        self.unknowns = columns * self.n_y
        self.evaluate = lru_cache(maxsize=2)(self._evaluate)

    def _evaluate(self, x: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Residual (N,) of unit variance and its Jacobian (N, 2 modes) by log w, log zeta."""
        n, s = self.modes, 1j * self.omega[:, None]
        w, zeta = 2 * np.pi * np.exp(x[:n]), np.exp(x[n:])
        den = s**2 + 2 * zeta * w * s + w**2
        slopes = np.hstack([-(2 * zeta * w * s + 2 * w**2) / den**2, -(2 * zeta * w * s) / den**2])
        # Columns: residue or its slope, mode, what is filtered.
        powers = np.stack([np.ones_like(s), s / np.abs(s).max()])
        poles = powers[..., None] / den[None, :, :, None] * self.through[:, None, :]
        Phi = np.hstack([np.moveaxis(poles, 1, 0).reshape(len(s), -1), self.beside])
        left, J = [], []
        for weight, y in zip(self.weight, self.Y, strict=True):
            A = _real(weight[:, None] * Phi)
            size = np.linalg.norm(A, axis=0) + np.finfo(float).tiny
            Q, R = np.linalg.qr(A / size)
            b = _real(weight * y)
            # By pivoted QR: the divide-and-conquer SVD of numpy's lstsq may not converge.
            c = la.lstsq(R, Q.T @ b, cond=1e-12, lapack_driver="gelsy")[0] / size
            c = c[: poles.shape[0] * n * self.through.shape[1]]
            filtered = np.einsum("akc,amc->km", powers * self.through, c.reshape(2, n, -1))
            slope = _real(weight[:, None] * np.tile(filtered, 2) * slopes)
            left.append(b - Q @ (Q.T @ b))
            J.append(Q @ (Q.T @ slope) - slope)
        return np.concatenate(left), np.concatenate(J)

    def covariance(self, x: tuple[float, ...]) -> np.ndarray:
        """(2 modes, 2 modes): each output was weighted separately, but the noise of all outputs is correlated."""
        _, J = self.evaluate(x)
        by_output = J.reshape(self.n_y, 2, len(self.omega), -1)
        own = by_output[:, 0] + 1j * by_output[:, 1]
        middle = np.real(np.einsum("ikp,kij,jkq->pq", np.conj(own), self.correlation, own, optimize=True))
        inverse = np.linalg.inv(J.T @ J)
        return inverse @ middle @ inverse


def _rows(block: SpectralBlock, model: ResponseModel, driven: np.ndarray) -> tuple[np.ndarray, ...]:
    """omega, Y, weight, correlation, inputs, impulse, aliases, own regressors of a block, experiment by experiment."""
    assert block.noise is not None
    n, n_y, m = block.Y.shape
    omega, n_u = np.tile(block.omega, m), len(model.actuators)
    s = 1j * omega
    chain, (drive, folded) = model.sensors.sense(omega)[:, 0], (one[:, 0, 0] for one in model.drive(omega))
    U = np.moveaxis(block.U[:, driven], 2, 0).reshape(m * n, -1)
    volts = driven < n_u
    # The springs act on the integral of the floor's velocity.
    inputs = U * np.where(volts, (chain * drive)[:, None], (chain / s)[:, None])
    noise = np.moveaxis(np.broadcast_to(block.noise, (n, m, n_y, n_y)), 1, 0).reshape(m * n, n_y, n_y)
    sigma = np.sqrt(np.real(np.einsum("kii->ki", noise)))
    impulse, own = np.zeros((m * n, 0), complex), np.zeros((m * n, 0), complex)
    if block.transient:
        impulse, own = chain[:, None], model.chain_transients(s)[0]
    return (
        omega,
        np.moveaxis(block.Y, (1, 2), (0, 1)).reshape(n_y, m * n),
        np.sqrt(2) / sigma.T,
        noise / (sigma[:, :, None] * sigma[:, None, :]),
        inputs,
        impulse,
        folded[:, None] * U[:, volts],
        own,
    )


def _real(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x.real, x.imag])
