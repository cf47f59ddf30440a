"""Gates that compare each channel with its response in the model: exchanged channels and polarity."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.channel_faults import Faults, ModelComparison, compare, cycle_of, explain
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Response, Series, Severity, bars, quoted, those
from avis_ctrl.measurement.gates.h1 import Samples, Spectra, directions, segment_length, usable

ORDER, POLARITY = "channel order", "polarity"  # gate names of the findings


@dataclass(frozen=True)
class CopySettings:
    """different : r.m.s. of the difference of two channels, after scaling, relative to either's, below which one is a
        copy of the other: independent sensor noise is larger.
    alike : the same for the model's channels: below it a motion explains that two sensors read alike. Parameter errors
        of a few per cent make symmetric sensors differ by this much.
    fewest : minimum number of samples: two always agree up to an offset and a factor, this many do not by chance.
    """

    different: float = 1e-3
    alike: float = 0.05
    fewest: int = 8


COPIES = CopySettings()


@dataclass(frozen=True, eq=False)
class _Kept:
    """Copies in a record; of a driven one the samples, and the same with the model's y."""

    record: str
    copies: list[tuple[int, int, float, float]]
    measured: Samples | None = None
    model: Samples | None = None


class ChannelMap(Gate):
    """Exchanged, mislabelled and copied channels ("channel order"), and flipped signs ("polarity").

    Without a model, only copies are detected: a channel that equals a constant times another channel within 0.1 % of
    its r.m.s. in every record. A motion along one axis makes the sensors of a symmetric table read alike. If the model
    predicts this for every record, the finding is a note.

    With a model: the smallest set of exchanges and flips that explains the measured rows (sensors) and columns
    (drives), see `explain`; for settings and the probability of a false stop see `MapSettings`. If another order fits
    better without sufficient evidence, the finding is a note. Flipping all sensors cannot be distinguished from
    flipping all drives: the explanation with fewer flips is reported. If both have equally many, the message states
    this.
    """

    name = "channel map"

    def look(self, seen: Excerpt) -> _Kept:
        copies = _copies(seen)
        if not seen.driven or self.expectation.response is None:
            return _Kept(seen.header.name, copies)
        measured = usable(seen)
        y = predicted(self.expectation.response, measured, seen.header.u_names)
        order = _order(seen.header.y_names, self.expectation.y_names, y.shape[1])
        return _Kept(seen.header.name, copies, measured, None if order is None else replace(measured, y=y[:, order]))

    def conclude(self, kept: list[_Kept]) -> list[Finding]:
        def response(f: np.ndarray) -> np.ndarray:
            assert self.expectation.response is not None
            G = self.expectation.response(2 * np.pi * f, self.campaign.u_names)
            return G[:, _order(self.campaign.y_names, self.expectation.y_names, G.shape[1])]

        copied, comparison = list(_copied(kept, self.campaign)), compare(_pairs(kept), response)
        if comparison is None:
            if self.expectation.response is None:
                return _not_compared(kept, copied, "no model was given", "ok")
            return _not_compared(kept, copied, "too few driven samples", "note")
        faults = explain(comparison)
        picture = _order_picture(faults, self.campaign, comparison)
        order = [*copied, *_exchanged(faults, self.campaign, comparison.settings.least_agreement, picture)]
        order = order or [_right(faults, self.campaign, comparison, picture)]
        return [*order, *_polarity(faults, self.campaign, comparison)]


def _not_compared(kept: list[_Kept], copied: list[Finding], why: str, severity: Severity) -> list[Finding]:
    sentence = f"No channel is a copy of another; their order was not compared with a model ({why})."
    order = copied or [Finding(ORDER, severity, sentence, picture=_copy_picture(kept))]
    return [*order, Finding(POLARITY, severity, f"Polarity was not compared with a model ({why}).")]


def _copied(kept: list[_Kept], campaign: Campaign) -> Iterator[Finding]:
    names = campaign.y_names
    for i, k in sorted({(i, k) for of in kept for i, k, _, _ in of.copies}):
        hits = [(of.record, scale, rest) for of in kept for a, b, scale, rest in of.copies if (a, b) == (i, k)]
        _, scale, rest = hits[0]
        if len(hits) < len(kept) or any(abs(s - scale) > 2 * COPIES.different * abs(scale) for _, s, _ in hits):
            continue
        models = [of.model for of in kept]
        alike = all(m is not None and _difference(m.y[:, i], m.y[:, k]) < COPIES.alike for m in models)
        severity: Severity = "note" if alike else "stop"
        cause = (
            "the model expects that of these records, so they do not show whether one signal was recorded twice. "
            "Excite other axes, too."
            if alike
            else "one signal was recorded twice. Check the wiring and the channel list; leave one of them out."
        )
        sentence = (
            f"Channel {names[k]!r} is {names[i]!r} times {scale:.6g} within {100 * rest:.2g} % of its r.m.s. in every "
            f"record: {cause}"
        )
        pair, records = (names[i], names[k]), tuple(record for record, _, _ in hits)
        yield Finding(ORDER, severity, sentence, pair, records, rest, COPIES.different, _copy_picture(kept))


def _exchanged(faults: Faults, campaign: Campaign, least: float, picture: Picture) -> Iterator[Finding]:
    sensors, drives = campaign.y_names, campaign.u_names
    for kind, what, p, names in (("row", "Sensor", faults.p, sensors), ("column", "Drive", faults.q, drives)):
        for cycle in (cycle_of(p, i) for i in range(len(p))):
            if len(cycle) == 1 or cycle[0] > min(cycle):
                continue
            if kind == "row":
                gain = min(faults.other[j] - faults.own[j] for j in cycle)
                listed = "; ".join(
                    f"the correlation of {names[j]!r} with the model's {names[int(p[j])]!r} is "
                    f"{faults.other[j]:.2f}, with its own {faults.own[j]:.2f}"
                    for j in cycle
                )
            else:
                of, before, after = faults.columns[cycle[0]]
                gain = after - before
                listed = f"exchanging them raises the correlation of {sensors[of]!r} from {before:.2f} to {after:.2f}"
            pair = tuple(names[j] for j in cycle)
            verb = "are exchanged" if len(pair) == 2 else "are mixed up"
            p_value = max(faults.p_value[kind, j] for j in cycle)
            sentence = (
                f"{what}s {' and '.join(map(repr, pair))} {verb}: {listed} (1 is perfect; gain and delay are fitted; "
                f"p-value at most {p_value:.1g}). Exchange their names or their cables."
            )
            yield Finding(ORDER, "stop", sentence, pair, value=gain, limit=least, picture=picture)


def _right(faults: Faults, campaign: Campaign, comparison: ModelComparison, picture: Picture) -> Finding:
    worst, enough = int(np.argmin(faults.other)), comparison.settings.least_agreement
    lowest = float(faults.other[worst])
    least = f"the lowest correlation is {lowest:.2f}, of {campaign.y_names[worst]!r}"
    alone = those(campaign.y_names, faults.other < enough)
    severity: Severity = "ok"
    channels: tuple[str, ...] = ()
    if faults.doubtful:
        names = [(campaign.y_names if what == "row" else campaign.u_names)[k] for what, k in faults.doubtful]
        severity = "note"
        sentence = (
            f"The agreement of model and records is too poor to check the order of the channels ({least}; another "
            f"order or sign of {quoted(names)} would agree better, but an inaccurate model can cause that, too). Check "
            "the channel list by hand."
        )
    elif alone and 2 * len(alone) < len(faults.other):
        severity, channels = "warning", alone
        low, high = comparison.settings.delay_s
        sentence = (
            f"Sensor {quoted(alone)} agrees with no response of the model (correlation as low as {lowest:.2f}), while "
            f"the others do. Its signal is more than {1000 * high:g} ms late or {-1000 * low:g} ms early, or the "
            "channel list is wrong, or the model lacks an effect there."
        )
    elif alone:
        severity = "note"
        sentence = (
            f"The model agrees with too few sensors to check the order of the channels ({least}). Check the channel "
            "list by hand."
        )
    else:
        sentence = f"No other order of the channels agrees better with the model ({least})."
    return Finding(ORDER, severity, sentence, channels, value=lowest, limit=enough, picture=picture)


def _order_picture(faults: Faults, campaign: Campaign, comparison: ModelComparison) -> Picture:
    a = faults.r[:, None] * comparison.agreement(faults.q, faults.c)
    x = np.arange(len(a))
    others = np.max(np.where(np.eye(len(a), dtype=bool), -np.inf, a), axis=1) if len(a) > 1 else np.zeros(1)
    return Picture(
        "Sensors against the model",
        "sensor",
        "correlation [-]",
        (Series("own expected response", x, np.diag(a), "points"), Series("best other", x, others, "points")),
        (Limit("least that counts as evidence", comparison.settings.least_agreement),),
        x_names=campaign.y_names,
    )


def _polarity(faults: Faults, campaign: Campaign, comparison: ModelComparison) -> Iterator[Finding]:
    """Flipped sensors and drives, or that there are none."""
    least, lowest = comparison.settings.least_agreement, float(faults.other.min())
    heights, limit = dict(zip(campaign.y_names, faults.r * faults.other, strict=True)), Limit("opposite sign", -least)
    picture = bars("Signed correlation with the model", "sensor", "correlation [-]", heights, (limit,))
    rows, columns = ([int(k) for k in np.flatnonzero(signs < 0)] for signs in (faults.r, faults.c))
    if faults.doubtful:
        sentence = "The signs could not be checked: the agreement of model and records is too poor."
        yield Finding(POLARITY, "note", sentence, value=lowest, limit=least, picture=picture)
    elif not rows and not columns:
        sentence = f"All signs agree with the model (lowest correlation of a sensor {lowest:.2f})."
        yield Finding(POLARITY, "ok", sentence, value=lowest, limit=least, picture=picture)
    either = 2 * (len(rows) + len(columns)) == len(faults.r) + np.count_nonzero(comparison.moving)
    doubt = " It is equally possible that all other channels are reversed." if either else ""
    said = []
    for k in rows:
        value = -float(faults.other[k])
        how = f"correlation {value:.2f} where +1 is expected"
        said.append(("Sensor", campaign.y_names[k], value, how, faults.p_value["row", k]))
    for k in columns:
        of, before, after = faults.columns[k]
        how = f"reversing it raises the correlation of sensor {campaign.y_names[of]!r} from {before:.2f} to {after:.2f}"
        said.append(("Drive", campaign.u_names[k], before - after, how, faults.p_value["column", k]))
    for what, name, value, how, p_value in said:
        sentence = (
            f"{what} {name!r} has the opposite sign of the model ({how}; p-value at most {p_value:.1g}). Its leads are "
            "exchanged, or the model's axis has the opposite direction. Exchange the leads or reverse the sign of the "
            f"channel.{doubt}"
        )
        yield Finding(POLARITY, "stop", sentence, (name,), value=value, limit=-least, picture=picture)


def predicted(response: Response, measured: Samples, inputs: tuple[str, ...]) -> np.ndarray:
    """(samples, n_y) y of the model, starting from rest; periodic if the samples wrap."""
    samples = len(measured.u)
    n = samples if measured.wrap else 2 * samples
    f = np.fft.rfftfreq(n, 1 / measured.rate_Hz)
    U = np.fft.rfft(measured.u, n, axis=0)
    # The model's response is not needed on lines 60 dB below the largest.
    power = np.sum(np.abs(U) ** 2, axis=1)
    keep = power > 1e-6 * power.max(initial=0.0)
    keep[0] = False
    if not keep.any():
        return np.zeros((samples, 0))
    G = response(2 * np.pi * f[keep], inputs)
    Y = np.zeros((len(f), G.shape[1]), complex)
    Y[keep] = np.einsum("fij,fj->fi", G, U[keep])
    return np.fft.irfft(Y, n, axis=0)[:samples]


def _pairs(kept: list[_Kept]) -> list[tuple[Spectra, Spectra]]:
    """Measured and expected spectra, with the longest segments that all records together allow: records that drive one
    axis after the other are short, but many.
    """
    held = [(k.measured, k.model) for k in kept if k.measured is not None and k.model is not None]
    if not held:
        return []
    rank = directions(np.concatenate([one.u - one.u.mean(axis=0) for one, _ in held])).shape[1]
    samples = [len(one.u) for one, _ in held]
    length = min(segment_length(sum(samples), rank), 1 << int(np.log2(max(16, min(samples)))))
    return [(one.spectra(length), model.spectra(length)) for one, model in held]


def _order(names: tuple[str, ...], expected: tuple[str, ...] | None, rows: int) -> list[int] | None:
    """Rows of the model in the order of the campaign's channels; None if they do not correspond."""
    if expected is None:
        return list(range(rows)) if rows == len(names) else None
    return [expected.index(n) for n in names] if set(names) <= set(expected) and len(expected) == rows else None


def _copies(seen: Excerpt) -> list[tuple[int, int, float, float]]:
    """(i, k, scale, relative difference): y_k = scale y_i + constant, within `CopySettings.different`."""
    y = seen.first.y - seen.first.y.mean(axis=0)
    if len(y) < COPIES.fewest:
        return []
    power = np.sum(y**2, axis=0)
    return [
        (i, k, float(y[:, i] @ y[:, k] / power[i]), rest)
        for i, k in combinations(range(y.shape[1]), 2)
        if (rest := _difference(y[:, i], y[:, k])) < COPIES.different
    ]


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    """R.m.s. of b minus the best multiple of a, relative to b's; infinite if either is zero."""
    aa, bb = float(a @ a), float(b @ b)
    return max(0.0, 1 - float(a @ b) ** 2 / (aa * bb)) ** 0.5 if aa > 0 and bb > 0 else np.inf


def _copy_picture(kept: list[_Kept]) -> Picture:
    count = np.array([len(k.copies) for k in kept])
    return Picture(
        "Pairs of channels that are copies",
        "record number",
        "pairs [-]",
        (Series("pairs", np.arange(len(count)), count, "points"),),
    )
