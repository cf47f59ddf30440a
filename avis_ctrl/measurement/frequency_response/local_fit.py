"""Local models of a frequency response: polynomials in frequency around each line.

Around the frequency f, with d = (line - f) / scale and for each record r,

    Y_r(d) = G(d) U_r(d) + T_r(d) + V_r(d),     G(d) = sum_s G_s d^s,     T_r(d) = sum_s t_rs d^s

(local polynomial method: Pintelon, Schoukens, Vandersteen and Barbe, Mech. Syst. Signal Process. 24, 2010; Pintelon and
Schoukens, System Identification, 2nd ed., 2012, section 7.2). T_r is the transient, including leakage. G and T_r are
estimated by linear least squares.

G is common to all records, T_r is not. T_r is removed by projection onto the orthogonal complement of the polynomials
over the window, a fixed matrix. The result is compressed to a triangular factor per line, updated record by record. The
memory is therefore one factor per line, for any number and length of records.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError, InputError


@dataclass(frozen=True)
class LocalFitSettings:
    """batch : number of lines whose least-squares problems are factored at once; it limits the size of the work arrays.
    together_bytes : memory for the spectra of records that are processed together; larger groups save factorisations.
    rank_tolerance : relative size of the part of an input that the other inputs do not explain, below which the input
        counts as dependent: half the digits of double precision.
    span_tolerance : the same if the responses to the inputs need not be separated: rounding to single precision must
        not be taken for an independent direction.
    silent : amplitude relative to the band's r.m.s. below which an input counts as silent: -100 dB, below the range of
        a 16-bit converter.
    """

    batch: int = 192
    together_bytes: int = 1 << 26
    rank_tolerance: float = 1e-8
    span_tolerance: float = 1e-6
    silent: float = 1e-5


SETTINGS = LocalFitSettings()


@dataclass(frozen=True, eq=False)
class LocalEstimate:
    """Local estimates on lines, with covariances as in `FrequencyResponse`.

    frequency_Hz : (n,); value : (n, n_y, n_u); noise : (n, n_y, n_y) covariance of V on one line of one record;
    gram : (n, n_u, n_u) Gram matrix of the part of the inputs that neither slopes nor transients explain;
    dof : complex degrees of freedom of `noise`.
    """

    frequency_Hz: np.ndarray
    value: np.ndarray
    noise: np.ndarray
    gram: np.ndarray
    dof: int


def degrees_of_freedom(records: int, n_u: int, order: int, half_width: int) -> int:
    """Number of equations minus unknowns of one line: G is common to all records, the transients are not."""
    return records * (2 * half_width - order) - (order + 1) * n_u


def least_half_width(records: int, n_u: int, n_y: int, order: int, spacing: int = 1) -> int:
    """Smallest half width [lines] that gives 2 n_y + 4 degrees of freedom. Below n_y the covariance is singular; above,
    its inverse is too large on average by the factor dof / (dof - n_y).

    spacing : lines from one excited line to the next (number of periods of a periodic record); each window then also
        contains order + 1 excited lines, and enough of them for the unknowns of G over all records.
    """
    half_width = order + 1
    while degrees_of_freedom(records, n_u, order, half_width) < 2 * n_y + 4:
        half_width += 1
    excited = max(order + 1, -(-(order + 1) * n_u // records) + 1) if n_u else 0
    return half_width if spacing == 1 else max(half_width, -(-spacing * excited // 2))


class LocalFit:
    """Accumulates the least-squares problems of all lines, record by record.

    Parameters
    ----------
    frequency_Hz : (n,) frequencies of the estimates; they need not lie on lines of any record.
    n_u, n_y : numbers of inputs and outputs; n_u may be 0 (noise only).
    order : degree of the polynomials, 0 to 6.
    half_width : the window has 2 half_width + 1 lines; near the ends of the given lines it is shifted inwards.
    scale_Hz : unit of d, about half the window.

    Raises
    ------
    InputError : an order or a width outside its range.
    """

    def __init__(self, frequency_Hz: np.ndarray, n_u: int, n_y: int, order: int, half_width: int, scale_Hz: float):
        if order not in range(7):
            raise InputError("expected a whole order from 0 to 6", field="order", value=order)
        if 2 * half_width <= order:
            message = f"expected more than {order / 2:g} lines for polynomials of order {order}"
            raise InputError(message, field="half_width", value=half_width)
        self.frequency_Hz = np.asarray(frequency_Hz, float)
        self.n_u, self.n_y, self.order, self.half_width, self.scale_Hz = n_u, n_y, order, half_width, scale_Hz
        # Columns: [U d^R .. U d], U, Y: the part needed for G(f) is in the lower right corner.
        self._lead = order * n_u
        self._size = self._lead + n_u + n_y
        self._factor = np.zeros((self.frequency_Hz.size, self._size, self._size), complex)
        self._unit: tuple[np.ndarray, np.ndarray] | None = None
        self.records = 0
        # Orthonormal basis of the complement of the transient's polynomials over a window.
        span = np.vander(np.linspace(-1, 1, 2 * half_width + 1), order + 1)
        self._free = np.linalg.qr(span, mode="complete")[0][:, order + 1 :].T

    @property
    def dof(self) -> int:
        """Degrees of freedom of the noise covariance on each line."""
        return degrees_of_freedom(self.records, self.n_u, self.order, self.half_width)

    def window(self, line_Hz: np.ndarray, keep: slice) -> tuple[np.ndarray, np.ndarray]:
        """Indices (b, m) of the lines around the frequencies `keep`, and d (b, m) there."""
        width, step = 2 * self.half_width + 1, line_Hz[1] - line_Hz[0]
        centre = np.rint((self.frequency_Hz[keep] - line_Hz[0]) / step).astype(int)
        start = np.clip(centre - self.half_width, 0, line_Hz.size - width)
        index = start[:, None] + np.arange(width)
        return index, (line_Hz[index] - self.frequency_Hz[keep][:, None]) / self.scale_Hz

    def add(self, U: np.ndarray, Y: np.ndarray, line_Hz: np.ndarray) -> None:
        """Add records of the same length.

        Parameters
        ----------
        U, Y : (n_records, n_lines, n_u) and (n_records, n_lines, n_y) spectra divided by sqrt(samples).
        line_Hz : (n_lines,) consecutive lines.

        Raises
        ------
        InputError : fewer lines than a window, shapes that do not match.
        """
        self._check(U, Y, line_Hz)
        if self._unit is None:
            self._unit = _scale(U), _scale(Y)
        U, Y = U / self._unit[0], Y / self._unit[1]
        for start in range(0, self.frequency_Hz.size, SETTINGS.batch):
            keep = slice(start, min(start + SETTINGS.batch, self.frequency_Hz.size))
            index, d = self.window(line_Hz, keep)
            rows = self._free @ self._columns(U[:, index], Y[:, index], d)
            rows = np.moveaxis(rows, 0, 1).reshape(index.shape[0], -1, self._size)
            if self.records:
                rows = np.concatenate([self._factor[keep], rows], axis=1)
            factor = np.asarray(np.linalg.qr(rows, mode="r"))
            self._factor[keep, : factor.shape[1]] = factor
        self.records += U.shape[0]

    def _columns(self, U: np.ndarray, Y: np.ndarray, d: np.ndarray) -> np.ndarray:
        powers = [d[:, :, None] ** s for s in range(self.order, 0, -1)]
        return np.concatenate([*(U * p for p in powers), U, Y], axis=-1)

    def _check(self, U: np.ndarray, Y: np.ndarray, line_Hz: np.ndarray) -> None:
        shape = (U.shape[0], line_Hz.size)
        if U.shape != (*shape, self.n_u) or Y.shape != (*shape, self.n_y):
            message = f"expected {shape} records and lines with {self.n_u} inputs and {self.n_y} outputs"
            raise InputError(message, field="U, Y", value=(U.shape, Y.shape))
        if line_Hz.size < 2 * self.half_width + 1:
            message = (
                f"expected at least {2 * self.half_width + 1} lines, the window of the local model: a longer record, a "
                "wider band or fewer inputs"
            )
            raise InputError(message, field="lines in the band", value=line_Hz.size)

    def estimate(self, names: tuple[str, ...] | None = None, partial: bool = False) -> LocalEstimate:
        """G, C and S on all lines.

        partial : the inputs need not be separable. S is then singular along directions that the inputs do not span on a
            line, where G is unknown; C, and G along the spanned directions, are as with fewer inputs.

        Raises
        ------
        InputError : no degrees of freedom.
        ComputationError : inputs that cannot be distinguished, with their names, unless `partial`.
        """
        if self.dof < 1 or self._unit is None:
            message = (
                f"expected more or longer records, or a wider window: {self.dof} degrees of freedom remain on each "
                f"line with {self.n_u} inputs, order {self.order} and {self.half_width} lines on each side"
            )
            raise InputError(message, field="records", value=self.records)
        lead, first = self._lead, self._lead + self.n_u
        slopes, own, outputs = self._factor[:, :, :lead], self._factor[:, :, lead:first], self._factor[:, :, first:]
        # Size of each input in the window, at least that of a silent input.
        rows = self.records * (2 * self.half_width - self.order)
        size = np.maximum(np.linalg.norm(own, axis=1), SETTINGS.silent * np.sqrt(rows))
        # The rows of the triangular factor below the slopes are the part of the inputs that the slopes do not explain.
        # This is wrong if the slopes are linearly dependent; they are then projected out with an orthonormal basis of
        # their span.
        spent: int | np.ndarray = lead
        if partial:
            left, s, _ = np.linalg.svd(slopes / np.tile(size, self.order)[:, None, :], full_matrices=False)
            bent = s > SETTINGS.span_tolerance
            Q, spent = left * bent[:, None, :], np.sum(bent, axis=1)
            own, outputs = (part - Q @ (np.swapaxes(Q.conj(), 1, 2) @ part) for part in (own, outputs))
        else:
            own, outputs = own[:, lead:], outputs[:, lead:]
        left, s, right = np.linalg.svd(own / size[:, None, :], full_matrices=False)
        known = s > (SETTINGS.span_tolerance if partial else SETTINGS.rank_tolerance)
        if not partial and not np.all(known):
            self._refuse(~np.all(known, axis=1), s, right, names)
        inverse = np.where(known, 1 / np.where(known, s, 1.0), 0.0)
        along = np.swapaxes(left.conj(), 1, 2) @ outputs * known[:, :, None]
        value = np.swapaxes(right.conj(), 1, 2) @ (inverse[:, :, None] * along) / size[:, :, None]
        dof = rows - spent - np.sum(known, axis=1)
        noise = _covariance(outputs - left @ along) / dof[:, None, None]
        gram = _covariance((s * known)[:, :, None] * right * size[:, None, :])
        unit_u, unit_y = self._unit
        value = np.swapaxes(value, 1, 2) * unit_y[:, None] / unit_u
        noise, gram = noise * unit_y[:, None] * unit_y, gram * unit_u[:, None] * unit_u
        return LocalEstimate(self.frequency_Hz, value, noise, gram, int(dof.min()))

    def _refuse(self, bad: np.ndarray, s: np.ndarray, right: np.ndarray, names: tuple[str, ...] | None) -> None:
        """Raise the error for indistinguishable inputs; s, right : SVD of the part of each input that is not
        explained."""
        names = tuple(f"u{j}" for j in range(self.n_u)) if names is None else names
        null = np.abs(right[np.flatnonzero(bad)[0], -1])
        f = self.frequency_Hz[bad]
        raise ComputationError(
            f"the responses to {', '.join(n for n, part in zip(names, null, strict=True) if part > 0.03)} cannot be "
            "distinguished or are not excited",
            measured=f"{f.size} of {self.frequency_Hz.size} lines from {f[0]:.6g} to {f[-1]:.6g} Hz, relative size of "
            f"their own part {s[bad, -1].min():.1e}",
            cause="inputs that are silent there, or driven by the same signal, or too few excited lines in a window "
            f"of {2 * self.half_width + 1}",
            next_step="keep to the excited band, leave out the inputs that no record excites, take in records that "
            "drive them differently, or widen the window",
        )


def _scale(x: np.ndarray) -> np.ndarray:
    """Root mean square of each channel, 1 where it is silent."""
    rms = np.sqrt(np.mean(np.abs(x) ** 2, axis=(0, 1)))
    return np.where(rms > 0, rms, 1.0)


def _covariance(rows: np.ndarray) -> np.ndarray:
    """Sum of e e^H over stacked rows e^T: (n, m, k) to (n, k, k)."""
    return np.swapaxes(rows, 1, 2) @ rows.conj()
