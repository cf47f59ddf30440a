"""A record in time for effects that depend on amplitude or time: its voltages, and the motion at the mounts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft


@dataclass(frozen=True, eq=False)
class RecordMotion:
    """A record, or the part of one that a block holds.

    Attributes
    ----------
    name : of the block. sample_rate_Hz, start_s : of the first sample, on the campaign's clock.
    campaign_s : (first, last) time of the campaign.
    volts : (samples, n_u) commanded, in the model's order.
    deflection : (samples, n_g) of each mount along each axis, payload less chassis [m], in the order of
        `MountGeometry.names`. rows : (n_g, 6) from q to it. stiffness : (n_g,) N/m of each.
    vertical : (n_g,) which are along z. driven_rows : (n_u,) which row each motor acts along.
    before : samples of the record before the block's first one, held in all arrays; cut off by `spectrum`.
    """

    name: str
    sample_rate_Hz: float
    start_s: float
    campaign_s: tuple[float, float]
    volts: np.ndarray
    deflection: np.ndarray
    rows: np.ndarray
    stiffness: np.ndarray
    vertical: np.ndarray
    driven_rows: np.ndarray
    level_V: float = 0.0
    before: int = 0

    @cached_property
    def time_s(self) -> np.ndarray:
        """(samples,) on the campaign's clock."""
        return self.start_s + (np.arange(len(self.volts)) - self.before) / self.sample_rate_Hz

    def spectrum(self, samples: np.ndarray, omega: np.ndarray) -> np.ndarray:
        """(n, channels) of (samples, channels) on the block's lines, scaled as a `SpectralBlock` is."""
        own = samples[self.before:]
        lines = np.rint(omega * len(own) / (2 * np.pi * self.sample_rate_Hz)).astype(int)
        return scipy.fft.rfft(own - own.mean(0), axis=0)[lines] / np.sqrt(len(own))
