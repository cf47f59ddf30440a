"""A drive F = M a + Fv v with what may be missing from it.

Position and force go through the same low-pass filter forth and back (parallel filter, Gautier 1997), derivatives are
those of the filtered position; forces that are not linear in the motion are computed from it and filtered once more.
Where the motion repeats, the noise of the force is its scatter from one repetition to the next. In a closed loop least
squares is biased by the noise of the position; `identify_single_axis` has instruments against it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import signal
from scipy.interpolate import make_interp_spline

from avis_ctrl.errors import InputError
from avis_ctrl.gap.single_axis.machine import bumps, octaves
from avis_ctrl.gap.single_axis.orientation import require_oriented
from avis_ctrl.gap.single_axis.settings import SETTINGS
from avis_ctrl.gap.single_axis.terms import AxisParameter, Term, register
from avis_ctrl.measurement.gates.finding import Picture, Series, thinned

BLOCKS = 16
# Repeated: the motion returns to itself within this part of its r.m.s.
REPEATS = 1e-3
FIR_TAPS, FIR_STEP_S = 21, 0.008


class DriveData:
    """Filtered motion of a drive; see `machine.AxisProblem`.

    Parameters
    ----------
    time : (n,) s, uniform. position : (n,) m. force : (n,) N. reference : (n,) m, for finding repetitions.
    cutoff_Hz : of the fourth-order Butterworth filter, run forth and back. By default as far up as force and motion
        are coherent, for only there a delay and a lag part; 60 Hz at the least.

    Raises
    ------
    InputError : shapes, times that are not uniform, a cutoff out of range, a record too short, an axis at rest.
    """

    kind = "drive"

    def __init__(self, time: np.ndarray, position: np.ndarray, force: np.ndarray, reference: np.ndarray | None = None,
                 cutoff_Hz: float | None = None):
        time, position, force, reference = _checked(time, position, force, reference)
        self.rate = (len(time) - 1) / (time[-1] - time[0])
        cutoff_Hz = _coherent_to(position, force, self.rate) if cutoff_Hz is None else cutoff_Hz
        if not 0 < cutoff_Hz < self.rate / 2:
            raise InputError(f"expected a cutoff between 0 and {self.rate / 2:g} Hz", field="cutoff_Hz",
                             value=cutoff_Hz)
        edge = int(np.ceil(2 * self.rate / cutoff_Hz))
        if len(time) < BLOCKS * 8 * edge:
            raise InputError(f"expected at least {BLOCKS * 8 * edge / self.rate:.3g} s: {BLOCKS} blocks that are long "
                             "against the filter", field="samples", value=len(time))
        self.sections = signal.butter(4, cutoff_Hz / (self.rate / 2), output="sos")
        self.q = self.filtered(position)
        self.t, self.force = time - time[0], self.filtered(force)
        # Differences of three samples would lose 1 % of the acceleration at a sixteenth of the sample rate.
        spline = make_interp_spline(self.t, self.q, k=5)
        self.v, self.a = spline.derivative(1)(self.t), spline.derivative(2)(self.t)
        # Four samples a period of the cutoff hold all that the filter leaves.
        step = max(1, int(self.rate / (4 * cutoff_Hz)))
        block = np.minimum(np.arange(len(time)) * BLOCKS // len(time), BLOCKS - 1)
        start = np.searchsorted(block, np.arange(BLOCKS))
        inside = np.arange(len(time)) - start[block]
        length = np.bincount(block)[block]
        keep = (inside >= edge) & (inside < length - edge) & (np.arange(len(time)) % step == 0)
        self.keep = np.flatnonzero(keep)
        self.row_rate = self.rate / step
        self.block = block[self.keep]
        self.runs = [np.arange(len(self.keep))]
        self.y = self.force[self.keep]
        self.size = np.full(len(self.y), float(np.sqrt(np.mean(self.y ** 2))))
        self.speed = float(np.sqrt(np.mean(self.v ** 2)))
        if not self.speed * self.t[-1] > 1e-9 * (np.ptp(position) + np.finfo(float).tiny) or not self.size[0] > 0:
            raise InputError("expected a drive that moves and a force that is not zero", field="position, force")
        require_oriented(self._fitted, force, position, "force, position")
        # Of the measured position: a reference repeats even where forces are added to the loop that do not.
        self.noise, self.repeats_s = self._repetition(position)
        level = self.size[0]
        self.base = (AxisParameter("M", "kg", level / np.sqrt(np.mean(self.a ** 2)), 0, np.inf,
                                   level / np.sqrt(np.mean(self.a ** 2))),
                     AxisParameter("Fv", "N s/m", level / self.speed / 2, -np.inf, np.inf, level / self.speed))
        self.splits = self._halves()
        self.notes = () if self.repeats_s is None else (
            f"The motion repeats every {self.repeats_s:.4g} s; the force scatters by {np.sqrt(self.noise or 0):.3g} N "
            "from one repetition to the next, which is the measured noise.",)

    def _fitted(self, force: np.ndarray, position: np.ndarray) -> tuple[float, bool]:
        """Mass, viscous and Coulomb friction and offset by least squares; see `require_oriented`."""
        F, spline = self.filtered(force), make_interp_spline(self.t, self.filtered(position), k=5)
        v = spline.derivative(1)(self.t)
        X = np.column_stack([np.ones_like(v), v, np.sign(v), spline.derivative(2)(self.t)])[self.keep]
        F = F[self.keep]
        x, *_ = np.linalg.lstsq(X / (size := np.maximum(np.linalg.norm(X, axis=0), 1e-300)), F, rcond=None)
        return float(np.std(F - X / size @ x) / max(float(np.std(F)), 1e-300)), bool(x[3] > 0)

    def filtered(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(signal.sosfiltfilt(self.sections, x))

    def _halves(self) -> list[tuple[str, np.ndarray, np.ndarray]]:
        order = np.arange(BLOCKS)
        speed = np.array([np.sqrt(np.mean(self.v[self.keep][self.block == b] ** 2)) for b in order])
        fast = np.argsort(speed)
        return [("first and second half of the record", order[:BLOCKS // 2], order[BLOCKS // 2:]),
                ("slower and faster blocks", fast[:BLOCKS // 2], fast[BLOCKS // 2:]),
                ("even and odd blocks", order[::2], order[1::2])]

    def _repetition(self, guide: np.ndarray) -> tuple[float | None, float | None]:
        """Mean square of the filtered force's scatter between repetitions, and their period."""
        n, x = len(guide), guide - np.mean(guide)
        size, least = float(np.sqrt(np.mean(x ** 2))), len(guide) // 32
        F = np.fft.rfft(x, 2 * n)
        product = np.fft.irfft(np.abs(F) ** 2)[:n]
        energy = np.cumsum(x ** 2)
        lags = np.arange(least, n // 2)
        # Mean square of x(t + lag) - x(t) over the overlap.
        apart = (energy[n - 1 - lags] + energy[-1] - energy[lags - 1] - 2 * product[lags]) / (n - lags)
        good = lags[apart < (REPEATS * size) ** 2 + 1e-9 * size ** 2]
        if not len(good):
            return None, None
        lag = int(good[0] + np.argmin(apart[good - least][:max(1, least // 4)]))
        d = (self.force[lag:] - self.force[:-lag]) / np.sqrt(2)
        # The middle one of the blocks: a start or a single disturbance is no noise.
        return float(np.median([np.mean(part ** 2) for part in np.array_split(d, BLOCKS)])), lag / self.rate

    def residual(self, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        return self.y - self.predicted(terms, theta)[self.keep]

    def predicted(self, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        """(samples,) filtered force."""
        F, raw, at = theta[0] * self.a + theta[1] * self.v, np.zeros_like(self.v), len(self.base)
        after = []
        for term in terms:
            assert isinstance(term, DriveTerm)
            p = theta[at:at + len(term.parameters(self))]
            at += len(p)
            F = F + term.linear(self, p)
            one = term.force(self, p)
            raw = raw if one is None else raw + one
            after.append((term, p))
        if np.any(raw):
            F = F + self.filtered(raw)
        for term, p in after:
            F = term.after(self, F, p)
        return F

    def sigma(self, e: np.ndarray, used: np.ndarray) -> np.ndarray:
        return np.full(len(e), max(float(np.sqrt(np.mean(e[used] ** 2))), 1e-12 * self.size[0]))

    def references(self, terms: Sequence[Term], theta: np.ndarray) -> Mapping[str, np.ndarray]:
        """A long linear filter from position to force, and a free map of position, velocity and direction."""
        shift = np.arange(FIR_TAPS) - FIR_TAPS // 2
        index = np.clip(self.keep[:, None] + np.round(shift * FIR_STEP_S * self.rate).astype(int), 0, len(self.q) - 1)
        fir = np.column_stack([self.v[index], self.a[index]])
        q, v, a = (x[self.keep] / np.sqrt(np.mean(x ** 2)) for x in (self.q - self.q.mean(), self.v, self.a))
        Q, V, A = (np.stack(bumps(x, count), axis=1) for x, count in ((q, 8), (v, 16), (a, 8)))
        free = np.hstack([(Q[:, :, None] * V[:, None, :]).reshape(len(q), -1),
                          (A[:, :, None] * V[:, None, ::2]).reshape(len(q), -1)])
        return {f"linear of order {2 * FIR_TAPS}": fir, "free map of position, velocity and acceleration": free}


    def free(self, variable: str, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        if variable == "position":
            shapes = bumps(self.q, 16)
        else:  # friction jumps where the motion turns
            shapes = [one * side for one in bumps(np.abs(self.v), 10) for side in (self.v > 0, self.v < 0)]
        return np.column_stack([self.filtered(1.0 * one)[self.keep] for one in shapes])

    def where(self, e: np.ndarray) -> tuple[dict[str, Any], ...]:
        f = np.fft.rfftfreq(len(e), 1 / self.row_rate)
        keep = f > 0
        return octaves(f[keep], np.abs(np.fft.rfft(e)[keep]) ** 2, {"input": "force", "output": "position"})

    def picture(self, errors: Sequence[np.ndarray], names: Sequence[str]) -> Picture:
        t = self.t[self.keep]
        series = tuple(Series(name, *thinned(t, e)) for name, e in zip(names, errors, strict=True))
        return Picture("What each stage leaves on unseen data", "time [s]", "force [N]", series)


def _checked(time: np.ndarray, position: np.ndarray, force: np.ndarray, reference: np.ndarray | None
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    time, position, force = (np.asarray(x, float).ravel() for x in (time, position, force))
    reference = None if reference is None else np.asarray(reference, float).ravel()
    for name, x in (("position", position), ("force", force), ("reference", reference)):
        if x is not None and (x.shape != time.shape or not np.all(np.isfinite(x))):
            raise InputError(f"expected {len(time)} finite samples", field=name, value=x.shape)
    steps = np.diff(time)
    if len(time) < 32 or not np.all(np.isfinite(time)) or np.any(steps <= 0) or np.ptp(steps) > 0.01 * np.mean(steps):
        raise InputError("expected at least 32 uniform, increasing times", field="t", value=len(time))
    if not (np.ptp(position) > 0 and np.ptp(force) > 0):
        raise InputError("expected a position and a force that change", field="position, force")
    return time, position, force, reference


def _coherent_to(position: np.ndarray, force: np.ndarray, rate: float) -> float:
    """Hz, upper end of the last third of an octave in which acceleration and force are coherent."""
    with np.errstate(divide="ignore", invalid="ignore"):  # no acceleration at all: coherent nowhere
        f, coherence = signal.coherence(np.diff(position, 2), force[1:-1], rate, nperseg=len(force) // BLOCKS)
    top = min(SETTINGS.least_cutoff_Hz, 0.4 * rate)
    for upper in top * 2 ** (np.arange(1, 40) / 3):
        band = (f >= upper / 2 ** (1 / 3)) & (f < upper)
        if upper <= 0.4 * rate and band.any() and np.mean(coherence[band]) >= SETTINGS.coherent:
            top = float(upper)
    return top


class DriveTerm(Term):
    """A force that a drive's model may lack: `linear` in the filtered motion, `force` from it (filtered after), or a
    change of the whole prediction."""

    location = "drive"

    def linear(self, data: DriveData, p: np.ndarray) -> np.ndarray | float:
        """(samples,) N, linear in q, v, a."""
        return 0.0

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray | None:
        """(samples,) N, before the filter."""
        return None

    def after(self, data: DriveData, F: np.ndarray, p: np.ndarray) -> np.ndarray:
        """(samples,) N, the prediction changed as a whole."""
        return F


def _one(name: str, unit: str, scale: float, low: float = -np.inf) -> tuple[AxisParameter, ...]:
    return (AxisParameter(name, unit, 0.0 if low < 0 else 1e-3 * scale, low, np.inf, scale),)


class CoulombFriction(DriveTerm):
    variable = "velocity"
    name, words = "coulomb_friction", "Coulomb friction, a force of constant size against the motion"
    separated_by = "slow motion at several constant speeds"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return _one("Fc", "N", data.size[0], 0.0)

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] * np.sign(data.v)


class ForceOffset(DriveTerm):
    name, words = "force_offset", "a constant force (weight on an inclined axis, or an offset of the current sensor)"
    separated_by = "the force with the drive at rest, released and unloaded: a constant force stays, friction does not"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return _one("offset", "N", data.size[0])

    def linear(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] * np.ones_like(data.v)


class CoulombAsymmetry(DriveTerm):
    variable = "velocity"
    name, words = "coulomb_asymmetry", "Coulomb friction that differs between the two directions"
    needs = ("coulomb_friction",)
    separated_by = ForceOffset.separated_by

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return _one("Fc_ahead_less_back", "N", data.size[0])

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] / 2 * np.abs(np.sign(data.v))


class ViscousAsymmetry(DriveTerm):
    variable = "velocity"
    name, words = "viscous_asymmetry", "viscous friction that differs between the two directions"
    separated_by = "several constant speeds in each direction"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return _one("Fv_ahead_less_back", "N s/m", data.size[0] / data.speed)

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] / 2 * np.abs(data.v)


class QuadraticDrag(DriveTerm):
    variable = "velocity"
    name, words = "quadratic_drag", "a drag that grows with the square of the speed"
    separated_by = "several constant speeds"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return _one("c2", "N s^2/m^2", data.size[0] / data.speed ** 2, 0.0)

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] * np.abs(data.v) * data.v


class Stribeck(DriveTerm):
    variable = "velocity"
    name, words = "stribeck_friction", "Stribeck friction, which falls as the drive starts to move"
    needs = ("coulomb_friction",)
    separated_by = "slow motion at several constant speeds"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        top = float(np.max(np.abs(data.v)))
        return (AxisParameter("Fs", "N", 1e-3 * data.size[0], 0.0, np.inf, data.size[0]),
                AxisParameter("v_s", "m/s", 0.1 * top, 1e-3 * top, 0.5 * top, 0.1 * top))

    def starts(self, data: DriveData, residual: np.ndarray) -> list[np.ndarray]:
        top = float(np.max(np.abs(data.v)))
        return [np.array([0.01 * data.size[0], part * top]) for part in (0.02, 0.15)]

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] * np.sign(data.v) * np.exp(-(data.v / p[1]) ** 2)


class Stiffness(DriveTerm):
    variable = "position"
    name, words = "stiffness", "a spring to the ground (a cable, a hose)"
    separated_by = "the force at rest in several positions"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        size = data.size[0]
        return (AxisParameter("k", "N/m", 0.0, -np.inf, np.inf, size / max(float(np.std(data.q)), 1e-300)),
                AxisParameter("force_at_zero", "N", 0.0, -np.inf, np.inf, size))

    def linear(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] * data.q + p[1]


class CubicStiffness(DriveTerm):
    variable = "position"
    name, words = "cubic_stiffness", "a spring that stiffens with the cube of the displacement from mid travel"
    separated_by = "the force at rest in several positions"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return _one("k3", "N/m^3", data.size[0] / float(np.std(data.q)) ** 3)

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        return p[0] * (data.q - (data.q.max() + data.q.min()) / 2) ** 3


class Cogging(DriveTerm):
    variable = "position"
    name, words = "cogging", "a force that is periodic in the position (cogging, pitch of a screw)"
    separated_by = "slow motion over the whole travel"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        travel, size = float(np.ptp(data.q)), data.size[0]
        return (AxisParameter("sine", "N", 0.0, -np.inf, np.inf, size),
                AxisParameter("cosine", "N", 0.0, -np.inf, np.inf, size),
                AxisParameter("periods_per_m", "1/m", 4 / travel, 2 / travel, 400 / travel, 1 / travel))

    def starts(self, data: DriveData, residual: np.ndarray) -> list[np.ndarray]:
        travel, q = float(np.ptp(data.q)), data.q[data.keep]
        # A period needs two turns on the travel, and to be slow against the filter at the usual speed.
        tried = np.arange(2.0, 100.0, 0.25) / travel
        power = [abs(np.sum(residual * np.exp(-2j * np.pi * n * q))) for n in tried]
        return [np.array([0.0, 0.0, tried[int(np.argmax(power))]])]

    def force(self, data: DriveData, p: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * p[2] * data.q
        return p[0] * np.sin(angle) + p[1] * np.cos(angle)


class Delay(DriveTerm):
    name = "delay"
    words = "a delay between force and position (negative: the force was logged late)"
    separated_by = "faster motion: a delay and a lag differ at high frequency"

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return (AxisParameter("delay_s", "s", 1e-4, -0.1, 0.1, 1e-3),)

    def after(self, data: DriveData, F: np.ndarray, p: np.ndarray) -> np.ndarray:
        # The position comes late: the force of now is seen in the motion of later.
        return np.interp(data.t + p[0], data.t, F)


class Lag(DriveTerm):
    name, words = "actuator_lag", "a first-order lag of the actuator, commanded force F + T F'"
    separated_by = Delay.separated_by

    def parameters(self, data: DriveData) -> tuple[AxisParameter, ...]:
        return (AxisParameter("time_constant_s", "s", 1e-4, 0.0, 0.1, 1e-3),)

    def after(self, data: DriveData, F: np.ndarray, p: np.ndarray) -> np.ndarray:
        return F + p[0] * np.gradient(F, 1 / data.rate)


register("drive", CoulombFriction(), ForceOffset(), CoulombAsymmetry(), ViscousAsymmetry(), QuadraticDrag(), Stribeck(),
         Stiffness(), CubicStiffness(), Cogging(), Delay(), Lag())
