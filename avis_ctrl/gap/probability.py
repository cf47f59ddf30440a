"""Probability of an effect among the alternatives fitted in its place."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.identification.likelihood import Fitted


def name_of(label: str) -> tuple[str, str]:
    """Name and location of an effect from its label, without the variant of its law."""
    name, _, place = label.partition("@")
    return name, place.partition("/")[0]


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the search: the fit with one more effect, and all fits that were tried in its place, by label.

    before : the fit without the effect. candidates : number of effects and places scored. label : of the effect; by
        default the last effect of the fit.
    """

    before: Fitted
    fitted: Fitted
    tried: dict[str, Fitted]
    candidates: int
    label: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", self.fitted.labels[-1])


def odds_against(one: Mapping[Any, float], other: Mapping[Any, float], beside: float = 0.0) -> float:
    """Odds of `other` against `one`, from the spread of their log-likelihood difference over bands and levels.

    Q. H. Vuong, Econometrica 57 (1989) 307-333. Real elements follow textbook laws only approximately. A model that is
    better in some bands and worse in others is not certain to be the better model, however large the total difference.
    beside : part of the difference that belongs to no band (priors).
    """
    d = np.array([value - other[group] for group, value in one.items() if group in other])
    spread = float(np.sqrt(np.sum((d - d.mean()) ** 2)))
    ahead = (float(d.sum()) + beside) / max(spread, 1.0)
    # The tail below -37 standard deviations underflows; odds of 1e300 can still be added.
    return float(stats.norm.sf(ahead) / max(stats.norm.cdf(ahead), 1e-300))


def larger_odds(one: Mapping[Any, float], other: Mapping[Any, float], beside: float) -> float:
    """Odds of `other` against `one`: from the total difference, or from its spread (`odds_against`), whichever is
    larger."""
    ahead = sum(one.values()) - sum(other.values()) + beside
    return max(math.exp(-min(max(ahead, -50.0), 50.0)), odds_against(one, other, beside))


def odds_against_fit(one: Fitted, other: Fitted) -> float:
    """Odds of fit `other` against fit `one` (`larger_odds`)."""
    mine, theirs = one.log_likelihoods, other.log_likelihoods
    beside = one.log_evidence - other.log_evidence - sum(mine.values()) + sum(theirs.values())
    return larger_odds(mine, theirs, beside)


def prior_odds(fitted: Fitted, label: str, settings: GapSettings) -> float:
    """Prior odds of an effect of a fit against one of the library."""
    return 1 / settings.outside_odds if fitted.model.effect(label).outside else 1.0


def probabilities(step: Step, settings: GapSettings) -> dict[str, float]:
    """Probability of each fit that was tried in a step, by label; of the accepted effect that of `probability_of`."""
    own, mine = probability_of(step, settings)[0], step.tried[step.label]
    prior = prior_odds(mine, step.label, settings)

    def of(label: str, one: Fitted) -> float:
        return min(own * odds_against_fit(mine, one) * prior_odds(one, label, settings) / prior, 1 - own)

    return {label: own if label == step.label else of(label, one) for label, one in step.tried.items()}


def probability_of(
    step: Step, settings: GapSettings, odds_against: Callable[[Fitted, Fitted], float] = odds_against_fit
) -> tuple[float, tuple[str, ...]]:
    """Probability of the accepted effect among all effects fitted in its place, and the names that cannot be ruled out.
    Effects without a name in the library have a lower prior probability. odds_against : odds of the second fit against
    the first."""
    own, mine = name_of(step.label), step.tried[step.label]
    prior = prior_odds(mine, step.label, settings)
    odds = {("", ""): odds_against(mine, step.before) / prior}
    for label, one in step.tried.items():
        if name_of(label) != own:
            rival = odds_against(mine, one) * prior_odds(one, label, settings) / prior
            odds[name_of(label)] = max(odds.get(name_of(label), 0.0), rival)
    probability = 1 / (1 + sum(odds.values()))
    rivals = [
        name
        for (name, _), one in sorted(odds.items(), key=lambda item: -item[1])
        if name not in ("", own[0]) and one * probability > settings.rival
    ]
    return min(probability, settings.most_sure), tuple(dict.fromkeys(rivals))
