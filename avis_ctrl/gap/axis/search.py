"""Selection of the effects that the data support: score tests of single effects and pairs, fits, model evidence. Each
selected effect is then removed and replaced by every other one.

Every set of effects is fitted once (`Explored`), with the likelihood of the table. The order in which effects are found
does not influence which ones are named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from itertools import combinations

import numpy as np

from avis_ctrl.gap.axis.model import AxisModel, Effect, Problem, added_priors
from avis_ctrl.gap.axis.settings import AxisSettings
from avis_ctrl.gap.probability import larger_odds
from avis_ctrl.gap.score import reduction
from avis_ctrl.gap.search import fit_or_none
from avis_ctrl.gap.validation import by_information
from avis_ctrl.identification.likelihood import Data, Fitted, Profile, first_variances, fit, unseen
from avis_ctrl.identification.maximum_likelihood import as_real, whitened
from avis_ctrl.identification.priors import Priors
from avis_ctrl.identification.single_axis.fit import not_below

Progress = Callable[[str], None]
# Log-likelihood by segment, octave, and whether the data were held out.
Cells = dict[tuple[int, int, bool], float]


@dataclass(frozen=True, eq=False)
class Candidate:
    """Effects with initial values for a fit.

    directions : (k, N) whitened, orthogonal to those of the current model. along : (k,) products with the residual.
    """

    effects: tuple[tuple[Effect, np.ndarray], ...]
    directions: np.ndarray
    along: np.ndarray

    @cached_property
    def reduction(self) -> float:
        """Reduction of the sum of squares that the score test predicts."""
        return reduction(self.directions @ self.directions.T, self.along).chi2

    @property
    def first(self) -> Effect:
        """The effect, or the first one of a pair."""
        return self.effects[0][0]


@dataclass(eq=False)
class Explored:
    """Fits by the set of their effects' labels, so that the order in which effects are found has no influence.

    base : the fit without effects. cells : `cells` of a fit, for the fitted or the held-out data; computed once.
    """

    problem: Problem
    settings: AxisSettings
    fits: dict[frozenset[str], Fitted | None] = field(default_factory=dict)
    base: Fitted = field(init=False)
    cells: Callable[[Fitted, bool], Cells] = field(init=False)

    def __post_init__(self) -> None:
        model, data, settings = self.problem.model, self.data, self.settings
        priors = added_priors(model, settings)
        self.base = fit(model, priors, priors.z(model.values), data, first_variances(data, settings), settings)
        self.fits[frozenset()] = self.base
        self.cells = cache(partial(cells, settings=settings))

    @property
    def data(self) -> Data:
        """The lines that are fitted."""
        found: Data = self.problem.model.lines.fitted
        return found

    def with_effects(self, now: Fitted, added: Sequence[tuple[Effect, np.ndarray]]) -> Fitted | None:
        """The fit with additional effects; None if it did not converge."""
        labels = frozenset((*now.labels, *(one.label for one, _ in added)))
        if labels not in self.fits:
            model, priors, z = now.model, now.priors, now.z
            for one, values in added:
                model = model.with_effect(one, values)
                own = added_priors(model, self.settings)
                priors, z = priors.followed_by(own), np.concatenate([z, own.z(values)])
            self.fits[labels] = self._fit(model, priors, z, now)
        return self.fits[labels]

    def without(self, now: Fitted, label: str) -> Fitted | None:
        """The fit without one of its effects; None if it did not converge."""
        labels = frozenset(now.labels) - {label}
        if labels not in self.fits:
            model = now.model.without(label)
            rows = [now.priors.names.index(name) for name in model.names]
            self.fits[labels] = self._fit(model, now.priors.of(model.names), now.z[rows], now)
        return self.fits[labels]

    def _fit(self, model: AxisModel, priors: Priors, z: np.ndarray, like: Fitted) -> Fitted | None:
        with np.errstate(all="ignore"):
            return fit_or_none(like, model, priors, z, self.data, self.settings)

    def held_out(self, one: Fitted) -> float:
        """Log-likelihood of the held-out data."""
        return sum(self.cells(one, True).values())

    def score(self, one: Fitted) -> float:
        """Evidence of the fitted data plus log-likelihood of the held-out data."""
        return one.log_evidence + self.held_out(one)

    def least_missed(self, now: Fitted, labels: Sequence[str]) -> str:
        """Label of the effect without which the score is largest. A fit without an effect that did not converge counts
        as the lowest."""

        def score(label: str) -> float:
            rest = self.without(now, label)
            return -math.inf if rest is None else self.score(rest)

        return max(labels, key=score)

    def odds_against(self, one: Fitted, other: Fitted) -> float:
        """Odds of another fit against this one, by the evidence of the fitted data and the likelihood of the held-out
        data, or by how evenly their difference is spread over segments and octaves, whichever is larger: the residual
        of a real record is not white noise."""
        mine, theirs = self.cells(one, False), self.cells(other, False)
        beside = one.log_evidence - other.log_evidence - sum(mine.values()) + sum(theirs.values())
        return larger_odds(mine | self.cells(one, True), theirs | self.cells(other, True), beside)

    def candidates(self, now: Fitted, effects: Sequence[Effect]) -> list[Candidate]:
        """Every effect that the model does not contain, at its best seed, the largest reduction first."""
        profile, taken = Profile(now, self.data, self.settings), {one.key for one in now.model.effects}
        found = [
            max((self._candidate(profile, one, seed) for seed in one.initial_values()), key=lambda c: c.reduction)
            for one in effects
            if one.key not in taken
        ]
        return sorted(found, key=lambda c: -c.reduction)

    def _candidate(self, profile: Profile, one: Effect, seed: np.ndarray) -> Candidate:
        """An effect at its seed. Directions: the derivatives with respect to its linear parameters, if it has any, or
        to all of them."""
        now = profile.fitted
        model = now.model.with_effect(one, seed)
        rows = [
            as_real(whitened(L[:, None], model.answer(block).dY[-len(seed) :]))
            for block, L in zip(self.data.blocks, now.weights.L, strict=True)
        ]
        linear = np.array([p.linear for p in one.parameters], bool)
        C = profile.free(np.concatenate(rows, axis=1)[linear | (not linear.any())])
        return Candidate(((one, seed),), C, C @ profile.e)

    def in_place_of(self, now: Fitted, label: str, effects: Sequence[Effect], most: int) -> list[tuple[Effect, Fitted]]:
        """Other effects in the place of one, and their fits: the best to first order, at most `most`."""
        rest, own = self.without(now, label), now.model.effect(label).key
        found = [] if rest is None else self.candidates(rest, effects)
        known = max((c.reduction for c in found if c.first.key == own), default=0.0)
        near = [c for c in found[:most] if c.reduction >= 0.5 * self.settings.not_far_behind * known]
        fits = [(c.first, self.with_effects(rest, c.effects)) for c in near if rest is not None]
        return [(effect, one) for effect, one in fits if one is not None and not at_an_edge(one)]

    def shortlist(self, now: Fitted) -> list[Candidate]:
        """The best single effects, and the best pairs whose joint reduction exceeds the sum of the single ones."""
        settings, found, one_law = self.settings, self.candidates(now, self.problem.library), dict[str, Candidate]()
        for c in found:
            one_law.setdefault(c.first.key, c)
        pairs = []
        for a, b in combinations(one_law.values(), 2):
            directions, along = np.vstack([a.directions, b.directions]), np.concatenate([a.along, b.along])
            both = Candidate((*a.effects, *b.effects), directions, along)
            if both.reduction > a.reduction + b.reduction + 2 * settings.certain:
                pairs.append(both)
        singles = [c for c in found if c.reduction > 2 * settings.certain]
        pairs.sort(key=lambda c: -c.reduction)
        return [*singles[: settings.refits], *pairs[: settings.pairs]]


def search(explored: Explored, progress: Progress) -> Fitted:
    """The model with the effects that the data support.

    An effect is added if the score rises by more than the number of candidates explains and held-out data confirm it.
    It is dropped if other effects have made it redundant. When no more effects are added, each is compared with every
    other one in its place, and the search continues if one is better.
    """
    settings, now, revisions = explored.settings, explored.base, 0
    price = settings.certain + math.log(len(explored.problem.library))
    while True:
        progress(f"candidates beside {', '.join(now.labels) or 'the base model'}")
        tried = [now]
        if len(now.labels) < settings.longest:
            for c in explored.shortlist(now):
                one = explored.with_effects(now, c.effects)
                if one is not None and not at_an_edge(one):
                    tried.append(one)
        best = max(tried, key=lambda one: explored.score(one) - (len(one.labels) - len(now.labels)) * price)
        if best is not now:
            best = _without_idle(_revised(best, explored, laws_only=True), explored)
        if (
            best is now
            or explored.score(best) <= explored.score(now)
            or (explored.held_out(best) <= explored.held_out(now))
        ):
            revisions += 1
            best = _without_idle(_revised(now, explored, laws_only=False), explored)
            if revisions > settings.revisions or best.labels == now.labels:
                return best
        now = best


def _revised(now: Fitted, explored: Explored, laws_only: bool) -> Fitted:
    """Replace each effect by another law of the same effect, or by any other effect, if the score rises."""
    settings, effects = explored.settings, explored.problem.library
    for label in now.labels:
        laws = [one for one in effects if one.key == now.model.effect(label).key]
        tried = explored.in_place_of(now, label, laws if laws_only else effects, settings.starts + len(laws))
        best = max((one for _, one in tried), key=explored.score, default=now)
        if explored.score(best) > explored.score(now) + settings.settled:
            now = best
    return now


def _without_idle(now: Fitted, explored: Explored) -> Fitted:
    while len(now.labels) > 1:
        rest = explored.without(now, explored.least_missed(now, now.labels))
        if rest is None or explored.score(rest) < explored.score(now) - explored.settings.certain:
            return now
        now = rest
    return now


def at_an_edge(fitted: Fitted) -> str:
    """Message on a parameter of an effect at the end of its range, or beyond what physics allows; empty if none is."""
    for one, values in zip(fitted.model.effects, fitted.model.parts, strict=True):
        if one.implausible and (reason := one.implausible(values)):
            return reason
        for p, value in zip(one.parameters, values, strict=True):
            if value <= p.low or value >= p.high:
                return f"{p.name} of {one.name} ends at {value:.3g} {p.unit}, the limit of its range"
    return ""


def unnamed(now: Fitted, explored: Explored, variable: str | None = None) -> Fitted | None:
    """The best model with an additional unnamed function, of one variable if it is given; None if the data do not
    support one."""
    settings = explored.settings
    others = [one for one in explored.problem.unnamed if variable in (None, one.variable)]
    tried = [
        one for c in explored.candidates(now, others) if (one := explored.with_effects(now, c.effects)) is not None
    ]
    best = max(tried, key=lambda one: one.log_evidence, default=None)
    price = settings.certain + math.log(max(len(others), 1) * settings.outside_odds)
    return best if best is not None and best.log_evidence > now.log_evidence + price else None


@dataclass(frozen=True, eq=False)
class Rival:
    """Another effect in place of a given one: the fit, its odds, and whether it predicts the same."""

    effect: Effect
    fitted: Fitted
    odds: float
    same: bool


def rivals(best: Fitted, label: str, explored: Explored) -> list[Rival]:
    """Effects that could replace a given one while all others are kept."""
    settings, own = explored.settings, best.model.effect(label).key
    known = [
        Rival(effect, one, explored.odds_against(best, one), alike(best, one, settings))
        for effect, one in explored.in_place_of(best, label, explored.problem.library, 2 * settings.refits)
        if effect.key != own
    ]
    return sorted(known, key=lambda r: -r.odds)


def alike(one: Fitted, other: Fitted, settings: AxisSettings) -> bool:
    """Whether two models predict the same within the data: if one were true, the log-likelihood of the other would be
    lower by less than `alike` [nats] on average."""
    residual = one.white.e - other.white.e
    return bool(0.5 * residual @ residual < settings.alike)


def cells(fitted: Fitted, held: bool, settings: AxisSettings) -> Cells:
    """Log-likelihood of the fitted data by segment and octave, or of the held-out data by segment. Each held-out
    segment may have a larger variance than the fitted data, so that a single disturbance decides nothing."""
    data = fitted.model.lines.held if held else fitted.model.lines.fitted
    weights, e = unseen(fitted, data, settings) if held else (fitted.weights, fitted.e)
    (frequency, segment, *_), determinant = row_table(fitted, data), np.zeros(len(e))
    for group, at in weights.rows.items():
        determinant[at] = weights.log_determinants[group] / len(at)
    octave = 0 * segment if held else np.floor(np.log2(frequency))
    places, cell = np.unique(np.stack([segment, octave]), axis=1, return_inverse=True)
    count, e2, rest = (np.bincount(cell.ravel(), x) for x in (np.ones(len(e)), e**2, determinant))
    louder = np.maximum(e2 / count, 1.0) if held else np.ones(len(e2))
    residual = e2 / louder + count * np.log(louder)
    return {(int(i), int(j), held): float(x) for i, j, x in zip(*places, -0.5 * (residual + rest), strict=True)}


def row_table(fitted: Fitted, data: Data) -> np.ndarray:
    """(4, N) frequency [rad/s], segment, its start time [s], and level of each number of the residual of these data."""
    parts = []
    for block, level in zip(data.blocks, data.levels, strict=True):
        segment, when = fitted.model.lines.of_lines(block.name)
        lines = np.stack([block.omega, segment, when, np.full(len(when), level)])
        parts.append(np.tile(np.repeat(lines, block.Y.shape[1], axis=1), 2))
    return np.concatenate(parts, axis=1)


def parts(fitted: Fitted, names: Sequence[str]) -> list[tuple[str, np.ndarray]]:
    """Halves of the data by band, time and level, each with half of the information on the given parameters."""
    frequency, _, when, level = row_table(fitted, fitted.model.lines.fitted)
    information = np.sum(fitted.J[[fitted.priors.names.index(name) for name in names]] ** 2, axis=0)
    return [
        *by_information(frequency, information, "the lower part of the band", "the upper part of the band"),
        *by_information(when, information, "the first half of the record", "the second half of the record"),
        *by_information(level, information, "low levels", "high levels"),
    ]


def robust(fitted: Fitted) -> np.ndarray:
    """Covariance of all parameter values, with the scores summed over each segment (K. Liang, S. Zeger, Biometrika 73
    (1986) 13), which allows any correlation within a segment. No variance is below that of the fit."""
    segment, slope = row_table(fitted, fitted.model.lines.fitted)[1], fitted.priors.slopes(fitted.z)
    inside = np.unique(segment)[:, None] == segment
    scores = (inside * fitted.e) @ fitted.J.T - fitted.z / len(inside)
    P, few = fitted.covariance, len(inside) / max(len(inside) - 1, 1)
    return not_below(few * P @ (scores.T @ scores) @ P, P) * np.outer(slope, slope)
