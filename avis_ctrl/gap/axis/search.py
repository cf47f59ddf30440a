"""Selection of the effects that the data support: score tests of single effects and pairs, fits, model evidence. Each
selected effect is then removed and replaced by every other one.

Every set of effects is fitted once (`Explored`), with the likelihood of the table. The order in which effects are found
does not influence which ones are named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import combinations

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.axis.model import AxisModel, Effect, effect_priors
from avis_ctrl.gap.axis.settings import AxisSettings
from avis_ctrl.gap.probability import larger_odds
from avis_ctrl.gap.score import reduction
from avis_ctrl.identification.likelihood import Data, Fitted, first_variances, fit, unseen
from avis_ctrl.identification.maximum_likelihood import as_real, whitened
from avis_ctrl.identification.priors import Priors
from avis_ctrl.identification.single_axis.fit import not_below

Progress = Callable[[str], None]
# Log-likelihood by segment, octave, and whether the data were held out.
Cells = dict[tuple[int, int, bool], float]


@dataclass(frozen=True, eq=False)
class Candidate:
    """Effects with initial values for a fit, the reduction of the sum of squares that the score test predicts, and
    their whitened directions (k, N), orthogonal to those of the current model."""

    effects: tuple[tuple[Effect, np.ndarray], ...]
    reduction: float
    directions: np.ndarray


@dataclass(eq=False)
class Explored:
    """Fits by the set of their effects' labels, so that the order in which effects are found has no influence.

    cells : `cells` of a fit, for the fitted or the held-out data; computed once.
    """

    data: Data
    settings: AxisSettings
    fits: dict[frozenset[str], Fitted | None] = field(default_factory=dict)
    cells: Callable[[Fitted, bool], Cells] = field(init=False)

    def __post_init__(self) -> None:
        self.cells = cache(partial(cells, settings=self.settings))

    def base(self, model: AxisModel, priors: Priors) -> Fitted:
        """The fit without effects."""
        found = fit(
            model, priors, priors.z(model.values), self.data, first_variances(self.data, self.settings), self.settings
        )
        self.fits[frozenset()] = found
        return found

    def with_effects(self, now: Fitted, added: Sequence[tuple[Effect, np.ndarray]]) -> Fitted | None:
        """The fit with additional effects; None if it did not converge."""
        labels = frozenset((*now.labels, *(one.label for one, _ in added)))
        if labels not in self.fits:
            model, priors, z = now.model, now.priors, now.z
            for one, values in added:
                model = model.with_effect(one, values)
                own = effect_priors(model, self.settings)
                priors, z = priors.followed_by(own), np.concatenate([z, own.z(values)])
            self.fits[labels] = self._try(model, priors, z, now)
        return self.fits[labels]

    def without(self, now: Fitted, label: str) -> Fitted | None:
        """The fit without one of its effects; None if it did not converge."""
        labels = frozenset(now.labels) - {label}
        if labels not in self.fits:
            model = now.model.without(label)
            rows = [now.priors.names.index(name) for name in model.names]
            self.fits[labels] = self._try(model, now.priors.of(model.names), now.z[rows], now)
        return self.fits[labels]

    def _try(self, model: AxisModel, priors: Priors, z: np.ndarray, like: Fitted) -> Fitted | None:
        try:
            with np.errstate(all="ignore"):
                return fit(model, priors, z, self.data, like.variances, self.settings)
        except (AvisError, np.linalg.LinAlgError, FloatingPointError):
            return None

    def held_out(self, one: Fitted) -> float:
        """Log-likelihood of the held-out data."""
        return sum(self.cells(one, True).values())

    def score(self, one: Fitted) -> float:
        """Evidence of the fitted data plus log-likelihood of the held-out data."""
        return one.log_evidence + self.held_out(one)

    def odds_against(self, one: Fitted, other: Fitted) -> float:
        """Odds of another fit against this one, by the evidence of the fitted data and the likelihood of the held-out
        data, or by how evenly their difference is spread over segments and octaves, whichever is larger: the residual
        of a real record is not white noise."""
        mine, theirs = self.cells(one, False), self.cells(other, False)
        beside = one.log_evidence - other.log_evidence - sum(mine.values()) + sum(theirs.values())
        return larger_odds(mine | self.cells(one, True), theirs | self.cells(other, True), beside)


def candidates(now: Fitted, data: Data, effects: Sequence[Effect]) -> list[Candidate]:
    """Every effect that the model does not contain, at its best seed, the largest reduction first."""
    J, e = now.J, now.e
    Q = np.linalg.qr(J.T)[0]
    residual, taken, found = e - Q @ (Q.T @ e), {one.key for one in now.model.effects}, []
    for one in effects:
        if one.key in taken:
            continue
        best = None
        for seed in one.initial_values():
            C = directions(now, data, one, seed)
            C = C - (C @ Q) @ Q.T
            reduced = reduction(C @ C.T, C @ residual).chi2
            if best is None or reduced > best.reduction:
                best = Candidate(((one, seed),), reduced, C)
        if best is not None:
            found.append(best)
    return sorted(found, key=lambda c: -c.reduction)


def directions(now: Fitted, data: Data, one: Effect, seed: np.ndarray) -> np.ndarray:
    """(k, N) whitened derivatives of the prediction with respect to an effect's parameters at its seed; only those of
    linear parameters, if there are any."""
    model = now.model.with_effect(one, seed)
    rows = []
    for block, L in zip(data.blocks, now.weights.L, strict=True):
        dY = model.columns(block)[-len(seed) :]
        rows.append(as_real(whitened(L[:, None], dY)))
    C = now.weights.flatten(np.concatenate(rows, axis=1))
    linear = np.array([p.linear for p in one.parameters], bool)
    return C[linear | (not linear.any())]


def shortlist(found: Sequence[Candidate], residual: np.ndarray, settings: AxisSettings) -> list[Candidate]:
    """The best single effects, and the best pairs whose joint reduction exceeds the sum of the single ones."""
    singles = [c for c in found if c.reduction > 2 * settings.certain]
    one_law: dict[str, Candidate] = {}
    for c in found:
        one_law.setdefault(c.effects[0][0].key, c)
    pairs = []
    for a, b in combinations(one_law.values(), 2):
        C = np.vstack([a.directions, b.directions])
        reduced = reduction(C @ C.T, C @ residual).chi2
        if reduced > a.reduction + b.reduction + 2 * settings.certain:
            pairs.append(Candidate((*a.effects, *b.effects), reduced, C))
    pairs.sort(key=lambda c: -c.reduction)
    return [*singles[: settings.refits], *pairs[: settings.pairs]]


def search(base: Fitted, explored: Explored, effects: Sequence[Effect], progress: Progress) -> Fitted:
    """The model with the effects that the data support.

    An effect is added if the score rises by more than the number of candidates explains and held-out data confirm it.
    It is dropped if other effects have made it redundant. When no more effects are added, each is compared with every
    other one in its place, and the search continues if one is better.
    """
    settings, now, revisions = explored.settings, base, 0
    effects = [one for one in effects if not one.outside]
    price = settings.certain + math.log(len(effects))
    while True:
        progress(f"candidates beside {', '.join(now.labels) or 'the base model'}")
        tried = [now]
        if len(now.labels) < settings.longest:
            for c in shortlist(candidates(now, explored.data, effects), now.e, settings):
                one = explored.with_effects(now, c.effects)
                if one is not None and not at_an_edge(one):
                    tried.append(one)
        best = max(tried, key=lambda one: explored.score(one) - (len(one.labels) - len(now.labels)) * price)
        if best is not now:
            best = _without_idle(_revised(best, explored, effects, laws_only=True), explored)
        if (
            best is now
            or explored.score(best) <= explored.score(now)
            or (explored.held_out(best) <= explored.held_out(now))
        ):
            revisions += 1
            best = _without_idle(_revised(now, explored, effects, laws_only=False), explored)
            if revisions > settings.revisions or best.labels == now.labels:
                return best
        now = best


def _revised(now: Fitted, explored: Explored, effects: Sequence[Effect], laws_only: bool) -> Fitted:
    """Replace each effect by another law of the same effect, or by any other effect, if the score rises."""
    settings = explored.settings
    for label in now.labels:
        own, rest = next(one for one in now.model.effects if one.label == label), explored.without(now, label)
        if rest is None:
            continue
        laws = [one for one in effects if one.key == own.key]
        found = candidates(rest, explored.data, laws if laws_only else effects)
        least = 0.5 * settings.not_far_behind * max(c.reduction for c in found if c.effects[0][0].key == own.key)
        for c in found[: settings.starts + len(laws)]:
            if c.reduction < least:
                break
            one = explored.with_effects(rest, c.effects)
            if one is not None and not at_an_edge(one) and explored.score(one) > explored.score(now) + settings.settled:
                now = one
    return now


def _without_idle(now: Fitted, explored: Explored) -> Fitted:
    while len(now.labels) > 1:
        rest = [one for label in now.labels if (one := explored.without(now, label)) is not None]
        best = max(rest, key=explored.score, default=None)
        if best is None or explored.score(best) < explored.score(now) - explored.settings.certain:
            return now
        now = best
    return now


def at_an_edge(fitted: Fitted) -> str:
    """Message on a parameter of an effect at the end of its range, or beyond what physics allows; empty if none is."""
    for one in fitted.model.effects:
        if one.implausible and (reason := one.implausible(fitted.model.of(one))):
            return reason
        for p, value in zip(one.parameters, fitted.model.of(one), strict=True):
            if value <= p.low or value >= p.high:
                return f"{p.name} of {one.name} ends at {value:.3g} {p.unit}, the limit of its range"
    return ""


def unnamed(now: Fitted, explored: Explored, effects: Sequence[Effect]) -> Fitted | None:
    """The best model with an additional unnamed function; None if the data do not support one."""
    settings, tried = explored.settings, []
    others = [one for one in effects if one.outside]
    for c in candidates(now, explored.data, others):
        one = explored.with_effects(now, c.effects)
        if one is not None:
            tried.append(one)
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


def rivals(best: Fitted, label: str, explored: Explored, effects: Sequence[Effect]) -> list[Rival]:
    """Effects that could replace a given one while all others are kept."""
    settings = explored.settings
    rest = explored.without(best, label)
    if rest is None:
        return []
    own = next(one for one in best.model.effects if one.label == label)
    found = candidates(rest, explored.data, [one for one in effects if not one.outside])
    mine = next((c for c in found if c.effects[0][0].label == label), None)
    least = 0.5 * mine.reduction if mine is not None else 0.0
    known: list[Rival] = []
    for c in found[: 2 * settings.refits]:
        effect = c.effects[0][0]
        if effect.key == own.key or c.reduction < settings.not_far_behind * least:
            continue
        one = explored.with_effects(rest, c.effects)
        if one is None or at_an_edge(one):
            continue
        known.append(Rival(effect, one, explored.odds_against(best, one), alike(best, one, settings)))
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
    rows, determinant = row_table(fitted, data), np.zeros(len(e))
    for group, at in weights.rows.items():
        determinant[at] = weights.log_determinants[group] / len(at)
    octave = 0 * rows.segment if held else np.floor(np.log2(rows.frequency)).astype(int)
    places, cell = np.unique(np.stack([rows.segment, octave]), axis=1, return_inverse=True)
    count, e2, rest = (np.bincount(cell.ravel(), x) for x in (np.ones(len(e)), e**2, determinant))
    louder = np.maximum(e2 / count, 1.0) if held else np.ones(len(e2))
    residual = e2 / louder + count * np.log(louder)
    return {(int(i), int(j), held): float(x) for i, j, x in zip(*places, -0.5 * (residual + rest), strict=True)}


@dataclass(frozen=True, eq=False)
class Rows:
    """Frequency [rad/s], segment, its start time [s], and level of each real number of the stacked residual."""

    frequency: np.ndarray
    segment: np.ndarray
    when: np.ndarray
    level: np.ndarray


def row_table(fitted: Fitted, data: Data) -> Rows:
    """Frequency, segment, time and level of the residual of a fit to these data."""
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for block, level in zip(data.blocks, data.levels, strict=True):
        segment, when = fitted.model.lines.of_lines(block.name)
        for column, values in zip(columns, (block.omega, segment, when, np.full(len(when), level)), strict=True):
            column.append(np.tile(np.repeat(values, block.Y.shape[1]), 2))
    return Rows(*(np.concatenate(column) for column in columns))


def parts(fitted: Fitted, names: Sequence[str]) -> list[tuple[str, np.ndarray]]:
    """Halves of the data by band, time and level, each with half of the information on the given parameters."""
    rows = row_table(fitted, fitted.model.lines.fitted)
    information = np.sum(fitted.J[[fitted.priors.names.index(name) for name in names]] ** 2, axis=0)
    found = []
    for values, words in (
        (rows.frequency, ("the lower part of the band", "the upper part of the band")),
        (rows.when, ("the first half of the record", "the second half of the record")),
        (rows.level, ("low levels", "high levels")),
    ):
        order = np.argsort(values, kind="stable")
        middle = values[order][np.searchsorted(np.cumsum(information[order]), information.sum() / 2)]
        below = values <= middle
        if below.any() and not below.all():
            found += [(words[0], np.flatnonzero(below)), (words[1], np.flatnonzero(~below))]
    return found


def robust(fitted: Fitted) -> np.ndarray:
    """Covariance of all parameter values, with the scores summed over each segment (K. Liang, S. Zeger, Biometrika 73
    (1986) 13), which allows any correlation within a segment. No variance is below that of the fit."""
    segment, slope = row_table(fitted, fitted.model.lines.fitted).segment, fitted.priors.slopes(fitted.z)
    groups = np.unique(segment)
    scores = np.array(
        [fitted.J[:, segment == one] @ fitted.e[segment == one] - fitted.z / len(groups) for one in groups]
    )
    P, few = fitted.covariance, len(groups) / max(len(groups) - 1, 1)
    return not_below(few * P @ (scores.T @ scores) @ P, P) * np.outer(slope, slope)
