"""Gate for channels without a signal: constant, stuck at a code, or noise alone while others respond."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import FALSE_ALARM, Expectation, Finding, Limit, Picture, Series, quoted
from avis_ctrl.measurement.gates.h1 import h1, moving, segment_length, spectra, usable
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
    record: str
    driven: bool
    rms: np.ndarray
    spread: np.ndarray
    codes: np.ndarray
    stuck: dict[int, tuple[int, int]]
    response: np.ndarray | None
    traces: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


class DeadChannel(Gate):
    """Sensors without a signal and drives that are never driven.

    Constant channels and stuck codes need no statistics. A channel counts as noise alone if its largest multiple
    coherence over the driven lines is within the limit for noise (beta distribution of n_u and K - n_u, 1 % divided
    among channels and lines) while half of the channels respond, in terms of coherence / (1 - coherence); all driven
    records are considered. In a sine record, the power of the fitted sine is compared with the residual by
    F(2, samples - 3). Only small signals can cause false alarms.
    """

    name = "dead channel"

    def look(self, seen: Excerpt, expectation: Expectation) -> _Kept:
        y = np.concatenate([p.y for p in seen.pieces])
        t = np.concatenate([p.time for p in seen.pieces]) - seen.header.start_s
        stuck = {}
        for k in range(y.shape[1]):
            runs = equal_runs(y[:, k])
            longest, second = runs[0][0], runs[1][0] if len(runs) > 1 else 1
            if max(SETTINGS.stuck_samples, SETTINGS.stuck_factor * second) <= longest < len(y):
                stuck[k] = runs[0]
        traces = {k: (t[(part := slice(max(0, at - n), at + 2 * n))], y[part, k]) for k, (n, at) in stuck.items()}
        codes = np.array([len(np.unique(y[: 1 << 14, k])) for k in range(y.shape[1])])
        spread = np.ptp(np.concatenate([p.u for p in seen.pieces]), axis=0)
        return _Kept(
            seen.header.name,
            seen.driven,
            np.where(np.ptp(y, axis=0) > 0, y.std(axis=0), 0.0),
            spread,
            codes,
            stuck,
            _excess(seen),
            traces,
        )

    def conclude(self, kept: list[_Kept], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        rms = np.array([k.rms for k in kept])
        picture = Picture(
            "R.m.s. of each channel by record",
            "record number",
            f"r.m.s. [{campaign.y_unit}]",
            tuple(Series(name, np.arange(len(kept)), rms[:, j], "points") for j, name in enumerate(campaign.y_names)),
            y_scale="log",
        )
        found = [*self._sensors(kept, campaign, rms, picture), *self._never_driven(kept, campaign, picture)]
        strongest = rms.max(axis=0)
        quietest = int(np.argmin(strongest))
        return found or [
            Finding(
                self.name,
                "ok",
                f"All {len(strongest)} channels move; the quietest is "
                f"{campaign.y_names[quietest]!r} with {strongest[quietest]:.3g} {campaign.y_unit} r.m.s. in its "
                "strongest record.",
                value=float(strongest[quietest]),
                limit=0.0,
                picture=picture,
            )
        ]

    def _sensors(self, kept: list[_Kept], campaign: Campaign, rms: np.ndarray, picture: Picture) -> Iterator[Finding]:
        responses = [k.response for k in kept if k.response is not None]
        # Drift looks like a slow sine: for sine records the median is used.
        sines = all(record.header.excitation == "sine" for record in campaign.records)
        excess = (np.median if sines else np.max)(responses, axis=0) if responses else None
        for j, name in enumerate(campaign.y_names):
            dead = tuple(k.record for k in kept if k.rms[j] == 0)
            if dead:
                where = "every record" if len(dead) == len(kept) else f"record {', '.join(dead[:5])}"
                yield Finding(
                    self.name,
                    "stop",
                    f"Channel {name!r} is constant in {where}: the sensor is not connected or not recorded. "
                    "Check its cable and input, or leave the channel out.",
                    (name,),
                    dead,
                    0.0,
                    0.0,
                    picture,
                )
            for k in kept:
                if j in k.stuck:
                    yield self._stuck(name, j, k, campaign)
            if not dead and excess is not None and excess[j] < 1 and np.median(excess) > SETTINGS.responds:
                yield Finding(
                    self.name,
                    "stop",
                    f"Channel {name!r} contains only noise of {np.median(rms[:, j]):.3g} {campaign.y_unit} "
                    f"r.m.s. ({int(np.median([k.codes[j] for k in kept]))} different values) in every driven "
                    "record while the other channels respond (its ratio of response to noise is "
                    f"{excess[j]:.2g} times the limit for noise alone; the median of all channels is "
                    f"{np.median(excess):.3g} times it): not connected, or recorded under another name. "
                    "Check its cable, or leave it out.",
                    (name,),
                    tuple(k.record for k in kept if k.response is not None),
                    float(excess[j]),
                    1.0,
                    picture,
                )

    def _never_driven(self, kept: list[_Kept], campaign: Campaign, picture: Picture) -> Iterator[Finding]:
        driven = [k.spread for k in kept if k.driven]
        idle = tuple(n for j, n in enumerate(campaign.u_names) if not any(spread[j] > 0 for spread in driven))
        if driven and idle:
            yield Finding(
                self.name,
                "note",
                f"Input {quoted(idle)} is constant in every driven record: its effect cannot be determined. "
                "Drive it in a further record, or leave it out.",
                idle,
                picture=picture,
            )

    def _stuck(self, name: str, j: int, kept: _Kept, campaign: Campaign) -> Finding:
        n, at = kept.stuck[j]
        rate = campaign.sample_rate_Hz
        t, x = kept.traces[j]
        picture = Picture(
            f"Record {kept.record}, {name}",
            "time [s]",
            f"{name} [{campaign.y_unit}]",
            (Series(name, t, x),),
            (Limit("stuck from", at / rate, "x"),),
        )
        return Finding(
            self.name,
            "warning",
            f"Channel {name!r} of record {kept.record} repeats one value for {n} samples ({n / rate:.3g} s) "
            f"from {at / rate:.4g} s on: the converter or the data link was stuck. Leave that part out or "
            "repeat the record.",
            (name,),
            (kept.record,),
            float(n),
            float(SETTINGS.stuck_samples),
            picture,
        )


def equal_runs(x: np.ndarray) -> list[tuple[int, int]]:
    """(length, start) of the two longest runs of equal samples."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(x)) + 1])
    lengths = np.diff(np.concatenate([starts, [len(x)]]))
    order = np.argsort(lengths)[::-1][:2]
    return [(int(lengths[k]), int(starts[k])) for k in order]


def _excess(seen: Excerpt) -> np.ndarray | None:
    """(n_y,) largest coherence / (1 - coherence) over the driven lines, relative to its 1 % limit for noise alone."""
    if not seen.driven:
        return None
    if seen.header.excitation == "sine":
        return _sine_excess(seen)
    u, y, wrap = usable(seen)
    if not moving(u):
        return None
    of = spectra(u, y, seen.header.sample_rate_Hz, segment_length(len(u), moving(u)), wrap)
    estimate = h1([of])
    if estimate is None:
        return None
    n_u = estimate.rank
    level = FALSE_ALARM / estimate.coherence.size
    limit = stats.beta.isf(level, n_u, estimate.dof)
    ratio = estimate.coherence / np.maximum(1 - estimate.coherence, 1e-12)
    return np.max(ratio, axis=0) / (limit / max(1 - limit, 1e-12))


def _sine_excess(seen: Excerpt) -> np.ndarray:
    """(n_y,) the same for a sine: power of the fitted sine over that of the residual, relative to F(2, samples - 3)."""
    piece = seen.first
    n_u = piece.u.shape[1]
    fit = fit_sine(piece.header.name, np.hstack([piece.u, piece.y]), n_u, seen.header.sample_rate_Hz)
    ratio = np.abs(fit.X[n_u:]) ** 2 / 4 * fit.samples / np.maximum(fit.residual_rms[n_u:] ** 2, 1e-300)
    return ratio / float(stats.f.isf(FALSE_ALARM / len(ratio), 2, fit.samples - 3))
