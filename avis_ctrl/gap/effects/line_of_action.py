"""Elements along one direction at a point of the payload: the best direction, and the reported quantities.

The parameters are a point and a = d sqrt(size), with the direction d and a size (mass or stiffness) that cannot be
negative. The position along the line of action has no effect; its foot is reported, the point nearest to the geometric
centre.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from avis_ctrl.gap.effects.base import Reported, Values
from avis_ctrl.gap.effects.impedance import at_points, springs_along
from avis_ctrl.gap.starting_values import SETTINGS


@cache
def directions() -> np.ndarray:
    """(n, 3) directions over a hemisphere."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi / 2, SETTINGS.polar),
        np.linspace(0, 2 * np.pi, SETTINGS.around, endpoint=False),
        indexing="ij",
    )
    every = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    return np.unique(np.round(every.reshape(-1, 3), 12), axis=0)


def best_direction(G: np.ndarray, b: np.ndarray, points: np.ndarray) -> tuple[float, int, np.ndarray, float]:
    """(chi2, point index, direction (3,), size) with the largest reduction of chi-square; points (n, 3)."""
    basis = at_points(points, "xyz", oblique=True)
    d = basis @ b
    A = basis @ G @ np.swapaxes(basis, 1, 2)
    every = directions()
    V = springs_along(every)
    along = d @ V.T
    size = A.reshape(len(A), -1) @ (V[:, :, None] * V[:, None, :]).reshape(len(V), -1).T
    mass = np.where(size > 0, along / np.where(size > 0, size, 1.0), 0.0)
    chi2 = np.where(mass > 0, mass * along, 0.0)
    k, v = np.unravel_index(int(np.argmax(chi2)), chi2.shape)
    return float(chi2[k, v]), int(k), every[v], float(mass[k, v])


def along(values: Values) -> np.ndarray:
    """(3,) a = d sqrt(size); zero for an effect without this parameter."""
    return np.array([values.get(f"along_{axis}", 0.0) for axis in "xyz"])


def reported_line(values: Values, covariance: np.ndarray, size: str, unit: str) -> dict[str, Reported]:
    """Size, direction and foot of the line of action from the values along_x .. and x_m .., to first order."""
    names = list(values)
    first, last = names.index("along_x"), names.index("x_m")
    rows = [*range(first, first + 3), *range(last, last + 3)]
    x = np.array([values[names[row]] for row in rows])
    line = of_line(x)
    slope = np.array(
        [
            (of_line(x + step) - of_line(x - step)) / (2 * np.abs(step).max())
            for step in np.eye(6) * 1e-6 * max(float(np.abs(x[:3]).max()), 1e-3)
        ]
    ).T
    std = np.sqrt(np.maximum(np.diag(slope @ covariance[np.ix_(rows, rows)] @ slope.T), 0.0))
    labels = [(size, unit), *((f"direction_{axis}", "1") for axis in "xyz"), *((f"{axis}_m", "m") for axis in "xyz")]
    return {name: Reported(float(v), float(s), u) for (name, u), v, s in zip(labels, line, std, strict=True)}


def foot(values: Values) -> np.ndarray:
    """(3,) m: the point of the line of action nearest to the geometric centre, from the values along_x .. and x_m .."""
    names = (*(f"along_{axis}" for axis in "xyz"), *(f"{axis}_m" for axis in "xyz"))
    return of_line(np.array([values[name] for name in names]))[4:]


def of_line(x: np.ndarray) -> np.ndarray:
    """(7,) size, direction with its largest component positive, and foot, from x = [d sqrt(size), point] (6,)."""
    a, point = x[:3], x[3:]
    mass = float(a @ a)
    d = a / np.sqrt(mass) * np.sign(a[np.argmax(np.abs(a))])
    return np.concatenate([[mass], d, point - (point @ d) * d])
