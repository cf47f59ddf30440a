"""A seismometer channel: coil and displacement of one second-order mass, and what one of them may lack.

The base is `identification.single_axis.seismometer` without delays. Rows are the logarithm of magnitude and the phase
of the first channel over the drive, and of the second channel's displacement-to-velocity ratio, in which the mass
itself cancels: a fault of one channel shows there far below what the mass's own nonlinearity leaves in each response.

The scatter of each kind of row is a^2 h^2 + c^2 + v with v the variance of the noise, h the distortion of the record
(harmonics that both channels see) where it is known, and a, c from the residual of that kind of row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.single_axis.machine import octaves
from avis_ctrl.gap.single_axis.terms import AxisParameter, Term, register
from avis_ctrl.identification.single_axis.lag import LARGEST_MODE_DAMPING
from avis_ctrl.identification.single_axis.seismometer import Responses, fit_seismometer, response
from avis_ctrl.identification.single_axis.sine import SineRecord
from avis_ctrl.measurement.gates.finding import Picture, Series

# Neighbouring frequencies share their misfit (as in `identification.single_axis.seismometer`): they leave together.
TOGETHER = 2
LEAST_FREQUENCIES = 8
# Shares of the distortion's part at the median frequency that are tried.
RATIOS = np.concatenate([[0.0], np.logspace(-2, 2, 17)])


class SeismometerData:
    """Rows of responses; see `machine.AxisProblem`.

    Parameters
    ----------
    responses : coil, displacement or both over the drive. distortion : (n,) r.m.s. of harmonics over the first, of the
        motion itself; zero where it is not known. ratio_variance : (n,) relative E|error|^2 of the second channel over
        the first; the sum of both variances where it is not known.

    Raises
    ------
    InputError : shapes, few frequencies, a ground response. ComputationError : no seismometer fits.
    """

    kind = "seismometer"

    def __init__(self, responses: Responses, distortion: np.ndarray | None = None,
                 ratio_variance: np.ndarray | None = None):
        n = len(responses.frequency_Hz)
        if n < LEAST_FREQUENCIES or "ground" in responses.value:
            raise InputError(f"expected coil, displacement or both at {LEAST_FREQUENCIES} frequencies or more",
                             field="responses", value=(n, sorted(responses.value)))
        self.f = np.asarray(responses.frequency_Hz, float)
        self.s = 2j * np.pi * self.f
        self.channels = tuple(kind for kind in ("coil", "displacement") if kind in responses.value)
        h = np.zeros(n) if distortion is None else np.asarray(distortion, float).ravel()
        if h.shape != (n,) or not np.all(np.isfinite(h)) or np.any(h < 0):
            raise InputError(f"expected {n} finite numbers, none negative", field="distortion", value=h.shape)
        start = fit_seismometer(responses, delay=False)
        self.names = start.names
        self.base = tuple(AxisParameter(name, unit, float(x), 1e-6 * abs(float(x)) if name in ("corner_Hz", "damping")
                                        else -np.inf, np.inf, abs(float(x)))
                          for name, unit, x in zip(start.names, start.information.units, start.values, strict=True))
        relative = {kind: np.asarray(V) / np.abs(responses.value[kind]) ** 2 for kind, V in responses.variance.items()}
        summed = np.sum([relative[kind] for kind in self.channels], axis=0)
        both = summed if ratio_variance is None else np.asarray(ratio_variance)
        variance = [relative[self.channels[0]], *([both] if len(self.channels) > 1 else [])]
        H = [responses.value[kind] for kind in self.channels]
        self.measured = [H[0], *([H[1] / H[0]] if len(H) > 1 else [])]
        kinds = 2 * len(self.measured)
        self.runs = [np.arange(n * k, n * (k + 1)) for k in range(kinds)]
        self.v = np.concatenate([x / 2 for x in variance for _ in (0, 1)])
        self.notes = () if not np.any(h) else (
            f"Harmonics of the motion reach {100 * h.max():.2g} % of it at {self.f[int(np.argmax(h))]:.3g} Hz: the "
            "mass itself is nonlinear, which no term of a channel holds.",)
        self.h = np.tile(h / max(float(np.median(h)), 1e-12), kinds)
        count = n // TOGETHER
        self.block = np.tile(np.minimum(np.arange(n) // TOGETHER, count - 1), kinds)
        self.size = np.full(n * kinds, np.sqrt(0.5))  # two rows hold one complex number of size one
        self.noise = float(np.mean(self.v))
        order = np.arange(count)
        self.splits = [("lower and upper half of the band", order[:count // 2], order[count // 2:]),
                       ("even and odd blocks", order[::2], order[1::2])]

    @staticmethod
    def of(records: Sequence[SineRecord], measured: Sequence[str], driven: str) -> dict[str, Any]:
        """Arguments from sine records by frequency.

        Raises
        ------
        ComputationError : too few frequencies.
        """
        used = [r for k, r in enumerate(records) if k == 0 or r.frequency_Hz > 1.001 * records[k - 1].frequency_Hz]
        if len(used) < LEAST_FREQUENCIES:
            raise ComputationError("too few sine records", measured=f"{len(used)} usable frequencies",
                                   cause="records refused or columns mapped wrongly",
                                   next_step=f"map the columns; give at least {LEAST_FREQUENCIES} frequencies")
        pairs = {role: [record.ratio(role, driven) for record in used] for role in measured}
        responses = Responses(np.array([record.frequency_Hz for record in used]),
                              {role: np.array([H for H, _ in pair]) for role, pair in pairs.items()},
                              {role: np.array([v for _, v in pair]) for role, pair in pairs.items()})
        at = [used[0].channels.index(role) for role in measured]
        # What every channel shows is the motion's; what one alone shows is its own noise or hum.
        seen = np.array([min(float(np.sqrt(np.sum(record.harmonics[j] ** 2))) for j in at) for record in used])
        found: dict[str, Any] = {"responses": responses, "distortion": seen}
        if {"coil", "displacement"} <= set(measured):
            ratio = [record.ratio("displacement", "coil") for record in used]
            found["ratio_variance"] = np.array([v / abs(H) ** 2 for H, v in ratio])
        return found

    def residual(self, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        p0 = len(self.base)
        model = response(self.f, self.names, theta[:p0])
        H = [np.asarray(model[kind]) for kind in self.channels]
        at = p0
        for term in terms:
            assert isinstance(term, ChannelTerm)
            p = theta[at:at + len(term.parameters(self))]
            at += len(p)
            factor = term.factor(self.s, p)
            H = [one * factor if term.location in (kind, "drive") else one
                 for kind, one in zip(self.channels, H, strict=True)]
        predicted = [H[0], *([H[1] / H[0]] if len(H) > 1 else [])]
        quotients = [measured / model for measured, model in zip(self.measured, predicted, strict=True)]
        return np.concatenate([part for Q in quotients for part in (np.log(np.abs(Q)), np.angle(Q))])

    def sigma(self, e: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Maximum likelihood of a and c over their ratio, for each kind of row."""
        found = np.empty(len(e))
        for run in self.runs:
            keep = run[used[run]]
            tried = []
            for ratio in RATIOS:
                shape = 1 + (ratio * self.h) ** 2
                c2 = max(float(np.mean((e[keep] ** 2) / shape[keep])) - float(np.mean(self.v[keep] / shape[keep])), 0.0)
                total = np.maximum(c2 * shape + self.v, 1e-24)
                tried.append((float(np.sum(np.log(total[keep]) + e[keep] ** 2 / total[keep])), total))
            found[run] = np.sqrt(min(tried, key=lambda one: one[0])[1][run])
        return found

    def references(self, terms: Sequence[Term], theta: np.ndarray) -> Mapping[str, np.ndarray]:
        """Magnitude and phase of each response free to bend as a cubic in the logarithm of the frequency; and a common
        rational factor of fourth order, which is what more modes of the mass could do."""
        x = np.log(self.f / np.sqrt(self.f[0] * self.f[-1])) / np.log(self.f[-1] / self.f[0]) * 2
        n, rows = len(self.f), len(self.block)
        powers = x[:, None] ** np.arange(4)
        free = np.zeros((rows, 4 * len(self.runs)))
        for k, run in enumerate(self.runs):
            free[run, 4 * k:4 * k + 4] = powers
        # ln(1 + sum a_k z^k) to first order, on the first response alone: the ratio holds nothing of the mass.
        z = 1j * self.f / np.sqrt(self.f[0] * self.f[-1])
        D = 1 / (1 + np.abs(z) ** 2)
        modes = np.zeros((rows, 4))
        for k in range(1, 5):
            modes[:n, k - 1], modes[n:2 * n, k - 1] = (z ** k * D).real, (z ** k * D).imag
        return {"more modes of the mass, order 4": modes, "free bends of magnitude and phase": free}

    def free(self, variable: str, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        return np.zeros((len(self.block), 0))  # no term of a channel is a static function

    def where(self, e: np.ndarray) -> tuple[dict[str, Any], ...]:
        power = [e[self.runs[2 * k]] ** 2 + e[self.runs[2 * k + 1]] ** 2 for k in range(len(self.measured))]
        worst = int(np.argmax([one.sum() for one in power]))
        names = (self.channels[0], f"{self.channels[-1]} over {self.channels[0]}")
        return octaves(self.f, power[worst], {"input": "drive", "output": names[worst]})

    def picture(self, errors: Sequence[np.ndarray], names: Sequence[str]) -> Picture:
        run, what = self.runs[-1], f"phase of {' over '.join(self.channels[::-1])}"
        series = tuple(Series(name, self.f, np.degrees(e[run]), "points")
                       for name, e in zip(names, errors, strict=True))
        return Picture(f"What each stage leaves on unseen frequencies, {what}", "frequency [Hz]", "phase [deg]", series,
                       (), "log", "linear")


class ChannelTerm(Term):
    """A factor on one channel ("coil", "displacement") or on all ("drive")."""

    def __init__(self, location: str):
        self.__dict__["location"] = location

    def factor(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        """(n,) complex, 1 where nothing is missing."""
        raise NotImplementedError

    def parameters(self, data: SeismometerData) -> tuple[AxisParameter, ...]:
        top = float(data.f[-1])
        return (AxisParameter(self._lag, "s", 1e-3 / top, 0.0, 0.45 / top, 0.01 / top),)

    _lag = "delay_s"


class Delay(ChannelTerm):
    name, words = "delay", "a pure delay of one channel"
    separated_by = "higher frequencies: the phase of a delay stays proportional to them, that of a pole bends"

    def factor(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.exp(-s * p[0])


class Pole(ChannelTerm):
    name, words = "first_order_lag", "a first-order lag of one channel"
    separated_by = Delay.separated_by
    _lag = "time_constant_s"

    def factor(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        return 1 / (1 + s * p[0])


class Crosstalk(ChannelTerm):
    name, words = "crosstalk", "a share of the velocity in the displacement channel"
    separated_by = "the magnitude at higher frequencies"

    def parameters(self, data: SeismometerData) -> tuple[AxisParameter, ...]:
        top = float(data.f[-1])
        return (AxisParameter("share_s", "s", 0.0, -0.45 / top, 0.45 / top, 0.01 / top),)

    def factor(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        return 1 + s * p[0]


class Mode(ChannelTerm):
    """Lightly damped: a mode of damping 0.87 has the phase of a delay to fourth order, and a mount has not."""

    name, words = "mechanical_mode", "a mechanical mode of a sensor's mount"
    separated_by = "frequencies up to the mode, where the magnitude rises"

    def parameters(self, data: SeismometerData) -> tuple[AxisParameter, ...]:
        top = float(data.f[-1])
        return (AxisParameter("frequency_Hz", "Hz", 3 * top, 1.05 * top, 100 * top, top),
                AxisParameter("damping", "", 0.1, 1e-3, LARGEST_MODE_DAMPING, 0.1))

    def factor(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        w = 2 * np.pi * p[0]
        return w ** 2 / (s ** 2 + 2 * p[1] * w * s + w ** 2)


class Highpass(ChannelTerm):
    name, words = "highpass", "a first-order high-pass (AC coupling) of one channel"
    separated_by = "lower frequencies"

    def parameters(self, data: SeismometerData) -> tuple[AxisParameter, ...]:
        low = float(data.f[0])
        return (AxisParameter("corner_Hz", "Hz", 1e-2 * low, 0.0, 10 * low, 0.1 * low),)

    def factor(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        return s / (s + 2 * np.pi * p[0])


register("seismometer", *(kind(location) for location in ("displacement", "coil", "drive")
                          for kind in (Delay, Pole, Mode, Highpass)), Crosstalk("displacement"))
