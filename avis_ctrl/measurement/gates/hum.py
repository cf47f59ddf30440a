"""Gate for mains hum: narrow lines at 50 or 60 Hz and their harmonics above the local noise floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Series, Severity, over_frequency
from avis_ctrl.measurement.gates.h1 import driven_lines

MAINS_HZ = (50.0, 60.0)


@dataclass(frozen=True)
class HumSettings:
    """harmonics : number of multiples of 50 and of 60 Hz that are tested.
    tolerance : maximum relative deviation of the mains frequency from its nominal value [1].
    reference, guard : bins on either side that give the floor, and bins left out next to those of the line.
    least_ratio : minimum ratio of a line's power to its floor [1]: floors are not quite flat.
    large : fraction of the channel's r.m.s. above which a line is a warning [1].
    """

    harmonics: int = 6
    tolerance: float = 0.004
    reference: int = 16
    guard: int = 3
    least_ratio: float = 3.0
    large: float = 0.01


SETTINGS = HumSettings()


@dataclass(frozen=True, eq=False)
class _Line:
    """A tested line: p-value of the F test, r.m.s. of the line, ratio of its power to the local floor."""

    channel: int
    mains_Hz: float
    at_Hz: float
    p: float
    ratio: float
    rms: float


@dataclass(frozen=True, eq=False)
class _Kept:
    record: str
    lines: list[_Line]
    passed_over: int
    rms: np.ndarray
    f: np.ndarray
    asd: np.ndarray


class Hum(Gate):
    """Narrow lines at k 50 Hz and k 60 Hz, k = 1 .. 6, within 0.4 %.

    Power spectra are means over K Hann segments without overlap (K from 4 to 32). The largest bin within the tolerance
    is compared with the reference bins on either side; the louder side is the floor. Their ratio is F(2K, 2 m K)
    distributed for m bins of a locally flat floor, so that 1 % divided among bins, lines, channels and records controls
    false alarms. Lines that the commanded u drives (bins with more than 1e-6 of the median power of its driven bins)
    belong to the experiment and are skipped. A large line is a warning, otherwise a note.
    """

    name = "hum"

    def look(self, seen: Excerpt) -> _Kept:
        h = seen.header
        y, u = seen.first.y, seen.first.u
        length = _length(len(y), h.sample_rate_Hz)
        f, P = signal.welch(y, h.sample_rate_Hz, "hann", length, 0, axis=0, detrend="linear")
        _, Pu = signal.welch(u, h.sample_rate_Hz, "hann", length, 0, axis=0)
        K = len(y) // length
        driven = _driven(Pu, h.excitation)
        lines, passed = [], 0
        for mains in MAINS_HZ:
            for k in range(1, SETTINGS.harmonics + 1):
                made = _tested(f, P, driven, k * mains, mains, K)
                lines += made or []
                passed += made is None
        return _Kept(h.name, lines, passed, y.std(axis=0), f, np.sqrt(P))

    def conclude(self, kept: list[_Kept]) -> list[Finding]:
        tested, passed = sum(len(k.lines) for k in kept), sum(k.passed_over for k in kept)
        hits: dict[tuple[int, float], list[tuple[_Kept, _Line]]] = {}
        for k in kept:
            for line in k.lines:
                if line.p < FINDING.false_alarm / tested and line.ratio > SETTINGS.least_ratio:
                    hits.setdefault((line.channel, line.mains_Hz), []).append((k, line))
        found = [self._finding(key[1], some) for key, some in sorted(hits.items()) if not _of_the_other(key, hits)]
        note = f"; {passed} lines are excited by u and were not tested" if passed else ""
        what = "No mains hum was found" if tested else "No line of the mains could be tested"
        sentence = f"{what} ({tested} tests of 50 and 60 Hz and harmonics{note})."
        picture = self._picture(kept[-1], 0, MAINS_HZ)
        return found or [Finding(self.name, "ok", sentence, limit=FINDING.false_alarm, picture=picture)]

    def _finding(self, mains: float, hits: list[tuple[_Kept, _Line]]) -> Finding:
        record, line = max(hits, key=lambda hit: hit[1].ratio)
        name, unit = self.campaign.y_names[line.channel], self.campaign.y_unit
        part = max(hit.rms / max(k.rms[hit.channel], 1e-300) for k, hit in hits)
        records = tuple(dict.fromkeys(k.record for k, _ in hits))
        at_Hz = [k * mains for k in sorted({round(hit.at_Hz / mains) for _, hit in hits})]
        sentence = (
            f"Channel {name!r} carries mains hum at {', '.join(f'{f:g}' for f in at_Hz)} Hz: at {line.at_Hz:.4g} Hz "
            f"{line.rms:.3g} {unit} r.m.s., {10 * np.log10(line.ratio):.0f} dB above the local floor, "
            f"{100 * part:.2g} % of the channel's r.m.s. (record {record.record}). Check grounding and shielding."
        )
        severity: Severity = "warning" if part > SETTINGS.large else "note"
        picture = self._picture(record, line.channel, at_Hz)
        return Finding(self.name, severity, sentence, (name,), records, line.ratio, SETTINGS.least_ratio, picture)

    def _picture(self, kept: _Kept, j: int, at_Hz: Sequence[float]) -> Picture:
        name = self.campaign.y_names[j]
        label = f"amplitude density [{self.campaign.y_unit}/√Hz]"
        series = Series(name, kept.f[1:], kept.asd[1:, j])
        limits = tuple(Limit(f"{f:g} Hz", f, "x") for f in at_Hz)
        return over_frequency(f"Record {kept.record}, {name}", label, (series,), limits)


def _of_the_other(key: tuple[int, float], hits: Mapping[tuple[int, float], Sequence[tuple[_Kept, _Line]]]) -> bool:
    """Whether all lines of a channel and mains frequency are harmonics of the other one as well (300 Hz), of which the
    channel has further lines."""
    channel, mains = key
    other = MAINS_HZ[1 - MAINS_HZ.index(mains)]

    def foreign(of: float, divisor: float) -> bool:
        return any(round(hit.at_Hz / of) * of % divisor for _, hit in hits.get((channel, of), ()))

    return foreign(other, mains) and not foreign(mains, other)


def _length(samples: int, rate: float) -> int:
    """Segment length of about 4 s, for at least 4 and at most 32 segments."""
    return int(np.clip(4 * rate, samples // 32, max(samples // 4, 2)))


def _driven(Pu: np.ndarray, excitation: str) -> np.ndarray:
    """(n,) mask of bins in which u has lines: none for noise excitation, because its spectrum is smooth."""
    power = Pu.sum(axis=1)
    if excitation == "noise" or not power.any():
        return np.zeros(len(power), bool)
    return power > 1e-6 * np.median(power[driven_lines(power)])


def _tested(f: np.ndarray, P: np.ndarray, driven: np.ndarray, at: float, mains: float, K: int) -> list[_Line] | None:
    """The line at `at` Hz in each channel; empty beyond the band, None if u drives it."""
    df = f[1]
    width = max(1, int(np.ceil(SETTINGS.tolerance * at / df)))
    low, high = round(at / df) - width, round(at / df) + width
    below = slice(low - SETTINGS.guard - SETTINGS.reference, low - SETTINGS.guard)
    above = slice(high + SETTINGS.guard + 1, high + SETTINGS.guard + SETTINGS.reference + 1)
    if below.start < 1 or above.stop >= len(f):
        return []
    if driven[below.start : above.stop].any():
        return None
    lines = []
    for j in range(P.shape[1]):
        floor = max(P[below, j].mean(), P[above, j].mean())
        peak = low + int(np.argmax(P[low : high + 1, j]))
        if floor <= 0:
            continue
        ratio = float(P[peak, j] / floor)
        # The largest of 2 width + 1 bins; neighbouring Hann bins are correlated, which makes the bound conservative.
        p = min(1.0, (2 * width + 1) * float(stats.f.sf(ratio, 2 * K, 2 * K * SETTINGS.reference)))
        around_peak = P[max(peak - 2, 0) : peak + 3, j] - floor
        lines.append(_Line(j, mains, float(f[peak]), p, ratio, float(np.sqrt(max(around_peak.sum(), 0.0) * df))))
    return lines
