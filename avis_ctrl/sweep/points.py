"""The points file (what is computed, from which base, and which of its keys vary), and its points: listed points times
grid axes times random draws."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.file_errors import Section, read_toml, validated

Point = dict[str, Any]


class RandomSection(Section):
    """Random values between two limits, uniform on a linear ("linear") or logarithmic ("log") scale."""

    count: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)]
    low: float
    high: float
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"expected low below high, found {self.low:g} and {self.high:g}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"expected a positive low on a log scale, found {self.low:g}")
        return self

    def between(self, fraction: float) -> float:
        """The value at a fraction (0 to 1) of the range."""
        if self.scale == "linear":
            return self.low + fraction * (self.high - self.low)
        return math.exp(math.log(self.low) + fraction * (math.log(self.high) - math.log(self.low)))


class VarySection(Section):
    """A key with a list of values or with random values."""

    key: Annotated[str, Field(min_length=1)]
    values: Annotated[list[Any], Field(min_length=1)] | None = None
    random: RandomSection | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.values is None) == (self.random is None):
            raise ValueError(f"expected exactly one of values and random for {self.key}")
        return self


class PointsFile(Section):
    """A complete points file.

    base : a design file; for kind "gap" a campaign; for kind "function" FILE.py:NAME. rig : for kind "gap" only.
    pareto : the two quantities of the plot, both minimised; None for the default of the kind.
    """

    title: str = "sweep"
    kind: Literal["design", "skyhook", "gap", "function"] = "design"
    base: Annotated[str, Field(min_length=1)]
    rig: str | None = None
    vary: list[VarySection] = []
    point: list[dict[str, Any]] = []
    pareto: Annotated[list[str], Field(min_length=2, max_length=2)] | None = None


def read_points_file(path: Path) -> PointsFile:
    """Read and check a points file. Raises InputError: one line naming file, field, value and what was expected."""
    return validated(PointsFile, read_toml(path, "a sweep file as in docs/sweep.md"), path)


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

    Raises InputError: an unknown key, a key that varies twice, random axes of different counts, too many points.
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
    counted = Counter([*dict.fromkeys(keys), *(one.key for one in file.vary)])
    if twice := [key for key, count in counted.items() if count > 1]:
        raise InputError("expected each key once", field="key", value=twice[0])
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
