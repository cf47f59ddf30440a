"""Interface of the computation at a point."""

from __future__ import annotations

from typing import Any, Protocol


class Job(Protocol):
    """A point with everything that its result depends on; it is pickled to other processes."""

    @property
    def inputs(self) -> str:
        """Everything that the result depends on, as text."""

    def compute(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Figures for the table, and further content of the point's file. Raises AvisError."""
