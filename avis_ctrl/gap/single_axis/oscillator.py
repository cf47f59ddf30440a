"""An oscillator m y'' + d y' + k y = u with what may be missing from it, in the frequency domain.

As in `identification.single_axis.oscillator`, the transforms of a block obey Y = (U + T - N)/D, D = m s^2 + d s + k,
T a polynomial in s for the state at both ends, fitted block by block and projected out (the state is no part of a
model, so that it is free on unseen blocks too), and N the transform of a nonlinear restoring force, evaluated on the
measured y: exact but for the noise of y, and linear in its coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import signal
from scipy.interpolate import make_interp_spline

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.single_axis.machine import bumps, octaves
from avis_ctrl.gap.single_axis.orientation import require_oriented
from avis_ctrl.gap.single_axis.terms import AxisParameter, Term, register
from avis_ctrl.identification.single_axis.oscillator import TRANSIENT, fit_oscillator
from avis_ctrl.measurement.gates.finding import Picture, Series, thinned

BLOCKS = 16
LEAST_LINES = 40
OVERSAMPLED = 4
LINEAR_ORDER = 40  # of the linear model without physics, where the base has two
DEGREE = 5  # of the free polynomial force in y and y'


class OscillatorData:
    """Transforms of blocks; see `machine.AxisProblem`.

    Parameters
    ----------
    u, y : (n,) band-limited. band_Hz : lines used; by default half a per cent to 40 % of the sample rate.

    Raises
    ------
    InputError : shapes, band, a record too short. ComputationError : no oscillator fits.
    """

    kind = "oscillator"
    noise: float | None = None
    notes: tuple[str, ...] = ("The state at both ends of every block is free, on unseen blocks too.",)

    def __init__(self, u: np.ndarray, y: np.ndarray, sample_rate_Hz: float, band_Hz: tuple[float, float] | None = None):
        u, y = np.asarray(u, float).ravel(), np.asarray(y, float).ravel()
        band = (0.005 * sample_rate_Hz, 0.4 * sample_rate_Hz) if band_Hz is None else band_Hz
        n = len(u) // BLOCKS
        if len(y) == len(u) and np.count_nonzero(_between(n, sample_rate_Hz, band)) < LEAST_LINES:
            raise InputError(f"expected at least {LEAST_LINES} lines of the band in each of {BLOCKS} blocks: a longer "
                             "record or a wider band", field="u, y", value=len(u))
        def fitted(u: np.ndarray, y: np.ndarray) -> tuple[float, bool]:
            try:
                return fit_oscillator(u, y, sample_rate_Hz, band).residual.share, True
            except ComputationError:
                return 1.0, False
        require_oriented(fitted, u, y, "u, y")
        start = fit_oscillator(u, y, sample_rate_Hz, band)  # checks its input too
        self.rate, self.band = sample_rate_Hz, band
        self.line = _between(n, sample_rate_Hz, band)
        self.f = np.fft.rfftfreq(n, 1 / sample_rate_Hz)[self.line]
        self.s = 2j * np.pi * self.f
        self.u, self.y = (x[:n * BLOCKS].reshape(BLOCKS, n) for x in (u, y))
        # Kinks in a force have harmonics beyond half the sample rate, which would fold back into the band.
        fine = signal.resample_poly(y - y.mean(), OVERSAMPLED, 1, window=("kaiser", 8.0)) + y.mean()
        spline = make_interp_spline(np.arange(len(fine)) / (OVERSAMPLED * sample_rate_Hz), fine, k=5)
        v = spline.derivative()(np.arange(len(fine)) / (OVERSAMPLED * sample_rate_Hz))
        self.fine, self.v = (x[:OVERSAMPLED * n * BLOCKS].reshape(BLOCKS, -1) for x in (fine, v))
        self.U, self.Y = self.transform(self.u), self.transform(self.y)
        self.s0 = 2 * np.pi * float(np.sqrt(band[0] * band[1])) if band[0] > 0 else np.pi * band[1]
        self.level = float(np.sqrt(np.mean(y ** 2)))
        self.speed = float(np.sqrt(np.mean(self.v ** 2)))
        self.base = tuple(AxisParameter(name, unit, float(x), 0.0 if name != "d" else -np.inf, np.inf, abs(float(x)))
                          for name, unit, x in zip(start.names, start.information.units, start.values, strict=True))
        self.k = float(start.values[2])
        self.force = self.k * self.level
        lines = len(self.f)
        # Rows: for each block the real parts of its lines, then the imaginary parts.
        self.block = np.repeat(np.arange(BLOCKS), 2 * lines)
        self.runs = [np.arange(2 * lines * b + lines * part, 2 * lines * b + lines * (part + 1))
                     for b in range(BLOCKS) for part in (0, 1)]
        self.size = np.full(len(self.block), float(np.sqrt(np.mean(np.abs(self.Y) ** 2) / 2)))
        order, loud = np.arange(BLOCKS), np.argsort(np.mean(self.y ** 2, axis=1))
        half = BLOCKS // 2
        self.splits = [("first and second half of the record", order[:half], order[half:]),
                       ("softer and louder blocks", loud[:half], loud[half:]),
                       ("even and odd blocks", order[::2], order[1::2])]

    def transform(self, x: np.ndarray) -> np.ndarray:
        """(blocks, lines) of (blocks, samples), at the sample rate or OVERSAMPLED times it."""
        return np.fft.rfft(x, axis=1)[:, :len(self.line)][:, self.line] * (self.u.shape[1] / x.shape[1])

    def _free_state(self, e: np.ndarray, D: np.ndarray) -> np.ndarray:
        """(2 lines, columns) without the part that T/D can be; e (lines, columns) complex."""
        powers = (self.s / self.s0)[:, None] ** np.arange(TRANSIENT) / D[:, None]
        Q = np.linalg.qr(np.vstack([powers.real, powers.imag]))[0]
        flat = np.vstack([e.real, e.imag])
        return flat - Q @ (Q.T @ flat)

    def _dynamics(self, theta: np.ndarray) -> np.ndarray:
        return theta[0] * self.s ** 2 + theta[1] * self.s + theta[2]

    def residual(self, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        D, at = self._dynamics(theta), len(self.base)
        U = self.U.astype(complex)
        late = np.ones_like(self.s)
        for term in terms:
            assert isinstance(term, OscillatorTerm)
            p = theta[at:at + len(term.parameters(self))]
            at += len(p)
            U = U - term.transformed(self, p)
            late = late * term.path(self, p)
            D = D + term.impedance(self, p)
        return self._free_state((self.Y - late * U / D).T, D).T.ravel()

    def sigma(self, e: np.ndarray, used: np.ndarray) -> np.ndarray:
        return np.full(len(e), max(float(np.sqrt(np.mean(e[used] ** 2))), 1e-12 * self.size[0]))

    def references(self, terms: Sequence[Term], theta: np.ndarray) -> Mapping[str, np.ndarray]:
        """A bank of modes all over the band, driven by the input; and any polynomial force in y and y'."""
        D = self._dynamics(theta)
        modes = 2 * np.pi * np.geomspace(self.f[0], self.f[-1], LINEAR_ORDER // 2)
        # As broad as they are apart, so that together they follow any smooth response. The input alone drives them:
        # with the output among the regressors they would predict its noise.
        broad = float(np.log(modes[1] / modes[0])) / 2
        linear = [self.U * self.s ** k * w ** (2 - k) / (self.s ** 2 + 2 * broad * w * self.s + w ** 2) / theta[2]
                  for w in modes for k in (0, 1)]
        # And the resonance itself, free to move and to broaden.
        linear += [self.U * (self.s / self.s0) ** k * theta[2] / D ** 2 for k in range(4)]
        y, v = self.fine / self.level, self.v / self.speed
        free = [self.transform(self._without_linear(y ** i * v ** j)) / D
                for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)
                if i + j >= 2]
        found = {f"linear of order {LINEAR_ORDER}": self._columns(linear, D),
                 f"any force of degree {DEGREE} in y and y'": self._columns(free, D)}
        if not terms:
            # A named force passes the noise of y on, which a free function of the same y would then predict.
            found |= {f"free function of the {name}": self.free(name, terms, theta)
                      for name in ("position", "velocity")}
        return found

    def free(self, variable: str, terms: Sequence[Term], theta: np.ndarray) -> np.ndarray:
        x = self.fine if variable == "position" else self.v
        D = self._dynamics(theta)
        return self._columns([self.transform(self._without_linear(one)) / D for one in bumps(x, 16)], D)

    def _without_linear(self, N: np.ndarray) -> np.ndarray:
        """N(y, y') less what is linear in y and y'.

        A regressor that holds y itself holds the noise of the y that it is to predict, and would predict it. For a
        Gaussian y the rest does not correlate with small noise on y (Stein: E[N' - E[y N]/E[y^2]] = 0).
        """
        linear = np.column_stack([self.fine.ravel(), self.v.ravel(), np.ones(N.size)])
        scale = np.linalg.norm(linear, axis=0)
        Q = linear / scale
        return N - (Q @ np.linalg.solve(Q.T @ Q, Q.T @ N.ravel())).reshape(N.shape)

    def _columns(self, several: Sequence[np.ndarray], D: np.ndarray) -> np.ndarray:
        return np.column_stack([self._free_state(one.T, D).T.ravel() for one in several])

    def where(self, e: np.ndarray) -> tuple[dict[str, Any], ...]:
        power = np.sum(e.reshape(BLOCKS, 2, -1) ** 2, axis=(0, 1))
        return octaves(self.f, power, {"input": "u", "output": "y"})

    def picture(self, errors: Sequence[np.ndarray], names: Sequence[str]) -> Picture:
        def level(e: np.ndarray) -> np.ndarray:
            return np.sqrt(np.mean(np.sum(e.reshape(BLOCKS, 2, -1) ** 2, axis=1), axis=0) / self.y.shape[1])
        series = [Series("measured", *thinned(self.f, np.sqrt(np.mean(np.abs(self.Y) ** 2, axis=0) / self.y.shape[1])))]
        series += [Series(name, *thinned(self.f, level(e))) for name, e in zip(names, errors, strict=True)]
        return Picture("What each stage leaves on unseen data", "frequency [Hz]", "r.m.s. on a line [unit of y]",
                       tuple(series), (), "log", "log")


def _between(n: int, rate: float, band: tuple[float, float]) -> np.ndarray:
    f = np.fft.rfftfreq(n, 1 / rate) if n > 0 and rate > 0 else np.zeros(0)
    return (f >= band[0]) & (f <= band[1]) & (f > 0)


class OscillatorTerm(Term):
    """What an oscillator's equation may lack: a restoring force on the left side, a change of the path from u to y, or
    linear dynamics added to D."""

    location = "oscillator"

    def transformed(self, data: OscillatorData, p: np.ndarray) -> np.ndarray | float:
        """(blocks, lines) transform of the force."""
        return 0.0

    def path(self, data: OscillatorData, p: np.ndarray) -> np.ndarray | float:
        """(lines,) factor of the response to the input."""
        return 1.0

    def impedance(self, data: OscillatorData, p: np.ndarray) -> np.ndarray | float:
        """(lines,) added to D."""
        return 0.0


class Force(OscillatorTerm):
    """A force c N(y, y'), linear in c; the transform of N is kept, one for each data set."""

    symbol = "c"
    low = -np.inf

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def unit(self) -> str:
        raise NotImplementedError

    def _of(self, data: OscillatorData) -> tuple[np.ndarray, float]:
        kept = data.__dict__.setdefault("kept", {})
        if self.key not in kept:
            N = self.shape(data.fine, data.v)
            kept[self.key] = data.transform(N), float(np.sqrt(np.mean(N ** 2)))
        return kept[self.key]

    def parameters(self, data: OscillatorData) -> tuple[AxisParameter, ...]:
        scale = 0.01 * data.force / self._of(data)[1]
        start = 0.0 if self.low < 0 else 1e-3 * scale
        return (AxisParameter(self.symbol, self.unit(), start, self.low, np.inf, scale),)

    def transformed(self, data: OscillatorData, p: np.ndarray) -> np.ndarray:
        return p[0] * self._of(data)[0]


class CubicStiffness(Force):
    variable = "position"
    name, words, symbol = "cubic_stiffness", "cubic stiffness, a restoring force k3 y^3", "k3"
    separated_by = "a sine swept slowly up and down at several levels"

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        return y ** 3

    def unit(self) -> str:
        return "u a unit of y^3"


class QuadraticStiffness(Force):
    variable = "position"
    name, words, symbol = "quadratic_stiffness", "quadratic stiffness, a restoring force k2 y^2", "k2"
    separated_by = "the mean displacement under a sine at several levels"

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        return y ** 2

    def unit(self) -> str:
        return "u a unit of y^2"


class QuadraticDamping(Force):
    variable = "velocity"
    name, words, symbol = "quadratic_damping", "quadratic damping, a force d2 |y'| y'", "d2"
    low = 0.0  # a passive force takes energy out
    separated_by = "free decays from several amplitudes"

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.abs(v) * v

    def unit(self) -> str:
        return "u s^2 a unit of y^2"


class CubicDamping(Force):
    variable = "velocity"
    name, words, symbol = "cubic_damping", "cubic damping, a force d3 y'^3", "d3"
    low = 0.0
    separated_by = "free decays from several amplitudes"

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        return v ** 3

    def unit(self) -> str:
        return "u s^3 a unit of y^3"


class CoulombFriction(Force):
    variable = "velocity"
    name, words = "coulomb_friction", "Coulomb friction, a force of constant size against the motion"
    symbol, low = "Fc", 0.0
    separated_by = "free decays from several amplitudes"

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.sign(v)

    def unit(self) -> str:
        return "u"


class PositionDamping(Force):
    name, words = "position_damping", "damping that grows with the square of the position, a force c y^2 y'"
    low = 0.0
    separated_by = "free decays from several amplitudes"

    def shape(self, y: np.ndarray, v: np.ndarray) -> np.ndarray:
        return y ** 2 * v

    def unit(self) -> str:
        return "u s a unit of y^3"


class InputCurvature(OscillatorTerm):
    """The drive's gain depends on the drive: u + g u^power, power 2 or 3."""

    location = "input"
    power = 3
    name, words = "input_nonlinearity", "a drive whose gain changes with its level, u + g u^3"
    separated_by = "the response far above the resonance at several levels"

    def parameters(self, data: OscillatorData) -> tuple[AxisParameter, ...]:
        level = float(np.sqrt(np.mean(data.u ** 2)))
        return (AxisParameter("g", f"1/u^{self.power - 1}", 0.0, -np.inf, np.inf, 0.01 / level ** (self.power - 1)),)

    def transformed(self, data: OscillatorData, p: np.ndarray) -> np.ndarray:
        kept = data.__dict__.setdefault("kept", {})
        if self.key not in kept:
            kept[self.key] = data.transform(data.u ** self.power)
        return -p[0] * kept[self.key]


class InputCurvatureEven(InputCurvature):
    power = 2
    name, words = "input_nonlinearity_even", "a drive whose gain differs between the two directions, u + g u^2"


class Delay(OscillatorTerm):
    location = "input"
    name, words = "delay", "a delay between input and output"
    separated_by = "a wider band: delay and lag differ at high frequency"

    def parameters(self, data: OscillatorData) -> tuple[AxisParameter, ...]:
        return (AxisParameter("delay_s", "s", 0.01 / data.rate, 0.0, 10 / data.band[1], 1 / data.rate),)

    def path(self, data: OscillatorData, p: np.ndarray) -> np.ndarray:
        return np.exp(-data.s * p[0])


class Lag(Delay):
    name, words = "actuator_lag", "a first-order lag in the path from input to output"

    def parameters(self, data: OscillatorData) -> tuple[AxisParameter, ...]:
        return (AxisParameter("time_constant_s", "s", 0.01 / data.rate, 0.0, 10 / data.band[1], 1 / data.rate),)

    def path(self, data: OscillatorData, p: np.ndarray) -> np.ndarray:
        return 1 / (1 + data.s * p[0])


class AttachedOscillator(OscillatorTerm):
    """A sprung mass m2 on the oscillator adds m2 s^2 (c s + k2)/(m2 s^2 + c s + k2) to D (Den Hartog)."""

    name, words = "attached_oscillator", "a second mode, a sprung mass on the oscillator"
    separated_by = "a finer resolution about the second resonance"

    def parameters(self, data: OscillatorData) -> tuple[AxisParameter, ...]:
        low, high = float(data.f[0]), float(data.f[-1])
        mass = data.base[0].start
        return (AxisParameter("mass", "u s^2 a unit of y", 0.01 * mass, 0.0, np.inf, 0.1 * mass),
                AxisParameter("frequency_Hz", "Hz", float(np.sqrt(low * high)), low, high, 0.1 * high),
                AxisParameter("damping", "", 0.02, 1e-4, 1.0, 0.02))

    def starts(self, data: OscillatorData, residual: np.ndarray) -> list[np.ndarray]:
        power = np.sum(residual.reshape(BLOCKS, 2, -1) ** 2, axis=(0, 1))
        smooth = np.convolve(power, np.ones(9), mode="same")
        tried = (float(data.f[int(np.argmax(smooth))]), float(np.sqrt(data.f[0] * data.f[-1])))
        return [np.array([0.01 * data.base[0].start, f, 0.02]) for f in tried]

    def impedance(self, data: OscillatorData, p: np.ndarray) -> np.ndarray:
        w = 2 * np.pi * p[1]
        inner = 2 * p[2] * w * data.s + w ** 2
        return p[0] * data.s ** 2 * inner / (data.s ** 2 + inner)


register("oscillator", CubicStiffness(), QuadraticStiffness(), QuadraticDamping(), CubicDamping(), CoulombFriction(),
         PositionDamping(), InputCurvature(), InputCurvatureEven(), Delay(), Lag(), AttachedOscillator())
