"""Matrices between physical channels and the logical axes x .. phi_z (Rademakers, appendix A.4).

They follow from the geometry alone. Appendix A.4 was not available; these are the kinematic relations on which it is
based according to section 2.1.1.

If the channels do not span all six coordinates, the requested axes are driven (or measured) exactly, and the other
coordinates as little as the channels allow; rotations count as displacement, or force, at the edge. Sensors of absolute
motion take precedence. Position sensors measure the payload relative to the chassis: they help to separate other
coordinates from the requested ones, and measure an axis only if the other sensors cannot. Such an axis is called
"relative": its signal includes the motion of the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES


@dataclass(frozen=True)
class Reach:
    """What a set of channels can drive or measure.

    weakest : minimum singular value that counts, relative to the largest. Drawings give directions to about 0.005 rad;
        a coordinate that is driven or measured only through such a tilt is not intended.
    noise_band_Hz : band in which the sensors' noise is compared as velocity: that of a table's modes and loops.
    """

    weakest: float = 0.02
    noise_band_Hz: tuple[float, float] = (1.0, 30.0)


REACH = Reach()


@dataclass(frozen=True, eq=False)
class ActuatorAxes:
    """Voltages to generalised forces and back.

    matrix : (6, n_u) T, N/V and N m/V, all six coordinates.
    allocation : (n_u, n_axes) V per N or N m: the voltages of minimum Euclidean norm for a force on `axes`, with the
        minimum force on the other coordinates.
    condition : condition number of the inverted rows, each scaled to unit length, so that it does
        not depend on units.
    leftover : (n_others, n_axes) force on the other coordinates per force on `axes`, moments as forces at the edge;
        zero if the actuators span all six coordinates.
    """

    actuators: tuple[str, ...]
    axes: tuple[str, ...]
    matrix: np.ndarray
    allocation: np.ndarray
    condition: float
    leftover: np.ndarray


@dataclass(frozen=True, eq=False)
class SensorAxes:
    """Displacements (or velocities) along the sensors to logical coordinates and back.

    matrix : (n_s, 6) from q to the sensors.
    decoding : (n_axes, n_s) least-squares inverse, weighted with the sensors' noise: logical coordinates `axes` from
        the sensors, with minimum sensitivity to the other coordinates.
    condition : condition number of the inverted columns, each scaled to unit length.
    leftover : (n_axes, n_others) sensitivity to the other coordinates, rotations at the edge.
    relative : the axes that are measured relative to the chassis.
    inertial : (n_s,) True for sensors of absolute motion.
    """

    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    matrix: np.ndarray
    decoding: np.ndarray
    condition: float
    leftover: np.ndarray
    relative: tuple[str, ...]
    inertial: np.ndarray


def actuator_axes(rig: Rig, axes: Sequence[str] = COORDINATES, actuators: Sequence[str] | None = None) -> ActuatorAxes:
    """Allocation of forces on `axes` to the actuators (all of them by default).

    Raises
    ------
    InputError : unknown names, or axes that these actuators cannot drive independently, which the
        message names.
    """
    eom = rig.equations_of_motion()
    names = eom.actuators if actuators is None else tuple(actuators)
    T = eom.T[:, _positions(eom.actuators, names, "actuators")]
    wanted = _positions(COORDINATES, axes, "axes")
    others = [k for k in range(6) if k not in wanted]
    inverse, condition = _blind_inverse(
        T.T, wanted, others, rig.edge_m, f"cannot be pushed independently by the actuators {list(names)}"
    )
    arms = _arms(rig)
    leftover = (T[others] @ inverse.T) * arms[wanted] / arms[others][:, None]
    return ActuatorAxes(names, tuple(axes), T, inverse.T, condition, leftover)


def sensor_axes(rig: Rig, axes: Sequence[str] = COORDINATES, sensors: Sequence[str] | None = None) -> SensorAxes:
    """Logical coordinates `axes` from the sensors (all of them by default).

    Raises
    ------
    InputError : unknown names, or coordinates that these sensors cannot distinguish.
    """
    all_names, matrix = rig.sensor_rows()
    names = all_names if sensors is None else tuple(sensors)
    chosen = _positions(all_names, names, "sensors")
    H, channels = matrix[chosen], [rig.sensors()[k] for k in chosen]
    wanted = _positions(COORDINATES, axes, "axes")
    others = [k for k in range(6) if k not in wanted]
    inertial, noise = np.array([one.inertial for one in channels], bool), _noise(rig, chosen)
    complaint = f"cannot be distinguished by the sensors {list(names)}"
    alone = bool(np.all(inertial))
    absolute: list[int] = []
    if np.any(inertial):
        absolute = wanted if alone else _absolute(H[inertial], wanted, rig.edge_m, noise[inertial])
    relative = [k for k in wanted if k not in absolute]
    decoding, condition = np.zeros((len(wanted), len(names))), 1.0
    if absolute and alone:
        decoding, condition = _blind_inverse(H, wanted, others, rig.edge_m, complaint, noise)
    elif absolute:
        # Position sensors measure the absolute axes minus the floor motion, which adds unknowns.
        own = [H[:, k] * inertial for k in absolute]
        both = [H[:, k] for k in range(6) if k not in absolute]
        against = [H[:, k] * ~inertial for k in absolute]
        order = [*absolute, *(k for k in range(6) if k not in absolute), *absolute]
        rows = [wanted.index(k) for k in absolute]
        decoding[rows], condition = _blind_inverse(
            np.array([*own, *both, *against]).T,
            list(range(len(own))),
            list(range(len(own), len(order))),
            rig.edge_m,
            complaint,
            noise,
            order,
        )
    if relative:
        rows, least = [wanted.index(k) for k in relative], ~inertial
        part, worse = _blind_inverse(
            H[least], relative, [k for k in range(6) if k not in relative], rig.edge_m, complaint, noise[least]
        )
        decoding[np.array(rows)[:, None], np.flatnonzero(least)] = part
        condition = max(condition, worse)
    arms = _arms(rig)
    leftover = (decoding @ H[:, others]) * arms[wanted][:, None] / arms[others]
    return SensorAxes(
        names, tuple(axes), H, decoding, condition, leftover, tuple(COORDINATES[k] for k in relative), inertial
    )


def drivable(rig: Rig) -> tuple[str, ...]:
    """Coordinates that the actuators can drive independently; the others stay passive."""
    return _spanned(rig.equations_of_motion().T.T, rig.edge_m)


def sensed(rig: Rig) -> tuple[str, ...]:
    """Coordinates that the sensors can separate from all others, absolutely or relative to the chassis."""
    return _spanned(rig.sensor_rows()[1], rig.edge_m)


def _spanned(H: np.ndarray, edge_m: float) -> tuple[str, ...]:
    """Coordinates that lie in the row space of H (n, 6)."""
    _, sizes, V = np.linalg.svd(H * _edge_scale(edge_m), full_matrices=False)
    kept = V[sizes > REACH.weakest * sizes[0]]
    return tuple(name for k, name in enumerate(COORDINATES) if np.linalg.norm(kept[:, k]) > 1 - 0.5 * REACH.weakest**2)


def _absolute(H: np.ndarray, wanted: list[int], edge_m: float, noise: np.ndarray) -> list[int]:
    """The wanted axes that inertial sensors H (n, 6) measure with less than unit sensitivity to other coordinates."""
    found: list[int] = []
    scale = _edge_scale(edge_m)
    for k in wanted:
        asked = [*found, k]
        others = [j for j in range(6) if j not in asked]
        try:
            decoding, _ = _blind_inverse(H, asked, others, edge_m, "", noise)
        except InputError:
            continue
        leftover = (decoding @ H[:, others]) / scale[asked][:, None] * scale[others]
        if np.all(np.linalg.norm(leftover, axis=1) < 1):
            found = asked
    return found


def _noise(rig: Rig, chosen: list[int]) -> np.ndarray:
    """(n,) noise of each sensor as velocity, relative to the largest; ones if all are equal."""
    omega = 2 * np.pi * np.geomspace(*REACH.noise_band_Hz, 20)
    all_of, found = rig.sensors(), []
    for k in chosen:
        density = all_of[k].motion_density(rig.converter, rig.sample_rate_Hz)
        found.append(density * np.exp(-np.mean(np.log(np.abs(all_of[k].as_velocity(omega))))))
    relative = np.maximum(np.array(found) / max([*found, np.finfo(float).tiny]), 1e-3)
    return np.ones(len(found)) if np.all(relative > np.max(relative, initial=0.0) - 1e-9) else relative


def _edge_scale(edge_m: float) -> np.ndarray:
    """(6,) factors that convert columns for q into columns for displacements, rotations at the edge."""
    return np.array([1 / edge_m if name.startswith("phi") else 1.0 for name in COORDINATES])


def _arms(rig: Rig) -> np.ndarray:
    return 1 / _edge_scale(rig.edge_m)


def _blind_inverse(
    H: np.ndarray,
    wanted: list[int],
    others: list[int],
    edge_m: float,
    complaint: str,
    noise: np.ndarray | None = None,
    order: list[int] | None = None,
) -> tuple[np.ndarray, float]:
    """D (n_wanted, n) with D H = I on `wanted`, minimum response to `others` and, of these, minimum noise.

    H : (n, m), its columns the coordinates `order` (m,), by default all six.
    Also returns the condition number of the inverted columns, each scaled to unit length.
    """
    order = list(range(6)) if order is None else order
    scale = _edge_scale(edge_m)[order]
    columns = wanted + others
    if len(H) >= len(columns):
        lengths = np.linalg.norm(H[:, columns] * scale[columns], axis=0)
        sizes = np.linalg.svd(H[:, columns] * scale[columns], compute_uv=False)
        if np.all(lengths > 0) and sizes[-1] > REACH.weakest * sizes[0]:
            return _weighted(H[:, columns], len(wanted), noise)
    _require_reach(H * scale, wanted, [order[k] for k in wanted], complaint)
    # The part of the other columns that these channels distinguish from the wanted ones is zeroed; the rest remains.
    own, rest = H[:, wanted] * scale[wanted], H[:, others] * scale[others]
    basis = np.linalg.qr(own)[0]
    _, sizes, V = np.linalg.svd(rest - basis @ (basis.T @ rest), full_matrices=False)
    kept = V[sizes > REACH.weakest * np.linalg.svd(H * scale, compute_uv=False)[0]]
    separated = np.hstack([H[:, wanted], rest @ kept.T])
    return _weighted(separated, len(wanted), noise)


def _require_reach(H: np.ndarray, wanted: list[int], coordinates: list[int], complaint: str) -> None:
    """Raises InputError if a combination of the wanted columns of H, rotations at the edge, is too weak."""
    _, sizes, V = np.linalg.svd(H[:, wanted], full_matrices=True)
    there = int(np.sum(sizes > REACH.weakest * np.max(np.linalg.svd(H, compute_uv=False), initial=0.0)))
    if there < len(wanted):
        shares = np.linalg.norm(V[there:], axis=0)
        weak = [COORDINATES[k] for k, share in zip(coordinates, shares, strict=True) if share > 0.1]
        raise InputError(f"{' and '.join(weak)} {complaint}", field="axes", value=[COORDINATES[k] for k in coordinates])


def _weighted(columns: np.ndarray, n_wanted: int, noise: np.ndarray | None) -> tuple[np.ndarray, float]:
    """First rows of the minimum-noise left inverse of `columns` (n, m), and the condition number. noise : (n,)."""
    sizes = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)
    if noise is None or np.all(noise == 1):
        inverse = np.linalg.pinv(columns.T).T
    else:
        inverse = np.linalg.pinv(columns / noise[:, None]) / noise
    return inverse[:n_wanted], float(sizes[0] / sizes[-1])


def _positions(names: Sequence[str], asked: Sequence[str], field: str) -> list[int]:
    if len(set(asked)) != len(asked) or any(name not in names for name in asked):
        raise InputError(f"expected different names out of {list(names)}", field=field, value=list(asked))
    return [list(names).index(name) for name in asked]
