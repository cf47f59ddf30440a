"""Uncertain elements: real parameters, complex numbers in a disk, dynamics of bounded norm.

Each is an LFT in a normalised delta, |delta| <= 1 (or a matrix Delta of norm at most 1); delta = 0 is the nominal
value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.checks import is_whole
from avis_ctrl.errors import InputError
from avis_ctrl.uncertainty.blocks import Block, ComplexFull, ComplexScalar, RealScalar


@dataclass(frozen=True)
class ElementSettings:
    """pole : 1 + skew delta at and below which a parameter is taken as infinite [1]: far above the accuracy of delta; a
    finite value there is a million times the range.
    """

    pole: float = 1e-6


SETTINGS = ElementSettings()


@dataclass(frozen=True)
class Element:
    """An uncertain element with a name. rows, cols : size of one copy of its Delta."""

    name: str
    rows: int = 1
    cols: int = 1

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError("expected a name", field="name", value=self.name)

    @property
    def scalar(self) -> bool:
        """Whether its copies form a block delta I."""
        return self.rows == self.cols == 1

    @property
    def skew(self) -> float:
        """s in value = (nominal + b delta)/(1 + s delta); 0 unless a real range is asymmetric."""
        return 0.0

    def block(self, copies: int) -> Block:
        """The block of a number of copies."""
        return ComplexScalar(copies, self.name)

    def value(self, delta: Any) -> Any:
        """The value of a normalised delta: a number, or a system for complex elements."""
        return delta


@dataclass(frozen=True)
class RealParameter(Element):
    """A real number in [low, high]; delta = -1, 0, 1 at low, nominal and high."""

    nominal: float = 0.0
    low: float = -1.0
    high: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (np.all(np.isfinite([self.low, self.nominal, self.high])) and self.low < self.nominal < self.high):
            raise InputError(
                f"expected low < nominal < high, got {self.low:g}, {self.nominal:g}, {self.high:g}", field=self.name
            )

    def block(self, copies: int) -> Block:
        return RealScalar(copies, self.name)

    @property
    def skew(self) -> float:
        """s in value = (nominal + b delta)/(1 + s delta); 0 for a symmetric range."""
        width = self.high - self.low
        skew = (2 * self.nominal - self.high - self.low) / width
        return skew if abs(skew) > 1e-14 * (abs(self.high) + abs(self.low)) / width else 0.0

    @property
    def _line(self) -> tuple[float, float]:
        """a, b in value = (nominal + b delta)/(1 + a delta)."""
        return self.skew, self.high + self.skew * self.high - self.nominal

    def lft(self) -> np.ndarray:
        """(2, 2): value = F_u of this matrix and delta."""
        a, b = self._line
        # n + (b - n a) delta/(1 + a delta); both channels get the same size.
        change = b - self.nominal * a
        size = np.sqrt(abs(change))
        return np.array([[-a, np.sign(change) * size], [size, self.nominal]])

    def delta(self, value: float) -> float:
        """The normalised delta of a value."""
        a, b = self._line
        return (value - self.nominal) / (b - a * value)

    def value(self, delta: float) -> float:
        """The value of a normalised delta; inf at delta = -1/skew, and beyond it."""
        a, b = self._line
        below = 1 + a * delta
        return (self.nominal + b * delta) / below if below > SETTINGS.pole else np.inf

    def __str__(self) -> str:
        up, down = self.high - self.nominal, self.nominal - self.low
        if np.isclose(up, down, rtol=1e-9):
            spread = f"+-{100 * up / abs(self.nominal):.3g} %" if self.nominal else f"+-{up:.4g}"
            return f"{self.name} = {self.nominal:.5g} {spread}"
        return f"{self.name} = {self.nominal:.5g} in [{self.low:.5g}, {self.high:.5g}]"


@dataclass(frozen=True)
class ComplexDisk(Element):
    """A complex number within `radius` of a real centre."""

    centre: float = 0.0
    radius: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (np.isfinite(self.centre) and np.isfinite(self.radius) and self.radius > 0):
            raise InputError(
                "expected a finite real centre and a positive radius", field=self.name, value=(self.centre, self.radius)
            )

    def lft(self) -> np.ndarray:
        """(2, 2): value = F_u of this matrix and delta."""
        size = np.sqrt(self.radius)
        return np.array([[0.0, size], [size, self.centre]])

    def value(self, delta: Any) -> Any:
        return self.centre + self.radius * delta

    def __str__(self) -> str:
        return f"{self.name} within {self.radius:.5g} of {self.centre:.5g} (complex)"


@dataclass(frozen=True)
class Dynamics(Element):
    """Unknown stable dynamics Delta(s), rows x cols, of H-infinity norm at most 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("rows", "cols"):
            if not is_whole(getattr(self, field), 1):
                raise InputError(
                    "expected whole numbers of at least 1", field=f"{self.name}: shape", value=(self.rows, self.cols)
                )

    def block(self, copies: int) -> Block:
        if self.scalar:
            return ComplexScalar(copies, self.name)
        if copies > 1:
            raise InputError(
                "dynamics with several inputs or outputs may appear once only: a repeated full block has "
                "no bound of mu",
                field=self.name,
                value=f"{copies} copies",
            )
        return ComplexFull(self.rows, self.cols, self.name)

    def __str__(self) -> str:
        return f"{self.name}: dynamics of norm 1" + ("" if self.scalar else f", {self.rows} x {self.cols}")
