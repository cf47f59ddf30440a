"""A table whose mass, damping and stiffness matrices are linear in the parameters to be estimated.

    M(theta) q'' + C(theta) q' + K(theta) q = T u,     M(theta) = M0 + sum over j of theta_j M_j, C and K likewise

The state of Rademakers' filter (TU/e 2005, eq. 3.3) is (q, q', theta) with theta' = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.identification.ekf_kernel import ModelArrays
from avis_ctrl.rigs.rig import Rig

AXES = ("x", "y", "z")
# Relative change of the matrices' slope over a step of 20 % that still counts as linear: round-off.
LINEARITY = 1e-9


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The matrices by parameter.

    Attributes
    ----------
    names, values : n_p parameters and where they start.
    M0, C0, K0 : (n_q, n_q) what the parameters do not act on. dM, dC, dK : (n_q, n_q, n_p).
    T : (n_q, n_u), N/V and N m/V. H : (n_y, 2 n_q), measurements of (q, q').
    """

    names: tuple[str, ...]
    values: np.ndarray
    M0: np.ndarray
    C0: np.ndarray
    K0: np.ndarray
    dM: np.ndarray
    dC: np.ndarray
    dK: np.ndarray
    T: np.ndarray
    H: np.ndarray

    def __post_init__(self) -> None:
        n_q, n_p = np.shape(self.M0)[0], len(self.names)
        n_u, n_y = np.shape(self.T)[-1], np.shape(self.H)[0]
        shapes = {"values": (n_p,), "M0": (n_q, n_q), "C0": (n_q, n_q), "K0": (n_q, n_q), "dM": (n_q, n_q, n_p),
                  "dC": (n_q, n_q, n_p), "dK": (n_q, n_q, n_p), "T": (n_q, n_u), "H": (n_y, 2 * n_q)}
        for field, shape in shapes.items():
            array = np.ascontiguousarray(getattr(self, field), float)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise InputError(f"expected finite numbers of shape {shape}", field=field, value=array.shape)
            object.__setattr__(self, field, array)

    @property
    def n_q(self) -> int:
        return self.M0.shape[0]

    def matrices(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M, C, K at (n_p,) parameters."""
        return self.M0 + self.dM @ theta, self.C0 + self.dC @ theta, self.K0 + self.dK @ theta

    def derivative(self, x: np.ndarray, theta: np.ndarray, u: np.ndarray) -> np.ndarray:
        """f(x, theta, u), (2 n_q,): x' of eq. 3.1 (theta' is zero)."""
        M, C, K = self.matrices(theta)
        q, v = np.split(np.asarray(x), 2)
        return np.concatenate([v, np.linalg.solve(M, self.T @ u - C @ v - K @ q)])

    def jacobian(self, x: np.ndarray, theta: np.ndarray, u: np.ndarray) -> np.ndarray:
        """F of eq. 3.6, (2 n_q + n_p square), states ordered (q, q', theta)."""
        M, C, K = self.matrices(theta)
        n, n_p = self.n_q, len(self.names)
        q, v = np.split(np.asarray(x), 2)
        a = np.linalg.solve(M, self.T @ u - C @ v - K @ q)
        moved = np.einsum("ijp,j->ip", self.dM, a) + np.einsum("ijp,j->ip", self.dC, v) + \
            np.einsum("ijp,j->ip", self.dK, q)
        F = np.zeros((2 * n + n_p, 2 * n + n_p), dtype=a.dtype)
        F[:n, n:2 * n] = np.eye(n)
        F[n:2 * n] = -np.linalg.solve(M, np.hstack([K, C, moved]))
        return F

    def system(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (2 n_q, 2 n_q) and B (2 n_q, n_u) of x' = A x + B u."""
        M, C, K = self.matrices(theta)
        n = self.n_q
        lower = np.linalg.solve(M, np.hstack([-K, -C, self.T]))
        return np.vstack([np.eye(n, 2 * n, n), lower[:, :2 * n]]), np.vstack([0 * self.T, lower[:, 2 * n:]])

    def arrays(self, G: np.ndarray | None = None, decay: float = 1.0) -> ModelArrays:
        """For the compiled loop; G (n_q, n_f) and decay of a disturbance, by default none."""
        G = np.zeros((self.n_q, 0)) if G is None else G
        H = np.hstack([self.H, np.zeros((len(self.H), G.shape[1]))])
        return ModelArrays(self.M0, self.C0, self.K0, self.dM, self.dC, self.dK, self.T, H, G, decay)


def source_parameters(rig: Rig) -> tuple[str, ...]:
    """The parameters of eq. 3.11 by our names: mass, principal inertias, and every c and k of the isolators except
    those of isolator 1 along x (26 with four isolators).

    Raises
    ------
    InputError : a rig that does not name its parameters so.
    """
    known = rig.parameters()
    isolators = range(1, 1 + sum(name.endswith(".k_x") for name in known))
    names = ["mass", "J1", "J2", "J3", *(f"isolator{i}.{kind}_{axis}" for kind in "ck" for i in isolators
                                         for axis in AXES if (i, axis) != (1, "x"))]
    if missing := [name for name in names if name not in known]:
        raise InputError(f"the rig {rig.name} has no {', '.join(missing)}: name the parameters to be estimated",
                         field="names", value=None)
    return tuple(names)


def linear_model(rig: Rig, names: Sequence[str], measurements: Sequence[str] | None = None,
                 actuators: Sequence[str] | None = None, motion: str = "velocity") -> LinearModel:
    """The model of a rig in the parameters `names`, from differences of its matrices.

    Parameters
    ----------
    measurements, actuators : sensors and actuators of the records, by default all, in the rig's order.
    motion : what is measured along the sensors' axes, "velocity" or "displacement".

    Raises
    ------
    InputError : unknown or repeated names, a parameter on which M, C or K do not depend linearly, or on which they do
        not depend at all, or which also moves the actuators or sensors; a start that is not positive.
    """
    names = tuple(names)
    _check_names(rig, names)
    eom = rig.equations_of_motion()
    sensors, rows = rig.sensor_rows()
    picked = places(sensors if measurements is None else measurements, sensors, "the rig has", "y names")
    driven = places(eom.actuators if actuators is None else actuators, eom.actuators, "the rig has", "u names")
    values = np.array([rig.parameters()[name].value for name in names], float)
    slopes = np.zeros((3, 6, 6, len(names)))
    for j, name in enumerate(names):
        slopes[..., j] = _slope(rig, name, values[j])
    M0, C0, K0 = np.array([eom.M, eom.C, eom.K]) - slopes @ values
    dM, dC, dK = slopes
    H = np.zeros((len(picked), 12))
    H[:, 6:] = rows[picked]
    if motion == "displacement":
        H = np.roll(H, 6, axis=1)
    return LinearModel(names, values, M0, C0, K0, dM, dC, dK, eom.T[:, driven], H)


def _check_names(rig: Rig, names: tuple[str, ...]) -> None:
    known = rig.parameters()
    for name in names:
        if names.count(name) > 1:
            raise InputError("each parameter once", field="names", value=name)
        if name not in known:
            rig.with_parameters({name: 1.0})  # refuses, with the nearest name
        if not known[name].value > 0:
            raise InputError("expected a positive starting value: the filter's prior is a share of it",
                             field=name, value=known[name].value)


def _slope(rig: Rig, name: str, value: float) -> np.ndarray:
    """(3, 6, 6) derivative of M, C, K by one parameter, the same over 20 % either way."""
    rows = rig.sensor_rows()[1]
    eom = rig.equations_of_motion()
    seen = []
    for factor in (0.8, 1.2):
        moved = rig.with_parameters({name: factor * value})
        there = moved.equations_of_motion()
        if not (np.array_equal(there.T, eom.T) and np.array_equal(moved.sensor_rows()[1], rows)):
            raise InputError("this parameter also moves actuators or sensors; the filter takes those as known and "
                             "estimates parameters of M, C and K only", field="names", value=name)
        difference = np.array([there.M - eom.M, there.C - eom.C, there.K - eom.K])
        seen.append(difference / ((factor - 1) * value))
    size = np.max(np.abs(seen))
    if size == 0:
        raise InputError("M, C and K do not depend on this parameter", field="names", value=name)
    # Each of the three against its own round-off: their units differ.
    for one, other, matrix in zip(*seen, (eom.M, eom.C, eom.K), strict=True):
        allowed = LINEARITY * (np.max(np.abs(one)) + np.max(np.abs(matrix)) / value)
        if np.max(np.abs(one - other)) > allowed:
            raise InputError("M, C and K must be linear in the parameters of this filter; in this one they are not",
                             field="names", value=name)
    return (seen[0] + seen[1]) / 2
