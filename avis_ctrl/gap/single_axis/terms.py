"""Candidate terms: one class for each effect that a model of one axis may lack.

A term names its parameters with units and physically possible ranges, where it acts, what it is in words, and which
measurement would tell it from its neighbours. What it does to the model depends on the kind of axis (`drive_terms`,
`oscillator_terms`, `seismometer_terms`). An own term is one subclass, registered by `register`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avis_ctrl.errors import InputError

KINDS = ("drive", "oscillator", "seismometer")


@dataclass(frozen=True)
class AxisParameter:
    """A parameter with its range; scale is the size of step that matters (positive)."""

    name: str
    unit: str
    start: float
    low: float = -np.inf
    high: float = np.inf
    scale: float = 1.0


class Term:
    """A candidate.

    Attributes
    ----------
    name, location : as they appear in the result.
    words : what is missing, as the end of "the model lacks ...".
    separated_by : the measurement that tells it from terms that predict the same here.
    needs : names of terms without which it has no meaning.
    variable : "position" or "velocity" where the term is a static function of it: a free function of the same variable
        then judges its shape. Empty otherwise.
    """

    name: ClassVar[str] = ""
    location: ClassVar[str] = ""
    words: ClassVar[str] = ""
    separated_by: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]] = ()
    variable: ClassVar[str] = ""

    def parameters(self, data: Any) -> tuple[AxisParameter, ...]:
        """Of this term for these data, whose sizes give scales and starts."""
        raise NotImplementedError

    def starts(self, data: Any, residual: np.ndarray) -> list[np.ndarray]:
        """Where to start the fit; several where a parameter acts nonlinearly."""
        return [np.array([p.start for p in self.parameters(data)])]

    @property
    def key(self) -> str:
        """Name and place, by which terms of one kind differ."""
        return f"{self.name}@{self.location}"


_REGISTRY: dict[str, dict[str, Term]] = {kind: {} for kind in KINDS}


def register(kind: str, *terms: Term) -> None:
    """Add candidates to the library of a kind.

    Raises
    ------
    InputError : an unknown kind, a term without name or words, or one whose name and place are taken.
    """
    if kind not in _REGISTRY:
        raise InputError(f"expected one of {', '.join(KINDS)}", field="kind", value=kind)
    for term in terms:
        if not term.name or not term.words or not term.location:
            raise InputError("expected a term with name, location and words", field="term", value=type(term).__name__)
        if term.key in _REGISTRY[kind]:
            raise InputError("expected a name and place that no other term has", field="term", value=term.key)
        _REGISTRY[kind][term.key] = term


def library(kind: str) -> Mapping[str, Term]:
    """Candidates of a kind by name and place.

    Raises
    ------
    InputError : an unknown kind.
    """
    if kind not in _REGISTRY:
        raise InputError(f"expected one of {', '.join(KINDS)}", field="kind", value=kind)
    return dict(_REGISTRY[kind])
