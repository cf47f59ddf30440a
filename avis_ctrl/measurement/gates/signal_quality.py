"""Gates for the part of y that u explains: signal-to-noise ratio and multiple coherence, by channel and band."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Severity, bars, curves, over_frequency
from avis_ctrl.measurement.gates.h1 import (
    H1,
    Samples,
    centres,
    driven_lines,
    h1,
    h1_of,
    octaves,
    spectra_of,
    thirds,
    usable,
)
from avis_ctrl.measurement.gates.periodicity import smoothed


@dataclass(frozen=True)
class QualitySettings:
    """low_dB, poor_dB : signal-to-noise ratio below which one band is a note, and all bands are a warning [dB].
    low_coherence : mean coherence of a band below which it is a note [1].
    same_level : records within this factor of the largest level are pooled [1].
    noise_factor : ratio of the noise at rest to the stated noise above which it is a warning [1].
    """

    low_dB: float = 10.0
    poor_dB: float = 0.0
    low_coherence: float = 0.5
    same_level: float = 1.4
    noise_factor: float = 3.0


SETTINGS = QualitySettings()


@dataclass(frozen=True, eq=False)
class _Noise:
    """f (n,) Hz; snr (n, n_y) signal power / noise power of one period; segment_s : segment length of a record that is
    not periodic (its segments leak), 0 for a periodic record; noise_rms (n_y,) : at rest.
    """

    f: np.ndarray
    snr: np.ndarray | None
    segment_s: float
    noise_rms: np.ndarray | None


class SignalToNoise(Gate):
    """Signal-to-noise ratio in octave bands.

    For a periodic record: power of the mean of the periods after the first over the variance between them, on the
    driven lines; otherwise coherence / (1 - coherence) with its bias removed. There is no statistical test: the numbers
    are estimates with an error of less than 1 dB if a band contains 30 lines x periods. If the sensor noise is known,
    records at rest are compared with it above half the Nyquist frequency; the random error is negligible with thousands
    of degrees of freedom.
    """

    name = "signal to noise"

    def look(self, seen: Excerpt) -> _Noise:
        noise = _high_noise(seen) if self.expectation.sensor_noise_rms_V else None
        return _Noise(*_snr(seen), noise)

    def conclude(self, kept: list[_Noise]) -> list[Finding]:
        noisy = list(self._noisy(kept))
        measured = [k for k in kept if k.snr is not None and len(k.f)]
        if not measured:
            sentence = "No driven record is long enough to separate signal and noise."
            return noisy or [Finding(self.name, "ok", sentence)]
        best = max(measured, key=lambda k: float(np.median(np.asarray(k.snr))))
        f, snr = best.f, np.asarray(best.snr)
        bands = octaves(f)
        dB = np.array([10 * np.log10(np.maximum(snr[band].mean(axis=0), 1e-6)) for band in bands])
        middle = centres(f, bands)
        series, low = curves(self.campaign.y_names, middle, dB, "points"), Limit("low", SETTINGS.low_dB)
        picture = over_frequency("Signal to noise of the best record", "ratio [dB]", series, (low,), "linear")
        found = noisy + list(self._weak(self.campaign.y_names, middle, dB, best.segment_s, picture))
        b, j = divmod(int(np.argmin(dB)), dB.shape[1])
        sentence = (
            f"Signal to noise is at least {dB[b, j]:.0f} dB in every band (lowest {self.campaign.y_names[j]!r} around "
            f"{middle[b]:.3g} Hz)."
        )
        return found or [Finding(self.name, "ok", sentence, value=dB[b, j], limit=SETTINGS.low_dB, picture=picture)]

    def _weak(
        self, names: tuple[str, ...], middle: np.ndarray, dB: np.ndarray, segment_s: float, picture: Picture
    ) -> Iterator[Finding]:
        advice = (
            f". Causes are noise, or leakage of a mode that rings longer than the segments of {segment_s:.3g} s. "
            "A periodic excitation would distinguish them; a higher level helps only against noise."
            if segment_s
            else ". Such bands have little weight in a fit; excite them more if they are important."
        )
        for name, levels in zip(names, dB.T, strict=True):
            weak, best = np.flatnonzero(levels < SETTINGS.low_dB), levels.max()
            if best < SETTINGS.poor_dB:
                sentence = (
                    f"Channel {name!r} has more noise than signal in every band (at best {best:.1f} dB at "
                    f"{middle[np.argmax(levels)]:.3g} Hz). Raise the level, or average longer."
                )
                yield Finding(self.name, "warning", sentence, (name,), (), best, SETTINGS.poor_dB, picture)
            elif weak.size:
                low = ", ".join(f"{round(float(levels[b]))} dB at {middle[b]:.3g} Hz" for b in weak)
                sentence = f"Channel {name!r} has little signal: {low}{advice}"
                yield Finding(self.name, "note", sentence, (name,), (), levels.min(), SETTINGS.low_dB, picture)

    def _noisy(self, kept: list[_Noise]) -> Iterator[Finding]:
        stated = self.expectation.sensor_noise_rms_V
        levels = [k.noise_rms for k in kept if k.noise_rms is not None]
        if stated is None or not levels:
            return
        rms = np.median(levels, axis=0)
        heights, label = dict(zip(self.campaign.y_names, rms, strict=True)), f"r.m.s. [{self.campaign.y_unit}]"
        title = "Noise of each channel, from above half the Nyquist frequency"
        picture = bars(title, "channel", label, heights, (Limit("stated", stated),), "log")
        for name, one in heights.items():
            if one > (limit := SETTINGS.noise_factor * stated):
                sentence = (
                    f"Channel {name!r} has sensor noise of {one:.3g} {self.campaign.y_unit} r.m.s., {one / stated:.1f} "
                    "times what the rig file states. Check its preamplifier and cable, or correct the rig file."
                )
                yield Finding(self.name, "warning", sentence, (name,), (), one, limit, picture)


class Coherence(Gate):
    """Multiple coherence of each channel with all inputs, over the driven records near the largest level.

    Records near the largest level are pooled, which allows long segments. The lowest frequency is that of the second
    line of a segment; if the voltage begins lower, the message states this. The bias of the estimates is removed,
    gamma^2 - (1 - gamma^2) n_u / (K - n_u), and they are averaged over third-octave bands: the plotted values are those
    that are tested. A channel that is significantly low in all bands (normal approximation of the mean, 1 % divided
    among bands and channels) is a warning. If a mode rings longer than the segments, leakage lowers the coherence there
    without any fault; the message states the length of the segments.
    """

    name = "coherence"

    def look(self, seen: Excerpt) -> tuple[float, Samples] | None:
        """Level and samples of a driven record."""
        if not seen.driven or seen.header.excitation == "sine":
            return None
        return seen.header.level_V, usable(seen)

    def conclude(self, kept: list[tuple[float, Samples] | None]) -> list[Finding]:
        driven = [k for k in kept if k is not None]
        top = max((level for level, _ in driven), default=0.0)
        chosen = [samples for level, samples in driven if level * SETTINGS.same_level >= top]
        best, seconds = _pooled(chosen)
        if best is None:
            sentence = "No driven record is long enough for a coherence of all inputs together."
            return [Finding(self.name, "ok", sentence)]
        free = best.unbiased_coherence()
        bands = thirds(best.f)
        middle = centres(best.f, bands)
        mean = np.array([free[b].mean(axis=0) for b in bands])
        # Standard deviation of an estimate of 0.5: (1 - g) sqrt(2 g / K), Bendat and Piersol table 9.6.
        z = stats.norm.isf(FINDING.false_alarm / mean.size)
        margin = np.array([z * 0.5 / np.sqrt(best.dof * max(1, int(b.sum()))) for b in bands])
        surely = np.flatnonzero(np.all(mean < SETTINGS.low_coherence - margin[:, None], axis=0)).tolist()
        series, limit = curves(self.campaign.y_names, middle, mean), SETTINGS.low_coherence
        title = f"Multiple coherence at {top:.3g} V, third octaves"
        picture = over_frequency(title, "coherence [-]", series, (Limit("low", limit),), "linear")
        below, excited = "", _lowest_driven(chosen)
        if best.f[0] > 1.5 * excited:
            below = (
                f" Below {best.f[0]:.3g} Hz, down to {excited:.3g} Hz where the voltage begins, the records are "
                "too short for a coherence of all inputs."
            )
        low = np.flatnonzero(np.any(mean < SETTINGS.low_coherence, axis=0)).tolist()
        causes = (
            "Causes are noise, an input that is not recorded, nonlinearity, or, if the signal to noise is high, "
            f"leakage of a mode that decays more slowly than the segments of {seconds:.3g} s. Longer records "
            f"distinguish leakage from the other causes; a higher level reduces the influence of noise.{below}"
        )
        found = [self._low(self.campaign.y_names, [j], middle, mean, causes, picture) for j in surely]
        if some := [j for j in low if j not in surely]:
            found.append(self._low(self.campaign.y_names, some, middle, mean, causes, picture, "note"))
        b, j = divmod(int(np.argmin(mean)), mean.shape[1])
        lowest = mean[b, j]
        sentence = (
            f"Multiple coherence is at least {lowest:.2f} in every third-octave band from {best.f[0]:.3g} to "
            f"{best.f[-1]:.3g} Hz (lowest {self.campaign.y_names[j]!r} around {middle[b]:.3g} Hz).{below}"
        )
        return found or [Finding(self.name, "ok", sentence, value=lowest, limit=limit, picture=picture)]

    def _low(
        self,
        names: tuple[str, ...],
        group: Sequence[int],
        middle: np.ndarray,
        mean: np.ndarray,
        causes: str,
        picture: Picture,
        severity: Severity = "warning",
    ) -> Finding:
        """Finding on one channel that is low everywhere (a warning), or on all that are low somewhere (a note)."""
        ordered = sorted(group, key=lambda j: float(mean[:, j].min()))
        said = []
        for j in ordered[:4]:
            b = int(np.argmin(mean[:, j]))
            count = int(np.count_nonzero(mean[:, j] < SETTINGS.low_coherence))
            said.append(
                f"{names[j]!r} {max(mean[b, j], 0):.2f} around {middle[b]:.3g} Hz (low in "
                f"{count} band{'s' * (count > 1)})"
            )
        more = f" and {len(group) - 4} more channel{'s' * (len(group) > 5)}" if len(group) > 4 else ""
        part = "all" if severity == "warning" else "some"
        sentence = (
            f"Multiple coherence is below {SETTINGS.low_coherence:g} in {part} of the {len(middle)} third-octave "
            f"bands: {'; '.join(said)}{more}. {causes}"
        )
        channels, lowest = tuple(names[j] for j in ordered), mean[:, group].min()
        return Finding(self.name, severity, sentence, channels, (), lowest, SETTINGS.low_coherence, picture)


def _pooled(chosen: list[Samples]) -> tuple[H1 | None, float]:
    """H1 over records, with the longest segments that are numerous enough, and their length in s."""
    if not chosen:
        return None, 0.0
    n_u = int(np.count_nonzero(np.max([np.ptp(k.u, axis=0) for k in chosen], axis=0)))
    shortest, samples = min(len(k.u) for k in chosen), sum(len(k.u) for k in chosen)
    length = 1 << int(np.log2(max(16, shortest)))
    # The longest segments that are numerous enough: twice the number of inputs plus 8.
    while length >= 16:
        enough = 2 * samples / length >= 2 * n_u + 8
        if enough and (made := h1([k.spectra(length) for k in chosen])) is not None:
            return made, length / chosen[0].rate_Hz
        length //= 2
    return None, 0.0


def _lowest_driven(chosen: list[Samples]) -> float:
    """Lowest frequency [Hz] of the whole records at which the voltages have a thousandth of their largest power."""
    lowest = []
    for k in chosen:
        power = np.sum(np.abs(np.fft.rfft(k.u - k.u.mean(axis=0), axis=0)) ** 2, axis=1)
        lowest.append(float(np.flatnonzero(driven_lines(power))[0]) * k.rate_Hz / len(k.u))
    return min(lowest)


def _snr(seen: Excerpt) -> tuple[np.ndarray, np.ndarray | None, float]:
    """Driven lines (n,) Hz, signal power / noise power (n, n_y), and segment length [s] if segments leak, else 0."""
    if not seen.driven or seen.header.excitation == "sine":
        return np.zeros(0), None, 0.0
    rate = seen.header.sample_rate_Hz
    if seen.periodic and (periods := seen.periods("y")).shape[0] >= 3:
        Y, U = np.fft.rfft(periods[1:], axis=1), np.fft.rfft(seen.periods("u")[1:].mean(axis=0), axis=0)
        power = np.sum(np.abs(U) ** 2, axis=1)
        power[0] = 0.0
        keep = driven_lines(power)
        P = len(Y)
        noise = np.sum(np.abs(Y - Y.mean(axis=0)) ** 2, axis=0)[keep] / (P - 1)
        # Neighbouring lines have the same noise level: a mean over nine lines avoids division by a value that is small
        # by chance.
        noise = smoothed(noise)
        signal = np.maximum(smoothed(np.abs(Y.mean(axis=0)[keep]) ** 2) - noise / P, 0.0)
        f = np.fft.rfftfreq(periods.shape[1], 1 / rate)[keep]
        return f, signal / np.maximum(noise, 1e-300), 0.0
    if (estimate := h1_of(seen)) is None:
        return np.zeros(0), None, 0.0
    free = np.maximum(estimate.unbiased_coherence(), 0.0)
    return estimate.f, free / np.maximum(1 - free, 1e-12), 1 / float(spectra_of(seen).f[1])


def _high_noise(seen: Excerpt) -> np.ndarray | None:
    """(n_y,) r.m.s. at rest of white noise with the channel's density above half the Nyquist frequency."""
    if seen.header.excitation != "rest":
        return None
    y = seen.first.y[: 1 << 16]
    Y = np.abs(np.fft.rfft((y - y.mean(axis=0)) * np.hanning(len(y))[:, None], axis=0)) ** 2
    density = np.median(Y[len(Y) // 2 :], axis=0) / np.log(2)
    return np.asarray(np.sqrt(density / np.sum(np.hanning(len(y)) ** 2)))
