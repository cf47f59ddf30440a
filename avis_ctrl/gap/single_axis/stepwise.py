"""Effects one by one: which candidate, how sure, and when to stop.

Posterior probabilities are stacking-free pseudo-BMA weights with the Bayesian bootstrap over blocks (Yao, Vehtari,
Simpson and Gelman, Bayesian Analysis 13 (2018) 917, section 3.4): with Dirichlet weights over the blocks, the softmax
of the summed log scores, averaged over draws. A candidate that wins by one lucky block alone gets no certainty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy import stats

from avis_ctrl.gap.single_axis.machine import (
    AxisProblem,
    Fitted,
    HeldOut,
    correlation_time,
    fit,
    held_out,
    held_out_refitted,
)
from avis_ctrl.gap.single_axis.settings import SETTINGS
from avis_ctrl.gap.single_axis.terms import Term

# Chance of naming something on data whose model is complete, over all candidates of a stage.
FALSE_ALARM = 0.01
# Candidates that together hold this probability are not told apart.
CREDIBLE = 0.95
# Halves may differ by this part of a value even where their deviations are smaller: re-identified parameters of one rig
# scatter as much (the contract's damping: +-20 %), and no physical law holds to a per cent on a real machine.
AGREEMENT = 0.2
# The contract: the gap is closed within 1.2 of the noise floor. Beyond the first effect, what moves the r.m.s. by less
# is as well an inexact shape of the effects that are named.
AT_THE_NOISE = 1.2
MOST_EFFECTS = 5
DRAWS = 2000
RIDGES = (1e-6, 1e-4, 1e-2, 1.0, 100.0)

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Candidate:
    """Terms added to a model, one or two: the fit, its held-out score, why they may not be named (empty: they may).

    probability : among the candidates and "nothing more"; candidates that predict the same share theirs.
    """

    terms: tuple[Term, ...]
    fitted: Fitted
    judged: HeldOut
    gain: float = 0.0
    probability: float = 0.0
    refused: str = ""

    @property
    def key(self) -> str:
        return " + ".join(term.key for term in self.terms)

    @property
    def name(self) -> str:
        return " + ".join(term.name for term in self.terms)

    def predicts_like(self, other: Candidate) -> bool:
        return bool(np.linalg.norm(self.judged.e - other.judged.e) < SETTINGS.same * np.linalg.norm(other.judged.e))


@dataclass(frozen=True, eq=False)
class Step:
    """A stage: the model kept, its held-out figures from refits, the candidates of this stage with the best first.

    named : the candidate that led here, None of the base. rivals : that share the credible set with it.
    """

    fitted: Fitted
    judged: HeldOut
    named: Candidate | None = None
    rivals: tuple[Candidate, ...] = ()
    candidates: tuple[Candidate, ...] = ()


def search(problem: AxisProblem, library: Sequence[Term], progress: Progress
           ) -> tuple[list[Step], tuple[Candidate, ...]]:
    """The ladder of stages, and the candidates of the stage at which nothing helped any more.

    Where no term alone may be named on the base, or none is more likely than not, pairs are tried: friction beside a
    constant force, neither of which shows as long as the other is missing.
    """
    progress("base model")
    base = fit(problem, (), np.array([p.start for p in problem.base]))
    steps = [Step(base, held_out_refitted(problem, base))]
    while len(steps) <= MOST_EFFECTS:
        candidates = _candidates(problem, steps, library, 1, progress)
        if all(c.refused for c in candidates) and (len(steps) == 1 or _unsure(candidates[0])):
            pairs = _candidates(problem, steps, library, 2, progress)
            candidates = pairs if any(not c.refused for c in pairs) else candidates
        accepted = [c for c in candidates if not c.refused]
        if not accepted:
            return steps, candidates
        best = accepted[0]
        rivals, held = [], best.probability
        for other in candidates:
            twin = other.predicts_like(best)
            if other is not best and other.probability > 0 and (twin or held < CREDIBLE):
                rivals.append(other)
                held += 0.0 if twin else other.probability
        progress(f"refit with {best.name}")
        steps.append(Step(best.fitted, held_out_refitted(problem, best.fitted), best, tuple(rivals), candidates))
    return steps, ()


def _candidates(problem: AxisProblem, steps: Sequence[Step], library: Sequence[Term], many: int, progress: Progress
                ) -> tuple[Candidate, ...]:
    """All sets of `many` terms that may be added, by probability; the first ones with their refusals."""
    now = steps[-1].fitted
    names = {term.name for term in now.terms}
    keys = {term.key for term in now.terms}
    sets = [terms for terms in combinations([term for term in library if term.key not in keys], many)
            if all(set(term.needs) <= names | {one.name for one in terms} for term in terms)]
    what = "candidates" if many == 1 else "pairs"
    progress(f"{len(sets)} {what} on top of {' + '.join(sorted(names)) or 'the base'}")
    found = [_added(problem, now, terms) for terms in sets]
    if not found:
        return ()
    current = held_out(problem, now)
    best = min(found, key=lambda c: float(np.sum((c.judged.e / now.sigma) ** 2)))
    # Nothing more against something: residuals as correlated as those of the present model. Among candidates, and for
    # pairs, which come where the present model is far off: as those of the best one, the noise if one of them is right.
    tau_best = correlation_time(problem, best.judged)
    tau_now = correlation_time(problem, current) if many == 1 else tau_best
    block = problem.block
    gain = np.array([c.judged.blocks(block, tau_now) - current.blocks(block, tau_now) for c in found])
    among = np.array([c.judged.blocks(block, tau_best) - best.judged.blocks(block, tau_best) for c in found])
    # The same weights for all candidates and all data, so that no verdict hangs on a draw.
    draws = np.random.default_rng(0).dirichlet(np.ones(gain.shape[1]), DRAWS) * gain.shape[1]
    sure = np.mean(draws @ gain.T > 0, axis=0)
    weight = _softmax(draws @ among.T).mean(axis=0)
    alike = np.array([[one.predicts_like(other) or one is other for other in found] for one in found], float)
    nothing = float(np.mean(1 / (1 + np.exp(np.clip((draws @ gain.T).max(axis=1), -500, 500)))))
    least = float(np.log(len(found) / FALSE_ALARM))
    judged = [Candidate(c.terms, c.fitted, c.judged, float(g.sum()), min(float(w) * (1 - nothing), SETTINGS.most_sure),
                        _too_small(float(g.sum()), float(s), least))
              for c, g, w, s in zip(found, gain, alike @ weight, sure, strict=True)]
    if now.terms:
        judged = [replace(c, refused=c.refused or _immaterial(current, c.judged)) for c in judged]
    judged.sort(key=_rank)
    return tuple(_checked(problem, _without_limits(judged, len(now.theta)), len(now.theta)))


def _added(problem: AxisProblem, now: Fitted, terms: tuple[Term, ...]) -> Candidate:
    fits = [fit(problem, (*now.terms, *terms), np.concatenate([now.theta, *starts]))
            for starts in product(*(term.starts(problem, now.e) for term in terms))]
    best = min(fits, key=lambda f: float(np.sum((f.e / now.sigma) ** 2)))
    return Candidate(terms, best, held_out(problem, best))


def _rank(c: Candidate) -> tuple[float, int, float]:
    """By probability in per cent; of those that predict the same, the one that needs no other."""
    return -round(c.probability, 2), sum(len(term.needs) for term in c.terms), -c.gain


def _unsure(leader: Candidate) -> str:
    return "" if leader.probability >= SETTINGS.headline else f"has a probability of {leader.probability:.2f} only"


def _softmax(x: np.ndarray) -> np.ndarray:
    y = np.exp(x - x.max(axis=1, keepdims=True))
    return y / y.sum(axis=1, keepdims=True)


def _too_small(gain: float, sure: float, least: float) -> str:
    """Likelihood ratio on unseen data: by Markov's inequality a complete model loses by log(1/alpha) with chance alpha
    at most; all candidates share alpha."""
    if gain < least:
        return f"gains {gain:.1f} in the held-out log likelihood, {least:.1f} are needed"
    if sure < 1 - FALSE_ALARM:
        return f"its gain hangs on few blocks: {100 * sure:.0f} % of their resamplings keep it"
    return ""


def _immaterial(current: HeldOut, judged: HeldOut) -> str:
    ratio = float(np.linalg.norm(current.e / current.sigma) / np.linalg.norm(judged.e / current.sigma))
    return "" if ratio >= AT_THE_NOISE else f"changes what is left by a factor of {ratio:.3g} only"


def _without_limits(candidates: list[Candidate], first: int) -> list[Candidate]:
    """A rival whose best parameters lie at the limit of what is physical is no rival; where the leader's do, nobody
    takes its place: the second best of a wrong explanation is no explanation."""
    limit = "a parameter ends at the limit of its physical range"
    ended = [c.fitted.at_bound(first) for c in candidates]
    if ended[0] and not candidates[0].refused:
        return [replace(c, refused=c.refused or (limit if end else "less probable than what leads"))
                for c, end in zip(candidates, ended, strict=True)]
    left = sum(c.probability for c, end in zip(candidates, ended, strict=True) if not end)
    whole = sum(c.probability for c in candidates)
    kept = [replace(c, probability=0.0 if end else min(c.probability * whole / max(left, 1e-300), SETTINGS.most_sure),
                    refused=c.refused or (limit if end else "")) for c, end in zip(candidates, ended, strict=True)]
    return sorted(kept, key=_rank)


def _checked(problem: AxisProblem, candidates: list[Candidate], first: int) -> list[Candidate]:
    """The leader must agree with itself; where it does not, no other takes its place."""
    leader = candidates[0]
    reason = leader.refused or _unsure(leader) or disagreement(problem, leader.fitted, first)
    return [replace(leader, refused=reason),
            *(replace(c, refused=c.refused or "less probable than what leads") for c in candidates[1:])]


def disagreement(problem: AxisProblem, found: Fitted, first: int) -> str:
    """In words, where a parameter from `first` on differs between halves of the data; empty where none does."""
    for name, one, other in problem.splits:
        halves = [fit(problem, found.terms, found.theta, np.isin(problem.block, part)) for part in (one, other)]
        dof = max(min(len(one), len(other)) - 1, 1)
        limit = float(stats.t.ppf(1 - FALSE_ALARM / 2, dof))
        for j in range(first, len(found.theta)):
            (a, va), (b, vb) = ((half.theta[j], half.covariance[j, j]) for half in halves)
            if abs(a - b) > limit * np.sqrt(va + vb) and abs(a - b) > AGREEMENT * abs(found.theta[j]):
                p = found.parameters[j]
                return f"{p.name} is {a:.4g} in one half and {b:.4g} {p.unit} in the other ({name})"
    return ""


def reference(problem: AxisProblem, found: Fitted, columns: np.ndarray) -> HeldOut:
    """The fitted model with regressors that have no physics; of several ridges the one that predicts best, which
    favours the reference and so the refusal."""
    tried = [held_out(problem, found, columns, ridge) for ridge in RIDGES]
    return max(tried, key=lambda judged: float(judged.score.sum()))
