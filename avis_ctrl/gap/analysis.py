"""Gap analysis of a rig and a campaign, from the signals to the verdict.

prepare -> fit of rig -> fit with tolerances -> search -> motion of the records again -> naming (-> search from the rig
file, if the fit moved its values too far) -> stages, power fractions and residual
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.gap.detection_limits import detection_limits
from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.outside_library import unnamed_faults
from avis_ctrl.gap.line_response import clear_cache
from avis_ctrl.gap.next_measurement import between, grows_faster, of_unexplained
from avis_ctrl.gap.preparation import Prepared, mended_with, prepare, with_motion_of, with_noise_from, with_second_order
from avis_ctrl.gap.probability import Step, name_of, odds_against_fit, probabilities, probability_of
from avis_ctrl.gap.residual import ModelResidual, every_record, heat_map, places
from avis_ctrl.gap.result import Considered, Detectable, Gap, NamedEffect, Remainder, Stage, Verdict, Where, missed
from avis_ctrl.gap.run import Mapper, Progress, Run, between_stages, sequential_map
from avis_ctrl.gap.score import EvidenceScore
from avis_ctrl.gap.search import (
    backward_elimination,
    forbidden,
    implausible,
    is_weak,
    next_effect_from,
    outliers,
    search,
    with_motion,
    with_undetected,
    without_effect,
)
from avis_ctrl.gap.settings import SETTINGS, GapSettings
from avis_ctrl.gap.signal_effects import levels, named, time_residuals
from avis_ctrl.gap.table_model import ActiveEffect
from avis_ctrl.gap.tolerances import credible, has_tolerance, moved, of_effect, tolerances_behind, with_tolerance
from avis_ctrl.gap.validation import Power, change_from, halves, share_of
from avis_ctrl.identification.likelihood import Data, Fitted, first_variances, fit, log_likelihood, refit
from avis_ctrl.identification.priors import Tolerance, re_identified, tolerances_of, with_tolerances
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.summary import joined, percent


@dataclass(frozen=True, eq=False)
class Fits:
    """base : fit of the re-identified rig. at_file : model and parameters with the values of the rig file, from which
    fits start. tolerant : fit with all tolerances. steps : of the search. best : fit with all effects."""

    base: Fitted
    at_file: Fitted
    tolerant: Fitted
    steps: tuple[Step, ...]
    best: Fitted


@dataclass(frozen=True, eq=False)
class Names:
    """Effects that are named.

    updated : fit with these effects. probability, rivals : by label of the effect. refused : why an effect is not
        named, by label.
    """

    updated: Fitted
    probability: dict[str, float]
    rivals: dict[str, tuple[str, ...]]
    refused: dict[str, str]


def analyse(
    campaign: Campaign,
    rig: Rig,
    seed: int = 1,
    band_Hz: tuple[float, float] | None = None,
    amplifier_corner_Hz: float | None = None,
    effects: Sequence[Effect] | None = None,
    progress: Progress = lambda text: None,
    each: Mapper = sequential_map,
    settings: GapSettings = SETTINGS,
) -> Gap:
    """Search for missing effects, name them and update the model.

    Parameters
    ----------
    campaign : records with the channel names of the rig; some of them drive the actuators. rig : as in its file.
    band_Hz : of the comparison; the excited band if None. effects : candidates; the library if None.
    each : runs independent fits; one after the other by default.

    Raises
    ------
    InputError : no record drives an actuator, or the noise cannot be estimated.
    """
    began = time.monotonic()
    progress = between_stages(progress)
    prepared = prepare(campaign, rig, band_Hz, amplifier_corner_Hz, Run(settings, progress, each))
    known = list(library().values()) if effects is None else list(effects)
    fits = _fits(prepared, rig, known)
    if prepared.clipped is not None and fits.steps:
        progress("clipped samples: replaced by the prediction of the model with its effects")
        prepared = mended_with(prepared, fits.best.model)
        del fits  # with the motion in every record, which takes much memory
        fits = _fits(prepared, rig, known)
    prepared, fits, names = _completed(prepared, fits, known)
    if not credible(names.updated, settings):
        progress("search with the values of the rig file: the fit moved them further than their tolerances allow")
        again = _searched_from_file(fits, names.updated, prepared, known)
        if again is not None:
            own, again, renamed = _completed(prepared, again, known)
            if renamed.updated.labels or not names.updated.labels:
                prepared, fits, names = own, again, renamed
    return _gap(prepared, fits, names, known, seed, began)


def _completed(prepared: Prepared, fits: Fits, effects: Sequence[Effect]) -> tuple[Prepared, Fits, Names]:
    """Noise and motion estimated again with the model that was found, the fits with them, and the names."""
    settings, progress = prepared.run.settings, prepared.run.progress
    residual = ModelResidual.of(fits.best.model, prepared.held_out)
    if prepared.local_noise and residual.noise_nrmse**2 > settings.within_noise * residual.nrmse**2:
        # A local polynomial model counts distortion as noise; the model with its effects may predict it.
        progress("noise estimated again, with the effects that were found")
        prepared = with_noise_from(prepared, fits.best.model)
        fits = _refitted(fits, prepared, effects)
    if any(fits.best.model.effect(label).effect.nonlinear for label in fits.best.labels):
        progress("motion of the table estimated again, with the effects that were found")
        prepared = with_motion_of(prepared, fits.best.model)
        fits = _with_motion(fits, prepared)
    steps, best = _without_weak(fits.steps, fits.best, prepared.fit_data, settings)
    more, best = outliers(best, prepared.fit_data, effects, prepared.run)
    fits = replace(fits, steps=(*steps, *more), best=best)
    progress("validation of the effects on held-out records")
    return prepared, fits, _names(fits, prepared)


def _fits(prepared: Prepared, rig: Rig, effects: Sequence[Effect]) -> Fits:
    data, settings, progress = prepared.fit_data, prepared.run.settings, prepared.run.progress
    progress("fit of mass, inertia, stiffness and damping")
    start, nominal = prepared.rough, prepared.nominal.base
    large = of_effect(start.effects[0], tolerances_of(rig), settings)
    priors = re_identified(nominal.rig, settings).followed_by(large)
    base = fit(start, priors, priors.z(start.values), data, first_variances(data, settings), settings)
    progress("fit with all values of the rig file free")
    tolerances = with_tolerances(nominal, tolerances_of(rig), settings)
    apart = replace(
        base.model,
        base=replace(base.model.base, names=tolerances.names),
        nominal=replace(nominal, names=tolerances.names),
        corners_differ=True,
    )
    priors = tolerances.followed_by(large)
    tolerant = fit(apart, priors, priors.z(apart.values), data, base.variances, settings)
    at_file = replace(tolerant.bare(), model=apart, z=priors.z(apart.values))
    return _searched(Fits(base, at_file, tolerant.bare(), (), tolerant), prepared, effects)


def _searched_from_file(fits: Fits, updated: Fitted, prepared: Prepared, effects: Sequence[Effect]) -> Fits | None:
    """A search that starts from the values of the rig file; None if its model is no better than the updated one.

    Values that moved further than their tolerances allow may compensate for a missing effect.
    """
    data, settings = prepared.fit_data, prepared.run.settings
    # Noise and motion may have been estimated again since these fits.
    base, tolerant = refit(fits.base, data, settings), refit(fits.tolerant, data, settings)
    step = next_effect_from(fits.at_file, base, tolerant, data, _with_unnamed(effects), prepared.run)
    if step is None:
        return None
    least = settings.certain + math.log(step.candidates)
    if step.fitted.log_evidence < tolerant.log_evidence + least:
        return None
    before = fits.steps[0].tried if fits.steps else {}
    rivals = {label: refit(one, data, settings.quick).bare() for label, one in before.items() if one.labels == (label,)}
    first = replace(step, tried={**rivals, **step.tried})
    again = _searched(Fits(base, fits.at_file, tolerant.bare(), (first,), step.fitted), prepared, effects)
    return again if again.best.log_evidence > updated.log_evidence + least else None


def _refitted(fits: Fits, prepared: Prepared, effects: Sequence[Effect]) -> Fits:
    """Refit the last model with the new noise estimate and continue the search from there. Effects found before are
    still judged with the noise estimate with which they were found."""
    best = refit(fits.best, prepared.fit_data, prepared.run.settings)
    return _searched(replace(fits, best=best), prepared, effects)


def _with_motion(fits: Fits, prepared: Prepared) -> Fits:
    """The fits with the motion of the records as prepared; the last model is fitted again.

    The first motion is that of a model with the sensors as in the rig file. The force of a cubic spring changes by 3 %
    with 1 % of its deflection.
    """

    def moved(one: Fitted) -> Fitted:
        return with_motion(one, prepared.nominal.motion)

    steps = (
        replace(
            step,
            before=moved(step.before),
            fitted=moved(step.fitted),
            tried={label: moved(one) for label, one in step.tried.items()},
        )
        for step in fits.steps
    )
    best = refit(moved(fits.best), prepared.fit_data, prepared.run.settings)
    return Fits(moved(fits.base), moved(fits.at_file), moved(fits.tolerant), tuple(steps), best)


def _with_unnamed(effects: Sequence[Effect]) -> list[Effect]:
    """The candidates, and the unnamed faults, which are fitted for comparison only."""
    return [*effects, *unnamed_faults().values()]


def _searched(fits: Fits, prepared: Prepared, effects: Sequence[Effect]) -> Fits:
    """Add the effects that the search finds in addition to those of the best fit."""
    steps = search(fits.best, prepared.fit_data, _with_unnamed(effects), prepared.run)
    return replace(fits, steps=(*fits.steps, *steps), best=steps[-1].fitted if steps else fits.best)


def _without_weak(
    steps: Sequence[Step], best: Fitted, data: Data, settings: GapSettings
) -> tuple[tuple[Step, ...], Fitted]:
    """Remove weak effects (`is_weak`) that the evidence does not require; the remaining steps and the fit. Values
    beyond their tolerance are kept: their evidence lies in how far other values had to move, or in narrower priors
    (`outliers`)."""
    stated = tolerances_of(best.model.rig)
    weak = [
        step
        for step in steps
        if not has_tolerance(best.model.effect(step.label), stated) and is_weak(best, step.label, settings)
    ]
    kept, best = backward_elimination(weak, best, data, settings)
    return tuple(step for step in steps if step in kept or step not in weak), best


def _names(fits: Fits, prepared: Prepared) -> Names:
    """Name the effects that pass all checks: an effect must be more probable than its alternatives, have the same size
    in both halves of band and level, and make held-out records more likely."""
    data, held, settings = prepared.fit_data, prepared.held_data, prepared.run.settings
    best, probability, rivals, refused = fits.best, {}, {}, {}
    for step in fits.steps:
        probability[step.label], rivals[step.label] = probability_of(step, settings)
    drift = "the delay of y after u drifts in the records (gate sample clock)" * prepared.faults.drifting_delay
    for step in fits.steps:
        label = step.label
        why = drift or _refusal(fits.best, step, probability[label], data, held, settings)
        if why:
            one = fits.best.model.effect(label)
            refused[label] = (
                f"the residual is most like {one.effect.described(one.place, one.by_name)}, which is not in the library"
                if one.effect.outside
                else f"{one.effect.name} fits best, but is not named: {why}"
            )
            best = without_effect(best, label, data, settings) or best
    if refused:
        remaining = [step for step in fits.steps if step.label in best.labels]
        kept, best = _without_weak(remaining, best, data, settings)
        refused |= {
            step.label: f"{name_of(step.label)[0]} is not named: without the effects that are refused, its "
            "strength is hardly distinguishable from zero"
            for step in remaining
            if step not in kept
        }
        for step in kept:
            if change := _change_if_weak(best, fits.best, step.label, settings):
                refused[step.label] = (
                    f"{name_of(step.label)[0]} is not named: beside the effects that are refused, its strength is "
                    f"hardly distinguishable from zero, and without them its parameters differ by {100 * change:.0f} %"
                )
                best = without_effect(best, step.label, data, settings) or best
    named = {label: value for label, value in probability.items() if label in best.labels}
    return Names(best, named, {label: rivals[label] for label in named}, refused)


def _refusal(best: Fitted, step: Step, probability: float, data: Data, held: Data, settings: GapSettings) -> str:
    """Why an effect is not named; empty if it is named."""
    one = best.model.effect(step.label)
    if one.effect.outside:
        return "it is not in the library"
    if probability < settings.headline:
        return f"its probability is only {probability:.2f}"
    if reason := forbidden(best, one):
        return reason
    if not _borne_out(best, step, data, held, settings):
        return "held-out records are not more likely with it"
    for half in halves(best, _constant(one), settings, absent=one.absent):
        if half.change > settings.law_change:
            return f"for {half.words} alone, its parameters differ by {100 * half.change:.0f} % or more"
    return ""


def _constant(one: ActiveEffect) -> list[str]:
    """Parameters on which halves of the data must agree: all except those that may end at their bounds."""
    return [name for name, p in zip(one.names, one.parameters, strict=True) if p.linear or not p.optional]


def _change_if_weak(fitted: Fitted, whole: Fitted, label: str, settings: GapSettings) -> float:
    """Relative change of a weak effect's parameters from the fit with the effects that are refused; 0 if it is small,
    or if the effect is strong beside them. A weak effect that changes describes the refused ones in their absence."""
    if not is_weak(whole, label, settings):
        return 0.0
    one = fitted.model.effect(label)
    change = change_from(fitted, whole, _constant(one), settings, one.absent)
    return change if change > settings.law_change else 0.0


def _borne_out(best: Fitted, step: Step, data: Data, held: Data, settings: GapSettings) -> bool:
    """Whether an effect makes held-out records more likely: when it was found or, failing that, together with all
    effects found later. A weak effect may not show while a stronger one is missing."""

    counted = has_tolerance(best.model.effect(step.label), tolerances_of(best.model.rig))

    def likelihood(one: Fitted) -> float:
        # A value beyond its tolerance shows in how far other values had to move, hardly in a residual.
        return log_likelihood(one, held, settings) - 0.5 * counted * float(one.z @ one.z)

    if likelihood(step.fitted) > likelihood(step.before):
        return True
    rest = without_effect(best, step.label, data, settings)
    return rest is not None and likelihood(best) > likelihood(rest)


def _gap(prepared: Prepared, fits: Fits, names: Names, effects: Sequence[Effect], seed: int, began: float) -> Gap:
    """Assemble the result; stages, maps and sentences are computed on held-out records."""
    blocks, updated, settings, progress = prepared.held_out, names.updated, prepared.run.settings, prepared.run.progress
    before, after = ModelResidual.of(fits.base.model, blocks), ModelResidual.of(updated.model, blocks)
    raw = ModelResidual.of(fits.base.model, prepared.unmasked)
    noise = after.noise_nrmse**2
    power = Power(noise, before.nrmse**2)
    stages = [
        Stage("nominal", *_figures(ModelResidual.of(with_second_order(prepared.nominal), prepared.unmasked))),
        Stage("re-identified", *_figures(raw)),
        Stage("tolerances", *_figures(ModelResidual.of(fits.tolerant.model, prepared.unmasked))),
    ]
    if prepared.faults.hum is not None:
        stages.append(Stage("mains_hum", *_figures(ModelResidual.of(fits.tolerant.model, blocks))))
    stages += [
        Stage(name_of(label)[0], *_figures(after if one is updated else ModelResidual.of(one.model, blocks)))
        for label, one in _chain(fits, updated, prepared)
    ]
    wider = with_undetected(updated, effects, prepared.fit_data, settings)
    found = [
        NamedEffect(
            one.effect.name,
            name_of(one.label)[1],
            one.effect.titled(one.place),
            one.effect.reported(updated.model, one.place, one.by_name, wider.covariance_of(one.names)),
            names.probability[one.label],
            names.rivals[one.label],
            label=one.label,
            share=share_of(updated.model, one.label, blocks, power, after.nrmse**2),
        )
        for one in map(updated.model.effect, updated.labels)
    ]
    faults = prepared.faults
    if after.chi2_per_dof <= settings.known_noise:
        progress("noise of floor and sensors")
        residual = time_residuals(prepared.campaign, updated.model, prepared.run.each)
        clear_cache()
        faults = replace(faults, noise=levels(residual, updated.model, faults.hum, faults.converter))
    found += [replace(one, share=_share_of_signal(one.name, raw, before, power)) for one in named(faults, settings)]
    found.sort(key=lambda one: -(one.share or 0.0))
    reported = tuple(one for one in found if (one.share or 0.0) >= settings.trace)
    traces = tuple(one for one in found if (one.share or 0.0) < settings.trace)
    excess = after.nrmse**2 - noise
    sensors = {name: one.value for name, one in faults.noise.sensors.items()} if faults.noise else None
    records, shares = every_record(prepared, fits.base.model, updated.model, sensors)
    remainder = Remainder(
        after.nrmse, after.nrmse / max(after.noise_nrmse, 1e-300), power.share(excess), grows_faster(records)
    )
    closed = after.chi2_per_dof <= settings.within_noise or excess <= 0
    small = math.sqrt(max(excess, 0.0)) < settings.small
    verdict = _verdict(reported, closed, closed or small, remainder, settings)
    where, remaining = places(before), places(after)
    onward = separating_measurement(reported, fits)
    imitated = "" if credible(updated, settings) else _far(updated, settings)
    if onward is None and (imitated or verdict in ("unexplained", "partly explained")):
        onward = of_unexplained(remaining, records)
    limits: tuple[Detectable, ...] = ()
    if verdict == "none":
        progress("detection limits of the effects")
        limits = detection_limits(EvidenceScore(updated, prepared.fit_data, settings), effects)
    sentences = (
        _opening(verdict, reported, traces, stages, remainder, after),
        imitated,
        *names.refused.values(),
        _remains(remainder, remaining),
        prepared.noise,
    )
    return Gap(
        verdict,
        reported,
        tuple(stages),
        where if verdict != "none" else (),
        remaining,
        after.noise_nrmse,
        onward,
        fits.base.model,
        updated.model,
        _considered(fits, names, prepared),
        heat_map(before, after),
        tuple(one for one in sentences if one),
        prepared.halves.how,
        seed,
        time.monotonic() - began,
        wider.whole_covariance()[: len(updated.z), : len(updated.z)],
        limits,
        shares,
        records,
        faults.raised if closed else (),
        traces,
        remainder,
        _moved(wider, settings),
    )


def _chain(fits: Fits, updated: Fitted, prepared: Prepared) -> list[tuple[str, Fitted]]:
    """The models from the one with tolerances to the updated one, each with one more effect, in order of finding."""
    found = []
    one: Fitted | None = updated
    for label in reversed(updated.labels):
        if one is None:
            break
        found.append((label, one))
        before = {label for label in one.labels if label != found[-1][0]}
        if not before:
            break
        known = next((step.fitted for step in fits.steps if set(step.fitted.labels) == before), None)
        one = known or without_effect(one, label, prepared.fit_data, prepared.run.settings.quick)
    return found[::-1]


def _figures(residual: ModelResidual) -> tuple[float, float]:
    return residual.nrmse, residual.chi2_per_dof


def _share_of_signal(name: str, raw: ModelResidual, masked: ModelResidual, power: Power) -> float:
    """Part of the gap due to an effect on the signals alone, relative to the baseline's excess including this part. Hum
    is measured on the lines that it pollutes; floor and converter, which are part of the noise, by the noise itself."""
    own = max(raw.nrmse**2 - masked.nrmse**2, 0.0) if name == "mains_hum" else power.noise
    return float(own / max(own + power.excess, 1e-300))


def _verdict(
    reported: Sequence[NamedEffect], closed: bool, small: bool, residual: Remainder, settings: GapSettings
) -> Verdict:
    """Verdict by the rules of the contract. closed : the residual is noise. small : closed, or below 1 % of the
    response."""
    if not reported:
        return "none" if small else "unexplained"
    return "explained" if closed or residual.share <= 1 - settings.explained else "partly explained"


def _moved(fitted: Fitted, settings: GapSettings) -> tuple[Tolerance, ...]:
    """Every value of the rig file with a tolerance, the largest shift first."""
    return moved(fitted, with_tolerance(fitted), tolerances_of(fitted.model.rig), settings)


def separating_measurement(reported: Sequence[NamedEffect], fits: Fits) -> str | None:
    """The measurement that would distinguish an effect from its strongest rival; None if no rival remains."""
    for one in reported:
        if one.indistinguishable_from and one.label:
            step = next(step for step in fits.steps if step.label == one.label)
            mine, other = step.tried[step.label], one.indistinguishable_from[0]
            # Of the places and laws of the rival, the one with the largest odds cannot be ruled out.
            rival = max(
                (fit for label, fit in step.tried.items() if name_of(label)[0] == other),
                key=lambda fit: odds_against_fit(mine, fit),
            )
            return between(one.name, other, mine.model, rival.model)
    return None


def _far(fitted: Fitted, settings: GapSettings) -> str:
    """Values of the rig file that moved further, as a whole, than their tolerances allow; those that an effect
    represents are not among them."""
    names = fitted.priors.names
    named = {names[k] for one in fitted.model.effects for k in tolerances_behind(one, names)}
    shifts = [one for one in _moved(fitted, settings) if one.parameter not in named]
    far = sum(abs(one.moved) > settings.beyond_least for one in shifts)
    size = float(np.sqrt(np.mean([one.moved**2 for one in shifts])))
    return (
        f"the fit moves the values of the rig file further than their tolerances allow ({shifts[0].parameter} by "
        f"{abs(shifts[0].moved):.3g} tolerances; {far} of {len(shifts)} by more than {settings.beyond_least:g}; r.m.s. "
        f"{size:.2g}): the rig file is wrong there, its tolerances are too small, or an effect is missing that these "
        "values imitate"
    )


def _considered(fits: Fits, names: Names, prepared: Prepared) -> tuple[Considered, ...]:
    """Effects that were fitted but not named, the most probable first."""
    rows, thin, settings = [], prepared.held_data.blocks, prepared.run.settings
    for number, step in enumerate(fits.steps, 1):
        top, probability = max(one.log_evidence for one in step.tried.values()), probabilities(step, settings)
        for label, one in sorted(step.tried.items(), key=lambda item: -item[1].log_evidence):
            effect = one.model.effects[-1]
            if effect.effect.outside or label in names.updated.labels:
                continue
            reason = (
                names.refused.get(label)
                or implausible(one)
                or (f"step {number}: log evidence {top - one.log_evidence:.3g} lower than the best")
            )
            reported = effect.effect.reported(one.model, effect.place, effect.by_name, one.covariance_of(effect.names))
            chi2 = ModelResidual.of(one.model, thin).chi2_per_dof
            rows.append(
                Considered(
                    effect.effect.name,
                    name_of(label)[1],
                    chi2,
                    min(probability[label], settings.most_sure),
                    reason,
                    reported,
                    effect.place.partition("/")[2],
                )
            )
    return tuple(sorted(rows, key=lambda one: -one.probability)[: settings.shown_runners_up])


def _opening(
    verdict: Verdict,
    reported: Sequence[NamedEffect],
    traces: Sequence[NamedEffect],
    stages: Sequence[Stage],
    residual: Remainder,
    after: ModelResidual,
) -> str:
    """The opening sentences: verdict and size of the gap."""
    before = next(one.nrmse for one in stages if one.name == "re-identified")
    rest = f"the noise alone is estimated at {percent(after.noise_nrmse)}"
    also = f" Effects that explain less than 1 % of the gap: {joined([one.name for one in traces])}." if traces else ""
    fitted = "all values of the rig file fitted again"
    if verdict == "none":
        return (
            f"No missing effect was found: with {fitted}, the error on held-out records is "
            f"{percent(residual.nrmse)}; {rest}.{also}"
        )
    if verdict == "unexplained":
        return (
            f"The model misses something that no effect of the library explains: with {fitted}, the error on "
            f"held-out records is {percent(residual.nrmse)}; {rest}.{also}"
        )
    lines = " (on lines without hum)" if any(one.name == "mains_hum" for one in (*reported, *traces)) else ""
    return (
        f"{missed(reported)} With {'this' if len(reported) == 1 else 'these'} and {fitted}, the gap falls from "
        f"{percent(before)} to {percent(residual.nrmse)}{lines}; {rest}.{also}"
    )


def _remains(residual: Remainder, remaining: Sequence[Where]) -> str:
    """How large the residual is, where, and at which level."""
    if residual.over_noise <= 1.05:
        if not remaining:
            return "the residual is the noise"
        places = sorted({f"{one.output} from {one.from_Hz:.3g} to {one.to_Hz:.3g} Hz" for one in remaining})
        return (
            f"as a whole the residual does not exceed the noise, but it does in {'; '.join(places[:3])}"
            f"{' and elsewhere' if places[3:] else ''}"
        )
    level = {
        True: "; it grows faster than the drive level",
        False: "; it does not grow faster than the drive level",
        None: "",
    }[residual.grows_with_level]
    lies = (
        f", most of it in {remaining[0].output} from {remaining[0].from_Hz:.3g} to {remaining[0].to_Hz:.3g} Hz"
        if remaining
        else ""
    )
    return (
        f"the residual is {percent(residual.nrmse)} of the held-out signal, {residual.over_noise:.3g} times the "
        f"noise{lies}; its power beyond noise is {percent(residual.share)} of that of the re-identified "
        f"model{level}"
    )
