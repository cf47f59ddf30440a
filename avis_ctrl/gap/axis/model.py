"""A mass with the effects that may be missing, in the form that the likelihood of the table requires.

Let R = M s^2 q + d s q + k q + forces, Z = M s^2 + d s + k + inner dynamics, and P the path from force to mass:

    drive:  F = F_measured - (P F - R)/P       oscillator:  q = q_measured + (P F - R)/Z

These equal R / P and P F / Z except for window leakage, which P F - R takes into account exactly. Both are linear in
the coefficients of the forces. The linear part of a force, alpha q + beta v at the level of the record, is included in
Z as well. Otherwise the force would predict the noise of the same q from which it is computed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.axis.records import Lines, Shape
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings
from avis_ctrl.identification.priors import Priors
from avis_ctrl.identification.response import Driven
from avis_ctrl.identification.spectral_block import SpectralBlock

Curve = Callable[[np.ndarray, np.ndarray], np.ndarray]
Ratios = Callable[[Mapping[str, float]], Mapping[str, tuple[float, str]]]


@dataclass(frozen=True)
class Parameter:
    """unit : with {F} and {x} for the units of force and position. A linear parameter starts at zero. Any other is
    positive and starts at the effect's seeds, within its range. step : relative step of the derivative with respect to
    a shape parameter, large enough to smooth the edges of a force."""

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    linear: bool = True
    step: float = 1e-2


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect that a single-axis model may lack.

    name, location : as reported. title : what is missing, in words. separated_by : the measurement that distinguishes
    it from effects with the same prediction. shapes : forces as functions of the motion, one for each of the first
    parameters; the remaining, nonlinear parameters shape all of them. variable : "position", "velocity" or "input" if
    the force is a function of this variable alone: a free function of it then tests its shape. dynamics : (s, p) added
    to Z. path : (s, p) factor of the path from force to mass. channel : (s, p) factor of one sensor channel. seeds :
    initial values of fits. law : variant of the effect. outside : an unnamed function, which represents whatever the
    library lacks. derived : quantities reported instead of the parameters. implausible : (p) why the values are not
    physical; empty if they are plausible.
    """

    name: str
    location: str
    title: str
    parameters: tuple[Parameter, ...]
    separated_by: str = ""
    shapes: tuple[Shape, ...] = ()
    dynamics: Curve | None = None
    path: Curve | None = None
    channel: Curve | None = None
    seeds: tuple[tuple[float, ...], ...] = ()
    law: str = ""
    variable: str = ""
    outside: bool = False
    derived: Callable[[np.ndarray], dict[str, tuple[float, str]]] | None = None
    implausible: Callable[[np.ndarray], str] | None = None

    @property
    def label(self) -> str:
        """Name, location and law."""
        return f"{self.name}@{self.location}" + (f"/{self.law}" if self.law else "")

    @property
    def key(self) -> str:
        """Name and location."""
        return f"{self.name}@{self.location}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters in a model."""
        return tuple(f"{p.name}@{self.label}" for p in self.parameters)

    @property
    def sizes(self) -> list[str]:
        """Names, as in a model, of the parameters in which it is linear."""
        return [name for name, p in zip(self.names, self.parameters, strict=True) if p.linear]

    def reported(self, values: np.ndarray) -> Mapping[str, tuple[float, str]]:
        """Quantities with units that are reported for these values of the parameters."""
        if self.derived:
            return self.derived(values)
        return {p.name: (value, p.unit) for p, value in zip(self.parameters, values.tolist(), strict=True)}

    def initial_values(self) -> list[np.ndarray]:
        """Initial values of fits; zero by default."""
        return [np.array(one) for one in self.seeds] or [np.zeros(len(self.parameters))]


def central_differences(
    function: Callable[[np.ndarray], np.ndarray], p: np.ndarray, steps: Sequence[float] | np.ndarray
) -> list[np.ndarray]:
    """Derivative of a function with respect to each of its parameters."""
    return [(function(p + h) - function(p - h)) / (2 * h.sum()) for h in np.diag(steps)]


def slopes(curve: Curve, s: np.ndarray, p: np.ndarray) -> list[np.ndarray]:
    """Derivatives of a curve with respect to each of its parameters."""
    steps = [1e-5 * abs(one) or 1e-6 / float(np.max(np.abs(s))) for one in p]
    return central_differences(lambda x: curve(s, x), p, steps)


def summed(parts: np.ndarray) -> np.ndarray:
    """(n,) sum of the three terms of each line (n, 3); much faster than `np.sum` along so short an axis."""
    return parts[:, 0] + parts[:, 1] + parts[:, 2]


@dataclass(frozen=True, eq=False)
class AxisModel:
    """A base model with effects. base : its parameters, of which those that are not linear are positive.

    A subclass defines `predicted`, and `steps` for its derivatives.
    """

    lines: Any
    base: tuple[Parameter, ...]
    effects: tuple[Effect, ...]
    values: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: those of the base model, then those of the effects."""
        return (*(p.name for p in self.base), *(name for one in self.effects for name in one.names))

    @property
    def units(self) -> tuple[str, ...]:
        """Units of all parameters."""
        return (*(p.unit for p in self.base), *(p.unit for one in self.effects for p in one.parameters))

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the effects."""
        return tuple(one.label for one in self.effects)

    @property
    def parts(self) -> list[np.ndarray]:
        """Parameter values of each effect."""
        ends = np.cumsum([len(self.base), *(len(one.parameters) for one in self.effects)])
        return np.split(self.values, ends[:-1])[1:]

    def effect(self, label: str) -> Effect:
        """The effect with this label."""
        return self.effects[self.labels.index(label)]

    def of(self, effect: Effect) -> np.ndarray:
        """Parameter values of an effect."""
        return self.parts[self.effects.index(effect)]

    def at(self, values: np.ndarray) -> AxisModel:
        """The model with other values of its parameters."""
        if not np.all(np.isfinite(values)):
            raise InputError("expected finite values", field="values")
        return replace(self, values=np.asarray(values, float))

    def with_effect(self, one: Effect, values: np.ndarray) -> AxisModel:
        """The model with one more effect, which comes last."""
        return replace(self, effects=(*self.effects, one), values=np.concatenate([self.values, values]))

    def without(self, label: str) -> AxisModel:
        """The model without one of its effects."""
        kept = [k for k, one in enumerate(self.effects) if one.label != label]
        return replace(
            self,
            effects=tuple(self.effects[k] for k in kept),
            values=np.concatenate([self.values[: len(self.base)], *(self.parts[k] for k in kept)]),
        )

    def predicted(self, block: SpectralBlock) -> np.ndarray:
        """(n, n_y) outputs on the lines of a block."""
        raise NotImplementedError

    def steps(self) -> np.ndarray:
        """(p,) steps of the central differences."""
        raise NotImplementedError

    def answer(self, block: SpectralBlock, body: None = None, derivative: bool = True, inner: None = None) -> Driven:
        """Predicted outputs (n, n_y, 1) on the lines of a block, and their derivatives (p, n, n_y, 1)."""
        Y, dY = self.predicted(block), []
        if derivative:
            dY = central_differences(lambda x: replace(self, values=x).predicted(block), self.values, self.steps())
        return Driven(Y[:, :, None], np.reshape(dY, (len(dY), *Y.shape, 1)))

    def contributions(self, block: SpectralBlock) -> np.ndarray:
        """(n, n_y, 1) part of the prediction that may have a relative error, constant over a band: all of it.
        Departures of a real force from its law are distortion."""
        return self.answer(block, None, False).Y


@dataclass(frozen=True, eq=False)
class MassModel(AxisModel):
    """Model with M, d and, for an oscillator, k; see the module."""

    lines: Lines

    def _force(self, one: Effect, p: np.ndarray, block: SpectralBlock) -> tuple[np.ndarray, np.ndarray]:
        """(shapes, n, 3) forces of an effect on the lines of a block, and their linear parts (shapes, n)."""
        by = tuple(map(float, p[len(one.shapes) :]))
        own = np.array([self.lines.pick(self.lines.of(shape, by), block.name) for shape in one.shapes])
        if self.lines.solves_for == "force" or one.location == "input":
            return own, np.zeros(own.shape[:2])
        return own, np.array(
            [
                alpha + 1j * beta * block.omega
                for alpha, beta in (self.lines.linear_part(shape, by) for shape in one.shapes)
            ]
        )

    def answer(self, block: SpectralBlock, body: None = None, derivative: bool = True, inner: None = None) -> Driven:
        n, s, around, several = len(self.base), 1j * block.omega, self.lines.around(block.omega), self.parts
        A, V, Q, F = (
            self.lines.pick(one, block.name) for one in (self.lines.A, self.lines.V, self.lines.Q, self.lines.F)
        )
        regressors = (A, V, Q)[:n]
        Z = sum(x * s ** (2 - k) for k, x in enumerate(self.values[:n]))
        R = sum(x * one for x, one in zip(self.values, regressors, strict=False))
        P, forces = np.ones(around.shape, complex), {}
        for one, p in zip(self.effects, several, strict=True):
            if one.shapes:
                own, linear = forces[one.label] = self._force(one, p, block)
                R, Z = R + np.tensordot(p[: len(own)], own, 1), Z + p[: len(own)] @ linear
            if one.dynamics:
                Z, R = Z + one.dynamics(s, p), R + one.dynamics(around, p) * Q
            if one.path:
                P = P * one.path(around, p)
        drive, f = self.lines.solves_for == "force", summed(P * F - R)
        D = -P[:, 1] if drive else Z
        Y = summed(F if drive else Q) + f / D
        if not derivative:
            return Driven(Y[:, None, None], np.empty((0, len(s), 1, 1)))

        def force(column: np.ndarray, z: np.ndarray | float = 0.0) -> np.ndarray:
            return -summed(column) / D - (0.0 if drive else f / D**2 * z)

        dY = [force(one, s ** (2 - k)) for k, one in enumerate(regressors)]
        for one, p in zip(self.effects, several, strict=True):
            c = p[: len(one.shapes)]
            if one.shapes:
                dY += [force(*both) for both in zip(*forces[one.label], strict=True)]
            for h in np.diag(p * [q.step for q in one.parameters])[len(c) :] if one.shapes else ():
                up, down = (self._force(one, p + step, block) for step in (h, -h))
                dY.append(force(*(np.tensordot(c, a - b, 1) / (2 * h.sum()) for a, b in zip(up, down, strict=True))))
            if one.dynamics:
                dY += [
                    force(slope * Q, z)
                    for slope, z in zip(slopes(one.dynamics, around, p), slopes(one.dynamics, s, p), strict=True)
                ]
            if one.path:
                dP = [P / one.path(around, p) * slope for slope in slopes(one.path, around, p)]
                dY += [summed(slope * F) / D + (f / D**2 * slope[:, 1] if drive else 0.0) for slope in dP]
        return Driven(Y[:, None, None], np.array(dY)[:, :, None, None])


@dataclass(frozen=True, eq=False)
class Problem:
    """A base model at its initial values, with the effects that it may lack.

    noise : noise power on the held-out lines over that of the response; None if it cannot be estimated. notes :
    sentences on the data. units : of {F} and {x}, and names of input and output. ratios : function from values by name
    to derived quantities with units. plain : base model data that a simulation needs.
    """

    kind: str
    model: AxisModel
    effects: Sequence[Effect]
    noise: float | None
    notes: tuple[str, ...]
    units: Mapping[str, str]
    ratios: Ratios = lambda values: {}
    plain: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def library(self) -> list[Effect]:
        """Effects that may be named."""
        return [one for one in self.effects if not one.outside]

    @cached_property
    def unnamed(self) -> list[Effect]:
        """Functions that represent whatever the library lacks."""
        return [one for one in self.effects if one.outside]


def sizes(model: AxisModel, at: Sequence[int]) -> np.ndarray:
    """Parameter values that change the prediction by as much as the whole response, r.m.s. over the fitted lines."""
    power, total = np.zeros(len(at)), 0
    for block in model.lines.fitted.blocks:
        dY = model.answer(block).dY[list(at)]
        scale = float(np.sqrt(np.mean(np.abs(block.Y) ** 2)))
        power += np.sum(np.abs(dY / scale) ** 2, axis=(1, 2, 3))
        total += block.Y.size
    return 1 / np.sqrt(np.maximum(power / total, 1e-300))


def added_priors(model: AxisModel, settings: AxisSettings = SETTINGS) -> Priors:
    """Priors of the parameters of a model's last effect, or of the base of a model without effects, about their initial
    values. They are so wide that they hardly move the estimate, but they count in the evidence: a factor of e, or as
    much as the whole response."""
    names, parameters = model.names, model.base
    if model.effects:
        names, parameters = model.effects[-1].names, model.effects[-1].parameters
    n, linear = len(model.values), np.array([p.linear for p in parameters], bool)
    return Priors(
        names,
        np.where(linear, 0.0, model.values[-len(names) :]),
        np.where(linear, sizes(model, range(n - len(names), n)), settings.shape_spread),
        ~linear,
        np.array([p.low for p in parameters]),
        np.array([p.high for p in parameters]),
    )
