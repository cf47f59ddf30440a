"""What a point may be: a design, a skyhook, a gap, a function of the user's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from avis_ctrl.sweep.design_points import DesignBase
from avis_ctrl.sweep.function_points import FunctionBase
from avis_ctrl.sweep.gap_points import GapBase
from avis_ctrl.sweep.points_file import PointsFile


class Job(Protocol):
    """A point with everything that its result depends on; goes to another process whole."""

    @property
    def inputs(self) -> str:
        """Everything that the result depends on, as text."""

    def compute(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Figures for the table, and what else is kept. Raises AvisError."""


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
    kinds: dict[str, Callable[[PointsFile, Path], Base]] = {
        "design": DesignBase.read, "skyhook": DesignBase.read, "gap": GapBase.read, "function": FunctionBase.read}
    return kinds[file.kind](file, folder)
