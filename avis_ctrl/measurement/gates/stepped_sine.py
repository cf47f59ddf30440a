"""Gate for stepped-sine campaigns: a sine is fitted to each channel of each record.

    x = Re(X exp(j w t)) + mean,     H = X_channel / X_drive

H is a smooth function of frequency, and each kind of channel has its own shape: a drive is proportional to the other
drives, a sensor on a mass-spring system follows b s^k / (s^2 + 2 zeta w0 s + w0^2).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Series, over_frequency, samples_over_time
from avis_ctrl.measurement.gates.sine_fit import KINDS, SineFit, fit_sine, second_order


@dataclass(frozen=True)
class SteppedSineSettings:
    """residual, residual_factor : a residual is too large above this fraction of the sine and this many times the
        median of its neighbours, two on either side [1].
    ratio, ratio_factor : a ratio is off if it differs from the line between its neighbours by this fraction and by this
        many times the median departure [1].
    constant : relative spread below which a channel's ratio is constant [1].
    second_order : misfit below which a ratio is of second order [1].
    fewest : minimum number of records.
    """

    residual: float = 0.1
    residual_factor: float = 4.0
    ratio: float = 0.15
    ratio_factor: float = 6.0
    constant: float = 0.2
    second_order: float = 0.1
    fewest: int = 5


SETTINGS = SteppedSineSettings()


@dataclass(frozen=True, eq=False)
class _Steps:
    """Sine records in the order of their frequencies f (n,) Hz.

    names : of all channels, u before y; X (n, channels) amplitudes; rest (n, channels) residuals relative to them;
    live : indices of the channels with a sine; drive : index of the reference drive.
    """

    fits: list[SineFit]
    names: tuple[str, ...]
    f: np.ndarray
    X: np.ndarray
    rest: np.ndarray
    live: list[int]
    drive: int

    def ratio(self, j: int) -> np.ndarray:
        """(n,) ratio of channel j to the drive."""
        return self.X[:, j] / self.X[:, self.drive]

    def picture(self) -> Picture:
        """Amplitude of each channel relative to the drive."""
        title = f"Amplitude of each channel by {self.names[self.drive]}"
        others = (j for j in self.live if j != self.drive)
        series = tuple(Series(self.names[j], self.f, np.abs(self.ratio(j)), "points") for j in others)
        return over_frequency(title, "ratio [-]", series, (Limit("proportional", 1.0),))


class SteppedSine(Gate):
    """Bad records and wrong labels of a stepped-sine campaign.

    A record is bad if a channel's residual after the sine exceeds 10 % of the sine and 4 times the median of its
    neighbours in frequency. It is also bad if the residual exceeds twice this median, and |H| departs from the straight
    line (in logarithms) between its neighbours by 15 % and by 6 times the median departure of the channel. A recorded
    drive whose ratio to another drive is not constant but follows a second-order response is a sensor's output.
    Channels without the sine are left to the dead-channel gate. These are engineering limits, not statistical tests:
    the records are few, and residuals are distortion rather than noise, so no false-alarm rate is claimed.
    """

    name = "stepped sine"

    def look(self, seen: Excerpt) -> SineFit | None:
        if seen.header.excitation != "sine" or not seen.driven:
            return None
        piece = seen.first
        return fit_sine(piece.header.name, np.hstack([piece.u, piece.y]), piece.u.shape[1], seen.header.sample_rate_Hz)

    def conclude(self, kept: list[SineFit | None]) -> list[Finding]:
        fits = sorted((k for k in kept if k is not None), key=lambda k: k.f)
        names, n_u = (*self.campaign.u_names, *self.campaign.y_names), len(self.campaign.u_names)
        if len(fits) < SETTINGS.fewest:
            sentence = (
                f"No stepped-sine campaign: {len(fits)} sine records, {SETTINGS.fewest} are needed to compare "
                "neighbours."
            )
            return [Finding(self.name, "ok", sentence)]
        X = np.array([k.X for k in fits])
        rest = np.array([k.residual_rms for k in fits]) / np.maximum(np.abs(X), 1e-300) * np.sqrt(2)
        silent = [j for j in range(len(names)) if np.median(rest[:, j]) > 10]
        live = [j for j in range(len(names)) if j not in silent]
        steps = _Steps(fits, names, np.array([k.f for k in fits]), X, rest, live, _drive(rest, live, n_u))
        lost = [names[k] for k in silent if k >= n_u]
        found = [*self._labels(steps, n_u, lost), *self._bad_records(steps)]
        largest = rest[:, live].max()
        sentence = (
            f"{len(fits)} sine records from {fits[0].f:.3g} to {fits[-1].f:.3g} Hz are smooth in frequency; the "
            f"largest residual is {100 * largest:.2g} % of its sine."
        )
        return found or [
            Finding(self.name, "ok", sentence, value=largest, limit=SETTINGS.residual, picture=steps.picture())
        ]

    def _labels(self, steps: _Steps, n_u: int, lost: list[str]) -> Iterator[Finding]:
        """Findings on drives that are sensors' outputs; lost : the names of silent sensors."""
        f, names = steps.f, steps.names
        for j in (j for j in steps.live if j < n_u and j != steps.drive):
            H = steps.ratio(j)
            spread = float(np.exp(np.std(np.log(np.abs(H)))) - 1)
            turned = float(np.ptp(np.degrees(np.unwrap(np.angle(H)))))
            if spread < SETTINGS.constant and turned < 45:
                continue
            model = second_order(f, H)
            if model.misfit > SETTINGS.second_order:
                continue
            likely = (
                f"; the sensor channel {lost[0]!r} is silent: their names or cables are probably exchanged"
                if lost
                else ""
            )
            sentence = (
                f"Channel {names[j]!r} is recorded as a drive but is a sensor's output: its ratio to "
                f"{names[steps.drive]!r} is not constant (it varies from {np.abs(H).min():.3g} to "
                f"{np.abs(H).max():.3g} and turns by {turned:.0f} degrees from {f[0]:.3g} to {f[-1]:.3g} Hz) but "
                f"follows a second-order {KINDS[model.k]} response with corner {model.corner_Hz:.3f} Hz and damping "
                f"{model.damping:.3f} within {100 * model.misfit:.1f} %{likely}. Record it as an output, and find the "
                "channel that measures the drive."
            )
            channels, picture = (names[j], *lost), steps.picture()
            yield Finding(self.name, "stop", sentence, channels, (), spread, SETTINGS.constant, picture)

    def _bad_records(self, steps: _Steps) -> Iterator[Finding]:
        f, n = steps.f, len(steps.f)
        for j in steps.live:
            name, rest, H = steps.names[j], steps.rest[:, j], np.abs(steps.ratio(j))
            off = _departure(np.log(f), np.log(H)) if j != steps.drive else np.zeros(n)
            usual = float(np.median(np.abs(off[1:-1])))
            for k, fit in enumerate(steps.fits):
                around = [i for i in range(max(0, k - 2), min(n, k + 3)) if i != k]
                near = float(np.median(rest[around]))
                limit = max(SETTINGS.residual, SETTINGS.residual_factor * near)
                # A bad record makes its neighbours depart too: only the largest departure around counts.
                astray = abs(off[k]) > max(SETTINGS.ratio, SETTINGS.ratio_factor * usual) and abs(off[k]) >= np.max(
                    np.abs(off[max(0, k - 1) : k + 2])
                )
                if rest[k] <= limit and not (astray and rest[k] > 2 * near):
                    continue
                ratio = (
                    f"; its ratio to {steps.names[steps.drive]!r} is {H[k]:.3g}, while its neighbours suggest "
                    f"{H[k] * np.exp(-off[k]):.3g}"
                    if off[k]
                    else ""
                )
                sentence = (
                    f"Record {fit.record} is bad in channel {name!r}: the residual after removing the sine of "
                    f"{f[k]:.4g} Hz is {100 * rest[k]:.3g} % of the sine, in neighbouring records {100 * near:.2g} "
                    f"%{ratio}. The signal is distorted, clipped or out of range there (see its figure); leave the "
                    "record out."
                )
                picture = samples_over_time(fit.record, name, fit.t, fit.traces[:, j])
                yield Finding(self.name, "stop", sentence, (name,), (fit.record,), rest[k], limit, picture)


def _drive(rest: np.ndarray, live: list[int], n_u: int) -> int:
    """Index of the recorded drive that is the purest sine."""
    among = [j for j in live if j < n_u] or live
    return min(among, key=lambda j: float(np.median(rest[:, j])))


def _departure(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n,) difference of each point from the straight line between its neighbours; 0 at the ends."""
    d = np.zeros(len(x))
    share = (x[1:-1] - x[:-2]) / (x[2:] - x[:-2])
    d[1:-1] = y[1:-1] - (y[:-2] + share * (y[2:] - y[:-2]))
    return d
