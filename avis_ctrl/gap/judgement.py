"""From a search to a verdict: what is named, how sure, what cannot be told apart, and when to refuse.

An effect is named for certain when the model with it leaves noise only. When something remains, the gap may be one the
library has no name for, of which the best candidate is only the nearest neighbour. Then it is named only if it takes
most of the gap and comes out the same from data that share nothing: half of the records, half of the band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import stats

from avis_ctrl.gap.data import of_one_level
from avis_ctrl.gap.in_words import sized, spoken
from avis_ctrl.gap.next_measurement import between
from avis_ctrl.gap.refit import Refit, probabilities, try_refit
from avis_ctrl.gap.result import Considered, NamedEffect, Verdict
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.search import CLOSED, FALSE_ALARM, LEAST_FALL, MOST_OF_IT, Found, Rival, known_noise, location
from avis_ctrl.gap.signal_effects import MOST_SURE, SignalFaults, named
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.spectra import SpectralBlock

# A rival as probable as this cannot be told apart.
RIVAL = 0.05
# Without a named effect: chi-square per degree of freedom from which a residual counts as a gap although no score is
# significant: a tenth in r.m.s. above the noise, twice what its own uncertainty leaves open.
UNEXPLAINED = 1.21
# With nothing left: share that they must take at least, or what else closed the gap was the noise, better known.
EARNED = 0.5
# Halves agree within so many standard deviations (of parameters, widened by the misfit), or within this share.
AGREE_STD, AGREE_SHARE = 4.0, 0.15
LARGE_MOTION = "large_motion"
# Runners-up that are told of.
MOST_CONSIDERED = 12
# A linear effect whose strength differs from level to level by this share, and by chance less often than that, is none.
UNEQUAL_SHARE, UNEQUAL = 0.25, 1e-4


@dataclass(frozen=True, eq=False)
class Judgement:
    """Verdict, effects and model; rivals that were refitted, and sentences on how it was decided.

    like : what a gap without a name behaves most like. raised : sensors whose own noise, above ambient, is all that has
    no name; empty where something else has none.
    """

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    updated: Refit
    considered: tuple[Considered, ...]
    reasons: tuple[str, ...]
    next_experiment: str | None
    like: str = ""
    raised: tuple[str, ...] = ()


def judge(thin: Sequence[SpectralBlock], found: Found, base: Refit, updated: Refit, faults: SignalFaults,
          left_out: Sequence[str] = ()) -> Judgement:
    """Weigh what a search and the signals brought. left_out : why some of what was found is not in `updated`."""
    own = effects_of(updated.model)
    if own and not earned(base, updated, known_noise(thin)):
        own, updated = [], base
    _, faint = undetermined(updated)
    if own and faint:
        own, updated = [], base
    if updated.held_per_dof > CLOSED or found.beaten is not None:
        # What a wrong model leaves of the records is no measure of the noise in them.
        faults = replace(faults, noise=None)
    signal = named(faults)
    raised = faults.raised
    reasons = [*left_out, faint] if faint else [*left_out]
    refused_by_level = False
    if own and updated.held_per_dof > CLOSED:
        refusal = refused(thin, base, updated)
        if refusal:
            reasons.append(f"{' and '.join(one.effect.name for one in own)} comes nearest, but {refusal}: not named")
            own, updated = [], base
    elif own and (refusal := unequal_levels(thin, updated)):
        reasons.append(f"{' and '.join(one.effect.name for one in own)} comes nearest, but {refusal}: not named")
        own, updated, refused_by_level = [], base, True
    reasons += _beyond(found, updated, own)
    most = CLOSED if own or signal else UNEXPLAINED
    table_left = updated.held_per_dof > most or refused_by_level or found.beaten is not None
    residual_left = table_left or bool(raised)
    if raised and table_left:
        reasons.insert(0, f"the noise of {', '.join(raised)} is above the rig file's ambient level; the library has no "
                          "name for that")
    effects = [*_table_effects(found, updated, own, known_noise(thin)), *signal]
    if effects:
        verdict: Verdict = "partly explained" if residual_left else "explained"
    else:
        verdict = "unexplained" if residual_left else "none"
    return Judgement(verdict, tuple(effects), updated, _considered(found, updated, known_noise(thin)), tuple(reasons),
                     _next(effects, found, updated),
                     found.beaten.words if found.beaten is not None and not own else "", () if table_left else raised)


def _beyond(found: Found, updated: Refit, own: Sequence[ActiveEffect]) -> list[str]:
    """What the gap behaves like where the library has no name for it, or has one that is no more than as good."""
    if (rival := found.beaten) is not None:
        nearest = " and ".join(one.effect.name for one in effects_of(rival.against.model))
        return [f"it behaves most like {rival.words}, {_amount(rival)}; the library has no name for that, and "
                f"{nearest}, which comes nearest, leaves {rival.against.held_per_dof:.3g} times the noise's power, "
                f"this {rival.refit.held_per_dof:.3g}"]
    if own:
        return [f"{rival.words}, {_amount(rival)}, for which the library has no name, is not ruled out: probability "
                f"{1 - rival.left:.2g} beside what is named"
                for rival in _equal(found, updated)]
    return []


def _equal(found: Found, updated: Refit) -> list[Rival]:
    """Competitors that are as good as what is named."""
    return [one for one in found.rivals if one.left < 1 - RIVAL and set(one.against.labels) == set(updated.labels)]


def _amount(rival: Rival) -> str:
    """Parameters of a competitor in words."""
    last = rival.refit.model.effects[-1]
    reported = rival.refit.reported(last, max(rival.refit.fit.chi2_per_dof, 1.0))
    surest = sorted(reported.items(), key=lambda item: -abs(item[1].value) / max(item[1].std, 1e-300))
    return ", ".join(f"{spoken(name, one.unit)} {sized(one)}" for name, one in surest[:2])


def effects_of(model: TableModel) -> list[ActiveEffect]:
    """Effects beside the second-order terms that every model holds."""
    return [one for one in model.effects if one.effect.name != LARGE_MOTION]


def earned(base: Refit, updated: Refit, stretch: float = 1.0) -> bool:
    """Whether named effects take their part of the gap as the noise is known in the end.

    stretch : of differences of chi-square by the noise's own uncertainty (`known_noise`).
    """
    excess = base.held_per_dof - 1.0
    if excess < 0.1:
        return base.excess_held - updated.excess_held > LEAST_FALL * stretch
    return base.held_per_dof - updated.held_per_dof > EARNED * excess


def undetermined(updated: Refit) -> tuple[str, str]:
    """(label, why) of an effect that is not told from none: its strength is within its own uncertainty (A. Wald's test,
    with the covariance that the scatter over bands and records gives), or beyond what physics allows. Empty where all
    are told.
    """
    for one in effects_of(updated.model):
        if why := updated.forbidden(one):
            return one.label, f"{one.effect.name} comes nearest, but that is not possible ({why}): not named"
        linear = [j for j, p in enumerate(one.parameters) if p.linear]
        # In units of what the data know of each alone, so that what they do not know together falls out.
        rows = [updated.model.names.index(one.names[j]) if one.names[j] in updated.model.names else -1 for j in linear]
        known_by = updated.fit.information
        size = np.array([known_by.scale[k] / np.sqrt(max(known_by.relative[k, k], 1e-300)) if k >= 0
                         else one.parameters[j].size for k, j in zip(rows, linear, strict=True)])
        away = np.array([one.values[j] - one.parameters[j].none for j in linear]) / size
        C = updated.covariance_of(one, updated.misfit)[np.ix_(linear, linear)] / np.outer(size, size)
        known = np.linalg.matrix_rank(C, hermitian=True) if linear else 0
        if known and float(stats.chi2.sf(away @ np.linalg.pinv(C, hermitian=True) @ away, known)) > FALSE_ALARM:
            why = "these records do not tell its strength from none"
            return one.label, f"{one.effect.name} comes nearest, but {why}: not named"
    return "", ""


def refused(thin: Sequence[SpectralBlock], base: Refit, updated: Refit) -> str:
    """Why effects that leave more than noise are not to be named; empty where they are."""
    excess, left = base.held_per_dof - 1.0, updated.held_per_dof - 1.0
    share = 1 - left / excess if excess > 0 else 0.0
    if share < MOST_OF_IT:
        return f"it takes only {100 * max(share, 0):.0f} % of the gap away"
    records = ([block for k, block in enumerate(thin) if k % 2 == 0], [block for k, block in enumerate(thin) if k % 2])
    middle = float(np.median(np.concatenate([block.omega for block in thin])))
    bands = ([block.lines(np.flatnonzero(block.omega <= middle)) for block in thin],
             [block.lines(np.flatnonzero(block.omega > middle)) for block in thin])
    for halves, what in ((records, "halves of the records"), (bands, "halves of the band")):
        if all(halves) and (why := _disagree(updated, halves, what)):
            return why
    return ""


def unequal_levels(thin: Sequence[SpectralBlock], updated: Refit) -> str:
    """Why a linear effect is none: its strength is another one at another level; empty where it is the same.

    Each level's own strength is tested to first order against one for all (Rao's score), all other parameters free.
    """
    model = updated.model
    levels = {block.name: model.motion[block.name].level_V for block in thin if block.name in model.motion}
    groups = of_one_level(sorted(set(levels.values())), lambda level: ("", level))
    if len(groups) < 2 or len(levels) < len(thin):
        return ""
    score = Score(model, thin)
    misfit = max(1.0, score.chi2 / score.dof)
    for one in effects_of(model):
        strength = [j for j, p in enumerate(one.parameters) if p.linear]
        if one.effect.nonlinear or len(strength) != 1:
            continue
        row = model.names.index(one.names[strength[0]]) if one.names[strength[0]] in model.names else None
        if row is None:
            continue
        dY = [model.answer(part.block, part.body, inner=part.inner).dY[row:row + 1] for part in score.parts]
        A = np.concatenate([score.directions([d * (levels[b.name] in group) for d, b in zip(dY, thin, strict=True)])
                            for group in groups[1:]])
        took = score.reduction(A)
        of_level = np.concatenate([[0.0], took.coefficients])
        size = abs(one.values[strength[0]] - one.parameters[strength[0]].none)
        p = float(stats.chi2.sf(took.chi2 / misfit, max(took.rank, 1)))
        if p < UNEQUAL and np.ptp(of_level) > UNEQUAL_SHARE * size:
            return (f"its {one.parameters[strength[0]].name} differs by {np.ptp(of_level) / size:.0%} of its strength "
                    f"between the records' levels (by chance {p:.0e})")
    return ""


def _disagree(updated: Refit, halves: tuple[list[SpectralBlock], list[SpectralBlock]], what: str) -> str:
    fits = [try_refit(updated.model, half, half, 8) for half in halves]
    a, b = fits
    if a is None or b is None:
        return f"no fit to {what} came to an end"
    for first, second in zip(effects_of(a.model), effects_of(b.model), strict=True):
        std = [np.sqrt(np.maximum(np.diag(one.covariance_of(e)), 0) * max(one.fit.chi2_per_dof, 1.0))
               for one, e in ((a, first), (b, second))]
        for k, parameter in enumerate(first.parameters):
            x, y = first.values[k], second.values[k]
            spread = float(np.hypot(std[0][k], std[1][k]))
            size = _size(first, second, k)
            # A parameter that a half does not determine says nothing.
            if spread > 0.5 * size or parameter.optional:
                continue
            if abs(x - y) > max(AGREE_STD * spread, AGREE_SHARE * size):
                return (f"its {parameter.name} is {x:.4g} or {y:.4g} {parameter.unit} from {what}")
    return ""


def _size(first: ActiveEffect, second: ActiveEffect, k: int) -> float:
    """Size of a parameter, or of the largest of its group: from its value without the effect where that means none."""
    group = first.parameters[k].group
    rows = [j for j, one in enumerate(first.parameters) if j == k or (group and one.group == group)]
    return max(abs(e.values[j] - (e.parameters[j].none if e.parameters[j].linear else 0.0))
               for e in (first, second) for j in rows)


def _table_effects(found: Found, updated: Refit, own: list[ActiveEffect], stretch: float) -> list[NamedEffect]:
    """Effects that act on the table, with probabilities among what was refitted in their place."""
    made = []
    for one in own:
        rivals, others = _in_place_of(one.label, found, updated)
        p = probabilities(rivals, stretch) if rivals else np.ones(0)
        unnamed = min((r.left for r in _equal(found, updated)), default=1.0)
        by_name: dict[tuple[str, str], float] = {}
        for rival, share in zip(rivals, p, strict=True):
            last = next(e for e in rival.model.effects if e.label not in others)
            key = (last.effect.name, location(last.place))
            by_name[key] = by_name.get(key, 0.0) + float(share)
        key = (one.effect.name, location(one.place))
        ties = tuple(sorted({name for (name, _), share in by_name.items() if share >= RIVAL and name != key[0]}))
        made.append(NamedEffect(*key, one.effect.title, updated.reported(one, updated.misfit),
                                min(by_name.get(key, 1.0) * unnamed, MOST_SURE), ties,
                                _gain(found, one.label), one.label))
    return made


def _in_place_of(label: str, found: Found, updated: Refit) -> tuple[list[Refit], set[str]]:
    """Refits that have some effect in the place of one of the updated model's, and the labels of the others."""
    others = {other for other in updated.labels if other != label}
    return [r for stage in found.pool for r in stage if others <= set(r.labels)
            and len(r.labels) == len(updated.labels)
            and (set(r.labels) == set(updated.labels) or not r.implausible())], others


def _gain(found: Found, label: str) -> float:
    """Rise of the held-out log-likelihood by the step of the chain that brought an effect, on the compared lines."""
    for before, after in pairwise(found.chain):
        if label in after.labels and label not in before.labels:
            return (before.excess_held - after.excess_held) / 2
    return 0.0


def _considered(found: Found, updated: Refit, stretch: float) -> tuple[Considered, ...]:
    """What was refitted and not taken, the most probable first, and why. Probabilities are among all of it."""
    rows = []
    left = 1.0 if found.beaten is None else found.beaten.left
    best, who = ((found.best, "the best model") if found.beaten is None else
                 (found.beaten.refit, "what it behaves most like"))
    named, refitted = _names(updated), [one for stage in found.pool for one in stage]
    shares: dict[frozenset[tuple[str, str]], float] = {}
    for one, share in zip(refitted, probabilities(refitted, stretch) if refitted else (), strict=True):
        shares[_names(one)] = shares.get(_names(one), 0.0) + float(share)
    for rival in sorted(refitted, key=lambda one: one.criterion):
        names, own = _names(rival), effects_of(rival.model)
        if names <= named or not own:  # a step on the way to what was chosen, or a variant of it, lost to nothing
            continue
        share, shares[names] = shares[names], 0.0  # of variants the first has what they have together
        reason = rival.implausible() or (
            "it comes nearest; why it is not named stands in the result" if names == _names(found.best) else
            f"leaves {rival.held_per_dof:.3g} times the noise's power of the held-out records, {who} "
            f"{best.held_per_dof:.3g}")
        if rival.held_per_dof > found.chain[0].held_per_dof:
            reason += ": more than without it; its fit stopped short, or does not hold beyond its records"
        rows.append(Considered(" and ".join(one.effect.name for one in own),
                               " and ".join(location(one.place) for one in own), rival.held_per_dof,
                               min(share * left, MOST_SURE), reason, rival.reported(own[-1])))
    for rival in found.passed_over:
        own = effects_of(rival.model)
        if _names(rival) <= named:
            continue
        rows.append(Considered(" and ".join(one.effect.name for one in own),
                               " and ".join(location(one.place) for one in own), rival.held_per_dof, 0.0,
                               rival.implausible() or "behind others after a refit to few lines, not refitted to all",
                               rival.reported(own[-1])))
    return tuple(sorted(rows, key=lambda one: (-one.probability, one.chi2_per_dof))[:MOST_CONSIDERED])


def _names(one: Refit) -> frozenset[tuple[str, str]]:
    """Effects and places of a refit, without variants."""
    return frozenset((each.effect.name, location(each.place)) for each in effects_of(one.model))


def _next(effects: Sequence[NamedEffect], found: Found, updated: Refit) -> str | None:
    """Which measurement would tell rivals apart: of each name the best refit in the place of the other."""
    for one in effects:
        if not one.indistinguishable_from:
            continue
        rivals, others = _in_place_of(one.label, found, updated)
        models: dict[str, TableModel] = {}
        for tried in sorted(rivals, key=lambda r: r.criterion):
            models.setdefault(next(e for e in tried.model.effects if e.label not in others).effect.name, tried.model)
        other = one.indistinguishable_from[0]
        return between(one.name, other, models.get(one.name, updated.model), models[other])
    if (rival := found.beaten) is not None:
        nearest = effects_of(rival.against.model)
        if nearest:
            return between(rival.words, nearest[-1].effect.name, rival.refit.model, rival.against.model)
    return None
