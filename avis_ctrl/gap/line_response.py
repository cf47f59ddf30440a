"""Response of a table on the spectral lines of a whole record: the linear part of a time simulation.

A record that starts from rest is padded with silence of at least its own length and at least `quiet_s`, so that the
wrap-around of the discrete Fourier transform has died out. The responses are those of a fit (`TableResponse`),
including hold, delay and aliases; the floor velocity is band-limited between its samples. At zero frequency, the
floor's displacement per velocity and an integrating loop are infinite while the measured output is finite. This line is
evaluated at `lowest_line` times the line spacing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft

from avis_ctrl.errors import InputError
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.gap.table_response import Acting, TableResponse


@dataclass(frozen=True)
class SimulationSettings:
    """Settings of the simulation of whole records: response on their lines, and forces solved in windows of time.

    quiet_s : silence after a record [s]; with 1 % damping at 1.5 Hz, motion decays to 0.4 %.
    highest_Hz : lines above this are set to zero [Hz]: there only the inertia of a table matters, and it moves little.
    lowest_line : position of the line at frequency zero [line spacings].
    chunk : number of lines for which the table is assembled at once; limits memory.
    most_samples : maximum number of samples of a record that fits into memory in one piece (padded: about 2 kB per
        sample).
    window_s : length of a window [s]: about a radian of the fastest motion of a mount with friction at rest.
    window_tolerance : a window has converged when its deflection changes by less than this fraction of the largest one
        so far [1].
    most_iterations : maximum fixed-point iterations in a window before it is divided into more pieces.
    pieces : numbers of pieces of a window, tried in this order until the iteration contracts; 2^20 for single samples.
    defect : maximum residual of the equation of motion over the deflection, r.m.s. [1]: far below any sensor's noise.
    most_passes : maximum number of passes over the record before the simulation counts as not converging.
    """

    quiet_s: float = 60.0
    highest_Hz: float = 500.0
    lowest_line: float = 0.01
    chunk: int = 8192
    most_samples: int = 1_000_000
    window_s: float = 0.05
    window_tolerance: float = 1e-9
    most_iterations: int = 40
    pieces: tuple[int, ...] = (1, 8, 1 << 20)
    defect: float = 1e-5
    most_passes: int = 12


SETTINGS = SimulationSettings()


class LineResponse:
    """The table on the lines of a padded record.

    Attributes
    ----------
    samples, padded : of a record, without and with silence. omega : (n,) rad/s of the lines kept, starting at zero.
    parts : the table on successive groups of `chunk` lines. kept : quantities computed from it once for all records.
    """

    def __init__(self, model: TableModel, samples: int, padded: int, sample_rate_Hz: float):
        self.model, self.samples, self.padded, self.sample_rate_Hz = model, samples, padded, sample_rate_Hz
        spacing = 2 * np.pi * sample_rate_Hz / padded
        n = min(padded // 2 + 1, int(SETTINGS.highest_Hz * padded / sample_rate_Hz) + 1)
        self.omega = spacing * np.arange(n)
        self.omega[0] = SETTINGS.lowest_line * spacing
        self.parts = [self.at(slice(k, k + SETTINGS.chunk)) for k in range(0, n, SETTINGS.chunk)]
        self.kept: dict[str, Any] = {}

    def at(self, lines: slice | np.ndarray) -> Assembled:
        """The table on some of the lines."""
        return Assembled(self.model.operators(self.omega[lines]))

    def spectrum(self, samples: np.ndarray) -> np.ndarray:
        """(n, m) spectrum of (samples, m) from rest."""
        return scipy.fft.rfft(samples, self.padded, axis=0)[: len(self.omega)]

    def in_time(self, spectrum: np.ndarray) -> np.ndarray:
        """(samples, m) time signal of a spectrum (n, m)."""
        return scipy.fft.irfft(spectrum, self.padded, axis=0)[: self.samples]

    def record_response(
        self,
        u: np.ndarray,
        floor: np.ndarray | None,
        moved: np.ndarray | None = None,
        acceleration: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """y (samples, n_y), and deflection (samples, n_g) of the mounts.

        u (samples, n_u), floor (samples, 3). moved : (n, n_q) spectrum of a motion in addition to the response to u and
        floor. acceleration : (samples, n_y) along the sensors in addition to that of the table's motion.
        """
        U = self.spectrum(np.hstack([u, np.zeros((len(u), 3)) if floor is None else floor]))
        beside = None if acceleration is None else -self.spectrum(acceleration) / (self.omega**2)[:, None]
        Y, d, start = [], [], 0
        for part in self.parts:
            here = slice(start, start := start + len(part.ops.omega))
            response = TableResponse(
                part, Acting(U[here, :, None], u.shape[1], reading=None if beside is None else beside[here, :, None])
            )
            x = response.x if moved is None else response.x + moved[here, :, None]
            Y.append(response.read(x)[:, :, 0])
            d.append(part.deflection(x, response.w)[:, :, 0])
        return self.in_time(np.concatenate(Y)), self.in_time(np.concatenate(d))


_last: list[tuple[tuple[object, ...], LineResponse]] = []


def line_response(model: TableModel, samples: int, sample_rate_Hz: float) -> LineResponse:
    """The linear part of a model for records of one length; the last result is cached until `clear_cache` is called.

    Raises
    ------
    InputError : a record too long for one piece, or a sample rate other than the model's.
    """
    key = model.base, model.effects, samples, sample_rate_Hz
    if _last and _last[0][0] == key:
        return _last[0][1]
    if samples > SETTINGS.most_samples:
        raise InputError(
            f"expected a record of at most {SETTINGS.most_samples} samples, which is simulated in one piece",
            field="samples",
            value=samples,
        )
    if model.period_s and abs(sample_rate_Hz * model.period_s - 1) > 1e-6:
        raise InputError(
            f"expected the rig's own {1 / model.period_s:g} Hz", field="sample_rate_Hz", value=sample_rate_Hz
        )
    padded = scipy.fft.next_fast_len(max(2 * samples, samples + int(np.ceil(SETTINGS.quiet_s * sample_rate_Hz))), True)
    clear_cache()  # first, so that memory never holds two
    _last.append((key, LineResponse(model, samples, padded, sample_rate_Hz)))
    return _last[0][1]


def clear_cache() -> None:
    """Free the memory of the cached response."""
    for _, response in _last:
        response.kept.clear()  # they refer to the response: only garbage collection would free it
    _last.clear()
