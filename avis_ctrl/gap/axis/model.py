"""A mass with what may be missing from it, as the likelihood of the table takes a model.

With R = M s^2 q + d s q + k q + forces and Z = M s^2 + d s + k + inner dynamics, P the path from force to mass:

    drive:       F = R / P                     oscillator:   q = q_measured + (P F - R)/Z

The second is P F / Z but for what a window spills, which R holds exactly. Both are linear in the forces' coefficients.
The linear part of a force, alpha q + beta v at the level of the record, belongs to Z as well: without it the force
would predict the noise of the very q that it is computed from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.axis.records import Lines, Shape
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings
from avis_ctrl.identification.priors import Priors
from avis_ctrl.identification.spectral_block import SpectralBlock

Curve = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Parameter:
    """unit : with {F} and {x} for those of force and position. A linear one begins at zero; another one, positive,
    where the effect's seeds begin, within its range."""

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    linear: bool = True


@dataclass(frozen=True, eq=False)
class Effect:
    """What a model of one axis may lack.

    name, location : as reported. title : what is missing, in words. separated_by : the measurement that tells it from
    effects that predict the same. shapes : forces, functions of the motion, one for each of the first parameters.
    dynamics : (s, p) added to Z. path : (s, p) factor of the path from force to mass. channel : (s, p) factor of one
    channel of a sensor. seeds : values where a fit may begin. law : variant of the effect. outside : a function without
    a name, which stands for whatever the library does not hold. fixed : values of the law, with units. derived : what
    is reported in the place of the parameters. implausible : (p) why physics forbids values; empty where it does not.
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
    outside: bool = False
    fixed: dict[str, tuple[float, str]] = field(default_factory=dict)
    derived: Callable[[np.ndarray], dict[str, tuple[float, str]]] | None = None
    implausible: Callable[[np.ndarray], str] | None = None

    @property
    def label(self) -> str:
        return f"{self.name}@{self.location}" + (f"/{self.law}" if self.law else "")

    @property
    def key(self) -> str:
        return f"{self.name}@{self.location}"

    def begins(self) -> list[np.ndarray]:
        return [np.array(one) for one in self.seeds] or [np.zeros(len(self.parameters))]


@dataclass(frozen=True, eq=False)
class Answer:
    """Y (n, n_y, 1) and its derivatives dY (p, n, n_y, 1)."""

    Y: np.ndarray
    dY: np.ndarray


def split(values: np.ndarray, effects: Sequence[Effect], base: int) -> list[np.ndarray]:
    """Values of each effect."""
    found, at = [], base
    for one in effects:
        found.append(values[at:at + len(one.parameters)])
        at += len(one.parameters)
    return found


def slopes(curve: Curve, s: np.ndarray, p: np.ndarray) -> list[np.ndarray]:
    """Derivative of a curve by each of its parameters, by central differences."""
    found = []
    for j in range(len(p)):
        h = np.zeros(len(p))
        h[j] = 1e-5 * abs(p[j]) or 1e-6 / float(np.max(np.abs(s)))
        found.append((curve(s, p + h) - curve(s, p - h)) / (2 * h[j]))
    return found


@dataclass(frozen=True, eq=False)
class AxisModel:
    """base : names and units of the base model's parameters, the first one positive."""

    lines: Any
    base: tuple[tuple[str, str], ...]
    effects: tuple[Effect, ...]
    values: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        return (*(name for name, _ in self.base), *(f"{p.name}@{one.label}" for one in self.effects
                                                    for p in one.parameters))

    @property
    def units(self) -> tuple[str, ...]:
        return (*(unit for _, unit in self.base), *(p.unit for one in self.effects for p in one.parameters))

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(one.label for one in self.effects)

    def of(self, effect: Effect) -> np.ndarray:
        """Values of an effect."""
        return split(self.values, self.effects, len(self.base))[self.effects.index(effect)]

    def at(self, values: np.ndarray) -> AxisModel:
        if not np.all(np.isfinite(values)):
            raise InputError("expected finite values", field="values")
        return replace(self, values=np.asarray(values, float))

    def with_effect(self, one: Effect, values: np.ndarray) -> AxisModel:
        return replace(self, effects=(*self.effects, one), values=np.concatenate([self.values, values]))

    def without(self, label: str) -> AxisModel:
        parts = split(self.values, self.effects, len(self.base))
        kept = [k for k, one in enumerate(self.effects) if one.label != label]
        return replace(self, effects=tuple(self.effects[k] for k in kept),
                       values=np.concatenate([self.values[:len(self.base)], *(parts[k] for k in kept)]))

    def answer(self, block: SpectralBlock, body: None = None, derivative: bool = True) -> Answer:
        raise NotImplementedError

    def contributions(self, block: SpectralBlock) -> np.ndarray:
        """(n, n_y, 1): what may have a relative error that is constant over a band: the whole prediction. What no law
        of a force holds exactly is distortion."""
        return self.answer(block, None, False).Y

    def columns(self, block: SpectralBlock, derivative: bool = True) -> np.ndarray:
        return self.answer(block, None, derivative).dY


@dataclass(frozen=True, eq=False)
class MassModel(AxisModel):
    """M, d and, of an oscillator, k; see the module."""

    lines: Lines

    def _parts(self, block: SpectralBlock) -> dict[str, Any]:
        pick, name, s = self.lines.pick, block.name, 1j * block.omega
        regressors = [pick(one, name) for one in (self.lines.A, self.lines.V, self.lines.Q)[:len(self.base)]]
        Z = sum(x * s ** (2 - k) for k, x in enumerate(self.values[:len(self.base)]))
        R = sum(x * one for x, one in zip(self.values, regressors, strict=False))
        q, P, found = pick(self.lines.Q, name), np.ones(len(s), complex), []
        for one, p in zip(self.effects, split(self.values, self.effects, len(self.base)), strict=True):
            own = [pick(self.lines.of(shape), name) for shape in one.shapes]
            R = R + sum((c * column for c, column in zip(p, own, strict=False)), np.zeros(len(s)))
            linear = [np.zeros(len(s), complex)] * len(own)
            if self.lines.solves_for == "position" and one.location != "input":
                linear = [alpha + beta * s for alpha, beta in map(self.lines.linear_part, one.shapes)]
                Z = Z + sum((c * part for c, part in zip(p, linear, strict=False)), np.zeros(len(s)))
            if one.dynamics:
                added = one.dynamics(s, p)
                Z, R = Z + added, R + added * q
            if one.path:
                P = P * one.path(s, p)
            found.append((one, p, own, linear))
        return {"s": s, "Z": Z, "R": R, "P": P, "q": q, "regressors": regressors, "effects": found,
                "F": pick(self.lines.F, name)}

    def answer(self, block: SpectralBlock, body: None = None, derivative: bool = True) -> Answer:
        a = self._parts(block)
        drive, s = self.lines.solves_for == "force", a["s"]
        f = a["P"] * a["F"] - a["R"]
        Y = a["R"] / a["P"] if drive else a["q"] + f / a["Z"]
        if not derivative:
            return Answer(Y[:, None, None], np.empty((0, len(s), 1, 1)))

        def force(column: np.ndarray, z: np.ndarray | float = 0.0) -> np.ndarray:
            return column / a["P"] if drive else -column / a["Z"] - f / a["Z"] ** 2 * z
        dY = [force(one, s ** (2 - k)) for k, one in enumerate(a["regressors"])]
        for one, p, own, linear in a["effects"]:
            dY += [force(*both) for both in zip(own, linear, strict=True)]
            for slope in slopes(one.dynamics, s, p) if one.dynamics else ():
                dY.append(force(slope * a["q"], slope))
            for slope in slopes(one.path, s, p) if one.path else ():
                P = one.path(s, p)
                dY.append(-Y * slope / P if drive else a["P"] / P * slope * a["F"] / a["Z"])
        return Answer(Y[:, None, None], np.array(dY)[:, :, None, None])


def base_priors(model: AxisModel, positive: Sequence[bool], settings: AxisSettings = SETTINGS) -> Priors:
    """Of the base model's parameters, so wide that they bend nothing: a factor of e, or as much as the whole
    response."""
    v = model.values[:len(model.base)]
    size = sizes(model, list(range(len(v))))
    up = np.asarray(positive, bool)
    return Priors(tuple(name for name, _ in model.base), np.where(up, v, 0.0),
                  np.where(up, settings.shape_spread, size), up)


def sizes(model: AxisModel, at: Sequence[int]) -> np.ndarray:
    """Values of parameters that change the prediction by as much as the whole response, r.m.s. over fitted lines."""
    power, total = np.zeros(len(at)), 0
    for block in model.lines.fitted.blocks:
        dY = model.columns(block)[list(at)]
        scale = float(np.sqrt(np.mean(np.abs(block.Y) ** 2)))
        power += np.sum(np.abs(dY / scale) ** 2, axis=(1, 2, 3))
        total += block.Y.size
    return 1 / np.sqrt(np.maximum(power / total, 1e-300))


def effect_priors(model: AxisModel, settings: AxisSettings = SETTINGS) -> Priors:
    """Of the last effect of a model, at its start."""
    one = model.effects[-1]
    n = len(one.parameters)
    start, linear = model.values[-n:], np.array([p.linear for p in one.parameters], bool)
    size = sizes(model, list(range(len(model.values) - n, len(model.values))))
    return Priors(tuple(f"{p.name}@{one.label}" for p in one.parameters), np.where(linear, 0.0, start),
                  np.where(linear, size, settings.shape_spread), ~linear, np.array([p.low for p in one.parameters]),
                  np.array([p.high for p in one.parameters]))
