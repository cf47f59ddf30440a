"""The points of a file: listed points times grid axes times random draws."""

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

    most_points : more are refused, because a grid grows by its product and a slip in the file would fill the disk.
    patience_s : wait [s] for a scheduler and its first worker; a scheduler's own start takes a few seconds.
    deaths : processes of a cluster that may die under one point before it counts as their cause (a machine that is
        switched off is not).
    """

    most_points: int = 20_000
    patience_s: float = 60.0
    deaths: int = 3


def points_of(file: PointsFile, expand: Callable[[str], Sequence[str]], settings: SweepSettings = SweepSettings()
              ) -> list[Point]:
    """Values by key of every point.

    The random axes are drawn together, `count` points in all. Draws depend on seed and key only.

    Parameters
    ----------
    expand : the keys that a key with wildcards stands for; raises InputError for an unknown one. Random values are
        drawn for each of them, those of a list are for all of them.

    Raises
    ------
    InputError : an unknown key, one that varies twice, random axes of different counts, too many points.
    """
    listed = [_flat(point) for point in file.point] or [{}]
    grids = [one for one in file.vary if one.values is not None]
    drawn = [one for one in file.vary if one.random is not None]
    counts = {one.random.count for one in drawn if one.random is not None}
    if len(counts) > 1:
        raise InputError("expected one count: random axes are drawn together", field="vary.random.count",
                         value=sorted(counts))
    sizes = [len(listed), *(len(one.values or ()) for one in grids), *counts]
    if (total := math.prod(sizes)) > settings.most_points:
        raise InputError(f"expected at most {settings.most_points}; here are {' x '.join(map(str, sizes))}",
                         field="points", value=total)
    keys = [key for point in file.point for key in _flat(point)]
    _require_single([*dict.fromkeys(keys), *(one.key for one in file.vary)])
    for key in (*keys, *(one.key for one in grids)):
        expand(key)
    draws = [dict(row) for row in zip(*(_column(one, key) for one in drawn for key in expand(one.key)), strict=True)]
    values = [[(one.key, value) for value in one.values or ()] for one in grids]
    return [{**point, **dict(chosen), **draw} for point in listed for chosen in itertools.product(*values)
            for draw in draws or [{}]]


def _require_single(keys: Sequence[str]) -> None:
    for key in keys:
        if keys.count(key) > 1:
            raise InputError("expected each key once", field="key", value=key)


def _flat(table: dict[str, Any], before: str = "") -> Point:
    """A listed point: TOML makes tables of keys with dots; a table in quotes or braces at the end is the same."""
    found: Point = {}
    for key, value in table.items():
        found |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return found


def _column(axis: VarySection, key: str) -> list[tuple[str, float]]:
    drawn = axis.random
    assert drawn is not None  # as points_of chose them
    fractions = np.random.default_rng([drawn.seed, *key.encode()]).random(drawn.count)
    return [(key, drawn.between(float(fraction))) for fraction in fractions]
