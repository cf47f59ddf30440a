"""Gate for spikes: single samples far outside what their neighbours lead to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import Expectation, Finding, Limit, Picture, Series, times

# Cubic through the two neighbours on either side: x0 - (4 (x-1 + x1) - (x-2 + x2)) / 6, and what a spike of 1 leaves.
SHAPE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6
# What a corner leaves: of a flat top, or of the signal's slope.
CORNER = np.array([0.0, -1.0, 2.0, -1.0, 0.0])


@dataclass(frozen=True)
class SpikeSettings:
    """factor : a spike over the median departure around it [1]: 13.5 standard deviations of Gaussian noise. Noise that
        grows with the signal, as of a real laser sensor, reaches 15 times.
    steps : a spike over the converter's step [1].
    around : samples over which the median departure is taken.
    left : departures left beside a spike once it is taken out, at most, by the spike [1].
    """

    factor: float = 20.0
    steps: float = 5.0
    around: int = 512
    left: float = 0.3


SETTINGS = SpikeSettings()


@dataclass(frozen=True, eq=False)
class _Kept:
    """Of one channel of a record: spikes, the largest one's sample, time s, value, what its neighbours lead to."""

    record: str
    channel: str
    count: int
    sample: int
    at_s: float
    value: float
    expected: float
    ratio: float
    t: np.ndarray
    x: np.ndarray


class Spikes(Gate):
    """Single samples away from the cubic through their four neighbours.

    The departure is compared with the median departure around, so that quiet and loud stretches are judged alike;
    chance never reaches the limit (1e-40 for each sample). A smooth signal leaves a small departure, one with power up
    to the Nyquist frequency a large one: the message states the least spike that would be found. Neighbours must fit
    the cubic once the sample is taken out, and better than a corner does, as of a flat top; steps, lost samples and
    runs of two or more are for other gates. The outer four samples of a piece are not judged.
    """

    name = "spikes"

    def look(self, seen: Excerpt, expectation: Expectation) -> tuple[list[_Kept], float]:
        found, least = [], 0.0
        for piece in seen.pieces:
            t = piece.time - seen.header.start_s
            for name, x in zip(seen.header.y_names, piece.y.T, strict=True):
                where, ratio, spread = spikes(x, expectation.y_lsb_V)
                least = max(least, float(np.max(spread, initial=0.0)))
                if len(where):
                    k = int(where[np.argmax(ratio)])
                    part = slice(max(0, k - 100), k + 100)
                    expected = float(x[k] - departure(x[k - 2 : k + 3])[0])
                    found.append(
                        _Kept(seen.header.name, name, len(where), k + round(float(t[0]) * seen.header.sample_rate_Hz),
                              float(t[k]), float(x[k]), expected, float(ratio.max()), t[part], x[part]))
        return found, least

    def conclude(self, kept: list[tuple[list[_Kept], float]], campaign: Campaign,
                 expectation: Expectation) -> list[Finding]:
        found = [self._finding(k, campaign.y_unit) for of, _ in kept for k in of]
        if found:
            return found
        least = np.array([SETTINGS.factor * one for _, one in kept])
        return [Finding(self.name, "ok",
                        f"No single sample differs from its neighbours; a spike of more than {least.max():.2g} "
                        f"{campaign.y_unit} would be found in every record.", value=float(least.max()),
                        picture=Picture("Smallest spike that would be found", "record", f"spike [{campaign.y_unit}]",
                                        (Series("least spike", np.arange(len(least)), least, "bars"),),
                                        x_names=tuple(r.header.name for r in campaign.records)))]

    def _finding(self, k: _Kept, unit: str) -> Finding:
        many = f"{k.count} single samples, the worst" if k.count > 1 else "a single sample"
        return Finding(self.name, "warning",
                       f"Channel {k.channel!r} of record {k.record} has {many} far from the neighbours, at "
                       f"{k.at_s:.6g} s (sample {k.sample}): {k.value:.4g} {unit}, while interpolation gives "
                       f"{k.expected:.4g}. The deviation is {times(k.ratio)} the usual one (limit {SETTINGS.factor:g}):"
                       " an electrical disturbance or a faulty conversion. Check cables and grounding; repeat the "
                       "record, or replace the sample by the interpolated value.", (k.channel,), (k.record,), k.ratio,
                       SETTINGS.factor,
                       Picture(f"Record {k.record}, {k.channel}", "time [s]", f"{k.channel} [{unit}]",
                               (Series(k.channel, k.t, k.x),), (Limit("spike", k.at_s, "x"),)))


def spikes(x: np.ndarray, lsb: float | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples (m,) that are spikes, their departure by the median one around (m,), and that median (blocks,)."""
    if len(x) < 16 or np.ptp(x) == 0:
        return np.zeros(0, int), np.zeros(0), np.zeros(0)
    r = np.concatenate([np.zeros(2), departure(x), np.zeros(2)])
    if lsb is None:
        lsb = float(np.min(np.diff(np.unique(x[: 1 << 14])), initial=np.inf))
        lsb = lsb if np.isfinite(lsb) else 0.0
    floor = SETTINGS.steps * lsb / SETTINGS.factor + 1e-12 * float(np.max(np.abs(x)))
    blocks = np.array_split(np.abs(r), max(1, len(r) // SETTINGS.around))
    spread = np.maximum([np.median(block) for block in blocks], floor)
    # A stretch that has just become loud is judged by itself and by its neighbours.
    wide = np.max([spread, np.append(spread[1:], 0), np.append(0, spread[:-1])], axis=0)
    ratio = np.abs(r) / np.repeat(wide, [len(block) for block in blocks])
    near = np.flatnonzero(ratio > SETTINGS.factor)
    single = []
    for k in near[(near >= 4) & (near < len(x) - 4)]:
        here = r[k - 2 : k + 3]
        left = here - r[k] * SHAPE
        largest = abs(r[k]) >= np.max(np.abs(here))
        if largest and np.max(np.abs(left)) < SETTINGS.left * abs(r[k]) and np.sum(left**2) < jump_corner(here):
            single.append(int(k))
    return np.array(single, int), ratio[single], spread


def jump_corner(here: np.ndarray) -> float:
    """Sum of squares that the best corner leaves of five departures: at the middle sample or between it and another."""
    trials = [np.column_stack([CORNER, np.roll(CORNER, shift)]) for shift in (-1, 1)]
    sums = []
    for A in trials:
        c = np.linalg.lstsq(A, here, rcond=None)[0]
        if c[0] * c[1] < 0:  # opposite corners are no corner
            c = np.array([CORNER @ here / (CORNER @ CORNER), 0.0])
        sums.append(float(np.sum((here - A @ c) ** 2)))
    return min(sums)


def departure(x: np.ndarray) -> np.ndarray:
    """(n - 4,) of each sample from the cubic through its two neighbours on either side."""
    return np.convolve(x, SHAPE, "valid")

