"""Forward selection of effects by score tests, fits and model evidence.

    evidence of a model = p(records | model), parameters and path errors integrated out (`likelihood`)

Each step fits the effects with the largest score statistics. Each of them is added to the current model and fitted
together with all parameters of the rig and all tolerances. The effect with the largest evidence is accepted if the gain
in evidence exceeds what the number of candidates explains. Uncertain effects are compared with their rivals again,
given the effects found later. If a rival replaces one, later effects that no longer raise the evidence are removed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.effects.base import Effect, shares
from avis_ctrl.gap.effects.flexible_mode import resonance
from avis_ctrl.gap.probability import Step, name_of, prior_odds, probability_of
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.run import Run
from avis_ctrl.gap.score import EvidenceScore
from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.gap.starting_values import HasExtendedModels, seeds
from avis_ctrl.gap.table_model import ActiveEffect, TableModel, active
from avis_ctrl.gap.tolerances import of_effect, of_values, rescaled, spread, tolerances_behind, within_tolerance
from avis_ctrl.identification.likelihood import Data, Fitted, Profile, fit, refit, without_path_errors
from avis_ctrl.identification.priors import Priors, tolerances_of


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect at a place with starting values, and the reduction of the sum of squares by the score test.

    p_value : of as large a reduction by noise alone, over all frequencies and other values that were tried there.
    others : further starting values, the most promising first.
    """

    effect: ActiveEffect
    reduction: float
    p_value: float
    others: tuple[ActiveEffect, ...] = ()


def candidates(fitted: Fitted, data: Data, effects: Sequence[Effect], run: Run) -> list[Candidate]:
    """Every effect at every place with its best seed, the largest reduction first.

    Effects that add resonances with many parameters take long to initialise. They are searched only if one resonance
    with an arbitrary shape on every path gives a sufficient reduction.
    """
    score = EvidenceScore(fitted, data, run.settings)
    model, taken = score.model, {name_of(label) for label in fitted.labels}

    def scored(effect: Effect) -> list[Candidate]:
        if effect.nonlinear and not model.motion:
            return []
        found = []
        places = [one for one in effect.places(model) if (effect.name, one.partition("/")[0]) not in taken]
        for place, best in zip(places, seeds(effect, score, places), strict=True):
            starts = [
                active(effect, model, place, values)
                for values in dict.fromkeys(one.values for one in best[: run.settings.starts])
            ]
            found += [Candidate(starts[0], best[0].chi2, best[0].p_value, tuple(starts[1:]))] if best else []
        return found

    resonant = [one for one in effects if one.resonant]
    found = [one for own in run.each(scored, [one for one in effects if not one.resonant]) for one in own]
    most = max((one.reduction for one in found), default=0.0)
    if not found or resonance(score) >= run.settings.resonance_share * most:
        found += [one for own in run.each(scored, resonant) for one in own]
    return sorted(found, key=lambda one: -one.reduction)


def shortlist(found: Sequence[Candidate], settings: GapSettings) -> list[Candidate]:
    """Each effect at its best place, if the reduction is significant given the number of candidates."""
    chosen: dict[str, Candidate] = {}
    for one in found:
        if one.p_value * len(found) < math.exp(-settings.certain):
            chosen.setdefault(one.effect.effect.name, one)
    return list(chosen.values())[: settings.refits]


def nearly_best(fits: Mapping[str, Fitted], best: str, before: Fitted, settings: GapSettings) -> list[str]:
    """Labels of the fits that raise the log evidence nearly as much as that of the label `best`, which is among them
    even if its parameters cost more than they gain."""
    most = fits[best].log_evidence
    least = min(before.log_evidence + settings.near_best * (most - before.log_evidence), most)
    return [label for label, one in fits.items() if one.log_evidence >= least]


def other_laws(found: Sequence[Candidate], best: Collection[str], fitted: Collection[str]) -> list[Candidate]:
    """The same effects at the same places with their other laws, except those already fitted; `best` and `fitted` are
    labels."""
    names = {name_of(label) for label in best}
    return [one for one in found if name_of(one.effect.label) in names and one.effect.label not in fitted]


def extensions(fits: Sequence[Fitted], data: Data, settings: GapSettings) -> list[Candidate]:
    """Richer laws of the effects that were fitted last, each starting from the fit of a simpler law. An effect with
    many local minima starts again from other values."""
    found = []
    for one in fits:
        law = one.model.effects[-1].effect
        if isinstance(law, HasExtendedModels):
            whole = without_path_errors(one, data, settings)
            last = whole.model.effects[-1]
            found += [
                Candidate(active(last.effect, one.model, place, values), 0.0, 0.0)
                for place, values in law.extended_models(EvidenceScore(whole, data, settings), last)
            ]
    return found


def _priors_of(one: ActiveEffect, model: TableModel, settings: GapSettings) -> Priors:
    """Priors of an effect's parameters, with those that it specifies itself (`Effect.priors`)."""
    priors, known = of_effect(one, tolerances_of(model.rig), settings), model.priors
    mean, sigma = priors.mean.copy(), priors.sigma.copy()
    for row, name in enumerate(priors.names):
        mean[row], sigma[row] = known.get(name, (mean[row], sigma[row]))
    return replace(priors, mean=mean, sigma=sigma)


def with_effect(fitted: Fitted, one: ActiveEffect, data: Data, settings: GapSettings) -> Fitted | None:
    """The fit with one more effect; None if it fails."""
    model = fitted.model.with_effect(one)
    own = _priors_of(one, model, settings)
    z = np.concatenate([_without_tolerances_behind(fitted, one), own.z(np.array(one.values))])
    return fit_or_none(fitted, model, rescaled(fitted.priors, one, settings.held).followed_by(own), z, data, settings)


def _without_tolerances_behind(fitted: Fitted, one: ActiveEffect) -> np.ndarray:
    """Standardised parameters from which the fit with an added effect starts: tolerances that compensated for the
    effect are reset to zero."""
    z = fitted.z.copy()
    z[tolerances_behind(one, fitted.priors.names)] = 0
    return z


def without_effect(fitted: Fitted, label: str, data: Data, settings: GapSettings) -> Fitted | None:
    """The fit without one of the effects; None if it fails."""
    model = fitted.model.without(label)
    one = fitted.model.effect(label)
    rows = [fitted.priors.names.index(name) for name in model.names]
    priors = rescaled(fitted.priors, one, 1 / settings.held).of(model.names)
    return fit_or_none(fitted, model, priors, fitted.z[rows], data, settings)


def with_undetected(fitted: Fitted, effects: Sequence[Effect], data: Data, settings: GapSettings) -> Fitted:
    """The fit with each effect that a table may have unnoticed (`Effect.always_possible`) added at zero strength.

    Nothing is fitted again; the standard deviations of effects with a similar response become larger. A structural loss
    of the mounts, for example, resembles a leveling loop and a relaxation.
    """
    for effect in effects:
        if effect.always_possible and effect.name not in {name_of(label)[0] for label in fitted.labels}:
            for place in effect.places(fitted.model)[:1]:
                none = [one.none for one in effect.parameters(fitted.model, place)]
                one = active(effect, fitted.model, place, none)
                fitted = with_effect(fitted, one, data, replace(settings, rounds=0, iterations=0)) or fitted
    return fitted


def fit_or_none(
    fitted: Fitted, model: Any, priors: Priors, z: np.ndarray, data: Data, settings: GapSettings
) -> Fitted | None:
    """The fit of a model from z, with the variances of another fit to start with; None if it fails."""
    try:
        return fit(model, priors, z, data, fitted.variances, settings)
    except (AvisError, np.linalg.LinAlgError, FloatingPointError):
        return None


def search(base: Fitted, data: Data, effects: Sequence[Effect], run: Run) -> list[Step]:
    """Search for effects; the steps in the order of finding. Values of the rig file beyond their tolerance are searched
    again at the end: such a value appears mainly as shifts of the other values, hardly in the residual.

    base : the initial fit, which may already contain effects. The last step has the fit with all effects found.
    """
    steps: list[Step] = []
    settings, progress = run.settings, run.progress

    def more(effects: Sequence[Effect]) -> None:
        while True:
            now = steps[-1].fitted if steps else base
            progress(f"search for effect {len(now.labels) + 1}")
            step = next_effect(now, data, searched(now, effects, settings), run)
            if step is None:
                return
            if steps:  # only the last fit needs residual and Jacobian
                steps[-1] = replace(steps[-1], fitted=steps[-1].fitted.bare())
            steps.append(step)
            progress(f"  best model: {', '.join(step.fitted.labels)}")

    more(effects)
    for _ in range(settings.revisions):
        progress("comparison of each effect with its rivals, given the effects found later")
        if not _revised(steps, data, settings):
            break
        more(effects)
    values = of_values(effects, base.model)
    if steps and len(values) < len(effects):  # otherwise they have just been searched
        more(values)
    return steps


def searched(now: Fitted, effects: Sequence[Effect], settings: GapSettings) -> list[Effect]:
    """Effects that may be added to a fit: at most `longest` values beyond their tolerance, and as many others."""
    values = of_values(effects, now.model)
    names = {one.name for one in values}
    found = sum(one.effect.name in names for one in map(now.model.effect, now.labels))
    full = (found >= settings.longest, len(now.labels) - found >= settings.longest)  # values, others
    return [one for one in effects if not full[one.name not in names]]


def outliers(now: Fitted, data: Data, effects: Sequence[Effect], run: Run) -> tuple[list[Step], Fitted]:
    """Values of the rig file beyond their tolerance that stand out because the other values moved by much less than
    their tolerances; and the last fit, with the tolerances as stated.

    The priors are as narrow as the spread of the values, both without and with each effect.
    """
    settings = run.settings
    rows, size = spread(now, settings)
    if size > settings.narrow:
        return [], now
    run.progress(f"search for values that stand out from the others, which moved by {size:.2f} tolerances")
    steps: list[Step] = []
    narrow, beyond = _with_spread(now, rows, size, data, settings), of_values(effects, now.model)
    while step := next_effect(narrow, data, searched(narrow, beyond, settings), run):
        steps.append(step)
        narrow = step.fitted
    return steps, _with_spread(narrow, rows, 1 / size, data, settings) if steps else now


def _with_spread(fitted: Fitted, rows: Sequence[int], size: float, data: Data, settings: GapSettings) -> Fitted:
    """The fit with the standard deviations of some priors multiplied by a factor."""
    priors = fitted.priors.scaled(rows, size)
    return fit(fitted.model, priors, priors.z(fitted.priors.values(fitted.z)), data, fitted.variances, settings)


def _revised(steps: list[Step], data: Data, settings: GapSettings) -> bool:
    """Compare uncertain effects with their rivals again, given the effects found later: before these, several effects
    could explain the same data. If one is replaced, effects that become unnecessary are removed. Returns whether one
    was replaced."""
    for k, step in enumerate(steps[:-1]):
        if probability_of(step, settings)[0] > settings.sure:
            continue
        best = steps[-1].fitted
        again = _again(step, best, data, settings)
        label = _likeliest(again.tried, settings)
        if again.tried[label].log_evidence - best.log_evidence < settings.certain:
            steps[k] = again
            continue
        one = again.tried[label]
        full = refit(one, data, settings)
        steps[k] = replace(again, fitted=full.bare(), label=label)
        steps[k + 1 :], best = backward_elimination(steps[k + 1 :], full, data, settings)
        steps[-1] = replace(steps[-1], fitted=best)
        return True
    return False


def backward_elimination(
    steps: Sequence[Step], best: Fitted, data: Data, settings: GapSettings
) -> tuple[list[Step], Fitted]:
    """Remove, one by one, effects whose removal lowers the evidence by less than a name requires. Returns the remaining
    steps and the fit."""
    kept = []
    for step in steps:
        rest = without_effect(best, step.label, data, settings)
        if rest is not None and best.log_evidence - rest.log_evidence < settings.certain:
            best = rest
        else:
            kept.append(step)
    return kept, best


def is_weak(best: Fitted, label: str, settings: GapSettings) -> bool:
    """Whether an effect's strength is hardly distinguishable from zero: by Wald's test it raises the log-likelihood by
    less than twice the gain required for a name."""
    one = best.model.effect(label)
    values = dict(zip(one.names, one.values, strict=True))
    names = [name for name in one.absent if name in best.priors.names]
    if not names:
        return False
    away = np.array([values[name] - one.absent[name] for name in names])
    return float(away @ np.linalg.solve(best.covariance_of(names), away)) / 2 < 2 * settings.certain


def _again(step: Step, best: Fitted, data: Data, settings: GapSettings) -> Step:
    """Repeat the choice of a step, given the effects found later. A rival that was behind by more than the total gain
    of all later effects is not fitted again: it could not catch up."""
    rest = without_effect(best, step.label, data, settings)
    if rest is None:
        return step
    begun = without_path_errors(rest, data, settings)
    known = {name_of(label) for label in best.labels}
    tried, mine = {step.label: best.bare()}, step.tried[step.label].log_evidence
    later = max(best.log_evidence - step.fitted.log_evidence, 0.0) + settings.certain
    for label, fitted in step.tried.items():
        if name_of(label) in known or mine - fitted.log_evidence > later:
            continue
        one = with_effect(begun, fitted.model.effects[-1], data, settings)
        if one is not None:
            tried[label] = one.bare()
    return Step(rest.bare(), best.bare(), tried, step.candidates, step.label)


def next_effect(now: Fitted, data: Data, effects: Sequence[Effect], run: Run) -> Step | None:
    """The effect with the largest evidence; None if no effect improves the current model enough."""
    if not effects:
        return None
    tried, count = _compared(without_path_errors(now, data, run.settings), now, data, effects, run)
    return _with_best(now, tried, count, data, run.settings) if tried else None


def next_effect_from(
    start: Fitted, base: Fitted, now: Fitted, data: Data, effects: Sequence[Effect], run: Run
) -> Step | None:
    """As `next_effect`, where the fit `now` has moved the values of the rig file too far. Effects are searched beside a
    fit `base` with fixed tolerances; the fits of all parameters start from `start`, with the rig file's values.
    """
    begun = without_path_errors(base, data, run.settings)
    found, count = _compared(begun, begun, data, effects, run)
    start = replace(start, variances=begun.variances)
    tried = _likelier(_joint_fits(start, [one.model.effects[-1] for one in found.values()], data, run))
    return _with_best(now, tried, count, data, run.settings) if tried else None


def _with_best(now: Fitted, tried: dict[str, Fitted], count: int, data: Data, settings: GapSettings) -> Step:
    """The step with the effect of the largest evidence. The candidates near the best are fitted to the end."""
    best = _likeliest(tried, settings)
    least = tried[best].log_evidence - settings.near_tie
    ended = {label: refit(one, data, settings) for label, one in tried.items() if one.log_evidence >= least}
    best = _likeliest(ended, settings)
    return Step(now.bare(), ended[best], tried | {label: one.bare() for label, one in ended.items()}, count)


def _compared(
    begun: Fitted, now: Fitted, data: Data, effects: Sequence[Effect], run: Run
) -> tuple[dict[str, Fitted], int]:
    """Fits of the best candidates by label, and the number of candidates; no fits if none improves the fit `now`
    enough. begun : the same fit with minimum path errors, from which they start."""
    settings = run.settings
    found = candidates(begun, data, effects, run)
    short = shortlist(found, settings)
    run.progress(f"  {len(found)} candidates ranked by the score test, the best {len(short)} are fitted")
    tried: dict[str, Fitted] = {}
    asked: set[str] = set()
    best, further = "", short
    while further:
        asked |= {one.effect.label for one in further}
        before = tried
        more, impossible = _tried(begun, further, data, run)
        tried = _likelier([*before.values(), *more.values()])
        best = _likeliest(tried, settings) if tried else ""
        better = [
            one
            for label, one in more.items()
            if label not in before
            or (label == best and one.log_evidence - before[label].log_evidence > settings.certain)
        ]
        if not (better or impossible):
            break
        # Values that physics forbids in one law may be possible in another.
        near = [*impossible, *(nearly_best(tried, best, now, settings) if tried else [])]
        further = [*extensions(better, data, settings), *other_laws(found, near, asked)]
        if further:
            run.progress(f"  {len(further)} more forms of the best candidates are fitted")
    if not tried:
        return {}, len(found)
    rise = tried[best].log_evidence - now.log_evidence
    return (tried if rise >= settings.certain + math.log(max(len(found), len(tried))) else {}), len(found)


@dataclass(frozen=True, eq=False)
class _Begun:
    """An effect after a fit of its own parameters alone: gain of log evidence, and reduction of the sum of squares."""

    effect: ActiveEffect
    gain: float
    reduction: float


def _tried(now: Fitted, chosen: Sequence[Candidate], data: Data, run: Run) -> tuple[dict[str, Fitted], set[str]]:
    """Fits of candidates by label, and labels of those whose fit failed or has impossible values. First the parameters
    of each effect alone are fitted, the others following to first order; then, for candidates that are not far behind,
    all parameters."""
    if not chosen:
        return {}, set()
    settings = run.settings
    profile = Profile(now, data, settings)

    def fitted(one: ActiveEffect, iterations: int) -> _Begun | None:
        try:
            at = _without_tolerances_behind(now, one)
            model = now.model.at(now.priors.values(at)).only(one)
            own = _priors_of(one, model, settings)
            z, gain, reduction = profile.fit(model, own, own.z(np.array(one.values)), iterations, at)
        except (AvisError, np.linalg.LinAlgError, FloatingPointError):
            return None
        return _Begun(one.at(own.values(z).tolist()), gain, reduction)

    def begun(one: Candidate) -> tuple[Candidate, _Begun | None]:
        if at_full_strength(one.effect):
            return one, None
        starts = [one.effect, *one.others]
        if len(starts) > 1:
            ends = [end for start in starts if (end := fitted(start, settings.first_iterations)) is not None]
            starts = [max(ends, key=lambda end: end.gain).effect] if ends else []
        return one, fitted(starts[0], settings.rough_iterations) if starts else None

    made = run.each(begun, chosen)
    most = max((end.gain for _, end in made if end is not None), default=0.0)
    # The best is fitted in any case: without path errors its gain is underestimated, and may be negative.
    least = min(most, settings.not_far_behind * most)
    near = [end.effect for _, end in made if end is not None and end.gain >= least]
    # If the other parameters must move beyond first order, as with a heavy sprung mass, only a fit of all parameters
    # shows what an effect can achieve.
    near += [
        one.effect
        for one, end in made
        if at_full_strength(one.effect)
        or (
            one.reduction >= 2 * settings.not_far_behind * most
            and (end is None or end.reduction < settings.least_promised * one.reduction)
        )
    ]
    found = _likelier(_joint_fits(now, near, data, run))
    return found, {one.label for one in near} - found.keys()


def _joint_fits(now: Fitted, effects: Sequence[ActiveEffect], data: Data, run: Run) -> list[Fitted]:
    """Fits of all parameters with one more effect each. Excluded are fits that fail, that end at values which physics
    forbids, or that end within a tolerance."""

    def ended(one: ActiveEffect) -> Fitted | None:
        return _small(with_effect(now, one, data, run.settings.quick))

    found = [with_motion(one, now.model.motion) for one in run.each(ended, effects) if one is not None]
    stated = tolerances_of(now.model.rig)
    return [
        one
        for one in found
        if not implausible(one) and not within_tolerance(one.model.effects[-1], stated, run.settings)
    ]


def _likelier(fits: Sequence[Fitted]) -> dict[str, Fitted]:
    """For each label of the last effect, the fit with the largest evidence; the first of equal ones."""
    found: dict[str, Fitted] = {}
    for one in fits:
        known = found.get(one.labels[-1])
        if known is None or one.log_evidence > known.log_evidence:
            found[one.labels[-1]] = one
    return found


def _likeliest(fits: Mapping[str, Fitted], settings: GapSettings) -> str:
    """Label of the most probable fit: evidence, and prior odds of effects that are not in the library."""
    return max(fits, key=lambda label: fits[label].log_evidence + math.log(prior_odds(fits[label], label, settings)))


def at_full_strength(one: ActiveEffect) -> bool:
    """Whether an effect adds a resonance without a strength that can be small. Mass and stiffness found without it must
    move beyond first order, so that only a joint fit shows its value."""
    return one.effect.resonant and not one.absent


def _small(found: Fitted | None) -> Fitted | None:
    """The fit without its large data, mainly the motion of the records, for the transfer from another process."""
    return found and with_motion(found.bare(), {})


def with_motion(fitted: Fitted, motion: Mapping[str, RecordMotion]) -> Fitted:
    """The fit with another motion of the records, not fitted again."""
    return replace(fitted, model=replace(fitted.model, motion=motion))


def implausible(fitted: Fitted) -> str:
    """Why physics forbids the values of some effect; empty if it does not."""
    return next((reason for one in fitted.model.effects if (reason := forbidden(fitted, one))), "")


def forbidden(fitted: Fitted, one: ActiveEffect) -> str:
    """Why physics forbids the values of an effect; empty if it does not."""
    std = np.sqrt(np.maximum(np.diag(fitted.covariance_of(one.names)), 0))
    values = dict(zip((p.name for p in one.parameters), std, strict=True))
    if np.any(shares(one.by_name) <= 0):
        return "elements that differ so much that one of them would have the opposite sign"
    return str(one.effect.implausible(one.by_name, values) or at_the_edge(one))


def at_the_edge(effect: ActiveEffect) -> str:
    """Describe a shape parameter that ended at its physical bound, where the effect has turned into a different one;
    empty if there is none."""
    for parameter, value in zip(effect.parameters, effect.values, strict=True):
        margin = 1e-6 * (parameter.high - parameter.low)
        inside = parameter.low + margin <= value <= parameter.high - margin
        if not (inside or parameter.linear or parameter.optional):
            end = f"runs to {value:.3g} {parameter.unit}, the end of its range"
            return f"{parameter.name} of {effect.effect.name} {end}"
    return ""
