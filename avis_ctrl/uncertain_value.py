"""A value with its standard deviation as text. Sentences, tables and the terminal all use this rounding."""

from __future__ import annotations

import math


def rounded(value: float, std: float) -> tuple[str, str]:
    """Value and standard deviation, both rounded to the second significant digit of the standard deviation.

    If this would need many zeros, both are written with the value's power of ten (1.2340e9, 0.0012e9). Without a
    positive, finite standard deviation the value is given with five digits.
    """
    if not (math.isfinite(std) and std > 0 and math.isfinite(value)):
        return f"{value:.5g}", f"{std:.2g}"
    places = 1 - int(f"{std:.1e}".partition("e")[2])
    if -4 <= places <= 9 and abs(value) < 1e7:
        return f"{round(value, places):.{max(places, 0)}f}", f"{round(std, places):.{max(places, 0)}f}"
    power = math.floor(math.log10(abs(value) or std))
    first, second = (f"{v / 10.0**power:.{max(places + power, 0)}f}e{power}" for v in (value, std))
    return first, second


def with_prefix(value: float, std: float, unit: str) -> tuple[float, float, str]:
    """Value, standard deviation and unit; values below 0.01 s, m or V are converted to ms, mm or mV."""
    if unit in ("s", "m", "V") and 0 < abs(value) < 0.01:
        return 1e3 * value, 1e3 * std, f"m{unit}"
    return value, std, unit


def text(value: float, std: float, unit: str = "") -> str:
    """Text "value +- std unit", or the value alone if there is no standard deviation."""
    value, std, unit = with_prefix(value, std, unit)
    first, second = rounded(value, std)
    known = f"{first} +- {second}" if math.isfinite(std) and std > 0 else first
    return known if unit in ("", "1", "mixed units") else f"{known} {unit}"
