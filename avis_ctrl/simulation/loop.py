"""Closed-loop simulation of the nonlinear table under digital control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.rigs.floor_spectrum import realise
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation import kernel
from avis_ctrl.simulation.discrete import linear_part, rest_state, step_arrays
from avis_ctrl.simulation.sampled_loop import NO_ANTI_WINDUP, SampledLoop, lever_arms

Code = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class DivergenceSettings:
    """stop_m, stop_rad : motion relative to the floor beyond which the loop has diverged; the stops of an isolated
    table are closer."""

    stop_m: float = 0.02
    stop_rad: float = 0.2


SETTINGS = DivergenceSettings()


@dataclass(frozen=True, eq=False)
class SimulationRecord:
    """Simulated signals at the controller's sampling instants.

    Attributes
    ----------
    time : (n,) s. The record of a diverged loop ends early.
    q, q_dot : (n, 6) payload, m and rad, m/s and rad/s.
    floor_dot : (n, 6) floor, m/s and rad/s.
    volts, demanded : (n, n_u) held voltages, and as computed before the limit [V].
    sensed : (n, n_s) volts at the converter, noise included, before rounding and clipping.
    diverged : the payload went beyond its stops.
    clipped_dac, clipped_adc : number of samples beyond the limits, summed over the channels.
    """

    loop: SampledLoop
    time: np.ndarray
    q: np.ndarray
    q_dot: np.ndarray
    floor_dot: np.ndarray
    volts: np.ndarray
    demanded: np.ndarray
    sensed: np.ndarray
    diverged: bool

    @cached_property
    def clipped_dac(self) -> int:
        """Number of demanded voltages beyond the drives' limits."""
        return int(np.count_nonzero(np.abs(self.demanded) > self.loop.limits_V))

    @cached_property
    def clipped_adc(self) -> int:
        """Number of sensor voltages beyond the converter's range."""
        converter = self.loop.sensors.converter
        return int(np.count_nonzero(converter.clipped(self.sensed))) if converter else 0

    def velocity(self, axis: str) -> np.ndarray:
        """(n,) payload velocity along a coordinate [m/s]; a rotation as velocity of the edge."""
        k = COORDINATES.index(axis)
        return self.q_dot[:, k] * lever_arms(self.loop.rig)[k]


def floor_velocity(loop: SampledLoop, samples: int, rng: np.random.Generator) -> np.ndarray:
    """(samples + 1, 6) floor velocity [m/s, rad/s], one period of a realisation; zero in coordinates without
    spectrum."""
    velocity = np.zeros((samples + 1, 6))
    for name, spectrum in loop.floor.items():
        if name not in COORDINATES:
            raise InputError(f"a coordinate out of {COORDINATES}", field="floor", value=name)
        velocity[:-1, COORDINATES.index(name)] = realise(spectrum, samples * loop.period_s, loop.period_s, rng)
    velocity[-1] = velocity[0]
    return velocity


def flicker(samples: int, period_s: float, rng: np.random.Generator, channels: int) -> np.ndarray:
    """(samples, channels) Gaussian noise of one-sided density 2 period_s / f, from the record's lowest line upwards.

    At 1 Hz the density equals that of white noise with variance one. The mean is zero, and the record is periodic.
    """
    frequency = np.fft.rfftfreq(samples, period_s)
    rms = np.zeros(frequency.size)
    rms[1:] = np.sqrt(2 * period_s / frequency[1:] / (samples * period_s))
    if samples % 2 == 0:
        rms[-1] = 0.0
    draw = rng.standard_normal((2, frequency.size, channels))
    # Each line has variance rms^2: half in the real part and half in the imaginary part.
    return np.fft.irfft(0.5 * samples * rms[:, None] * (draw[0] + 1j * draw[1]), samples, axis=0)


def simulate(
    loop: SampledLoop,
    duration_s: float = 60.0,
    seed: int | tuple[int, ...] = 1,
    *,
    settle_s: float = 10.0,
    nonlinear: bool = True,
    extra_substeps: int = 1,
    floor: np.ndarray | None = None,
    initial: np.ndarray | None = None,
    drive: np.ndarray | None = None,
    code: Code | None = None,
) -> SimulationRecord:
    """Simulate the loop and keep the last `duration_s`.

    Parameters
    ----------
    duration_s, settle_s : time that is kept, and time simulated before it, from rest.
    seed : of floor and sensor noise; the same seed gives the same record.
    nonlinear : False for the table linearised about rest; the step is then exact.
    extra_substeps : divides each step further, to assess the discretisation error.
    floor : (n + 1, 6) floor velocities in place of a realisation, n samples in all.
    initial : (12,) q and q' at the start.
    drive : (n, n_u) volts added to what the controller demands, before the limit; n samples in all, including those of
        `settle_s`. Zero by default.
    code : function called at every sample in place of the loop's controller, from the converter's volts (n_s,) to volts
        (n_u,).

    Raises
    ------
    InputError : durations or arrays that do not fit.
    """
    require_positive(duration_s, "duration_s")
    require_positive(settle_s, "settle_s", zero_allowed=True)
    rng = np.random.default_rng(seed)
    settle = round(settle_s * loop.sample_rate_Hz)
    samples = settle + round(duration_s * loop.sample_rate_Hz)
    floor = floor_velocity(loop, samples, rng) if floor is None else np.ascontiguousarray(floor, float)
    if floor.shape != (samples + 1, 6):
        raise InputError(f"expected floor velocities of shape {(samples + 1, 6)}", field="floor", value=floor.shape)
    n_s, n_u = len(loop.sensors.chains), loop.n_drives
    drive = np.zeros((samples, n_u)) if drive is None else np.ascontiguousarray(drive, float)
    if drive.shape != (samples, n_u) or not np.all(np.isfinite(drive)):
        raise InputError(f"expected finite voltages of shape {(samples, n_u)}", field="drive", value=drive.shape)
    noise = rng.standard_normal((samples, n_s)) * loop.sensors.noise_rms_V + loop.sensors.offset_V
    if np.any(loop.sensors.flicker_rms_V):
        noise += flicker(samples, loop.period_s, rng, n_s) * loop.sensors.flicker_rms_V
    # Offsets are assumed constant since long before the start: the loop starts at its equilibrium with them.
    rest = rest_state(loop) if np.any(loop.sensors.offset_V) and code is None else None
    state = np.zeros(linear_part(loop).nstates) if rest is None else rest.state
    if initial is not None:
        state[:12] = initial
    converter = loop.sensors.converter
    adc = np.array((converter.lsb_V, *converter.limits_V) if converter else (0.0, 0.0, 0.0))
    records = kernel.Records(*(np.empty((samples, width)) for width in (6, 6, n_u, n_u, n_s)))
    arrays = step_arrays(loop, extra_substeps)
    work = kernel.workspace(arrays, state, loop.delay_substeps * extra_substeps)
    if rest is not None:
        work.u[:] = np.clip(rest.volts, -loop.limits_V, loop.limits_V)
        work.control_in[: rest.controller.size] = rest.controller
    run = kernel.Run(
        arrays,
        work,
        records,
        floor,
        noise,
        drive,
        loop.substeps * extra_substeps,
        nonlinear,
        "acceleration" in loop.sensors.quantities,
        adc,
        loop.limits_V,
        loop.anti_windup if code is None else NO_ANTI_WINDUP,  # `code` does its own
        np.array([SETTINGS.stop_m, SETTINGS.stop_rad]),
    )
    done = kernel.simulated(run) if code is None else kernel.simulated_stepwise(run, code)
    kept = slice(min(settle, done - 1), done)
    q, q_dot, volts, demanded, sensed = (record[kept].copy() for record in records)
    time = (np.arange(samples)[kept] - settle) * loop.period_s
    return SimulationRecord(loop, time, q, q_dot, floor[:-1][kept].copy(), volts, demanded, sensed, done < samples)
