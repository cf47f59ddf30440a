"""Residual of a model in a record, in time and on the lines of its transform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from scipy.signal.windows import hann

from avis_ctrl.identification.campaign_fit import SETTINGS as FIT
from avis_ctrl.measurement.campaign import Campaign, RecordHeader

# Variance of a mean of |e|^2 over neighbouring lines of a Hann window, over that of independent lines: the correlation
# of e is 2/3 one line apart and 1/6 two lines apart, so 1 + 2 (4/9 + 1/36).
HANN_SHARED = 1 + 2 * (4 / 9 + 1 / 36)


@dataclass(frozen=True, eq=False)
class RecordResidual:
    """y minus a model's prediction in one record.

    header : of the record. u : (samples, n_u) commanded volts. e : (samples, n_y), unit of y.
    """

    header: RecordHeader
    u: np.ndarray
    e: np.ndarray

    @cached_property
    def frequency_Hz(self) -> np.ndarray:
        """(n,) frequencies of the lines."""
        return scipy.fft.rfftfreq(self.header.samples, 1 / self.header.sample_rate_Hz)

    @cached_property
    def E(self) -> np.ndarray:
        """(n, n_y) spectrum under a Hann window; noise of variance s^2, white at the sample rate, has E|E|^2 = s^2."""
        return self._spectrum(self.e)

    @cached_property
    def U(self) -> np.ndarray:
        """(n, n_u) spectrum of u under the same window."""
        return self._spectrum(self.u)

    @cached_property
    def driven(self) -> np.ndarray:
        """(n,) mask of the lines that u excites."""
        power = np.sum(np.abs(self.U) ** 2, axis=1)
        return power > FIT.silent_line**2 * power.max() if power.max() > 0 else np.zeros(len(power), bool)

    @property
    def silent(self) -> bool:
        """Whether u is zero."""
        return not np.any(self.u)

    @property
    def periods(self) -> int:
        """Number of whole periods that fill the record; 0 if it is not periodic, or not cut between periods."""
        h = self.header
        whole = h.periods if h.period_samples and h.samples % h.period_samples == 0 else 0
        return whole if whole >= 2 else 0

    def _spectrum(self, x: np.ndarray) -> np.ndarray:
        n = self.header.samples
        return scipy.fft.rfft((x - x.mean(0)) * hann(n, sym=False)[:, None], axis=0) / np.sqrt(n * 3 / 8)


def record_residuals(campaign: Campaign, predicted: Mapping[str, np.ndarray]) -> tuple[RecordResidual, ...]:
    """Residuals of the records for which a prediction (samples, n_y) is given by name; memory holds all of them."""
    records = (campaign.named(name).load() for name in predicted)
    return tuple(
        RecordResidual(record.header, record.u, record.y - predicted[record.header.name]) for record in records
    )
