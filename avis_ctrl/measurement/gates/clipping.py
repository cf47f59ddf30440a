"""Gates for samples that the converter could not show: clipping and over-range levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import (
    FALSE_ALARM,
    Expectation,
    Finding,
    Limit,
    Picture,
    Series,
    Severity,
    thinned,
)

# A noise-free sine's top code is hit up to 2.42 times as often as the next one.
SINE_TOP = 2.42
# An over-range level: its spread is at most this part of the jump into it.
LEVEL_SPREAD = 0.05
# ... and the jump at least so many times the median change over two samples.
UNUSUAL = 10.0


@dataclass(frozen=True, eq=False)
class _Ends:
    """How one channel of a record ends: samples `count` at `value`, why they count as clipped, and some time signal."""

    record: str
    channel: str
    samples: int
    peak: float
    count: int = 0
    value: float = 0.0
    why: str = ""
    p: float = 1.0
    bursts: int = 0
    t: np.ndarray | None = None
    x: np.ndarray | None = None


class Clipping(Gate):
    """Flat tops.

    At a known range: samples within half a step of its ends; none are expected, so that two together or three in all
    are
    an alarm. At an unknown range: the extreme value comes more often than a sine's top would (2.42 times as often
    as any of the next five values), by a binomial test at 1 % shared over ends, channels and records; it needs
    about 50 clipped samples. And, in either case, levels outside the signal: runs entered and left by jumps of opposite
    sign,
    larger than 20 times the spread within, at the record's very end of range (an instrument's "out of range" output);
    3 samples suffice, an unclipped signal has no such runs.
    """

    name = "clipping"

    def look(self, seen: Excerpt, expectation: Expectation) -> list[_Ends]:
        h = seen.header
        u = np.concatenate([p.u for p in seen.pieces])
        y = np.concatenate([p.y for p in seen.pieces])
        t = np.concatenate([p.time for p in seen.pieces]) - h.start_s
        limit = expectation.drive_limit_V
        ends = []
        for k, name in enumerate(h.u_names):
            bounds = (-limit, limit) if limit else None
            ends.append(_ends(h.name, name, t, u[:, k], bounds, 2e-9 * limit if limit else None, free=False))
        for k, name in enumerate(h.y_names):
            ends.append(_ends(h.name, name, t, y[:, k], expectation.y_range_V, expectation.y_lsb_V, free=True))
        return ends

    def conclude(self, kept: list[list[_Ends]], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        rows = [row for rows in kept for row in rows]
        level = FALSE_ALARM / (2 * len(rows))
        found = [self._finding(row) for row in rows if row.count and row.p < level]
        if found:
            return found
        peaks = {n: max(r.peak for r in rows if r.channel == n) for n in (*campaign.u_names, *campaign.y_names)}
        top = max(peaks, key=lambda n: peaks[n])
        limits = () if expectation.y_range_V is None else (Limit("converter", expectation.y_range_V[1]),)
        x = np.arange(len(peaks))
        picture = Picture(
            "Largest absolute value of each channel",
            "channel number",
            f"largest value [{campaign.y_unit}]",
            (Series("peak", x, np.array(list(peaks.values())), "bars"),),
            limits,
        )
        return [
            Finding(
                self.name,
                "ok",
                f"No channel is clipped; the largest value is {peaks[top]:.4g} at {top!r}.",
                value=peaks[top],
                limit=None if not limits else limits[0].value,
                picture=picture,
            )
        ]

    def _finding(self, row: _Ends) -> Finding:
        part = row.count / row.samples
        severity: Severity = "note" if row.count < 2 else "stop" if part > 1e-3 else "warning"
        assert row.t is not None and row.x is not None
        t, x = thinned(row.t, row.x)
        picture = Picture(
            f"Record {row.record}, {row.channel}",
            "time [s]",
            row.channel,
            (Series(row.channel, t, x),),
            (Limit("clipped at", row.value),),
        )
        bursts = f" in {row.bursts} bursts" if row.bursts > 1 else ""
        sentence = (
            f"Channel {row.channel!r} of record {row.record} has {row.count} samples ({100 * part:.2g} %){bursts} at "
            f"{row.value:.6g}: {row.why}. Lower the level or the gain and repeat the record; until then leave it out."
        )
        return Finding(self.name, severity, sentence, (row.channel,), (row.record,), float(row.count), 0.0, picture)


def _ends(
    record: str,
    channel: str,
    t: np.ndarray,
    x: np.ndarray,
    bounds: tuple[float, float] | None,
    lsb: float | None,
    free: bool,
) -> _Ends:
    """Judge one channel; `free` looks for repeated extremes and over-range levels too."""
    peak = float(np.max(np.abs(x)))
    best = _Ends(record, channel, len(x), peak)
    if np.ptp(x) == 0:
        return best

    def made(mask: np.ndarray, value: float, why: str, p: float) -> _Ends:
        bursts = int(np.count_nonzero(np.diff(mask.astype(int)) == 1) + mask[0])
        middle = int(np.flatnonzero(mask)[0])
        part = slice(max(0, middle - 1000), middle + 1000)
        return _Ends(record, channel, len(x), peak, int(mask.sum()), value, why, p, bursts, t[part], x[part])

    if bounds is not None:
        margin = (lsb if lsb is not None else 1e-6 * (bounds[1] - bounds[0])) / 2
        at = (x >= bounds[1] - margin) | (x <= bounds[0] + margin)
        if at.any():
            value = float(x[at][0])
            what = "the end of its range, where flat tops hide the true signal"
            return made(at, value, what, 0.0 if at.sum() > 1 else 1.0)
    if not free:
        return best
    for sign in (1.0, -1.0):
        mask = over_range(sign * x)
        if mask.any():
            near = np.convolve(mask, np.ones(3), "same") > 0  # a sample may fall within a jump
            inside = sign * np.max(sign * x[~near]) if not near.all() else float("nan")
            return made(
                mask,
                float(np.median(x[mask])),
                "a level outside the signal, entered and left by jumps, as an "
                f"instrument gives when it is out of range (the rest of the record ends at {inside:.6g})",
                0.0,
            )
        if bounds is None and (p := repeated_extreme(sign * x)) < best.p:
            top = np.max(sign * x)
            best = made(
                sign * x == top,
                float(sign * top),
                "the largest value repeats far more often than the next ones, as at the end of a converter's range",
                p,
            )
    return best


def repeated_extreme(x: np.ndarray) -> float:
    """Chance that a sine's top or a noise's tail repeats the largest value so often; 1 where it does not repeat."""
    counts = np.unique(x, return_counts=True)[1]
    n, others = int(counts[-1]), int(counts[-6:-1].max(initial=0))
    if n < 5 or others == 0:
        return 1.0
    return float(stats.binom.sf(n - 1, n + others, SINE_TOP / (1 + SINE_TOP)))


def over_range(x: np.ndarray) -> np.ndarray:
    """(samples,) mask of runs at the top that are entered by a jump up and left by a jump down."""
    mask = np.zeros(len(x), bool)
    top, low = float(np.max(x)), float(np.min(x))
    if top == low:
        return mask
    usual = float(np.median(np.abs(x[2:] - x[:-2]))) if len(x) > 2 else 0.0
    near = np.concatenate([[False], x > top - LEVEL_SPREAD * (top - low), [False]])
    edges = np.flatnonzero(np.diff(near.astype(int)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        run = x[start:stop]
        if len(run) < 3 or start < 2 or stop > len(x) - 2:
            continue
        # One sample may fall within the jump itself.
        jump = min(run[0] - x[start - 2], run[-1] - x[min(stop + 1, len(x) - 1)])
        if (
            np.ptp(run) < LEVEL_SPREAD * jump
            and jump > max(0.2 * (top - low), UNUSUAL * usual)
            and np.ptp(x[start - 2 : start]) > 0
        ):
            mask[start:stop] = True
    return mask
