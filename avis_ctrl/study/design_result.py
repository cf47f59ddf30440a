"""Result of a design study: one frozen object from which the JSON files and the report are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.reduction_error import ReductionError
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.mu_peak import MuPeak
from avis_ctrl.simulation.design_check import SimulationCheck
from avis_ctrl.simulation.instability_cause import InstabilityCause
from avis_ctrl.study.dc_gain import AtRest
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.other_axes import Companions
from avis_ctrl.study.plant import DesignPlant

ControllerKind = Literal["mu", "hinf", "skyhook", "passive"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A controller to be analysed; K None: no control."""

    name: str
    title: str
    kind: ControllerKind
    K: StateSpace | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Bound(MuPeak):
    """Bounds of mu or of a worst-case gain of a design; upper is inf if the set contains an unstable plant.

    words : the perturbation that attains the lower bound, in physical units.
    """

    words: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Transmissibility:
    """Floor to payload, rotations as edge displacement, over omega (n,) [rad/s].

    nominal : (n, n_axes, n_axes) complex; sigma : (n,) its largest singular value.
    low, high : (n,) smallest and largest sigma over the sampled plants.
    """

    omega: np.ndarray
    nominal: np.ndarray
    sigma: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, eq=False)
class SiteResponse:
    """Response of the nominal loop to the site's floor motion and to the sensor noise.

    velocity_rms, noise_rms : payload velocity by axis [m/s] in the design's floor band, from floor and noise, and from
        noise alone.
    third_octave_Hz, floor_third_octaves, payload_third_octaves : bands [Hz] and r.m.s. velocities [m/s]; payload
        (n_bands, n_axes).
    rating, floor_rating : generic vibration criterion met by the worst axis and by the floor (None: not even VC-A).
    volts_rms, volts_peak : by channel [V]; the peak is the level that a Gaussian signal exceeds once in ten minutes.
    """

    velocity_rms: dict[str, float]
    noise_rms: dict[str, float]
    third_octave_Hz: np.ndarray
    floor_third_octaves: np.ndarray
    payload_third_octaves: np.ndarray
    rating: str | None
    floor_rating: str | None
    volts_rms: dict[str, float]
    volts_peak: dict[str, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class ControllerResult(Candidate):
    """A controller and its analysis.

    gamma : H-infinity norm of the weighted performance channels of the nominal plant. gamma_slicot : the same by
        SLICOT's AB13DD; None if that routine fails.
    mu : robust performance of the weighted channels; stability : robust stability (mu of the uncertainty alone).
    worst_peak, worst_band : worst-case transmissibility over all frequencies, and over the design's band.
    compliance : (n,) largest singular value of force -> displacement [m/N] at `transmissibility.omega`, floor at rest.
    peak_transmissibility : nominal, largest singular value over all frequencies.
    fastest_pole_Hz : of the continuous-time controller.
    rest : DC gain of the controller alone; None without a controller.
    """

    stable: bool
    gamma: float
    mu: Bound
    stability: Bound
    worst_peak: Bound
    worst_band: Bound
    transmissibility: Transmissibility
    compliance: np.ndarray
    site: SiteResponse
    peak_transmissibility: float
    fastest_pole_Hz: float
    gamma_slicot: float | None = None
    rest: AtRest | None = None

    @property
    def guaranteed(self) -> bool:
        """Whether the upper bounds are proved between the computed frequencies, too."""
        return all(bound.guaranteed for bound in (self.mu, self.worst_peak, self.worst_band))

    @property
    def order(self) -> int:
        """Number of states of the controller."""
        return self.K.nstates if self.K is not None else 0


@dataclass(frozen=True, eq=False)
class SixDofCheck:
    """The sampled mu controller on all six degrees of freedom, with companion loops on the other axes.

    omega : (n,) rad/s; kept : (n,) largest singular value from floor to payload on the kept axes, rotations at the
        edge;
    others : (n,) the same from the other coordinates of the floor, which the design model does not contain.
    alone : (n, 6) gain from each coordinate of the floor to the same coordinate of the payload, in the order of
        `COORDINATES`.
    deviation_dB : largest difference between `kept` and the design model inside the design's band.
    """

    omega: np.ndarray
    kept: np.ndarray
    others: np.ndarray
    alone: np.ndarray
    deviation_dB: float


@dataclass(frozen=True, eq=False)
class Simulated:
    """The sampled loop of all axes: companion loops, simulated plants, and the controller as a processor runs it.

    digital : sensor volts to demanded drive volts at the rig's sample rate, including decoding, companion loops and
        allocation; delay_samples : from a sample to the voltage it causes.
    culprit : why the first unstable plant is unstable; None if every plant is stable.
    rest : DC gain of `digital`.
    """

    companions: Companions
    check: SimulationCheck
    digital: StateSpace
    delay_samples: float
    culprit: InstabilityCause | None
    rest: AtRest | None = None


@dataclass(frozen=True)
class AxisGain:
    """Worst-case velocity of one axis in the design's band, per unit floor velocity in any direction.

    mu : upper bound for the mu controller, proved over the whole set. skyhook : lower bound for the tuned skyhook,
        attained by a plant of the set; nan if the design has no skyhook, inf if a plant makes it unstable.
    """

    axis: str
    mu: float
    skyhook: float

    @property
    def advantage(self) -> float:
        """Skyhook over mu; nan (never met) without a skyhook that is stable for all plants."""
        return self.skyhook / self.mu if np.isfinite(self.skyhook) else np.nan


@dataclass(frozen=True)
class Requirement:
    """A row of the verdict table."""

    name: str
    limit: float
    value: float
    unit: str
    met: bool
    comparison: Literal["at most", "at least", "is"]
    note: str = ""


@dataclass(frozen=True)
class FailedController:
    """A controller that could not be designed or analysed, and why."""

    name: str
    title: str
    kind: ControllerKind
    reason: str


@dataclass(frozen=True, eq=False)
class DesignResult:
    """Complete result of `avis design`.

    loop : the sampled loop of all axes: companion loops, simulation, and the cause if it is unstable.
    failed : controllers for comparison that could not be designed or analysed. by_axis : mu against skyhook.
    limits : sentences on the limiting bounds and uncertainties, and with mu above 1 on what would help.
    """

    design: Design
    rig: Rig
    plant: DesignPlant
    controllers: tuple[ControllerResult, ...]
    dk_history: tuple[Any, ...]
    requirements: tuple[Requirement, ...]
    reduction: ReductionError
    six_dof: SixDofCheck
    loop: Simulated | None
    provenance: dict[str, Any]
    seconds: float
    notes: tuple[str, ...] = ()
    failed: tuple[FailedController, ...] = ()
    by_axis: tuple[AxisGain, ...] = ()
    limits: str = ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """The sentences of `limits`, and the notes."""
        return tuple(filter(None, (self.limits, *self.notes)))

    @property
    def simulation(self) -> SimulationCheck | None:
        """Simulations of the closed loop with the nonlinear rig, plant by plant; None if nothing was simulated."""
        return self.loop.check if self.loop is not None else None

    @property
    def stable(self) -> bool:
        """Whether the sampled loop of all axes is stable for every simulated plant."""
        return self.simulation is None or all(plant.stable for plant in self.simulation.plants)

    def controller(self, name: str) -> ControllerResult:
        """The controller of a given name."""
        return next(c for c in self.controllers if c.name == name)
