"""Quick H1 estimates by Welch's method, for the gates only.

G = S_yu inv(S_uu) over Hann segments with half overlap (Bendat and Piersol, Random Data, 4th ed., 2010, chapter 7). For
a periodic record the mean of all periods after the first is used, and segments wrap around its end, so that repeated
periods do not count as new data.

Voltages that always move together (six logical axes played through eight drives, one axis after the other) span fewer
directions than there are drives. Only these directions are estimated. The rows of V are an orthonormal basis of them:
u = V^T a, and G V^T is estimated from a. The reported G is (G V^T) V, which is zero in the other directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from avis_ctrl.measurement.gates.excerpt import Excerpt, once

# Independent segments per half-overlapping Hann segment: 1 / (1 + 2 rho^2), where rho = 1/6 is the correlation of the
# window with itself shifted by half its length.
OVERLAP = 1 / 1.056


@dataclass(frozen=True)
class H1Settings:
    """most_samples : maximum number of samples used of a record, for speed: 31 segments for up to four inputs.
    driven : power of u at a line relative to the strongest line, below which the line counts as not driven: at -30 dB
        most of u and y is leakage from other lines.
    direction : power of a direction of the voltages relative to the strongest direction, with all drives scaled to
        equal r.m.s., below which it counts as not excited: rounding of the voltages to four digits gives less.
    at_line : the same at a single line, relative to the line's own strongest direction: the response in a weaker
        direction would have more than 100 times the noise.
    """

    most_samples: int = 1 << 16
    driven: float = 1e-3
    direction: float = 1e-6
    at_line: float = 1e-4


SETTINGS = H1Settings()


@dataclass(frozen=True, eq=False)
class Spectra:
    """Windowed spectra of the segments of a record.

    f : (n,) Hz; U : (K, n, n_u), Y : (K, n, n_y), scaled to r.m.s. per sqrt(Hz).
    """

    f: np.ndarray
    U: np.ndarray
    Y: np.ndarray

    @property
    def count(self) -> int:
        """Approximate number of independent segments."""
        return max(1, int(len(self.U) * OVERLAP))

    def driven(self) -> np.ndarray:
        """(n,) mask of lines at which the inputs have power, without the mean (lines 0 and 1)."""
        power = np.sum(np.abs(self.U) ** 2, axis=(0, 2))
        power[0] = 0.0
        mask = driven_lines(power)
        mask[:2] = False
        return mask


@dataclass(frozen=True, eq=False)
class H1:
    """H1 estimate: f (n,) Hz, G (n, n_y, n_u), noise (n, n_y) residual power, covariance (n, n_u, n_u) of a row of G
    divided by its noise, coherence (n, n_y) multiple, dof complex degrees of freedom of the noise, basis (n_u, rank)
    orthonormal excited directions of u, power (n,) of u.
    """

    f: np.ndarray
    G: np.ndarray
    noise: np.ndarray
    covariance: np.ndarray
    coherence: np.ndarray
    dof: int
    basis: np.ndarray
    power: np.ndarray

    @property
    def rank(self) -> int:
        """Number of excited directions of u."""
        return self.basis.shape[1]

    def unbiased_coherence(self) -> np.ndarray:
        """(n, n_y) coherence with its bias removed."""
        return self.coherence - (1 - self.coherence) * self.rank / self.dof


def driven_lines(power: np.ndarray) -> np.ndarray:
    """(n,) mask of lines with more than `H1Settings.driven` of the power (n,) of the strongest line."""
    return power > SETTINGS.driven * np.max(power, initial=0.0)


@dataclass(frozen=True, eq=False)
class Samples:
    """u (samples, n_u) and y (samples, n_y) of a record at rate_Hz; wrap : they are one period, which repeats."""

    u: np.ndarray
    y: np.ndarray
    rate_Hz: float
    wrap: bool = False

    @property
    def moving(self) -> int:
        """Number of inputs that are not constant."""
        return int(np.count_nonzero(np.ptp(self.u, axis=0)))

    def spectra(self, length: int | None = None) -> Spectra:
        """Spectra of half-overlapping Hann segments, of `segment_length` by default; none if there are fewer samples
        than in one.
        """
        size = segment_length(len(self.u), self.moving) if length is None else length
        window = signal.get_window("hann", size)
        scale = np.sqrt(2 / (self.rate_Hz * np.sum(window**2)))

        def cut(a: np.ndarray) -> np.ndarray:
            a = np.concatenate([a, a[: size // 2]]) if self.wrap else a
            if len(a) < size:
                return np.zeros((0, size // 2 + 1, a.shape[1]), complex)
            parts = np.lib.stride_tricks.sliding_window_view(a, size, axis=0)[:: size // 2]
            parts = parts - parts.mean(axis=-1, keepdims=True)
            return scale * np.moveaxis(np.fft.rfft(parts * window), -1, 1)

        return Spectra(np.fft.rfftfreq(size, 1 / self.rate_Hz), cut(self.u), cut(self.y))


@once
def usable(seen: Excerpt) -> Samples:
    """The mean period after the first, or the start of the record."""
    rate_Hz = seen.header.sample_rate_Hz
    if seen.periodic:
        u, y = seen.periods("u"), seen.periods("y")
        if u.shape[1] <= SETTINGS.most_samples:
            return Samples(u[1:].mean(axis=0), y[1:].mean(axis=0), rate_Hz, True)
    # Copies: a view would keep the whole record in memory.
    u, y = (array[: SETTINGS.most_samples].copy() for array in (seen.first.u, seen.first.y))
    return Samples(u, y, rate_Hz)


@once
def spectra_of(seen: Excerpt) -> Spectra:
    """Spectra of the usable samples."""
    return usable(seen).spectra()


@once
def h1_of(seen: Excerpt) -> H1 | None:
    """H1 over one record."""
    return h1([spectra_of(seen)])


def segment_length(samples: int, inputs: int) -> int:
    """Segment length, a power of two, with at least 6 segments for each input and 24 in total at half overlap."""
    wanted = max(24, 6 * inputs)
    return max(16, 1 << int(np.log2(max(16.0, 2 * samples / (wanted + 1)))))


def directions(U: np.ndarray) -> np.ndarray:
    """(n_u, rank) orthonormal basis of the excited directions, in the real span of the voltages U (..., n_u)."""
    flat = U.reshape(-1, U.shape[-1])
    gram = np.real(flat.conj().T @ flat)
    size = np.sqrt(np.diag(gram))
    moves = size > np.sqrt(1e-12) * np.max(size, initial=0.0)
    scale = np.where(moves, size, 1.0)
    power, V = np.linalg.eigh(np.where(np.outer(moves, moves), gram / np.outer(scale, scale), 0.0))
    found = scale[:, None] * V[:, power > SETTINGS.direction * np.max(power, initial=0.0)] * moves[:, None]
    return np.asarray(np.linalg.qr(found)[0])


def h1(of: list[Spectra]) -> H1 | None:
    """H1 over the segments of records with equal segment length; None if they are too few for the inputs.

    Inputs that do not move have a zero column. Only lines that are driven in all excited directions are kept.
    """
    joint = of[0]
    if len(of) > 1:
        joint = Spectra(joint.f, np.concatenate([s.U for s in of]), np.concatenate([s.Y for s in of]))
    driven = joint.driven()
    if not driven.any():
        return None
    f, U, Y = joint.f[driven], joint.U[:, driven], joint.Y[:, driven]
    basis = directions(U)
    K, rank = joint.count, basis.shape[1]
    if rank == 0 or 2 * rank + 4 > K:
        return None
    reduced, Y = np.moveaxis(U @ basis, 0, 1), np.moveaxis(Y, 0, 1)  # (n, K, rank), (n, K, n_y)
    gram = np.swapaxes(reduced.conj(), 1, 2) @ reduced
    # Each direction is divided by its size in the whole band, so that a much louder drive does not hide the others.
    size = np.sqrt(np.real(np.einsum("fii->i", gram)))
    power = np.linalg.eigvalsh(gram / np.outer(size, size))
    keep = power[:, 0] > SETTINGS.at_line * power[:, -1]
    if not keep.any():
        return None
    f, reduced, Y, gram = f[keep], reduced[keep], Y[keep], gram[keep]
    inverse = np.linalg.inv(gram)
    solved = inverse @ (np.swapaxes(reduced.conj(), 1, 2) @ Y)
    left, total = _power(Y - reduced @ solved), _power(Y)
    dof = K - rank
    noise = left / len(U) * K / dof
    coherence = 1 - left / np.where(total > 0, total, 1.0)
    coherence[total == 0] = 0.0
    G = np.swapaxes(solved, 1, 2) @ basis.T
    covariance = basis @ inverse @ basis.T * (len(U) / K)
    power_u = _power(reduced).sum(axis=1)
    return H1(f, G, noise, covariance, np.clip(coherence, 0.0, 1.0), dof, basis, power_u)


def _power(x: np.ndarray) -> np.ndarray:
    """(n, channels) sum of |x|^2 over the segments, x (n, K, channels)."""
    return np.asarray(np.sum(x.real**2 + x.imag**2, axis=1))


def octaves(f: np.ndarray) -> list[np.ndarray]:
    """Masks of octave bands over the frequencies; bands with fewer than 3 lines are extended."""
    if not len(f):
        return []
    edges = [f[0]]
    while edges[-1] < f[-1]:
        top = 2 * edges[-1]
        while top < f[-1] and np.count_nonzero((f >= edges[-1]) & (f < top)) < 3:
            top *= 1.1
        edges.append(top)
    edges[-1] = np.nextafter(max(edges[-1], f[-1]), np.inf)
    masks = [(f >= low) & (f < high) for low, high in pairwise(edges)]
    return [mask for mask in masks if mask.any()] or [np.ones(len(f), bool)]


def thirds(f: np.ndarray) -> list[np.ndarray]:
    """Masks of the third-octave bands that contain a line."""
    place = np.floor(3 * np.log2(f / f[0]) + 1e-9).astype(int)
    return [place == k for k in np.unique(place)]


def centres(f: np.ndarray, bands: list[np.ndarray]) -> np.ndarray:
    """(bands,) geometric mean of the lowest and the highest frequency [Hz] of each band."""
    return np.array([np.sqrt(f[band][0] * f[band][-1]) for band in bands])
