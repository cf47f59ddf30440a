"""Mains lines in the residual of a model: one fundamental near 50 or 60 Hz, its harmonics, all records and channels.

A line at k f0 is compared with nearby lines that contain the same mixture of noise, model error and distortion. For a
periodic record with P periods these are the lines at offsets 2 P j: they are in the same position relative to the
harmonics of the period, and odd harmonics are compared with odd ones. For other records they are the next lines beyond
the main lobe of the Hann window. Let z be the line's power over the mean of the louder side of m lines. For noise, z
has the distribution F(2, 2m), whose tail is (1 + z/m)^-m. m log(1 + z/m) is then exponential with mean 1, and its sum
over records is gamma distributed (Fisher 1925). A Bonferroni correction accounts for the search over f0, harmonics and
channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats
from scipy.signal.windows import hann

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.signals.record_residual import RecordResidual
from avis_ctrl.identification.clusters import widening

MAINS_HZ = (50.0, 60.0)
# int w^2 t^2 dt / (int w t^2 dt)^2 of a Hann window over the same without window: 28.1 / 12.
HANN_COST = 2.34


@dataclass(frozen=True)
class HumSettings:
    """Settings of the search for mains hum.

    search_Hz : half width of the band about 50 and 60 Hz in which the fundamental is searched [Hz]; grids keep their
        frequency within it.
    false_alarm : probability of a false alarm in a whole campaign [1]: one user in a thousand is misled.
    least_ratio : minimum mean power of a line over that of its neighbours [1]: noise floors are not quite flat.
    neighbours : lines on either side with which a line is compared: enough for their mean, few enough for a flat floor.
    guard : lines omitted next to the tested one: the main lobe of a Hann window is two lines wide.
    polluted_lines : half width of a polluted band in a transform without window, whose side lobes fall slowly [lines].
    """

    search_Hz: float = 0.3
    false_alarm: float = 1e-3
    least_ratio: float = 3.0
    neighbours: int = 12
    guard: int = 3
    polluted_lines: int = 3


SETTINGS = HumSettings()


@dataclass(frozen=True)
class HumLine:
    """A harmonic in one channel: peak amplitude [unit of y] over the records, weighted by their noise.

    ratio : power over that of the neighbouring lines, mean of the records.
    """

    channel: str
    harmonic: int
    amplitude: Reported
    ratio: float


@dataclass(frozen=True, eq=False)
class HumFinding:
    """Mains hum.

    frequency_Hz : the fundamental, common to all records. nominal_Hz : 50 or 60.
    lines : significant harmonics and channels, the largest first.
    parameters : "frequency_Hz", and "amplitude_V" of the largest line (in the unit of y).
    confidence : 1 - p, p the probability of a line as significant as the most significant one anywhere in a campaign
        without hum.
    """

    nominal_Hz: float
    frequency_Hz: Reported
    lines: tuple[HumLine, ...]
    parameters: dict[str, Reported]
    confidence: float
    sentence: str

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels with hum."""
        return tuple(sorted({line.channel for line in self.lines}))

    @property
    def harmonics(self) -> tuple[int, ...]:
        """Harmonics found in any channel."""
        return tuple(sorted({line.harmonic for line in self.lines}))


@dataclass(frozen=True, eq=False)
class _Score:
    """For a nominal frequency: f0 grid (n,); score, ratio (n, harmonics, channels); tests: number of records in each
    score."""

    nominal_Hz: float
    f0: np.ndarray
    score: np.ndarray
    ratio: np.ndarray
    tests: np.ndarray

    @property
    def p(self) -> np.ndarray:
        """P-value of each line by itself; 1 if it is not `least_ratio` times as strong as its neighbours."""
        tested = (self.tests > 0) & (self.ratio > SETTINGS.least_ratio)
        return np.where(tested, stats.gamma.sf(self.score, np.maximum(self.tests, 1)), 1.0)


def find_hum(residuals: Sequence[RecordResidual]) -> HumFinding | None:
    """The hum in the residual of a model, None if no line is significant.

    Tests the residual at every harmonic below 0.98 of half the sample rate, driven or not; a driven line whose
    neighbours are not driven is skipped. Takes a transform of each record and about 10 ms.
    """
    scores = [_scores(residuals, nominal) for nominal in MAINS_HZ]
    trials = sum(int(np.count_nonzero(one.tests)) for one in scores)
    each = [one.p for one in scores]
    chance = min(1.0, min(float(p.min()) for p in each) * trials)
    if chance > SETTINGS.false_alarm:
        return None
    # p underflows where lines are strong; there the sum of the scores decides between the frequencies. 300 Hz is a
    # harmonic of both mains frequencies, other lines belong to one of them.
    surest = [p * trials <= SETTINGS.false_alarm for p in each]
    strength = [np.sum(np.where(sure, one.score, 0.0), axis=(1, 2)) for one, sure in zip(scores, surest, strict=True)]
    which = int(np.argmax([sums.max() for sums in strength]))
    best, sure, at = scores[which], surest[which], int(np.argmax(strength[which]))
    frequency = _refined(residuals, float(best.f0[at]), np.argwhere(sure[at]))
    # With the frequency known, further lines are tested at its harmonics only.
    there = _scores(residuals, best.nominal_Hz, np.array([frequency.value]))
    own = there.p[0]
    hits = np.argwhere((own < SETTINGS.false_alarm / own.size) | sure[at])
    frequency = _refined(residuals, frequency.value, hits)
    lines = _lines(residuals, frequency.value, hits, there.ratio[0])
    largest, header, nominal = lines[0], residuals[0].header, best.nominal_Hz
    lines_Hz = ", ".join(f"{k * nominal:g}" for k in sorted({line.harmonic for line in lines}))
    channels = sorted({line.channel for line in lines}, key=header.y_names.index)
    A = largest.amplitude
    sentence = (
        f"Mains hum of {frequency.value:.4f} +- {frequency.std:.1g} Hz with lines at {lines_Hz} Hz in"
        f" {', '.join(channels)}; the largest, at {largest.harmonic * nominal:g} Hz in {largest.channel}, has"
        f" {1e3 * A.value:.4g} +- {1e3 * A.std:.2g} m{header.y_unit} peak, {10 * np.log10(largest.ratio):.0f} dB above"
        " the lines next to it."
    )
    return HumFinding(nominal, frequency, lines, {"frequency_Hz": frequency, "amplitude_V": A}, 1 - chance, sentence)


def polluted(
    finding: HumFinding, samples: int, sample_rate_Hz: float, half_lines: int = SETTINGS.polluted_lines
) -> np.ndarray:
    """(samples // 2 + 1,) mask of the lines of a record's transform that hum reaches, to be left out of a fit.

    half_lines : on either side of each harmonic found in any channel. A transform without window leaks as 1/distance,
        so that at most 1/(pi half_lines) of the amplitude remains.
    """
    mask = np.zeros(samples // 2 + 1, bool)
    for k in finding.harmonics:
        middle = k * finding.frequency_Hz.value * samples / sample_rate_Hz
        low, high = int(np.ceil(middle - half_lines)), int(np.floor(middle + half_lines))
        mask[max(low, 0) : high + 1] = True
    return mask


def subtract(
    finding: HumFinding, e: np.ndarray, y: np.ndarray, sample_rate_Hz: float, channels: Sequence[str]
) -> np.ndarray:
    """(samples, n_y) y minus the sines of the detected lines, with amplitudes and phases fitted to e (samples, n_y).

    e : the residual of the same record, so that the response to u at these frequencies remains.
    """
    cleaned = np.array(y, float)
    f0 = finding.frequency_Hz.value
    for j, name in enumerate(channels):
        ks = [line.harmonic for line in finding.lines if line.channel == name]
        if ks:
            A = _sines(f0, ks, len(e), sample_rate_Hz)
            cleaned[:, j] -= A @ _fitted(A, e[:, j])
    return cleaned


def _scores(residuals: Sequence[RecordResidual], nominal: float, f0: np.ndarray | None = None) -> _Score:
    """Scores at f0 (n,), by default on a grid within `search_Hz` of the nominal frequency."""
    h = residuals[0].header
    duration = max(one.header.duration_s for one in residuals)
    top = int(0.49 * h.sample_rate_Hz / (nominal + SETTINGS.search_Hz))
    if f0 is None:
        n = int(np.ceil(2 * SETTINGS.search_Hz * 2 * duration * max(top, 1))) + 1
        f0 = np.linspace(nominal - SETTINGS.search_Hz, nominal + SETTINGS.search_Hz, n)
    shape = (len(f0), top, len(h.y_names))
    score, tests, ratio = np.zeros(shape), np.zeros(shape, int), np.zeros(shape)
    for one in residuals:
        _add(one, f0, score, tests, ratio)
    return _Score(nominal, f0, score, ratio / np.maximum(tests, 1), tests)


def _offsets(one: RecordResidual) -> np.ndarray:
    """Distances, in lines, of the lines with which a line is compared."""
    stride = 2 * one.periods or 1
    return max(stride, SETTINGS.guard + 1) + stride * np.arange(SETTINGS.neighbours)


def _add(one: RecordResidual, f0: np.ndarray, score: np.ndarray, tests: np.ndarray, ratio: np.ndarray) -> None:
    """Add the contribution of a record, harmonic by harmonic; a line is evaluated once however many f0 fall on it."""
    power, df = np.abs(one.E) ** 2, one.frequency_Hz[1]
    offsets = _offsets(one)
    for k in range(1, score.shape[1] + 1):
        bins, back = np.unique(np.rint(k * f0 / df).astype(int), return_inverse=True)
        inside = (bins - offsets[-1] >= 1) & (bins + offsets[-1] < len(power) - 1)
        b = np.where(inside, bins, offsets[-1] + 1) if inside.any() else None
        if b is None or 2 * offsets[-1] + 2 >= len(power):
            continue
        sides = [power[b[:, None] + sign * offsets].mean(axis=1) for sign in (-1, 1)]
        floor = np.maximum(*sides)
        z = power[b] / np.maximum(floor, 1e-300)
        usable = inside[:, None] & (floor > 0)
        if one.header.excitation != "noise":
            # A driven line among silent neighbours is excitation, not hum.
            alike = (one.driven[b[:, None] + offsets].mean(1) + one.driven[b[:, None] - offsets].mean(1)) / 2
            usable &= ~(one.driven[b] & (alike < 0.5))[:, None]
        s = SETTINGS.neighbours * np.log1p(z / SETTINGS.neighbours)
        score[:, k - 1] += np.where(usable, s, 0.0)[back]
        ratio[:, k - 1] += np.where(usable, z, 0.0)[back]
        tests[:, k - 1] += usable[back]


def _sines(f0: float, harmonics: Sequence[int], samples: int, rate: float) -> np.ndarray:
    """(samples, 2 n) cosines and sines."""
    phase = 2 * np.pi * f0 / rate * np.arange(samples)[:, None] * np.asarray(harmonics)
    return np.hstack([np.cos(phase), np.sin(phase)])


def _fitted(A: np.ndarray, e: np.ndarray) -> np.ndarray:
    return np.linalg.solve(A.T @ A, A.T @ e)


def _spread(one: RecordResidual, f: float) -> np.ndarray:
    """(n_y,) variance of the cosine or sine amplitude of a line: 2 s^2 / N, s^2 from comparable lines near f."""
    b, offsets = round(f / one.frequency_Hz[1]), _offsets(one)
    near = np.clip(np.concatenate([b - offsets, b + offsets]), 1, len(one.E) - 1)
    return 2 * np.mean(np.abs(one.E[near]) ** 2, axis=0) / one.header.samples


@dataclass(frozen=True, eq=False)
class _Demodulated:
    """A line of a record, shifted to zero frequency: harmonic, times t (n,) [s], complex values (n,) averaged over some
    samples, variance of the cosine or sine amplitude, and duration [s]."""

    harmonic: int
    t: np.ndarray
    values: np.ndarray
    variance: float
    duration_s: float

    def mean(self, shift_Hz: float) -> float:
        """Magnitude of the mean, a quarter of the amplitude, if the fundamental is higher by `shift_Hz`."""
        return float(abs(np.mean(self.values * np.exp(-2j * np.pi * self.harmonic * shift_Hz * self.t))))

    def information(self, shift_Hz: float) -> float:
        """Inverse variance of the fundamental [1/Hz^2]: of a sine in white noise, var(2 pi f) = 12 v/(A T)^2 with v the
        variance of the cosine or sine amplitude (Rife and Boorstyn 1974), times the cost of the window."""
        A2 = (4 * self.mean(shift_Hz)) ** 2
        size = max(A2 - 2 * self.variance, 0.0) / self.variance
        return (2 * np.pi * self.harmonic * self.duration_s) ** 2 * size / 12 / HANN_COST


def _demodulated(one: RecordResidual, f0: float, hits: np.ndarray) -> list[_Demodulated]:
    """Significant lines of a record, without channels that are constant; about 64 values each make the fine search
    cheap."""
    n, rate = one.header.samples, one.header.sample_rate_Hz
    window, block, found = hann(n, sym=False), max(n // 64, 1), []
    for k, j in hits:
        variance = float(_spread(one, (k + 1) * f0)[j])
        if not variance:
            continue
        turned = one.e[:, j] * window * np.exp(-2j * np.pi * (k + 1) * f0 / rate * np.arange(n))
        coarse = turned[: n // block * block].reshape(-1, block).mean(axis=1)
        t = (np.arange(len(coarse)) * block + (block - 1) / 2) / rate
        found.append(_Demodulated(int(k) + 1, t, coarse, variance, n / rate))
    return found


def _refined(residuals: Sequence[RecordResidual], start: float, hits: np.ndarray) -> Reported:
    """f0 by least squares over all significant lines, with free amplitudes and phases in each record.

    Its variance is that of sines in noise (`_Demodulated.information`), increased by the scatter between the records
    (`_std_of_mean`): the frequency of the mains varies by some mHz.
    """
    records = [_demodulated(one, start, hits) for one in residuals]

    def best(lines: Sequence[_Demodulated]) -> float:
        reach = 1 / max(one.duration_s for one in lines)
        found = optimize.minimize_scalar(
            lambda shift: -sum(one.mean(shift) ** 2 / one.variance for one in lines),
            bounds=(-reach, reach),
            method="bounded",
            options={"xatol": 1e-5 * reach},
        )
        return float(found.x)

    shift = best([one for lines in records for one in lines])
    each = np.array([best(lines) if lines else shift for lines in records])
    information = [sum(one.information(own) for one in lines) for own, lines in zip(each, records, strict=True)]
    variance = np.array([1 / one if one else np.inf for one in information])
    return Reported(start + shift, _std_of_mean(each - shift, variance), "Hz")


def _std_of_mean(difference: np.ndarray, variance: np.ndarray) -> float:
    """Standard deviation of a mean with the inverse variances as weights; difference (n,) of the values from it,
    variance (n,) of each, infinite for a value that is not known.

    If the values differ by more than their variances explain, each has a variance between records in addition
    (DerSimonian and Laird, Controlled Clinical Trials 7 (1986) 177-188), so that a record with a large weight does not
    make the mean certain. One value shows no scatter.
    """
    known = np.isfinite(variance)
    d, weights = difference[known], 1 / variance[known]
    if not len(d):
        return math.inf
    total, more = float(weights.sum()), len(d) - 1
    share = weights / total
    excess = float(weights @ (d - share @ d) ** 2) - more
    between = excess / (total - float(weights @ share)) if more and excess > 0 else 0.0
    ratio = 1 + between * total * float(share @ share)
    return float(np.sqrt(widening(ratio, len(d)) / total))


def _lines(residuals: Sequence[RecordResidual], f0: float, hits: np.ndarray, ratio: np.ndarray) -> tuple[HumLine, ...]:
    names, unit, rate = residuals[0].header.y_names, residuals[0].header.y_unit, residuals[0].header.sample_rate_Hz
    found = []
    ks = sorted({int(k) + 1 for k, _ in hits})
    sizes, variances = np.zeros((2, len(residuals), len(ks), len(names)))
    for r, one in enumerate(residuals):
        A = _sines(f0, ks, one.header.samples, rate)
        c = _fitted(A, one.e)
        v = np.array([_spread(one, k * f0) for k in ks])
        # Noise adds 2 v to |a|^2 = a_c^2 + a_s^2; only its radial component changes the amplitude.
        sizes[r] = c[: len(ks)] ** 2 + c[len(ks) :] ** 2 - 2 * v
        variances[r] = np.where(v > 0, v, np.inf)  # a constant channel shows no hum
    weights = 1 / variances
    power = np.sum(weights * sizes, axis=0) / np.maximum(np.sum(weights, axis=0), 1e-300)
    for k, j in hits:
        i = ks.index(int(k) + 1)
        amplitude = float(np.sqrt(max(power[i, j], 0.0)))
        difference = np.sqrt(np.maximum(sizes[:, i, j], 0.0)) - amplitude
        size = Reported(amplitude, _std_of_mean(difference, variances[:, i, j]), unit)
        found.append(HumLine(names[j], int(k) + 1, size, float(ratio[k, j])))
    return tuple(sorted(found, key=lambda line: -line.amplitude.value))
