"""Gates for how much of y comes from u: signal-to-noise ratio and multiple coherence, by channel and band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import (
    FALSE_ALARM,
    Expectation,
    Finding,
    Limit,
    Picture,
    Series,
    Severity,
    quoted,
)
from avis_ctrl.measurement.gates.h1 import Spectra, h1, octaves, segment_length, spectra, usable

LOW_DB, POOR_DB = 10.0, 0.0
LOW_COHERENCE = 0.5
NOISE_FACTOR = 3.0


@dataclass(frozen=True, eq=False)
class _Noise:
    """f (n,) Hz; snr (n, n_y) signal power by noise power of one period; noise_rms (n_y,); wide: noise at rest."""

    record: str
    f: np.ndarray
    snr: np.ndarray | None
    noise_rms: np.ndarray | None


class SignalToNoise(Gate):
    """Signal by noise in octave bands.

    Of a periodic record: power of the mean of the periods after the first by the variance between them, over the driven
    lines; of others coherence / (1 - coherence) without its bias. No alarm is raised by a test: the numbers are
    estimates
    with an error of less than 1 dB where a band holds 30 lines x periods. A note is below 10 dB in some band, a warning
    below 0 dB
    in every band. Where the sensors' noise is known, records at rest are compared with it: white noise of 3 times the
    stated
    r.m.s. above half the Nyquist frequency is a warning (chi-square with thousands of degrees of freedom: chance has no
    part).
    """

    name = "signal to noise"

    def look(self, seen: Excerpt, expectation: Expectation) -> _Noise:
        f, snr = _snr(seen)
        return _Noise(seen.header.name, f, snr, _high_noise(seen) if expectation.sensor_noise_rms_V else None)

    def conclude(self, kept: list[_Noise], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        found = self._noisy(kept, campaign, expectation)
        measured = [(k.f, k.snr, k.record) for k in kept if k.snr is not None and len(k.f)]
        if not measured:
            picture = Picture("Signal to noise", "frequency [Hz]", "ratio [dB]", ())
            return found or [
                Finding(self.name, "ok", "No driven record is long enough to part signal from noise.", picture=picture)
            ]
        f, snr = max(measured, key=lambda m: float(np.median(m[1])))[:2]
        bands = octaves(f)
        dB = np.array([10 * np.log10(np.maximum(snr[band].mean(axis=0), 1e-6)) for band in bands])
        middle = np.array([np.sqrt(f[band][0] * f[band][-1]) for band in bands])
        picture = Picture(
            "Signal to noise of the best record",
            "frequency [Hz]",
            "ratio [dB]",
            tuple(Series(n, middle, dB[:, j], "points") for j, n in enumerate(campaign.y_names)),
            (Limit("low", LOW_DB),),
            "log",
        )
        for j, name in enumerate(campaign.y_names):
            weakest = int(np.argmin(dB[:, j]))
            if dB[:, j].max() < POOR_DB:
                found.append(
                    Finding(
                        self.name,
                        "warning",
                        f"Channel {name!r} has more noise than signal in every band (at best {dB[:, j].max():.1f} dB at"
                        f" {middle[np.argmax(dB[:, j])]:.3g} Hz). Raise the level, or average longer.",
                        (name,),
                        value=float(dB[:, j].max()),
                        limit=POOR_DB,
                        picture=picture,
                    )
                )
            elif dB[weakest, j] < LOW_DB:
                low = ", ".join(f"{middle[b]:.3g} Hz {dB[b, j]:.0f} dB" for b in np.flatnonzero(dB[:, j] < LOW_DB))
                found.append(
                    Finding(
                        self.name,
                        "note",
                        f"Channel {name!r} has little signal around {low}. Those bands weigh little in a fit; "
                        "drive them more if they matter.",
                        (name,),
                        value=float(dB[weakest, j]),
                        limit=LOW_DB,
                        picture=picture,
                    )
                )
        if not found:
            b, j = divmod(int(np.argmin(dB)), dB.shape[1])
            found.append(
                Finding(
                    self.name,
                    "ok",
                    f"Signal to noise is at least {dB[b, j]:.0f} dB in every band (lowest {campaign.y_names[j]!r}"
                    f" around {middle[b]:.3g} Hz).",
                    value=float(dB[b, j]),
                    limit=LOW_DB,
                    picture=picture,
                )
            )
        return found

    def _noisy(self, kept: list[_Noise], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        stated = expectation.sensor_noise_rms_V
        levels = [k.noise_rms for k in kept if k.noise_rms is not None]
        if stated is None or not levels:
            return []
        rms = np.median(levels, axis=0)
        x = np.arange(len(rms))
        picture = Picture(
            "Noise of each channel, from above half the Nyquist frequency",
            "channel number",
            f"r.m.s. [{campaign.y_unit}]",
            (Series("measured", x, rms, "bars"),),
            (Limit("stated", stated),),
            y_scale="log",
        )
        return [
            Finding(
                self.name,
                "warning",
                f"Channel {name!r} has sensor noise of {rms[j]:.3g} {campaign.y_unit} r.m.s., {rms[j] / stated:.1f}"
                " times what the rig file states. Check its preamplifier and cable, or correct the rig file.",
                (name,),
                value=float(rms[j]),
                limit=NOISE_FACTOR * stated,
                picture=picture,
            )
            for j, name in enumerate(campaign.y_names)
            if rms[j] > NOISE_FACTOR * stated
        ]


@dataclass(frozen=True, eq=False)
class _Coherence:
    record: str
    level: float
    of: Spectra | None


class Coherence(Gate):
    """Multiple coherence of each channel with all inputs, by octave band, over the records of one level.

    Estimates are freed of their bias, gamma^2 - (1 - gamma^2) n_u / (K - n_u). A band is low where the mean is under
    0.5 and the mean of its lines does not reach 0.5 by chance (normal approximation of the beta distribution's mean, 1
    % shared over bands and
    channels). A channel that is low in all bands is a warning; in some, a note. Short segments leak around
    lightly damped resonances, which lowers the coherence there without any fault.
    """

    name = "coherence"

    def look(self, seen: Excerpt, expectation: Expectation) -> _Coherence:
        if not seen.driven or seen.header.excitation == "sine":
            return _Coherence(seen.header.name, 0.0, None)
        u, y, wrap = usable(seen)
        length = segment_length(len(u), int(np.count_nonzero(np.ptp(u, axis=0))))
        return _Coherence(
            seen.header.name, seen.header.level_V, spectra(u, y, seen.header.sample_rate_Hz, length, wrap)
        )

    def conclude(self, kept: list[_Coherence], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        groups: dict[tuple[float, int], list[Spectra]] = {}
        for k in kept:
            if k.of is not None:
                groups.setdefault((k.level, len(k.of.f)), []).append(k.of)
        estimates = [(level, e) for (level, _), of in groups.items() if (e := h1(of)) is not None]
        if not estimates:
            return [
                Finding(
                    self.name,
                    "ok",
                    "No driven record is long enough for a coherence of all inputs together.",
                    picture=Picture("Multiple coherence", "frequency [Hz]", "coherence [-]", ()),
                )
            ]
        level, best = max(estimates, key=lambda e: (e[1].dof, e[0]))
        n_u = int(np.count_nonzero(best.G.any(axis=(0, 1))))
        free = best.coherence - (1 - best.coherence) * n_u / best.dof
        bands = octaves(best.f)
        middle = np.array([np.sqrt(best.f[b][0] * best.f[b][-1]) for b in bands])
        mean = np.array([free[b].mean(axis=0) for b in bands])
        # Standard deviation of an estimate of 0.5: (1 - g) sqrt(2 g / K), Bendat and Piersol table 9.6.
        z = stats.norm.isf(FALSE_ALARM / mean.size)
        margin = np.array([z * 0.5 / np.sqrt(best.dof * max(1, int(b.sum()))) for b in bands])
        low = mean < LOW_COHERENCE - margin[:, None]
        picture = Picture(
            f"Multiple coherence at {level:g} V",
            "frequency [Hz]",
            "coherence [-]",
            tuple(Series(n, best.f, best.coherence[:, j]) for j, n in enumerate(campaign.y_names)),
            (Limit("low", LOW_COHERENCE),),
            "log",
        )
        found = []
        for j, name in enumerate(campaign.y_names):
            if low[:, j].any():
                severity: Severity = "warning" if low[:, j].all() else "note"
                where = ", ".join(f"{middle[b]:.3g} Hz ({max(mean[b, j], 0):.2f})" for b in np.flatnonzero(low[:, j]))
                found.append(
                    Finding(
                        self.name,
                        severity,
                        f"Channel {name!r} has low coherence with the inputs around {where}: noise, an input that is"
                        " not recorded, or nonlinearity. Raise the level or leave these bands out of the fit.",
                        (name,),
                        value=float(mean[:, j].min()),
                        limit=LOW_COHERENCE,
                        picture=picture,
                    )
                )
        if not found:
            b, j = divmod(int(np.argmin(mean)), mean.shape[1])
            found.append(
                Finding(
                    self.name,
                    "ok",
                    f"Multiple coherence is at least {mean[b, j]:.2f} in every band (lowest"
                    f" {quoted((campaign.y_names[j],))} around {middle[b]:.3g} Hz).",
                    value=float(mean[b, j]),
                    limit=LOW_COHERENCE,
                    picture=picture,
                )
            )
        return found


def _snr(seen: Excerpt) -> tuple[np.ndarray, np.ndarray | None]:
    """Driven lines (n,) Hz and signal by noise power (n, n_y)."""
    if not seen.driven or seen.header.excitation == "sine":
        return np.zeros(0), None
    rate = seen.header.sample_rate_Hz
    if seen.periodic and (periods := seen.periods("y")).shape[0] >= 3:
        Y, U = np.fft.rfft(periods[1:], axis=1), np.fft.rfft(seen.periods("u")[1:].mean(axis=0), axis=0)
        power = np.sum(np.abs(U) ** 2, axis=1)
        keep = power > 1e-3 * power[1:].max()
        keep[0] = False
        P = len(Y)
        noise = np.sum(np.abs(Y - Y.mean(axis=0)) ** 2, axis=0)[keep] / (P - 1)
        # Neighbouring lines share their noise level: a mean over nine lines keeps the ratio from dividing by chance.
        noise = _smooth(noise, 9)
        signal = np.maximum(_smooth(np.abs(Y.mean(axis=0)[keep]) ** 2, 9) - noise / P, 0.0)
        f = np.fft.rfftfreq(periods.shape[1], 1 / rate)[keep]
        return f, signal / np.maximum(noise, 1e-300)
    u, y, wrap = usable(seen)
    n_u = int(np.count_nonzero(np.ptp(u, axis=0)))
    estimate = h1([spectra(u, y, rate, segment_length(len(u), n_u), wrap)])
    if estimate is None:
        return np.zeros(0), None
    free = np.maximum(estimate.coherence - (1 - estimate.coherence) * n_u / estimate.dof, 0.0)
    return estimate.f, free / np.maximum(1 - free, 1e-12)


def _smooth(a: np.ndarray, width: int) -> np.ndarray:
    """Moving mean over lines, narrower at the ends."""
    width = min(width, len(a))
    kernel = np.ones(width)
    count = np.convolve(np.ones(len(a)), kernel, "same")
    return np.stack([np.convolve(a[:, j], kernel, "same") / count for j in range(a.shape[1])], axis=1)


def _high_noise(seen: Excerpt) -> np.ndarray | None:
    """(n_y,) r.m.s. of white noise with the density that the channel has above half the Nyquist frequency, at rest."""
    if seen.header.excitation != "rest":
        return None
    y = seen.first.y[: 1 << 16]
    Y = np.abs(np.fft.rfft((y - y.mean(axis=0)) * np.hanning(len(y))[:, None], axis=0)) ** 2
    density = np.median(Y[len(Y) // 2 :], axis=0) / np.log(2)
    return np.asarray(np.sqrt(density / np.sum(np.hanning(len(y)) ** 2)))
