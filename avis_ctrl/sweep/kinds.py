"""Kinds of points: a design, a skyhook, a gap search, a user function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from avis_ctrl.sweep.points_file import PointsFile
from avis_ctrl.sweep.task import Job


class Base(Protocol):
    """The common part of the points of a sweep."""

    @property
    def quantities(self) -> Mapping[str, str]:
        """Labels, with units, of the figures."""

    @property
    def pareto(self) -> tuple[str, str] | None:
        """The two quantities of the plot; None without a natural choice."""

    def expand(self, key: str) -> Sequence[str]:
        """The keys that match a key. Raises InputError for an unknown key."""

    def job(self, point: Mapping[str, Any]) -> Job:
        """The base with the values of a point. Raises InputError for values that do not fit."""


def open_base(file: PointsFile, folder: Path) -> Base:
    """The base of a points file in a folder. Raises InputError if it is missing or invalid."""
    # Late imports: a process that computes one kind does not load the others.
    if file.kind == "gap":
        from avis_ctrl.sweep.gap_points import GapBase

        return GapBase.read(file, folder)
    if file.kind == "function":
        from avis_ctrl.sweep.function_points import FunctionBase

        return FunctionBase.read(file, folder)
    from avis_ctrl.sweep.design_points import DesignBase

    return DesignBase.read(file, folder)
