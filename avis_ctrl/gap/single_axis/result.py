"""What the search for a gap of one axis returns, and its JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.measurement.gates.finding import Picture


@dataclass(frozen=True)
class Estimate:
    """A parameter of a named effect."""

    name: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class AxisEffect:
    """A named effect.

    probability : of this effect, or of one that predicts the same, among the candidates of its stage and "nothing
        more", given that the library holds it; 0.99 at the most.
    indistinguishable_from : candidates that share 95 % of the probability with it.
    """

    name: str
    location: str
    parameters: tuple[Estimate, ...]
    probability: float
    indistinguishable_from: tuple[str, ...] = ()


@dataclass(frozen=True)
class AxisStage:
    """A model and what it misses on data that its fit has not seen.

    nrmse : norm of the error over norm of what was measured. chi2_per_dof : mean square of the error over the measured
    noise; None where nothing in the data tells the noise.
    """

    stage: str
    nrmse: float
    chi2_per_dof: float | None


@dataclass(frozen=True, eq=False)
class AxisGap:
    """What is missing from a model of one axis.

    verdict : "none", "explained", "partly explained" or "unexplained" (contract of `avis gap`). stages : base model,
    then each named effect. references : models without physics, for comparison only. where : parts of what the last
    stage leaves. sentences : the first one is the answer. runners_up : candidates of the first stage with their
    posterior probabilities. pictures : plain data.
    """

    kind: str
    verdict: str
    effects: tuple[AxisEffect, ...]
    stages: tuple[AxisStage, ...]
    references: tuple[AxisStage, ...]
    where: tuple[dict[str, Any], ...]
    sentences: tuple[str, ...]
    next_experiment: str | None = None
    base_parameters: tuple[Estimate, ...] = ()
    runners_up: tuple[tuple[str, float], ...] = ()
    pictures: tuple[Picture, ...] = ()
    seconds: float = 0.0

    def ratios(self) -> tuple[Estimate, ...]:
        """Resonance, damping ratio and k3/k of an oscillator, without deviations."""
        p = {one.name: one.value for one in (*self.base_parameters, *(q for e in self.effects for q in e.parameters))}
        if self.kind != "oscillator" or not {"m", "d", "k"} <= set(p):
            return ()
        found = [Estimate("resonance", float(np.sqrt(p["k"] / p["m"]) / (2 * np.pi)), np.nan, "Hz"),
                 Estimate("damping ratio", float(p["d"] / (2 * np.sqrt(p["k"] * p["m"]))), np.nan, "")]
        return (*found, *([Estimate("k3/k", p["k3"] / p["k"], np.nan, "a unit of y^2")] if "k3" in p else []))

    def to_json(self) -> dict[str, Any]:
        """Plain data in the shape of the contract's gap.json; numbers that are not finite become None."""
        return {
            "format": "avis-gap-axis", "version": 1, "kind": self.kind, "verdict": self.verdict,
            "effects": [{"name": effect.name, "location": effect.location,
                         "parameters": _parameters(effect.parameters), "probability": _number(effect.probability),
                         "indistinguishable_from": list(effect.indistinguishable_from)} for effect in self.effects],
            "gap": [_stage(stage) for stage in self.stages],
            "references": [_stage(stage) for stage in self.references],
            "where": [{key: _number(float(value)) if isinstance(value, (float, np.floating)) else value
                       for key, value in place.items()} for place in self.where],
            "base_parameters": _parameters(self.base_parameters),
            "ratios": _parameters(self.ratios()),
            "runners_up": [{"name": name, "probability": _number(p)} for name, p in self.runners_up],
            "sentences": list(self.sentences), "next_experiment": self.next_experiment,
            "seconds": round(self.seconds, 2)}


def _parameters(estimates: tuple[Estimate, ...]) -> dict[str, Any]:
    return {one.name: {"value": _number(one.value), "std": _number(one.std), "unit": one.unit} for one in estimates}


def _stage(stage: AxisStage) -> dict[str, Any]:
    chi2 = None if stage.chi2_per_dof is None else _number(stage.chi2_per_dof)
    return {"stage": stage.stage, "nrmse": _number(stage.nrmse), "chi2_per_dof": chi2}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
