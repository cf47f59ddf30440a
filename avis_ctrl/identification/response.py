"""Frequency response of a rig as its records show it, with its derivatives by all parameters.

    y = s(w) (jw)^p R { inv(D) F  [u; v_floor; transient] - r E v_floor / jw } + aliases R inv(M) T u
    D = K + jw C - w^2 M,    F = [ T h(w) a(w),  (K_f + jw C_f) E / jw,  I, jw I ]

R picks the motion along each sensor. For each sensor, s is its chain (geophone, compensation, preamplifier) and p the
order of the derivative that it measures; r is one if it measures relative to the chassis and zero otherwise. h is hold
and delay, a the amplifiers, E the three translations of the floor. The last two blocks of F represent the transient of
a record that does not start and end alike: its initial momentum and displacement act as an impulse and a step (real
vectors, unknown, estimated along with the parameters).

Derivatives are analytic: d inv(D)F = inv(D) (dF - dD inv(D) F), with dM, dC, dK, dT of the rig's matrices. These are
polynomials of at most second degree in each parameter, for which a central difference is exact at any step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, wraps
from typing import NamedTuple, Protocol, Self, TypeVar
from weakref import ref

import numpy as np

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.identification.large_motion import AS_SIMULATED, Turning
from avis_ctrl.identification.sample_and_hold import Motion, aliases, hold
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.lti.rational import cascade, second_order_roots
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.measurement.campaign import RecordHeader
from avis_ctrl.rigs.rig import Parameter, Rig

FLOOR = ("vx", "vy", "vz")
MOTION_OF_UNIT: dict[str, Motion] = {"m": "displacement", "m/s": "velocity", "m/s^2": "acceleration"}
_POWER: dict[str, int] = {"displacement": 0, "velocity": 1, "acceleration": 2}
N_Q = 6
Model = TypeVar("Model")
Value = TypeVar("Value")


@dataclass(frozen=True)
class ResponseSettings:
    """lowest : lower bound of a positive parameter in a fit, relative to its size at the start [1]: just above zero,
    where the matrices are still regular."""

    lowest: float = 1e-6


SETTINGS = ResponseSettings()


@lru_cache(maxsize=32)
def _chain_response(chain: StateSpace | None, motion: Motion, lines: bytes) -> np.ndarray:
    """(n,) from displacement to y of unit sensitivity; read-only. Cached, because a fit needs the same lines
    repeatedly."""
    omega = np.frombuffer(lines)
    return (1.0 if chain is None else chain.frequency_response(omega)[:, 0, 0]) * (1j * omega) ** _POWER[motion]


@lru_cache(maxsize=64)
def _aliases(
    lines: bytes,
    period_s: float,
    delay_s: float,
    motion: Motion,
    corner_Hz: float | None,
    low_pass: tuple[complex, ...],
) -> np.ndarray:
    """(n,) `aliases`; read-only."""
    return aliases(np.frombuffer(lines), period_s, delay_s, motion, corner_Hz, low_pass)


def kept_lines(compute: Callable[[Model, np.ndarray], Value], most: int = 2) -> Callable[[Model, np.ndarray], Value]:
    """Cache the last `most` results of a method of lines omega, while their models live; they are read-only. A fit
    needs them repeatedly, and records of one kind share their lines."""
    known: list[tuple[ref[Model], np.ndarray, Value]] = []

    def forget(gone: ref[Model]) -> None:
        known[:] = [one for one in known if one[0] is not gone]

    # Threads share the list. It is only replaced as a whole: at worst, a result is computed twice.
    @wraps(compute)
    def found(model: Model, omega: np.ndarray) -> Value:
        for one, lines, value in tuple(known):
            if one() is model and lines is omega:
                return value
        value = compute(model, omega)
        known[:] = [*known, (ref(model, forget), omega, value)][-most:]
        return value

    return found


@dataclass(frozen=True, eq=False)
class SensorModel:
    """Sensors of a rig: names, the motion that each measures, and its chain (unit sensitivity).

    motions, chains, poles, sensitivity_units : one per sensor. chain None for an ideal sensor; poles the coefficients
        (ascending) of the chain's denominator, [1] without a chain. sensitivity : (n_y,) unit of y per unit of motion,
        in the passband. relative : (n_y,) which sensors measure relative to the chassis. low_pass : poles of the
        anti-alias filter, which every chain contains.
    """

    names: tuple[str, ...]
    motions: tuple[Motion, ...]
    chains: tuple[StateSpace | None, ...]
    sensitivity: np.ndarray
    unit: str
    sensitivity_units: tuple[str, ...]
    poles: tuple[tuple[float, ...], ...]
    relative: np.ndarray
    # Corner [Hz] and damping ratio of each geophone's suspension, actual and assumed by its filter; None without one.
    suspensions: tuple[tuple[float, float] | None, ...] = ()
    assumed: tuple[tuple[float, float] | None, ...] = ()
    low_pass: tuple[complex, ...] = ()

    @property
    def _mismatches(self) -> dict[int, tuple[tuple[float, float], tuple[float, float]]]:
        """Suspension as assumed and actual of the geophones whose filters do not match them, by index."""
        pairs = enumerate(zip(self.assumed, self.suspensions, strict=False))
        return {k: (known, own) for k, (known, own) in pairs if known and own and known != own}

    @property
    def detuned(self) -> dict[str, tuple[float, float]]:
        """Corner [Hz] and damping ratio of the geophones whose filters do not match them."""
        return {self.names[k]: own for k, (_, own) in self._mismatches.items()}

    def suspension_slopes(self, s: np.ndarray, k: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """(n, len(k)) each: relative change of the response of some geophones per Hz of the corner, and per unit of the
        damping ratio; s (n, 1)."""
        f, z = np.array([self.suspensions[one] for one in k], float).T
        w = 2 * np.pi * f
        den = s**2 + 2 * z * w * s + w**2
        return -2 * np.pi * (2 * z * s + 2 * w) / den, -2 * w * s / den

    @property
    def realised(self) -> SensorModel:
        """The same sensors, with every suspension that its filter does not match included in the sensor's chain."""
        chains = list(self.chains)
        for k, (known, own) in self._mismatches.items():
            if (chain := chains[k]) is not None:
                chains[k] = cascade(second_order_roots(*known), second_order_roots(*own), 1.0) @ chain
        return replace(self, chains=tuple(chains), assumed=self.suspensions)

    def picked(self, index: Sequence[int]) -> SensorModel:
        """The sensors at `index`, in that order; an index may be repeated."""

        def of(values: tuple[Value, ...]) -> tuple[Value, ...]:
            return tuple(values[k] for k in index)

        return SensorModel(
            of(self.names),
            of(self.motions),
            of(self.chains),
            self.sensitivity[list(index)],
            self.unit,
            of(self.sensitivity_units),
            of(self.poles),
            self.relative[list(index)],
            low_pass=self.low_pass,
        )

    @property
    def alike(self) -> bool:
        """Whether all sensors measure one kind of motion, in space, with one chain."""
        return len({*zip(self.motions, map(id, self.chains), strict=True)}) == 1 and not np.any(self.relative)

    @property
    def common(self) -> tuple[Motion, StateSpace | None, tuple[float, ...]]:
        """Motion, chain and poles of all sensors. Raises InputError if they differ."""
        if not self.alike:
            raise InputError("expected sensors of one kind, with one chain", field="sensors", value=list(self.motions))
        return self.motions[0], self.chains[0], self.poles[0]

    def sense(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y) response from displacement to y of unit sensitivity."""
        s = 1j * np.asarray(omega, float)
        lines = s.imag.tobytes()
        found = [_chain_response(*one, lines) for one in zip(self.chains, self.motions, strict=True)]
        for k, ((f0, z0), (f, z)) in self._mismatches.items():
            w0, w = 2 * np.pi * f0, 2 * np.pi * f
            found[k] = found[k] * ((s**2 + 2 * z0 * w0 * s + w0**2) / (s**2 + 2 * z * w * s + w**2))
        return np.stack(found, axis=1)

    def driven(
        self, omega: np.ndarray, period_s: float, delay_s: float, corner_Hz: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """(n,) response from commanded to acting volts: hold, delay and amplifier; and (n, n_y) `aliases` of each
        sensor's motion. They pass the chain far above its corners, where its gain is that of the anti-alias filter
        alone."""
        omega = np.asarray(omega, float)
        lag = 1 + 1j * omega / (2 * np.pi * corner_Hz) if corner_Hz else 1.0
        if not period_s:
            return np.exp(-1j * omega * delay_s) / lag, np.zeros((len(omega), len(self.motions)), complex)
        lines = omega.tobytes()
        return hold(omega, period_s, delay_s) / lag, np.stack(
            [_aliases(lines, period_s, delay_s, motion, corner_Hz, self.low_pass) for motion in self.motions], axis=1
        )


def sensor_model(rig: Rig, unit: str = "V", names: Sequence[str] | None = None) -> SensorModel:
    """The rig's sensors as its file describes them ("V"), or ideal sensors in m, m/s, m/s^2.

    Raises
    ------
    InputError : any other unit, names that the rig does not have.
    """
    known, _ = rig.sensor_rows()
    chosen = tuple(names) if names is not None else known
    at = places(chosen, known, f"the sensors of the rig {rig.name} are", "y names")
    n = len(chosen)
    if unit in MOTION_OF_UNIT:
        return SensorModel(
            chosen,
            (MOTION_OF_UNIT[unit],) * n,
            (None,) * n,
            np.ones(n),
            unit,
            (f"{unit} per {unit}",) * n,
            ((1.0,),) * n,
            np.zeros(n, bool),
        )
    if unit != "V":
        raise InputError(f"expected V, {', '.join(MOTION_OF_UNIT)}", field="unit of y", value=unit)
    sensors = [rig.sensors()[k] for k in at]
    # Identical sensors share one chain object, whose response is computed once.
    systems = {(one.zeros, one.poles, one.quantity): one.chain(1.0) for one in sensors}
    units = {"velocity": "V s/m", "acceleration": "V s^2/m", "displacement": "V/m"}
    return SensorModel(
        chosen,
        tuple(one.quantity for one in sensors),
        tuple(systems[one.zeros, one.poles, one.quantity] for one in sensors),
        np.array([one.gain for one in sensors]),
        "V",
        tuple(units[one.quantity] for one in sensors),
        tuple(tuple(np.atleast_1d(np.real(np.poly(one.poles)))[::-1].tolist()) for one in sensors),
        np.array([not one.inertial for one in sensors]),
        tuple(one.suspension for one in sensors),
        tuple(one.suspension for one in sensors),
        sensors[0].low_pass if sensors else (),
    )


# Names of the parameters of the drives that are no rig's.
AMPLIFIERS = "amplifier_time_constant_s"
OF_DRIVES = ("loop_delay_s", AMPLIFIERS)


class Matrices(NamedTuple):
    """Equations of motion and sensor rows; derivatives have a leading axis of parameters."""

    M: np.ndarray
    C: np.ndarray
    K: np.ndarray
    C_floor: np.ndarray
    K_floor: np.ndarray
    T: np.ndarray
    R: np.ndarray


class Driven(NamedTuple):
    """Y (n, n_y, m) for inputs U, and its derivatives dY (n_p, n, n_y, m) by the parameters in the model's order."""

    Y: np.ndarray
    dY: np.ndarray


@dataclass(frozen=True, eq=False)
class Operands:
    """Vectors that the entries of the matrices multiply on each line, and the maps from there to y.

    s : (n, 1, 1) j omega. Y : (n, n_y, m). q : (n, 6, m).
    left, inertial : (n, n_y, 6) y by forces on q, and by inertial forces, whose reaction may act on a chassis.
    sense, alias : (n, n_y, 1) y by the displacement along a sensor, and by its aliased part.
    volts : (n, n_u, m) whose aliases are measured; multiplied by hold (n, 1, 1) they act.
    floor, chassis : (n, 3 or 6, m) displacement that acts through the mounts, and reference of the relative sensors.
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

        The parameters are last in memory, so that one product per line serves all of them.
        """
        s, q, (n, n_y, m), n_f = self.s, self.q, self.Y.shape, self.floor.shape[1]
        dY = np.zeros((n, m, n_y, len(names) + more), complex)
        aliased = np.broadcast_to(self.alias, (n, n_y, 1)) * (self.mat.R @ np.linalg.inv(self.mat.M))
        folded = np.linalg.solve(self.mat.M, self.mat.T) @ self.volts
        springs = [(-d.K, q), (-d.C, s * q)]
        if np.any(self.floor):
            springs += [(d.K_floor[:, :, :n_f], self.floor), (d.C_floor[:, :, :n_f], s * self.floor)]
        # Map from a vector to y, and the matrices with the vectors they multiply; only rows (p) with nonzero entries.
        for left, entries in (
            (self.left, springs),
            (-self.inertial, [(d.M, s**2 * q)]),
            (-aliased, [(d.M, folded)]),
            (self.left * self.hold + aliased, [(d.T, self.volts)]),
        ):
            rows = np.flatnonzero(sum(np.any(A, axis=(1, 2)) for A, _ in entries))
            if rows.size:
                dY[..., rows] += left[:, None] @ sum(_products(A[rows], x) for A, x in entries)
        # A row of R affects its own sensor only, as do the sensor's own parameters.
        alias = np.broadcast_to(self.alias, (n, n_y, 1))
        rows, k = np.nonzero(np.any(d.R, axis=2))
        if rows.size:
            R = d.R[rows, k]
            against = R[:, : self.chassis.shape[1]] * self.sensors.relative[k, None]
            change = self.sense[:, k] * (R @ q - against @ self.chassis) + alias[:, k] * (R @ folded)
            dY[:, :, k, rows] += change.swapaxes(1, 2)
        for kind in ("sensor", "corner", "damping"):
            own = [
                (j, self.sensors.names.index(name.removeprefix(f"{kind}.")))
                for j, name in enumerate(names)
                if name.startswith(f"{kind}.")
            ]
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
    """(n, m, i, p) products of matrices (p, i, j) and x (n, j, m)."""
    (p, i, j), (n, _, m) = slopes.shape, x.shape
    return (x.swapaxes(1, 2).reshape(n * m, j) @ slopes.transpose(2, 1, 0).reshape(j, i * p)).reshape(n, m, i, p)


class FrequencyModel(Protocol):
    """Interface of a model that the fit of records requires: `ResponseModel`, or a model with effects
    (`gap.table_model`)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters."""

    @property
    def units(self) -> tuple[str, ...]:
        """(n_p,) their units."""

    @property
    def values(self) -> np.ndarray:
        """(n_p,) their present values; read-only."""

    @property
    def actuators(self) -> tuple[str, ...]:
        """Driven inputs."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Actuators, then the floor's velocities."""

    @property
    def matrices(self) -> Matrices:
        """Equations of motion and sensor rows."""

    @property
    def derivative_matrices(self) -> Matrices:
        """Derivatives by the free parameters."""

    def scales(self) -> np.ndarray:
        """(n_p,) size of one relative unit of each parameter."""

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) lower and upper bounds in a fit that starts here."""

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) largest relative decrease and increase in one step of a fit."""

    def at(self, theta: Sequence[float] | np.ndarray) -> Self:
        """The model with its free parameters at theta."""

    def driven(self, omega: np.ndarray, U: np.ndarray, derivative: bool = True) -> Driven:
        """y for spectra of the inputs."""

    def answer(
        self,
        block: SpectralBlock,
        body: np.ndarray | None = None,
        derivative: bool = True,
        inner: np.ndarray | None = None,
    ) -> Driven:
        """y of a block of data."""

    def sensor_transients(self, omega: np.ndarray) -> np.ndarray:
        """Transients of the sensors."""

    def inner_transients(self, omega: np.ndarray) -> np.ndarray:
        """y by initial states other than those of body and sensors."""


def size_of(values: np.ndarray) -> np.ndarray:
    """(n_p,) size of one relative unit of each parameter: its magnitude, or 0.1 (m, kg m^2, ..) if it is zero."""
    return np.where(values == 0, 0.1, np.abs(values))


def central_differences(matrices_of: Callable[[Rig], Sequence[np.ndarray]], rig: Rig, name: str) -> list[np.ndarray]:
    """Derivatives of a rig's matrices by a parameter, exact at any step for polynomials of second degree."""
    value = rig.parameters()[name].value
    step = 0.1 * abs(value) or 1e-3  # large enough to avoid cancellation
    up, down = (matrices_of(rig.with_parameters({name: value + sign * step})) for sign in (1, -1))
    return [(high - low) / (2 * step) for high, low in zip(up, down, strict=True)]


@dataclass(frozen=True, eq=False)
class ResponseModel:
    """Frequency response of a rig as a function of its physical parameters.

    Parameters
    ----------
    rig : structure, and the values of the fixed parameters.
    names : free parameters: of `rig.parameters()`, "sensor.NAME" (its sensitivity), "loop_delay_s", and
        "amplifier_time_constant_s" if the amplifiers have a lag.
    sensors : from `sensor_model`. actuators : inputs that records drive, by default all.
    period_s, delay_s : hold and loop delay; period_s = 0 for responses measured relative to the voltage itself.
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
    def of(
        rig: Rig,
        names: Sequence[str],
        unit: str = "V",
        sensors: Sequence[str] | None = None,
        actuators: Sequence[str] | None = None,
        sampled: bool = True,
        amplifier_corner_Hz: float | None = None,
    ) -> ResponseModel:
        """The model of a rig with its own sample rate and delay."""
        driven = tuple(actuators) if actuators is not None else rig.equations_of_motion().actuators
        return ResponseModel(
            rig,
            tuple(names),
            sensor_model(rig, unit, sensors),
            driven,
            1 / rig.sample_rate_Hz if sampled else 0.0,
            rig.loop_delay_s if sampled else 0.0,
            amplifier_corner_Hz,
        )

    @property
    def amplifier_time_constant_s(self) -> float:
        """Time constant of the amplifiers [s]; 0 without a lag."""
        return 1 / (2 * np.pi * self.amplifier_corner_Hz) if self.amplifier_corner_Hz else 0.0

    @property
    def _known(self) -> frozenset[str]:
        """Names of all parameters that may be free."""
        return frozenset(self.all_parameters())

    def all_parameters(self) -> dict[str, Parameter]:
        """All parameters that may be free."""
        found = dict(self.rig.parameters())
        for name, value, unit in zip(
            self.sensors.names, self.sensors.sensitivity, self.sensors.sensitivity_units, strict=True
        ):
            found[f"sensor.{name}"] = Parameter(float(value), unit, f"sensitivity of {name}")
        for name, own in zip(self.sensors.names, self.sensors.suspensions or (), strict=False):
            if own is not None:
                found[f"corner.{name}"] = Parameter(own[0], "Hz", f"corner of the suspension of {name}")
                found[f"damping.{name}"] = Parameter(own[1], "", f"damping ratio of the suspension of {name}")
        found["loop_delay_s"] = Parameter(self.delay_s, "s", "delay from the sample to the actuator voltage")
        if self.amplifier_corner_Hz:
            found[AMPLIFIERS] = Parameter(self.amplifier_time_constant_s, "s", "time constant of the amplifiers")
        return found

    @cached_property
    def values(self) -> np.ndarray:
        """(n_p,) present values of the free parameters; read-only."""
        known = self.all_parameters()
        found = np.array([known[name].value for name in self.names])
        found.setflags(write=False)
        return found

    @property
    def units(self) -> tuple[str, ...]:
        """(n_p,) units of the free parameters."""
        known = self.all_parameters()
        return tuple(known[name].unit for name in self.names)

    def scales(self) -> np.ndarray:
        """(n_p,) size of one relative unit of each parameter."""
        return size_of(self.values)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) lower and upper bounds in a fit that starts here: `lowest` times its size if positive."""
        low = np.where([positive(name) for name in self.names], SETTINGS.lowest * self.scales(), -np.inf)
        return low, np.full(len(low), np.inf)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) relative amounts by which a parameter may decrease or increase in one step of a fit: half its size."""
        half = np.full(len(self.names), 0.5)
        return half, half

    @property
    def inputs(self) -> tuple[str, ...]:
        """Actuators, then the floor's velocities."""
        return (*self.actuators, *FLOOR)

    def require_rate(self, header: RecordHeader) -> None:
        """Raise InputError for a record that was sampled at another rate."""
        if self.period_s and abs(header.sample_rate_Hz * self.period_s - 1) > 1e-6:
            raise InputError(
                f"expected the rig's own {1 / self.period_s:g} Hz",
                value=header.sample_rate_Hz,
                field=f"record {header.name}: sample_rate_Hz",
            )

    def at(self, theta: Sequence[float] | np.ndarray) -> Self:
        """The model with its free parameters at theta (n_p,). Raises InputError if no rig has these values."""
        values = dict(zip(self.names, np.asarray(theta, float).tolist(), strict=True))
        sensitivity = np.array(
            [
                values.get(f"sensor.{name}", old)
                for name, old in zip(self.sensors.names, self.sensors.sensitivity, strict=True)
            ]
        )
        delay = values.get("loop_delay_s", self.delay_s)
        if not 0 <= delay < 1:
            raise InputError("expected a delay from 0 to 1 s", field="loop_delay_s", value=delay)
        corner = self.amplifier_corner_Hz
        if AMPLIFIERS in values:
            if values[AMPLIFIERS] <= 0:
                raise InputError("expected a time constant above zero", field=AMPLIFIERS, value=values[AMPLIFIERS])
            corner = 1 / (2 * np.pi * values[AMPLIFIERS])
        of_rig = {
            name: value
            for name, value in values.items()
            if not name.startswith(("sensor.", "corner.", "damping.")) and name not in OF_DRIVES
        }
        own = tuple(
            old and (values.get(f"corner.{name}", old[0]), values.get(f"damping.{name}", old[1]))
            for name, old in zip(self.sensors.names, self.sensors.suspensions, strict=False)
        )
        return replace(
            self,
            rig=self.rig.with_parameters(of_rig),
            delay_s=delay,
            amplifier_corner_Hz=corner,
            sensors=replace(self.sensors, sensitivity=sensitivity, suspensions=own),
        )

    @cached_property
    def matrices(self) -> Matrices:
        """Matrices of the rig, with the actuators and sensors of the model."""
        return self.matrices_of(self.rig)

    @cached_property
    def accelerance(self) -> np.ndarray:
        """(n_y, n_u) acceleration along the sensors per volt far above the resonances of the suspension, R inv(M) T."""
        mat = self.matrices
        return mat.R @ np.linalg.solve(mat.M, mat.T)

    def matrices_of(self, rig: Rig) -> Matrices:
        """Matrices of the given rig, with the actuators and sensors of the model."""
        eom = rig.equations_of_motion()
        known, rows = rig.sensor_rows()
        R = rows[[known.index(name) for name in self.sensors.names]]
        T = eom.T[:, [eom.actuators.index(name) for name in self.actuators]]
        return Matrices(eom.M, eom.C, eom.K, eom.C_floor, eom.K_floor, T, R)

    @cached_property
    def derivative_matrices(self) -> Matrices:
        """Derivatives by each free parameter, (n_p, ...) each; zero for parameters that are not the rig's."""
        known = self.rig.parameters()
        shapes = [(len(self.names), *matrix.shape) for matrix in self.matrices]
        found = Matrices(*(np.zeros(shape) for shape in shapes))
        for j, name in enumerate(self.names):
            if name not in known:
                continue
            for which, channel, slope in self.rig.slopes(name) or self._differences(name):
                if not channel:
                    getattr(found, which)[j] = slope
                elif which == "T" and channel in self.actuators:
                    found.T[j, :, self.actuators.index(channel)] = slope
                elif which == "R" and channel in self.sensors.names:
                    found.R[j, self.sensors.names.index(channel)] = slope
        return found

    def _differences(self, name: str) -> list[tuple[str, str, np.ndarray]]:
        """As `Rig.slopes`, whole matrices."""
        slopes = central_differences(self.matrices_of, self.rig, name)
        return [(which, "", slope) for which, slope in zip(Matrices._fields, slopes, strict=True)]

    def response(self, omega: np.ndarray) -> np.ndarray:
        """G, (n, n_y, n_u + 3): from commanded volts and floor velocity [m/s] to y; omega > 0 [rad/s]."""
        n, n_in = len(omega), len(self.inputs)
        return self.driven(omega, np.broadcast_to(np.eye(n_in, dtype=complex), (n, n_in, n_in)), derivative=False).Y

    def answer(
        self,
        block: SpectralBlock,
        body: np.ndarray | None = None,
        derivative: bool = True,
        inner: np.ndarray | None = None,
    ) -> Driven:
        """y of a block of data; body (n, 12, m) : impulses and steps of the transient, added to the block's inputs;
        inner : initial states other than those of body and sensors, of which this model has none."""
        U = block.U if body is None else np.concatenate([block.U, body], axis=1)
        return self.driven(block.omega, U, derivative)

    def sensor_transients(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, n_t) transients of the sensors due to the ends of a record: of their chains and, if their corners
        are free, of the geophones' suspensions, which no filter then cancels exactly."""
        own = self.chains_ring(omega)
        if not any(name.startswith("corner.") for name in self.names):
            return own
        return np.concatenate([own, self.suspensions_ring(omega)], axis=2)

    def suspensions_ring(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, 2 m) transients 1/p and s/p of the suspensions of m geophones, p the polynomial of each at the
        corner that its filter assumes; a change of the corner within its tolerance has only a second-order effect."""
        s, known = 1j * omega, [(k, own) for k, own in enumerate(self.sensors.assumed) if own is not None]
        lags = np.array(self.sensors.low_pass)
        filtered = np.prod(lags / (lags - s[:, None]), axis=1)
        found = np.zeros((len(omega), len(self.sensors.names), len(known), 2), complex)
        for j, (k, (corner, damping)) in enumerate(known):
            w = 2 * np.pi * corner
            ring = filtered * w**2 / (s**2 + 2 * damping * w * s + w**2)
            found[:, k, j] = np.stack([ring, s / w * ring], axis=-1)
        return found.reshape(*found.shape[:2], -1)

    def chains_ring(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, n_t): `chain_transients` of all sensors."""
        each, start = self.chain_transients(1j * omega), 0
        found = np.zeros((len(omega), len(each), sum(own.shape[1] for own in each)), complex)
        for k, own in enumerate(each):
            found[:, k, start : start + own.shape[1]] = own
            start += own.shape[1]
        return found

    def chain_transients(self, s: np.ndarray) -> list[np.ndarray]:
        """(n, k) for each sensor: its own transients due to the ends of a record. These are the states of its chain,
        and a constant and a slope in frequency for the aliases of all other transients; s (n,) j omega."""
        known = {}
        for poles in dict.fromkeys(self.sensors.poles):
            states = (s**k / np.polyval(np.asarray(poles)[::-1], s) for k in range(len(poles) - 1))
            known[poles] = np.stack([*states, np.ones(len(s)), s], axis=-1)
        return [known[poles] for poles in self.sensors.poles]

    def inner_transients(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, 0): y by initial states other than those of body and sensors, of which this model has none."""
        return np.zeros((len(omega), len(self.sensors.names), 0), complex)

    def driven(self, omega: np.ndarray, U: np.ndarray, derivative: bool = True) -> Driven:
        """y for spectra of the inputs, and its derivatives by the free parameters.

        U : (n, n_u + 3, m), or (n, n_u + 3 + 12, m) with impulse and step of the transient last.
        """
        omega = np.asarray(omega, float)
        s, mat, n_u = 1j * omega[:, None, None], self.matrices, len(self.actuators)
        a, alias, inverse, out = self._lines(omega)
        volts, floor = U[:, :n_u], U[:, n_u : n_u + 3]
        force = np.zeros((len(omega), N_Q, U.shape[2]), complex)
        driven, moving = np.any(volts), np.any(floor)
        if driven:
            force += mat.T @ (a * volts)
        if moving:
            force += (mat.K_floor[:, :3] / s + mat.C_floor[:, :3]) @ floor
        if U.shape[1] > len(self.inputs):
            force += U[:, n_u + 3 : n_u + 3 + N_Q] + s * U[:, n_u + 3 + N_Q :]
        q = inverse @ force
        seen = mat.R @ q
        if moving and np.any(self.sensors.relative):
            seen -= (mat.R[:, :3] * self.sensors.relative[:, None]) @ (floor / s)
        S = self.sensors.sensitivity[:, None]
        Y = S * out * seen
        if driven:
            # Aliases pass the chain far above its corners.
            Y += S * alias * (self.accelerance @ volts)
        if not derivative:
            return Driven(Y, np.empty(0))
        left, w = S * out * (mat.R @ inverse), floor / s
        operands = Operands(self.sensors, mat, s, left, left, S * out, S * alias, a, volts, q, w, w, Y)
        dY = operands.derivative(self.names, self.derivative_matrices)
        for name in OF_DRIVES:
            if name in self.names:
                slope, folded = self.drive_slopes(omega, name)
                moved = out * (mat.R @ inverse @ mat.T @ (slope * volts)) + folded * (self.accelerance @ volts)
                dY[self.names.index(name)] = S * moved
        return Driven(Y, dY)

    def drive_slopes(self, omega: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of `drive` by a parameter of `OF_DRIVES`: exact for the continuous term; a difference for the
        aliases, which are small and, as a function of the delay, have a kink at whole samples."""
        s, (a, _) = 1j * omega[:, None, None], self.drive(omega)
        if name == AMPLIFIERS:
            tau = self.amplifier_time_constant_s
            step = 1e-4 * tau
            ends = [replace(self, amplifier_corner_Hz=1 / (2 * np.pi * end)) for end in (tau - step, tau + step)]
            slope, width = -s / (1 + s * tau) * a, 2 * step
        else:
            step = 1e-4 * (self.period_s or 1e-3)
            earlier, later = max(self.delay_s - step, 0.0), self.delay_s + step
            ends = [replace(self, delay_s=end) for end in (earlier, later)]
            slope, width = -s * a, later - earlier
        low, high = (end.drive(omega)[1] for end in ends)
        return slope, (high - low) / width

    @kept_lines
    def _lines(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """`drive`, inv(D) (n, 6, 6), and the responses of the sensor chains (n, n_y, 1)."""
        s, mat = 1j * omega[:, None, None], self.matrices
        inverse = np.linalg.inv(mat.K + s * mat.C + s**2 * mat.M)
        return *self.drive(omega), inverse, self.sensors.sense(omega)[:, :, None]

    def drive(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Response from commanded voltage to force divided by T (n, 1, 1), and the aliases of each sensor (n,
        n_y, 1)."""
        a, folded = self.sensors.driven(omega, self.period_s, self.delay_s, self.amplifier_corner_Hz)
        return a[:, None, None], folded[:, :, None]


# Names of parameters: the moments of inertia of a payload; and all inertial parameters, including masses and load.
MOMENTS = (("J1", "J2", "J3"), ("Ixx", "Iyy", "Izz"))
INERTIAL = ("mass", "load.mass", *MOMENTS[0], *MOMENTS[1])


def moment_rows(names: Sequence[str]) -> np.ndarray:
    """(k, n_p) rows r: r @ theta > 0 for all rows if no moment of inertia exceeds the sum of the other two.

    No rows unless all three moments are free. The moments about the axes are taken as the principal moments: products
    of inertia are assumed to be small.
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
    """Whether physics requires a positive value: masses, stiffness, damping, force constants, sensitivities.

    For a rig's own parameters; those of effects ("effect@place.parameter") have their own bounds.
    """
    if "@" in name:
        return False
    last = name.rpartition(".")[2]
    if name.startswith(("sensor.", "actuator.")) or name in INERTIAL or name == AMPLIFIERS:
        return True
    return last.startswith(("k_", "c_")) or (len(last) == 2 and last[0] in "de" and last[1].isdigit())
