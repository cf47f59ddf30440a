"""Gate for samples that the converter could not represent: clipping and over-range levels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import stats

from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Severity, bars, quoted, samples_over_time

# The top code of a noise-free sine occurs up to 2.42 times as often as the next code.
SINE_TOP = 2.42


@dataclass(frozen=True)
class ClippingSettings:
    """flatter : ratio of samples at the top to samples at the next values, below which nothing is concluded [1]: tops
        that are flatter than a sine's, such as those of two tones, reach 5.3 (fourth order).
    steps : minimum number of different values of the signal; noise at rest with a few codes has no tops.
    widths : widths of the top relative to the signal's range, besides the value itself [1]: noise added after the
        clipping rounds a flat top.
    wrong_unit : fraction of samples at or beyond the range above which the unit is wrong [1].
    level_spread : maximum spread of an over-range level, relative to the jump into it [1].
    unusual : minimum ratio of this jump to the median change over two samples [1].
    """

    flatter: float = 8.0
    steps: int = 20
    widths: tuple[float, ...] = (1 / 4096, 1 / 1024, 1 / 256, 1 / 64)
    wrong_unit: float = 0.5
    level_spread: float = 0.05
    unusual: float = 10.0


SETTINGS = ClippingSettings()


@dataclass(frozen=True, eq=False)
class _Ends:
    """Extremes of one channel of a record: `count` samples at `value`, the reason, and t [s] and x around the first."""

    record: str
    channel: str
    samples: int
    peak: float
    count: int = 0
    value: float = 0.0
    why: str = ""
    p: float = 1.0
    bursts: int = 0
    trace: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))
    unit: bool = False


class Clipping(Gate):
    """Flat tops and over-range levels.

    At a known range: samples within half a step of its ends. None are expected, so two of them raise an alarm. If more
    than half of all samples lie there, the cause is not clipping but a wrong unit or scale.
    At any range, also below its known end (as with a saturating preamplifier): `repeated_extreme`, a binomial test at
    1 %, divided among ends, channels and records. It needs about 40 samples at one end, 8 for each period of a periodic
    record, and a level that is flat within 1/64 of the signal's range; a single clipped peak is not detected. Simulated
    campaigns (tests/measurement/gates_rig.py, 20 of multisines, 20 of noise) gave no false alarm. In records of 24000
    to 40000 samples, clipped at both ends at 80 to 98 % of the peak, clipping was always found from 82 samples on.
    Levels outside the signal: runs that are entered and left by jumps of opposite sign, larger than 20 times the spread
    within the run, at the very end of the record's range (an instrument's "out of range" output). Three samples
    suffice; an unclipped signal has no such runs.
    """

    name = "clipping"

    def look(self, seen: Excerpt) -> list[_Ends]:
        h = seen.header
        u = np.concatenate([p.u for p in seen.pieces])
        y = np.concatenate([p.y for p in seen.pieces])
        t = np.concatenate([p.time for p in seen.pieces]) - h.start_s
        periods, ends = max(1, h.periods), []
        for k, name in enumerate(h.u_names):
            limit = self.expectation.drive_limits_V.get(name)
            bounds = (-limit, limit) if limit else None
            ends.append(_ends(h.name, name, t, u[:, k], bounds, 2e-9 * limit if limit else None, free=False))
        for k, name in enumerate(h.y_names):
            ends.append(
                _ends(h.name, name, t, y[:, k], self.expectation.y_range_V, self.expectation.y_lsb_V, True, periods)
            )
        return ends

    def conclude(self, kept: list[list[_Ends]]) -> list[Finding]:
        rows = [row for rows in kept for row in rows]
        level = FINDING.false_alarm / (2 * len(rows))
        wrong = [row for row in rows if row.unit]
        names = tuple(dict.fromkeys(row.channel for row in wrong))
        found = [self._unit(wrong, names)] if wrong else []
        bad = [row for row in rows if row.count and row.p < level and row.channel not in names]
        found += [
            self._finding([row for row in bad if row.channel == channel])
            for channel in dict.fromkeys(row.channel for row in bad)
        ]
        u_names, y_names = self.campaign.u_names, self.campaign.y_names
        peaks = {n: max(r.peak for r in rows if r.channel == n) for n in (*u_names, *y_names)}
        u_unit, y_unit = self.campaign.records[0].header.u_unit, self.campaign.y_unit
        u_top, y_top = max(u_names, key=lambda n: peaks[n]), max(y_names, key=lambda n: peaks[n])
        end = None if self.expectation.y_range_V is None else self.expectation.y_range_V[1]
        limits = () if end is None else (Limit("converter", end),)
        unit = y_unit if u_unit == y_unit else f"drives: {u_unit}, sensors: {y_unit}"
        picture = bars("Largest absolute value of each channel", "channel", f"largest value [{unit}]", peaks, limits)
        sentence = (
            f"No channel is clipped; the largest values are {peaks[u_top]:.4g} {u_unit} at drive {u_top!r} and "
            f"{peaks[y_top]:.4g} {y_unit} at sensor {y_top!r}."
        )
        return found or [Finding(self.name, "ok", sentence, value=peaks[y_top], limit=end, picture=picture)]

    def _unit(self, rows: list[_Ends], names: tuple[str, ...]) -> Finding:
        """Finding for records with most samples at or beyond the range."""
        row, unit = max(rows, key=lambda r: r.count), self.campaign.y_unit
        assert self.expectation.y_range_V is not None
        end, part = self.expectation.y_range_V[1], row.count / row.samples
        sentence = (
            f"{100 * part:.0f} % of the samples of channel {row.channel!r} of record {row.record} are at or beyond the "
            f"converter's range, which ends at {end:.6g} {unit}; the largest is {row.peak:.6g}. Channels concerned: "
            f"{quoted(names)}. The unit or scale is probably wrong (mV given as {unit}?), or the range in the rig "
            "file. Correct it first; only then can clipping be checked."
        )
        records = tuple(dict.fromkeys(r.record for r in rows))
        picture = samples_over_time(row.record, row.channel, *row.trace, unit, (Limit("converter", end),))
        return Finding(self.name, "stop", sentence, names, records, part, SETTINGS.wrong_unit, picture)

    def _finding(self, of: list[_Ends]) -> Finding:
        """Finding for the records in which one channel is clipped."""
        row = max(of, key=lambda r: r.count)
        part = row.count / row.samples
        bursts = f" in {row.bursts} bursts" if row.bursts > 1 else ""
        others = [f"{r.record} ({r.count} samples at {r.value:.4g})" for r in of if r is not row]
        also = f" Also in record {', '.join(others)}." if others else ""
        sentence = (
            f"Channel {row.channel!r} of record {row.record} has {row.count} samples ({100 * part:.2g} %){bursts} at "
            f"{row.value:.6g}: {row.why}.{also} Lower the level or the gain and repeat the record; until then leave "
            "the record out."
        )
        severity: Severity = "stop" if part > 1e-3 else "warning"
        picture = samples_over_time(row.record, row.channel, *row.trace, limits=(Limit("clipped at", row.value),))
        records = tuple(r.record for r in of)
        return Finding(self.name, severity, sentence, (row.channel,), records, row.count, 0.0, picture)


def _ends(
    record: str,
    channel: str,
    t: np.ndarray,
    x: np.ndarray,
    bounds: tuple[float, float] | None,
    lsb: float | None,
    free: bool,
    periods: int = 1,
) -> _Ends:
    """Check one channel; `free` also searches for repeated extremes, over-range levels and a wrong unit."""
    peak = float(np.max(np.abs(x)))
    best = _Ends(record, channel, len(x), peak)
    if np.ptp(x) == 0:
        return best

    def made(mask: np.ndarray, value: float, why: str, p: float) -> _Ends:
        bursts = int(np.count_nonzero(np.diff(mask.astype(int)) == 1) + mask[0])
        middle = int(np.flatnonzero(mask)[0])
        part = slice(max(0, middle - 1000), middle + 1000)
        return _Ends(record, channel, len(x), peak, int(mask.sum()), value, why, p, bursts, (t[part], x[part]))

    if bounds is not None:
        margin = (lsb if lsb is not None else 1e-6 * (bounds[1] - bounds[0])) / 2
        at = (x >= bounds[1] - margin) | (x <= bounds[0] + margin)
        if at.any():
            value = float(x[at][0])
            if free and at.mean() > SETTINGS.wrong_unit:
                return replace(made(at, value, "", 0.0), unit=True)
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
                "a constant level outside the range of the signal, with jumps to and from it, as an instrument "
                f"outputs when it is out of range (the rest of the record reaches {inside:.6g})",
                0.0,
            )
        top, p, width = repeated_extreme(sign * x, periods)
        if p < best.p:
            flat = sign * x >= top - width
            opposite = float(np.max(-sign * x))
            both = abs(opposite - top) <= 0.01 * top  # a symmetric limit: its other end counts too
            if both:
                flat |= -sign * x >= opposite - width
            best = made(
                flat,
                float(sign * top),
                ("here and at the opposite value " if both else "")
                + "the extreme value repeats far more often than the next ones, a flat top as from a saturated"
                " converter or preamplifier" + (" below the end of the known range" if bounds is not None else ""),
                p,
            )
    return best


def repeated_extreme(x: np.ndarray, periods: int = 1) -> tuple[float, float, float]:
    """Largest value, probability that an unclipped signal repeats it so often, and width of the flat top.

    The number of samples at the top is compared with the largest number at one of the five next values, or in one of
    the bins of the same width below it. The top of a smooth signal is a parabola, for which the ratio is
    1 / (sqrt 2 - 1) = 2.42. Above a ratio of 8, which no smooth top reaches, the probability is that of the binomial
    distribution with 2.42 / 3.42, multiplied by the number of widths. A peak that recurs in every period counts once
    per period, so the count of the next values is at least `periods`.
    """
    values, counts = np.unique(x, return_counts=True)
    top, extent = float(values[-1]), float(values[-1] - values[0])
    none = top, 1.0, 0.0
    if len(values) <= SETTINGS.steps or top - np.median(x) < 0.1 * extent:
        return none
    step = float(np.min(np.diff(values)))
    trials = [(0.0, int(counts[-1]), int(counts[-6:-1].max()))]
    for part in SETTINGS.widths:
        width = part * extent
        if width > 2 * step:
            near = np.searchsorted(values, top - width * np.arange(7) - 1e-9 * extent)
            bins = [int(counts[low:high].sum()) for low, high in pairwise([*near[1:][::-1], len(values)])][::-1]
            trials.append((width, bins[0], max(bins[1:])))
    best = none
    for width, n, others in trials:
        others = max(others, periods)
        if n >= max(5.0, SETTINGS.flatter * others):
            p = len(trials) * float(stats.binom.sf(n - 1, n + others, SINE_TOP / (1 + SINE_TOP)))
            best = min(best, (top, p, width), key=lambda b: b[1])
            if p < FINDING.false_alarm / 1000:  # the narrowest significant width gives the best count
                break
    return best


def over_range(x: np.ndarray) -> np.ndarray:
    """(samples,) mask of runs at the top that are entered by an upward jump and left by a downward jump."""
    mask = np.zeros(len(x), bool)
    top, low = float(np.max(x)), float(np.min(x))
    if top == low:
        return mask
    usual = float(np.median(np.abs(x[2:] - x[:-2]))) if len(x) > 2 else 0.0
    near = np.concatenate([[False], x > top - SETTINGS.level_spread * (top - low), [False]])
    edges = np.flatnonzero(np.diff(near.astype(int)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        run = x[start:stop]
        if len(run) < 3 or start < 2 or stop > len(x) - 2:
            continue
        # One sample may fall within the jump itself.
        jump = min(run[0] - x[start - 2], run[-1] - x[min(stop + 1, len(x) - 1)])
        if (
            np.ptp(run) < SETTINGS.level_spread * jump
            and jump > max(0.2 * (top - low), SETTINGS.unusual * usual)
            and np.ptp(x[start - 2 : start]) > 0
        ):
            mask[start:stop] = True
    return mask
