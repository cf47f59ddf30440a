"""Sample rate from time stamps, with precise messages on faulty stamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError


@dataclass(frozen=True)
class TimeAxisSettings:
    """rounding : deviation from even time stamps that is rounding and not reported [samples].
    jitter : largest deviation that is accepted [samples].
    gap : step above which samples are missing [samples].
    same_rate : relative difference up to which a stated sample rate agrees with the time stamps [1].
    """

    rounding: float = 1e-3
    jitter: float = 0.1
    gap: float = 1.5
    same_rate: float = 1e-3


SETTINGS = TimeAxisSettings()


def sample_rate_from(
    time_s: np.ndarray, place: Callable[[int], str] = "sample {}".format, field: str = "t"
) -> tuple[float, float, str]:
    """Sample rate [Hz], time of the first sample [s], and a note ("" if the stamps are even).

    The clock is the straight line through the first and the last stamp. Stamps within a tenth of a sample of it count
    as even, with a note above a thousandth. The rate is rounded within the uncertainty of the stamps.

    time_s : (n,) s; place : names a sample in messages, such as "line 17".

    Raises
    ------
    InputError : fewer than two stamps; stamps that are not finite, not increasing, with a gap, or uneven, with the
        place of the first (of the worst, if uneven) and their number.
    """
    time_s = np.asarray(time_s, float)
    if time_s.ndim != 1 or len(time_s) < 2:
        raise InputError("expected at least two time stamps", field=field, value=time_s.shape)
    finite = np.isfinite(time_s)
    if not finite.all():
        found = f"{np.count_nonzero(~finite)}, the first at {place(int(np.argmin(finite)))}"
        raise InputError(f"expected finite time stamps; NaN or infinite: {found}", field=field)
    step = np.diff(time_s)
    usual = float(np.median(step))
    back, gap = step <= 0, step > SETTINGS.gap * usual
    if back.any():
        k = int(np.argmax(back)) + 1
        found = f"{np.count_nonzero(back)}, the first at {place(k)}: {time_s[k]:.9g} s after {time_s[k - 1]:.9g} s"
        raise InputError(f"expected increasing time stamps; not later than the one before: {found}", field=field)
    if gap.any():
        k = int(np.argmax(gap)) + 1
        found = f"{np.count_nonzero(gap)}, the first before {place(k)}: {step[k - 1]:.6g} s instead of {usual:.6g} s"
        raise InputError(f"expected evenly spaced time stamps; gaps: {found}", field=field)
    mean = (time_s[-1] - time_s[0]) / (len(time_s) - 1)
    off = np.abs(time_s - time_s[0] - mean * np.arange(len(time_s))) / mean
    worst = int(np.argmax(off))
    if off[worst] > SETTINGS.jitter:
        found = f"{np.count_nonzero(off > SETTINGS.jitter)} are more than {SETTINGS.jitter:g} of a sample off"
        at = f"the worst at {place(worst)} by {off[worst]:.3g} samples of {mean:.6g} s"
        raise InputError(f"expected evenly spaced time stamps; {found}, {at}", field=field)
    uneven = off[worst] > SETTINGS.rounding
    note = f"time stamps are uneven by up to {off[worst]:.2g} of a sample; taken as even" if uneven else ""
    return rounded(1 / mean, (2 * float(off[worst]) + 1e-9) / (len(time_s) - 1)), float(time_s[0]), note


def agreed_rate(stated_Hz: float, measured_Hz: float, field: str = "sample_rate_Hz") -> float:
    """The stated sample rate [Hz]. Raises InputError if it is not the rate of the time stamps."""
    if abs(stated_Hz / measured_Hz - 1) > SETTINGS.same_rate:
        raise InputError(f"expected {measured_Hz:.9g} Hz, the rate of the time stamps", field=field, value=stated_Hz)
    return stated_Hz


def rounded(rate: float, uncertainty: float) -> float:
    """The shortest decimal number within the relative uncertainty of the rate."""
    for digits in range(2, 16):
        short = float(f"{rate:.{digits}g}")
        if abs(short - rate) <= uncertainty * rate:
            return short
    return rate
