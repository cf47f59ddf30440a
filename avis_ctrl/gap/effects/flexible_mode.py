"""Flexible modes of the payload: one, two or three in addition to its rigid-body motion."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from avis_ctrl.gap.effects.base import SETTINGS as LIBRARY
from avis_ctrl.gap.effects.base import Effect, EffectParameter, Reported, Table, Values, register
from avis_ctrl.gap.effects.impedance import paths, peaks
from avis_ctrl.gap.effects.sensors import receptance, second_order
from avis_ctrl.gap.operators import AddedCoordinate, Operators, mount_geometry
from avis_ctrl.gap.score import Score, reduction
from avis_ctrl.gap.starting_values import SETTINGS, Seed
from avis_ctrl.gap.table_model import ActiveEffect, TableModel

# Number of modes by variant.
COUNTS = {"": 1, "two": 2, "three": 3}


@register
class PayloadFlexibleMode(Effect):
    """Modes of the payload in addition to its rigid-body motion, with mass-normalised shapes at the mount points.

    Motors and sensors sit in the isolators and move with these points. The modal coordinate e of each mode obeys e'' +
    2 z w e' + w^2 e = sum of shape times force, including the forces of the mounts.
    """

    name = "payload_flexible_mode"
    title = "a flexible mode of the payload"
    looks_like = "resonances above those of the suspension, each with one mode shape for all drives and sensors"
    holds_states = True

    def titled(self, place: str) -> str:
        variant = place.partition("/")[2]
        return f"{variant} flexible modes of the payload" if variant else self.title

    def places(self, model: Table) -> tuple[str, ...]:
        return ("payload", "payload/two", "payload/three") if shape_points(model) else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        names = mount_geometry(model.rig).names
        driven = np.any(shape_rows(model.rig, model.actuators, model.sensors.names)[0], axis=0)
        damping = LIBRARY.mode_damping
        found: list[EffectParameter] = []
        for k in range(COUNTS[place.partition("/")[2]]):
            of, of_mode = ("", "of the mode") if k == 0 else (f"_{k + 1}", f"of mode {k + 1}")
            found += [
                EffectParameter.shape(
                    f"frequency{of}_Hz", "Hz", f"{of_mode}, free", 3.0, 400.0, 20.0, np.geomspace(*SETTINGS.mode_Hz)
                ),
                EffectParameter.shape(
                    f"damping{of}", "1", f"damping ratio {of_mode}", *damping, 0.02, (0.02,), optional=True
                ),
            ]
            for name, own in zip(names, driven, strict=True):
                words, short = f"mass-normalised shape {of_mode} at {name}", f"shape{of}_{name.replace('.', '_')}"
                found.append(EffectParameter(short, "1/sqrt(kg)", words, 0.0, -1.0, 1.0, 0.01, optional=not own))
        return tuple(found)

    def implausible(self, values: Values, std: Values) -> str:
        broad = any(damping > 0.999 * LIBRARY.mode_damping[1] for _, damping, _ in modes(values))
        return "a mode so strongly damped that it is no resonance" if broad else ""

    def priors(self, model: Table, place: str, values: Values) -> dict[str, tuple[float, float]]:
        """Where no motor acts, a shape has the size that it has elsewhere.

        The mounts' stiffness at these points also acts on the mode: its contribution to w^2 and 2 z w cannot be
        separated from the mode's own values, and forces on the payload do not reveal one combination of these shapes.
        """
        found: dict[str, tuple[float, float]] = {}
        parameters = self.parameters(model, place)
        own = len(parameters) // COUNTS[place.partition("/")[2]]
        for k in range(0, len(parameters), own):
            shape = parameters[k + 2 : k + own]
            size = np.sqrt(np.mean(np.square([values[one.name] for one in shape if not one.optional])))
            found |= {one.name: (0.0, max(float(size), SETTINGS.smallest_shape)) for one in shape if one.optional}
        return found

    def change(self, ops: Operators, place: str, values: Values) -> None:
        at_actuators, at_sensors = shape_rows(ops.base.rig, ops.base.actuators, ops.base.sensors.names)
        for frequency, zeta, shape in modes(values):
            if np.any(shape):
                stiffness = second_order(ops.s, frequency, zeta)
                ops.added.append(AddedCoordinate(stiffness, shape, at_actuators @ shape, at_sensors @ shape))

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Residues over all paths at the frequencies that reduce chi-square most; the shape is their symmetric part of
        rank one. Further modes start from the fitted ones (`extended_models`)."""
        return _one_mode(score, ()) if COUNTS[place.partition("/")[2]] == 1 else []

    def extended_models(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """Add one mode where the residual of the fitted ones is largest."""
        more = {count: place for place in self.places(score.model) for count in [COUNTS[place.partition("/")[2]]]}
        place = more.get(COUNTS[one.place.partition("/")[2]] + 1)
        found = _one_mode(score, [frequency for frequency, *_ in modes(one.by_name)]) if place else []
        return [(place, (*one.values, *found[0].values))] if place and found else []

    def reported(self, model: Table, place: str, values: Values, covariance: np.ndarray) -> dict[str, Reported]:
        """The modes in order of frequency: first the frequencies of all, then the damping ratios, then the shapes."""
        found = list(super().reported(model, place, values, covariance).items())
        own = len(found) // COUNTS[place.partition("/")[2]]
        each = sorted((found[k : k + own] for k in range(0, len(found), own)), key=lambda mode: mode[0][1].value)
        ordered = zip((name for name, _ in found), (value for mode in each for _, value in mode), strict=True)
        kinds = ("frequency", "damping", "shape")
        return dict(sorted(ordered, key=lambda named: kinds.index(named[0].partition("_")[0])))


def modes(values: Values) -> list[tuple[float, float, np.ndarray]]:
    """(frequency [Hz], damping ratio, shape (n_g,)) of each mode."""
    numbers, count = np.array(list(values.values())), sum(name.startswith("frequency") for name in values)
    return [(float(own[0]), float(own[1]), own[2:]) for own in np.split(numbers, count)]


def shape_points(model: Table) -> bool:
    """Whether every motor and sensor sits in a mount, aligned with an earth axis."""
    find = getattr(model.rig, "mount_of", None)
    return find is not None and all(find(name) for name in (*model.actuators, *model.sensors.names))


def shape_rows(rig: Any, actuators: Sequence[str], sensors: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """(n_u, n_g) and (n_y, n_g): mount and axis of each motor and of each sensor, with its sign."""
    return _shape_rows(
        tuple(map(rig.nearest_mount, actuators)), tuple(map(rig.nearest_mount, sensors)), mount_geometry(rig).names
    )


@lru_cache(maxsize=16)
def _shape_rows(
    actuators: tuple[tuple[str, float], ...], sensors: tuple[tuple[str, float], ...], mounts: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    at_actuators, at_sensors = np.zeros((len(actuators), len(mounts))), np.zeros((len(sensors), len(mounts)))
    for found, channels in ((at_actuators, actuators), (at_sensors, sensors)):
        for k, (mount, sign) in enumerate(channels):
            found[k, mounts.index(mount)] = sign
    return at_actuators, at_sensors


def resonance(score: Score) -> float:
    """Reduction of chi-square by one mode with free residues on every path."""
    return max(reduction(G, b).chi2 for G, b in _searched_modes(score)[1])


def _searched_modes(score: Score) -> tuple[list[tuple[float, float]], list[tuple[np.ndarray, np.ndarray]]]:
    """Frequency and damping ratio of every mode searched, with the Gram matrix of its paths and their product with the
    residual."""
    if "trials" not in score.kept:
        frequencies = np.geomspace(*SETTINGS.mode_Hz).tolist()
        tried = [(f, 0.02) for f in frequencies]
        tried += [(f, zeta) for f in peaks(score) if f > frequencies[0] for zeta in (0.005, 0.02)]
        kept = [paths(score, partial(receptance, frequency_Hz=f, damping=zeta)) for f, zeta in tried]
        score.kept["trials"] = tried, [(A @ A.T, A @ score.e) for A in kept]
    return score.kept["trials"]


def _one_mode(score: Score, beside: Sequence[float]) -> list[Seed]:
    """Single modes away from the given frequencies [Hz], the best first."""
    at, products = _searched_modes(score)
    found = []
    for (f, zeta), (G, b) in zip(at, products, strict=True):
        if all(abs(np.log(f / other)) > SETTINGS.modes_apart for other in beside):
            took = reduction(G, b)
            if seed := _seed(score.model, f, zeta, took.coefficients, took.chi2, len(at)):
                found.append(seed)
    return sorted(found, key=lambda seed: -seed.chi2)


def _seed(model: TableModel, f: float, zeta: float, residues: np.ndarray, chi2: float, trials: int) -> Seed | None:
    """Seed of a mode from residues (n_y n_u,); None if their sign allows no real shape."""
    at_actuators, at_sensors = shape_rows(model.rig, model.actuators, model.sensors.names)
    # Q = a_s a_u^T with both from one shape; its size is that of the best rank-one approximation.
    U, sigma, Vt = np.linalg.svd(residues.reshape(len(at_sensors), -1))
    shape = at_actuators.T @ Vt[0]
    sign, size = float(U[:, 0] @ (at_sensors @ shape)), float(np.sum((at_sensors @ shape) ** 2))
    if sign <= 0 or size == 0:
        return None
    values = f, zeta, *(shape * np.sqrt(sigma[0] * sign / size))
    share = sigma[0] ** 2 / float(np.sum(sigma**2))
    return Seed(tuple(float(v) for v in values), chi2 * float(share), len(residues), trials)
