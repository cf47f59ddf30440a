"""Score tests of elements that act on the payload at an unknown point: all places at once.

An element attached to the payload at p along an axis a adds the dynamic stiffness f(s) g g^T with g = e_a^T [I, -S(p)]:
a combination of the 21 symmetric unit matrices. The directions of these are projected once for each f; any place then
costs one product with a 21 x 21 matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from itertools import combinations

import numpy as np

from avis_ctrl.gap.effects.base import EffectParameter
from avis_ctrl.gap.score import Score, symmetric_coordinates
from avis_ctrl.gap.starting_values import SETTINGS
from avis_ctrl.rigs.rigid_body import point_map

# Diagonal entries of a matrix in the six coordinates.
DIAGONAL = tuple((k, k) for k in range(6))


def place_grid() -> tuple[np.ndarray, ...]:
    """Places searched along x, y, z [m]."""
    return tuple(np.linspace(*one) for one in SETTINGS.places_m)


def positions(parameters: Sequence[EffectParameter]) -> np.ndarray:
    """Grid of places (n, 3) [m]; coordinates without a parameter are zero."""
    free = {one.name for one in parameters}
    axes = [grid if f"{axis}_m" in free else np.zeros(1) for axis, grid in zip("xyz", place_grid(), strict=True)]
    return grid_points(*axes)


def grid_points(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(n, 3) all points of a grid."""
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)


def about(point: np.ndarray, share: float) -> np.ndarray:
    """(27, 3) places around a point [m], this fraction of the grid step away along each axis, within the grid."""
    grids = place_grid()
    steps = [share * (grid[1] - grid[0]) * np.array([-1.0, 0.0, 1.0]) for grid in grids]
    near = point + grid_points(*steps)
    return np.clip(near, [grid[0] for grid in grids], [grid[-1] for grid in grids])


def at_points(points: np.ndarray, axes: str, oblique: bool = False) -> np.ndarray:
    """(n, len(axes) or 6, 21): unit springs at each place along each axis; with oblique, between the axes too."""
    return _at_points(points.tobytes(), axes, oblique)


def springs_along(d: np.ndarray) -> np.ndarray:
    """(n, 6) unit springs along directions (n, 3), in terms of those of `at_points(.., oblique=True)`."""
    return np.column_stack([d**2, *(d[:, i] * d[:, j] for i, j in combinations(range(3), 2))])


@lru_cache(maxsize=16)
def _at_points(points: bytes, axes: str, oblique: bool) -> np.ndarray:
    found = []
    pairs = [("xyz".index(a),) * 2 for a in axes] + (list(combinations(range(3), 2)) if oblique else [])
    for point in np.frombuffer(points).reshape(-1, 3):
        G = point_map(point)
        springs = (np.outer(G[i], G[j]) + (i != j) * np.outer(G[j], G[i]) for i, j in pairs)
        found.append([symmetric_coordinates(one) for one in springs])
    return np.array(found)


def project(score: Score, dynamic: Callable[[np.ndarray], np.ndarray], key: Hashable) -> tuple[np.ndarray, np.ndarray]:
    """Gram matrix (21, 21) of the unit matrices times dynamic(s), and their product with the residual (21,).

    key : under which the score caches them.
    """
    if key not in score.kept:
        A = unit_matrices(score, dynamic)
        score.kept[key] = A @ A.T, A @ score.e
    return score.kept[key]


def unit_matrices(score: Score, dynamic: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(21, N): directions of each symmetric unit matrix times dynamic(s)."""
    return score.directions([part.by_impedance(dynamic(part.s[:, 0, 0])) for part in score.parts])


def peaks(score: Score) -> tuple[float, ...]:
    """Frequencies [Hz] at which the residual power exceeds that of its neighbourhood most, strongest first.

    A lightly damped resonance that the model lacks causes a peak there, narrower than any grid.
    """
    if "peaks" in score.kept:
        return score.kept["peaks"]
    omega, power, start = [], [], 0
    for part in score.parts:
        n = len(part.block.omega)
        e = score.e[start : start + 2 * part.block.Y.size].reshape(2, n, -1)
        start += 2 * part.block.Y.size
        omega.append(part.block.omega)
        power.append(np.mean(e**2, axis=(0, 2)))
    f, P = np.concatenate(omega) / (2 * np.pi), np.concatenate(power)
    # Mean power in steps of frequency, relative to the median around each step.
    reach = SETTINGS.peak_reach
    step = np.floor(np.log(f) / SETTINGS.peak_step).astype(int)
    step -= step.min()
    count = np.bincount(step)
    occupied = count > 0
    mean = np.bincount(step, P)[occupied] / count[occupied]
    centre = np.exp(np.bincount(step, P * np.log(f))[occupied] / np.maximum(np.bincount(step, P)[occupied], 1e-300))
    about = np.array([np.median(mean[max(k - reach, 0) : k + reach + 1]) for k in range(len(mean))])
    found: list[float] = []
    for k in np.argsort(-mean / about):
        apart = all(abs(np.log(centre[k] / one)) > SETTINGS.peaks_apart for one in found)
        if apart and mean[k] > SETTINGS.peak_height * about[k]:
            found.append(float(centre[k]))
    score.kept["peaks"] = tuple(found[: SETTINGS.most_peaks])
    return score.kept["peaks"]


def recoils(
    score: Score, receptance: Callable[[np.ndarray], np.ndarray], entries: Sequence[tuple[int, ...]] = DIAGONAL
) -> np.ndarray:
    """(len(entries), N): directions of entries of a chassis' inverse mass matrix, which is symmetric; receptance of s
    (n,) is that of unit mass."""
    i, j = np.array(entries).T
    off = (i != j)[:, None, None, None]
    columns = []
    for part, (moved, force) in zip(score.parts, _through_chassis(score), strict=True):
        out, force = np.moveaxis(moved, 2, 0)[..., None], np.moveaxis(force, 1, 0)[:, :, None]
        both = out[i] * force[j] + off * out[j] * force[i]
        columns.append(both * receptance(part.s[:, 0, 0])[:, None, None])
    return score.directions(columns)


def recoil_of(score: Score, recoil: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(N,): direction of a recoil (n, 6, 6), displacement of the chassis per force on it, of s (n,)."""
    both = zip(score.parts, _through_chassis(score), strict=True)
    return score.directions([(moved @ recoil(part.s[:, 0, 0]) @ force)[None] for part, (moved, force) in both])[0]


def _through_chassis(score: Score) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each block (n, n_y, 6) y per displacement of the chassis, and (n, 6, m) the force on it of the payload with
    all that is attached."""
    if "through chassis" not in score.kept:
        found = []
        for part in score.parts:
            made, response = part.made, part.response
            through = np.swapaxes(made.G, 0, 1)[:6] @ (made.z_pf[:, :, None] * made.ops.mounts.chassis)
            moved = response.left[:, :, :6] @ through - response.gain * response.sense * made.ops.against
            found.append((moved, -made.ops.borne(made.M) @ response.x[:, :6]))
        score.kept["through chassis"] = found
    return score.kept["through chassis"]


def paths(score: Score, receptance: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(n_y n_u, N): directions of the residue of each path, displacement per newton."""
    columns = []
    for part in score.parts:
        ops, response = part.made.ops, part.response
        force = np.linalg.norm(ops.base.matrices.T[:3], axis=0)[:, None] * response.volts
        n_y, n_u = len(ops.base.sensors.names), force.shape[1]
        measured = (response.gain * response.sense)[:, :, 0] * receptance(part.s[:, 0, 0])[:, None]
        out = np.zeros((n_y, n_u, *response.Y.shape), complex)
        for i in range(n_y):
            out[i, :, :, i] = measured[:, i, None] * np.moveaxis(force, 1, 0)
        columns.append(out.reshape(n_y * n_u, *response.Y.shape))
    return score.directions(columns)
