"""Quick H1 estimates by Welch's method, for the gates only.

G = S_yu inv(S_uu) over Hann segments with half overlap (Bendat and Piersol, Random Data, 4th ed., 2010, chapter 7).
Of a periodic record the mean of its periods is taken, after the first, and segments wrap around its end, so that
a period that repeats is not counted as new data.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from avis_ctrl.measurement.gates.excerpt import Excerpt

MOST_SAMPLES = 1 << 16
# Half-overlapping Hann segments are worth this many independent ones each.
OVERLAP = 1 / 1.056
# Lines whose input power is below this part of the largest count as not driven.
DRIVEN = 1e-3


@dataclass(frozen=True, eq=False)
class Spectra:
    """Sums over segments of one record.

    f : (n,) Hz; U : (K, n, n_u), Y : (K, n, n_y) windowed spectra of the segments, scaled to r.m.s. per sqrt(Hz).
    """

    f: np.ndarray
    U: np.ndarray
    Y: np.ndarray

    @property
    def count(self) -> int:
        """Independent segments, about."""
        return max(1, int(len(self.U) * OVERLAP))

    def driven(self) -> np.ndarray:
        """(n,) lines at which the inputs have power; never the mean."""
        power = np.sum(np.abs(self.U) ** 2, axis=(0, 2))
        mask = power > DRIVEN * np.max(power[1:], initial=0.0)
        mask[:2] = False
        return mask

    def active(self) -> np.ndarray:
        """(n_u,) inputs that move."""
        power = np.sum(np.abs(self.U[:, 2:]) ** 2, axis=(0, 1))
        return power > 1e-12 * np.max(power, initial=0.0)


@dataclass(frozen=True, eq=False)
class H1:
    """f (n,) Hz, G (n, n_y, n_u), noise (n, n_y) residual power, gram (n, n_u, n_u) sum over segments of U* U^T,
    coherence (n, n_y) multiple, dof complex degrees of freedom of the noise."""

    f: np.ndarray
    G: np.ndarray
    noise: np.ndarray
    gram: np.ndarray
    coherence: np.ndarray
    dof: int


def usable(seen: Excerpt) -> tuple[np.ndarray, np.ndarray, bool]:
    """u, y and whether they wrap around: the mean period after the first, or the first piece of the record."""
    if seen.periodic:
        u, y = seen.periods("u"), seen.periods("y")
        if u.shape[1] <= MOST_SAMPLES:
            return u[1:].mean(axis=0), y[1:].mean(axis=0), True
    return seen.first.u[:MOST_SAMPLES], seen.first.y[:MOST_SAMPLES], False


def segment_length(samples: int, inputs: int) -> int:
    """A power of two that leaves at least 6 segments for each input and 24 in all, half overlapping."""
    wanted = max(24, 6 * inputs)
    return max(16, 1 << int(np.log2(max(16.0, 2 * samples / (wanted + 1)))))


def spectra(u: np.ndarray, y: np.ndarray, rate_Hz: float, length: int, wrap: bool) -> Spectra:
    """Spectra of half-overlapping Hann segments; none of a record that is shorter than one."""
    if wrap:
        u, y = (np.concatenate([a, a[: length // 2]]) for a in (u, y))
    window = signal.get_window("hann", length)
    scale = np.sqrt(2 / (rate_Hz * np.sum(window**2)))

    def cut(a: np.ndarray) -> np.ndarray:
        if len(a) < length:
            return np.zeros((0, length // 2 + 1, a.shape[1]), complex)
        parts = np.lib.stride_tricks.sliding_window_view(a, length, axis=0)[:: length // 2]
        parts = parts - parts.mean(axis=-1, keepdims=True)
        return scale * np.moveaxis(np.fft.rfft(parts * window), -1, 1)

    return Spectra(np.fft.rfftfreq(length, 1 / rate_Hz), cut(u), cut(y))


def h1(of: list[Spectra]) -> H1 | None:
    """Over the segments of some records of equal segment length; None where there are too few for the inputs.

    Inputs that do not move have a zero column. Lines that are not driven are left out.
    """
    U, Y = np.concatenate([s.U for s in of]), np.concatenate([s.Y for s in of])
    joint = Spectra(of[0].f, U, Y)
    keep, active = joint.driven(), joint.active()
    K, n_u = joint.count, int(active.sum())
    if n_u == 0 or 2 * n_u + 4 > K or not keep.any():
        return None
    U, Y = U[:, keep][:, :, active], Y[:, keep]
    gram = np.einsum("kfi,kfj->fij", U.conj(), U)
    # A slight ridge keeps inputs that move together from dividing by zero.
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2).real[:, None, None] * np.eye(n_u)
    solved = np.linalg.solve(gram + ridge, np.einsum("kfi,kfj->fij", U.conj(), Y))
    residual = Y - np.einsum("kfi,fij->kfj", U, solved)
    dof = K - n_u
    noise = np.sum(np.abs(residual) ** 2, axis=0) / len(U) * K / dof
    total = np.sum(np.abs(Y) ** 2, axis=0)
    coherence = 1 - np.sum(np.abs(residual) ** 2, axis=0) / np.where(total > 0, total, 1.0)
    coherence[total == 0] = 0.0
    G = np.zeros((int(keep.sum()), Y.shape[2], len(active)), complex)
    G[:, :, active] = np.swapaxes(solved, 1, 2)
    full = np.zeros((len(G), len(active), len(active)), complex)
    full[:, np.ix_(active, active)[0], np.ix_(active, active)[1]] = gram * (K / len(U) if len(U) else 1.0)
    return H1(joint.f[keep], G, noise, full, np.clip(coherence, 0.0, 1.0), dof)


def octaves(f: np.ndarray) -> list[np.ndarray]:
    """Masks of octave bands over the frequencies; bands with fewer than 3 lines join the next."""
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
