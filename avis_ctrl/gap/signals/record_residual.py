"""What a model leaves of a record, in time and on the lines of its transform."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, RecordHeader

# Variance of a mean of |e|^2 over neighbouring lines of a Hann window, by that of independent lines: the correlation
# of e is 2/3 one line apart and 1/6 two apart, so 1 + 2 (4/9 + 1/36).
HANN_SHARED = 1 + 2 * (4 / 9 + 1 / 36)


@dataclass(frozen=True)
class LineSettings:
    """Of the lines of a record.

    driven : of the power of its largest line, above which a line of u counts as driven [1]: far above round-off,
        and below what any drive's spectrum leaves out on purpose.
    """

    driven: float = 1e-6


SETTINGS = LineSettings()


@dataclass(frozen=True, eq=False)
class RecordResidual:
    """y minus a model's prediction in one record.

    header : of the record. u : (samples, n_u) commanded volts. e : (samples, n_y), unit of y.

    Raises
    ------
    InputError : shapes that do not belong to the header, numbers that are not finite.
    """

    header: RecordHeader
    u: np.ndarray
    e: np.ndarray

    def __post_init__(self) -> None:
        wanted = (self.header.samples, len(self.header.y_names))
        if np.shape(self.e) != wanted or not np.all(np.isfinite(self.e)):
            raise InputError(f"expected finite numbers of shape {wanted}, as y has them", value=np.shape(self.e),
                             field=f"record {self.header.name}: residual")
        if len(self.u) != self.header.samples:
            raise InputError(f"expected {self.header.samples} samples", value=len(self.u),
                             field=f"record {self.header.name}: u")

    @cached_property
    def frequency_Hz(self) -> np.ndarray:
        """(n,) of the lines."""
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
        """(n,) lines in which u holds more than a millionth of the power of its largest line."""
        power = np.sum(np.abs(self.U) ** 2, axis=1)
        return power > SETTINGS.driven * power.max() if power.max() > 0 else np.zeros(len(power), bool)

    @property
    def silent(self) -> bool:
        """u does nothing."""
        return not np.any(self.u)

    @property
    def periods(self) -> int:
        """Whole periods that fill the record; 0 where it is not periodic, or not cut between periods."""
        h = self.header
        whole = h.periods if h.period_samples and h.samples % h.period_samples == 0 else 0
        return whole if whole >= 2 else 0

    def _spectrum(self, x: np.ndarray) -> np.ndarray:
        n = self.header.samples
        window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
        return scipy.fft.rfft((x - x.mean(0)) * window[:, None], axis=0) / np.sqrt(n * 3 / 8)


def record_residuals(campaign: Campaign, predicted: Mapping[str, np.ndarray]) -> tuple[RecordResidual, ...]:
    """Of the records that a prediction (samples, n_y) is given for, by record name; memory holds all of them.

    Raises
    ------
    InputError : a name that the campaign does not have, a prediction of another shape, none at all.
    """
    if not predicted:
        raise InputError("expected the prediction of one record at least", field="predicted")
    found = []
    for name, y in predicted.items():
        record = campaign.named(name).load()
        if np.shape(y) != record.y.shape:
            raise InputError(f"expected shape {record.y.shape}", field=f"record {name}: prediction", value=np.shape(y))
        found.append(RecordResidual(record.header, record.u, record.y - y))
    return tuple(found)


def check_common(left: Sequence[RecordResidual]) -> RecordHeader:
    """The first header; InputError where there is none or channels or rates differ."""
    if not left:
        raise InputError("expected the residual of one record at least", field="residuals")
    first = left[0].header
    for one in left[1:]:
        if (one.header.y_names, one.header.sample_rate_Hz) != (first.y_names, first.sample_rate_Hz):
            raise InputError(f"expected channels and sample rate of record {first.name}",
                             field=f"record {one.header.name}")
    return first
