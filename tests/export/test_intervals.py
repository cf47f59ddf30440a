"""Bounds over intervals of frequency, against dense sampling inside them."""

from __future__ import annotations

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError
from avis_ctrl.export.bounds import CoverSettings, Grid
from avis_ctrl.export.intervals import delay_jet, roots_jet, sinc_jet, system_jet
from avis_ctrl.lti.statespace import StateSpace

CENTRE = np.geomspace(0.5, 300.0, 200)
HALF = 0.004 * CENTRE


def inside(function) -> np.ndarray:
    """(n,) largest norm of a matrix function of omega (n,) over each interval."""
    found = [np.linalg.norm(function(CENTRE + t * HALF), ord=2, axis=(1, 2)) for t in np.linspace(-1, 1, 21)]
    return np.max(found, axis=0)


@pytest.mark.parametrize("dt", [0.0, 1e-3])
def test_bound_of_a_difference_that_nearly_cancels(rng, dt):
    """A delayed, held, filtered system less a nearby one: never below the true maximum, and close to it."""
    n = 5
    A = rng.normal(size=(n, n))
    A = A - (np.max(np.linalg.eigvals(A).real) + 2.0) * np.eye(n)
    if dt:
        A = np.eye(n) + dt * A
    one = StateSpace(A, rng.normal(size=(n, 2)), rng.normal(size=(2, n)), np.zeros((2, 2)), dt)
    other = StateSpace(A, 1.001 * one.B, one.C, one.D, dt)
    zeros, poles, T, tau = (-3.0 + 4.0j, -3.0 - 4.0j), (-20.0, -40.0), 1e-3, 1.5e-3

    def scalar(w):
        s = 1j * w
        x = w * T / 2
        return (s - zeros[0]) * (s - zeros[1]) / ((s + 20) * (s + 40)) * np.exp(-s * tau) * np.sin(x) / x

    def true(w):
        return scalar(w)[:, None, None] * one.frequency_response(w) - other.frequency_response(w)

    factor = roots_jet(zeros, poles, 1.0, CENTRE, HALF) * (delay_jet(tau, CENTRE) * sinc_jet(T, CENTRE))
    difference = factor * system_jet(one, CENTRE, HALF) - system_jet(other, CENTRE, HALF)
    value, slope = (np.linalg.norm(part, ord=2, axis=(1, 2)) for part in (difference.value, difference.slope))
    bound = value + HALF * slope + difference.remainder(HALF)
    largest = inside(true)
    assert np.all(bound >= largest * (1 - 1e-12))
    assert np.median(bound / largest) < 1.05


@pytest.mark.parametrize("least", [1e-6, 1.0])
def test_bound_relative_to_a_controller_of_unlike_gains(rng, least):
    """R = (1 + delta) K with gains in the ratio 1 to 1e3: the error relative to [K; least I] is at most |delta|, far
    less than |R - K| over the smallest gain; never below that of the best M at any frequency, and close to it."""
    n, further = 5, 1e-9
    A = rng.normal(size=(n, n))
    A = A - (np.max(np.linalg.eigvals(A).real) + 2.0) * np.eye(n)
    rows = np.array([[1.0], [1e-3]])
    K = StateSpace(A, rng.normal(size=(n, 2)), rows * rng.normal(size=(2, n)), rows * rng.normal(size=(2, 2)))
    half = HALF / 100
    alone = system_jet(K, CENTRE, half)
    error = roots_jet((-3.0,), (-40.0,), 0.02, CENTRE, half) * alone
    bound, remainder = error.relative_to(alone, least, half, np.full(CENTRE.size, further))

    def true(w):
        response = K.frequency_response(w)
        below = np.broadcast_to(least * np.eye(2), response.shape)
        return (
            (0.02 * (1j * w + 3) / (1j * w + 40))[:, None, None]
            * response
            @ np.linalg.pinv(np.concatenate([response, below], axis=1))
        )

    largest = np.max(
        [np.linalg.norm(true(CENTRE + t * half), ord=2, axis=(1, 2)) for t in np.linspace(-1, 1, 21)], axis=0
    )
    assert np.all(bound >= largest * (1 - 1e-9))
    assert np.median(bound / largest) < 1.05
    assert np.all((remainder >= 0) & (remainder < bound))


def test_an_interval_divided_is_covered():
    grid = Grid(np.array([1.0, 3.0]), np.array([0.5, 0.1]))
    finer = grid.divided(np.array([4, 1]))
    ends = np.concatenate([finer.centre - finer.half, finer.centre[-1:] + finer.half[-1:]])
    assert ends == pytest.approx([0.5, 0.75, 1.0, 1.25, 2.9, 3.1])
    assert finer.centre + finer.half == pytest.approx([0.75, 1.0, 1.25, 1.5, 3.1])


def test_slopes_are_derivatives():
    """Central differences."""
    step = 1e-6 * CENTRE
    for make in (
        lambda w: delay_jet(2e-3, w),
        lambda w: sinc_jet(1e-3, w),
        lambda w: roots_jet((-1.0,), (-5.0 + 2j, -5.0 - 2j), 3.0, w, HALF),
    ):
        numeric = (make(CENTRE + step).value - make(CENTRE - step).value) / (2 * step)
        jet = make(CENTRE)
        assert np.max(np.abs(jet.slope - numeric)) < 1e-5 * np.max(np.abs(numeric))
        assert np.all(jet.steep * (1 + 1e-12) >= np.abs(jet.slope))


def test_grid_has_no_gaps():
    grid = Grid.of(1000.0, CoverSettings())
    low, high = grid.centre - grid.half, grid.centre + grid.half
    assert grid.centre.size == 4248  # docs/export.md
    assert low[0] == 0.0
    assert high[-1] == pytest.approx(1000.0)
    assert np.allclose(high[:-1], low[1:], rtol=1e-9)
    # Neighbours are about equally wide, for the remainder of Taylor's theorem grows with the square of the width.
    assert np.max(np.abs(np.log(grid.half[1:] / grid.half[:-1]))) < 0.02


def test_a_grid_too_coarse_is_refused():
    undamped = StateSpace([[0.0, 10.0], [-10.0, -1e-6]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    with pytest.raises(ComputationError, match="too coarse"):
        system_jet(undamped, np.array([10.0]), np.array([0.1]))
    with pytest.raises(ComputationError, match="too coarse"):
        roots_jet((10j,), (), 1.0, np.array([10.0]), np.array([0.1]))
