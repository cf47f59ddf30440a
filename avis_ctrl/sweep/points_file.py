"""The points file: what is computed, from which base, and which of its keys vary."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from avis_ctrl.rigs.file_errors import Section, read_toml, validated


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
