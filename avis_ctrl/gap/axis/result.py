"""Result of the gap search for one axis, and its JSON form as the contract of `avis gap` requires."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.result import Findings, NamedEffect, Remainder, Stage, Verdict, Where
from avis_ctrl.measurement.gates.finding import Picture


@dataclass(frozen=True)
class RunnerUp:
    """A candidate that could replace a named effect, and its probability."""

    name: str
    instead_of: str
    probability: float


@dataclass(frozen=True, eq=False)
class AxisGap(Findings):
    """What is missing from a model of one axis.

    effects : the named ones, largest contribution first; traces : those with a negligible contribution. stages : base
    model, then one more effect each, on data that no fit has used; what depends on the noise is nan if the noise is
    unknown. remaining : bands with most of the residual of the last stage. left : its size. sentences : the first is
    the summary. parameters : base parameters of the updated model. ratios : derived from them. model : the updated and
    the base model as plain data, as read by `simulation`.
    """

    kind: str
    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    traces: tuple[NamedEffect, ...]
    stages: tuple[Stage, ...]
    remaining: tuple[Where, ...]
    left: Remainder
    sentences: tuple[str, ...]
    next_experiment: str | None
    parameters: Mapping[str, Reported]
    ratios: Mapping[str, Reported]
    runners_up: tuple[RunnerUp, ...]
    pictures: tuple[Picture, ...] = ()
    model: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """gap.json of the contract, format "avis-gap-axis" version 2; numbers may be nan."""
        return {
            "format": "avis-gap-axis",
            "version": 2,
            "kind": self.kind,
            **self.findings(),
            "base_parameters": {name: asdict(one) for name, one in self.parameters.items()},
            "ratios": {name: asdict(one) for name, one in self.ratios.items()},
            "runners_up": [vars(one) for one in self.runners_up],
            "sentences": list(self.sentences),
            "seconds": round(self.seconds, 2),
        }
