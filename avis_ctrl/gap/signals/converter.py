"""Resolution and clipping of a channel's converter, where they are worse than stated in the rig file.

Resolution. The values of a signal with quantisation step q are near q k + b, with integer k. The characteristic
function of its amplitudes, phi(nu) = mean exp(2 pi j nu y), then has modulus near 1 at nu = 1/q, where that of a smooth
distribution of standard deviation s is close to 0 (Widrow and Kollar, Quantization Noise, 2008, chapter 4). If the
values are rounded again to the nominal lsb, it is at least sinc(lsb/q). phi is the transform of the histogram of codes.
Signals of only a few steps have no useful phi. Their step shows in the gaps between the codes in use: noise of one lsb
never leaves the code next to its most frequent one empty.

Clipping. The extreme value of the whole campaign repeats far more often than a smooth signal allows
(`measurement.gates.clipping.repeated_extreme`), well inside the nominal range.

Nominal range and resolution are part of the model and are not reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.fft

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.clipping import repeated_extreme
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class ConverterSettings:
    """Settings of the check of converters.

    false_alarm : probability of a false alarm in a clean campaign, over all channels, ends and records [1].
    least_step : smallest step that is reported [nominal lsb]: two, minus the possible error of an estimate.
    least_phi : minimum modulus of the characteristic function for a comb of such a step [1]: sinc(1/2) = 0.64 at two.
    free_of_signal : cycles per standard deviation from which the characteristic function of a smooth signal has died
        out (the Bessel function of a sine comes last).
    on_the_comb : minimum fraction of the codes in use that are within one code of the comb [1]: the rest is noise added
        after the quantisation.
    few_codes : codes in use up to which a signal counts as one of few steps, without a useful characteristic function.
    off_the_mode : minimum number of samples off the most frequent code: with fewer, the signal never left its code.
    neighbour : minimum probability of the code next to the most frequent one [1]: for noise of 0.3 lsb and more, at any
        offset.
    nominal_margin : distance of a clip level from the nominal limit below which it is the nominal one [lsb]: offsets of
        converters.
    longest : maximum number of samples of a record that are inspected: more add nothing new.
    """

    false_alarm: float = 1e-3
    least_step: float = 1.9
    least_phi: float = 0.5
    free_of_signal: float = 2.0
    on_the_comb: float = 0.9
    few_codes: int = 40
    off_the_mode: int = 20
    neighbour: float = 0.02
    nominal_margin: float = 4.0
    longest: int = 1 << 20


SETTINGS = ConverterSettings()


@dataclass(frozen=True, eq=False)
class ConverterFinding:
    """One difference of one channel's converter from the rig file.

    parameters : "resolution_V" (step between values), or "clip_high_V" and/or "clip_low_V" (values where it clips).
    confidence : 1 - p, p an upper bound on the probability that a channel as in the rig file shows this anywhere in the
        campaign.
    """

    channel: str
    kind: Literal["resolution", "clipping"]
    parameters: dict[str, Reported]
    confidence: float
    sentence: str


@dataclass(frozen=True, eq=False)
class _Samples:
    """Distinct values of one channel in one record, and how often each occurs.

    codes : nominal codes nearest to the `inside` samples in the nominal range; spread : their standard deviation;
    travelled : sum of their changes from sample to sample.
    """

    record: str
    periods: int
    values: np.ndarray
    value_counts: np.ndarray
    codes: np.ndarray
    code_counts: np.ndarray
    inside: int
    spread: float
    travelled: int

    @staticmethod
    def of(record: str, periods: int, y: np.ndarray, nominal: Converter) -> _Samples:
        within = (y > nominal.limits_V[0] + nominal.lsb_V) & (y < nominal.limits_V[1] - nominal.lsb_V)
        codes = np.rint(y[within] / nominal.lsb_V).astype(np.int64)
        return _Samples(
            record,
            periods,
            *np.unique(y, return_counts=True),
            *np.unique(codes, return_counts=True),
            len(codes),
            float(codes.std()) if len(codes) else 0.0,
            int(np.abs(np.diff(codes)).sum()),
        )


def nominal_converter(rig: Rig) -> Converter:
    """The converter of the rig file.

    Raises
    ------
    InputError : a rig without geophones or acquisition.
    """
    if rig.converter is None:
        raise InputError("the rig file describes no converter", field="acquisition")
    return rig.converter


def inspect_converter(campaign: Campaign, rig: Rig) -> tuple[ConverterFinding, ...]:
    """Properties of each sensor's converter that are worse than stated in the rig file; empty if there are none.

    A step is detected from 1.9 nominal lsb on, a clip level if about 40 samples reach it (8 per period of a periodic
    record). One record is in memory at a time.

    Raises
    ------
    InputError : y not in V, a rig without converter.
    """
    if campaign.y_unit != "V":
        raise InputError(
            "expected V: the converter's steps are seen in its own unit", field="unit of y", value=campaign.y_unit
        )
    nominal = nominal_converter(rig)
    of_channel: dict[str, list[_Samples]] = {name: [] for name in campaign.y_names}
    for source in campaign.records:
        h = source.header
        record = source.load(0, min(h.samples, SETTINGS.longest))
        for k, name in enumerate(h.y_names):
            of_channel[name].append(_Samples.of(h.name, max(1, record.header.periods), record.y[:, k], nominal))
    tests = len(of_channel)
    found: list[ConverterFinding | None] = []
    for name, of in of_channel.items():
        step = _resolution(name, of, nominal, SETTINGS.false_alarm / (2 * tests))
        lsb = step.parameters["resolution_V"].value if step else nominal.lsb_V
        found += [step, _clipping(name, of, nominal, lsb, SETTINGS.false_alarm / (4 * tests))]
    return tuple(one for one in found if one is not None)


@dataclass(frozen=True)
class _Step:
    """Step q [lsb] with its standard error, and the probability p of such a step in a clean channel."""

    q: float
    std: float
    p: float


def _resolution(name: str, of: Sequence[_Samples], nominal: Converter, level: float) -> ConverterFinding | None:
    varying = [one for one in of if one.inside > 1]
    step = (_gaps(varying) or _comb(varying)) if varying else None
    if step is None or step.p > level:
        return None
    lsb = nominal.lsb_V
    value, std = step.q * lsb, step.std * lsb
    bits = np.log2(2 * nominal.range_V / value)
    return ConverterFinding(
        name,
        "resolution",
        {"resolution_V": Reported(value, std, "V")},
        1 - min(1.0, step.p),
        f"Sensor {name} is converted in steps of {1e3 * value:.4g} +- {1e3 * std:.2g} mV, {step.q:.3g} times the"
        f" {1e3 * lsb:.4g} mV of the rig file: {bits:.2f} instead of {nominal.bits} bits over its range.",
    )


def _comb(of: Sequence[_Samples]) -> _Step | None:
    """The step whose comb appears in |phi|, from the records that extend over enough steps."""
    low = min(int(one.codes.min()) for one in of)
    size = scipy.fft.next_fast_len(4 * (max(int(one.codes.max()) for one in of) - low + 1), real=True)
    nu = np.arange(size // 2 + 1) / size
    total, weight, travelled = np.zeros(len(nu)), np.zeros(len(nu)), np.zeros(len(nu))
    for one in of:
        if one.spread * nu[-1] < SETTINGS.free_of_signal:
            continue
        phi = np.abs(scipy.fft.rfft(np.bincount(one.codes - low, one.code_counts), size)) / one.inside
        free = nu >= SETTINGS.free_of_signal / one.spread
        n = float(one.inside)
        total[free] += n * phi[free]
        weight[free] += n
        # Each step that the signal crosses is one independent sample of where the values lie within a step.
        travelled += free * np.minimum(n, one.travelled * nu)
    usable = (weight > 0) & (nu <= 1 / SETTINGS.least_step)
    if not usable.any():
        return None
    mean = np.where(usable, total / np.maximum(weight, 1), 0.0)
    high = np.flatnonzero(mean >= max(SETTINGS.least_phi, 0.85 * mean.max()))
    if not high.size:
        return None
    # The lowest frequency of the comb is 1/q; its peak has the width of the transform.
    run = high[: int(np.argmax(np.append(np.diff(high), 2) > 1)) + 1]
    at = int(run[np.argmax(mean[run])])
    fitted = _fitted(of, 1 / nu[at])
    if fitted is None:
        return None
    q, std = fitted
    bound = np.log(len(nu)) - travelled[at] * mean[at] ** 2
    return _Step(q, std, float(np.exp(min(bound, 0.0))))


def _all_codes(of: Sequence[_Samples]) -> tuple[np.ndarray, np.ndarray]:
    """Codes in use in any record, and how often each occurs in all of them."""
    codes, at = np.unique(np.concatenate([one.codes for one in of]), return_inverse=True)
    return codes, np.bincount(at, np.concatenate([one.code_counts for one in of])).astype(int)


def _fitted(of: Sequence[_Samples], q: float) -> tuple[float, float] | None:
    """q by least squares of the distinct codes over their numbers k, widening from the middle, where k is certain.

    None if the codes in use do not lie on the comb: samples concentrated at a few levels have a large phi, too.
    """
    codes, counts = _all_codes(of)
    middle = float(codes[np.argmax(counts)])
    x = codes - middle
    b = 0.0
    for reach in np.geomspace(8 * q, max(np.abs(x).max(), 16 * q), 12):
        near = np.abs(x) <= reach
        k = np.rint((x[near] - b) / q)
        if np.ptp(k) < 2:
            continue
        q, b = (float(c) for c in np.polyfit(k, x[near], 1))
    k = np.rint((x - b) / q)
    if np.mean(np.abs(x - b - q * k) <= 1.0) < SETTINGS.on_the_comb:
        return None
    # The error is at least that of rounding to the nominal lsb, even if the comb happens to fit exactly.
    rest = max(float(np.std(x - b - q * k)), 1 / np.sqrt(12.0))
    return q, rest / max(float(k.std()) * np.sqrt(len(k)), 1e-9)


def _gaps(of: Sequence[_Samples]) -> _Step | None:
    """The step of a signal with only a few values, from the unused codes between them."""
    codes, counts = _all_codes(of)
    off = int(counts.sum() - counts.max())
    if not 2 <= len(codes) <= SETTINGS.few_codes or off < SETTINGS.off_the_mode:
        return None
    steps = np.diff(codes)
    smallest = int(steps.min())
    if smallest < 2:
        return None
    # A step that is not an integer number of codes appears as two integer steps that differ by one.
    k = np.concatenate([[0], np.cumsum(np.rint(steps / steps[steps <= smallest + 1].mean()))])
    q = float(np.polyfit(k, codes, 1)[0])
    std = 1 / np.sqrt(6.0) / max(float(k[-1]), 1.0)
    # Probability that both neighbours of the most frequent code are empty in so many samples.
    return _Step(q, std, float((1 - SETTINGS.neighbour) ** min(counts.sum(), 1e5)))


def _clipping(
    name: str, of: Sequence[_Samples], nominal: Converter, lsb: float, level: float
) -> ConverterFinding | None:
    """Clipping at either end of a channel's range."""
    parameters, p_all, count, records = {}, 0.0, 0, set()
    for end, sign, bound in (("low", -1.0, -nominal.limits_V[0]), ("high", 1.0, nominal.limits_V[1])):
        made = _plateau(of, sign, bound, nominal.lsb_V, lsb, level)
        if made is None:
            continue
        top, width, p, where = made
        std = max(lsb / np.sqrt(12.0), width / np.sqrt(12.0))
        parameters[f"clip_{end}_V"] = Reported(sign * top, std, "V")
        p_all = max(p_all, 4 * p)
        count += sum(where.values())
        records |= set(where)
    if not parameters:
        return None
    levels = " and ".join(f"{e.value:.4g}" for e in parameters.values())
    names = tuple(one.record for one in of if one.record in records)
    return ConverterFinding(
        name,
        "clipping",
        parameters,
        1 - min(1.0, p_all),
        f"Sensor {name} clips at {levels} V, {count} samples of record{'s' if len(names) > 1 else ''}"
        f" {', '.join(names)}; the rig file's converter ends at {nominal.limits_V[0]:.4g} and"
        f" {nominal.limits_V[1]:.4g} V.",
    )


def _plateau(
    of: Sequence[_Samples], sign: float, bound: float, nominal_lsb: float, lsb: float, level: float
) -> tuple[float, float, float, dict[str, int]] | None:
    """Level, width, p-value and samples by record of a flat end that no record exceeds."""
    top = max(float(np.max(sign * one.values)) for one in of)
    if top <= 0 or top > bound - max(SETTINGS.nominal_margin * nominal_lsb, lsb):
        return None
    best, widest = 1.0, 0.0
    near = [one for one in of if float(np.max(sign * one.values)) >= top - max(2 * lsb, top / 256)]
    for one in near:
        _, p, width = repeated_extreme(sign * np.repeat(one.values, one.value_counts), one.periods)
        if p * len(of) < best:
            best, widest = p * len(of), width
    if best > level:
        return None
    at = {one.record: int(one.value_counts[sign * one.values >= top - max(widest, lsb / 2)].sum()) for one in near}
    return top, widest, best, at
