"""A table whose mass, damping and stiffness matrices are linear in the parameters to be estimated.

    M(theta) q'' + C(theta) q' + K(theta) q = T u,     M(theta) = M0 + sum over j of theta_j M_j, C and K likewise

The state of Rademakers' filter (TU/e 2005, eq. 3.3) is (q, q', theta) with theta' = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class LinearModelSettings:
    """linearity : nonlinearity of a matrix, relative to its largest entry, that counts as round-off when all
    parameters change by a fifth [1]: a product of two parameters then deviates by a few per cent."""

    linearity: float = 1e-9


SETTINGS = LinearModelSettings()


class LinearModel(NamedTuple):
    """The matrices as linear functions of the parameters.

    names, values : n_p parameters and their starting values. constant : (3, n_q, n_q), the parts of M, C and K that do
        not depend on them. slopes : (3, n_q, n_q, n_p). T : (n_q, n_u), N/V and N m/V. H : (n_y, 2 n_q), measurements
        of (q, q').
    """

    names: tuple[str, ...]
    values: np.ndarray
    constant: np.ndarray
    slopes: np.ndarray
    T: np.ndarray
    H: np.ndarray

    @property
    def n_q(self) -> int:
        """Number of coordinates."""
        return len(self.T)

    def matrices(self, theta: np.ndarray) -> np.ndarray:
        """(3, n_q, n_q) M, C, K at (n_p,) parameters."""
        return self.constant + self.slopes @ theta

    def system(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (2 n_q, 2 n_q) and B (2 n_q, n_u) of x' = A x + B u."""
        (M, C, K), n = self.matrices(theta), self.n_q
        lower = np.linalg.solve(M, np.hstack([-K, -C, self.T]))
        return np.vstack([np.eye(n, 2 * n, n), lower[:, : 2 * n]]), np.vstack([0 * self.T, lower[:, 2 * n :]])


def source_parameters(rig: Rig) -> tuple[str, ...]:
    """The parameters of eq. 3.11 by their names here: mass, principal inertias, and every c and k of the isolators
    except those of isolator 1 along x (26 with four isolators).

    Raises
    ------
    InputError : a rig without parameters of these names.
    """
    known = rig.parameters()
    isolators = range(1, 1 + sum(name.endswith(".k_x") for name in known))
    names = [
        "mass",
        "J1",
        "J2",
        "J3",
        *(f"isolator{i}.{kind}_{axis}" for kind in "ck" for i in isolators for axis in "xyz" if (i, axis) != (1, "x")),
    ]
    if missing := [name for name in names if name not in known]:
        raise InputError(
            f"the rig {rig.name} has no {', '.join(missing)}: name the parameters to be estimated",
            field="names",
            value=None,
        )
    return tuple(names)


def linear_model(
    rig: Rig,
    names: Sequence[str],
    measurements: Sequence[str] | None = None,
    actuators: Sequence[str] | None = None,
    motion: str = "velocity",
) -> LinearModel:
    """The model of a rig in the parameters `names`.

    Parameters
    ----------
    measurements, actuators : sensors and actuators of the records, by default all, in the rig's order.
    motion : what is measured along the sensors' axes, "velocity" or "displacement".

    Raises
    ------
    InputError : unknown or repeated names; a parameter on which M, C or K do not depend linearly, or not at all, or
        which also affects the actuators or sensors; a starting value that is not positive.
    """
    names = tuple(names)
    if len(set(names)) < len(names):
        raise InputError("expected each parameter once", field="names", value=list(names))
    rig.with_parameters(dict.fromkeys(set(names) - set(rig.parameters()), 1.0))  # raises with the nearest name
    model = ResponseModel.of(rig, names, "m/s", measurements, actuators)
    known, slopes, theta = model.matrices, model.derivative_matrices, model.values
    for name, value, *of in zip(names, theta, *slopes, strict=True):
        M, C, K, _, _, T, R = (np.any(one) for one in of)
        if not value > 0:
            raise InputError(
                "expected a positive starting value: the filter's prior is a fraction of it", field=name, value=value
            )
        if T or R:
            raise InputError(
                "this parameter also moves actuators or sensors; the filter takes those as known and "
                "estimates parameters of M, C and K only",
                field="names",
                value=name,
            )
        if not (M or C or K):
            raise InputError("M, C and K do not depend on this parameter", field="names", value=name)
    of_body = np.moveaxis(np.array(slopes[:3]), 1, -1)
    constant, moved = np.array(known[:3]) - of_body @ theta, np.array(model.at(1.2 * theta).matrices[:3])
    size = SETTINGS.linearity * np.max(np.abs(moved), axis=(1, 2), keepdims=True)
    if np.any(np.abs(moved - constant - of_body @ (1.2 * theta)) > size):
        raise InputError(
            "M, C and K must be linear in the parameters of this filter; they are not linear in these",
            field="names",
            value=list(names),
        )
    rows = np.hstack([np.zeros_like(known.R), known.R])
    return LinearModel(names, theta, constant, of_body, known.T, rows if motion == "velocity" else np.roll(rows, 6, 1))
