"""Gate for outputs that are sampled by another clock than the one that plays the commanded voltage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate, excerpt
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Series, Severity, quoted
from avis_ctrl.measurement.gates.h1 import Spectra
from avis_ctrl.measurement.gates.missing_samples import SETTINGS as STEPS
from avis_ctrl.measurement.gates.missing_samples import delays, driven_on_both_sides, spectra_from_beginning


@dataclass(frozen=True)
class SampleClockSettings:
    """seen_rad : phase error at the highest driven frequency, at the end of the record, above which the gate warns:
        10 % of the response there.
    wrong_rad : phase error above which the model of a constant delay fails, and the gate reports a stop.
    equal : maximum difference of a record's rate from the median rate, relative to the latter, for one pair of clocks
        to be the cause: samples that are lost repeatedly give every record a rate of its own.
    segments : minimum number of segments of a record, for a straight line and its standard deviation.
    """

    seen_rad: float = 0.1
    wrong_rad: float = 1.0
    equal: float = 0.2
    segments: int = 6


SETTINGS = SampleClockSettings()


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift of the delay of y after u in one record.

    rate : growth of the delay [s/s], 0 if it is not significant. phase_rad : the resulting phase error at the highest
    driven frequency, at the end of the record. picture : delay over time.
    """

    record: str
    duration_s: float
    rate: float
    phase_rad: float
    picture: Picture


def drift_of(seen: Excerpt, level: float = FINDING.false_alarm) -> Drift | None:
    """Growth of the delay of y after u (`missing_samples.delays`): a straight line through the delays of the segments,
    tested by Student's t at `level`. None if the record cannot show it.

    Of the three estimates of the delay, the one with the median rate is used: a large drift distorts the response that
    is averaged over the whole record more than those of its halves.
    """
    t, delay = delays(seen)
    if len(t) < SETTINGS.segments:
        return None
    h, x = seen.header, t - t.mean()
    lines = _driven_in_both_halves(spectra_from_beginning(seen))
    if lines is None:
        return None
    rates = delay @ x / (x @ x)
    middle = int(np.argsort(rates)[len(rates) // 2])
    left = delay[middle] - delay[middle].mean() - rates[middle] * x
    dof = len(t) / STEPS.overlap - 2
    std = np.sqrt(max(float(left @ left), 1e-300) / dof / (x @ x))
    significant = 2 * stats.t.sf(abs(rates[middle]) / std, dof) < level
    rate = float(rates[middle]) / h.sample_rate_Hz if significant else 0.0
    omega = 2 * np.pi * float(lines.max())
    limit_ms = 1e3 * SETTINGS.seen_rad / omega
    picture = Picture(
        f"Record {h.name}: delay of y behind the response to u",
        "time [s]",
        "delay [ms]",
        (Series("delay", t - h.start_s, 1e3 * delay[middle] / h.sample_rate_Hz, "points"),),
        (Limit("warning", limit_ms), Limit("warning", -limit_ms)),
    )
    return Drift(h.name, h.duration_s, rate, abs(rate) * h.duration_s * omega, picture)


def _driven_in_both_halves(of: Spectra) -> np.ndarray | None:
    """Frequencies [Hz] of the lines that are driven in both halves of a record; None if these are too few: in a swept
    sine the delay changes with frequency, and thus with time."""
    driven = of.driven()
    both = driven & driven_on_both_sides(of, len(of.U) // 2)
    return of.f[both] if both.any() and both.sum() > STEPS.showing * driven.sum() else None


def of_clocks(drifts: Sequence[Drift]) -> bool:
    """Whether the delay drifts at about the same rate in all records, as with two clocks."""
    rates = np.array([one.rate for one in drifts])
    middle = float(np.median(rates))
    seen = all(one.phase_rad > SETTINGS.seen_rad for one in drifts)
    return seen and bool(np.all(np.abs(rates - middle) < SETTINGS.equal * abs(middle)))


def cause(drifts: Sequence[Drift]) -> str:
    """A sentence on the drift of the records whose phase error is above `seen_rad`."""
    found = [one for one in drifts if one.phase_rad > SETTINGS.seen_rad]
    worst = max(found, key=lambda one: one.phase_rad)
    growth, rates = worst.rate * worst.duration_s, np.array([one.rate for one in found])
    middle = float(np.median(rates))
    said = (
        f"In record {worst.record} the delay of the measured channels after the commanded voltage "
        f"{'grows' if growth > 0 else 'decreases'} by {1e3 * abs(growth):.3g} ms"
    )
    if of_clocks(drifts):
        return (
            f"{said}, and in all records at about the same rate: y is sampled by a clock that runs about "
            f"{100 * abs(middle):.2g} % {'faster' if middle > 0 else 'slower'} than the clock of u. Use one clock for "
            "both, and repeat the records."
        )
    others = [one.record for one in found if one is not worst]
    also = f", at another rate than in {quoted(others)}" if others else ", and not in the others"
    lost = "doubled" if middle > 0 else "lost"
    return f"{said}{also}: samples are {lost} repeatedly, or the clocks of u and y are not locked. Repeat the records."


def no_constant_delay(campaign: Campaign) -> bool:
    """Whether the delay of y after u changes so much in some record that no constant delay describes it."""
    found = (drift_of(excerpt(record)) for record in campaign.records)
    return any(one is not None and one.phase_rad > SETTINGS.wrong_rad for one in found)


class SampleClock(Gate):
    """Drift of the delay of y after the commanded voltage over each record.

    Two clocks of different rates make the delay grow in proportion to time, by 60 microseconds per minute and per part
    per million. No constant delay in a model describes this; where the phase error exceeds about one radian, an
    average over the record is no response of the table.
    """

    name = "sample clock"

    def look(self, seen: Excerpt) -> Drift | None:
        return drift_of(seen)

    def conclude(self, kept: list[Drift | None]) -> list[Finding]:
        known = [one for one in kept if one is not None]
        if not known:
            return [Finding(self.name, "ok", "No record can show a drift of the delay of y after u.")]
        worst = max(known, key=lambda one: one.phase_rad)
        if worst.phase_rad <= SETTINGS.seen_rad:
            sentence = f"The delay of y after u is constant ({len(known)} of {len(kept)} records can show a drift)."
            return [Finding(self.name, "ok", sentence, (), (), worst.phase_rad, SETTINGS.seen_rad, worst.picture)]
        wrong = worst.phase_rad > SETTINGS.wrong_rad
        severity: Severity = "stop" if wrong else "warning"
        limit = SETTINGS.wrong_rad if wrong else SETTINGS.seen_rad
        drifting = tuple(one.record for one in known if one.phase_rad > SETTINGS.seen_rad)
        records = () if of_clocks(known) else drifting
        return [Finding(self.name, severity, cause(known), (), records, worst.phase_rad, limit, worst.picture)]
