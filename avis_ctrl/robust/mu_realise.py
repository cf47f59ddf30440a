"""Realisation of a worst-case perturbation as a stable real-rational system of constant norm, for simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, append, gain
from avis_ctrl.lti.bilinear import image_frequency, sampled_image
from avis_ctrl.robust.mu_lmi import Array
from avis_ctrl.uncertainty.blocks import Block, BlockStructure


@dataclass(frozen=True)
class DeltaSettings:
    """real : imaginary part relative to the size [1] up to which a number counts as real, its round-off: the pole of an
    all-pass system would go to zero or infinity with it."""

    real: float = 1e-7


SETTINGS = DeltaSettings()


def realise_delta(delta: Array, omega: float, blocks: BlockStructure | Sequence[Block], dt: float = 0.0) -> StateSpace:
    """Stable real-rational Delta(s) with the block structure, constant norm and Delta(j omega) = delta.

    A complex number |d| e^{j theta} becomes +-|d| (s - a)/(s + a), a > 0 (Zhou, Doyle and Glover, 1996, proof of
    theorem 9.1). In a full block of rank one, sigma u v^H, every entry of u and v becomes such an all-pass factor. Real
    scalars are constant. Every block has the same norm at all frequencies.

    Parameters
    ----------
    delta : (n_w, n_z) with the structure; full blocks of rank one, as returned by mu_peak and worst_case_gain.
    omega : rad/s; at 0 and infinity (or the Nyquist frequency) only a real delta can be realised.
    dt : sample time [s] of the perturbed system; 0 if continuous. A sampled Delta is the image of a continuous Delta
        under the bilinear map, which preserves the norm at all frequencies.

    Raises
    ------
    InputError : delta does not have the block structure.
    ComputationError : a full block of higher rank, or a complex delta at frequency 0 or infinity.
    """
    structure = BlockStructure.of(blocks)
    delta = np.asarray(delta, complex)
    if not structure.contains(delta, 1e-7):
        raise InputError("expected a matrix with the structure of the blocks", field="delta", value=delta.shape)
    omega = float(image_frequency(omega, dt))
    parts = []
    for block, w, z in structure.slices():
        if block.kind == "full":
            parts.append(_rank_one(delta[w, z], omega))
            continue
        value = complex(delta[w.start, z.start])
        one = gain(value.real) if block.kind == "real" else _all_pass(value, omega)
        parts.append(append(*[one] * block.rows))
    whole = append(*_unique(parts, "z", "w"))
    return sampled_image(whole, dt) if dt else whole


def _all_pass(value: complex, omega: float) -> StateSpace:
    """+-|value| (s - a)/(s + a), equal to value at s = j omega."""
    size, angle = abs(value), float(np.angle(value))
    if abs(value.imag) <= SETTINGS.real * size:
        return gain(value.real)
    if not 0 < omega < np.inf:
        raise ComputationError(
            "a real system cannot be complex at frequency 0 or infinity",
            measured=f"delta {value:.6g}",
            next_step="take the perturbation of a neighbouring frequency",
        )
    sign, phase = (1.0, angle) if angle > 0 else (-1.0, angle + np.pi)
    a = omega / float(np.tan((np.pi - phase) / 2))
    # (s - a)/(s + a) = 1 - 2a/(s + a)
    root = np.array([[np.sqrt(2 * a)]])
    return StateSpace(np.array([[-a]]), root, -sign * size * root, np.array([[sign * size]]))


def _rank_one(value: Array, omega: float) -> StateSpace:
    U, sigma, Vh = np.linalg.svd(value)
    if sigma.size > 1 and sigma[1] > 1e-6 * sigma[0]:
        raise ComputationError(
            "only full blocks of rank one are realised with constant norm",
            measured=f"singular values {sigma[0]:.3g}, {sigma[1]:.3g}",
            next_step="take the perturbation returned by mu_peak or worst_case_gain",
        )
    u, vh = U[:, 0], Vh[0]
    turn = np.exp(-1j * np.angle(u[np.argmax(np.abs(u))]))
    u, vh = u * turn, vh / turn
    column = _unique([_all_pass(entry, omega) for entry in u])
    row = _unique([_all_pass(entry, omega) for entry in vh])
    spread = append(*column) @ gain(np.ones((u.size, 1)))
    collect = gain(np.ones((1, vh.size))) @ append(*row)
    return (spread @ collect).scaled(left=float(sigma[0]))


def _unique(parts: list[StateSpace], into: str = "u", out: str = "y") -> list[StateSpace]:
    """The same systems with distinct signal names."""
    return [
        part.renamed([f"{into}{k}_{i}" for i in range(part.ninputs)], [f"{out}{k}_{i}" for i in range(part.noutputs)])
        for k, part in enumerate(parts)
    ]
