"""Frequencies at which a bound is evaluated: initial ones from the poles, and refinement of local maxima."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_cover import Interval, midpoint
from avis_ctrl.robust.mu_lmi import Array


def first_frequencies(N: StateSpace, band: Interval, grid: int = 40) -> Array:
    """Initial frequencies [rad/s]: band ends, natural frequencies and resonances, and a coarse logarithmic grid."""
    poles = N.poles()
    size = np.abs(poles)
    resonance = np.sqrt(np.maximum(size**2 - 2 * poles.real**2, 0.0))
    named = np.concatenate([size, resonance[resonance > 0]])
    positive = named[named > 0]
    low, high = (positive.min() / 10, positive.max() * 10) if positive.size else (1.0, 1.0)
    low, high = max(low, band[0]), min(high, band[1])
    if 0 < low < high:
        named = np.concatenate([named, np.geomspace(low, high, grid)])
    named = np.sort(named[(named > band[0]) & (named < band[1])])
    if named.size:
        named = named[np.concatenate([[True], np.diff(named) > 1e-4 * named[1:]])]
    return np.unique(np.concatenate([[band[0]], named, [band[1]]]))


def refine_maxima(
    value: Callable[[Array], Array],
    omega: Array,
    values: Array,
    *,
    tolerance: float = 1e-4,
    worth: float = 0.9,
    most: int = 4,
    rounds: int = 12,
) -> tuple[Array, Array]:
    """Add points around the highest local maxima until their brackets agree to `tolerance`; sorted omega, values.

    Only the `most` highest maxima are refined, and only those of at least `worth` times the highest.
    """
    for _ in range(rounds):
        if not np.all(np.isfinite(values)):
            break
        padded = np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]) & (values >= worth * np.max(values)))
        peaks = peaks[np.argsort(values[peaks])[::-1]][:most]
        new: list[float] = []
        for k in peaks.tolist():
            low, high = max(k - 1, 0), min(k + 1, omega.size - 1)
            drop = values[k] - min(values[low], values[high])
            if drop > tolerance * values[k]:
                for a, b in ((omega[low], omega[k]), (omega[k], omega[high])):
                    if b > a and (np.isinf(b) or b - a > 1e-9 * b):
                        new += [midpoint(a, b)]
        fresh = np.setdiff1d(np.array(new), omega)
        if not fresh.size:
            break
        omega, values = np.concatenate([omega, fresh]), np.concatenate([values, value(fresh)])
        order = np.argsort(omega)
        omega, values = omega[order], values[order]
    return omega, values
