"""Rates of the scorer: Wilson's interval, reliability of probabilities, Brier and logarithmic scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import norm

# Edges of the reliability table: finer where a finder that is sure of itself has its answers.
EDGES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
# A probability of 1 that turns out wrong would make the logarithmic score infinite, whatever the other answers.
CLIP = 1e-6


def wilson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's interval of a share (JASA 22, 1927, p. 209); (0, 1) without a trial."""
    if trials == 0:
        return 0.0, 1.0
    z, p = float(norm.ppf((1 + level) / 2)), hits / trials
    middle, half = p + z**2 / (2 * trials), z * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    low, high = (middle - half) / (1 + z**2 / trials), (middle + half) / (1 + z**2 / trials)
    return float(max(low, 0.0)), float(min(high, 1.0))


@dataclass(frozen=True)
class Share:
    """hits of trials."""

    hits: int
    trials: int

    @classmethod
    def of(cls, answers: Sequence[bool]) -> Share:
        return cls(sum(map(bool, answers)), len(answers))

    @property
    def value(self) -> float:
        return self.hits / self.trials if self.trials else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        return wilson(self.hits, self.trials)

    def __str__(self) -> str:
        if not self.trials:
            return "no case"
        low, high = self.interval
        return f"{100 * self.value:.1f} % ({self.hits}/{self.trials}; {100 * low:.1f} to {100 * high:.1f} %)"


@dataclass(frozen=True)
class Bin:
    """Answers with a probability in [low, high), the last bin with its upper end."""

    low: float
    high: float
    mean: float
    right: Share


def reliability(probabilities: Sequence[float], right: Sequence[bool], edges: Sequence[float] = EDGES) -> list[Bin]:
    """Bins that hold an answer, with the mean probability claimed and the share that was right."""
    p, o = np.asarray(probabilities, float), np.asarray(right, bool)
    found = []
    for low, high in pairwise(edges):
        inside = (p >= low) & ((p < high) | ((high == edges[-1]) & (p <= high)))
        if inside.any():
            found.append(Bin(low, high, float(p[inside].mean()), Share.of(o[inside].tolist())))
    return found


def brier(probabilities: Sequence[float], right: Sequence[bool]) -> float:
    """Mean squared difference of probability and outcome (Brier, Monthly Weather Review 78, 1950): 0 is perfect."""
    return float(np.mean((np.asarray(probabilities, float) - np.asarray(right, float)) ** 2))


def log_score(probabilities: Sequence[float], right: Sequence[bool]) -> float:
    """Mean of -log of the probability given to what happened [nat]; probabilities within CLIP of 0 and 1 are clipped.

    Good, J. Royal Statistical Society B 14 (1952), p. 107.
    """
    p = np.clip(np.asarray(probabilities, float), CLIP, 1 - CLIP)
    return float(-np.mean(np.log(np.where(np.asarray(right, bool), p, 1 - p))))
