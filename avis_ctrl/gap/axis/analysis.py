"""Gap analysis of one axis, from a problem to a verdict: search, names, contributions, sentences.

Problem -> base fit -> search -> names (rivals, halves, held-out data) -> stages and sentences
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.gap.axis.model import AxisModel, Effect, Problem
from avis_ctrl.gap.axis.result import AxisGap, RunnerUp
from avis_ctrl.gap.axis.search import Explored, Progress, Rival, at_an_edge, parts, rivals, robust, search, unnamed
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings
from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.probability import Step, probability_of
from avis_ctrl.gap.result import NamedEffect, Remainder, Stage, Verdict, Where, missed
from avis_ctrl.gap.validation import Half, Power, halves
from avis_ctrl.identification.likelihood import Fitted
from avis_ctrl.identification.single_axis.fit import slopes
from avis_ctrl.measurement.gates.finding import Picture, Series
from avis_ctrl.summary import percent


@dataclass(frozen=True, eq=False)
class Name:
    """An effect that was found. refused : why it is not named, empty if it is. widened : see `_widening`."""

    effect: Effect
    probability: float
    rivals: tuple[Rival, ...]
    refused: str
    widened: float


def analyse(problem: Problem, progress: Progress = lambda text: None, settings: AxisSettings = SETTINGS) -> AxisGap:
    """Find the effects that a model lacks, with their probabilities.

    Raises
    ------
    InputError, ComputationError : as in the fit of the base model.
    """
    progress("base model")
    explored = Explored(problem, settings)
    base = explored.base
    best = _first_of_alike(search(explored, progress), explored)
    progress("names")
    refused: dict[str, str] = {}
    while True:
        names = [_name(best, one, explored) for one in best.model.effects if not one.outside]
        if in_doubt := {one.effect.label: one for one in names if one.refused}:
            # The one that the data miss least is removed first; the others are judged again without it.
            worst = in_doubt[explored.least_missed(best, list(in_doubt))]
            wrong = {worst.effect: worst.refused}
        elif better := _better_shape(best, explored):
            best, variable = better
            why = f"another function of the {variable} gives a much smaller residual"
            wrong = {one.effect: why for one in names if one.effect.variable == variable}
        else:
            free = unnamed(best, explored)
            shares = Contributions.of(best, free, names, explored)
            uncertain = [one.effect for one in names if not shares.certain(best, one.effect, settings)]
            uncertain.sort(key=lambda one: shares.of_effect[one.label])
            wrong = dict.fromkeys(uncertain[:1], "its size is not certain to differ from zero")
        if not wrong:
            break
        refused |= {one.name: why for one, why in wrong.items()}
        for one in wrong:
            rest = explored.without(best, one.label)
            if rest is None:  # nothing is known of the other effects without this one
                why = f"no fit without {one.name} succeeded"
                refused |= {other.effect.name: why for other in names if other.effect not in wrong}
            best = rest or base
    removed = power(base) - power(best)
    if not names or (free is not None and removed < settings.right_shape * (power(base) - power(free))):
        refused |= {one.effect.name: "a function of another shape removes far more" for one in names}
        names, best, free = [], base, unnamed(base, explored)
        shares = Contributions.of(best, free, names, explored)
    return _gap(explored, best, free, shares, names, refused)


def _better_shape(best: Fitted, explored: Explored) -> tuple[Fitted, str] | None:
    """The model with a free function of the variable of a named effect, and that variable, if its residual is much
    smaller; else None. A law that is only close to the true one must not be named."""
    known = {one.variable for one in best.model.effects if one.outside}
    for variable in sorted({one.variable for one in best.model.effects if one.variable} - known):
        free = unnamed(best, explored, variable)
        if free is not None and power(free) < (1 - explored.settings.right_shape) * power(best):
            return free, variable
    return None


def _first_of_alike(best: Fitted, explored: Explored) -> Fitted:
    """Replace each effect by the first one in the library that predicts the same."""
    keys = [one.key for one in explored.problem.effects]
    for label in best.labels:
        same = [r for r in rivals(best, label, explored) if r.same]
        first = min(same, key=lambda r: keys.index(r.effect.key), default=None)
        if first is not None and keys.index(first.effect.key) < keys.index(best.model.effect(label).key):
            best = first.fitted
    return best


def _name(best: Fitted, one: Effect, explored: Explored) -> Name:
    settings, others, rest = explored.settings, rivals(best, one.label, explored), explored.without(best, one.label)
    tried = {one.label: best, **{r.effect.label: r.fitted for r in others if not r.same}}
    step = Step(rest or explored.base, best, tried, len(tried), one.label)
    probability, _ = probability_of(step, settings, explored.odds_against)
    near = tuple(r for r in others if r.same or r.odds * probability > settings.rival)
    # Only linear parameters are compared: a shape parameter is often determined by a part of the data alone.
    found = halves(best, one.sizes, settings, parts(best, one.sizes), dict.fromkeys(one.sizes, 0.0))
    refused = _refusal(best, rest, found, explored)
    if probability < settings.headline:
        refused = f"its probability is only {probability:.2f}"
    return Name(one, probability, near, refused, _widening(found, settings))


def _widening(found: Sequence[Half], settings: AxisSettings) -> float:
    """Factor on the standard deviations of an effect's parameters, 1 or more. If halves of the data differ by more than
    noise, the parameters are known only as well as the halves agree (R. T. Birge, Phys. Rev. 40 (1932) 207-227)."""
    return max([1.0, *(float(np.sqrt(one.chi2 / one.dof)) for one in found if one.p_value < settings.widened_p_value)])


def _refusal(best: Fitted, rest: Fitted | None, found: Sequence[Half], explored: Explored) -> str:
    if edge := at_an_edge(best):
        return edge
    if rest is not None and explored.held_out(best) <= explored.held_out(rest):
        return "held-out data do not confirm it"
    for half in found:
        if half.change > explored.settings.law_change:
            return f"for {half.words} its size differs by {100 * half.change:.0f} %"
    return ""


def power(fitted: Fitted | AxisModel) -> float:
    """Residual power of a model on held-out data over the power of the data."""
    residual, whole = _power(fitted.model if isinstance(fitted, Fitted) else fitted)
    return float(sum(map(np.sum, residual)) / whole)


def power_by_line(fitted: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """(n,) each: frequency [Hz], and residual power of held-out data on that line over the total power of the data."""
    residual, whole = _power(fitted.model)
    # `records` puts the mean of a window at a thousandth of the bin spacing.
    f = [
        np.where(omega < 0.01 * np.unique(omega)[:2][-1], 0.0, omega / (2 * np.pi))
        for omega in (block.omega for block in fitted.model.lines.held.blocks)
    ]
    return np.concatenate(f), np.concatenate(residual) / whole


def _power(model: AxisModel) -> tuple[list[np.ndarray], float]:
    """Residual power on each line (n,) of each held-out block, and the total power of the data."""
    blocks = model.lines.held.blocks
    residual = [np.sum(np.abs(block.Y - model.answer(block, None, False).Y) ** 2, axis=(1, 2)) for block in blocks]
    return residual, sum(float(np.sum(np.abs(block.Y) ** 2)) for block in blocks)


@dataclass(frozen=True, eq=False)
class Contributions:
    """Contribution of each effect to the gap on held-out data, and the covariance of the parameters.

    floor : power of the noise, or of the residual of the best free function. after : residual power of the model
    without unnamed functions. remaining : fraction of the gap. alone : residual power without an effect, no refit;
    of_effect : fraction of the gap that the effect explains and the other effects, refitted, cannot; both by
    label. covariance : of all parameters.
    """

    floor: float
    after: float
    remaining: float
    alone: Mapping[str, float]
    of_effect: Mapping[str, float]
    covariance: np.ndarray

    @staticmethod
    def of(best: Fitted, free: Fitted | None, names: Sequence[Name], explored: Explored) -> Contributions:
        """Contributions of the named effects of `best`; free : the fit with a free function, None if there is none."""

        def without(label: str, otherwise: float) -> float:
            rest = explored.without(best, label)
            return power(rest) if rest else otherwise

        whole, before, noise = power(best), power(explored.base), explored.problem.noise
        after = max(whole, *(without(one.label, before) for one in best.model.effects if one.outside), 0.0)
        floor = noise if noise is not None else min(whole, power(free) if free is not None else whole)
        gap = Power(floor, before)
        remaining = max(after - floor, 0.0) / gap.excess
        alone = {one.effect.label: power(best.model.without(one.effect.label)) for one in names}
        shares = {label: gap.share(min(left, without(label, left)) - whole) for label, left in alone.items()}
        return Contributions(floor, after, remaining, alone, shares, _widened(best, names, shares, remaining))

    def certain(self, best: Fitted, one: Effect, settings: AxisSettings) -> bool:
        """Whether an effect's size differs from zero by at least `apart` standard deviations."""
        at, std = [best.model.names.index(name) for name in one.sizes], np.sqrt(np.diag(self.covariance))
        return any(abs(best.model.values[k]) >= settings.apart * std[k] for k in at)


def _widened(best: Fitted, names: Sequence[Name], shares: Mapping[str, float], remaining: float) -> np.ndarray:
    """Covariance of all parameters, widened because no law describes the real element exactly. The parameters of an
    effect are known only as well as halves of the data agree. The residual beyond noise may have any correlation from
    -1 to 1 with the effect (variance 1/3)."""
    factor, beside = np.ones(len(best.model.names)), np.zeros(len(best.model.names))
    for one in names:
        at = [best.model.names.index(name) for name in one.effect.names]
        factor[at] = one.widened
        beside[at] = best.model.of(one.effect) ** 2 * remaining / (3 * max(shares[one.effect.label], remaining, 1e-12))
    return robust(best) * np.outer(factor, factor) + np.diag(beside)


def _gap(
    explored: Explored,
    best: Fitted,
    free: Fitted | None,
    found: Contributions,
    names: Sequence[Name],
    refused: Mapping[str, str],
) -> AxisGap:
    problem, settings, base, covariance = explored.problem, explored.settings, explored.base, found.covariance
    effects = [_reported(one, best, covariance, found.of_effect[one.effect.label], problem) for one in names]
    effects.sort(key=lambda one: -found.alone[one.label])
    reported = tuple(one for one in effects if (one.share or 0.0) >= settings.trace)
    traces = tuple(one for one in effects if (one.share or 0.0) < settings.trace)
    outside = [one.label for one in best.model.effects if one.outside]
    stages = _stages(best, [*(one.label for one in effects), *outside], explored)
    closed = found.after <= max(settings.within_noise * found.floor, found.floor + settings.small**2)
    kinds: tuple[Verdict, Verdict] = ("partly explained", "explained") if reported else ("unexplained", "none")
    onward = next((one.effect.separated_by for one in names if one.rivals), None)
    unknown = next((one.title for fitted in (best, free) if fitted for one in fitted.model.effects if one.outside), "")
    sentences = _sentences(problem, kinds[closed], reported, traces, stages, names, unknown)
    if refused:
        lost = "; ".join(f"{name} reduces the gap, but {why}" for name, why in refused.items())
        sentences.append(f"Not named: {lost}.")
    ups = tuple(
        RunnerUp(r.effect.key, one.effect.key, min(r.odds * one.probability, settings.most_sure))
        for one in names
        for r in one.rivals
    )

    def base_values(values: np.ndarray) -> dict[str, tuple[float, str]]:
        return {p.name: (value, p.unit) for p, value in zip(best.model.base, values.tolist(), strict=False)}

    def ratios(values: np.ndarray) -> Mapping[str, tuple[float, str]]:
        names = (name.partition("@")[0] for name in best.model.names)
        return problem.ratios(dict(zip(names, values.tolist(), strict=True)))

    over_noise = np.nan if problem.noise is None else float(np.sqrt(found.after / max(problem.noise, 1e-300)))
    # If the noise is unknown, it is the fraction of the whole residual.
    share = found.after / stages[0].nrmse ** 2 if problem.noise is None else found.remaining
    return AxisGap(
        problem.kind,
        kinds[closed],
        reported,
        traces,
        tuple(stages),
        _where(best, problem),
        Remainder(stages[-1].nrmse, over_noise, share),
        tuple(sentences),
        onward,
        _propagated(base_values, best.model.values, covariance, problem),
        _propagated(ratios, best.model.values, covariance, problem),
        ups,
        _pictures(base, best, stages),
        {"kind": problem.kind, **problem.plain, "baseline": _plain(base), "updated": _plain(best)},
    )


def _reported(one: Name, best: Fitted, covariance: np.ndarray, share: float, problem: Problem) -> NamedEffect:
    effect = one.effect
    rows = [best.model.names.index(name) for name in effect.names]
    found = _propagated(effect.reported, best.model.of(effect), covariance[np.ix_(rows, rows)], problem)
    return NamedEffect(
        effect.name,
        effect.location,
        effect.title,
        found,
        one.probability,
        tuple(dict.fromkeys(r.effect.key for r in one.rivals)),
        effect.label,
        share=share,
    )


def _propagated(
    function: Callable[[np.ndarray], Mapping[str, tuple[float, str]]],
    values: np.ndarray,
    covariance: np.ndarray,
    problem: Problem,
) -> dict[str, Reported]:
    """Function values with standard deviations to first order."""
    found = function(values)

    def numbers(x: np.ndarray) -> np.ndarray:
        return np.array([value for value, _ in function(x).values()])

    J = slopes(numbers, values, np.where(values == 0, 1e-300, np.abs(values)))
    std = np.sqrt(np.einsum("ip,pq,iq->i", J, covariance, J)) if found else ()
    return {
        name: Reported(float(value), float(sigma), unit.format(**problem.units))
        for (name, (value, unit)), sigma in zip(found.items(), std, strict=True)
    }


def _stages(best: Fitted, labels: Sequence[str], explored: Explored) -> list[Stage]:
    """Base model, then one more effect per stage, the largest contribution first."""
    models, one, noise = [("base", explored.base)], best, explored.problem.noise
    for label in reversed(labels):
        models.insert(1, (label.partition("@")[0], one))
        rest = explored.without(one, label)
        if rest is None or len(one.labels) == 1:
            break
        one = rest
    over = np.nan if noise is None else 1 / max(noise, 1e-300)
    return [Stage(name, float(np.sqrt(power(one))), power(one) * over) for name, one in models]


def _plain(fitted: Fitted) -> dict[str, Any]:
    model = fitted.model
    return {
        "base": {p.name: float(value) for p, value in zip(model.base, model.values, strict=False)},
        "effects": [{"label": one.label, "values": model.of(one).tolist()} for one in model.effects if not one.outside],
    }


def _where(best: Fitted, problem: Problem) -> tuple[Where, ...]:
    """The fewest octaves that contain at least half of the residual power, largest first; the mean is in the lowest."""
    f, residual = power_by_line(best)
    octave = np.floor(np.log2(np.maximum(f, np.min(f[f > 0])))).astype(int)
    found: list[Where] = []
    for k in sorted(np.unique(octave), key=lambda k: -float(residual[octave == k].sum())):
        inside = octave == k
        share = float(residual[inside].sum() / max(residual.sum(), 1e-300))
        driven, measured = (problem.units.get(name, "") for name in ("input", "output"))
        found.append(Where(float(f[inside].min()), float(f[inside].max()), driven, measured, share))
        if sum(one.share for one in found) >= 0.5:
            break
    return tuple(found)


def _pictures(base: Fitted, best: Fitted, stages: Sequence[Stage]) -> tuple[Picture, ...]:
    at = np.arange(len(stages), dtype=float)
    ladder = Picture(
        "Gap on held-out data",
        "stage",
        "error over measured [%]",
        (Series("left", at, np.array([100 * one.nrmse for one in stages]), "bars"),),
        (),
        "linear",
        "log",
        tuple(one.name for one in stages),
    )
    series = []
    for name, fitted in (("base", base), ("updated", best)):
        f, residual = power_by_line(fitted)
        lines = np.unique(np.round(f, 9))
        lines = lines[lines > 0]
        rms = np.array([np.sqrt(np.mean(residual[np.round(f, 9) == one])) for one in lines])
        series.append(Series(name, lines, rms, "points" if len(lines) < 40 else "line"))
    return ladder, Picture(
        "Residual of each model on held-out data",
        "frequency [Hz]",
        "r.m.s. on a line, relative",
        tuple(series),
        (),
        "log",
        "log",
    )


def _sentences(
    problem: Problem,
    verdict: Verdict,
    reported: Sequence[NamedEffect],
    traces: Sequence[NamedEffect],
    stages: Sequence[Stage],
    names: Sequence[Name],
    unknown: str,
) -> list[str]:
    first, last = percent(stages[0].nrmse), percent(stages[-1].nrmse)
    if verdict == "none":
        sentences = [f"No missing effect was found: the error on held-out data is {last}."]
    elif verdict == "unexplained":
        sentences = [
            f"The error of the base model on held-out data is {first}, and no effect of the library explains it."
        ]
    else:
        sentences = [
            f"{missed(reported)} With {'this' if len(reported) == 1 else 'these'} the gap on held-out data falls "
            f"from {first} to {last}."
            f"{' A part is not explained.' * (verdict != 'explained')}"
        ]
    if traces:
        told = (f"{one.name} ({', '.join(f'{key} {p}' for key, p in one.parameters.items())})" for one in traces)
        sentences.append(f"Traces, below 1 % of the gap: {'; '.join(told)}.")
    if any(one.name == "delay" and next(iter(one.parameters.values())).value < 0 for one in (*reported, *traces)):
        sentences.append(
            "The delay is negative: the motion comes before the force, so that the force was logged "
            "late, or the motion early."
        )
    sentences += [
        f"{one.effect.name}: these data cannot distinguish it from "
        f"{' or '.join(dict.fromkeys(r.effect.title for r in one.rivals))}. To distinguish them: "
        f"{one.effect.separated_by}."
        for one in names
        if one.rivals and one.effect.separated_by
    ]
    sentences.append(
        "Nothing in these data repeats, so the noise cannot be estimated: the residual may be noise or a missing "
        "effect."
        if problem.noise is None
        else f"The residual of held-out data is {np.sqrt(stages[-1].chi2_per_dof):.3g} times the measured noise."
    )
    if unknown:
        sentences.append(f"The residual is most similar to {unknown}, which is not in the library.")
    return [*sentences, *problem.notes]
