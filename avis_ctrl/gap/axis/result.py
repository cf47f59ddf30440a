"""Result of the gap search for one axis, and its JSON form as the contract of `avis gap` requires."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.result import NamedEffect
from avis_ctrl.measurement.gates.finding import Picture


@dataclass(frozen=True)
class AxisStage:
    """A model on data that no fit has used. nrmse : norm of the error over that of the measured response.
    chi2_per_dof : mean square of the error over that of the measured noise; None if the noise is unknown."""

    name: str
    nrmse: float
    chi2_per_dof: float | None


@dataclass(frozen=True)
class RunnerUp:
    """A candidate that could replace a named effect, and its probability."""

    name: str
    instead_of: str
    probability: float


@dataclass(frozen=True, eq=False)
class AxisGap:
    """What is missing from a model of one axis.

    verdict : "none", "explained", "partly explained" or "unexplained" (contract of `avis gap`). effects : the named
    ones, largest contribution first; traces : those with a negligible contribution. stages : base model, then one more
    effect each. where : bands with most of the residual of the last stage. sentences : the first is the summary.
    parameters : base parameters of the updated model. model : the updated and the base model as plain data, as read by
    `simulation`.
    """

    kind: str
    verdict: str
    effects: tuple[NamedEffect, ...]
    traces: tuple[NamedEffect, ...]
    stages: tuple[AxisStage, ...]
    where: tuple[dict[str, Any], ...]
    sentences: tuple[str, ...]
    next_experiment: str | None
    parameters: Mapping[str, Reported]
    ratios: Mapping[str, Reported]
    runners_up: tuple[RunnerUp, ...]
    over_noise: float | None
    share_left: float
    pictures: tuple[Picture, ...] = ()
    model: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Plain data in the shape of the contract's gap.json; numbers that are not finite become None."""
        remaining = {
            "nrmse": number(self.stages[-1].nrmse),
            "over_noise": number(self.over_noise),
            "share": number(self.share_left),
            "where": list(self.where),
            "grows_with_level": None,
        }
        return {
            "format": "avis-gap-axis",
            "version": 2,
            "kind": self.kind,
            "verdict": self.verdict,
            "effects": [one.to_json() for one in self.effects],
            "traces": [one.to_json() for one in self.traces],
            "gap": [
                {"stage": one.name, "nrmse": number(one.nrmse), "chi2_per_dof": number(one.chi2_per_dof)}
                for one in self.stages
            ],
            "where": list(self.where),
            "remaining": remaining,
            "next_experiment": self.next_experiment,
            "base_parameters": _plain(self.parameters),
            "ratios": _plain(self.ratios),
            "runners_up": [vars(one) for one in self.runners_up],
            "sentences": list(self.sentences),
            "seconds": round(self.seconds, 2),
        }


def _plain(several: Mapping[str, Reported]) -> dict[str, Any]:
    return {name: {"value": number(p.value), "std": number(p.std), "unit": p.unit} for name, p in several.items()}


def number(value: float | None) -> float | None:
    """The value as a float; None if it is not finite."""
    return None if value is None or not np.isfinite(value) else float(value)
