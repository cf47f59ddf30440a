"""Known systems and excitations for the tests of measurement."""

from __future__ import annotations

import numpy as np
from scipy import signal

from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader


class Modal:
    """Discrete system: sum of second-order modes with random residues between n_u inputs and n_y outputs, plus D."""

    def __init__(self, rng, n_y, n_u, modes_Hz, damping, rate_Hz, direct=0.1):
        self.n_y, self.n_u, self.rate_Hz = n_y, n_u, rate_Hz
        self.D = direct * rng.standard_normal((n_y, n_u))
        self.parts = []
        for f in modes_Hz:
            p = np.exp((-damping + 1j * np.sqrt(1 - damping**2)) * 2 * np.pi * f / rate_Hz)
            self.parts.append((np.poly([p, p.conj()]).real, rng.standard_normal((n_y, n_u)) * abs(1 - p) ** 2))

    def response(self, frequency_Hz):
        """D + sum_m R_m z^-1 / (1 + a1 z^-1 + a2 z^-2): by the definition, not by simulation."""
        z1 = np.exp(-2j * np.pi * np.asarray(frequency_Hz) / self.rate_Hz)
        return self.D + sum((z1 / np.polyval(a[::-1], z1))[:, None, None] * R for a, R in self.parts)

    def simulate(self, u):
        """(samples, n_y) from rest."""
        y = u @ self.D.T
        for a, R in self.parts:
            y = y + signal.lfilter([0, 1], a, u, axis=0) @ R.T
        return y


def campaign(experiments, rate_Hz, excitation="noise", period_s=None, levels=None, floors=None):
    """Campaign of (u, y) pairs."""
    records = []
    for k, (u, y) in enumerate(experiments):
        floor = None if floors is None else floors[k]
        header = RecordHeader(
            f"{k:02d}",
            rate_Hz,
            u.shape[0],
            tuple(f"u{j + 1}" for j in range(u.shape[1])),
            tuple(f"y{j + 1}" for j in range(y.shape[1])),
            excitation,
            1.0 if levels is None else levels[k],
            0.0,
            period_s,
            floor_names=() if floor is None else ("vx", "vy", "vz")[: floor.shape[1]],
        )
        records.append(Record(header, u, y, floor))
    return Campaign("test", tuple(records))


def multisine(rng, samples, lines, n_u, amplitude=1.0):
    """One period each of the n_u experiments of an orthogonal random-phase multisine: (n_u, samples, n_u)."""
    T = np.exp(2j * np.pi * np.outer(np.arange(n_u), np.arange(n_u)) / n_u)
    phase = np.exp(2j * np.pi * rng.random((len(lines), n_u)))
    spectra = np.zeros((n_u, samples // 2 + 1, n_u), complex)
    spectra[:, lines] = phase[None] * T[:, None, :]
    return np.fft.irfft(spectra, samples, axis=1) * samples * amplitude / np.sqrt(2 * len(lines))


def squared_error(estimate, exact):
    """|error|^2 over its estimated variance, for every entry."""
    return np.abs(estimate.value - exact) ** 2 / estimate.variance()
