"""A rig with effects: the model that `gap` fits, with the interface of `identification.ResponseModel`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import Added, Effect, EffectParameter, Table
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.operators import Assembled, MountSlopes, Operators, mount_geometry, mount_slopes
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.table_response import MOUNT, Acting, AtMotion, TableResponse
from avis_ctrl.identification.response import Driven, Matrices, ResponseModel, kept_lines
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.structural_identifiability import structural_null_space, structure_of


@dataclass(frozen=True)
class ModelSettings:
    """Settings of a model's derivatives and of its sensors' transients.

    step : step of finite differences in an effect's parameters, in units of their size [1].
    probed_Hz : lowest and highest frequency [Hz], and number of frequencies at which sensor chains are compared with
        the rig's.
    unchanged : maximum variation over these frequencies of the ratio of a sensor's chain to the rig's, for the chain to
        count as the same [1]: round-off.
    """

    step: float = 1e-4
    probed_Hz: tuple[float, float, int] = (0.5, 100.0, 5)
    unchanged: float = 1e-6


SETTINGS = ModelSettings()


@dataclass(frozen=True, eq=False)
class ActiveEffect:
    """An effect at a place with values (n,) of its parameters, in the order of `Effect.parameters`."""

    effect: Effect
    place: str
    parameters: tuple[EffectParameter, ...]
    values: tuple[float, ...]

    @property
    def label(self) -> str:
        """Name and place."""
        return f"{self.effect.name}@{self.place}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters in a model."""
        return tuple(f"{self.label}.{one.name}" for one in self.parameters)

    @property
    def outside(self) -> bool:
        """Whether the library has no name for it."""
        return self.effect.outside

    @property
    def by_name(self) -> dict[str, float]:
        """Values by name of the parameter."""
        return dict(zip((one.name for one in self.parameters), self.values, strict=True))

    @property
    def absent(self) -> dict[str, float]:
        """Values of its linear parameters at which it does not act, by their names in a model."""
        return {name: p.none for name, p in zip(self.names, self.parameters, strict=True) if p.linear}

    def at(self, values: Sequence[float]) -> ActiveEffect:
        """The effect with other values."""
        return replace(self, values=tuple(float(v) for v in values))


def active(effect: Effect, model: TableModel, place: str, values: Sequence[float] | None = None) -> ActiveEffect:
    """An effect at a place of a model; at zero strength if no values are given."""
    parameters = effect.parameters(model, place)
    values = list(effect.starts(model, place)[0] if values is None else values)
    if len(values) != len(parameters):
        raise InputError(f"expected {len(parameters)} values", field=effect.name, value=list(values))
    return ActiveEffect(effect, place, parameters, tuple(float(v) for v in values))


@dataclass(frozen=True, eq=False)
class TableModel(Table):
    """`ResponseModel` with effects.

    effects : added, all their parameters free. corners_differ : no filter cancels a geophone's suspension exactly
    (`sensor_transients`). held : labels of effects whose parameters are fixed.
    """

    effects: tuple[ActiveEffect, ...] = ()
    corners_differ: bool = False
    held: frozenset[str] = frozenset()

    @cached_property
    def _free(self) -> list[tuple[int, int]]:
        """(effect, parameter) of each free parameter of the effects."""
        return [
            (k, j) for k, one in enumerate(self.effects) if one.label not in self.held for j in range(len(one.names))
        ]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters: those of the rig, then those of the effects."""
        return (*self.base.names, *(self.effects[k].names[j] for k, j in self._free))

    @property
    def values(self) -> np.ndarray:
        """(n_p,) values of the free parameters."""
        return np.concatenate([self.base.values, [self.effects[k].values[j] for k, j in self._free]])

    @property
    def priors(self) -> dict[str, tuple[float, float]]:
        """(mean, standard deviation) of free parameters that records need not determine (`Effect.priors`)."""
        known = {
            f"{one.label}.{name}": prior
            for one in self.effects
            for name, prior in one.effect.priors(self, one.place, one.by_name).items()
        }
        return {name: prior for name, prior in known.items() if name in self.names}

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the free parameters."""
        return (*self.base.units, *(self.effects[k].parameters[j].unit for k, j in self._free))

    def scales(self) -> np.ndarray:
        """(n_p,) one relative unit of each parameter."""
        own = [self.effects[k].parameters[j].size for k, j in self._free]
        return np.concatenate([(self.nominal or self.base).scales(), own])

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) maximum decrease and increase of each parameter in one step of a fit, in relative units: half of its
        value; for an effect at least half of its size, and upwards up to its full value."""
        known, sizes = self.base.reach()[0], np.array([self.effects[k].parameters[j].size for k, j in self._free])
        own = np.abs([self.effects[k].values[j] for k, j in self._free]) / sizes
        return (np.concatenate([known, np.maximum(0.5, 0.5 * own)]), np.concatenate([known, np.maximum(0.5, own)]))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(n_p,) lowest and highest physically possible values."""
        low, high = (self.nominal or self.base).bounds()
        own = [self.effects[k].parameters[j] for k, j in self._free]
        return np.concatenate([low, [one.low for one in own]]), np.concatenate([high, [one.high for one in own]])

    def at(self, theta: Sequence[float] | np.ndarray) -> TableModel:
        """The model with its free parameters set to theta. Raises InputError for impossible values."""
        theta = np.asarray(theta, float)
        n = len(self.base.names)
        values = [list(one.values) for one in self.effects]
        for value, (k, j) in zip(theta[n:], self._free, strict=True):
            values[k][j] = float(value)
        moved = tuple(one.at(v) for one, v in zip(self.effects, values, strict=True))
        return replace(self, base=self.base.at(theta[:n]), effects=moved)

    def _with_effect_parameter(self, index: int, value: float) -> TableModel:
        """The model with another value of one free parameter of an effect; the rig is unchanged."""
        k, j = self._free[index]
        values = list(self.effects[k].values)
        values[j] = value
        return replace(self, effects=(*self.effects[:k], self.effects[k].at(values), *self.effects[k + 1 :]))

    def with_effect(self, effect: ActiveEffect) -> TableModel:
        """The model with one more effect, which comes last."""
        return replace(self, effects=(*self.effects, effect))

    def only(self, effect: ActiveEffect) -> TableModel:
        """The model with one more effect; only the parameters of this effect are free."""
        return replace(
            self,
            base=replace(self.base, names=()),
            nominal=replace(self.nominal or self.base, names=()),
            effects=(*self.effects, effect),
            held=frozenset(one.label for one in self.effects),
        )

    def effect(self, label: str) -> ActiveEffect:
        """An effect by label."""
        return next(one for one in self.effects if one.label == label)

    def without(self, label: str) -> TableModel:
        """The model without one of its effects."""
        return replace(self, effects=tuple(one for one in self.effects if one.label != label))

    def with_law_of_rig_file(self, label: str) -> TableModel:
        """The model without one of its effects, but with the law that a rig file states in its place (`instead`)."""
        one = self.effect(label)
        place = one.effect.instead(one.place)
        if not place:
            return self.without(label)
        return replace(self, effects=tuple(replace(e, place=place) if e is one else e for e in self.effects))

    @cached_property
    def effective(self) -> ResponseModel:
        """The base with the rig parameters that effects set."""
        changes: dict[str, float] = {}
        for one in self.effects:
            changes |= one.effect.rig_changes(self, one.place, one.by_name)
        return replace(self.base, rig=self.base.rig.with_parameters(changes)) if changes else self.base

    @property
    def matrices(self) -> Matrices:
        """Matrices of the rig as the effects set it."""
        return self.effective.matrices

    @cached_property
    def derivative_matrices(self) -> Matrices:
        """Derivatives of the matrices without mounts, which effects may change, with respect to the rig's free
        parameters."""
        others = np.array([not MOUNT.fullmatch(name) for name in self.base.names], bool)
        found = Matrices(*(slopes * others[:, None, None] for slopes in self.effective.derivative_matrices))
        mounts, places = mount_geometry(self.effective.rig), self.mount_slopes
        G, G_c = mounts.payload, mounts.chassis
        for values, by_payload, by_floor in (
            (mounts.stiffness[:, None], found.K, found.K_floor),
            (mounts.damping[:, None], found.C, found.C_floor),
        ):
            for row, dG, dG_c in zip(places.parameters, places.payload, places.chassis, strict=True):
                by_payload[row] -= dG.T @ (values * G) + G.T @ (values * dG)
                by_floor[row] -= dG.T @ (values * G_c) + G.T @ (values * dG_c)
        return found

    @cached_property
    def mount_slopes(self) -> MountSlopes:
        """Derivatives of the mounts' geometry with respect to the rig's free parameters that move a mount, and thereby
        change the stiffness matrix."""
        changes = self.effective.derivative_matrices.K.any(axis=(1, 2))
        places = [k for k in np.flatnonzero(changes) if not MOUNT.fullmatch(self.base.names[k])]
        return mount_slopes((self.nominal or self.base).rig, self.base.names, tuple(places))

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the effects except the second-order terms."""
        return tuple(one.label for one in self.effects if not isinstance(one.effect, LargeMotion))

    @property
    def nonlinear(self) -> bool:
        """Whether an effect depends on amplitude or time."""
        return any(one.effect.nonlinear for one in self.effects)

    @property
    def linear(self) -> TableModel:
        """The model without effects that depend on amplitude or time."""
        return replace(self, effects=tuple(one for one in self.effects if not one.effect.nonlinear))

    def operators(self, omega: np.ndarray) -> Operators:
        """The table on lines omega (n,) rad/s, changed by the effects."""
        ops = Operators(self.effective, np.asarray(omega, float))
        for one in self.effects:
            one.effect.change(ops, one.place, one.by_name)
        return ops

    @kept_lines
    def assembled(self, omega: np.ndarray) -> Assembled:
        """The assembled table on lines omega."""
        return Assembled(self.operators(omega))

    def response(self, omega: np.ndarray) -> np.ndarray:
        """G, (n, n_y, n_u + 3), as `ResponseModel.response`, without effects that depend on amplitude or time."""
        n, n_in = len(omega), len(self.inputs)
        return self.driven(omega, np.broadcast_to(np.eye(n_in, dtype=complex), (n, n_in, n_in)), False).Y

    def sensor_transients(self, omega: np.ndarray) -> np.ndarray:
        """As `ResponseModel.sensor_transients`, with the states that effects add to a sensor's chain.

        If effects multiply the chain by r(s), a ratio of polynomials, the transients of the poles of r are r and s r,
        together with a constant and a slope. r^2 and s r^2 represent a small change of these poles, so that a fit's
        gradient need not include it. If the corners of geophones have tolerances, no filter cancels a suspension
        exactly and each suspension rings, with or without effects: 1/p and s/p, with p its polynomial, are then used
        instead, beside the states that effects declare (`Operators.ringing`).
        """
        own, s = self.base.chains_ring(omega), 1j * omega
        if self.corners_differ:
            ring = self._chain_ratio(omega)[:, :, None] * self.base.suspensions_ring(omega)
            return np.concatenate([own, ring, *self._ringing(omega)], axis=2)
        changed = self._changed_sensors
        if not changed.size:
            return own
        r = self._chain_ratio(omega)
        ringing = np.zeros((len(omega), r.shape[1], len(changed), 4), complex)
        for j, k in enumerate(changed):
            ringing[:, k, j] = np.stack([r[:, k], s * r[:, k], r[:, k] ** 2, s * r[:, k] ** 2], axis=-1)
        return np.concatenate([own, ringing.reshape(len(omega), r.shape[1], -1)], axis=2)

    def _ringing(self, omega: np.ndarray) -> list[np.ndarray]:
        """(n, n_y, m) y per unit initial value of the states that effects add to sensors' chains."""
        found = []
        for k, states in self.assembled(omega).ops.ringing:
            of_all = np.zeros((len(omega), len(self.sensors.names), states.shape[1]), complex)
            of_all[:, k] = states
            found.append(of_all)
        return found

    @cached_property
    def _changed_sensors(self) -> np.ndarray:
        """Indices of the sensors whose chain effects change by more than a constant factor, independent of the
        requested lines."""
        r = self._chain_ratio(2 * np.pi * np.geomspace(*SETTINGS.probed_Hz))
        level = np.mean(r, axis=0)
        return np.flatnonzero(np.max(np.abs(r - level), axis=0) > SETTINGS.unchanged * np.abs(level))

    def _chain_ratio(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y) chain of each sensor over that of the rig."""
        return self.assembled(omega).ops.sense / Operators(self.effective, omega).sense

    def inner_transients(self, omega: np.ndarray) -> np.ndarray:
        """(n, n_y, n_t): y per unit initial internal state of effects: modes, masses in mounts, a chassis.

        If such a state is lightly damped, much of its value at the ends of a record remains visible.
        """
        n_y = len(self.sensors.names)
        if not any(one.effect.holds_states for one in self.effects):
            return np.zeros((len(omega), n_y, 0), complex)
        made = self.assembled(omega)
        return made.y_of_states

    def driven(self, omega: np.ndarray, U: np.ndarray, derivative: bool = True) -> Driven:
        """As `ResponseModel.driven`: y from spectra of the inputs, and its derivative with respect to the free
        parameters."""
        return self._driven(np.asarray(omega, float), U, None, derivative)

    def answer(
        self,
        block: SpectralBlock,
        body: np.ndarray | None = None,
        derivative: bool = True,
        inner: np.ndarray | None = None,
    ) -> Driven:
        """As `ResponseModel.answer`: response of a record, including effects that depend on its motion in time; inner
        (n_t,): initial values of the states of `inner_transients`."""
        U = block.U if body is None else np.concatenate([block.U, body], axis=1)
        return self._driven(block.omega, U, block if self.nonlinear else None, derivative, inner)

    def _driven(
        self,
        omega: np.ndarray,
        U: np.ndarray,
        block: SpectralBlock | None,
        derivative: bool,
        inner: np.ndarray | None = None,
    ) -> Driven:
        made = self.assembled(omega)
        response = TableResponse(made, self.acting(U, block, inner))
        if not derivative:
            return Driven(response.Y, np.empty(0))
        dY = response.by_rig(self.effective, self.derivative_matrices, self.mount_slopes, len(self._free))
        self._by_effects(omega, block, made, response, dY)
        return Driven(response.Y, dY)

    def acting(self, U: np.ndarray, block: SpectralBlock | None, inner: np.ndarray | None = None) -> Acting:
        """Inputs with the acting volts, and the contributions of effects that depend on the record."""
        if block is None:
            return Acting(U, len(self.actuators), inner=inner)
        record = self.motion.get(block.name)
        if record is None:
            raise InputError(
                "expected the record's motion in time for an effect that depends on it", field=f"block {block.name}"
            )
        added = [_added(one, record, block.omega) for one in self.effects]
        volts, force, reading, output = (_sum(some) for some in zip(*added, strict=True))
        if volts is not None:
            U = U.copy()
            U[:, : len(self.actuators)] += volts
        return Acting(U, len(self.actuators), force, reading, output, inner)

    def contribution(self, one: ActiveEffect, block: SpectralBlock) -> Acting:
        """Inputs and outputs of a record that an effect adds, if it depends on the record, without all others."""
        return self._alone(block.omega, _added(one, self.motion[block.name], block.omega))

    def _alone(self, omega: np.ndarray, added: Added) -> Acting:
        volts, *rest = added
        U = np.zeros((len(omega), len(self.inputs), 1), complex)
        if volts is not None:
            U[:, : len(self.actuators)] = volts
        return Acting(U, len(self.actuators), *rest)

    def _by_effects(
        self, omega: np.ndarray, block: SpectralBlock | None, made: Assembled, response: TableResponse, dY: np.ndarray
    ) -> None:
        """Central differences with respect to the effects' parameters. For an effect that depends on the record they
        are taken of its contribution, in which the response is linear; for an effect that changes the table, of the
        whole response."""
        n = len(self.base.names)
        for row, (effect, others, width, tables) in enumerate(self._beside(omega), n):
            if effect.nonlinear:
                assert block is not None
                record = self.motion[block.name]
                up, down = (_added(other, record, omega) for other in others)
                slope = Added(
                    *(None if a is None or b is None else (a - b) / width for a, b in zip(up, down, strict=True))
                )
                dY[row] = TableResponse(made, self._alone(omega, slope)).Y
                continue
            sides = [AtMotion(table, response.acting, response.x) for table in tables]
            # d x = inv(D) (d F - d D x): no second inverse.
            dY[row] = ((sides[0].Y - sides[1].Y) + response.left @ (sides[0].push - sides[1].push)) / width

    @partial(kept_lines, most=1)
    def _beside(self, omega: np.ndarray) -> list[tuple[Effect, list[ActiveEffect], float, list[Assembled]]]:
        """For every free parameter of the effects: its effect, the effect with the parameter stepped up and down, the
        difference between the two values, and, if the effect changes the table, the two tables (not inverted)."""
        n, theta, (low, high), found = len(self.base.names), self.values, self.bounds(), []
        scale = self.scales()
        for row in range(n, len(theta)):
            step = SETTINGS.step * scale[row]
            # A bound that depends on the payload's mass may have moved past the value.
            lowest, highest = min(low[row], theta[row]), max(high[row], theta[row])
            ends = [min(max(theta[row] + sign * step, lowest), highest) for sign in (1, -1)]
            others, k = [self._with_effect_parameter(row - n, end) for end in ends], self._free[row - n][0]
            effect = self.effects[k].effect
            tables = [] if effect.nonlinear else [Assembled(one.operators(omega)) for one in others]
            found.append((effect, [one.effects[k] for one in others], ends[0] - ends[1], tables))
        return found


def inseparable_parameters(model: TableModel) -> tuple[tuple[str, ...], ...]:
    """Groups of the rig's free parameters of which its equations determine only combinations (two collinear springs): a
    fit keeps their initial ratio, and their standard deviations do not show this."""
    base = model.effective
    if not base.names:
        return ()
    found = structure_of(structural_null_space(base), base.values, base.units, base.names)
    return tuple(tuple(base.names[k] for k in group.members) for group in found.groups)


def _added(one: ActiveEffect, record: RecordMotion, omega: np.ndarray) -> Added:
    """Contribution of an effect to a record on its lines, (n, channels, 1) each; readings as displacement."""
    if not one.effect.nonlinear:
        return Added()
    found = one.effect.spectra(record, one.place, one.by_name, omega)
    if found.reading is not None:
        found = found._replace(reading=-found.reading / (omega**2)[:, None])
    return Added(*(None if each is None else each[:, :, None] for each in found))


def _sum(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    given = [part for part in parts if part is not None]
    return sum(given[1:], given[0]) if given else None
