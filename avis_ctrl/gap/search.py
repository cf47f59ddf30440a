"""Which effects the data call for: score tests, full refits, chains of effects, and when to stop.

A stage scores every effect at every place against the present model, refits the promising ones together with all
parameters of the rig, and keeps the few best as parents of the next stage: two effects that hide each other are found
as a pair. The shortest chain that brings the held-out residual to the noise is taken.

What the library has no name for (`effects.beyond`) is scored and refitted beside it, in places of its own, so that no
name loses its place. A competitor that explains the data decisively better than an effect takes that name away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.gap.data import thinned
from avis_ctrl.gap.each import Each, one_by_one
from avis_ctrl.gap.effects.base import Effect, EffectParameter, Seed, library
from avis_ctrl.gap.effects.beyond import beyond
from avis_ctrl.gap.refit import Reached, Refit, try_refit
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.table_model import ActiveEffect, TableModel, active
from avis_ctrl.identification.maximum_likelihood import weight_cost
from avis_ctrl.identification.spectra import SpectralBlock

Progress = Callable[[str], None]
# Held-out chi-square per degree of freedom up to which a residual counts as noise: an r.m.s. within 5 % of the noise,
# which is what the noise's own estimate of some hundred degrees of freedom and its bias near resonances leave open.
NOISE = 1.10
# With an effect named the gap counts as closed from here: an r.m.s. within 1.2 of the noise. What is then left is as
# likely the effect's own law, not quite that of the table, as a second effect: none is looked for unless that law is
# certain (`Effect.idealised`).
CLOSED = 1.44
# Chance of a significant score on clean data, over all candidates of a stage.
FALSE_ALARM = 1e-3
# Fall of the criterion that a further effect must bring: odds of e^10 against it, before the number of candidates.
LEAST_FALL = 20.0
# Refits of the first stage, and of each parent later; parents kept; effects in a chain.
REFITS, REFITS_LATER, PARENTS, LONGEST = 9, 5, 2, 2
# First on few lines and iterations; so many of a stage go on to all lines.
COARSE_LINES, COARSE_ITERATIONS, PROMOTED = 140, 8, 3
# Iterations in which the rig's parameters make room for an effect of the size that the score says.
GIVE_WAY = 4
# Iterations on more lines, of the first stage and later.
ITERATIONS = (20, 10)
# And for the best ones if they are not at their end yet.
MORE_ITERATIONS = 30
# Share of what the chain before it leaves over the noise that a second effect must take.
TAKES = 0.8
# And the share with which an effect may be given more of what it may have several of.
LARGER_PART = 0.5
# Share of the gap with which an effect counts as its cause although something is left.
MOST_OF_IT = 0.97
# One whose coarse refit leaves so many times the power that the best one leaves is not carried on.
HOPELESS = 6.0
# And where the best one closes the gap, one whose criterion is so much worse: odds of e^50.
BEHIND = 100.0
# A name is refitted, at its best place, where its score is at least this share of the best one's.
SHARE_OF_BEST = 0.02
# Another summit of an effect's score over what shapes it is tried, too, from this share of the highest on, and where
# it is that many times another frequency; or, without a summit, so many times that of the highest.
SUMMIT, APART, FAR = 0.5, 1.4, 2.0
# Competitors from beyond the library: coarse refits, and refits to more lines, in the place of each effect.
OUTSIDE_REFITS, OUTSIDE_PROMOTED = 3, 1
# One is tried where its score is at least this share of the best one's of the library.
OUTSIDE_SHARE = 0.3
# How many times as probable as one of them an effect of the library is beforehand, and the probability at which its
# name is given up.
PRIOR, GIVEN_UP = 10.0, 0.05
# Share of what the library's best leaves over the noise below which a competitor counts as the whole of the gap.
OF_THE_REST = 0.03
# The effect that stays of a pair is the same with the competitor within so many deviations, or this share.
HOLDS_STD, HOLDS = 4.0, 0.15


@dataclass(frozen=True, eq=False)
class Rival:
    """A competitor from beyond the library.

    refit : with it in the place of what `against` has. words : what it is. stretch : of differences of
    chi-square by the noise's own uncertainty (`known_noise`).
    """

    refit: Refit
    against: Refit
    words: str
    stretch: float = 1.0

    @property
    def odds(self) -> float:
        """-2 log of how many times as probable as the effects it is held against, beforehand and by the data.

        By chi-square and by the criterion, whichever is the worse for the competitor: an effect of the library must not
        lose its name to one that fits no better because it has a parameter that this table makes no use of. What the
        held-out data by themselves do not bear out counts for nothing.
        """
        new, old = self.refit, self.against
        misfit = max(1.0, min(new.held_per_dof, old.held_per_dof)) * self.stretch
        fall = min(old.criterion - new.criterion,
                   old.excess_fit + old.excess_held - new.excess_fit - new.excess_held)
        fall = fall if new.excess_held < old.excess_held else min(fall, 0.0)
        return 2 * math.log(PRIOR) - fall / misfit

    @property
    def left(self) -> float:
        """Probability of the effects that it is held against."""
        return 1 / (1 + math.exp(-min(max(self.odds, -1400.0), 1400.0) / 2))

    @property
    def wins(self) -> bool:
        """Hardly anything is left of the probability of the others.

        What a user's own effect explains to the noise is that effect's: he knows his table, and ours may only be a
        more pliable description of the same.
        """
        own = any(not one.effect.shipped for one in self.against.model.effects)
        if own and self.against.held_per_dof <= CLOSED:
            return False
        return self.left < GIVEN_UP

    @property
    def closes(self) -> bool:
        """It leaves noise, or next to nothing of what the others leave: no need to look for a pair."""
        excess = self.refit.held_per_dof - 1.0
        return self.refit.held_per_dof <= CLOSED or excess < OF_THE_REST * (self.against.held_per_dof - 1.0)


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
    reached_noise : the last one leaves noise. passed_over : refits to few lines that were too far behind to go on.
    rivals : from beyond the library. beaten : the one that took names away from the chain, if any did.
    """

    chain: tuple[Refit, ...]
    pool: tuple[tuple[Refit, ...], ...]
    reached_noise: bool
    passed_over: tuple[Refit, ...] = ()
    rivals: tuple[Rival, ...] = ()
    beaten: Rival | None = None

    @property
    def best(self) -> Refit:
        return self.chain[-1]


def location(place: str) -> str:
    """What is reported of a place: without the variant behind the slash."""
    return place.partition("/")[0]


def candidates(score: Score, effects: Sequence[Effect], each: Each = one_by_one) -> list[Candidate]:
    """Every effect at every place that the score finds something in, best first; significance over all of them."""
    model = score.model
    taken = {(one.effect.name, location(one.place)) for one in model.effects}
    # Where the model is far off, so is the noise that a score is held against.
    stretch = max(1.0, score.chi2 / score.dof) * known_noise([part.block for part in score.parts])

    def seeds(effect: Effect) -> list[tuple[str, list[Seed]]]:
        if effect.nonlinear and not model.motion:
            return []
        places = [place for place in effect.places(model) if (effect.name, location(place)) not in taken]
        return [(place, summits(effect.seeds(score, place), effect.parameters(model, place))) for place in places]
    by_effect = each(seeds, effects)
    tried = sum(len(found) for found in by_effect)
    made = [Candidate(active(effect, model, place, seed.values), seed, min(1.0, tried * seed.chance(stretch)))
            for effect, found in zip(effects, by_effect, strict=True) for place, own in found for seed in own]
    return sorted(made, key=lambda c: -c.worth)


def summits(found: Sequence[Seed], parameters: Sequence[EffectParameter]) -> list[Seed]:
    """The best of seeds that are sorted, and the next one that is a summit of its own, or far from the best on a broad
    one, if it is not far lower: to first order the wrong one of two frequencies may look better."""
    shape = [k for k, one in enumerate(parameters) if len(one.grid) > 3]
    if not shape or not found:
        return list(found[:1])
    at = np.array([[one.values[k] for k in shape] for one in found])
    high = sum(one.chi2 > SUMMIT * found[0].chi2 for one in found)
    for k in range(1, high if np.all(at > 0) else 0):
        away = np.max(np.abs(np.log(at[:k] / at[k])), axis=1)
        if np.all(away > np.log(APART)) or away[0] > np.log(FAR):
            return [found[0], found[k]]
    return [found[0]]


def known_noise(blocks: Sequence[SpectralBlock]) -> float:
    """How much more than the stated one the variance of a score is because the noise is known from some degrees of
    freedom only (`weight_cost`)."""
    return max(weight_cost(block) for block in blocks)


def shortlist(found: Sequence[Candidate], most: int) -> list[Candidate]:
    """The best ones, and the best place of every name that is not far behind."""
    significant = [one for one in found if one.p_value < FALSE_ALARM]
    if not significant:
        return []
    top = significant[0].worth
    chosen: list[Candidate] = []
    for one in significant:
        same = [c.effect.place for c in chosen if c.effect.effect.name == one.effect.effect.name]
        places = 2 if one.worth > 0.3 * top else 1
        room = len(set(same)) < places or one.effect.place in same
        if room and len(same) <= places and one.worth > SHARE_OF_BEST * top:
            chosen.append(one)
    return chosen[:most]


def search(base: Refit, fitted: Sequence[SpectralBlock], held_out: Sequence[SpectralBlock],
           progress: Progress = lambda text: None, effects: Sequence[Effect] | None = None,
           begin: tuple[Refit, ...] = (), each: Each = one_by_one, longest: int = LONGEST) -> Found:
    """The shortest chain of effects that explains the gap of a re-identified model, or the best there is.

    fitted, held_out : thinned blocks with noise. begin : a chain from base that is to be extended only.
    longest : most effects of a chain.
    """
    known = list(library().values()) if effects is None else list(effects)
    data = _Data(fitted, held_out, [thinned(block, COARSE_LINES, seed=1) for block in fitted], progress, each)
    best = begin or (base,)
    parents = [best]
    pool: list[tuple[Refit, ...]] = []
    passed_over: list[Refit] = []
    rivals: list[Rival] = []
    for depth in range(len(best), longest + 1):
        rough: list[tuple[Refit, ...]] = []
        worth = 0.0
        for chain in parents:
            scored = candidates(Score(chain[-1].model, fitted), known, each)
            worth = max([worth, *(one.worth for one in scored[:1])])
            rough += _rough(chain, shortlist(scored, REFITS if depth == 1 else REFITS_LATER), data, depth)
        made, left = _promoted(_distinct(rough), depth, data)
        before = parents
        # Where an earlier effect has grown: what else may follow it as it is now?
        while made and made[0][:-1] not in parents:
            parents = [made[0][:-1]]
            pool[-1:] = [(*(pool[-1] if pool else ()), parents[0][-1])]
            scored = candidates(Score(parents[0][-1].model, fitted), known, each)
            beside, behind = _promoted(_distinct(_rough(parents[0], shortlist(scored, REFITS_LATER), data, depth)),
                                       depth, data)
            made, left = _distinct([*made, *beside]), [*left, *behind]
        passed_over += left
        pool.append(tuple(chain[-1] for chain in made))
        plausible = [chain for chain in made if not chain[-1].implausible()]
        better = _worth_it(plausible[0], best, before, known_noise(fitted)) if plausible else None
        if better is None and (depth > 1 or not plausible):
            break
        best = better or best
        if depth == 1:
            rivals += _rivals(base, plausible[0][-1], data, OUTSIDE_SHARE * worth)
            # On a table without a gap nothing is to be taken away.
            gap = len(best) > 1 or base.held_per_dof > CLOSED
            if gap and rivals and rivals[-1].wins and rivals[-1].closes:
                return Found((base,), tuple(pool), False, tuple(passed_over), tuple(rivals), rivals[-1])
        if best[-1].held_per_dof <= CLOSED:
            break
        near = HOPELESS * plausible[0][-1].held_per_dof
        parents = [chain for chain in plausible[:PARENTS] if chain[-1].held_per_dof < near]
    found = Found(best, tuple(pool), best[-1].held_per_dof <= NOISE, tuple(passed_over), tuple(rivals))
    return _contested(found, data)


@dataclass(frozen=True, eq=False)
class _Data:
    """Blocks that are fitted, held out, and fitted on few lines."""

    fitted: Sequence[SpectralBlock]
    held_out: Sequence[SpectralBlock]
    few: Sequence[SpectralBlock]
    progress: Progress
    each: Each


def _rough(chain: tuple[Refit, ...], chosen: Sequence[Candidate], data: _Data, depth: int) -> list[tuple[Refit, ...]]:
    """Coarse refits of what a shortlist holds."""
    effects = [one.effect for one in chosen]
    if effects:
        # Variants of one law at one place are one to the reader.
        named = dict.fromkeys(_words(chain[-1], one) for one in effects)
        data.progress(f"{_ordinal(depth)} effect: {', '.join(named)}?")
    return [(*chain, found) for found in _coarse(chain[-1].model, effects, data)]


def _rivals(parent: Refit, against: Refit, data: _Data, least: float) -> list[Rival]:
    """The best competitor from beyond the library in the place of the effects that `against` has beyond `parent`."""
    scored = candidates(Score(parent.model, data.fitted), list(beyond().values()), data.each)
    effects = [one.effect for one in shortlist([one for one in scored if one.worth > least], OUTSIDE_REFITS)]
    if effects:
        data.progress(f"beyond the library: {', '.join(dict.fromkeys(one.effect.title for one in effects))}?")
    made = []
    for coarse in sorted(_coarse(parent.model, effects, data), key=lambda r: r.criterion)[:OUTSIDE_PROMOTED]:
        if coarse.held_per_dof > HOPELESS * against.held_per_dof:
            continue
        if (found := try_refit(coarse.model, data.fitted, data.held_out, ITERATIONS[0])) is not None:
            last = found.model.effects[-1]
            made.append(Rival(found, against, last.effect.said(last.place, last.by_name), known_noise(data.fitted)))
    return made


def contested(found: Found) -> Found:
    """The chain without names where one of the competitors known takes them away."""
    if len(found.chain) == 1 or found.beaten is not None:
        return found
    found = replace(found, rivals=tuple(replace(one, against=found.best) for one in found.rivals))
    for one in found.rivals:
        if one.wins:
            return replace(found, chain=found.chain[:1], reached_noise=False, beaten=one)
    return found


def _contested(found: Found, data: _Data) -> Found:
    """The chain without names that a competitor takes away, one of the pair's with new competitors in its place."""
    found = contested(found)
    chain = found.chain
    if len(chain) < 3 or chain[-1].held_per_dof > CLOSED:
        return found
    # A pair: each of its effects may stand for something else; the first has been contested if it closed the gap alone.
    first, second = (one.label for one in chain[-1].model.effects[-2:])
    for kept, dropped in ((first, second), (second, first))[:1 if chain[1].held_per_dof <= CLOSED else 2]:
        parent = (chain[1] if kept == first else
                  try_refit(chain[-1].model.without(dropped), data.fitted, data.held_out, ITERATIONS[1]))
        for one in _rivals(parent, chain[-1], data, 0.0) if parent is not None else ():
            found = replace(found, rivals=(*found.rivals, one))
            if one.wins and parent is not None:
                stays = _same(parent, one.refit, kept)
                return replace(found, chain=(chain[0], parent) if stays else chain[:1], reached_noise=False, beaten=one)
    return found


def _same(one: Refit, other: Refit, label: str) -> bool:
    """Whether an effect has the same parameters in two refits: within a seventh of its size, or their deviations."""
    a, b = (next(e for e in r.model.effects if e.label == label) for r in (one, other))
    std = np.sqrt([np.maximum(np.diag(r.covariance_of(e)), 0.0) * max(r.fit.chi2_per_dof, 1.0)
                   for r, e in ((one, a), (other, b))]).max(axis=0)
    return all(abs(x - y) <= max(HOLDS_STD * s, HOLDS * abs(x - p.none))
               for x, y, s, p in zip(a.values, b.values, std, a.parameters, strict=True) if p.linear)


def _coarse(model: TableModel, effects: Sequence[ActiveEffect], data: _Data, at: int | None = None) -> list[Refit]:
    """Refits on few lines with one more effect each, as number `at`; those that came to no end are left out.

    First the rig alone, for the seed took for granted that it gives way to the effect; then all together.
    """
    before = try_refit(model, data.few, data.held_out[:1], 0)
    least = np.inf if before is None else before.chi2_fit

    def fitted(one: ActiveEffect) -> Refit | None:
        begin = model.with_effect(one, at)
        held = try_refit(replace(begin, fixed=begin.fixed | set(one.names)), data.few, data.held_out[:1], GIVE_WAY)
        begin = begin if held is None else replace(held.model, fixed=begin.fixed)
        return try_refit(begin, data.few, data.held_out, COARSE_ITERATIONS)

    def reached(one: ActiveEffect) -> Reached | None:
        found = fitted(one)
        faint = weaker(one)
        if (found is None or found.chi2_fit > least) and faint.values != one.values:  # worse than without it
            second = fitted(faint)
            found = min((r for r in (found, second) if r is not None), key=lambda r: r.chi2_fit, default=None)
        return Reached.by(found)
    made = zip(effects, data.each(reached, effects), strict=True)
    return [found.refit(model.with_effect(one, at)) for one, found in made if found is not None]


def weaker(one: ActiveEffect) -> ActiveEffect:
    """The same at a tenth of its strength, where it has parameters that tell this."""
    return one.at([p.none + 0.1 * (value - p.none) if p.linear else value
                   for p, value in zip(one.parameters, one.values, strict=True)])


def _promoted(rough: list[tuple[Refit, ...]], depth: int, data: _Data) -> tuple[list[tuple[Refit, ...]], list[Refit]]:
    """The best of the coarse refits, refitted to more lines, best first; and those that were not."""
    chosen = [chain for chain in rough[:PROMOTED] if not _hopeless(chain, rough[0][-1])]
    left = [chain[-1] for chain in rough if chain not in chosen]
    for chain in chosen:
        data.progress(f"refit with {_words(chain[-2], chain[-1].model.effects[-1])}")

    def reached(chain: tuple[Refit, ...]) -> Reached | None:
        iterations = ITERATIONS[min(depth, 2) - 1]
        return Reached.by(try_refit(chain[-1].model, data.fitted, data.held_out, iterations))
    made = [(*chain[:-1], found.refit(chain[-1].model))
            for chain, found in zip(chosen, data.each(reached, chosen), strict=True) if found is not None]
    best, *others = _distinct(made) or [()]
    if not best:
        return [], left
    before = _grown(_to_the_end(best, data.fitted, data.held_out), data)
    best = _sought_again(before, data)
    # What else may be its last effect, beside the others as they are now.
    others = others if best is before else [_beside(best, one, data) for one in others]
    return _distinct([best, *others]), left


def _hopeless(chain: tuple[Refit, ...], first: Refit) -> bool:
    """Whether a coarse refit is too far behind the best one."""
    one = chain[-1]
    far = one.held_per_dof > HOPELESS * first.held_per_dof
    behind = first.held_per_dof <= CLOSED and one.criterion > first.criterion + BEHIND
    little = len(chain) > 2 and not definite(chain[-2]) and _share(one, chain[-2]) < TAKES / 2
    return far or behind or little


def _to_the_end(chain: tuple[Refit, ...], fitted: Sequence[SpectralBlock], held_out: Sequence[SpectralBlock]
                ) -> tuple[Refit, ...]:
    """A chain of which the last fit goes on where it had not come to its end and leaves more than noise: nothing is to
    be added to a model that is not yet fitted."""
    last = chain[-1]
    if last.fit.converged or last.held_per_dof <= CLOSED:
        return chain
    return (*chain[:-1], try_refit(last.model, fitted, held_out, MORE_ITERATIONS) or last)


def _grown(chain: tuple[Refit, ...], data: _Data) -> tuple[Refit, ...]:
    """A chain with as much more of its effects (further modes) as takes the larger part of what the chain leaves, each
    by more than chance; as it was where none does. The shorter chains are refitted with that effect as it is then."""
    last = found = chain[-1]
    while len(chain) > 1 and found.held_per_dof > CLOSED:
        more = [_with_more(found, k, data) for k in range(len(found.model.effects))]
        likely = [one for one in more if one is not None and not one.implausible()]
        best = min(likely, key=lambda r: r.criterion, default=found)
        if not _gains(best, found, known_noise(data.fitted)):
            break
        found = best
    if found is last or _share(found, last) <= LARGER_PART:
        return chain
    return _ending_in(found, chain, data)


def _with_more(found: Refit, k: int, data: _Data) -> Refit | None:
    """A refit with more of the effect number k, if there is more of it."""
    one = found.model.effects[k]
    larger = one.effect.grown(one, found.model, data.fitted)
    if not larger:
        return None
    data.progress(f"more of it: {one.effect.name} ({larger[0].place.replace('/', ', ')})?")
    return _best_of(found.model.without(one.label), larger, data, k)


def _best_of(model: TableModel, effects: Sequence[ActiveEffect], data: _Data, at: int) -> Refit | None:
    """The best of a model's refits with one of the effects as number `at`."""
    coarse = min(_coarse(model, effects, data, at), key=lambda r: r.criterion, default=None)
    return coarse and try_refit(coarse.model, data.fitted, data.held_out, MORE_ITERATIONS)


def _ending_in(found: Refit, chain: tuple[Refit, ...], data: _Data) -> tuple[Refit, ...]:
    """A chain with another end, its shorter parts with the effects as they are there; as it was where one of these
    comes to no end."""
    made = [found]
    for one in chain[:-1]:
        if (shorter := _alike(one, found, data)) is None:
            return chain
        made.insert(-1, shorter)
    return tuple(made)


def _alike(one: Refit, found: Refit, data: _Data) -> Refit | None:
    """A refit with the same effects as another one's first; None where it comes to no end."""
    first = found.model.effects[:len(one.model.effects)]
    if [effect.label for effect in first] == [effect.label for effect in one.model.effects]:
        return one
    return try_refit(replace(one.model, effects=first, fixed=found.model.fixed), data.fitted, data.held_out,
                     MORE_ITERATIONS)


def _sought_again(chain: tuple[Refit, ...], data: _Data) -> tuple[Refit, ...]:
    """A chain of which the effect before the last is sought anew beside the last one, where that takes most of what it
    left and still leaves more than noise: by itself it had stood for the other one, too, and ended elsewhere."""
    found = chain[-1]
    if len(chain) < 3 or found.held_per_dof <= CLOSED or _share(found, chain[-2]) <= TAKES:
        return chain
    k = len(found.model.effects) - 2
    one = found.model.effects[k]
    data.progress(f"{one.effect.name} ({location(one.place)}) beside {found.model.effects[-1].effect.name}?")
    without = try_refit(found.model.without(one.label), data.fitted, data.held_out, ITERATIONS[1])
    if without is None:
        return chain
    again = [other.effect for other in candidates(Score(without.model, data.fitted), [one.effect], data.each)
             if location(other.effect.place) == location(one.place)]
    other = _best_of(without.model, again[:REFITS_LATER], data, k)
    if other is None or other.implausible() or not _gains(other, found, known_noise(data.fitted)):
        return chain
    return _ending_in(other, chain, data)


def _beside(best: tuple[Refit, ...], chain: tuple[Refit, ...], data: _Data) -> tuple[Refit, ...]:
    """A chain that differs from the best one in its last effect, refitted from where that one has all the others."""
    *same, _ = best[-1].model.effects
    *before, last = chain[-1].model.effects
    if [one.label for one in before] != [one.label for one in same]:
        return chain
    model = best[-1].model
    begin = replace(model, effects=tuple(same), fixed=chain[-1].model.fixed).with_effect(last)
    found = try_refit(begin, data.fitted, data.held_out, MORE_ITERATIONS)
    return (*best[:-1], found) if found is not None and found.criterion < chain[-1].criterion else chain


def _worth_it(longer: tuple[Refit, ...], best: tuple[Refit, ...], parents: Sequence[tuple[Refit, ...]], stretch: float
              ) -> tuple[Refit, ...] | None:
    """A stage's chain if it is worth its length, or, where an earlier effect has grown in it, its shorter part if that
    alone brings it: what a further mode takes is no sign of the effect that follows it."""
    shorter = longer[:-1]
    if shorter in parents or _better(longer, shorter, stretch):
        return longer if _better(longer, best, stretch) else None
    return shorter if _gains(shorter[-1], best[-1], stretch) and _share(shorter[-1], best[-1]) > LARGER_PART else None


def _share(found: Refit, before: Refit) -> float:
    """Share of the excess over the noise that a further effect takes, on held-out data."""
    excess = before.held_per_dof - 1.0
    return (before.held_per_dof - found.held_per_dof) / excess if excess > 0 else 0.0


def definite(closed: Refit) -> bool:
    """Whether what effects leave of a gap that they close can be a faint second one: none of them is idealised."""
    return closed.held_per_dof <= CLOSED and not any(one.effect.idealised for one in closed.model.effects)


def _better(longer: tuple[Refit, ...], chain: tuple[Refit, ...], stretch: float) -> bool:
    """Whether a longer chain is worth its length: on the criterion, on the held-out data by themselves, and, of a
    second effect on, because it takes most of what the chain before it leaves.

    The last keeps out what only mends the first effect's law where that is not quite the table's; beside an effect of
    which the law is certain a faint second one may be small.
    """
    found, best = longer[-1], chain[-1]
    if not _gains(found, best, stretch):
        return False
    return len(chain) == 1 or definite(best) or (_share(found, best) > TAKES and not _mends(longer, chain))


def _gains(found: Refit, before: Refit, stretch: float) -> bool:
    """Whether a refit is better on the criterion, and on the held-out data by themselves, by more than chance."""
    misfit = max(1.0, found.held_per_dof) * stretch
    fall, held = before.criterion - found.criterion, before.excess_held - found.excess_held
    return fall / misfit > LEAST_FALL and held / misfit > LEAST_FALL / 2


def _mends(longer: tuple[Refit, ...], chain: tuple[Refit, ...]) -> bool:
    """Whether a further effect only mends the law of an idealised one: they are known to look alike, and the first
    takes all but a few per cent of the gap by itself."""
    new = longer[-1].model.effects[-1].effect
    alike = any(one.effect.idealised and (new.name in one.effect.confusable or one.effect.name in new.confusable)
                for one in chain[-1].model.effects)
    return alike and _share(chain[-1], chain[0]) > MOST_OF_IT


def _ordinal(depth: int) -> str:
    return ("first", "second", "third", "fourth")[depth - 1]


def _distinct(chains: list[tuple[Refit, ...]]) -> list[tuple[Refit, ...]]:
    """Best first; of the same effects in another order only one."""
    kept: dict[frozenset[str], tuple[Refit, ...]] = {}
    for chain in sorted(chains, key=lambda c: c[-1].criterion):
        kept.setdefault(frozenset(chain[-1].labels), chain)
    return list(kept.values())


def _words(parent: Refit, effect: ActiveEffect) -> str:
    before = [one.effect.name for one in parent.model.effects if one.effect.name != "large_motion"]
    names = [*before, f"{effect.effect.name} ({location(effect.place)})"]
    return " and ".join(names)
