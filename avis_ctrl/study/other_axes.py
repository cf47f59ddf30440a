"""Skyhook loops on the axes that a design does not control, designed for the rig's own sensors.

The controller of a design drives the axes in `keep`. Every other axis that the drives can move and the sensors can
measure independently gets a skyhook loop, called a companion loop in the code:

    F = -g  s/(s + w_tilt)  1/(s/w_roll + 1)  v

Loops are closed one after the other around the sampled table with six degrees of freedom, including hold, delay,
amplifiers, sensor dynamics and the design's own controller. In a second pass each loop is designed again with all other
loops closed. A grid of gains and corners is searched for the smallest r.m.s. payload velocity in the site's band, under
floor motion and sensor noise. Candidates must have a sufficient modulus margin (distance of the Nyquist curve from the
critical point), and must be robust to the neglected dynamics of the drives, as far as these act on the voltages of this
loop. The effect of the neglected dynamics on all voltages together is checked with the simulated plants. The classical
rule, critical damping with the usual corners, meets neither condition with 1 Hz geophones: below its corner a geophone
turns the phase by 180 degrees.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.errors import InputError
from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.rigs.logical_axes import actuator_axes, sensor_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.robust.frequency_grid import resonances
from avis_ctrl.simulation.discrete import digital_controller, sampled, spectral_radius
from avis_ctrl.simulation.sampled_loop import SampledLoop, lever_arms
from avis_ctrl.simulation.sampled_response import OpenResponse, open_response
from avis_ctrl.uncertainty.weight_base import Weight


@dataclass(frozen=True)
class CompanionSettings:
    """Settings of the search for the companion loops.

    modulus_margin : minimum |1 + L|, dimensionless; 0.5 is a sensitivity peak of 6 dB, the usual limit in textbooks.
    gain_factors : gains tried, as multiples of critical damping of the decoupled axis; from almost no effect to twice
        the classical rule.
    tilt_corners_Hz, roll_offs_Hz : corners tried; the usual 0.1 and 100 Hz and values around them.
    passes : number of passes over the axes; in the second pass all other loops are closed.
    shrink : factor on all gains while a plant of the uncertainty set is unstable, 3 dB per step.
    shrinks : maximum number of such steps, 18 dB in total, before the loops are omitted.
    low_Hz, points : start and number of points of the frequency grid; it ends at 90 % of half the sample rate.
    """

    modulus_margin: float = 0.5
    gain_factors: tuple[float, ...] = tuple(np.geomspace(0.03, 2.0, 13))
    tilt_corners_Hz: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5)
    roll_offs_Hz: tuple[float, ...] = (20.0, 50.0, 100.0, 200.0)
    passes: int = 2
    shrink: float = 10 ** (-3 / 20)
    shrinks: int = 6
    low_Hz: float = 0.01
    points: int = 400


@dataclass(frozen=True)
class Companion:
    """The loop of one axis.

    gain : N s/m, edge force per edge velocity for rotations.
    modulus_margin : minimum |1 + L| with all other loops closed.
    """

    axis: str
    gain: float
    tilt_corner_Hz: float
    roll_off_Hz: float
    modulus_margin: float

    def loop(self) -> StateSpace:
        """Measured velocity [m/s] -> force [N]."""
        return Skyhook((self.axis,), (self.gain,), self.tilt_corner_Hz, self.roll_off_Hz).loop(self.axis)


@dataclass(frozen=True)
class Companions:
    """The loops of the axes that a design does not control.

    passive : (axis, reason) of the axes without a loop.
    notes : what had to be reduced or omitted, in words.
    settings : settings of the search for the loops.
    """

    loops: tuple[Companion, ...]
    passive: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    settings: CompanionSettings = CompanionSettings()

    def systems(self) -> dict[str, StateSpace]:
        """Loop of each axis: measured velocity [m/s] -> force [N]."""
        return {one.axis: one.loop() for one in self.loops}

    def scaled(self, factor: float) -> Companions:
        """All gains times a factor; the modulus margins are not updated."""
        return replace(self, loops=tuple(replace(one, gain=factor * one.gain) for one in self.loops))

    def below_margin(self) -> tuple[Companion, ...]:
        """The loops whose modulus margin, with all other loops closed, is below the required one."""
        return tuple(one for one in self.loops if not one.modulus_margin >= self.settings.modulus_margin)

    def remarks(self) -> tuple[str, ...]:
        """The notes, and the loops that miss the required modulus margin."""
        low = ", ".join(f"{one.axis} {one.modulus_margin:.2f}" for one in self.below_margin())
        missed = (
            f"Loops of the other axes with a modulus margin below the required {self.settings.modulus_margin:g}, "
            f"with all loops closed: {low}."
        )
        return (*self.notes, missed) if low else self.notes


def free_axes(rig: Rig, keep: Sequence[str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Axes outside `keep` that can have a loop, and the remaining axes with the reason."""
    chosen, passive = list(keep), []
    for axis in COORDINATES:
        if axis in keep:
            continue
        try:
            actuator_axes(rig, [*chosen, axis])
            sensor_axes(rig, [*chosen, axis])
        except InputError as error:
            passive.append((axis, error.expected))
        else:
            chosen.append(axis)
    return chosen[len(keep) :], passive


def design_companions(
    bare: SampledLoop,
    chain_error: Weight | None = None,
    band_Hz: Sequence[float] = (0.5, 60.0),
    settings: CompanionSettings = CompanionSettings(),
) -> Companions:
    """Loops for the axes that `bare` does not control.

    Parameters
    ----------
    bare : the design's controller around the nominal rig, with empty `loops`.
    chain_error : relative error of the drives due to neglected dynamics; None for no error.
    band_Hz : band of the r.m.s. velocity to be minimised. Slow floor motion below the band, which no geophone loop can
        reduce, would dominate otherwise; the modulus margin limits its amplification.
    """
    axes, passive = free_axes(bare.rig, bare.axes)
    search = _Search(bare, _grid(bare, settings), chain_error, band_Hz, settings)
    found: dict[str, Companion] = {}
    for _ in range(settings.passes):
        for axis in axes:
            others = {name: one for name, one in found.items() if name != axis}
            best = search.best(axis, others)
            found = others if best is None else {**others, axis: best}
    reason = "none of the gains and corners tried is stable with the required margins"
    missing = tuple((axis, reason) for axis in axes if axis not in found)
    loops = tuple(found[axis] for axis in axes if axis in found)
    return _with_margins(Companions(loops, (*passive, *missing), settings=settings), bare)


def _with_margins(companions: Companions, bare: SampledLoop) -> Companions:
    """The same loops, each with its modulus margin for all other loops closed."""
    omega, loops = _grid(bare, companions.settings), companions.systems()
    G = open_response(bare, omega).sensed_volts

    def characteristic(loops: dict[str, StateSpace]) -> np.ndarray:
        """(n,) det(I - G C); closing one more loop multiplies it by the 1 + L of that loop."""
        C = digital_controller(replace(bare, loops=loops)).frequency_response(omega)
        return np.asarray(np.linalg.det(np.eye(G.shape[1]) - G @ C))

    closed = characteristic(loops)
    margins = [float(np.min(np.abs(closed / characteristic(loops | {axis: gain(0.0)})))) for axis in loops]
    return replace(
        companions,
        loops=tuple(replace(one, modulus_margin=margin) for one, margin in zip(companions.loops, margins, strict=True)),
    )


def _grid(bare: SampledLoop, settings: CompanionSettings) -> np.ndarray:
    """(n,) frequencies [rad/s], including the table's resonances."""
    even = np.geomspace(2 * np.pi * settings.low_Hz, 0.9 * np.pi / bare.period_s, settings.points)
    return np.unique(np.concatenate([even, resonances(bare.rig.equations_of_motion().state_space().poles())]))


def until_stable(companions: Companions, plants: Sequence[SampledLoop]) -> Companions:
    """Lower all gains until the linear sampled loop of every plant is stable; drop the loops if that fails.

    The modulus margins of the result are for the nominal plant.

    plants : the loop of each plant, the nominal plant first; its companion loops are replaced.
    """
    if not companions.loops:
        return companions
    settings, bare = companions.settings, replace(plants[0], loops={})
    for step in range(settings.shrinks + 1):
        factor = settings.shrink**step
        tried = companions.scaled(factor)
        if all(spectral_radius(replace(plant, loops=tried.systems())) < 1 for plant in plants):
            lowered = (
                f"The gains of the other axes' loops were lowered by {-20 * np.log10(factor):.0f} dB: with "
                "higher gains a plant of the uncertainty set was unstable."
            )
            return _with_margins(replace(tried, notes=(*tried.notes, lowered)) if step else tried, bare)
    # If the plants are unstable even without the loops, the loops are not the cause and remain as designed.
    without = [spectral_radius(replace(plant, loops={})) for plant in plants]
    if max(without) < 1:
        lowest = -20 * settings.shrinks * np.log10(settings.shrink)
        reason = (
            f"even with the gains of the other axes' loops lowered by {lowest:.0f} dB, a plant of the "
            "uncertainty set is unstable"
        )
        return replace(
            companions, loops=(), passive=(*companions.passive, *((one.axis, reason) for one in companions.loops))
        )
    return _with_margins(companions, bare)


class _Search:
    """Search for the loop of one axis at a time; a candidate is a rank-one change of a closed sampled loop."""

    def __init__(
        self,
        bare: SampledLoop,
        omega: np.ndarray,
        chain_error: Weight | None,
        band_Hz: Sequence[float],
        settings: CompanionSettings,
    ):
        self.bare, self.omega, self.settings = bare, omega, settings
        self.open: OpenResponse = open_response(bare, omega)
        self.judged = (omega >= 2 * np.pi * band_Hz[0]) & (omega <= 2 * np.pi * band_Hz[1])
        self.K = digital_controller(replace(bare, loops={})).frequency_response(omega)
        self.error = chain_error.magnitude(omega) if chain_error is not None else np.zeros(omega.size)
        self.arms = lever_arms(bare.rig)
        floor = np.zeros((omega.size, len(COORDINATES)))
        for name, spectrum in bare.floor.items():
            inside = omega >= 2 * np.pi * spectrum.low_Hz
            floor[inside, COORDINATES.index(name)] = spectrum.asd(omega[inside] / (2 * np.pi), "velocity")
        self.sources = np.hstack([floor, np.sqrt(bare.sensors.noise_psd(omega / (2 * np.pi), bare.period_s))])
        self._units: dict[str, np.ndarray] = {}
        self._filters: dict[tuple[float, float], np.ndarray] = {}
        equations = bare.rig.equations_of_motion()
        M, C, stiffness = (np.diag(X) / self.arms**2 for X in (equations.M, equations.C, equations.K))
        self.critical = dict(zip(COORDINATES, np.maximum(2 * np.sqrt(M * stiffness) - C, 0.0), strict=True))

    def best(self, axis: str, others: dict[str, Companion]) -> Companion | None:
        """The stable candidate with the required margins and the smallest r.m.s. payload velocity; None without one."""
        g, motion, through, seen, reach = self._around(axis, others)
        # |motion + through k seen|^2, summed over axes and sources, is a quadratic form in the number k.
        weight = self.sources[:, None, :] ** 2
        constant = np.sum(np.abs(motion) ** 2 * weight, axis=(1, 2))
        square = np.sum(np.abs(through) ** 2, axis=(1, 2)) * np.sum(np.abs(seen) ** 2 * weight, axis=(1, 2))
        mixed = np.sum(np.conj(motion) * (through * seen) * weight, axis=(1, 2))
        rows = []
        for candidate in self._candidates(axis):
            c = candidate.gain * self._filter(candidate)
            returned = 1 - c * g
            margin = float(np.min(np.abs(returned)))
            if margin < self.settings.modulus_margin or np.max(np.abs(self.error * c * reach / returned)) >= 1:
                continue
            k = c / returned
            density = constant + 2 * np.real(k * mixed) + np.abs(k) ** 2 * square
            rows.append((float(np.trapezoid(density[self.judged], self.omega[self.judged])), candidate, margin))
        for _, candidate, margin in sorted(rows, key=lambda row: row[0]):
            loops = {**{name: one.loop() for name, one in others.items()}, axis: candidate.loop()}
            if spectral_radius(replace(self.bare, loops=loops)) < 1:
                return replace(candidate, modulus_margin=margin)
        return None

    def _candidates(self, axis: str) -> Iterator[Companion]:
        s = self.settings
        for factor in s.gain_factors:
            for tilt in s.tilt_corners_Hz:
                for roll in s.roll_offs_Hz:
                    yield Companion(axis, factor * self.critical[axis], tilt, roll, np.nan)

    def _filter(self, one: Companion) -> np.ndarray:
        """(n,) the sampled loop with unit gain: force per measured velocity."""
        key = one.tilt_corner_Hz, one.roll_off_Hz
        if key not in self._filters:
            unit = sampled(replace(one, gain=1.0).loop(), self.bare.period_s)
            self._filters[key] = unit.frequency_response(self.omega)[:, 0, 0]
        return self._filters[key]

    def _unit(self, axis: str) -> np.ndarray:
        """(n, n_u, n_s) sensor volts to drive volts with a loop of gain 1 on this axis only: rank one."""
        if axis not in self._units:
            none = gain(np.zeros((len(self.bare.axes),) * 2))
            alone = replace(self.bare, K=none, loops={axis: gain(1.0)})
            self._units[axis] = digital_controller(alone).frequency_response(self.omega)
        return self._units[axis]

    def _around(self, axis: str, others: dict[str, Companion]) -> tuple[np.ndarray, ...]:
        """Responses at one loop with all others closed.

        Returns g (n,), motion (n, 6, sources), the two factors of the change of motion, and the sum of the magnitudes
        of the drives' contributions to g (n,).
        """
        C = self.K + sum(
            (one.gain * self._filter(one)[:, None, None] * self._unit(name) for name, one in others.items()),
            np.zeros(1),
        )
        G, n_s = self.open, self.K.shape[2]
        closed = np.linalg.inv(np.eye(n_s) - G.sensed_volts @ C)  # from volts added at the sensors to sensor volts
        added = np.concatenate([G.sensed_floor, np.broadcast_to(np.eye(n_s), (self.omega.size, n_s, n_s))], axis=2)
        sensed = closed @ added
        motion = np.concatenate([G.velocity_floor, np.zeros((*G.velocity_floor.shape[:2], n_s))], axis=2)
        motion = self.arms[:, None] * (motion + G.velocity_volts @ C @ sensed)
        unit = self._unit(axis)
        # unit = a s' with a the allocation of the axis; it is constant over frequency up to a phase, which goes into s
        a = unit[np.arange(unit.shape[0]), :, np.argmax(np.abs(unit).max(axis=1), axis=1)]
        a = a / np.where(np.abs(a).max(axis=1) > 0, np.linalg.norm(a, axis=1), 1.0)[:, None]
        s = np.einsum("fu,fus->fs", a.conj(), unit)
        pushed = closed @ (G.sensed_volts @ a[:, :, None])
        g = np.einsum("fs,fs->f", s, pushed[..., 0])
        # The errors of the drives are independent: mu of a rank-one matrix is the sum of its diagonal's magnitudes.
        reach = np.sum(np.abs(a * (s[:, None, :] @ closed @ G.sensed_volts)[:, 0]), axis=1)
        through = self.arms[:, None] * (G.velocity_volts @ (a[:, :, None] + C @ pushed))
        return g, motion, through, s[:, None, :] @ sensed, reach
