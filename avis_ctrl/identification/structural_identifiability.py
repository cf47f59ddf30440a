"""Parameters that no data can determine: null space of the equations, scalings, and groups of parameters.

A direction of the parameters that changes no response of the model cannot be identified from any record of these inputs
and outputs. There are two kinds. Some parameters enter the matrices only through sums (two springs in one line), which
gives directions with integer entries in the parameters' units. The other kind are scalings: multiplying mass,
stiffness, damping and force constants by a common factor changes no response, which gives a direction with integer
exponents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from avis_ctrl.identification.response import ResponseModel, size_of
from avis_ctrl.identification.sparse_space import components, reduced_rows, sparse_rows, whole_numbers


@dataclass(frozen=True)
class StructureSettings:
    """zero : singular value, relative to the largest, below which it counts as zero [1]; the derivative is exact to
    about 1e-12."""

    zero: float = 1e-9


SETTINGS = StructureSettings()


@dataclass(frozen=True, eq=False)
class Scaling:
    """Parameters that can be multiplied by f^exponent each, for any factor f, without a change of any response.

    exponents : (n_p,) integers, 0 for parameters that it does not change. pin : a parameter whose value fixes the
        scale.
    """

    exponents: np.ndarray
    pin: int


@dataclass(frozen=True, eq=False)
class Group:
    """Parameters that are determined only together.

    members : indices. unseen : (d, n_p) directions in the parameters' units that change no response.
    seen : (members - d, n_p) weights of the combinations that can be determined, in the parameters' units.
    """

    members: tuple[int, ...]
    unseen: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True, eq=False)
class Structure:
    """Parts of a null space: scalings with their pins, groups given the pins, and singles determined given the pins."""

    scalings: tuple[Scaling, ...]
    groups: tuple[Group, ...]
    singles: tuple[int, ...]


def structural_null_space(model: ResponseModel, floor: bool = False) -> np.ndarray:
    """(n_p, d) orthonormal, relative: directions that change no response of the model at any frequency.

    Computed from the derivative of the response, which has double poles: with six coordinates, 40 lines are more than
    its numerator has coefficients. floor : whether to include the response to a measured floor.
    """
    modes = model.rig.equations_of_motion().natural_frequencies().frequencies_Hz
    lines = 2 * np.pi * np.geomspace(0.2 * max(np.min(np.abs(modes)), 1e-3), 8 * np.max(np.abs(modes)), 40)
    inputs = len(model.inputs) if floor else len(model.actuators)
    U = np.broadcast_to(np.eye(len(model.inputs), dtype=complex)[:, :inputs], (40, len(model.inputs), inputs))
    found = model.driven(lines, U)
    level = np.sqrt(np.mean(np.abs(found.Y) ** 2, axis=1, keepdims=True))
    J = (found.dY / np.where(level > 0, level, 1.0)).reshape(len(model.names), -1)
    J = np.concatenate([J.real, J.imag], axis=1) * model.scales()[:, None]
    norm = np.linalg.norm(J, axis=1)
    acting = norm > SETTINGS.zero * norm.max(initial=0.0)
    unit = J / np.where(acting, norm, 1.0)[:, None]
    unit[~acting] = 0.0
    # The singular values and left singular vectors of the wide matrix are those of this small factor.
    small = np.asarray(np.linalg.qr(unit.T, mode="r")).T
    left, sizes, _ = np.linalg.svd(small)
    sizes = np.concatenate([sizes, np.zeros(len(unit) - len(sizes))])
    null = left[:, sizes <= SETTINGS.zero * sizes.max(initial=0.0)] / np.where(acting, norm, 1.0)[:, None]
    return la.orth(null) if null.size else null


def structure_of(
    null: np.ndarray, values: np.ndarray, units: Sequence[str], names: Sequence[str], tolerance: float = 1e-6
) -> Structure:
    """Parts of a null space (n_p, d), given in relative units.

    tolerance : threshold of a zero entry, relative to the largest entry of a vector.
    """
    scale = size_of(values)
    scalings = _scalings(null, values, units, names, tolerance)
    scalings = _pinned(null, scalings, names, tolerance)
    rest = _without(null, [one.pin for one in scalings])
    rows = sparse_rows(rest, tolerance) if rest.shape[1] else np.zeros((0, len(values)))
    groups = []
    for members, columns in components(rows):
        part = rows[np.ix_(members, columns)]
        unseen, seen = np.zeros((len(members), len(values))), np.zeros((len(columns) - len(members), len(values)))
        unseen[:, columns] = part * scale[columns]
        if len(seen):
            seen[:, columns] = sparse_rows(la.null_space(part), tolerance) / scale[columns]
        groups.append(Group(tuple(columns), _whole(unseen), _whole(seen)))
    taken = {j for group in groups for j in group.members} | {one.pin for one in scalings}
    return Structure(scalings, tuple(groups), tuple(j for j in range(len(values)) if j not in taken))


def _whole(rows: np.ndarray) -> np.ndarray:
    return np.array([whole_numbers(row) for row in rows]).reshape(rows.shape)


def _scalings(
    null: np.ndarray, values: np.ndarray, units: Sequence[str], names: Sequence[str], tolerance: float
) -> tuple[Scaling, ...]:
    """Scalings in the null space, with one exponent per kind of parameter (its unit); two kinds or more."""
    # Sensors first: of scalings with equally many kinds, the one without sensors is preferred.
    kinds = sorted({(not name.startswith("sensor."), unit) for name, unit in zip(names, units, strict=True)})
    member = np.array(
        [
            [float((not name.startswith("sensor."), unit) == kind and value != 0) for kind in kinds]
            for name, unit, value in zip(names, units, values, strict=True)
        ]
    )
    length = np.linalg.norm(member, axis=0)
    inside = length > 0
    outside = member[:, inside] / length[inside]
    _, sizes, Vh = np.linalg.svd(outside - null @ (null.T @ outside))
    lost = Vh[np.concatenate([sizes, np.zeros(len(Vh) - len(sizes))]) < max(tolerance, 1e-7) * 10]
    if not len(lost):
        return ()
    rows = [whole_numbers(row) for row in sparse_rows((lost / length[inside]).T, tolerance)]
    return tuple(Scaling(member[:, inside] @ _signed(row), -1) for row in rows if np.count_nonzero(row) > 1)


def _signed(row: np.ndarray) -> np.ndarray:
    """The row with the sign for which more kinds are multiplied than divided."""
    return row if np.sum(np.sign(row)) > 0 or (np.sum(np.sign(row)) == 0 and row[-1] > 0) else -row


def _pinned(
    null: np.ndarray, scalings: tuple[Scaling, ...], names: Sequence[str], tolerance: float
) -> tuple[Scaling, ...]:
    """Pin of each scaling: the parameter whose knowledge leaves the fewest entries in the remaining null space."""
    pins: list[int] = []
    found = []
    for k, scaling in enumerate(scalings):
        best: tuple[tuple[int, int, int], int] | None = None
        for j in np.flatnonzero(scaling.exponents).tolist():
            exponents = np.array([[one.exponents[i] for i in [*pins, j]] for one in scalings[: k + 1]])
            if abs(np.linalg.det(exponents)) < 1e-9:
                continue
            left = reduced_rows(_without(null, [*pins, j]), tolerance)
            liking = 0 if names[j].rpartition(".")[2] == "mass" or names[j].startswith("sensor.") else 1
            rank = (int(np.count_nonzero(left)), liking, j)
            if best is None or rank < best[0]:
                best = rank, j
        if best is not None:
            pins.append(best[1])
            found.append(Scaling(scaling.exponents, best[1]))
    return tuple(found)


def _without(null: np.ndarray, pins: Sequence[int]) -> np.ndarray:
    """The part of the null space that does not change the pins."""
    if not pins or not null.shape[1]:
        return null
    return null @ la.null_space(null[list(pins)], rcond=1e-9)
