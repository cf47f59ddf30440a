"""Which effects the data ask for: score tests, refits, evidence; one effect after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.effects.base import Effect, Seed
from avis_ctrl.gap.table_model import ActiveEffect, TableModel, active
from avis_ctrl.gap_engine.likelihood import Data, Fitted, fit
from avis_ctrl.gap_engine.score import EvidenceScore
from avis_ctrl.gap_engine.settings import SETTINGS, GapSettings
from avis_ctrl.gap_engine.tolerances import Priors


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect at a place, where its fit begins, and the fall of the sum of squares by the score test."""

    effect: ActiveEffect
    fall: float


@dataclass(frozen=True, eq=False)
class Step:
    """One more effect: the fit with it, its gain of log evidence, and the other candidates' by label."""

    fitted: Fitted
    gain: float
    others: dict[str, float]


def priors_of(effect: ActiveEffect, settings: GapSettings) -> Priors:
    """Broad normal priors of an effect's parameters: about none for its strength, about the start for its shape."""
    mean = np.array([p.none if p.linear else v for p, v in zip(effect.parameters, effect.values, strict=True)])
    sigma = np.array([settings.effect_sizes * p.size if p.linear else max(settings.shape_spread * abs(v), p.size)
                      for p, v in zip(effect.parameters, effect.values, strict=True)])
    low, high = (np.array([getattr(p, name) for p in effect.parameters]) for name in ("low", "high"))
    return Priors(effect.names, mean, sigma, np.zeros(len(mean), bool), low, high)


def candidates(fitted: Fitted, data: Data, effects: Sequence[Effect], settings: GapSettings) -> list[Candidate]:
    """Every effect at every place at its best seed, the largest fall first."""
    score, found = EvidenceScore(fitted, data, settings), []
    model: TableModel = fitted.model
    taken = {one.label for one in model.effects}
    for effect in effects:
        if effect.nonlinear and not model.motion:
            continue
        for place in effect.places(model):
            if f"{effect.name}@{place}" in taken:
                continue
            seeds: list[Seed] = effect.seeds(score, place)
            found += [Candidate(active(effect, model, place, seed.values), seed.chi2) for seed in seeds[:1]]
    return sorted(found, key=lambda one: -one.fall)


def shortlist(found: Sequence[Candidate], settings: GapSettings) -> list[Candidate]:
    """The best place of each name, as far as its fall may be worth its parameters."""
    least = 2 * (settings.certain + math.log(max(len(found), 1)))
    chosen: dict[str, Candidate] = {}
    for one in found:
        if one.fall > least:
            chosen.setdefault(one.effect.effect.name, one)
    return list(chosen.values())[:settings.refits]


def with_effect(fitted: Fitted, candidate: Candidate, data: Data, settings: GapSettings) -> Fitted | None:
    """The fit with one effect more; None where it came to no end."""
    one = candidate.effect
    model = fitted.model.with_effect(one)
    own = priors_of(one, settings)
    free = [k for k, name in enumerate(own.names) if name in model.names]
    own = Priors(tuple(own.names[k] for k in free), *(np.asarray(getattr(own, f))[free] for f in
                                                      ("mean", "sigma", "positive", "low", "high")))
    values = np.array(one.values)[free]
    try:
        return fit(model, fitted.priors.followed_by(own), np.concatenate([fitted.z, own.z(values)]), data,
                   fitted.variances, settings)
    except (AvisError, np.linalg.LinAlgError, FloatingPointError):
        return None


def search(base: Fitted, data: Data, effects: Sequence[Effect], settings: GapSettings = SETTINGS,
           progress: Callable[[str], None] = lambda text: None) -> list[Step]:
    """Effects in the order in which they are found."""
    steps: list[Step] = []
    now, quick = base, replace(settings, rounds=1, iterations=4)
    while len(steps) < settings.longest:
        found = candidates(now, data, effects, settings)
        chosen = shortlist(found, settings)
        progress("score: " + ", ".join(f"{one.effect.label} {one.fall:.4g}" for one in found[:6]))
        made = {one.effect.label: with_effect(now, one, data, quick) for one in chosen}
        gains = {label: one.log_evidence - now.log_evidence for label, one in made.items() if one is not None}
        ranked = sorted(gains.items(), key=lambda pair: -pair[1])
        progress("evidence: " + ", ".join(f"{label} {gain:+.4g}" for label, gain in ranked))
        if not gains:
            break
        best = max(gains, key=lambda label: gains[label])
        if gains[best] < settings.certain + math.log(max(len(found), 1)):
            break
        start = made[best]
        assert start is not None
        full = fit(start.model, start.priors, start.z, data, start.variances, settings)
        steps.append(Step(full, full.log_evidence - now.log_evidence, gains))
        now = full
    return steps
