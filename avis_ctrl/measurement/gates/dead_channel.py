"""Gate for channels without a signal: constant, stuck at a code, or noise alone while others respond."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import RecordHeader
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, curves, quoted, samples_over_time
from avis_ctrl.measurement.gates.h1 import h1_of, usable
from avis_ctrl.measurement.gates.sine_fit import fit_sine


@dataclass(frozen=True)
class DeadSettings:
    """stuck_samples, stuck_factor : minimum length of a stuck run, in samples and relative to all other runs [1].
    responds : minimum ratio of the median channel to the limit for noise alone, for others to count as dead [1].
    """

    stuck_samples: int = 50
    stuck_factor: int = 5
    responds: float = 10.0


SETTINGS = DeadSettings()


@dataclass(frozen=True, eq=False)
class _Kept:
    """Data of one record; stuck : finding on a stuck run, by channel."""

    record: str
    driven: bool
    rms: np.ndarray
    spread: np.ndarray
    codes: np.ndarray
    stuck: dict[int, Finding]
    response: np.ndarray | None


class DeadChannel(Gate):
    """Sensors without a signal and drives that are never driven.

    Constant channels and stuck codes need no statistics. A channel counts as noise alone if its largest multiple
    coherence over the driven lines is within the limit for noise (beta distribution of n_u and K - n_u, 1 % divided
    among channels and lines) while half of the channels respond, in terms of coherence / (1 - coherence); all driven
    records are considered. In a sine record, the power of the fitted sine is compared with the residual by
    F(2, samples - 3). Only small signals can cause false alarms.
    """

    name = "dead channel"

    def look(self, seen: Excerpt) -> _Kept:
        y = np.concatenate([p.y for p in seen.pieces])
        t = np.concatenate([p.time for p in seen.pieces]) - seen.header.start_s
        stuck = {}
        for k in range(y.shape[1]):
            runs = equal_runs(y[:, k])
            (longest, at), second = runs[0], runs[1][0] if len(runs) > 1 else 1
            if max(SETTINGS.stuck_samples, SETTINGS.stuck_factor * second) <= longest < len(y):
                stuck[k] = self._stuck(seen.header, k, t, y[:, k], longest, at)
        codes = np.array([len(np.unique(y[: 1 << 14, k])) for k in range(y.shape[1])])
        rms = np.where(np.ptp(y, axis=0) > 0, y.std(axis=0), 0.0)
        spread = np.ptp(np.concatenate([p.u for p in seen.pieces]), axis=0)
        return _Kept(seen.header.name, seen.driven, rms, spread, codes, stuck, _excess(seen))

    def conclude(self, kept: list[_Kept]) -> list[Finding]:
        rms = np.array([k.rms for k in kept])
        picture = Picture(
            "R.m.s. of each channel by record",
            "record number",
            f"r.m.s. [{self.campaign.y_unit}]",
            curves(self.campaign.y_names, np.arange(len(kept)), rms, "points"),
            y_scale="log",
        )
        found = [*self._sensors(kept, rms, picture), *self._never_driven(kept, picture)]
        strongest = rms.max(axis=0)
        least, name = strongest.min(), self.campaign.y_names[int(np.argmin(strongest))]
        sentence = (
            f"All {len(strongest)} channels move; the quietest is {name!r} with {least:.3g} {self.campaign.y_unit} "
            "r.m.s. in its strongest record."
        )
        return found or [Finding(self.name, "ok", sentence, value=least, limit=0.0, picture=picture)]

    def _sensors(self, kept: list[_Kept], rms: np.ndarray, picture: Picture) -> Iterator[Finding]:
        driven = {k.record: k.response for k in kept if k.response is not None}
        # Drift looks like a slow sine: for sine records the median is used.
        sines = all(record.header.excitation == "sine" for record in self.campaign.records)
        excess = (np.median if sines else np.max)(list(driven.values()), axis=0) if driven else None
        for j, name in enumerate(self.campaign.y_names):
            dead = tuple(k.record for k in kept if k.rms[j] == 0)
            if dead:
                where = "every record" if len(dead) == len(kept) else f"record {', '.join(dead[:5])}"
                sentence = (
                    f"Channel {name!r} is constant in {where}: the sensor is not connected or not recorded. Check its "
                    "cable and input, or leave the channel out."
                )
                yield Finding(self.name, "stop", sentence, (name,), dead, 0.0, 0.0, picture)
            yield from (k.stuck[j] for k in kept if j in k.stuck)
            if not dead and excess is not None and excess[j] < 1 and np.median(excess) > SETTINGS.responds:
                sentence = (
                    f"Channel {name!r} contains only noise of {np.median(rms[:, j]):.3g} {self.campaign.y_unit} r.m.s. "
                    f"({int(np.median([k.codes[j] for k in kept]))} different values) in every driven record while the "
                    f"other channels respond (its ratio of response to noise is {excess[j]:.2g} times the limit for "
                    f"noise alone; the median of all channels is {np.median(excess):.3g} times it): not connected, or "
                    "recorded under another name. Check its cable, or leave it out."
                )
                yield Finding(self.name, "stop", sentence, (name,), tuple(driven), excess[j], 1.0, picture)

    def _never_driven(self, kept: list[_Kept], picture: Picture) -> Iterator[Finding]:
        driven = [k.spread for k in kept if k.driven]
        idle = tuple(n for j, n in enumerate(self.campaign.u_names) if not any(spread[j] > 0 for spread in driven))
        if driven and idle:
            sentence = (
                f"Input {quoted(idle)} is constant in every driven record: its effect cannot be determined. Drive it "
                "in a further record, or leave it out."
            )
            yield Finding(self.name, "note", sentence, idle, picture=picture)

    def _stuck(self, header: RecordHeader, k: int, t: np.ndarray, x: np.ndarray, n: int, at: int) -> Finding:
        """Finding on channel k with n equal samples from x[at] on."""
        name, record, rate, part = (
            header.y_names[k],
            header.name,
            header.sample_rate_Hz,
            slice(max(0, at - n), at + 2 * n),
        )
        limit = Limit("stuck from", at / rate, "x")
        picture = samples_over_time(record, name, t[part], x[part], header.y_unit, (limit,))
        sentence = (
            f"Channel {name!r} of record {record} repeats one value for {n} samples ({n / rate:.3g} s) from "
            f"{at / rate:.4g} s on: the converter or the data link was stuck. Leave that part out or repeat the record."
        )
        return Finding(self.name, "warning", sentence, (name,), (record,), n, SETTINGS.stuck_samples, picture)


def equal_runs(x: np.ndarray) -> list[tuple[int, int]]:
    """(length, start) of the two longest runs of equal samples."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(x)) + 1])
    lengths = np.diff(np.concatenate([starts, [len(x)]]))
    longest = int(np.argmax(lengths))
    found = [(int(lengths[longest]), int(starts[longest]))]
    if len(lengths) > 1:
        lengths[longest] = 0
        second = int(np.argmax(lengths))
        found.append((int(lengths[second]), int(starts[second])))
    return found


def _excess(seen: Excerpt) -> np.ndarray | None:
    """(n_y,) largest coherence / (1 - coherence) over the driven lines, relative to its 1 % limit for noise alone."""
    if not seen.driven:
        return None
    if seen.header.excitation == "sine":
        return _sine_excess(seen)
    samples = usable(seen)
    if not samples.moving or (estimate := h1_of(seen)) is None:
        return None
    limit = stats.beta.isf(FINDING.false_alarm / estimate.coherence.size, estimate.rank, estimate.dof)
    ratio = estimate.coherence / np.maximum(1 - estimate.coherence, 1e-12)
    return np.max(ratio, axis=0) / (limit / max(1 - limit, 1e-12))


def _sine_excess(seen: Excerpt) -> np.ndarray:
    """(n_y,) the same for a sine: power of the fitted sine over that of the residual, relative to F(2, samples - 3)."""
    piece = seen.first
    n_u = piece.u.shape[1]
    fit = fit_sine(piece.header.name, np.hstack([piece.u, piece.y]), n_u, seen.header.sample_rate_Hz)
    ratio = np.abs(fit.X[n_u:]) ** 2 / 4 * fit.samples / np.maximum(fit.residual_rms[n_u:] ** 2, 1e-300)
    return ratio / float(stats.f.isf(FINDING.false_alarm / len(ratio), 2, fit.samples - 3))
