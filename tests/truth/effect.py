"""What an effect of the truth is: how it is drawn and what it does to a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .table import Pilot, Plant

STRENGTHS = ("faint", "clear", "gross")


@dataclass(frozen=True)
class Hidden:
    """One effect of a case.

    parameters : what a scorer may compare (SI, frequencies in Hz). details : the rest of what the effect needs
    (phases, shapes, directions), so that the effect is reproduced from the case alone.
    """

    name: str
    location: str
    parameters: dict[str, float]
    strength: str
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Draw:
    """What a drawing function gets: a generator, the table, its expected motion at the middle and highest level."""

    rng: np.random.Generator
    plant: Plant
    middle: Pilot
    high: Pilot
    strength: str
    span_s: float  # campaign clock at the end of the last record
    band_Hz: tuple[float, float]
    tolerances: dict[str, float] = field(default_factory=dict)  # of a cluttered table, SI; empty: none

    def size(self, faint: float, gross: float, least: float = 0.0) -> float:
        """A size between the faintest and the grossest, log-uniform within the third that the strength names.

        least : where the faintest begins if that is more.
        """
        third, faint = STRENGTHS.index(self.strength), max(faint, least)
        return float(faint * (gross / faint) ** ((third + self.rng.random()) / 3))

    def beyond(self, tolerance: str) -> float:
        """Three tolerances: a departure that is less is none in a cluttered table; 0 in a clean one."""
        return 3 * self.tolerances.get(tolerance, 0.0)

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def between(self, low: float, high: float, size: int | None = None) -> Any:
        """Log-uniform."""
        out = low * (high / low) ** self.rng.random(size)
        return float(out) if size is None else out

    def one(self, names: tuple[str, ...]) -> str:
        return str(self.rng.choice(names))

    def direction(self) -> np.ndarray:
        d = self.rng.standard_normal(3)
        return d / np.linalg.norm(d)

    def point(self) -> np.ndarray:
        """Somewhere on the payload, from the geometric centre."""
        return self.rng.uniform(-1, 1, 3) * [0.6, 0.5, 0.3]


@dataclass(frozen=True)
class Effect:
    """draw(Draw) -> (location, parameters, details); apply(plant, hidden) changes the plant in place."""

    name: str
    family: str
    draw: Callable[[Draw], tuple[str, dict[str, float], dict[str, Any]]]
    apply: Callable[[Plant, Hidden], None]
