"""Numbers, units and names as text; values that are not finite are given in words."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

import numpy as np

from avis_ctrl.summary import rounded_down, rounded_up
from avis_ctrl.uncertain_value import rounded

AXIS_WORDS = {"phi_x_edge": "phi_x (edge)", "phi_y_edge": "phi_y (edge)", "phi_z_edge": "phi_z (edge)"}

# A power of ten such as 1.2e-5, not inside a word.
_POWER = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]\d+)(?!\w)")
_MINUS = re.compile(r"(?<![\w.)-])-(?=\d)")


def typeset(text: str) -> str:
    """Text with the signs ± and −, and without powers of ten for numbers from 1 to 100 000."""
    return _MINUS.sub("−", _POWER.sub(_power, text.replace(" +- ", " ± ")))


def _power(typed: re.Match[str]) -> str:
    exponent = int(typed[2])
    return f"{float(typed[0]):.0f}" if 0 <= exponent < 5 else f"{typed[1]}e{exponent}".replace("-", "−")


def number(value: float, digits: int = 3) -> str:
    """A number with significant digits; powers of ten only below 0.001 and from 100 000 on."""
    if np.isnan(value):
        return "not computed"
    if np.isinf(value):
        return "unbounded"
    if value != 0 and (abs(value) >= 1e5 or abs(value) < 1e-3):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(exponent)}".replace("-", "−")
    rounded = float(f"{value:.{digits}g}")
    places = max(0, digits - 1 - int(np.floor(np.log10(abs(rounded))))) if rounded else 0
    return f"{rounded:.{places}f}".replace("-", "−")


def with_std(value: float, std: float) -> tuple[str, str]:
    """A value and its standard deviation, both to the second significant digit of the latter."""
    if not (np.isfinite(std) and std > 0 and np.isfinite(value)):
        return number(value, 5), number(std, 2)
    first, second = rounded(value, std)
    return first.replace("-", "−"), second.replace("-", "−")


def bound(value: float, digits: int = 3) -> str:
    """A bound of mu or of a gain; it is infinite if stability is not proved."""
    return "no bound" if np.isinf(value) else number(value, digits)


def upper(value: float, digits: int = 3) -> str:
    """An upper bound, rounded up."""
    return bound(rounded_up(value, digits), digits)


def lower(value: float, digits: int = 3) -> str:
    """A lower bound, rounded down."""
    return bound(rounded_down(value, digits), digits)


def percent(share: float, digits: int = 3) -> str:
    """A fraction in per cent; "< 0.001 %" if it is smaller."""
    if not np.isfinite(share):
        return "not computed"
    return "< 0.001 %" if 0 < share < 1e-5 else f"{number(100 * share, digits)} %"


Side = Literal["", "upper", "lower"]


def decibel(gain: float, side: Side = "") -> str:
    """A gain in dB, with its sign. side : "upper" (rounded up) or "lower" (rounded down) for a bound."""
    if np.isnan(gain):
        return "not computed"
    if np.isinf(gain):
        return "no bound"
    if gain <= 0:
        return "none"
    return _tenths(20 * np.log10(gain), side)


def _tenths(value_dB: float, side: Side) -> str:
    """Decibels with one digit behind the point; round-off of a millionth of it does not count."""
    tenths = round(10 * float(value_dB), 6)
    tenths = {"upper": np.ceil, "lower": np.floor}.get(side, np.round)(tenths)
    return f"{tenths / 10:+.1f} dB".replace("-", "−")


def quantity(value: float, unit: str, digits: int = 3, side: Side = "") -> str:
    """A number with its unit; a decibel with its sign, a count as a whole number. side : as for `decibel`."""
    if unit == "plants":
        return f"{value:.0f} plants"
    if unit == "dB" and not np.isnan(value):
        return "no bound" if np.isposinf(value) else _tenths(value, side)
    text = {"upper": upper, "lower": lower}.get(side, bound)
    return f"{text(value, digits)} {unit}".strip()


def hertz(omega: float) -> str:
    """A frequency [rad/s] in Hz."""
    return f"{number(omega / (2 * np.pi))} Hz" if np.isfinite(omega) else "none"


def limits(volts: Mapping[str, float]) -> str:
    """Voltage limits of the drives: one number if all are equal, otherwise by name."""
    if len(set(volts.values())) == 1:
        return f"{number(next(iter(volts.values())))} V"
    return ", ".join(f"{name} {number(value)} V" for name, value in volts.items())


def axis(name: str) -> str:
    """Name of an axis in text."""
    return AXIS_WORDS.get(name, name)


def unit(text: str) -> str:
    """A unit with superscript powers; empty for the unit 1."""
    return "" if text in ("1", "mixed units") else re.sub(r"\^(\d)", lambda power: "⁰¹²³⁴⁵⁶⁷⁸⁹"[int(power[1])], text)


def yes(value: bool) -> str:
    """yes or no."""
    return "yes" if value else "no"


def sentence(text: str) -> str:
    """Text as a sentence: capital first letter, except of a name with an underscore, and a full stop at the end."""
    text = text.replace(" +- ", " ± ").strip()
    first = text.partition(" ")[0].rstrip(":;,.")
    text = text if "_" in first else text[:1].upper() + text[1:]
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."
