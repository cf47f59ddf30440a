"""Rigid-body kinematics and the linear equations of motion of a body on a moving floor.

Coordinates q = (x, y, z, phi_x, phi_y, phi_z): displacement of the reference point in earth axes and
Tait-Bryan 3-2-1 angles; x and y horizontal, z up, right-handed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import ArrayLike

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace

COORDINATES = ("x", "y", "z", "phi_x", "phi_y", "phi_z")
# Standard acceleration of gravity [m/s^2] (CGPM 1901).
GRAVITY = 9.80665


def freeze(thing: object, **shapes: tuple[int, ...]) -> None:
    """Make fields of a frozen dataclass read-only float arrays. Raises InputError for another shape or numbers that
    are not finite."""
    for name, shape in shapes.items():
        array = np.array(getattr(thing, name), dtype=float)
        if array.shape != shape or not np.all(np.isfinite(array)):
            shown = array.tolist() if array.size <= 9 else array.shape
            raise InputError(f"expected finite numbers of shape {shape}", field=name, value=shown)
        array.setflags(write=False)
        object.__setattr__(thing, name, array)


def cross_matrix(r: ArrayLike) -> np.ndarray:
    """S(r), (3, 3), with S(r) a = r x a."""
    x, y, z = np.asarray(r)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def point_map(p: ArrayLike) -> np.ndarray:
    """G(p) = [I, -S(p)], (3, 6): displacement of the body-fixed point p [m] for a small motion q."""
    x, y, z = np.asarray(p)
    return np.array([[1.0, 0.0, 0.0, 0.0, z, -y], [0.0, 1.0, 0.0, -z, 0.0, x], [0.0, 0.0, 1.0, y, -x, 0.0]])


def tilt_row(direction: ArrayLike) -> np.ndarray:
    """(6,) apparent acceleration due to gravity, per unit of q, along a body-fixed unit direction d.

    A rotation phi changes d by phi x d. The sensor measures d . (a + g e_z), to which this adds g e_z . (phi x d).
    """
    x, y, _ = np.asarray(direction)
    return GRAVITY * np.array([0.0, 0.0, 0.0, y, -x, 0.0])


@dataclass(frozen=True)
class Modes:
    """Undamped natural frequencies [Hz], ascending, and mass-normalised shapes (columns).

    A negative frequency denotes a statically unstable mode that diverges at the rate 2 pi |f| [rad/s].
    """

    frequencies_Hz: np.ndarray
    shapes: np.ndarray


@dataclass(frozen=True, eq=False)
class EquationsOfMotion:
    """M q'' + C q' + K q = C_floor q_floor' + K_floor q_floor + T u.

    Parameters
    ----------
    M, C, K : (n, n), SI units of the coordinates.
    C_floor, K_floor : (n, n_floor).
    T : (n, n_u), N/V and N m/V.
    actuators : n_u names.
    coordinates, floor_coordinates : names of q and q_floor, out of `COORDINATES`.
    """

    M: np.ndarray
    C: np.ndarray
    K: np.ndarray
    C_floor: np.ndarray
    K_floor: np.ndarray
    T: np.ndarray
    actuators: tuple[str, ...]
    coordinates: tuple[str, ...] = COORDINATES
    floor_coordinates: tuple[str, ...] = COORDINATES

    def __post_init__(self) -> None:
        n, n_f, n_u = len(self.coordinates), len(self.floor_coordinates), len(self.actuators)
        shapes = {"M": (n, n), "C": (n, n), "K": (n, n), "C_floor": (n, n_f), "K_floor": (n, n_f), "T": (n, n_u)}
        freeze(self, **shapes)

    def natural_frequencies(self) -> Modes:
        """Modes of the undamped system with the floor and the actuators at rest."""
        stiffness = (self.K + self.K.T) / 2
        squares, shapes = la.eigh(stiffness, self.M)
        return Modes(np.sign(squares) * np.sqrt(np.abs(squares)) / (2 * np.pi), shapes)

    def restricted(self, coordinates: Sequence[str], floor: Sequence[str] | None = None) -> EquationsOfMotion:
        """Equations of some coordinates, the others locked to the earth (rows and columns deleted).

        `floor` : names of the floor coordinates that are kept, by default the same as `coordinates`.
        """
        keep = _indices(self.coordinates, coordinates)
        names = tuple(coordinates)
        floor_names = names if floor is None else tuple(floor)
        moved = np.ix_(keep, _indices(self.floor_coordinates, floor_names))
        square = np.ix_(keep, keep)
        return EquationsOfMotion(
            self.M[square],
            self.C[square],
            self.K[square],
            self.C_floor[moved],
            self.K_floor[moved],
            self.T[keep],
            self.actuators,
            names,
            floor_names,
        )

    def state_space(self, forces: bool = False) -> StateSpace:
        """State space in momentum form, which needs no derivative of the floor motion.

        States (q, p) with p = M q' - C_floor q_floor. Inputs: the actuators [V], then
        "floor_x" .. [m, rad], then, with `forces`, "force_x" .. [N, N m]: a generalised force on
        each coordinate. Outputs: "x" .. [m, rad] and "x_dot" .. [m/s, rad/s].
        """
        n, n_u = len(self.coordinates), len(self.actuators)
        n_d = n if forces else 0
        inverse = la.inv(self.M)
        damped = self.C @ inverse
        A = np.block([[np.zeros((n, n)), inverse], [-self.K, -damped]])
        pushed = np.hstack([self.T, self.K_floor - damped @ self.C_floor, np.eye(n, n_d)])
        carried = np.hstack([np.zeros((n, n_u)), inverse @ self.C_floor, np.zeros((n, n_d))])
        B = np.vstack([carried, pushed])
        C = np.block([[np.eye(n), np.zeros((n, n))], [np.zeros((n, n)), inverse]])
        D = np.vstack([np.zeros_like(carried), carried])
        inputs = (
            *self.actuators,
            *(f"floor_{name}" for name in self.floor_coordinates),
            *(f"force_{name}" for name in self.coordinates[:n_d]),
        )
        outputs = (*self.coordinates, *(f"{name}_dot" for name in self.coordinates))
        states = (*self.coordinates, *(f"p_{name}" for name in self.coordinates))
        return StateSpace(A, B, C, D, 0.0, inputs, outputs, states)


def _indices(names: Sequence[str], asked: Sequence[str]) -> list[int]:
    if len(set(asked)) != len(asked) or any(name not in names for name in asked) or not asked:
        raise InputError(f"expected different names out of {list(names)}", field="coordinates", value=list(asked))
    return [list(names).index(name) for name in asked]
