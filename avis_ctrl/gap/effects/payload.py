"""What a model may lack of the payload: where its mass is, what bends, what is attached or tied to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from avis_ctrl.gap.effects.base import Effect, EffectParameter, Seed, register
from avis_ctrl.gap.effects.impedance import at_points, positions, project, residues
from avis_ctrl.gap.effects.sensors import receptance, second_order
from avis_ctrl.gap.operators import AddedCoordinate, mount_geometry
from avis_ctrl.gap.score_algebra import reduction
from avis_ctrl.rigs.rigid_body import point_map

if TYPE_CHECKING:
    from avis_ctrl.gap.operators import Operators
    from avis_ctrl.gap.score import Score
    from avis_ctrl.gap.table_model import TableModel

PRODUCTS = {"Jxy": "J12", "Jxz": "J13", "Jyz": "J23"}
REACH_m = 2.0  # how far from the geometric centre something can be fixed to a payload


@register
class ComOffset(Effect):
    """Centre of mass beside where the rig file has it; parallel-axis terms included (equations.md)."""

    name = "com_offset"
    title = "the centre of mass is not where the model has it"
    looks_like = "coupling between translations and rotations, at every frequency above the resonances too"
    confusable = ("product_of_inertia", "sensor_misalignment", "cable_stiffness")

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload",) if "com_x" in model.rig.parameters() else ()

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"offset_{axis}_m", "m", f"centre of mass beyond the model's along {axis}", 0.0,
                                     -0.5, 0.5, 0.05) for axis in "xyz")

    def rig_changes(self, model: TableModel, place: str, values: Mapping[str, float]) -> dict[str, float]:
        known = model.rig.parameters()
        return {f"com_{axis}": known[f"com_{axis}"].value + values[f"offset_{axis}_m"] for axis in "xyz"}


@register
class ProductOfInertia(Effect):
    """One entry beside the diagonal of the inertia tensor about the centre of mass: J12 = -integral of x y dm."""

    name = "product_of_inertia"
    title = "a product of inertia of the payload"
    looks_like = "coupling between two rotations"
    confusable = ("com_offset", "payload_flexible_mode")

    def places(self, model: TableModel) -> tuple[str, ...]:
        return tuple(PRODUCTS) if "J12" in model.rig.parameters() else ()

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        known = model.rig.parameters()
        largest = 0.9 * min(known[name].value for name in ("J1", "J2", "J3"))
        return (EffectParameter(f"{place}_kgm2", "kg m^2", "entry of the inertia tensor beyond the model's", 0.0,
                                -largest, largest, 0.1 * largest),)

    def rig_changes(self, model: TableModel, place: str, values: Mapping[str, float]) -> dict[str, float]:
        name = PRODUCTS[place]
        return {name: model.rig.parameters()[name].value + values[f"{place}_kgm2"]}


@register
class PayloadFlexibleMode(Effect):
    """A mode of the payload beside its rigid motion, mass-normalised shape over the mounts' points.

    Motors and sensors sit in the isolators and move with these points. The mode's own coordinate e obeys
    e'' + 2 z w e' + w^2 e = sum of shape times force, the forces of the mounts included.
    """

    name = "payload_flexible_mode"
    title = "the payload bends: a mode beside its rigid motion"
    looks_like = "a resonance above the suspension's, in rows and columns that share one shape"
    confusable = ("attached_oscillator", "mount_surge", "base_compliance")
    holds_states = True

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload",) if shape_points(model) is not None else ()

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        names = mount_geometry(model.rig).names
        driven = np.any(shape_rows(model.rig, model.actuators, model.sensors.names)[0], axis=0)
        grid = tuple(np.geomspace(7.0, 140.0, 22))
        return (EffectParameter("frequency_Hz", "Hz", "of the mode, free", 0.0, 3.0, 400.0, 20.0, False, grid),
                EffectParameter("damping", "1", "damping ratio of the mode", 0.0, 1e-4, 0.5, 0.02, False, (0.02,),
                                True),
                *(EffectParameter(f"shape_{name.replace('.', '_')}", "1/sqrt(kg)", f"mass-normalised shape at {name}",
                                  0.0, -1.0, 1.0, 0.01, optional=not own, group="shape")
                  for name, own in zip(names, driven, strict=True)))

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        shape = np.array(list(values.values())[2:])
        if not np.any(shape):
            return
        at_actuators, at_sensors = shape_rows(ops.base.rig, ops.base.actuators, ops.base.sensors.names)
        ops.added.append(AddedCoordinate(second_order(ops.s, values["frequency_Hz"], values["damping"]), shape,
                                         at_actuators @ shape, at_sensors @ shape))


    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Residues over all paths at each frequency, of which the symmetric part of rank one is the shape."""
        model, found = score.model, []
        frequency, damping = self.parameters(model, place)[:2]
        at_actuators, at_sensors = shape_rows(model.rig, model.actuators, model.sensors.names)
        for f in frequency.grid:
            for zeta in damping.grid:
                took, Q = residues(score, partial(receptance, frequency_Hz=f, damping=zeta))
                # Q = a_s a_u^T with both from one shape: alternate between the two for the best of rank one.
                U, sigma, Vt = np.linalg.svd(Q)
                shape = at_actuators.T @ Vt[0]
                sign = float(U[:, 0] @ (at_sensors @ shape))
                size = float(np.sum((at_sensors @ shape) ** 2))
                if sign <= 0 or size == 0:
                    continue
                shape = shape * np.sqrt(sigma[0] * sign / size)
                share = float(sigma[0] ** 2 / np.sum(sigma ** 2))
                found.append(Seed((f, zeta, *shape), took.chi2 * share, took.rank))
        return sorted(found, key=lambda seed: -seed.chi2)


def shape_points(model: TableModel) -> bool | None:
    """Whether every motor and sensor sits in a mount, along an earth axis; None where not."""
    try:
        shape_rows(model.rig, model.actuators, model.sensors.names)
    except (KeyError, AttributeError):
        return None
    return True


def shape_rows(rig, actuators: Sequence[str], sensors: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """(n_u, n_g) and (n_y, n_g): which mount and axis each motor and each sensor sits in."""
    order = {name: k for k, name in enumerate(mount_geometry(rig).names)}
    motors = {motor.name: f"isolator{motor.isolator}.{motor.axis}" for motor in rig.motors}
    g = rig.geophones
    places = {name: f"isolator{i}.{axis}" for name, i, axis in zip(g.names, g.isolator, g.axis, strict=True)}
    return (np.eye(len(order))[[order[motors[name]] for name in actuators]],
            np.eye(len(order))[[order[places[name]] for name in sensors]])


class _AtPoint(Effect):
    """Something at a point of the payload."""

    def position(self) -> tuple[EffectParameter, ...]:
        return tuple(EffectParameter(f"{axis}_m", "m", f"its place along {axis}, from the geometric centre", 0.0,
                                     -REACH_m, REACH_m, 0.2, False, grid)
                     for axis, grid in zip("xyz", ((-0.4, 0.0, 0.4), (-0.3, 0.0, 0.3), (-0.15, 0.25)), strict=True))


def place_of(values: Mapping[str, float]) -> np.ndarray:
    return np.array([values.get(f"{axis}_m", 0.0) for axis in "xyz"])


@register
class AttachedOscillator(_AtPoint):
    """A mass m on a spring and damper at a point: m s^2 (2 z w s + w^2)/(s^2 + 2 z w s + w^2) along its rows."""

    name = "attached_oscillator"
    title = "a sprung mass on the payload"
    looks_like = "a pair of peak and dip at its own frequency, in every channel that moves its place"
    confusable = ("payload_flexible_mode", "mount_surge", "base_compliance")
    holds_states = True

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload/z", "payload/xyz", "payload/x", "payload/y")

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        mass = model.rig.mounted_body().mass
        frequencies = tuple(np.geomspace(1.2, 90.0, 28))
        axes = place.partition("/")[2]
        across = [one for one in self.position() if axes == "xyz" or one.name != f"{axes}_m"]
        return (EffectParameter("mass_kg", "kg", "sprung mass", 0.0, 0.0, mass, 0.01 * mass),
                EffectParameter("frequency_Hz", "Hz", "of the mass on its spring", 0.0, 0.3, 300.0, 10.0, False,
                                frequencies),
                EffectParameter("damping", "1", "damping ratio", 0.0, 1e-3, 2.0, 0.05, False, (0.05,), True),
                *across)

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        h = oscillator(ops.s, values["frequency_Hz"], values["damping"])
        axes = ["xyz".index(axis) for axis in place.partition("/")[2]]
        Z = values["mass_kg"] * ops.s ** 2 * h
        rows = point_map(place_of(values))[axes]
        ops.add_impedance(np.repeat(Z[:, None], len(axes), axis=1), rows)
        ops.inner.append(h[:, None, None] * rows.T)


    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Over frequency, damping and a grid of places; the mass follows."""
        model, found = score.model, []
        parameters = self.parameters(model, place)
        axes = place.partition("/")[2]
        points = positions(parameters)
        for f in parameters[1].grid:
            for zeta in (0.03, 0.15):
                G, b = project(score, partial(sprung, frequency_Hz=f, damping=zeta),
                               (f, zeta))
                along = at_points(points, axes).sum(1)
                mass = along @ b / np.einsum("pi,ij,pj->p", along, G, along)
                chi2 = mass * (along @ b)
                k = int(np.argmax(np.where(mass > 0, chi2, -np.inf)))
                if mass[k] > 0:
                    at = [points[k]["xyz".index(one.name[0])] for one in parameters[3:]]
                    found.append(Seed((min(float(mass[k]), 0.5 * parameters[0].high), f, zeta, *at), float(chi2[k]),
                                      1 + len(at)))
        return sorted(found, key=lambda seed: -seed.chi2)


def oscillator(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """Force of a sprung mass over the force of the same mass fixed, (n,)."""
    w = 2 * np.pi * frequency_Hz
    return (2 * damping * w * s + w ** 2) / second_order(s, frequency_Hz, damping)


def sprung(s: np.ndarray, frequency_Hz: float, damping: float) -> np.ndarray:
    """Dynamic stiffness of a sprung mass of 1 kg, (n,)."""
    return s ** 2 * oscillator(s, frequency_Hz, damping)


@register
class CableStiffness(_AtPoint):
    """A spring, with a little damping, from a point of the payload to the chassis: three axes, or one direction."""

    name = "cable_stiffness"
    title = "a cable or hose ties the payload to ground"
    looks_like = "stiffness at a place and height where no mount is: it shifts and couples the lowest resonances"
    confusable = ("com_offset", "leveling_loop")

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("payload/axes", "payload/oblique")

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        size = 0.02 * float(np.mean(np.diag(model.base.matrices.K)[:3])) / 4  # of one mount of four, on any rig
        most = 200 * size
        own = [EffectParameter(f"k_{axis}_N_per_m", "N/m", f"stiffness along {axis}", 0.0, 0.0, most, size)
               for axis in "xyz"]
        if place.endswith("oblique"):
            own += [EffectParameter(f"k_{axes}_N_per_m", "N/m", f"stiffness between {axes[0]} and {axes[1]}", 0.0,
                                    -most, most, size) for axes in ("xy", "xz", "yz")]
        return (*own, EffectParameter("damping_s", "s", "damping over stiffness", 0.0, 0.0, 0.1, 1e-3, False, (0.0,),
                                      True),
                *(replace(one, optional=True) for one in self.position()))

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        K = np.diag([values[f"k_{axis}_N_per_m"] for axis in "xyz"])
        for axes in ("xy", "xz", "yz"):
            i, j = "xyz".index(axes[0]), "xyz".index(axes[1])
            K[i, j] = K[j, i] = values.get(f"k_{axes}_N_per_m", 0.0)
        k, V = np.linalg.eigh(K)
        rows = V.T @ point_map(place_of(values))
        Z = k * (1 + ops.s * values["damping_s"])[:, None]
        ops.add_impedance(Z, rows, Z)

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Over a grid of places; the stiffnesses follow, those that come out negative at zero."""
        model, found = score.model, []
        parameters = self.parameters(model, place)
        points = positions(parameters)
        G, b = project(score, lambda s: np.ones_like(s))
        n_k = 6 if place.endswith("oblique") else 3
        basis = at_points(points, "xyz", oblique=n_k == 6)
        for point, rows in zip(points, basis, strict=True):
            A, d = rows @ G @ rows.T, rows @ b
            k = reduction(A, d).coefficients
            own = k.copy()
            own[:3] = np.maximum(own[:3], 0.0)
            chi2 = float(2 * own @ d - own @ A @ own)
            if np.any(own[:3] > 0):
                found.append(Seed((*np.clip(own, [one.low for one in parameters[:n_k]],
                                            [one.high for one in parameters[:n_k]]).tolist(), 0.0, *point), chi2,
                                  n_k + 3))
        return sorted(found, key=lambda seed: -seed.chi2)

    def implausible(self, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        if "k_xy_N_per_m" not in values:
            return ""
        K = np.diag([values[f"k_{axis}_N_per_m"] for axis in "xyz"])
        for axes in ("xy", "xz", "yz"):
            K["xyz".index(axes[0]), "xyz".index(axes[1])] = K["xyz".index(axes[1]), "xyz".index(axes[0])] = values[
                f"k_{axes}_N_per_m"]
        least = float(np.linalg.eigvalsh(K)[0])
        slack = 3 * max((std[f"k_{axis}_N_per_m"] for axis in "xyz"), default=0.0)
        return f"a cable with a negative stiffness, {least:.3g} N/m" if least < -slack - 1e-3 * K.max() else ""

