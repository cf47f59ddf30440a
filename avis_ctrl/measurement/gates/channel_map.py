"""Gates that compare each channel with what the model expects of it: exchanged channels and polarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.channel_faults import MARGIN, Faults, compare, explain
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import Expectation, Finding, Limit, Picture, Response, Series, Severity
from avis_ctrl.measurement.gates.h1 import Spectra, segment_length, spectra, usable

# Two channels are one where their difference is below this part of either, after scaling.
COPY = 1e-3


@dataclass(frozen=True, eq=False)
class _Kept:
    record: str
    measured: Spectra | None
    expected: Spectra | None
    copies: list[tuple[int, int, float, float]]


class ChannelMap(Gate):
    """`ChannelOrder` and `Polarity`, which look at the same."""

    name = "channel map"

    def conclude(self, kept: list[_Kept], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        of = ChannelOrder(), Polarity()
        return [finding for gate in of for finding in gate.conclude(kept, campaign, expectation)]

    def look(self, seen: Excerpt, expectation: Expectation) -> _Kept:
        copies = _copies(seen)
        if not seen.driven:
            return _Kept(seen.header.name, None, None, copies)
        u, y, wrap = usable(seen)
        length = segment_length(len(u), int(np.count_nonzero(np.ptp(u, axis=0))))
        rate = seen.header.sample_rate_Hz
        measured = spectra(u, y, rate, length, wrap)
        if expectation.response is None:
            return _Kept(seen.header.name, measured, None, copies)
        model = predicted(expectation.response, u, rate, seen.header.u_names, wrap)
        order = _order(seen.header.y_names, expectation.y_names, model.shape[1])
        expected = None if order is None else spectra(u, model[:, order], rate, length, wrap)
        return _Kept(seen.header.name, measured, expected, copies)


class ChannelOrder:
    """Exchanged or mislabelled channels, and copies of one channel under two names.

    With a model: the fewest exchanges and flips that explain the measured rows (sensors) and columns (drives), see
    `explain`. An exchange needs a gain in correlation of 0.15 + 5 standard deviations of its noise for each of the two,
    so
    that noise alone raises less than 1e-5 alarms; 0.15 is above what stiffness errors of 5 % and damping errors of
    20 % do (tests/measurement/test_gates_channels.py).
    Without one, copies only: a channel that equals another one times a constant within 0.1 % of its r.m.s.; independent
    sensor noise of more than that keeps true channels apart.
    """

    name = "channel order"

    def conclude(self, kept: list[_Kept], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        found = self._copied(kept, campaign)
        comparison = compare(_pairs(kept))
        if comparison is None:
            if not found:
                why = "no model was given" if expectation.response is None else "too few driven samples"
                found.append(
                    Finding(
                        self.name,
                        "note" if expectation.response is not None else "ok",
                        f"No channel is a copy of another; their order was not compared with a model ({why}).",
                        picture=_copy_picture(kept),
                    )
                )
            return found
        limit = MARGIN + 5 * comparison.standard
        faults = explain(comparison, limit)
        rows, columns = comparison.rows(faults.q, faults.c), comparison.columns(faults.p, faults.r)
        rows, columns = faults.r[:, None] * rows, faults.c[:, None] * columns
        found += self._exchanged(rows, faults, "row", campaign.y_names, limit)
        found += self._exchanged(columns, faults, "column", campaign.u_names, limit)
        if not found:
            own = np.diag(rows)
            worst = int(np.argmin(own))
            found.append(
                Finding(
                    self.name,
                    "ok",
                    "Every channel agrees best with its own expected response; the least, "
                    f"{campaign.y_names[worst]!r}, with correlation {own[worst]:.3f}.",
                    value=float(own[worst]),
                    picture=_picture(rows, campaign.y_names, "Sensor", limit),
                )
            )
        return found

    def _exchanged(
        self, c: np.ndarray, faults: Faults, kind: str, names: tuple[str, ...], limit: float
    ) -> list[Finding]:
        p, what = (faults.p, "Sensor") if kind == "row" else (faults.q, "Drive")
        found: list[Finding] = []
        done: set[int] = set()
        for i in range(len(p)):
            if p[i] == i or i in done:
                continue
            cycle, k = [i], int(p[i])
            while k != i:
                cycle.append(k)
                k = int(p[k])
            done.update(cycle)
            pair = tuple(names[j] for j in cycle)
            gain = min(faults.after[kind, j] - faults.before[kind, j] for j in cycle)
            listed = "; ".join(
                f"{names[j]!r} agrees with the model's {names[int(p[j])]!r} by {faults.after[kind, j]:.2f}, with its"
                f" own by {faults.before[kind, j]:.2f}"
                for j in cycle
            )
            verb = "are exchanged" if len(pair) == 2 else "are mixed up"
            found.append(
                Finding(
                    self.name,
                    "stop",
                    f"{what}s {' and '.join(map(repr, pair))} {verb}: {listed} (correlation of "
                    "magnitude and phase). Exchange their names or their cables.",
                    pair,
                    value=float(gain),
                    limit=limit,
                    picture=_picture(c, names, what, limit),
                )
            )
        return found

    def _copied(self, kept: list[_Kept], campaign: Campaign) -> list[Finding]:
        found, names = [], campaign.y_names
        pairs = {(i, k) for of in kept for i, k, _, _ in of.copies}
        for i, k in sorted(pairs):
            hits = [(of.record, scale, rest) for of in kept for a, b, scale, rest in of.copies if (a, b) == (i, k)]
            record, scale, rest = hits[0]
            found.append(
                Finding(
                    self.name,
                    "stop",
                    f"Channel {names[k]!r} is {names[i]!r} times {scale:.6g} within {100 * rest:.2g} % of its r.m.s. in"
                    f" record {record}: one signal recorded twice. Check the wiring and the channel list; leave one of"
                    " them out.",
                    (names[i], names[k]),
                    tuple(h[0] for h in hits),
                    float(rest),
                    COPY,
                    _copy_picture(kept),
                )
            )
        return found


class Polarity:
    """Flipped signs of drives (columns) and sensors (rows).

    Found by `explain` with the exchanges: a channel counts as flipped where its correlation with its own expectation
    is below -(0.15 + 5 standard deviations of its noise), which noise alone reaches less than once in 1e6. Flipping all
    sensors cannot be told from flipping all drives: the explanation with fewer flips is named, and the sentence says so
    where both have equally many.
    """

    name = "polarity"

    def conclude(self, kept: list[_Kept], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        comparison = compare(_pairs(kept))
        if comparison is None:
            why = "no model was given" if expectation.response is None else "too few driven samples"
            x = np.arange(len(campaign.y_names))
            picture = Picture(
                "Polarity of each sensor",
                "sensor number",
                "correlation [-]",
                (Series("not known", x, 0.0 * x, "points"),),
            )
            return [
                Finding(
                    self.name,
                    "ok" if expectation.response is None else "note",
                    f"Polarity was not compared with a model ({why}).",
                    picture=picture,
                )
            ]
        limit = MARGIN + 5 * comparison.standard
        faults = explain(comparison, limit)
        p, q, r, c = faults.p, faults.q, faults.r, faults.c
        row = np.diag(comparison.rows(q, c)[:, p])
        column = np.diag(comparison.columns(p, r)[:, q])
        picture = Picture(
            "Correlation of each channel with its expected response",
            "sensors, then drives",
            "correlation [-]",
            (
                Series("sensors", np.arange(len(p)), row, "bars"),
                Series("drives", len(p) + np.arange(len(q)), column, "bars"),
            ),
            (Limit("opposite sign", -limit),),
            x_names=(*campaign.y_names, *campaign.u_names),
        )
        found = []
        both = np.count_nonzero(r < 0) + np.count_nonzero(c < 0)
        total = len(r) + np.count_nonzero(comparison.measured.G.any(axis=(0, 1)))
        doubt = " It could as well be that all the other channels are flipped." if 2 * both == total else ""
        for flipped, correlation, names, what in (
            (r, np.abs(row), campaign.y_names, "Sensor"),
            (c, np.abs(column), campaign.u_names, "Drive"),
        ):
            for k in np.flatnonzero(flipped < 0):
                severity: Severity = "stop"
                found.append(
                    Finding(
                        self.name,
                        severity,
                        f"{what} {names[k]!r} has the opposite sign of the model (correlation {-correlation[k]:.2f}"
                        " where +1 is expected). Its leads are exchanged, or the model's axis points the other way;"
                        f" exchange them or flip the channel's sign.{doubt}",
                        (names[k],),
                        value=float(-correlation[k]),
                        limit=-limit,
                        picture=picture,
                    )
                )
        if not found:
            found.append(
                Finding(
                    self.name,
                    "ok",
                    f"All signs agree with the model (lowest correlation {np.abs(row).min():.2f} among sensors).",
                    value=float(np.abs(row).min()),
                    limit=limit,
                    picture=picture,
                )
            )
        return found


def predicted(response: Response, u: np.ndarray, rate: float, inputs: tuple[str, ...], wrap: bool) -> np.ndarray:
    """(samples, n_y) the model's y, from rest; periodic where `wrap`."""
    n = len(u) if wrap else 2 * len(u)
    f = np.fft.rfftfreq(n, 1 / rate)
    U = np.fft.rfft(u, n, axis=0)
    # Lines 60 dB down need no response of the model.
    power = np.sum(np.abs(U) ** 2, axis=1)
    keep = power > 1e-6 * power.max(initial=0.0)
    keep[0] = False
    Y: np.ndarray | None = None
    lines = np.flatnonzero(keep)
    for part in np.array_split(lines, max(1, len(lines) // 8192 + 1)):
        if not len(part):
            continue
        G = response(2 * np.pi * f[part], inputs)
        if Y is None:
            Y = np.zeros((len(f), G.shape[1]), complex)
        Y[part] = np.einsum("fij,fj->fi", G, U[part])
    if Y is None:
        return np.zeros((len(u), 0))
    return np.fft.irfft(Y, n, axis=0)[: len(u)]


def _pairs(kept: list[_Kept]) -> list[tuple[Spectra, Spectra]]:
    return [(k.measured, k.expected) for k in kept if k.measured is not None and k.expected is not None]


def _order(names: tuple[str, ...], expected: tuple[str, ...] | None, rows: int) -> list[int] | None:
    """Rows of the model in the order of the campaign's channels; None where they do not correspond."""
    if expected is None:
        return list(range(rows)) if rows == len(names) else None
    return [expected.index(n) for n in names] if set(names) <= set(expected) and len(expected) == rows else None


# Two samples are always alike up to a constant and a factor; this many are not by chance.
FEWEST_ALIKE = 8


def _copies(seen: Excerpt) -> list[tuple[int, int, float, float]]:
    """(i, k, scale, rest): channels with y_k = scale y_i up to a constant, within COPY of its r.m.s."""
    y = seen.first.y - seen.first.y.mean(axis=0)
    S = y.T @ y
    found: list[tuple[int, int, float, float]] = []
    if len(y) < FEWEST_ALIKE:
        return found
    for i in range(len(S)):
        for k in range(i + 1, len(S)):
            if S[i, i] > 0 and S[k, k] > 0:
                rest = max(0.0, 1 - S[i, k] ** 2 / (S[i, i] * S[k, k])) ** 0.5
                if rest < COPY:
                    found.append((i, k, float(S[i, k] / S[i, i]), rest))
    return found


def _copy_picture(kept: list[_Kept]) -> Picture:
    count = np.array([len(k.copies) for k in kept])
    return Picture(
        "Pairs of channels that are copies",
        "record number",
        "pairs [-]",
        (Series("pairs", np.arange(len(count)), count, "points"),),
    )


def _picture(c: np.ndarray, names: tuple[str, ...], what: str, limit: float) -> Picture:
    x = np.arange(len(names))
    others = np.max(np.where(np.eye(len(c), dtype=bool), -np.inf, c), axis=1) if len(c) > 1 else np.zeros(1)
    return Picture(
        f"{what}s against the model",
        what.lower(),
        "correlation [-]",
        (Series("own expected response", x, np.diag(c), "points"), Series("best other", x, others, "points")),
        x_names=tuple(names),
    )
