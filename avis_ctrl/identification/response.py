"""Frequency response of a rig as its records see it, with its derivative by every parameter.

    y = s(w) (jw)^p R { inv(D) F  [u; v_floor; transient] - r E v_floor / jw } + aliases R inv(M) T u
    D = K + jw C - w^2 M,    F = [ T h(w) a(w),  (K_f + jw C_f) E / jw,  I, jw I ]

R picks the motion along each sensor, s is its chain (geophone, compensation, preamplifier), p the derivative that it
senses, each its own, h hold and delay, a the amplifiers, E the three translations of the floor, r one for what is
read against the chassis and zero otherwise. The last two blocks of F carry the transient of a record that does not
start and end alike: whatever momentum and displacement it starts with acts as an impulse and a step (real vectors,
unknown, found along with the parameters).

Derivatives are analytic: d inv(D)F = inv(D) (dF - dD inv(D) F), with dM, dC, dK, dT of the rig's matrices. These are
polynomials of at most second degree in each parameter, for which a central difference is exact at any step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, wraps
from itertools import zip_longest
from typing import NamedTuple, Protocol, Self, TypeVar

import numpy as np

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.identification.large_motion import AS_SIMULATED, Turning
from avis_ctrl.identification.sample_and_hold import Motion, aliases, hold
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.lti.rational import cascade, second_order_roots
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Parameter, Rig

FLOOR = ("vx", "vy", "vz")
MOTION_OF_UNIT: dict[str, Motion] = {"m": "displacement", "m/s": "velocity", "m/s^2": "acceleration"}
_POWER: dict[str, int] = {"displacement": 0, "velocity": 1, "acceleration": 2}
N_Q = 6
Model = TypeVar("Model")
Value = TypeVar("Value")
# Share of its size at the start that a positive parameter keeps in a fit.
LOWEST = 1e-6


@lru_cache(maxsize=32)
def _chain_response(chain: StateSpace | None, motion: Motion, lines: bytes) -> np.ndarray:
    """(n,) from displacement to y of unit sensitivity; not to be written to. A fit asks for the same lines again."""
    omega = np.frombuffer(lines)
    return (1.0 if chain is None else chain.frequency_response(omega)[:, 0, 0]) * (1j * omega) ** _POWER[motion]


@lru_cache(maxsize=64)
def _aliases(lines: bytes, period_s: float, delay_s: float, motion: Motion, corner_Hz: float | None,
             low_pass: tuple[complex, ...]) -> np.ndarray:
    """(n,) `aliases`, not to be written to."""
    return aliases(np.frombuffer(lines), period_s, delay_s, motion, corner_Hz, low_pass)


def kept_lines(compute: Callable[[Model, np.ndarray], Value], most: int = 2
               ) -> Callable[[Model, np.ndarray], Value]:
    """A method of lines omega that keeps the `most` results it found last, not to be written to: a fit needs them again
    and again, and records of one kind share their lines."""
    known: list[tuple[Model, np.ndarray, Value]] = []

    @wraps(compute)
    def found(model: Model, omega: np.ndarray) -> Value:
        for one, lines, value in known:
            if one is model and lines is omega:
                return value
        known.append((model, omega, value := compute(model, omega)))
        del known[:-most]
        return value
    return found


@dataclass(frozen=True, eq=False)
class SensorModel:
    """Sensors of a rig: names, what motion each chain takes in, and the chain (unit sensitivity).

    motions, chains, poles, sensitivity_units : one a sensor. chain None for an ideal sensor; poles the coefficients
    (ascending) of the chain's denominator, [1] without a chain. sensitivity : (n_y,) unit of y per unit of motion, in
    the passband. relative : (n_y,) which read the payload against the chassis. low_pass : poles of the anti-alias
    filter, which every chain contains.
    """

    names: tuple[str, ...]
    motions: tuple[Motion, ...]
    chains: tuple[StateSpace | None, ...]
    sensitivity: np.ndarray
    unit: str
    sensitivity_units: tuple[str, ...]
    poles: tuple[tuple[float, ...], ...]
    relative: np.ndarray
    # Corner [Hz] and damping ratio of each geophone's suspension, as it is and as its filter assumes; None without one.
    suspensions: tuple[tuple[float, float] | None, ...] = ()
    assumed: tuple[tuple[float, float] | None, ...] = ()
    low_pass: tuple[complex, ...] = ()

    def _detuned(self, s: np.ndarray, k: int) -> np.ndarray | float:
        """Factor on a geophone's response whose suspension is not the one that its filter assumes."""
        known, own = (one[k] if one else None for one in (self.assumed, self.suspensions))
        if known is None or own is None or known == own:
            return 1.0
        (f0, z0), (f, z) = known, own
        w0, w = 2 * np.pi * f0, 2 * np.pi * f
        return (s ** 2 + 2 * z0 * w0 * s + w0 ** 2) / (s ** 2 + 2 * z * w * s + w ** 2)

    @property
    def detuned(self) -> dict[str, tuple[float, float]]:
        """Corner [Hz] and damping ratio of the geophones that their filters do not match."""
        known = zip(self.names, self.suspensions, self.assumed, strict=False)
        return {name: own for name, own, assumed in known if own is not None and own != assumed}

    def suspension_slopes(self, s: np.ndarray, k: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """(n, len(k)) each: relative change of the response of some geophones per Hz of the corner, and per unit of the
        damping ratio; s (n, 1)."""
        f, z = np.array([self.suspensions[one] for one in k], float).T
        w = 2 * np.pi * f
        den = s ** 2 + 2 * z * w * s + w ** 2
        return -2 * np.pi * (2 * z * s + 2 * w) / den, -2 * w * s / den

    @property
    def realised(self) -> SensorModel:
        """The same with every suspension that its filter does not match as part of the sensor's chain."""
        chains = []
        for chain, known, own in zip_longest(self.chains, self.assumed, self.suspensions):
            if chain is not None and known and own and known != own:
                chain = cascade(second_order_roots(*known), second_order_roots(*own), 1.0) @ chain
            chains.append(chain)
        return replace(self, chains=tuple(chains), assumed=self.suspensions)

    def picked(self, index: Sequence[int]) -> SensorModel:
        """The sensors at `index` (from the first), in that order; an index may come again."""
        def of(values: tuple) -> tuple:
            return tuple(values[k] for k in index)
        return SensorModel(of(self.names), of(self.motions), of(self.chains), self.sensitivity[list(index)], self.unit,
                           of(self.sensitivity_units), of(self.poles), self.relative[list(index)],
                           low_pass=self.low_pass)

    @property
    def alike(self) -> bool:
        """Whether all sensors have one chain on one kind of motion, in space."""
        return len({*zip(self.motions, map(id, self.chains), strict=True)}) == 1 and not np.any(self.relative)

    def _common(self) -> int:
        if not self.alike:
            raise InputError("expected sensors of one kind, with one chain", field="sensors", value=list(self.motions))
        return 0

    @property
    def motion(self) -> Motion:
        """That of all sensors. Raises InputError where they differ."""
        return self.motions[self._common()]

    @property
    def chain(self) -> StateSpace | None:
        """That of all sensors. Raises InputError where they differ."""
        return self.chains[self._common()]

    @property
    def transient_poles(self) -> tuple[float, ...]:
        """Those of all sensors. Raises InputError where they differ."""
        return self.poles[self._common()]

    def sense(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y) from displacement to y of unit sensitivity."""
        s = 1j * np.asarray(omega, float)
        lines = s.imag.tobytes()
        return np.stack([_chain_response(chain, motion, lines) * self._detuned(s, k) for k, (chain, motion) in
                         enumerate(zip(self.chains, self.motions, strict=True))], axis=1)

    def driven(self, omega: np.ndarray, period_s: float, delay_s: float, corner_Hz: float | None
               ) -> tuple[np.ndarray, np.ndarray]:
        """(n,) commanded to acting volts: hold, delay and amplifier; and (n, n_y) `aliases` of each sensor's motion,
        which pass its chain far above its corners: its gain is that of the anti-alias filter alone."""
        omega = np.asarray(omega, float)
        lag = 1 + 1j * omega / (2 * np.pi * corner_Hz) if corner_Hz else 1.0
        if not period_s:
            return np.exp(-1j * omega * delay_s) / lag, np.zeros((len(omega), len(self.motions)), complex)
        lines = omega.tobytes()
        return hold(omega, period_s, delay_s) / lag, np.stack(
            [_aliases(lines, period_s, delay_s, motion, corner_Hz, self.low_pass) for motion in self.motions], axis=1)


def sensor_model(rig: Rig, unit: str = "V", names: Sequence[str] | None = None) -> SensorModel:
    """The rig's sensors as its file describes them ("V"), or ideal ones in m, m/s, m/s^2.

    Raises
    ------
    InputError : a unit that is none of these, names that it does not have.
    """
    known, _ = rig.sensor_rows()
    chosen = tuple(names) if names is not None else known
    at = places(chosen, known, f"the sensors of the rig {rig.name} are", "y names")
    n = len(chosen)
    if unit in MOTION_OF_UNIT:
        return SensorModel(chosen, (MOTION_OF_UNIT[unit],) * n, (None,) * n, np.ones(n), unit,
                           (f"{unit} per {unit}",) * n, ((1.0,),) * n, np.zeros(n, bool))
    if unit != "V":
        raise InputError(f"expected V, {', '.join(MOTION_OF_UNIT)}", field="unit of y", value=unit)
    sensors = [rig.sensors()[k] for k in at]
    # Alike sensors share one chain object, whose response is computed once.
    systems = {(one.zeros, one.poles, one.quantity): one.chain(1.0) for one in sensors}
    units = {"velocity": "V s/m", "acceleration": "V s^2/m", "displacement": "V/m"}
    return SensorModel(chosen, tuple(one.quantity for one in sensors),
                       tuple(systems[one.zeros, one.poles, one.quantity] for one in sensors),
                       np.array([one.gain for one in sensors]), "V", tuple(units[one.quantity] for one in sensors),
                       tuple(tuple(np.atleast_1d(np.real(np.poly(one.poles)))[::-1].tolist()) for one in sensors),
                       np.array([not one.inertial for one in sensors]),
                       tuple(one.suspension for one in sensors), tuple(one.suspension for one in sensors),
                       sensors[0].low_pass if sensors else ())


class Matrices(NamedTuple):
    """Equations of motion and sensor rows; for derivatives with a leading axis of parameters."""

    M: np.ndarray
    C: np.ndarray
    K: np.ndarray
    C_floor: np.ndarray
    K_floor: np.ndarray
    T: np.ndarray
    R: np.ndarray


class Driven(NamedTuple):
    """Y (n, n_y, m) for inputs U, and dY (n_p, n, n_y, m) by the parameters in the model's order."""

    Y: np.ndarray
    dY: np.ndarray


@dataclass(frozen=True, eq=False)
class Operands:
    """What the entries of the matrices multiply on each line, and how y follows.

    s : (n, 1, 1) j omega. left, inertial : (n, n_y, 6) y by forces on q, and by forces of inertia, whose reaction a
    chassis may bear. sense, alias : (n, n_y, 1) y by the displacement along a sensor, and by what of it folds back.
    volts : (n, n_u, m) whose aliases are seen; times hold (n, 1, 1) they act. q : (n, 6, m). floor, chassis :
    (n, 3 or 6, m) displacement of what pushes through the mounts, and of what sensors read against. Y : (n, n_y, m).
    """

    sensors: SensorModel
    mat: Matrices
    s: np.ndarray
    left: np.ndarray
    inertial: np.ndarray
    sense: np.ndarray
    alias: np.ndarray
    hold: np.ndarray
    volts: np.ndarray
    q: np.ndarray
    floor: np.ndarray
    chassis: np.ndarray
    Y: np.ndarray

    def derivative(self, names: Sequence[str], d: Matrices, more: int = 0) -> np.ndarray:
        """(n_p + more, n, n_y, m): of Y by parameters of the rig and its sensors, then zeros. d : of the matrices.

        In memory the parameters come last: what is done to all of them is one product a line.
        """
        s, q, (n, n_y, m), n_f = self.s, self.q, self.Y.shape, self.floor.shape[1]
        dY = np.zeros((n, m, n_y, len(names) + more), complex)
        aliased = np.broadcast_to(self.alias, (n, n_y, 1)) * (self.mat.R @ np.linalg.inv(self.mat.M))
        folded = np.linalg.solve(self.mat.M, self.mat.T) @ self.volts
        springs = [(-d.K, q), (-d.C, s * q)]
        if np.any(self.floor):
            springs += [(d.K_floor[:, :, :n_f], self.floor), (d.C_floor[:, :, :n_f], s * self.floor)]
        # y by a vector, and the entries with what they multiply to make it: of rows (p) that they enter at all.
        for left, entries in ((self.left, springs), (-self.inertial, [(d.M, s ** 2 * q)]), (-aliased, [(d.M, folded)]),
                              (self.left * self.hold + aliased, [(d.T, self.volts)])):
            rows = np.flatnonzero(sum(np.any(A, axis=(1, 2)) for A, _ in entries))
            if rows.size:
                dY[..., rows] += left[:, None] @ sum(_products(A[rows], x) for A, x in entries)
        # A row of R touches its own sensor only, as do the sensor's own parameters.
        alias = np.broadcast_to(self.alias, (n, n_y, 1))
        rows, k = np.nonzero(np.any(d.R, axis=2))
        if rows.size:
            R = d.R[rows, k]
            against = R[:, :self.chassis.shape[1]] * self.sensors.relative[k, None]
            change = self.sense[:, k] * (R @ q - against @ self.chassis) + alias[:, k] * (R @ folded)
            dY[:, :, k, rows] += change.swapaxes(1, 2)
        for kind in ("sensor", "corner", "damping"):
            own = [(j, self.sensors.names.index(name.removeprefix(f"{kind}."))) for j, name in enumerate(names)
                   if name.startswith(f"{kind}.")]
            if not own:
                continue
            rows, k = np.array(own).T
            if kind == "sensor":
                change = self.Y[:, k] / self.sensors.sensitivity[k, None]
            else:
                slope = self.sensors.suspension_slopes(s[:, :, 0], k)[kind == "damping"]
                change = slope[:, :, None] * (self.Y[:, k] - alias[:, k] * (self.mat.R[k] @ folded))
            dY[:, :, k, rows] = change.swapaxes(1, 2)
        return dY.transpose(3, 0, 2, 1)


def _products(slopes: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(n, m, i, p) of matrices (p, i, j) times x (n, j, m)."""
    (p, i, j), (n, _, m) = slopes.shape, x.shape
    return (x.swapaxes(1, 2).reshape(n * m, j) @ slopes.transpose(2, 1, 0).reshape(j, i * p)).reshape(n, m, i, p)


class FrequencyModel(Protocol):
    """What the fit of records uses of a model: `ResponseModel`, or one with effects (`gap.table_model`)."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> tuple[str, ...]: ...
    @property
    def values(self) -> np.ndarray: ...
    @property
    def actuators(self) -> tuple[str, ...]: ...
    @property
    def inputs(self) -> tuple[str, ...]: ...
    @property
    def matrices(self) -> Matrices: ...
    @property
    def derivative_matrices(self) -> Matrices: ...
    def scales(self) -> np.ndarray: ...
    def bounds(self) -> tuple[np.ndarray, np.ndarray]: ...
    def reach(self) -> tuple[np.ndarray, np.ndarray]: ...
    def at(self, theta: Sequence[float] | np.ndarray) -> Self: ...
    def driven(self, omega: np.ndarray, U: np.ndarray, derivative: bool = True) -> Driven: ...
    def answer(self, block: SpectralBlock, body: np.ndarray | None = None, derivative: bool = True,
               inner: np.ndarray | None = None) -> Driven: ...
    def sensor_transients(self, omega: np.ndarray) -> np.ndarray: ...
    def inner_transients(self, omega: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class ResponseModel:
    """y of a rig by frequency, as a function of its physical parameters.

    Parameters
    ----------
    rig : structure, and the values of what is not free.
    names : free parameters: of `rig.parameters()`, "sensor.NAME" (its sensitivity), "loop_delay_s".
    sensors : as `sensor_model`. actuators : inputs that records drive, by default all.
    period_s, delay_s : hold and loop delay; period_s = 0 for responses measured against the voltage itself.
    amplifier_corner_Hz : first-order lag of the amplifiers, None for none.
    turning : what turns with the payload, in the second-order terms of a prediction in time; the response is linear.

    Raises
    ------
    InputError : names that the rig does not have.
    """

    rig: Rig
    names: tuple[str, ...]
    sensors: SensorModel
    actuators: tuple[str, ...]
    period_s: float
    delay_s: float
    amplifier_corner_Hz: float | None = None
    turning: Turning = AS_SIMULATED

    def __post_init__(self) -> None:
        places(self.names, list(self._known), f"the rig {self.rig.name} has no such parameter; it has", "parameters")
        available = self.rig.equations_of_motion().actuators
        places(self.actuators, available, f"the actuators of the rig {self.rig.name} are", "u names")

    @staticmethod
    def of(rig: Rig, names: Sequence[str], unit: str = "V", sensors: Sequence[str] | None = None,
           actuators: Sequence[str] | None = None, sampled: bool = True,
           amplifier_corner_Hz: float | None = None) -> ResponseModel:
        """The model of a rig with its own clock and delay."""
        driven = tuple(actuators) if actuators is not None else rig.equations_of_motion().actuators
        return ResponseModel(rig, tuple(names), sensor_model(rig, unit, sensors), driven,
                             1 / rig.sample_rate_Hz if sampled else 0.0, rig.loop_delay_s if sampled else 0.0,
                             amplifier_corner_Hz)

    @property
    def _known(self) -> frozenset[str]:
        """Names of every parameter that could be free."""
        return frozenset(self.all_parameters())

    def all_parameters(self) -> dict[str, Parameter]:
        """Every parameter that could be free."""
        found = dict(self.rig.parameters())
        for name, value, unit in zip(self.sensors.names, self.sensors.sensitivity, self.sensors.sensitivity_units,
                                     strict=True):
            found[f"sensor.{name}"] = Parameter(float(value), unit, f"sensitivity of {name}")
        for name, own in zip(self.sensors.names, self.sensors.suspensions or (), strict=False):
            if own is not None:
                found[f"corner.{name}"] = Parameter(own[0], "Hz", f"corner of the suspension of {name}")
                found[f"damping.{name}"] = Parameter(own[1], "", f"damping ratio of the suspension of {name}")
        found["loop_delay_s"] = Parameter(self.delay_s, "s", "delay from the sample to the actuator voltage")
        return found

    @cached_property
    def values(self) -> np.ndarray:
        """(n_p,) present values of the free parameters; not to be written to."""
        known = self.all_parameters()
        found = np.array([known[name].value for name in self.names])
        found.setflags(write=False)
        return found

    @property
    def units(self) -> tuple[str, ...]:
        known = self.all_parameters()
        return tuple(known[name].unit for name in self.names)

    def scales(self) -> np.ndarray:
        """(n_p,) what one relative unit of a parameter is: its size, or 0.1 (m, kg m^2, ..) for one that is zero."""
        values = self.values
        return np.where(values == 0, 0.1, np.abs(values))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) lowest and highest values in a fit from here: what is positive keeps LOWEST of its size."""
        low = np.where([positive(name) for name in self.names], LOWEST * self.scales(), -np.inf)
        return low, np.full(len(low), np.inf)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) relative units by which a parameter may go down or up in one step of a fit: half of itself."""
        half = np.full(len(self.names), 0.5)
        return half, half

    @property
    def inputs(self) -> tuple[str, ...]:
        """Actuators, then the floor's velocities."""
        return (*self.actuators, *FLOOR)

    def at(self, theta: Sequence[float] | np.ndarray) -> Self:
        """The model with its free parameters at theta (n_p,). Raises InputError where no rig has them."""
        values = dict(zip(self.names, np.asarray(theta, float).tolist(), strict=True))
        sensitivity = np.array([values.get(f"sensor.{name}", old) for name, old
                                in zip(self.sensors.names, self.sensors.sensitivity, strict=True)])
        delay = values.get("loop_delay_s", self.delay_s)
        if not 0 <= delay < 1:
            raise InputError("expected a delay from 0 to 1 s", field="loop_delay_s", value=delay)
        of_rig = {name: value for name, value in values.items()
                  if not name.startswith(("sensor.", "corner.", "damping.")) and name != "loop_delay_s"}
        own = tuple(old and (values.get(f"corner.{name}", old[0]), values.get(f"damping.{name}", old[1]))
                    for name, old in zip(self.sensors.names, self.sensors.suspensions, strict=False))
        return replace(self, rig=self.rig.with_parameters(of_rig), delay_s=delay,
                       sensors=replace(self.sensors, sensitivity=sensitivity, suspensions=own))

    @cached_property
    def matrices(self) -> Matrices:
        """Of the rig as it is, the actuators and sensors of the model."""
        return self.matrices_of(self.rig)

    def matrices_of(self, rig: Rig) -> Matrices:
        """Of that rig, with the actuators and sensors of the model."""
        eom = rig.equations_of_motion()
        known, rows = rig.sensor_rows()
        R = rows[[known.index(name) for name in self.sensors.names]]
        T = eom.T[:, [eom.actuators.index(name) for name in self.actuators]]
        return Matrices(eom.M, eom.C, eom.K, eom.C_floor, eom.K_floor, T, R)

    @cached_property
    def derivative_matrices(self) -> Matrices:
        """By each free parameter, (n_p, ...) each; zero for those that are not the rig's."""
        known = self.rig.parameters()
        shapes = [(len(self.names), *matrix.shape) for matrix in self.matrices]
        found = Matrices(*(np.zeros(shape) for shape in shapes))
        for j, name in enumerate(self.names):
            if name not in known:
                continue
            for which, channel, slope in self.rig.slopes(name) or self._differences(name, known[name].value):
                if not channel:
                    getattr(found, which)[j] = slope
                elif which == "T" and channel in self.actuators:
                    found.T[j, :, self.actuators.index(channel)] = slope
                elif which == "R" and channel in self.sensors.names:
                    found.R[j, self.sensors.names.index(channel)] = slope
        return found

    def _differences(self, name: str, value: float) -> list[tuple[str, str, np.ndarray]]:
        """As `Rig.slopes`, whole matrices: central differences, exact at any step for polynomials of second degree."""
        step = 0.1 * abs(value) or 1e-3  # a tenth loses no digits
        up, down = (self.matrices_of(self.rig.with_parameters({name: value + sign * step})) for sign in (1, -1))
        slopes = (high - low for high, low in zip(up, down, strict=True))
        return [(which, "", slope / (2 * step)) for which, slope in zip(Matrices._fields, slopes, strict=True)]

    def response(self, omega: np.ndarray) -> np.ndarray:
        """G, (n, n_y, n_u + 3): from commanded volts and floor velocity [m/s] to y; omega > 0 [rad/s]."""
        n, n_in = len(omega), len(self.inputs)
        return self.driven(omega, np.broadcast_to(np.eye(n_in, dtype=complex), (n, n_in, n_in)), derivative=False).Y

    def answer(self, block: SpectralBlock, body: np.ndarray | None = None, derivative: bool = True,
               inner: np.ndarray | None = None) -> Driven:
        """y of a block of data; body (n, 12, m): impulses and steps of the transient beside the block's inputs; inner:
        states beside those of body and sensors, of which this model has none."""
        U = block.U if body is None else np.concatenate([block.U, body], axis=1)
        return self.driven(block.omega, U, derivative)

    def sensor_transients(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, n_t): what the ends of a record leave in the sensors: in their chains, and in the suspensions of
        geophones whose corners are free, for no filter cancels these exactly then."""
        own = self.chains_ring(omega)
        if not any(name.startswith("corner.") for name in self.names):
            return own
        return np.concatenate([own, self.suspensions_ring(omega)], axis=2)

    def suspensions_ring(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, 2 m) transients 1/p and s/p of the suspensions of m geophones, p the polynomial of each, at the
        corner that its filter assumes: what a corner within its tolerance changes of them is of second order."""
        s, known = 1j * omega, [(k, own) for k, own in enumerate(self.sensors.assumed) if own is not None]
        lags = np.array(self.sensors.low_pass)
        filtered = np.prod(lags / (lags - s[:, None]), axis=1)
        found = np.zeros((len(omega), len(self.sensors.names), len(known), 2), complex)
        for j, (k, (corner, damping)) in enumerate(known):
            w = 2 * np.pi * corner
            ring = filtered * w ** 2 / (s ** 2 + 2 * damping * w * s + w ** 2)
            found[:, k, j] = np.stack([ring, s / w * ring], axis=-1)
        return found.reshape(*found.shape[:2], -1)

    def chains_ring(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, n_t): `chain_transients` of each sensor."""
        each, start = self.chain_transients(1j * omega), 0
        found = np.zeros((len(omega), len(each), sum(own.shape[1] for own in each)), complex)
        for k, own in enumerate(each):
            found[:, k, start:start + own.shape[1]] = own
            start += own.shape[1]
        return found

    def chain_transients(self, s: np.ndarray) -> list[np.ndarray]:
        """(n, k) of each sensor: what the ends of a record leave in it by itself: the states of its chain, and a
        constant and a slope in frequency, which hold the aliases of all others; s (n,) j omega."""
        known = {}
        for poles in dict.fromkeys(self.sensors.poles):
            states = (s ** k / np.polyval(np.asarray(poles)[::-1], s) for k in range(len(poles) - 1))
            known[poles] = np.stack([*states, np.ones(len(s)), s], axis=-1)
        return [known[poles] for poles in self.sensors.poles]

    def inner_transients(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, 0): y by initial states beside those of body and sensors, of which this model has none."""
        return np.zeros((len(omega), len(self.sensors.names), 0), complex)

    def driven(self, omega: np.ndarray, U: np.ndarray, derivative: bool = True) -> Driven:
        """y for spectra of the inputs, and its derivative by the free parameters.

        U : (n, n_u + 3, m), or (n, n_u + 3 + 12, m) with impulse and step of the transient last.
        """
        omega = np.asarray(omega, float)
        s, mat, n_u = 1j * omega[:, None, None], self.matrices, len(self.actuators)
        a, alias, inverse, out = self._lines(omega)
        volts, floor = U[:, :n_u], U[:, n_u:n_u + 3]
        force = np.zeros((len(omega), N_Q, U.shape[2]), complex)
        driven, moving = np.any(volts), np.any(floor)
        if driven:
            force += mat.T @ (a * volts)
        if moving:
            force += (mat.K_floor[:, :3] / s + mat.C_floor[:, :3]) @ floor
        if U.shape[1] > len(self.inputs):
            force += U[:, n_u + 3:n_u + 3 + N_Q] + s * U[:, n_u + 3 + N_Q:]
        q = inverse @ force
        seen = mat.R @ q
        if moving and np.any(self.sensors.relative):
            seen -= (mat.R[:, :3] * self.sensors.relative[:, None]) @ (floor / s)
        S = self.sensors.sensitivity[:, None]
        Y = S * out * seen
        Minv = np.linalg.inv(mat.M)
        if driven:
            # Aliases pass the chain far above its corners.
            Y += S * alias * (mat.R @ Minv @ mat.T @ volts)
        if not derivative:
            return Driven(Y, np.empty(0))
        left, w = S * out * (mat.R @ inverse), floor / s
        operands = Operands(self.sensors, mat, s, left, left, S * out, S * alias, a, volts, q, w, w, Y)
        dY = operands.derivative(self.names, self.derivative_matrices)
        if "loop_delay_s" in self.names:
            dY[self.names.index("loop_delay_s")] = self._delay_derivative(omega, volts, mat, inverse, out, Minv)
        return Driven(Y, dY)

    def _delay_derivative(self, omega, volts, mat, inverse, out, Minv) -> np.ndarray:
        """Of the continuous term exactly; aliases by a difference, for they are small, with a kink at whole samples."""
        s, step = 1j * omega[:, None, None], 1e-4 * (self.period_s or 1e-3)
        a, _ = self.drive(omega)
        earlier, later = max(self.delay_s - step, 0.0), self.delay_s + step
        slope = (replace(self, delay_s=later).drive(omega)[1]
                 - replace(self, delay_s=earlier).drive(omega)[1]) / (later - earlier)
        moved = out * (mat.R @ inverse @ mat.T @ (-s * a * volts)) + slope * (mat.R @ Minv @ mat.T @ volts)
        return self.sensors.sensitivity[:, None] * moved

    @kept_lines
    def _lines(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """`drive`, inv(D) (n, 6, 6), and the chains of the sensors (n, n_y, 1)."""
        s, mat = 1j * omega[:, None, None], self.matrices
        inverse = np.linalg.inv(mat.K + s * mat.C + s ** 2 * mat.M)
        return *self.drive(omega), inverse, self.sensors.sense(omega)[:, :, None]

    def drive(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Voltage commanded to force divided by T (n, 1, 1), and the aliases of each sensor (n, n_y, 1)."""
        a, folded = self.sensors.driven(omega, self.period_s, self.delay_s, self.amplifier_corner_Hz)
        return a[:, None, None], folded[:, :, None]


# Names of parameters: the moments of inertia of a payload, and with its mass and its load's all that is inertia.
MOMENTS = (("J1", "J2", "J3"), ("Ixx", "Iyy", "Izz"))
INERTIAL = ("mass", "load.mass", *MOMENTS[0], *MOMENTS[1])


def moment_rows(names: Sequence[str]) -> np.ndarray:
    """(k, n_p) rows r: r @ theta > 0 for all of them where no moment of inertia exceeds the sum of the other two.

    No rows unless all three moments are free. The moments about the axes stand for the principal ones: products of
    inertia are assumed to be small.
    """
    rows = []
    for moments in MOMENTS:
        if set(moments) <= set(names):
            at = [list(names).index(name) for name in moments]
            for largest in at:
                row = np.zeros(len(names))
                row[at] = 1.0
                row[largest] = -1.0
                rows.append(row)
    return np.array(rows).reshape(-1, len(names))


def positive(name: str) -> bool:
    """Whether physics asks for a positive value: masses, stiffness, damping, force constants, sensitivities.

    Of a rig's own parameters; those of effects ("effect@place.parameter") have bounds of their own.
    """
    if "@" in name:
        return False
    last = name.rpartition(".")[2]
    if name.startswith(("sensor.", "actuator.")) or name in INERTIAL:
        return True
    return last.startswith(("k_", "c_")) or (len(last) == 2 and last[0] in "de" and last[1].isdigit())
