"""Data for the gates: a record, or evenly spaced pieces of a record that is too long for memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, ClassVar, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader, RecordSource
from avis_ctrl.measurement.gates.finding import Expectation, Finding


@dataclass(frozen=True)
class ExcerptSettings:
    """longest : samples of a record that are examined at most: 8 MiB for each channel.
    pieces : number of pieces of a longer record: its start, its end, and two places between.
    """

    longest: int = 1 << 20
    pieces: int = 4


SETTINGS = ExcerptSettings()


@dataclass(frozen=True, eq=False)
class Excerpt:
    """A record's header with the loaded pieces; a short record is one piece."""

    header: RecordHeader
    pieces: tuple[Record, ...]

    @property
    def whole(self) -> bool:
        """Whether the pieces contain all samples of the record."""
        return sum(len(piece.y) for piece in self.pieces) == self.header.samples

    @property
    def first(self) -> Record:
        """First piece."""
        return self.pieces[0]

    @property
    def periodic(self) -> bool:
        """Whether the first piece contains at least two whole periods."""
        period = self.header.period_samples
        return period is not None and len(self.first.y) >= 2 * period

    @property
    def driven(self) -> bool:
        """Whether some commanded voltage moves."""
        return self.header.excitation not in ("rest", "floor") and any(np.ptp(p.u, axis=0).any() for p in self.pieces)

    def periods(self, what: str = "y") -> np.ndarray:
        """(periods, samples, channels) of u or y, over all pieces, without an incomplete last period of a piece."""
        length = self.header.period_samples or 0
        arrays = [getattr(piece, what) for piece in self.pieces]
        cut = [a[: len(a) // length * length].reshape(-1, length, a.shape[1]) for a in arrays]
        return np.concatenate(cut)


def excerpt(record: RecordSource, longest: int = SETTINGS.longest) -> Excerpt:
    """The record, or four evenly spaced pieces of at most `longest` samples in total, cut between periods; one piece if
    a period is longer than a quarter of `longest`.
    """
    samples, period = record.header.samples, record.header.period_samples or 1
    if samples <= longest:
        return Excerpt(record.header, (record.load(),))
    size = longest // SETTINGS.pieces
    if period > size:
        return Excerpt(record.header, (record.load(0, longest),))
    size = size // period * period
    starts = np.linspace(0, samples - size, SETTINGS.pieces).astype(int) // period * period
    return Excerpt(record.header, tuple(record.load(int(start), int(start) + size) for start in starts))


Result = TypeVar("Result")


def once(function: Callable[[Excerpt], Result]) -> Callable[[Excerpt], Result]:
    """The function, computed once for each excerpt: several gates need the same result."""
    known: WeakKeyDictionary[Excerpt, Result] = WeakKeyDictionary()

    @wraps(function)
    def of(seen: Excerpt) -> Result:
        if seen not in known:
            known[seen] = function(seen)
        return known[seen]

    return of


class Gate(ABC):
    """One check of a campaign: `look` at each record once, then `conclude`. expectation : what is known of the rig."""

    name: ClassVar[str]

    def __init__(self, campaign: Campaign, expectation: Expectation):
        self.campaign, self.expectation = campaign, expectation

    @abstractmethod
    def look(self, seen: Excerpt) -> Any:
        """What `conclude` needs of a record; small."""

    @abstractmethod
    def conclude(self, kept: list[Any]) -> list[Finding]:
        """At least one finding."""
