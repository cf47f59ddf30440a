"""Base class of effects. An effect is a named piece of physics with a place, parameters, and an action on the table.

To add one, write a class and register it:

    @register
    class EddyBrake(Effect):
        name = "eddy_brake"
        ...

`change` acts on the table line by line. An effect that depends on amplitude or time implements `volts`, `force` or
`reading` instead, from the record's motion in time. A parameter marked `linear` has no effect at the value `none`. Near
that value the effect is almost linear in it, which the score test and the starting values use. The other parameters
shape the effect (a frequency, a damping).
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from avis_ctrl import uncertain_value
from avis_ctrl.errors import InputError
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.identification.response import ResponseModel, SensorModel
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class LibrarySettings:
    """Assumptions of the library of effects.

    tilted_rad : tilt up to which a sensor counts as aligned with an earth axis [rad]: far more than a mounting error.
    tried_Hz : frequencies at which a user-defined effect is tested [Hz]: below, at and above the suspension resonances.
    reach_m : largest distance from the geometric centre, along each axis, at which something can be attached to a
        payload [m].
    most_turned : largest rotation about each axis of the axes of a sprung mass relative to x, y, z [rad]: any three
        orthogonal axes are at most 1.1 rad from some permutation of x, y, z.
    mode_damping : lowest and highest damping ratio of a flexible mode [1]: at the upper one its response is no longer a
        resonance, and its shapes can compensate for other effects.
    loss_Hz : frequency at which the stiffness of a mount with structural damping equals that of the rig file [Hz]: near
        the suspension resonances.
    leveled : number of mounts with a leveling valve, the first ones; three points determine a plane.
    valve_Hz : lowest and highest corner frequency of a leveling valve [Hz]: at the lower one the valve hardly acts, at
        the upper one it acts without lag.
    """

    tilted_rad: float = 0.3
    tried_Hz: tuple[float, ...] = (0.3, 3.0, 30.0)
    reach_m: float = 2.0
    most_turned: float = 1.2
    mode_damping: tuple[float, float] = (1e-4, 0.5)
    loss_Hz: float = 3.0
    leveled: int = 3
    valve_Hz: tuple[float, float] = (0.01, 100.0)


SETTINGS = LibrarySettings()
# Parameter values by name.
Values = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Table:
    """What an effect uses of the table that it acts on: the model without the effect.

    base : the rig and its free parameters. motion : records in time by name, required by effects that depend on
    amplitude or time. nominal : the rig as in its file, which sets the step sizes of a fit: a parameter that a wrong
    model has driven to zero must be able to recover. None for the base itself.
    """

    base: ResponseModel
    motion: Mapping[str, RecordMotion] = field(default_factory=dict)
    nominal: ResponseModel | None = None

    @property
    def effective(self) -> ResponseModel:
        """The base with the rig parameters that other effects set."""
        return self.base

    @property
    def rig(self) -> Rig:
        """The rig of the base."""
        return self.base.rig

    @property
    def sensors(self) -> SensorModel:
        """Sensors of the base."""
        return self.base.sensors

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the drives."""
        return self.base.actuators

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the drives, and of the floor's axes."""
        return self.base.inputs

    @property
    def period_s(self) -> float:
        """Sample period [s]; 0 for responses to the voltage itself."""
        return self.base.period_s

    @property
    def delay_s(self) -> float:
        """Delay of the base [s]."""
        return self.base.delay_s

    @property
    def amplifier_corner_Hz(self) -> float | None:
        """Corner of the amplifiers of the base [Hz]; None without a lag."""
        return self.base.amplifier_corner_Hz


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    none : value without the effect. low, high : physical limits. size : unit of the parameter in a fit.
    linear : the effect vanishes in proportion as the parameter approaches `none`.
    grid : values of the search, for a nonlinear parameter. optional : whether it may end at its bounds.
    """

    name: str
    unit: str
    description: str
    none: float
    low: float
    high: float
    size: float
    linear: bool = True
    grid: tuple[float, ...] = ()
    optional: bool = False

    @staticmethod
    def shape(
        name: str,
        unit: str,
        description: str,
        low: float,
        high: float,
        size: float,
        grid: Iterable[float],
        *,
        optional: bool = False,
        none: float = 0.0,
    ) -> EffectParameter:
        """A parameter that is not linear: it shapes the effect."""
        return EffectParameter(name, unit, description, none, low, high, size, False, tuple(map(float, grid)), optional)

    def of_each(self, names: Iterable[int | str]) -> tuple[EffectParameter, ...]:
        """The same parameter for each name, which replaces {} in name and description."""
        return tuple(
            replace(self, name=self.name.format(one), description=self.description.format(one)) for one in names
        )


@dataclass(frozen=True)
class Reported:
    """A parameter as reported: value, standard deviation, unit."""

    value: float
    std: float
    unit: str

    def __str__(self) -> str:
        return uncertain_value.text(self.value, self.std, self.unit)


class Added(NamedTuple):
    """Contribution of an effect to a record on its lines, (n, channels) each; None for none.

    volts : added to the commanded volts. force : generalised, on the payload. reading : acceleration along the sensors,
    added to that of the payload. output : added to the sensor outputs, in the unit of y.
    """

    volts: np.ndarray | None = None
    force: np.ndarray | None = None
    reading: np.ndarray | None = None
    output: np.ndarray | None = None


def uneven(names: Iterable[int | str], words: str, most: float = 0.9) -> tuple[EffectParameter, ...]:
    """Parameters of mounts, contacts or drives that differ from their mean; words has {} for the name."""
    return EffectParameter.shape("uneven_{}", "1", words, -most, most, 0.1, (0.0,), optional=True).of_each(names)


def shares(values: Values) -> np.ndarray:
    """(m,) value of each mount, contact or drive over their mean, from the values uneven_ .. of all but the last."""
    given = [value for name, value in values.items() if name.startswith("uneven_")]
    return 1 + np.array([*given, -sum(given)])


class Effect(ABC):
    """A piece of physics that a model may lack.

    Attributes
    ----------
    name : as in docs/contracts/gap.md. title : in words, for a sentence. looks_like : its signature in the responses.
    at : where it can act, if its `places` do not depend on the table.
    nonlinear : depends on amplitude or time; acts through `volts`, `force` or `reading`.
    time_varying : a nonlinear effect that depends on time alone: at any level it is the same fraction of the response.
    strength : parameter to which `force` is proportional; empty if there is none.
    holds_states : has states of its own; their values at the ends of a record are estimated with its transient.
    resonant : adds resonances with many parameters, which a mode of any shape describes approximately.
    outside : an effect of `effects.outside_library`, fitted in competition with the library and never named.
    always_possible : any table may have it, too weak to be detected; the standard deviations of others allow for it.
    """

    name: str
    title: str
    looks_like: str
    at: tuple[str, ...] = ()
    nonlinear: bool = False
    time_varying: bool = False
    strength: str = ""
    holds_states: bool = False
    resonant: bool = False
    outside: bool = False
    always_possible: bool = False

    def places(self, model: Table) -> tuple[str, ...]:
        """Where the effect can act on this table; empty if nowhere."""
        return self.at

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        """Parameters of the effect at a place."""
        raise NotImplementedError

    def instead(self, place: str) -> str:
        """Place with the law that a rig file states in place of the effect's own, with the same values; empty if it
        states none. The share of an effect is its difference from this law."""
        return ""

    def rig_changes(self, model: Table, place: str, values: Values) -> dict[str, float]:
        """Parameters of the rig that the effect sets."""
        return {}

    def change(self, ops: Operators, place: str, values: Values) -> None:
        """Modify the table line by line."""
        return None

    def volts(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        """(samples, n_u) volts that act in place of the commanded ones; None if they are unchanged."""
        return None

    def force(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        """(samples, 6) generalised force on the payload, None for none."""
        return None

    def reading(self, record: RecordMotion, place: str, values: Values) -> np.ndarray | None:
        """(samples, n_y) acceleration along the sensors, added to that of the payload; None for none."""
        return None

    def titled(self, place: str) -> str:
        """The title of the effect with the law of a place."""
        return self.title

    def described(self, place: str, values: Values) -> str:
        """Description with its place, for a sentence."""
        return f"{self.titled(place)} ({place})"

    def spectra(self, record: RecordMotion, place: str, values: Values, omega: np.ndarray) -> Added:
        """Contribution to a record on lines omega; for a force proportional to `strength`, the unit force is cached."""

        def on_lines(act: Callable[..., np.ndarray | None], values: Values) -> np.ndarray | None:
            if getattr(Effect, act.__name__) is getattr(type(self), act.__name__):
                return None

            def samples() -> np.ndarray:
                found = act(record, place, values)
                return np.empty((len(record.volts), 0)) if found is None else found

            found = record.kept(f"{self.name}@{place} {act.__name__} {values}", omega, samples)
            return found if found.shape[1] else None

        volts = on_lines(self.volts, values)
        if volts is not None:
            volts = volts - record.kept("volts", omega, lambda: record.volts)
        if self.strength:
            unit = on_lines(self.force, {**values, self.strength: 1.0})
            force = None if unit is None else values[self.strength] * unit
        else:
            force = on_lines(self.force, values)
        return Added(volts, force, on_lines(self.reading, values))

    def starts(self, model: Table, place: str) -> Sequence[tuple[float, ...]]:
        """Initial points of the search, (n_parameters,) each: shape parameters on their grid, linear ones at none."""
        return list(product(*((one.none,) if one.linear else one.grid for one in self.parameters(model, place))))

    def implausible(self, values: Values, std: Values) -> str:
        """Why these values are not physical; empty if they are plausible."""
        return ""

    def priors(self, model: Table, place: str, values: Values) -> dict[str, tuple[float, float]]:
        """(mean, standard deviation) by name of parameters that records need not determine, from approximate values."""
        return {}

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        """Parameters as the report shows them; by default unchanged."""
        return {
            one.name: Reported(values[one.name], float(np.sqrt(max(covariance[k, k], 0.0))), one.unit)
            for k, one in enumerate(self.parameters(model, place))
        }


_registry: dict[str, Effect] = {}


def register(effect: type[Effect]) -> type[Effect]:
    """Add an effect to the library (class decorator).

    Raises
    ------
    InputError : no name, or a name that another class uses.
    """
    name = getattr(effect, "name", "")
    if not name:
        raise InputError("expected an effect with a name", field="effect", value=effect.__name__)
    known = _registry.get(name)
    if known is not None and (type(known).__module__, type(known).__qualname__) != (
        effect.__module__,
        effect.__qualname__,
    ):
        raise InputError("expected a name that no other effect has", field="effect", value=name)
    _registry[name] = effect()
    return effect


def registered() -> dict[str, Effect]:
    """All registered effects by name."""
    return dict(_registry)


def restore(known: dict[str, Effect]) -> None:
    """Reset the library to a state that `registered` returned."""
    _registry.clear()
    _registry.update(known)
