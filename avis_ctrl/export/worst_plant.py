"""Lower bounds: the worst plants of the uncertainty set for the emitted controller, found at single frequencies.

The loop is closed frequency by frequency with the exact response of the emitted numbers, including hold and delay, but
without the images of the sample rate: if a chain may be wrong by more than 100 % at half the rate, the set contains
plants without images. The worst plant is then simulated in time with the compiled code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avis_ctrl.export.bounds import Bounds
from avis_ctrl.export.sampled_response import SampledAxes
from avis_ctrl.robust.mu import mu
from avis_ctrl.robust.mu_gain import perturbed, worst_gain
from avis_ctrl.robust.mu_peak import MuPeak
from avis_ctrl.uncertainty.generalized_plant import GeneralizedPlant


class WorstPlant(NamedTuple):
    """gain : from floor to payload velocity of the kept axes, rotations at the edge. omega : rad/s. delta : (n_w, n_z)
    of the design's blocks. direction : (n_axes,) complex floor velocity of norm 1 that has this gain."""

    gain: float
    omega: float
    delta: np.ndarray
    direction: np.ndarray


def mu_lower(axes: SampledAxes, found: Bounds) -> float:
    """A lower bound of mu of the loop, near the peaks of its upper bound."""
    plant = axes.folder.plant.synthesis
    M = _closed(plant, axes, _near(found.mu, axes.half_rate))
    return float(np.max(mu(M, plant.all_blocks, tolerance=1e-3).lower))


def worst_transmissibility(axes: SampledAxes, found: Bounds) -> WorstPlant:
    """The plant with the worst transmissibility, near the peaks of its upper bound."""
    plant = axes.folder.plant
    omega = _near(found.peak, axes.half_rate)
    M = _closed(plant.full.restricted(plant.floor_velocities, plant.velocities), axes, omega)
    worst = worst_gain(M, plant.full.blocks)
    k = int(np.argmax(worst.gain))
    _, _, Vh = np.linalg.svd(perturbed(M[k], worst.delta[k]))
    return WorstPlant(float(worst.gain[k]), float(omega[k]), worst.delta[k], np.conj(Vh[0]))


def _near(peak: MuPeak, half_rate: float, count: int = 12) -> np.ndarray:
    """(n,) frequencies of the highest upper bounds, of the highest local maxima of their curve, and of the lower bound.
    The highest bounds alone may all lie where the bound of the sampling errors is largest."""
    upper = peak.upper_curve
    beside = np.concatenate([[-np.inf], upper, [-np.inf]])
    maxima = np.flatnonzero((upper >= beside[:-2]) & (upper >= beside[2:]))
    chosen = [*np.argsort(upper)[::-1][:count], *maxima[np.argsort(upper[maxima])[::-1][:count]]]
    return np.unique([one for one in (*peak.frequencies[chosen], peak.omega) if 0 < one < half_rate])


def _closed(plant: GeneralizedPlant, axes: SampledAxes, omega: np.ndarray) -> np.ndarray:
    """(n_omega, n_z + n_e, n_w + n_d) response of the loop with the emitted controller."""
    # F_l(P, K) is F_u of P with its last inputs and outputs first.
    P = plant.P.frequency_response(omega)
    return perturbed(np.roll(P, (plant.nmeas, plant.ncon), axis=(1, 2)), axes.response(omega))
