"""Gate for lost or repeated samples, and for records with contradictory clocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import RecordHeader
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate, once
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Series
from avis_ctrl.measurement.gates.h1 import H1, Samples, Spectra, h1


@dataclass(frozen=True)
class MissingSamplesSettings:
    """block_rows : rows of the shortest repeated block, equal in every channel: with noise in one channel this is no
        coincidence.
    periodic : minimum fraction of a record's rows that equal earlier rows for the record to be periodic as a whole: two
        periods give a half.
    jump_samples : minimum step of the delay: only whole samples are lost.
    longest_samples : maximum delay in the search, in either direction, and maximum step: segments without a clear delay
        scatter over the whole range of the search.
    explains : minimum decrease of the residual's mean logarithm when the step is undone: a tenth of its power. Steps
        caused by a delay of the model that varies with frequency increase it when undone.
    both_sides : minimum ratio of a line's mean drive powers before and after the step, the smaller to the larger, for
        the line to show the step: on one side alone it cannot be distinguished from the phase of the response.
    showing : minimum fraction of all lines that must show a step. A swept sine drives each line once: only the few
        lines around the instant are driven on both sides, and each of them only for a moment.
    overlap : variance of a mean or a slope over half-overlapping Hann segments, relative to independent ones.
    """

    block_rows: int = 16
    periodic: float = 0.4
    jump_samples: float = 0.5
    longest_samples: int = 64
    explains: float = 0.1
    both_sides: float = 0.1
    showing: float = 0.5
    overlap: float = 1.5


SETTINGS = MissingSamplesSettings()


@dataclass(frozen=True, eq=False)
class _Kept:
    """found : findings on rows that are repeated or missing; t, delay : as of `delays`, with its picture; stepped : the
    delays with a step.
    """

    header: RecordHeader
    found: list[Finding]
    t: np.ndarray
    delay: np.ndarray
    picture: Picture
    stepped: list[np.ndarray]


class MissingSamples(Gate):
    """Lost samples, repeated blocks, overlapping records.

    Lost samples shift y against the commanded u. In each segment the delay of y behind H1 u is fitted to the phase of
    the driven lines, weighted by the residual. The largest step between the medians of the segments before and after
    any instant is tested (Student's t with the scatter of the few segments, 1 % divided among instants, records and the
    three estimates of H1). The step must also explain the record. A steadily growing delay is not a step. In a swept
    sine the delay changes with frequency, and thus with time, so no steps are reported.

    If samples were lost from u and y together, a periodic u shows it: each period is compared with the first by
    circular correlation, which is exact, because u is commanded. A repeated block consists of rows that equal earlier
    rows in every channel of y, not a whole number of periods away.
    """

    name = "missing samples"

    def look(self, seen: Excerpt) -> _Kept:
        t, delay = delays(seen)
        stepped = [
            one
            for one in delay
            if (step := delay_step(one, FINDING.false_alarm)) is not None
            and SETTINGS.jump_samples < abs(step[1]) <= SETTINGS.longest_samples
            and not drifts(one, step[0])
            and explained(seen, t, *step) > SETTINGS.explains
        ]
        picture = Picture(
            f"Record {seen.header.name}: delay of y behind the response to u",
            "time [s]",
            "delay [samples]",
            (Series("delay", t - seen.header.start_s, delay[0], "points"),),
            (Limit("half a sample", SETTINGS.jump_samples), Limit("half a sample", -SETTINGS.jump_samples)),
        )
        return _Kept(seen.header, list(self._rows(seen, picture)), t, delay, picture, stepped)

    def conclude(self, kept: list[_Kept]) -> list[Finding]:
        level = FINDING.false_alarm / max(1, sum(k.delay.size for k in kept))
        found = [*self._overlaps(kept), *(f for k in kept for f in (*k.found, *self._steps(k, level)))]
        longest = max(kept, key=lambda k: len(k.t))
        comparable = [k for k in kept if len(k.t) > 3 and np.std(k.delay[0]) < SETTINGS.jump_samples]
        vague = sum(len(k.t) > 3 for k in kept) - len(comparable)
        scatter = float(max((np.std(k.delay[0]) for k in comparable), default=np.nan))
        said = f"; the delay scatters by at most {scatter:.2g} samples r.m.s." if comparable else ""
        said += f"; in {vague} the correlation of y with u is too low for this check" if vague else ""
        sentence = (
            f"No lost or repeated samples were found ({len(comparable)} of {len(kept)} records could be compared with "
            f"a moving commanded voltage{said})."
        )
        value, limit = scatter if comparable else None, SETTINGS.jump_samples
        return found or [Finding(self.name, "ok", sentence, value=value, limit=limit, picture=longest.picture)]

    def _rows(self, seen: Excerpt, picture: Picture) -> Iterator[Finding]:
        """Findings on rows of one record that are repeated, or missing in u and y together."""
        rate, name, clock = seen.header.sample_rate_Hz, seen.header.name, _clock(seen)
        if block := repeated_block(seen.first.y, seen.header.period_samples):
            at, back, n = block
            sentence = (
                f"Record {name} repeats {n} rows at {at / rate:.5g} s that it already had {back} samples before: a "
                "buffer was written twice. Repeat the record."
            )
            if n > SETTINGS.periodic * len(seen.first.y):
                sentence = (
                    f"The measured channels of record {name} repeat exactly after {back} samples. No measured signal "
                    "does: u and y are exchanged, or the records are simulated without noise and lack their period."
                )
            yield Finding(self.name, "stop", sentence, (), (name,), n, SETTINGS.block_rows, picture)
        if clock.any():
            p = int(np.flatnonzero(clock)[0])
            # Within the period of the loss the correlation shows only part of the shift.
            shift = float(clock[-1] or clock[p])
            sentence = (
                f"The commanded voltage of record {name} is {abs(shift):g} samples off its period of "
                f"{seen.header.period_s:g} s from period {p + 1} on: rows are missing or doubled, or the stated period "
                "is wrong. Check period_s, or repeat the record."
            )
            yield Finding(self.name, "stop", sentence, (), (name,), shift, 0.0, picture)

    def _steps(self, k: _Kept, level: float) -> Iterator[Finding]:
        """The largest significant step of the delay."""
        steps = [step for one in k.stepped if (step := delay_step(one, level)) is not None]
        at, size = max(steps, key=lambda step: abs(step[1]), default=(0, 0.0))
        if abs(size) > SETTINGS.jump_samples:
            change, what = ("shorter", "lost") if size < 0 else ("longer", "doubled")
            sentence = (
                f"In record {k.header.name} the delay of the measured channels after the commanded voltage becomes "
                f"{abs(size):.1f} samples {change} at about {k.t[at] - k.header.start_s:.4g} s: about "
                f"{max(1, round(abs(size)))} samples were {what}. Repeat the record, or use only the part before."
            )
            yield Finding(self.name, "stop", sentence, (), (k.header.name,), size, SETTINGS.jump_samples, k.picture)

    def _overlaps(self, kept: list[_Kept]) -> list[Finding]:
        if len({k.header.start_s for k in kept}) == 1:
            return []
        found = []
        for a, b in pairwise(sorted(kept, key=lambda k: k.header.start_s)):
            end, start = a.header.start_s + a.header.duration_s, b.header.start_s
            if start < end - 1.5 / a.header.sample_rate_Hz:
                sentence = (
                    f"Record {b.header.name} starts at {start:.6g} s, before record {a.header.name} ends at {end:.6g} "
                    "s: the clocks or the sample rate are wrong. Check start_s and sample_rate_Hz."
                )
                records = a.header.name, b.header.name
                found.append(Finding(self.name, "warning", sentence, (), records, start - end, 0.0, a.picture))
        return found[:3]


def is_step(finding: Finding) -> bool:
    """Whether a finding reports a step of the delay."""
    return finding.gate == MissingSamples.name and finding.limit == SETTINGS.jump_samples


@once
def delays(seen: Excerpt) -> tuple[np.ndarray, np.ndarray]:
    """t (K,) s of the segments' centres, and delay (up to 3, K) in samples of y behind H1 u, with H1 from all segments,
    the first half and the second half.

    A step in the record corrupts the H1 of all segments, but at least one half is free of it.
    """
    if not seen.driven or seen.header.excitation == "sine":
        return np.zeros(0), np.zeros((1, 0))
    rate = seen.header.sample_rate_Hz
    of = spectra_from_beginning(seen)
    half = len(of.U) // 2
    parts = [of, Spectra(of.f, of.U[:half], of.Y[:half]), Spectra(of.f, of.U[half:], of.Y[half:])]
    estimates = [e for part in parts if (e := h1([part])) is not None]
    if not estimates:
        return np.zeros(0), np.zeros((1, 0))
    # A segment lasts 1 / of.f[1] seconds; the next one starts after half of it.
    t = seen.first.header.start_s + (np.arange(len(of.U)) + 1) / (2 * of.f[1])
    return t, np.array([_delay(of, estimate, rate) for estimate in estimates])


def _beginning(seen: Excerpt) -> Samples:
    return Samples(seen.first.u[: 1 << 17], seen.first.y[: 1 << 17], seen.header.sample_rate_Hz)


@once
def spectra_from_beginning(seen: Excerpt) -> Spectra:
    """Spectra of successive segments, without averaging over periods."""
    return _beginning(seen).spectra()


def _delay(of: Spectra, estimate: H1, rate: float) -> np.ndarray:
    """(K,) delay in samples of each segment of y behind H1 u."""
    keep = np.isin(of.f, estimate.f)
    expected = np.moveaxis(np.moveaxis(of.U[:, keep], 0, 1) @ np.swapaxes(estimate.G, 1, 2), 0, 1)
    cross = of.Y[:, keep] * expected.conj() / np.maximum(estimate.noise, 1e-300)
    weight = (expected.real**2 + expected.imag**2) / np.maximum(estimate.noise, 1e-300)
    omega = 2 * np.pi * estimate.f[None, :, None] / rate
    # Gauss-Newton on sum weight |Y / expected - exp(-j omega d)|^2, initialised at the best whole number of samples.
    scan = np.arange(-SETTINGS.longest_samples, SETTINGS.longest_samples + 1)
    summed = np.sum(cross, axis=2)
    power = np.real(summed @ np.exp(1j * omega[0] * scan))
    d = scan[np.argmax(power, axis=1)].astype(float)
    for _ in range(4):
        turned = summed * np.exp(1j * omega[..., 0] * d[:, None])
        d = d - np.sum(omega[..., 0] * turned.imag, axis=1) / np.maximum(np.sum(omega**2 * weight, axis=(1, 2)), 1e-300)
    return np.asarray(d)


def explained(seen: Excerpt, t: np.ndarray, where: int, size: float) -> float:
    """Decrease of the H1 residual when a step of the delay is undone: mean logarithm over lines and channels.

    The step has `size` samples, at t[where] or half a segment before or after; rows are inserted or removed. Only lines
    that are driven before and after it count (`both_sides` of the settings); if these are too few (`showing`), the
    result is -inf.
    """
    rate, count = seen.header.sample_rate_Hz, max(1, round(abs(size)))
    samples = _beginning(seen)
    y, of = samples.y, spectra_from_beginning(seen)
    before, showing = h1([of]), of.f[driven_on_both_sides(of, where)]
    most = -np.inf
    for instant in t[max(0, where - 1) : where + 2] - seen.first.header.start_s:
        at = min(max(round(instant * rate), 0), len(y) - count - 1)
        if size < 0:
            whole = np.concatenate([y[:at], np.repeat(y[at : at + 1], count, axis=0), y[at:]])[: len(y)]
        else:
            whole = np.concatenate([y[:at], y[at + count :], np.repeat(y[-1:], count, axis=0)])
        after = h1([replace(samples, y=whole).spectra()])
        if before is not None and after is not None:
            f = np.intersect1d(showing, np.intersect1d(before.f, after.f))
            if f.size > SETTINGS.showing * before.f.size:
                noise, left = (np.maximum(one.noise[..., np.isin(one.f, f), :], 1e-300) for one in (before, after))
                most = max(most, float(np.mean(np.log(noise / left))))
    return most


def driven_on_both_sides(of: Spectra, where: int) -> np.ndarray:
    """(n,) mask of the lines with similar drive power before and after segment `where` (`both_sides` of the
    settings)."""
    power = np.sum(np.abs(of.U) ** 2, axis=2)
    first, second = power[:where].mean(axis=0), power[where:].mean(axis=0)
    return np.asarray(np.minimum(first, second) > SETTINGS.both_sides * np.maximum(first, second))


def delay_step(delay: np.ndarray, level: float) -> tuple[int, float] | None:
    """(index, size in samples) of the most significant step of the delay; None if no step is significant."""
    n = len(delay)
    best: tuple[float, int, float] | None = None
    for k in range(2, n - 1):
        a, b = delay[:k], delay[k:]
        # Medians: the first segment contains the transient, and the segment across the step belongs to neither side.
        size = float(np.median(b) - np.median(a))
        scatter = 1.4826 * np.concatenate([np.abs(a - np.median(a)), np.abs(b - np.median(b))])
        sigma = max(float(np.median(scatter)), 1e-6)
        # 1.57: variance of a median over that of a mean.
        t = abs(size) / (sigma * np.sqrt(1.57 * SETTINGS.overlap * (1 / len(a) + 1 / len(b))))
        if best is None or t > best[0]:
            best = float(t), k, size
    if best is None or 2 * stats.t.sf(best[0], max(n // 2 - 2, 2)) > level:
        return None
    return best[1], best[2]


def drifts(delay: np.ndarray, where: int) -> bool:
    """Whether a straight line fits the delay better than a step at `where`: two different clocks, not lost samples."""
    x = np.arange(len(delay))
    line = delay - np.polyval(np.polyfit(x, delay, 1), x)
    step = delay - np.where(x < where, np.median(delay[:where]), np.median(delay[where:]))
    return float(np.median(np.abs(line))) < float(np.median(np.abs(step)))


def repeated_block(y: np.ndarray, period: int | None) -> tuple[int, int, int] | None:
    """(start, distance back, rows) of the longest block equal to earlier rows; None if there is none."""
    moving, rows = np.ptp(y, axis=0) > 0, SETTINGS.block_rows
    if not moving.any() or len(y) < 2 * rows:
        return None
    _, codes = np.unique(
        np.ascontiguousarray(y[:, moving]).view(np.dtype((np.void, 8 * int(moving.sum())))).ravel(), return_inverse=True
    )
    changed = np.concatenate([[True], np.diff(codes) != 0])
    factors = np.random.default_rng(0).integers(1, 1 << 62, rows, dtype=np.int64) | 1
    windows = np.lib.stride_tricks.sliding_window_view(codes.astype(np.int64), rows)
    hashed = sum(windows[:, k] * factors[k] for k in range(rows))
    order = np.argsort(hashed, kind="stable")
    same = np.flatnonzero(np.diff(hashed[order]) == 0)
    later, back = order[same + 1], order[same + 1] - order[same]
    # Constant rows are left to the dead-channel gate.
    lively = np.lib.stride_tricks.sliding_window_view(changed, rows).sum(axis=1)[later] > rows // 2
    if period:
        lively &= back % period != 0
    if not lively.any():
        return None
    later, back = later[lively], back[lively]
    lag = int(np.bincount(back).argmax())
    where = np.sort(later[back == lag])
    return int(where[0]), lag, int(len(where) + rows - 1)


def _clock(seen: Excerpt) -> np.ndarray:
    """(periods,) shift in samples of each period of u against the first; empty if u is not periodic."""
    if not seen.periodic or not seen.driven:
        return np.zeros(0)
    u = seen.periods("u")
    if np.allclose(u, u[:1], rtol=0, atol=1e-6 * np.max(np.abs(u))):
        return np.zeros(len(u))
    U = np.fft.rfft(u, axis=1)
    c = np.fft.irfft(np.sum(U * U[:1].conj(), axis=2), u.shape[1], axis=1)
    shift = np.argmax(c, axis=1)
    return np.where(shift > u.shape[1] // 2, shift - u.shape[1], shift).astype(float)
