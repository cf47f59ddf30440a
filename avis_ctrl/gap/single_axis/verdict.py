"""From the ladder of stages to a verdict, sentences and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.gap.single_axis.machine import AxisProblem, HeldOut, correlation_time, held_out
from avis_ctrl.gap.single_axis.result import AxisEffect, AxisGap, AxisStage, Estimate
from avis_ctrl.gap.single_axis.settings import SETTINGS
from avis_ctrl.gap.single_axis.stepwise import (
    AT_THE_NOISE,
    DRAWS,
    FALSE_ALARM,
    Candidate,
    Progress,
    Step,
    reference,
    search,
)
from avis_ctrl.gap.single_axis.terms import AxisParameter, Term
from avis_ctrl.measurement.gates.finding import Picture, Series

# Of the squared error that a model without physics shows to be removable, effects that take less than this leave more
# than half of the r.m.s.: neighbours of the truth, not the truth.
LEAST_SHARE = 0.75


@dataclass(frozen=True, eq=False)
class _Reference:
    """A model without physics on top of a stage: rms ratio of the stage to it, and whether that is certain."""

    name: str
    judged: HeldOut
    ratio: float
    certain: bool


def gap_of(problem: AxisProblem, library: Sequence[Term], progress: Progress) -> AxisGap:
    """Search, verdict and words."""
    rng = np.random.default_rng(0)
    steps, last = search(problem, library, progress)
    progress("models without physics")
    left = _references(problem, steps[-1], rng)
    on_base = left if len(steps) == 1 else _references(problem, steps[0], rng)
    steps, refused = _enough(problem, steps, on_base, left)
    verdict = _verdict(problem, steps, left)
    stages = tuple(AxisStage("base" if step.named is None else step.named.name, *_figures(problem, step.judged))
                   for step in steps)
    references = tuple(AxisStage(f"{where}, {one.name}", *_figures(problem, one.judged))
                       for where, several in (("base", on_base), ("all named", left if len(steps) > 1 else ()))
                       for one in several)
    effects = _effects(problem, steps)
    first = steps[1].candidates if len(steps) > 1 else last
    experiments = [term.separated_by for term, effect in zip(_named(steps), effects, strict=True)
                   if effect.indistinguishable_from]
    return AxisGap(problem.kind, verdict, effects, stages, references, problem.where(steps[-1].judged.e),
                   tuple(_sentences(problem, verdict, stages, effects, steps, left, last, refused)),
                   "; ".join(dict.fromkeys(experiments)) or None,
                   _estimates(steps[-1].fitted.parameters, steps[-1], 0, len(problem.base)),
                   tuple((c.key, c.probability) for c in first),
                   (_picture(stages), problem.picture([step.judged.e for step in steps],
                                                      [stage.stage for stage in stages])))


def _references(problem: AxisProblem, step: Step, rng: np.random.Generator) -> list[_Reference]:
    return [_reference(problem, step, name, columns, rng)
            for name, columns in problem.references(step.fitted.terms, step.fitted.theta).items()]


def _reference(problem: AxisProblem, step: Step, name: str, columns: np.ndarray, rng: np.random.Generator
               ) -> _Reference:
    plain, judged = held_out(problem, step.fitted), reference(problem, step.fitted, columns)
    tau = correlation_time(problem, plain)
    gain = judged.blocks(problem.block, tau) - plain.blocks(problem.block, tau)
    draws = rng.dirichlet(np.ones(len(gain)), DRAWS) * len(gain)
    certain = bool(gain.sum() > np.log(1 / FALSE_ALARM) and np.mean(draws @ gain > 0) >= 1 - FALSE_ALARM)
    ratio = float(np.linalg.norm(plain.e / plain.sigma) / np.linalg.norm(judged.e / plain.sigma))
    return _Reference(name, judged, ratio, certain)


def _enough(problem: AxisProblem, steps: list[Step], on_base: Sequence[_Reference], left: Sequence[_Reference]
            ) -> tuple[list[Step], str]:
    """No effects where all of them together take up too little of what is there to take up."""
    if len(steps) == 1:
        return steps, ""
    before, after = (float(np.mean(step.judged.e ** 2)) for step in (steps[0], steps[-1]))
    floors = [float(np.mean(one.judged.e ** 2)) for one in (*on_base, *left) if one.certain]
    floors += [problem.noise] if problem.noise is not None else []
    floor = min([*floors, after])
    share = (before - after) / max(before - floor, np.finfo(float).tiny)
    if share >= LEAST_SHARE:
        return _of_right_shape(problem, steps)
    names = ", ".join(step.named.name for step in steps[1:] if step.named)
    return steps[:1], (f"{names} would take up {100 * share:.0f} % of the squared error that can be taken up: a "
                       "neighbour of what is missing, and not named")


def _of_right_shape(problem: AxisProblem, steps: list[Step]) -> tuple[list[Step], str]:
    """No effects where a free function of the variable that one of them acts on removes as much of what is left."""
    last = steps[-1]
    rng = np.random.default_rng(0)
    for variable in sorted({term.variable for term in last.fitted.terms if term.variable}):
        one = _reference(problem, last, f"free function of the {variable}",
                         problem.free(variable, last.fitted.terms, last.fitted.theta), rng)
        if one.certain and one.ratio ** 2 * (1 - LEAST_SHARE) > 1:
            names = ", ".join(term.name for term in last.fitted.terms if term.variable == variable)
            return steps[:1], (f"What is missing is a function of the {variable}, but not of the shape of {names}: "
                               f"a free function leaves {one.ratio:.3g} times less, and {names} is not named")
    return steps, ""


def _verdict(problem: AxisProblem, steps: Sequence[Step], left: Sequence[_Reference]) -> str:
    """Something is missing where what is left exceeds the noise, or what a model without physics leaves, by a factor
    that the contract does not call closed; in long records every small imperfection is certain."""
    judged = steps[-1].judged
    chi = _figures(problem, judged)[1]
    free = any(one.certain and one.ratio > AT_THE_NOISE for one in left)
    # Few rows scatter by more than that, and unseen rows carry the scatter of the parameters too.
    rows = len(judged.e) / correlation_time(problem, judged)
    chance = float(stats.chi2(rows).isf(FALSE_ALARM)) / rows * (1 + len(steps[-1].fitted.theta) / rows)
    missing = free or (chi is not None and chi > max(AT_THE_NOISE ** 2, chance))
    if len(steps) == 1:
        # Where nothing tells the noise, a model without physics that certainly predicts better is all that does.
        return "unexplained" if missing or (chi is None and any(one.certain for one in left)) else "none"
    return "partly explained" if missing else "explained"


def _figures(problem: AxisProblem, judged: HeldOut) -> tuple[float, float | None]:
    power = float(np.mean(judged.e ** 2))
    return (float(np.sqrt(power / np.mean(problem.size ** 2))),
            None if problem.noise is None else power / problem.noise)


def _estimates(parameters: Sequence[AxisParameter], step: Step, start: int, stop: int) -> tuple[Estimate, ...]:
    deviation = np.sqrt(np.diag(step.fitted.covariance))
    return tuple(Estimate(parameters[j].name, float(step.fitted.theta[j]), float(deviation[j]), parameters[j].unit)
                 for j in range(start, stop))


def _effects(problem: AxisProblem, steps: Sequence[Step]) -> tuple[AxisEffect, ...]:
    """Each with its parameters in the last model, where all are fitted together."""
    found, at = [], len(problem.base)
    named = {term.key for term in _named(steps)}
    for step in steps[1:]:
        assert step.named is not None
        for term in step.named.terms:
            stop = at + len(term.parameters(problem))
            # Of a pair, one is as sure as all pairs that hold it; its rivals are what stands in its place.
            sure = step.named.probability if len(step.named.terms) == 1 else min(
                sum(c.probability for c in _distinct(step.candidates) if term in c.terms), SETTINGS.most_sure)
            rivals = {one.key for c in step.rivals if term not in c.terms for one in c.terms} - named
            sizes = _estimates(steps[-1].fitted.parameters, steps[-1], at, stop)
            found.append(AxisEffect(term.name, term.location, sizes, sure, tuple(sorted(rivals))))
            at = stop
    return tuple(found)


def _named(steps: Sequence[Step]) -> list[Term]:
    return [term for step in steps[1:] if step.named for term in step.named.terms]


def _distinct(candidates: Sequence[Candidate]) -> list[Candidate]:
    """One of those that predict the same, which share their probability."""
    found: list[Candidate] = []
    for c in candidates:
        if not any(c.predicts_like(one) for one in found):
            found.append(c)
    return found


def _sentences(problem: AxisProblem, verdict: str, stages: Sequence[AxisStage], effects: Sequence[AxisEffect],
               steps: Sequence[Step], left: Sequence[_Reference], last: Sequence[Candidate], refused: str
               ) -> list[str]:
    said = [_answer(verdict, stages, effects, steps)]
    words = {term.key: term.words for step in steps for c in step.candidates for term in c.terms}
    for term, effect in zip(_named(steps), effects, strict=True):
        if effect.indistinguishable_from:
            rivals = " or ".join(words[key] for key in effect.indistinguishable_from)
            said.append(f"{term.name}: these data cannot tell it from {rivals}; what would: {term.separated_by}.")
    if stages[-1].chi2_per_dof is not None:
        said.append(f"What is left on unseen data is {np.sqrt(stages[-1].chi2_per_dof):.3g} times the measured noise.")
    else:
        said.append("Nothing in these data repeats, so that the noise is not measured: what is left is compared with "
                    "models without physics alone.")
    for one in left:
        told = f"leaves {one.ratio:.2f} times less" if one.ratio > 1 else "predicts no better"
        said.append(f"A model without physics ({one.name}) on top {told} on unseen data"
                    + (", certainly." if one.certain else ", which may be chance."))
    if len(effects) > 1:
        power = [stage.nrmse ** 2 for stage in stages]
        shares = [f"{stage.stage} takes {100 * (power[k] - power[k + 1]) / power[0]:.3g} %"
                  for k, stage in enumerate(stages[1:])]
        said.append(f"Of the squared error of the base model, {', '.join(shares)}.")
    said += problem.notes
    if refused:
        said.append(refused + ".")
    lost = [f"{c.key} {c.refused}" for c in last if c.gain > 0 and c.refused][:3]
    if lost:
        said.append("Not named: " + "; ".join(lost) + ".")
    return said


def _answer(verdict: str, stages: Sequence[AxisStage], effects: Sequence[AxisEffect], steps: Sequence[Step]) -> str:
    first, last = 100 * stages[0].nrmse, 100 * stages[-1].nrmse
    if verdict == "none":
        return f"Nothing is missing that these data can show: the base model leaves {first:.3g} % on unseen data."
    if not effects:
        return (f"The base model leaves {first:.3g} % on unseen data, significantly more than a model without physics "
                "or the noise, and no effect of the library accounts for it: unexplained.")
    names = []
    for term, effect in zip(_named(steps), effects, strict=True):
        sizes = ", ".join(f"{p.name} {p.value:.4g} +- {p.std:.2g} {p.unit}".rstrip() for p in effect.parameters)
        names.append(f"{term.words} ({effect.name} at {effect.location}: {sizes}; "
                     f"probability {effect.probability:.2f})")
    tail = "" if verdict == "explained" else ", and something more is missing that the library does not hold"
    return (f"The model lacks {'; then '.join(names)}; with that the gap on unseen data falls from {first:.3g} % to "
            f"{last:.3g} %{tail}.")


def _picture(stages: Sequence[AxisStage]) -> Picture:
    at = np.arange(len(stages), dtype=float)
    return Picture("Gap on unseen data", "stage", "error over measured [%]",
                   (Series("left", at, np.array([100 * stage.nrmse for stage in stages]), "bars"),), (), "linear",
                   "log", tuple(stage.stage for stage in stages))
