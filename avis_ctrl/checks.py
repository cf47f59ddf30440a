"""Argument checks used by many functions. They raise a one-line error that names the field."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from avis_ctrl.errors import InputError


def is_number(value: object) -> bool:
    """Whether a value is a finite real number."""
    return (
        isinstance(value, (int, float, np.integer, np.floating))
        and not isinstance(value, bool)
        and bool(np.isfinite(value))
    )


def is_whole(value: object, least: float = -np.inf) -> bool:
    """Whether a value is an integer of at least `least`."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= least)


def require(value: float, field: str, low: float = 0.0, high: float = np.inf) -> None:
    """Raise InputError naming the field unless the value is finite and low < value < high."""
    if not (is_number(value) and low < value < high):
        span = f"greater than {low:g}" if np.isinf(high) else f"between {low:g} and {high:g}"
        raise InputError(f"expected a finite number {span}", field=field, value=value)


def require_positive(value: float, field: str, *, zero_allowed: bool = False) -> None:
    """Raise InputError naming the field unless the value is finite and positive (or zero if allowed)."""
    if not (is_number(value) and (value > 0 or (zero_allowed and value == 0))):
        raise InputError(
            f"expected a finite number, {'zero or positive' if zero_allowed else 'greater than zero'}",
            field=field,
            value=value,
        )


def require_whole(value: int, field: str, least: int) -> None:
    """Raise InputError naming the field unless the value is an integer of at least `least`."""
    if not is_whole(value, least):
        raise InputError(f"expected a whole number, {least} or more", field=field, value=value)


def places(names: Iterable[str], known: Sequence[str], owner: str, field: str) -> list[int]:
    """Index of each name in `known`.

    Raises InputError with the unknown names; owner : the start of its message, such as "the record has".
    """
    names = list(names)
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"{owner} {', '.join(known)}", field=field, value=unknown)
    return [list(known).index(name) for name in names]
