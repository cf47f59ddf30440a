"""Force and position records of one mass as spectral lines of Hann windows, free of transients.

A Hann window w(t) and its derivative are zero at both ends. Integration by parts then gives the transform of a
derivative from that of the signal itself (M. Shinbrot, NACA TN 3288, 1954),

    F{w x'}(omega_k) = sum_l c_l j omega_(k+l) X_(k+l),    c = (-1/4, 1/2, -1/4)

so that M F{w x''} + d F{w x'} + k F{w x} = F{w F} holds exactly on every line, whatever the state at the ends. The
three terms are kept separate, because a response (a delay, a sprung mass) acts on each at its own frequency; applied to
their sum it would also shift the window. Every other line is used, because the noise of neighbouring lines has a
correlation of 2/3.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy import fft, signal
from scipy.interpolate import BSpline

from avis_ctrl.errors import InputError
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings
from avis_ctrl.gap.dahl import dahl
from avis_ctrl.identification.likelihood import Data
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.variances import bands


@dataclass(frozen=True, eq=False)
class Signals:
    """A record: force and position (n,)."""

    name: str
    force: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """Signals of a record at a finer sample rate: q, v and u; mid-range and standard deviation of q, r.m.s. of v."""

    q: np.ndarray
    v: np.ndarray
    u: np.ndarray
    middle: float
    size: float
    speed: float

    @cached_property
    def sign(self) -> np.ndarray:
        """(n,) sign of the velocity."""
        return np.sign(self.v)

    def dahl(self, distance: float) -> np.ndarray:
        """(n,) Dahl friction of unit size: a spring before it slips."""
        return dahl(self.q[:, None], self.q[:1], distance, np.zeros(1))[:, 0] / distance


def _finer(x: np.ndarray, over: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """(over n,) a band-limited signal at `over` times its rate, and its derivative. The line between its ends is
    subtracted and the rest is extended by odd reflection, without a step. A polyphase filter would add a ripple at the
    old rate, a velocity that friction would take for a reversal."""
    n = len(x)
    slope, t = (x[-1] - x[0]) / (n - 1), np.arange(over * n) / over
    bent = x - x[0] - slope * np.arange(n)
    X = fft.rfft(np.r_[bent, -bent[-2:0:-1]])
    s = 2j * np.pi * rate * np.arange(len(X)) / (2 * (n - 1))

    def at_all(X: np.ndarray) -> np.ndarray:
        return over * fft.irfft(X, over * 2 * (n - 1))[: over * n]

    return at_all(X) + x[0] + slope * t, at_all(s * X) + slope * rate


def splines(x: np.ndarray, count: int) -> list[np.ndarray]:
    """Quadratic B-splines over the quantiles of x, which represent a function of x of any shape."""
    inner = np.unique(np.quantile(x, np.linspace(0, 1, count - 1)))
    knots = np.r_[[inner[0]] * 2, inner, [inner[-1]] * 2]
    flat = BSpline.design_matrix(np.clip(x.ravel(), inner[0], inner[-1]), knots, 2).toarray()
    return list(flat.T)


# Force of unit size as a function of the motion and of shape parameters.
Shape = Callable[..., np.ndarray]


class Lines:
    """Windowed transforms of the records of one axis.

    Parameters
    ----------
    records : all at one sample rate. solves_for : "force" or "position", the signal that the model predicts. band_Hz :
    of the lines. smooth_Hz : low-pass cutoff of the motion from which functions are computed; None for no filter.

    Attributes
    ----------
    s : (k,) j omega [rad/s]. fitted, held : data for the likelihood; U of the blocks is empty, because the model keeps
    its own inputs by block name. rows : by block, record and number of each of its segments. over : samples of the
    motion per measured sample. of : (segments, k, 3) by record, from a function of the motion and values of its shape
    parameters. linear_part : from the same, the coefficients of q and v in its best linear approximation. Both are
    computed once.

    Raises
    ------
    InputError : records that are too short for the band.
    """

    def __init__(
        self,
        records: Sequence[Signals],
        rate: float,
        solves_for: str,
        band_Hz: tuple[float, float],
        smooth_Hz: float | None = None,
        settings: AxisSettings = SETTINGS,
    ):
        self.rate, self.solves_for, self.settings, self.smooth_Hz = rate, solves_for, settings, smooth_Hz
        self.records = list(records)
        # With several records, whole records are held out.
        whole = len(self.records) > 1
        shortest = min(len(one.force) for one in self.records)
        self.length = shortest // (2 if whole else settings.spans) * 2 // (settings.segments + 1)
        self.length = min(self.length, max(int(shortest / settings.spans), 2))
        k = np.arange(0, max(self.length // 2, 1), 2)
        f = k * rate / max(self.length, 1)
        inside = (f >= band_Hz[0]) & (f <= min(band_Hz[1], 0.45 * rate))
        self.k = _thinned(k[inside], f[inside], settings)
        if len(self.k) < settings.fewest_lines // 4:
            raise InputError(
                f"expected at least {settings.fewest_lines // 4} lines of the band in each of "
                f"{settings.spans * settings.segments} segments: a longer record or a wider band",
                field="samples",
                value=shortest,
            )
        # The mean of a window is a line too, at a frequency close to zero.
        self.s = 2j * np.pi * np.maximum(self.k, 1e-3) * rate / self.length
        self.starts: list[np.ndarray] = []
        self.held_out: list[np.ndarray] = []
        for number, one in enumerate(self.records):
            starts, held = self._segments(len(one.force), number if whole else None)
            self.starts.append(starts)
            self.held_out.append(held)
        top = min(band_Hz[1], 0.45 * rate)
        self.over = max(2, int(np.ceil(2 * settings.oversampled * top / rate)))
        self.motion = [self._motion(one) for one in self.records]
        self.of: Callable[..., list[np.ndarray]] = cache(self._of)
        self.linear_part: Callable[..., tuple[float, float]] = cache(self._linear_part)
        self.picked: dict[Hashable, tuple[Sequence[np.ndarray], np.ndarray]] = {}
        self.F = [self.transform(one.force, i) for i, one in enumerate(self.records)]
        self.Q, self.V, self.A = (
            [self.transform(one.position, i, order) for i, one in enumerate(self.records)] for order in range(3)
        )
        self.Y = [one.sum(axis=2) for one in (self.F if solves_for == "force" else self.Q)]
        self.rows: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.fitted, self.held = self._data(False), self._data(True)
        self.size = float(np.sqrt(np.mean([np.mean(np.abs(block.Y) ** 2) for block in self.fitted.blocks])))

    def _segments(self, n: int, record: int | None) -> tuple[np.ndarray, np.ndarray]:
        step = self.length // 2
        if record is not None:
            starts = np.arange(0, n - self.length + 1, step)
            return starts, np.full(len(starts), record % 3 == 1)
        span = n // self.settings.spans
        begins = [span * j + step * i for j in range(self.settings.spans) for i in range(self.settings.segments)]
        held = [j % 3 == 1 for j in range(self.settings.spans) for _ in range(self.settings.segments)]
        keep = [start + self.length <= n for start in begins]
        return np.array(begins)[keep], np.array(held)[keep]

    def _motion(self, one: Signals) -> Motion:
        over = self.over

        def smooth(x: np.ndarray) -> np.ndarray:
            if self.smooth_Hz is None or self.smooth_Hz >= 0.49 * self.rate:
                return x
            return signal.sosfiltfilt(signal.butter(4, 2 * self.smooth_Hz / self.rate, output="sos"), x)

        q, v = _finer(smooth(one.position), over, self.rate)
        return Motion(
            q,
            v,
            _finer(one.force, over, self.rate)[0],
            float((q.max() + q.min()) / 2),
            float(np.std(q)),
            float(np.sqrt(np.mean(v**2))),
        )

    def transform(self, x: np.ndarray, record: int, order: int = 0) -> np.ndarray:
        """(segments, k, 3) terms of the windowed derivative of a signal, given at the sample rate or at the finer rate
        of the motion."""
        over = round(len(x) / len(self.records[record].force))
        starts, length = self.starts[record] * over, self.length * over
        X = np.fft.rfft(np.stack([x[a : a + length] for a in starts]), axis=1) / length
        at = self.k[:, None] + np.array([-1, 0, 1])
        lines = np.where(at < 0, X[:, np.abs(at)].conj(), X[:, np.abs(at)])
        return np.array([-0.25, 0.5, -0.25]) * (2j * np.pi * at * self.rate / self.length) ** order * lines

    def around(self, omega: np.ndarray) -> np.ndarray:
        """(n, 3) j omega [rad/s] of the three terms of lines (n,)."""
        return 1j * (omega[:, None] + 2 * np.pi * self.rate / self.length * np.array([-1, 0, 1]))

    def _of(self, shape: Shape, by: tuple[float, ...] = ()) -> list[np.ndarray]:
        return [self.transform(np.broadcast_to(shape(m, *by), m.q.shape), i) for i, m in enumerate(self.motion)]

    def _linear_part(self, shape: Shape, by: tuple[float, ...] = ()) -> tuple[float, float]:
        m, fit, step = self._linear
        alpha, beta, _ = fit @ np.broadcast_to(shape(m, *by), m.q.shape)[::step]
        return float(alpha), float(beta)

    @cached_property
    def _linear(self) -> tuple[Motion, np.ndarray, int]:
        m = self.motion[0]
        step = max(1, len(m.q) // 50_000)
        X = np.column_stack([m.q - np.mean(m.q), m.v, np.ones_like(m.q)])[::step]
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        return m, np.linalg.pinv(X / size) / size[:, None], step

    def of_lines(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(n,) segment number of each line of a block, and the start time of that segment [s]."""
        record, segment = self.rows[name]
        many = max(len(starts) for starts in self.starts)
        when = [self.starts[i][j] / self.rate for i, j in zip(record, segment, strict=True)]
        return np.repeat(record * many + segment, len(self.k)), np.repeat(when, len(self.k))

    def pick(self, columns: Sequence[np.ndarray], name: str) -> np.ndarray:
        """(n,) or (n, 3) values on the lines of a block; computed once."""
        key = id(columns), name
        if key not in self.picked:
            record, segment = self.rows[name]
            self.picked[key] = columns, np.concatenate([columns[i][j] for i, j in zip(record, segment, strict=True)])
        return self.picked[key][1]

    def _data(self, held: bool) -> Data:
        """One block per octave of signal level; the blocks share one discrepancy."""
        at = [(i, j) for i, flags in enumerate(self.held_out) for j in np.flatnonzero(flags == held)]
        loud = np.array([np.sqrt(np.mean(np.abs(self.Y[i][j]) ** 2)) for i, j in at])
        level = np.round(np.log2(loud / loud.max()))
        blocks, levels = [], []
        for one in np.unique(level):
            name = f"{'held out' if held else 'fitted'} {one:g}"
            inside = level == one
            self.rows[name] = tuple(np.array(at)[inside].T)
            omega = np.tile(self.s.imag, int(inside.sum()))
            Y = self.pick(self.Y, name)[:, None]
            floor = self.settings.floor**2 * float(np.mean(np.abs(Y) ** 2))
            blocks.append(block_of(name, omega, Y, np.full(Y.shape, floor)))
            levels.append(float(2.0**one * loud.max()))
        return Data(tuple(blocks), tuple(levels))


def block_of(name: str, omega: np.ndarray, Y: np.ndarray, variance: np.ndarray) -> SpectralBlock:
    """Lines of outputs (n, n_y) with independent noise (n, n_y); the model itself keeps its inputs."""
    block = SpectralBlock(name, omega, np.zeros((len(omega), 0, 1)), Y[:, :, None])
    return block.with_noise(variance[:, :, None] * np.eye(Y.shape[1]))


def _thinned(k: np.ndarray, f: np.ndarray, settings: AxisSettings) -> np.ndarray:
    keep = []
    if not len(k):
        return k
    own = bands(2 * np.pi * np.maximum(f, 1e-6), 3)
    for band in np.unique(own):
        inside = k[own == band]
        few = min(len(inside), settings.lines_per_band)
        keep.append(inside[np.linspace(0, len(inside) - 1, few).round().astype(int)])
    return np.concatenate(keep)
