"""The points of a sweep: listed points times grid axes times random draws."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.sweep.points_file import PointsFile, VarySection

Point = dict[str, Any]


@dataclass(frozen=True)
class SweepSettings:
    """Limits of a sweep.

    max_points : maximum number; a grid grows as a product, and a typing error in the file could fill the disk.
    patience_s : time [s] to wait for a scheduler and its first worker; a scheduler takes a few seconds to start.
    deaths : number of cluster processes that may die while computing a point before the point counts as the cause (a
        process may also die because its machine is switched off).
    """

    max_points: int = 20_000
    patience_s: float = 60.0
    deaths: int = 3


def points_of(
    file: PointsFile, expand: Callable[[str], Sequence[str]], settings: SweepSettings = SweepSettings()
) -> list[Point]:
    """All points, each with its values by key.

    Random axes are drawn together: `count` draws in total. The draws depend on seed and key only.

    Parameters
    ----------
    expand : returns the keys that match a key with wildcards; raises InputError for an unknown key. Random values are
        drawn for each matching key separately; the values of a list apply to all of them.

    Raises
    ------
    InputError : an unknown key, a key that varies twice, random axes of different counts, too many points.
    """
    listed = [_flat(point) for point in file.point] or [{}]
    grids = [one for one in file.vary if one.values is not None]
    drawn = [one for one in file.vary if one.random is not None]
    counts = {one.random.count for one in drawn if one.random is not None}
    if len(counts) > 1:
        raise InputError(
            "expected one count: random axes are drawn together", field="vary.random.count", value=sorted(counts)
        )
    sizes = [len(listed), *(len(one.values or ()) for one in grids), *counts]
    if (total := math.prod(sizes)) > settings.max_points:
        raise InputError(
            f"expected at most {settings.max_points}; here are {' x '.join(map(str, sizes))}",
            field="points",
            value=total,
        )
    keys = [key for point in file.point for key in _flat(point)]
    _require_single([*dict.fromkeys(keys), *(one.key for one in file.vary)])
    for key in (*keys, *(one.key for one in grids)):
        expand(key)
    draws = [dict(row) for row in zip(*(_column(one, key) for one in drawn for key in expand(one.key)), strict=True)]
    values = [[(one.key, value) for value in one.values or ()] for one in grids]
    return [
        {**point, **dict(chosen), **draw}
        for point in listed
        for chosen in itertools.product(*values)
        for draw in draws or [{}]
    ]


def _require_single(keys: Sequence[str]) -> None:
    for key in keys:
        if keys.count(key) > 1:
            raise InputError("expected each key once", field="key", value=key)


def _flat(table: dict[str, Any], before: str = "") -> Point:
    """Flatten a listed point: TOML reads dotted keys as nested tables; explicit tables are treated the same way."""
    found: Point = {}
    for key, value in table.items():
        found |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return found


def _column(axis: VarySection, key: str) -> list[tuple[str, float]]:
    drawn = axis.random
    assert drawn is not None  # points_of passes random axes only
    fractions = np.random.default_rng([drawn.seed, *key.encode()]).random(drawn.count)
    return [(key, drawn.between(float(fraction))) for fraction in fractions]
