"""Short representations of results: one line in a terminal, a table in a notebook, no raw arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from enum import Enum
from html import escape
from math import isfinite
from textwrap import fill
from typing import Any, ClassVar


@dataclass(frozen=True)
class SummarySettings:
    """longest : maximum number of characters of a value in a repr or table. line : line width for wrapped sentences.
    digits : significant digits of a number in a repr or table.
    """

    longest: int = 60
    line: int = 100
    digits: int = 5


SETTINGS = SummarySettings()


def wrapped(sentence: str) -> str:
    """Wrap a sentence to the width of a terminal."""
    return fill(sentence, SETTINGS.line)


def rounded_up(value: float, digits: int = 3) -> float:
    """The value with significant digits, rounded up: for upper bounds, which hold for larger values only."""
    return _directed(value, digits, ROUND_CEILING)


def rounded_down(value: float, digits: int = 3) -> float:
    """The value with significant digits, rounded down: for lower bounds."""
    return _directed(value, digits, ROUND_FLOOR)


def distinct_from_one(value: float, digits: int = 4) -> str:
    """An upper bound of mu as text: rounded up, with enough digits not to look equal to 1."""
    return f"{rounded_up(value, digits_apart(value, 1.0, digits)):.9g}"


def _directed(value: float, digits: int, rounding: str) -> float:
    if not isfinite(value) or value == 0:
        return value
    exact = Decimal(repr(float(value)))  # the shortest number that reads back as this one
    return float(exact.quantize(Decimal(1).scaleb(exact.adjusted() - digits + 1), rounding=rounding))


def digits_apart(value: float, limit: float, least: int) -> int:
    """Number of significant digits, from `least` to nine, with which a value does not look equal to its limit."""
    return next((n for n in range(least, 9) if f"{value:.{n}g}" != f"{limit:.{n}g}"), 9 if value != limit else least)


def in_short(value: Any) -> str:
    """A number with five digits, an array as its shape, a long text as its beginning."""
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, (int, float)):
        return f"{value:.{SETTINGS.digits}g}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return in_short(value.item()) if not value.shape else f"array{tuple(value.shape)}"
    if isinstance(value, dict):
        facts = [f"{key}: {in_short(one)}" for key, one in value.items()]
        whole = ", ".join(facts)
        shown = [fact for k, fact in enumerate(facts, 1) if len(", ".join(facts[:k])) <= SETTINGS.longest]
        return whole if len(shown) == len(facts) else ", ".join([*shown, f"... ({len(facts)} entries)"])
    if isinstance(value, (list, tuple)):
        return f"({', '.join(map(in_short, value))})" if len(value) <= 2 else f"{len(value)} items"
    if isinstance(value, Enum):
        return value.name
    text = repr(value)
    return text if len(text) <= SETTINGS.longest else f"{text[: SETTINGS.longest - 3]}..."


def count_of(number: int, noun: str) -> str:
    """ "1 state", "2 states"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def joined(words: Sequence[str], last: str = "and") -> str:
    """ "a, b and c"."""
    return f" {last} ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else list(words))


def percent(fraction: float) -> str:
    """A fraction in per cent, three digits."""
    return f"{100 * fraction:.3g} %"


def html_table(rows: Iterable[Sequence[str]], head: Sequence[str] = (), title: str = "") -> str:
    """A plain HTML table; everything is escaped."""

    def line(cells: Sequence[str], tag: str) -> str:
        return "".join(["<tr>", *(f"<{tag} style='text-align:left'>{escape(str(c))}</{tag}>" for c in cells), "</tr>"])

    caption = f"<caption><b>{escape(title)}</b></caption>" if title else ""
    return f"<table>{caption}{line(head, 'th') if head else ''}{''.join(line(row, 'td') for row in rows)}</table>"


class Shown:
    """Mixin that gives a dataclass (with repr=False) a short repr, and a table in notebooks.

    in_line : the fields in the repr; empty for all fields.
    """

    in_line: ClassVar[tuple[str, ...]] = ()

    def __repr__(self) -> str:
        facts = [f"{name}={text}" for name, text in self._facts() if name in self.in_line or not self.in_line]
        return f"{type(self).__name__}({', '.join(facts)})"

    def _repr_html_(self) -> str:
        return html_table(self._facts(), title=type(self).__name__)

    def _facts(self) -> list[tuple[str, str]]:
        return [(one.name, _fact(one.name, getattr(self, one.name))) for one in fields(self)]  # type: ignore[arg-type]


def _fact(name: str, value: Any) -> str:
    """A field in short; an upper bound is rounded up, a lower bound down."""
    if isinstance(value, float) and "upper" in name:
        value = rounded_up(value, SETTINGS.digits)
    elif isinstance(value, float) and "lower" in name:
        value = rounded_down(value, SETTINGS.digits)
    return in_short(value)
