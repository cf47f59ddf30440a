"""A digital controller around a table: everything that a closed-loop simulation or its prediction needs.

    floor --> table --> sensors --> noise, converter --> controller --> limit --> delay, hold --> drives --> table

The controller is based on `rig`; the simulated table is `plant`, which may differ from it. Sensors measure the
payload's motion along axes fixed in space: their rotation with the payload is neglected, parts per million at
micrometre amplitudes. If `gravity` is set, the gravity that acts on their proof masses when the payload tilts is
included: neither source models it, but at low frequency it dominates the signal of a horizontal sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.floor_spectrum import SpectrumModel
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.rigs.sensing import conditioning


@dataclass(frozen=True)
class StepSettings:
    """most_substeps : largest number of steps per control period to represent the delay; a delay that needs more is
    probably mistyped."""

    most_substeps: int = 20


SETTINGS = StepSettings()
# Default meaning the rig's own value.
_AS_RIG: Any = None


@dataclass(frozen=True, eq=False)
class SensorBank:
    """The sensors of a rig, from motion along each sensor's axis to volts at the converter.

    Attributes
    ----------
    quantities : what each sensor measures, "velocity" [m/s] or "acceleration" [m/s^2] of the payload in space, or
        "displacement" [m] of the payload relative to the chassis.
    chains : one system per sensor, from motion to volts.
    gain_V : (n_s,) volts per unit of motion in the passband; the controller divides by it.
    noise_rms_V : (n_s,) white noise of one sample, before the converter.
    conditioning : filter that the controller applies to each channel after division by the gain (an accelerometer's
        integrator); None for none.
    converter : None for unlimited resolution.
    flicker_rms_V : (n_s,) r.m.s. of the white noise whose density equals that of the 1/f noise at 1 Hz.
    offset_V : (n_s,) constant offset of each channel's reading; zero by default.
    """

    quantities: tuple[str, ...]
    chains: tuple[StateSpace, ...]
    gain_V: np.ndarray
    noise_rms_V: np.ndarray
    conditioning: tuple[StateSpace | None, ...]
    converter: Converter | None = None
    flicker_rms_V: np.ndarray = field(default_factory=lambda: np.zeros(1))
    offset_V: np.ndarray = field(default_factory=lambda: np.zeros(1))

    def __post_init__(self) -> None:
        for name in ("gain_V", "noise_rms_V", "flicker_rms_V", "offset_V"):
            object.__setattr__(self, name, np.array(np.broadcast_to(getattr(self, name), len(self.chains)), float))

    @property
    def white_variance_V2(self) -> np.ndarray:
        """(n_s,) variance of one sample: noise, and rounding as white noise, valid if signal or noise moves by whole
        codes."""
        return self.noise_rms_V**2 + (self.converter.noise_rms_V**2 if self.converter else 0.0)

    def noise_psd(self, frequency_Hz: np.ndarray, period_s: float) -> np.ndarray:
        """(n, n_s) one-sided density of all noise at the converters [V^2/Hz]; frequency_Hz (n,) positive."""
        return 2 * period_s * (self.white_variance_V2 + self.flicker_rms_V**2 / np.asarray(frequency_Hz)[:, None])

    def white(self) -> SensorBank:
        """Without 1/f noise."""
        return replace(self, flicker_rms_V=np.zeros(1))


def rig_bank(rig: Rig, integrator_corner_Hz: float) -> SensorBank:
    """Sensors of a rig as specified in its file, and the controller's conditioning of each channel (`rigs.sensing`).

    integrator_corner_Hz : corner frequency of the accelerometers' leaky integrators.
    """
    sensors, filters = rig.sensors(), conditioning(rig, integrator_corner_Hz)
    systems = {one: None if one.is_one else one.system() for one in filters}
    # Identical sensors share one chain object.
    kinds = [replace(one, name="", position=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0)) for one in sensors]
    chains = {one: one.chain() for one in dict.fromkeys(kinds)}
    return SensorBank(
        tuple(one.quantity for one in sensors),
        tuple(chains[one] for one in kinds),
        np.array([one.gain for one in sensors]),
        np.array([one.noise_rms_V for one in sensors]),
        tuple(systems[one] for one in filters),
        rig.converter,
        np.array([one.flicker_rms_V for one in sensors]),
    )


class AntiWindup(NamedTuple):
    """The part cut off by the limits passes through a first-order lag and is subtracted from the same drive's next
    demands:

        u = limit(v),  v = demand - b,  b+ = keep b + feed (v - u)

    Low-order anti-windup acting on the controller's output (Turner and Postlethwaite, Int. J. Control 77, 2004): the
    states remain those of the linear controller. feed = 0 disables it.
    """

    keep: float = 0.0
    feed: float = 0.0

    @staticmethod
    def of(corner_Hz: float, gain: float, period_s: float) -> AntiWindup:
        """gain : DC gain of the lag."""
        keep = float(np.exp(-2 * np.pi * corner_Hz * period_s))
        return AntiWindup(keep, gain * (1 - keep))


NO_ANTI_WINDUP = AntiWindup()


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """A table under digital control on a moving floor.

    Attributes
    ----------
    rig : the controller's model of the table; its geometry defines the logical axes.
    K : u = K y; from measured velocities of `axes` to forces on them. Rotations count as velocity [m/s] and force [N]
        at the edge. Continuous, or sampled at the loop's rate.
    axes : coordinates that K controls, in its order.
    loops : separate controllers of other coordinates, each a system from velocity to force with K's signs and units;
        coordinates in neither are not controlled.
    sensors : the chains, in the order of the rig's sensors.
    floor : spectrum of the floor's motion by coordinate [m or rad]; coordinates without one are at rest.
    plant : the simulated table; `rig` by default.
    drive_errors : one system per drive, volts to volts (1 + W Delta of neglected dynamics), None where nominal; empty
        if all are nominal.
    drive_coupling : from the volts of all drives to the volts that act (I + coupling), after amplifiers and errors;
        None for uncoupled drives.
    amplifier_corner_Hz : first-order lag of the amplifiers, None for none.
    sample_rate_Hz, loop_delay_s, limit_V : the rig's by default; the delay is from sample to voltage. By default each
        drive has its own limit; a given limit_V, other than the rig's largest, is for all drives.
    gravity : whether gravity acts on the proof masses of tilted sensors (`Rig.tilt_rows`).
    digital : sampled controller from sensor volts to drive volts, used instead of K and loops if given.
    anti_windup : of the controller; none by default.

    Raises
    ------
    InputError : coordinates controlled twice, accelerometers with drives that act without lag, a delay that needs more
        than `SETTINGS.most_substeps` steps per sample period.
    """

    rig: Rig
    K: StateSpace
    axes: tuple[str, ...]
    loops: Mapping[str, StateSpace]
    sensors: SensorBank
    floor: Mapping[str, SpectrumModel]
    plant: Rig = _AS_RIG
    drive_errors: tuple[StateSpace | None, ...] = ()
    drive_coupling: StateSpace | None = None
    amplifier_corner_Hz: float | None = None
    sample_rate_Hz: float = _AS_RIG
    loop_delay_s: float = _AS_RIG
    limit_V: float = _AS_RIG
    gravity: bool = False
    name: str = "nominal"
    digital: StateSpace | None = None
    anti_windup: AntiWindup = NO_ANTI_WINDUP
    substeps: int = field(init=False, default=1)

    def __post_init__(self) -> None:
        rig = self.rig
        of_rig = {
            "plant": rig,
            "sample_rate_Hz": rig.sample_rate_Hz,
            "loop_delay_s": rig.loop_delay_s,
            "limit_V": rig.drive_limit_V,
        }
        for name, value in of_rig.items():
            if getattr(self, name) is _AS_RIG:
                object.__setattr__(self, name, value)
        object.__setattr__(self, "drive_errors", tuple(self.drive_errors) or (None,) * self.n_drives)
        self._check()
        periods = Fraction(self.loop_delay_s * self.sample_rate_Hz).limit_denominator(SETTINGS.most_substeps)
        if abs(float(periods) - self.loop_delay_s * self.sample_rate_Hz) > 1e-6:
            raise InputError(
                f"expected n/m sample periods with whole n and m, m up to {SETTINGS.most_substeps}; the nearest is "
                f"{float(periods) / self.sample_rate_Hz:.6g} s",
                field="loop_delay_s of the rig",
                value=self.loop_delay_s,
            )
        object.__setattr__(self, "substeps", periods.denominator)

    def _check(self) -> None:
        for name in ("sample_rate_Hz", "limit_V"):
            require_positive(getattr(self, name), name)
        require_positive(self.loop_delay_s, "loop_delay_s", zero_allowed=True)
        controlled = (*self.axes, *self.loops)
        if len(set(controlled)) != len(controlled) or not set(controlled) <= set(COORDINATES):
            raise InputError(f"different coordinates out of {COORDINATES}", field="axes, loops", value=controlled)
        if "acceleration" in self.sensors.quantities and any(drive.D[0, 0] for drive in self.drives()):
            # Otherwise the acceleration would jump with the voltage, exactly at a sampling instant.
            raise InputError(
                "a corner for the amplifiers: accelerometers need drives without direct feedthrough",
                field="amplifier_corner_Hz",
                value=self.amplifier_corner_Hz,
            )

    @property
    def n_drives(self) -> int:
        """Number of drives."""
        return len(self.rig.equations_of_motion().actuators)

    @property
    def period_s(self) -> float:
        """Sample period."""
        return 1.0 / self.sample_rate_Hz

    @property
    def limits_V(self) -> np.ndarray:
        """(n_u,) voltage limit of each drive."""
        if self.limit_V == self.rig.drive_limit_V:
            return self.rig.drive_limits_V()
        return np.full(self.n_drives, self.limit_V)

    @property
    def delay_substeps(self) -> int:
        """Loop delay in steps of the simulation."""
        return round(self.loop_delay_s * self.sample_rate_Hz * self.substeps)

    def drives(self) -> list[StateSpace]:
        """One system per drive from converter volts to actuator volts: amplifier, then its neglected dynamics."""
        corner = self.amplifier_corner_Hz and 2 * np.pi * self.amplifier_corner_Hz
        amplifier = cascade([], [-corner], corner) if corner else gain(1.0)
        return [amplifier if error is None else error @ amplifier for error in self.drive_errors]

    def with_plant(
        self,
        name: str,
        plant: Rig | None = None,
        drive_errors: Sequence[StateSpace | None] | None = None,
        sensor_errors: Sequence[StateSpace | None] | None = None,
        drive_coupling: StateSpace | None = None,
    ) -> SampledLoop:
        """The same controller with another table; errors are systems from volts to volts, None where nominal."""
        sensors = self.sensors
        if sensor_errors is not None:
            chains = tuple(
                chain if error is None else error @ chain
                for chain, error in zip(sensors.chains, sensor_errors, strict=True)
            )
            sensors = replace(sensors, chains=chains)
        return replace(
            self,
            name=name,
            plant=plant or self.rig,
            sensors=sensors,
            drive_errors=self.drive_errors if drive_errors is None else tuple(drive_errors),
            drive_coupling=self.drive_coupling if drive_coupling is None else drive_coupling,
        )


def lever_arms(rig: Rig, names: Sequence[str] = COORDINATES) -> np.ndarray:
    """(n,) factors from coordinates to displacements: 1 for translations, the edge [m] for rotations."""
    return np.array([rig.edge_m if name.startswith("phi") else 1.0 for name in names])
