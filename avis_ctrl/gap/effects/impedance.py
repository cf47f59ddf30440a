"""First looks at what acts on the payload at a point that is not known: all places at once.

Whatever is tied to the payload at p along an axis a adds the dynamic stiffness f(s) g g^T with g = e_a^T [I, -S(p)]: a
combination of the 21 symmetric unit matrices. Their directions are projected once for each f; any place is then a
product with a 21 x 21 matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter
from avis_ctrl.gap.score_algebra import Reduction, reduction, symmetric_coordinates
from avis_ctrl.rigs.rigid_body import point_map

if TYPE_CHECKING:
    from avis_ctrl.gap.score import Score

# Places looked at along x, y, z [m], from the geometric centre: over and around a table.
GRID_m = (np.linspace(-0.6, 0.6, 7), np.linspace(-0.5, 0.5, 6), np.linspace(-0.3, 0.4, 4))


def positions(parameters: Sequence[EffectParameter]) -> np.ndarray:
    """(n, 3) m; a coordinate that is no parameter stays zero."""
    free = {one.name for one in parameters}
    axes = [grid if f"{axis}_m" in free else np.zeros(1) for axis, grid in zip("xyz", GRID_m, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def at_points(points: np.ndarray, axes: str, oblique: bool = False) -> np.ndarray:
    """(n, len(axes) or 6, 21): unit springs at each place along each axis, with oblique between the axes too."""
    return _at_points(points.tobytes(), axes, oblique)


@lru_cache(maxsize=16)
def _at_points(points: bytes, axes: str, oblique: bool) -> np.ndarray:
    found = []
    for point in np.frombuffer(points).reshape(-1, 3):
        G = point_map(point)
        pairs = [("xyz".index(a),) * 2 for a in axes] + ([(0, 1), (0, 2), (1, 2)] if oblique else [])
        found.append([symmetric_coordinates(np.outer(G[i], G[j]) if i == j else np.outer(G[i], G[j]) + np.outer(
            G[j], G[i])) for i, j in pairs])
    return np.array(found)


def project(score: Score, dynamic: Callable[[np.ndarray], np.ndarray], key: Hashable = None
            ) -> tuple[np.ndarray, np.ndarray]:
    """Gram matrix (21, 21) and product with the residual (21,) of the unit matrices times dynamic(s).

    key : under which the score keeps them for the next one who asks.
    """
    if key is not None and key in score.kept:
        return score.kept[key]
    A = score.directions([part.by_impedance(dynamic(part.s[:, 0, 0])) for part in score.parts])
    found = A @ A.T, A @ score.e
    if key is not None:
        score.kept[key] = found
    return found


def recoils(score: Score, receptance: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(6, N): by each way in which a chassis can recoil, receptance (n,) [1/mass times displacement per force]."""
    columns = []
    for part in score.parts:
        made, answer = part.made, part.answer
        through = np.swapaxes(made.G, 0, 1)[:6] @ (made.z_pf[:, :, None] * made.ops.mounts.chassis)
        amount = part.s ** 2 * (made.M @ answer.x[:, :6]) * receptance(part.s[:, 0, 0])[:, None, None]
        seen = answer.left[:, :, :6] @ through
        columns.append(-np.moveaxis(seen[:, :, :, None] * amount[:, None], 2, 0))
    return score.directions(columns)


def residues(score: Score, receptance: Callable[[np.ndarray], np.ndarray]) -> tuple[Reduction, np.ndarray]:
    """Best residues (n_y, n_u) of a mode of that receptance over all paths, displacement per newton, without any tie
    between them."""
    columns = []
    for part in score.parts:
        ops, answer = part.made.ops, part.answer
        force = np.linalg.norm(ops.base.matrices.T[:3], axis=0)[:, None] * answer.volts
        n_y, n_u = len(ops.base.sensors.names), force.shape[1]
        seen = (answer.gain * answer.sense)[:, :, 0] * receptance(part.s[:, 0, 0])[:, None]
        out = np.zeros((n_y, n_u, *answer.Y.shape), complex)
        for i in range(n_y):
            out[i, :, :, i] = seen[:, i, None] * np.moveaxis(force, 1, 0)
        columns.append(out.reshape(n_y * n_u, *answer.Y.shape))
    A = score.directions(columns)
    took = reduction(A @ A.T, A @ score.e)
    return took, took.coefficients.reshape(n_y, n_u)
