"""Frequency grids for a loop: they cover the band where the response changes, and are dense at resonances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.lti import StateSpace


@dataclass(frozen=True)
class GridSettings:
    """points_per_decade : number of evenly spaced frequencies: enough between the resonances, which are added to them.
    most_points : largest number of frequencies of a grid: the time of a D-step grows with it.
    """

    points_per_decade: int = 5
    most_points: int = 140


SETTINGS = GridSettings()


def frequency_grid(system: StateSpace, change: float = 1e-3) -> np.ndarray:
    """Grid [rad/s] from the poles, without the ends where the response stays within `change` of its limits."""
    poles = system.poles()
    sizes = np.abs(poles)
    # A pole at zero is known only to round-off of the fastest one.
    sizes = sizes[sizes > 1e-12 * np.max(sizes, initial=0.0)]
    low, high = (np.min(sizes) / 10, np.max(sizes) * 10) if sizes.size else (1e-2, 1e2)
    wide = np.geomspace(low, high, max(20, round(4 * np.log10(high / low))))
    response = system.frequency_response(np.concatenate([[0.0], wide, [np.inf]]))
    level = np.max(np.linalg.norm(response, axis=(1, 2)))
    from_start, from_end = (np.linalg.norm(response[1:-1] - response[k], axis=(1, 2)) > change * level for k in (0, -1))
    if not (np.any(from_start) and np.any(from_end)):
        return wide
    first = max(int(np.argmax(from_start)) - 1, 0)
    last = min(wide.size - int(np.argmax(from_end[::-1])), wide.size - 1)
    low, high = wide[min(first, last - 1)], wide[max(last, first + 1)]
    even = np.geomspace(low, high, max(30, round(SETTINGS.points_per_decade * np.log10(high / low))))
    # Another decade on either side makes the scalings constant where the loop is already constant.
    ends = np.concatenate([low / np.array([10.0, 3.0]), high * np.array([3.0, 10.0])])
    return merged(np.concatenate([even, ends]), resonances(poles, low, high))


def resonances(poles: np.ndarray, low: float = 0.0, high: float = np.inf, damping: float = 0.4) -> np.ndarray:
    """Resonance frequencies [rad/s] of modes with a damping ratio below `damping`, and points half a bandwidth away."""
    light = poles[(poles.imag > 0) & (np.abs(poles.real) < damping * np.abs(poles))]
    centre = np.sqrt(np.maximum(np.abs(light) ** 2 - 2 * light.real**2, 0.0))
    points = np.concatenate([centre, centre + light.real, centre - light.real])
    return points[(points > low) & (points < high)]


def merged(omega: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Sorted union without points closer than 0.1 %, thinned to at most `SETTINGS.most_points`."""
    every = np.sort(np.concatenate([omega, extra]))
    kept = every[np.concatenate([[True], every[1:] > every[:-1] * np.exp(1e-3)])]
    most = SETTINGS.most_points
    return kept if kept.size <= most else kept[np.unique(np.linspace(0, kept.size - 1, most).astype(int))]


def refined_grid(omega: np.ndarray, mu: np.ndarray, peaks: int = 4) -> np.ndarray:
    """The grid with additional points halfway to both neighbours of its highest local maxima, if they fit."""
    inner = np.flatnonzero((mu[1:-1] >= mu[:-2]) & (mu[1:-1] >= mu[2:])) + 1
    highest = inner[np.argsort(mu[inner])[::-1][:peaks]]
    if omega.size + 2 * highest.size > SETTINGS.most_points:
        return omega
    halfway = [np.sqrt(omega[highest] * omega[highest + side]) for side in (-1, 1)]
    return merged(omega, np.concatenate(halfway))
