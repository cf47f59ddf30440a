"""Gain under the worst perturbation of norm 1 at given frequencies: a lower bound by ascent.

With E = N22 + N21 Delta inv(I - N11 Delta) N12 and its largest singular triple u, sigma, v

    d sigma = Re(a^H dDelta x),   x = inv(I - N11 Delta) N12 v,   a = inv(I - Delta N11)^H N21^H u,

so that the block that raises sigma most is a_k x_k^H / (|a_k| |x_k|) (full), the phase of x^H a (complex scalar) or the
sign of Re(x^H a) (real scalar). The performance block absorbs every phase, so that no quantity has to be real here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.robust.mu_lmi import Array, dagger
from avis_ctrl.robust.mu_lower import aligned
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class GainSettings:
    """steps : step lengths towards the steepest Delta, tried in this order.
    accuracy : an ascent ends when a step raises the gain by less than this fraction.
    dyad_loss : relative loss of gain that is accepted to replace a full block by a dyad (matrix of rank one).
    """

    steps: tuple[float, ...] = (1.0, 0.5, 0.2, 0.05, 0.01, 0.002)
    accuracy: float = 1e-6
    dyad_loss: float = 1e-4


SETTINGS = GainSettings()


class WorstGain(NamedTuple):
    """gain (B,) attained by delta (B, n_w, n_z) with ||delta|| <= 1."""

    gain: Array
    delta: Array


def perturbed(M: Array, delta: Array) -> Array:
    """Upper LFT of matrices: the map from d to e (.., n_e, n_d) with Delta (.., n_w, n_z) closed."""
    n_w, n_z = delta.shape[-2:]
    M11, M12, M21, M22 = M[..., :n_z, :n_w], M[..., :n_z, n_w:], M[..., n_z:, :n_w], M[..., n_z:, n_w:]
    return M22 + M21 @ delta @ np.linalg.solve(np.eye(n_z) - M11 @ delta, M12)


def _gain(M: Array, delta: Array) -> Array:
    """Largest singular values (B,); inf where Delta makes the loop singular."""
    try:
        return np.linalg.norm(perturbed(M, delta), ord=2, axis=(-2, -1))
    except np.linalg.LinAlgError:
        # One singular matrix ends the computation of the whole stack.
        return np.array([np.inf]) if len(M) == 1 else np.concatenate([_gain(M[[k]], delta[[k]]) for k in range(len(M))])


def _steepest(M: Array, delta: Array, structure: BlockStructure) -> tuple[Array, Array]:
    """The Delta (B, n_w, n_z) of norm 1 that raises the largest singular value most, to first order, and Delta with
    only the block changed that contributes most to this."""
    n_w, n_z = structure.n_w, structure.n_z
    U, _, Vh = np.linalg.svd(perturbed(M, delta))
    u, v = U[:, :, 0], np.conj(Vh[:, 0])
    M11, M12, M21 = M[:, :n_z, :n_w], M[:, :n_z, n_w:], M[:, n_z:, :n_w]
    x = np.linalg.solve(np.eye(n_z) - M11 @ delta, M12 @ v[..., None])[..., 0]
    a = np.linalg.solve(dagger(np.eye(n_w) - delta @ M11), dagger(M21) @ u[..., None])[..., 0]
    steepest = aligned(a, x, structure, lambda product, _: np.where(product >= 0, 1.0, -1.0))
    change, places = steepest - delta, list(structure.slices())
    rise = np.array([np.einsum("bi,bij,bj->b", np.conj(a[:, w]), change[:, w, z], x[:, z]).real for _, w, z in places])
    one = delta.copy()
    for k, (_, w, z) in enumerate(places):
        most = np.argmax(rise, axis=0) == k
        one[most, w, z] = steepest[most, w, z]
    return steepest, one


def worst_gain(
    M: Array, structure: BlockStructure, *, count: int = 4, iterations: int = 20, seed: int = 0
) -> WorstGain:
    """Ascent from Delta = 0 and random perturbations for M (B, n_z + n_e, n_w + n_d); monotone in every step.

    The gain is inf if a perturbation of norm 1 that makes the loop singular was met. Raises InputError for an M that is
    not finite.
    """
    if not np.all(np.isfinite(M)):
        raise InputError("expected finite entries", field="M")
    rng = np.random.default_rng(seed)
    batch = M.shape[0]
    delta = np.zeros((count * batch, structure.n_w, structure.n_z), complex)
    for k in range(batch, count * batch):
        delta[k] = structure.random(rng)
    repeated = np.concatenate([M] * count)
    gain = _gain(repeated, delta)
    _ascend(repeated, delta, gain, np.flatnonzero(np.isfinite(gain)), structure, iterations)
    _take_dyads(repeated, delta, gain, structure)
    best = np.argmax(gain.reshape(count, batch), axis=0) * batch + np.arange(batch)
    return WorstGain(gain[best], delta[best])


def with_neighbours(M: Array, found: WorstGain, structure: BlockStructure, iterations: int = 20) -> WorstGain:
    """Ascent from the perturbation of a neighbouring frequency where its gain is larger: an ascent can end at a lower
    maximum at one frequency only. M (B, ..) at increasing frequencies."""
    gain, delta = found.gain.copy(), found.delta.copy()
    for order in (np.arange(len(M)), np.arange(len(M))[::-1]):
        for before, k in pairwise(order):
            value = _gain(M[[k]], delta[[before]])[0]
            if np.isfinite(value) and value > gain[k]:
                gain[k], delta[k] = value, delta[before]
    changed = np.flatnonzero(np.isfinite(gain) & (gain > found.gain))
    if changed.size:
        _ascend(M, delta, gain, changed, structure, iterations)
        _take_dyads(M, delta, gain, structure)
    return WorstGain(gain, delta)


def _ascend(M: Array, delta: Array, gain: Array, climbing: Array, structure: BlockStructure, iterations: int) -> None:
    """Steps of the problems `climbing`, in place, until none raises the gain."""
    for _ in range(iterations):
        gained = gain[climbing]
        _climb(M, delta, gain, climbing, structure)
        climbing = climbing[(gain[climbing] > gained * (1 + SETTINGS.accuracy)) & np.isfinite(gain[climbing])]
        if not climbing.size:
            break


def _climb(M: Array, delta: Array, gain: Array, which: Array, structure: BlockStructure) -> None:
    """One step of the problems `which`, in place, with the first step length that raises the gain: of all blocks, or
    else of one, because another one may be at a narrow maximum."""
    targets = np.stack(_steepest(M[which], delta[which], structure))
    for kind in range(len(targets)):
        for step in SETTINGS.steps:
            trial = delta[which] + step * (targets[kind] - delta[which])
            value = _gain(M[which], trial)
            better = value > gain[which]
            delta[which[better]], gain[which[better]] = trial[better], value[better]
            which, targets = which[~better], targets[:, ~better]


def _take_dyads(M: Array, delta: Array, gain: Array, structure: BlockStructure) -> None:
    """Replace full blocks by dyads of the gradient, which they are at a maximum: only dyads can be realised with
    constant norm. In place, if the gain decreases by at most `dyad_loss`."""
    finite, dyads = np.isfinite(gain), delta.copy()
    steepest, _ = _steepest(M[finite], delta[finite], structure)
    for block, w, z in structure.slices():
        if block.kind == "full":
            dyads[finite, w, z] = steepest[:, w, z]
    value = _gain(M, dyads)
    take = finite & (value >= gain * (1 - SETTINGS.dyad_loss))
    delta[take], gain[take] = dyads[take], value[take]
