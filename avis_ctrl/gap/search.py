"""Which effects the data call for: score tests, full refits, chains of effects, and when to stop.

A stage scores every effect at every place against the present model, refits the promising ones together with all
parameters of the rig, and keeps the few best as parents of the next stage: two effects that hide each other are found
as a pair. The shortest chain that brings the held-out residual to the noise is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from avis_ctrl.gap.effects.base import Effect, Seed, library
from avis_ctrl.gap.data import thinned
from avis_ctrl.gap.refit import Refit, probabilities, try_refit
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.table_model import ActiveEffect, active
from avis_ctrl.identification.spectra import SpectralBlock

Progress = Callable[[str], None]
# Held-out chi-square per degree of freedom up to which a residual counts as noise: an r.m.s. within 5 % of the noise,
# which is what the noise's own estimate of some hundred degrees of freedom and its bias near resonances leave open.
NOISE = 1.10
# Chance of a significant score on clean data, over all candidates of a stage.
FALSE_ALARM = 1e-3
# Fall of the criterion that a further effect must bring: odds of e^10 against it, before the number of candidates.
LEAST_FALL = 20.0
# Refits of the first stage, and of each parent later; parents kept; effects in a chain.
REFITS, REFITS_LATER, PARENTS, LONGEST = 10, 5, 2, 3
# First on few lines and iterations; so many of a stage go on to all lines.
COARSE_LINES, COARSE_ITERATIONS, PROMOTED = 140, 8, 3
# A name is refitted, at its best place, where its score is at least this share of the best one's.
SHARE_OF_BEST = 0.02


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect at a place, where a refit may begin, and the score's significance over all candidates."""

    effect: ActiveEffect
    seed: Seed
    p_value: float

    @property
    def worth(self) -> float:
        return self.seed.chi2


@dataclass(frozen=True, eq=False)
class Found:
    """The end of a search.

    chain : refits from the re-identified model to the last accepted one. pool : every refit, by stage.
    reached_noise : the last one leaves noise. significant : whether any score was, at the first stage.
    scores : of the first stage.
    """

    chain: tuple[Refit, ...]
    pool: tuple[tuple[Refit, ...], ...]
    reached_noise: bool
    scores: tuple[Candidate, ...] = field(default=())

    @property
    def best(self) -> Refit:
        return self.chain[-1]


def location(place: str) -> str:
    """What is reported of a place: without the variant behind the slash."""
    return place.partition("/")[0]


def candidates(score: Score, effects: Sequence[Effect]) -> list[Candidate]:
    """Every effect at every place that the score finds something in, best first; significance over all of them."""
    model, found = score.model, []
    taken = {(one.effect.name, location(one.place)) for one in model.effects}
    tried = 0
    misfit = max(1.0, score.chi2 / score.dof)
    for effect in effects:
        if effect.nonlinear and not model.motion:
            continue
        for place in effect.places(model):
            if (effect.name, location(place)) in taken:
                continue
            tried += 1
            seeds = effect.seeds(score, place)
            found += [(active(effect, model, place, seed.values), seed) for seed in seeds[:1]]
    # Where the model is far off, so is the noise that a score is held against.
    return sorted((Candidate(one, seed, min(1.0, tried * float(stats.chi2.sf(seed.chi2 / misfit, seed.directions))))
                   for one, seed in found), key=lambda c: -c.worth)


def shortlist(found: Sequence[Candidate], most: int) -> list[Candidate]:
    """The best ones, and the best place of every name that is not far behind."""
    significant = [one for one in found if one.p_value < FALSE_ALARM]
    if not significant:
        return []
    top = significant[0].worth
    chosen: list[Candidate] = []
    for one in significant:
        same = [c for c in chosen if c.effect.effect.name == one.effect.effect.name]
        places = 2 if one.worth > 0.3 * top else 1
        if len(same) < places and one.worth > SHARE_OF_BEST * top:
            chosen.append(one)
    return chosen[:most]


def search(base: Refit, fitted: Sequence[SpectralBlock], held_out: Sequence[SpectralBlock],
           progress: Progress = lambda text: None, effects: Sequence[Effect] | None = None) -> Found:
    """The shortest chain of effects that explains the gap of a re-identified model, or the best there is.

    fitted, held_out : thinned blocks with noise.
    """
    known = list(library().values()) if effects is None else list(effects)
    pool: list[tuple[Refit, ...]] = []
    parents: list[tuple[Refit, ...]] = [(base,)]
    best: tuple[Refit, ...] = (base,)
    first: tuple[Candidate, ...] = ()
    few = [thinned(block, COARSE_LINES, seed=1) for block in fitted]
    for depth in range(1, LONGEST + 1):
        rough: list[tuple[Refit, ...]] = []
        for chain in parents:
            scored = candidates(Score(chain[-1].model, fitted), known)
            first = first or tuple(scored)
            for one in shortlist(scored, REFITS if depth == 1 else REFITS_LATER):
                progress(f"stage {depth}: {_words(chain[-1], one.effect)}")
                found = try_refit(chain[-1].model.with_effect(one.effect), few, held_out, COARSE_ITERATIONS)
                if found is not None:
                    rough.append((*chain, found))
        made: list[tuple[Refit, ...]] = []
        for chain in _distinct(rough)[:PROMOTED]:
            progress(f"stage {depth}: refit of {' and '.join(chain[-1].labels)}")
            if (found := try_refit(chain[-1].model, fitted, held_out)) is not None:
                made.append((*chain[:-1], found))
        made = _distinct(made)
        pool.append(tuple(chain[-1] for chain in made))
        plausible = [chain for chain in made if not chain[-1].implausible()]
        if not plausible:
            break
        top = plausible[0]
        if _better(top[-1], best[-1], depth):
            best = top
        if best[-1].held_per_dof <= NOISE and depth > len(best) - 1:
            break
        parents = plausible[:PARENTS]
        if best[-1].held_per_dof <= NOISE:
            parents = [best]
    return Found(best, tuple(pool), best[-1].held_per_dof <= NOISE, first)


def _better(found: Refit, best: Refit, depth: int) -> bool:
    """Whether a longer chain is worth its length: on the criterion, and on the held-out data by themselves."""
    misfit = max(1.0, found.held_per_dof)
    fall, held = best.criterion - found.criterion, best.chi2_held - found.chi2_held
    return fall / misfit > LEAST_FALL and held / misfit > LEAST_FALL / 2


def _distinct(chains: list[tuple[Refit, ...]]) -> list[tuple[Refit, ...]]:
    """Best first; of the same effects in another order only one."""
    kept: dict[frozenset[str], tuple[Refit, ...]] = {}
    for chain in sorted(chains, key=lambda c: c[-1].criterion):
        kept.setdefault(frozenset(chain[-1].labels), chain)
    return list(kept.values())


def _words(parent: Refit, effect: ActiveEffect) -> str:
    names = [*(one.effect.name for one in parent.model.effects), f"{effect.effect.name} ({location(effect.place)})"]
    return " and ".join(names)


def alternatives(found: Found) -> list[tuple[Refit, float]]:
    """Refits that differ from the chosen chain's end in its last effect, and the chosen one, with probabilities."""
    depth = len(found.chain) - 1
    if depth == 0:
        return []
    before = set(found.chain[-2].labels)
    rivals = [one for one in found.pool[depth - 1] if before <= set(one.labels) and not one.implausible()]
    if found.best not in rivals:
        rivals.append(found.best)
    return sorted(zip(rivals, probabilities(rivals).tolist(), strict=True), key=lambda pair: -pair[1])
