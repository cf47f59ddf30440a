"""Response of the emitted controller as the continuous table receives it, and its distance from rational functions.

From the seen velocities of the kept axes (those that the controller computes) to the forces on these axes, at a
frequency omega below half the sample rate,

    R(omega) = hold(omega) exp(-j omega tau) T K(exp(j omega T_s)) diag(gain / F(j omega)) rows

K has the numbers of controller.json, hold(omega) = (1 - exp(-j omega T_s)) / (j omega T_s), T maps drive volts to the
forces on the axes, rows maps axes to sensors, and F is the filter that the design's sensor model contains and that the
code implements itself. R is exact for the part of the response to the frequency omega that is at omega itself. A
sampled loop also has aliasing: the held force at omega + 2 pi k / T_s moves the table a little, and its sensors show
that motion at omega. With G the table from forces to seen velocities, the controller sees (G + E) times its forces
instead of G times,

    |E| <= sum over k != 0 of |F(omega) / F(omega_k)| |G(omega_k)| |omega / omega_k|,

where |G| is the maximum over the whole uncertainty set, with a separate perturbation for each image; the true images
cannot exceed it. An anti-alias filter is known and equal in all channels: |G| is bounded without it and then multiplied
by its magnitude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.export.design_folder import DesignFolder
from avis_ctrl.export.intervals import delay_jet, roots_jet, sinc_jet, system_jet
from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.lti.magnitude_fit import covering_fit
from avis_ctrl.lti.rational import Rational
from avis_ctrl.lti.statespace import StateSpace, append, gain
from avis_ctrl.rigs.delay_models import pade_delay
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.rigs.sensing import Filter, conditioning
from avis_ctrl.robust.mu_peak import MuPeak, stability_bound, worst_case_gain
from avis_ctrl.robust.mu_upper import skewed_upper_bound
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.workers import each
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class ResponseSettings:
    """images : number of pairs of images that are summed one by one; the rest is bounded by the joint decay of hold and
    table, at least as k^-2. points, order : of the function that bounds the table's gain above half the sample rate,
    where the gain decreases smoothly: number of fitted frequencies and order. lowest : its lowest frequency, as a
    fraction of half the rate; the intervals of the grid reach slightly below half the rate. rest : a frequency far
    below every pole, as a fraction of half the rate, at which the gain at rest is evaluated; that of position sensors
    is zero at zero frequency. near : number of points, the first ones, with the bound for the blocks themselves; the
    loop gain is largest there. The others have the bound for the simplified blocks, a larger set: some per cent higher,
    but proved between frequencies in a third of the time. slack : as for `worst_case_gain`; the gain relative to the
    function is flat over frequency, where a small slack needs many intervals."""

    images: int = 8
    points: int = 12
    order: int = 3
    lowest: float = 0.99
    rest: float = 1e-9
    near: int = 2
    slack: float = 1e-2


@dataclass(frozen=True, eq=False)
class SampledAxes:
    """The emitted controller between the kept axes of a design.

    Attributes
    ----------
    forces : (n, n_u) forces on the axes [N] per drive volt. rows : (n_y, n) motion along each sensor per motion of each
    axis. gains_V : (n_y,) volts per unit of motion.
    """

    folder: DesignFolder
    controller: SampledController
    forces: np.ndarray
    rows: np.ndarray
    gains_V: np.ndarray
    settings: ResponseSettings = ResponseSettings()

    @staticmethod
    def of(folder: DesignFolder, controller: SampledController) -> SampledAxes:
        """Raises InputError if axes are measured both in space and against the chassis, or by several kinds of
        sensors."""
        rig, keep, plant = folder.rig, folder.design.keep, folder.plant
        if plant.relative and len(plant.relative) != len(plant.axes):
            raise InputError(
                "expected axes that are all measured in space, or all against the chassis; a mixture has "
                "no certificate of its code",
                field="keep",
                value=keep,
            )
        kept = [COORDINATES.index(name) for name in keep]
        lever = lever_arms(rig, keep)
        names, H = rig.sensor_rows()
        found = actuator_axes(rig, keep)
        if controller.system.inputs != tuple(names) or controller.system.outputs != tuple(found.actuators):
            raise InputError(
                "expected the sensors and drives of the design's rig",
                field="inputs, outputs",
                value=[*controller.system.inputs, *controller.system.outputs],
            )
        alike = np.array([one.inertial != bool(plant.relative) for one in rig.sensors()])
        filters = {
            one
            for one, used in zip(conditioning(rig, folder.design.loop.integrator_corner_Hz), alike, strict=True)
            if used
        }
        if len(filters) > 1:
            raise InputError(
                "expected sensors of one kind: several kinds have no certificate of their code",
                field="sensors",
                value=sorted({one.quantity for one in rig.sensors()}),
            )
        return SampledAxes(
            folder,
            controller,
            found.matrix[kept] / lever[:, None],
            H[:, kept] / lever * alike[:, None],
            np.array([one.gain for one in rig.sensors()]),
        )

    @property
    def period_s(self) -> float:
        """Sample period [s]."""
        return self.controller.system.dt

    @property
    def half_rate(self) -> float:
        """Half the sample rate [rad/s]."""
        return np.pi / self.period_s

    def hold(self, omega: np.ndarray) -> np.ndarray:
        """(n,) response of hold and delay."""
        T = self.period_s
        return np.sinc(omega * T / (2 * np.pi)) * np.exp(-1j * omega * T * (0.5 + self.controller.delay_samples))

    @property
    def pade(self) -> StateSpace:
        """Delay of the design model, which the plant already contains."""
        rig = self.folder.rig
        return pade_delay(rig.loop_delay_s + 0.5 / rig.sample_rate_Hz, self.folder.design.loop.pade_order)

    @cached_property
    def _filters(self) -> list[StateSpace | None]:
        found = conditioning(self.folder.rig, self.folder.design.loop.integrator_corner_Hz)
        systems = {one: None if one.is_one else one.system() for one in found}
        return [systems[one] for one in found]

    def sensor_volts(self, omega: np.ndarray) -> np.ndarray:
        """(n_omega, n_y) volts of each sensor per seen velocity along it."""
        known = {id(one): 1.0 / one.frequency_response(omega)[:, 0, 0] for one in self._filters if one is not None}
        return np.stack(
            [
                gain * (known[id(one)] if one is not None else np.ones(omega.size))
                for one, gain in zip(self._filters, self.gains_V, strict=True)
            ],
            axis=1,
        )

    def volts(self, omega: np.ndarray) -> np.ndarray:
        """(n_omega, n_u, n) drive volts per seen velocity of the axes."""
        K = self.controller.system.frequency_response(omega)
        return K @ (self.sensor_volts(omega)[:, :, None] * self.rows)

    def response(self, omega: np.ndarray) -> np.ndarray:
        """(n_omega, n, n) R without the design model's delay; it takes the place of the design's controller."""
        delay = self.pade.frequency_response(omega)[:, 0, 0]
        return (self.hold(omega) / delay)[:, None, None] * (self.forces @ self.volts(omega))

    def gain_at_rest(self) -> float:
        """Largest gain from the seen velocities of the axes to their forces far below every pole [N s/m]."""
        return float(np.linalg.norm(self.response(np.array([self.settings.rest * self.half_rate]))[0], 2))

    def controller_error(
        self, K: StateSpace, least: float, centre: np.ndarray, half: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(n,) bound over |omega - centre| <= half of |M| in R - K exp(-j omega tau) = M [K; least I], including the
        effect of rounded decoding; and the part of it that decreases with the square of the interval width.

        K : continuous, from seen velocities to forces [N s/m]; the delay tau is that of the design model.
        least : gain [N s/m] below which the error is measured absolutely.
        """
        T, own, delay = self.period_s, self.controller.system, self.pade.poles().tolist()
        # The inverse of the all-pass of the design's delay; it is 1 at zero frequency.
        no_pade = roots_jet(delay, [-one for one in delay], (-1.0) ** len(delay), centre, half)
        channel = self._channel
        unfiltered = roots_jet(channel.poles, channel.zeros, 1 / channel.leading, centre, half)
        volts = self.gains_V[:, None] * self.rows
        code = StateSpace(own.A, own.B @ volts, self.forces @ own.C, self.forces @ own.D @ volts, T)
        held = sinc_jet(T, centre) * (delay_jet(T * (0.5 + self.controller.delay_samples), centre) * no_pade)
        R = held * (unfiltered * system_jet(code, centre, half))
        # The part that rounding adds beside the axes is about 1e-7 of R and as smooth: doubled for the interval.
        alone = system_jet(K, centre, half)
        return (R - alone).relative_to(alone, least, half, 2 * self._beside(centre))

    def folding(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """(n,) bound of |E| [m/(N s)] over |omega - centre| <= half, up to half the sample rate."""
        own = self._filter(centre, half)[0]
        terms = [
            own
            / self._filter(image, half)[1]
            * self._high_gain("force", "seen", image, half)
            * (centre + half)
            / (image - half)
            for image in self._images(centre)
        ]
        # Hold and table together fall at least as k^-2.
        return np.sum(terms, axis=0) + self._rest(terms)

    def _beside(self, omega: np.ndarray) -> np.ndarray:
        """(n_omega,) effect of chain errors on the voltages and sensor signals that belong to no axis [N s/m].

        With exact decoding and allocation it would be zero; rounded coefficients make it about 1e-7 of the controller.
        """
        plant, volts = self.folder.plant, self.volts(omega)
        allocation = np.zeros((self.forces.shape[1], len(plant.axes)))
        allocation[[self.controller.system.outputs.index(name) for name in plant.actuators]] = plant.allocation
        by_sensor = self.forces @ (
            self.controller.system.frequency_response(omega) * self.sensor_volts(omega)[:, None, :]
        )
        found = np.zeros(omega.size)
        for chains, beside, size in (
            ("actuator chain *", volts - allocation @ (self.forces @ volts), np.linalg.norm(self.forces, 2)),
            ("sensor chain *", by_sensor - by_sensor @ self.rows @ plant.decoding, np.linalg.norm(self.rows, 2)),
        ):
            if (weight := plant.weights.get(chains)) is not None:
                found += weight.magnitude(omega) * size * np.linalg.norm(beside, ord=2, axis=(1, 2))
        return found * np.abs(self.hold(omega))

    # -- images of the sample rate -------------------------------------------------------
    @property
    def _channel(self) -> Filter:
        """F, the same for all sensors of the axes."""
        used = np.any(np.abs(self.rows) > 0, axis=1)
        found = conditioning(self.folder.rig, self.folder.design.loop.integrator_corner_Hz)
        return next(one for one, in_use in zip(found, used, strict=True) if in_use)

    def _filter(self, centre: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) largest and smallest |F| over the intervals."""
        one = self._channel
        jet = roots_jet(one.zeros, one.poles, one.leading, centre, half)
        return jet.size, np.abs(jet.value) ** 2 / jet.size

    def _images(self, omega: np.ndarray) -> list[np.ndarray]:
        """(n_omega,) frequencies that are aliased to omega, the nearest first."""
        rate = 2 * np.pi / self.period_s
        return [np.abs(omega + k * rate) for n in range(1, self.settings.images + 1) for k in (-n, n)]

    def _rest(self, terms: list[np.ndarray]) -> np.ndarray:
        """(n_omega,) bound of the sum beyond the n nearest pairs of images, for terms that decrease at least as k^-2.

        Images lie at k + x and k - x, x at most 1/2. The sum of 1/(k - 1/2)^2 over k > n is below 1/n (midpoint rule),
        and the last terms are at most (n + 1/2)^2 times smaller than that function at 1.
        """
        n = self.settings.images
        return (n + 0.5) ** 2 / n * (terms[-2] + terms[-1])

    def held_images(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """(n,) bound over each interval of the r.m.s. payload velocity at all images, per force [m/(N s)]."""
        terms = [
            np.square(self._high_gain("force", "velocity", image, half) * (centre + half) / (image - half))
            for image in self._images(centre)
        ]
        return np.sqrt(np.sum(terms, axis=0) + self._rest(terms))

    def folded_floor(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """(n,) bound over each interval of the r.m.s. seen velocity from the nearest images, per floor velocity.

        An accelerometer without a filter shows motion equally at every image, so that the sum over all has no bound.
        """
        own = self._filter(centre, half)[0]
        terms = [
            np.square(self._high_gain("floor", "seen", image, half) * own / self._filter(image, half)[1])
            for image in self._images(centre)
        ]
        return np.sqrt(np.sum(terms, axis=0))

    @cached_property
    def _unfiltered(self) -> DesignPlant:
        folder = self.folder
        if not folder.rig.electronics.anti_alias_order:
            return folder.plant
        bare = replace(folder.rig.electronics, anti_alias_order=0, anti_alias_corner_Hz=None)
        return build_plant(folder.design, folder.rig.with_electronics(bare))

    @property
    def high_grid(self) -> np.ndarray:
        """(points,) rad/s from half the sample rate on, where the first image of half the rate lies."""
        ends = self.settings.lowest, 2 * self.settings.images + 1
        return np.geomspace(*ends, self.settings.points) * self.half_rate

    def force_to_seen(self, omega: np.ndarray) -> np.ndarray:
        """(n_omega,) bound of the table's gain above half the sample rate [m/(N s)]."""
        return self._high_gain("force", "seen", omega, np.zeros(omega.size))

    def force_to_seen_at(self, omega: np.ndarray) -> np.ndarray:
        """(n_omega,) bound of the table's gain at these frequencies only [m/(N s)]; at most `force_to_seen`, and
        computed in seconds instead of minutes."""
        return self._gains_at("force", "seen", omega) * self._low_pass(omega, np.zeros(omega.size))

    def passive_above(self) -> float:
        """Bound of payload velocity over floor velocity above half the sample rate, where no controller acts."""
        return self._high_bounds["floor", "velocity"].gain

    def _high_gain(self, source: str, target: str, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """(n,) bound of the gain over the uncertainty set and over intervals above half the rate."""
        bound = self._high_bounds[source, target]
        size = roots_jet(bound.zeros(), bound.poles(), bound.gain, centre, half).size
        return size * self._low_pass(centre, half) if target == "seen" else size

    def _low_pass(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """(n,) magnitude of the anti-alias filter."""
        lags = self.folder.rig.electronics.low_pass()
        return roots_jet((), lags, float(np.prod(np.abs(lags))), centre, half).size if lags else np.ones(centre.size)

    @cached_property
    def _high_bounds(self) -> dict[tuple[str, str], Rational]:
        """`_high_bound` of the four gains needed; a constant from floor to payload velocity."""
        pairs = [("force", "seen"), ("force", "velocity"), ("floor", "seen"), ("floor", "velocity")]
        self._stability  # noqa: B018 (computed once, before the processes fork)
        return dict(zip(pairs, each(lambda pair: self._high_bound(*pair), pairs), strict=True))

    @cached_property
    def _stability(self) -> MuPeak:
        """Robust stability of the table without control."""
        part, whole = self._part("force", "seen")
        blocks = BlockStructure(whole.blocks[:-1])
        return stability_bound(part.select(range(blocks.n_z), range(blocks.n_w)), blocks)

    def _high_bound(self, source: str, target: str) -> Rational:
        """A function whose magnitude bounds the worst-case gain above half the rate: fitted to values, then raised to
        what `worst_case_gain` proves between them."""
        if (source, target) == ("floor", "velocity"):
            return Rational(self._proved(source, target, None))
        near, far = np.split(self.high_grid, [self.settings.near])
        gains = np.concatenate(
            [self._gains_at(source, target, near), self._gains_at(source, target, far, simplified=True)]
        )
        fitted = covering_fit(self.high_grid, gains, gains, self.settings.order).function
        return fitted.scaled(self._proved(source, target, fitted))

    def _gains_at(self, source: str, target: str, omega: np.ndarray, simplified: bool = False) -> np.ndarray:
        """(n_omega,) bounds of the worst-case gain at these frequencies above half the rate, without the filter."""
        part, whole = self._part(source, target)
        M = part.frequency_response(omega)[:, None]
        gains = skewed_upper_bound(M, whole.simplified()).beta if simplified else np.full(omega.size, np.inf)
        if (unbounded := np.flatnonzero(np.isinf(gains))).size:
            gains[unbounded] = skewed_upper_bound(M[unbounded], whole).beta
        if not np.all(np.isfinite(gains)):
            raise ComputationError(
                "the table above half the sample rate has no bounded gain over the uncertainty set",
                next_step="design with smaller uncertainty",
            )
        return gains

    def _proved(self, source: str, target: str, weight: Rational | None) -> float:
        """Proved bound of the ratio of worst-case gain and |weight| above half the sample rate."""
        part, whole = self._part(source, target)
        n_z, blocks = part.noutputs - whole.blocks[-1].cols, BlockStructure(whole.blocks[:-1])
        if weight is not None:
            part = append(gain(np.eye(n_z)), *[weight.inverse().system()] * (part.noutputs - n_z)) @ part
        # points=0: only the largest gain is required, no curve.
        found = worst_case_gain(
            part, blocks, band=(self.high_grid[0], np.inf), slack=self.settings.slack, robust=self._stability, points=0
        )
        if not (found.guaranteed and np.isfinite(found.upper)):
            raise ComputationError("the table's gain above half the sample rate is not proved", measured=found.covers)
        return found.upper

    def _part(self, source: str, target: str) -> tuple[StateSpace, BlockStructure]:
        """The open table without anti-alias filter, and its blocks; from force or floor to seen or payload velocity."""
        plant = self._unfiltered
        blocks, P = plant.full.blocks, plant.full.P
        names = {
            "force": plant.full.u,
            "floor": plant.floor_velocities,
            "seen": plant.full.y,
            "velocity": plant.velocities,
        }
        part = P.select([*P.outputs[: blocks.n_z], *names[target]], [*P.inputs[: blocks.n_w], *names[source]])
        return part, blocks.with_performance(len(names[source]), len(names[target]))
