"""Actuator and sensor matrices: between physical channels and the logical axes x .. phi_z (Rademakers, A.4).

Built from geometry alone. Appendix A.4 itself is not in the text at hand; these are the kinematic relations that
section 2.1.1 says it was built from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES

# A logical axis counts as reached when the weakest combination has this share of the strongest.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class ActuatorAxes:
    """Voltages to generalised forces and back.

    matrix : (6, n_u) T, N/V and N m/V, all six coordinates.
    allocation : (n_u, n_axes) V per N or N m: the voltages of least Euclidean norm that make the
        force asked on `axes` and none on `quiet`.
    condition : condition number of the rows inverted, each scaled to unit length, so that it does
        not depend on units.
    """

    actuators: tuple[str, ...]
    axes: tuple[str, ...]
    quiet: tuple[str, ...]
    matrix: np.ndarray
    allocation: np.ndarray
    condition: float


@dataclass(frozen=True, eq=False)
class SensorAxes:
    """Displacements (or velocities) along the sensors to logical coordinates and back.

    matrix : (n_s, 6) from q to the sensors.
    decoding : (n_axes, n_s) least-squares inverse: logical coordinates `axes` from the sensors, blind
        to `resolved` coordinates that are not asked for.
    condition : condition number of the columns inverted, each scaled to unit length.
    """

    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    resolved: tuple[str, ...]
    matrix: np.ndarray
    decoding: np.ndarray
    condition: float


def actuator_axes(rig: Rig, axes: Sequence[str] = COORDINATES, actuators: Sequence[str] | None = None,
                  quiet: Sequence[str] | None = None) -> ActuatorAxes:
    """Allocation of forces on `axes` to the actuators (all of them by default).

    quiet : coordinates that must not be pushed; by default all the others.

    Raises
    ------
    InputError : unknown names, or axes that these actuators cannot push independently; it names the
        combination that is out of reach.
    """
    eom = rig.equations_of_motion()
    names = eom.actuators if actuators is None else tuple(actuators)
    columns = _positions(eom.actuators, names, "actuators")
    wanted = _positions(COORDINATES, axes, "axes")
    still = [name for name in COORDINATES if name not in axes] if quiet is None else list(quiet)
    rows = wanted + _positions(COORDINATES, still, "quiet")
    T = eom.T[:, columns]
    inverse, condition = _inverse(T[rows], rows, f"cannot be pushed independently by the actuators {list(names)}")
    return ActuatorAxes(names, tuple(axes), tuple(still), T, inverse[:, :len(wanted)], condition)


def sensor_axes(rig: Rig, axes: Sequence[str] = COORDINATES, sensors: Sequence[str] | None = None,
                resolved: Sequence[str] | None = None) -> SensorAxes:
    """Logical coordinates `axes` from the sensors (all of them by default).

    resolved : coordinates besides `axes` that the sensors also have to tell apart; by default all
        the others.

    Raises
    ------
    InputError : unknown names, or coordinates that these sensors cannot tell apart.
    """
    all_names, matrix = rig.sensor_rows()
    names = all_names if sensors is None else tuple(sensors)
    H = matrix[_positions(all_names, names, "sensors")]
    wanted = _positions(COORDINATES, axes, "axes")
    others = [name for name in COORDINATES if name not in axes] if resolved is None else list(resolved)
    columns = wanted + _positions(COORDINATES, others, "resolved")
    inverse, condition = _inverse(H[:, columns].T, columns, f"cannot be told apart by the sensors {list(names)}")
    return SensorAxes(names, tuple(axes), tuple(others), H, inverse.T[:len(wanted)], condition)


def _inverse(rows: np.ndarray, coordinates: list[int], complaint: str) -> tuple[np.ndarray, float]:
    """Right inverse of least norm of `rows` (n, m), and the condition number of its unit-length rows."""
    asked = [COORDINATES[k] for k in coordinates]
    lengths = np.linalg.norm(rows, axis=1)
    if np.any(lengths == 0):
        raise InputError(f"{asked[int(np.argmin(lengths))]} {complaint}", field="axes", value=asked)
    left, sizes, _ = np.linalg.svd(rows / lengths[:, None], full_matrices=True)
    if len(sizes) < len(asked) or sizes[-1] < RANK_TOLERANCE * sizes[0]:
        weak = [name for name, share in zip(asked, np.abs(left[:, -1]), strict=True) if share > 0.1]
        raise InputError(f"{' and '.join(weak)} {complaint}", field="axes", value=asked)
    return np.linalg.pinv(rows), float(sizes[0] / sizes[-1])


def _positions(names: Sequence[str], asked: Sequence[str], field: str) -> list[int]:
    if len(set(asked)) != len(asked) or any(name not in names for name in asked):
        raise InputError(f"expected different names out of {list(names)}", field=field, value=list(asked))
    return [list(names).index(name) for name in asked]
