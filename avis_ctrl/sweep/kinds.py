"""What a point may be: a design, a skyhook, a gap, a function of the user's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from avis_ctrl.sweep.job import Job
from avis_ctrl.sweep.points_file import PointsFile


class Base(Protocol):
    """What the points of a sweep have in common.

    quantities : labels, with units, of the figures. pareto : the two of the picture, None where nothing is natural.
    """

    @property
    def quantities(self) -> Mapping[str, str]: ...

    @property
    def pareto(self) -> tuple[str, str] | None: ...

    def expand(self, key: str) -> Sequence[str]:
        """The keys that a key stands for. Raises InputError for an unknown one."""

    def job(self, point: Mapping[str, Any]) -> Job:
        """The base with the values of a point. Raises InputError for one that does not fit."""


def open_base(file: PointsFile, folder: Path) -> Base:
    """The base of a file of points in a folder. Raises InputError where it does not exist or is wrong."""
    # Late: a process that computes one kind loads nothing of the others.
    if file.kind == "gap":
        from avis_ctrl.sweep.gap_points import GapBase

        return GapBase.read(file, folder)
    if file.kind == "function":
        from avis_ctrl.sweep.function_points import FunctionBase

        return FunctionBase.read(file, folder)
    from avis_ctrl.sweep.design_points import DesignBase

    return DesignBase.read(file, folder)
