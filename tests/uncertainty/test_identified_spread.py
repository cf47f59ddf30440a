"""The filter over a measured spread: above it everywhere, within 1 dB of the envelope, and of lowest order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.lti.magnitude_fit import covering_fit
from avis_ctrl.uncertainty.identified_spread import IdentifiedSpread, covering_spread
from avis_ctrl.uncertainty.weights import NeglectedDynamics

OMEGA = 2 * np.pi * np.geomspace(0.5, 60.0, 90)


def bumpy(seed: int) -> np.ndarray:
    """A spread such as measured ones: a slope, a bump at a resonance, and noise."""
    rng, f = np.random.default_rng(seed), OMEGA / (2 * np.pi)
    return (
        1e-3
        * (f / 5) ** rng.uniform(-0.5, 1)
        * (1 + 30 / (1 + 40 * np.log(f / 2.2) ** 2))
        * np.exp(0.3 * rng.standard_normal(OMEGA.size))
    )


SEEDS = (3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3)))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("declared", [None, NeglectedDynamics(0.01, 80.0, 4.0)])
def test_it_covers_the_data_within_one_dB_of_the_envelope_by_the_lowest_order(seed, declared):
    weight = IdentifiedSpread(OMEGA, bumpy(seed), declared, 1.2)
    assert np.all(weight.magnitude(OMEGA) >= weight.data * (1 - 1e-9))
    assert np.all(weight.envelope(OMEGA) >= weight.data * (1 - 1e-12))
    wide = np.geomspace(weight.grid[0], weight.grid[-1], 500)
    if declared is not None:
        assert np.all(weight.envelope(wide) >= 1.2 * declared.magnitude(wide) * (1 - 1e-12))
    # Everywhere, not only where it was fitted, the filter is above the envelope, by the stated amount at most.
    ends = np.array([0.2, 5.0]) * weight.grid[[0, -1]]
    between = np.geomspace(*ends, 30011)
    excess = 20 * np.log10(weight.magnitude(between) / weight.envelope(between))
    assert np.min(excess) >= -0.002 and np.max(excess) <= weight.slack_dB + 0.02
    curve = weight.envelope(weight.grid)
    raised = weight.magnitude(weight.grid) / curve
    assert 20 * np.log10(np.max(raised) / np.min(raised)) <= 1.0 + 1e-9  # the fit itself, at its frequencies
    lower = [covering_fit(weight.grid, curve, curve, order).error_max_dB for order in range(weight.shape.order)]
    assert all(excess > 1.0 for excess in lower)
    assert np.all(weight.shape.poles().real < 0) and np.all(weight.shape.zeros().real < 0)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(1e-6, 10.0), min_size=len(OMEGA), max_size=len(OMEGA)), st.floats(0.3, 3.0))
def test_the_envelope_is_the_smallest_one_of_its_slope(data, slope):
    """Above the data, no steeper than asked, and touching the data from wherever it is reached."""
    weight = IdentifiedSpread(OMEGA, np.array(data), slope=slope)
    points = np.geomspace(OMEGA[0], OMEGA[-1], 300)
    log = np.log(weight.envelope(points))
    assert np.all(weight.envelope(OMEGA) >= np.array(data) * (1 - 1e-12))
    assert np.all(np.abs(np.diff(log)) <= slope * np.diff(np.log(points)) + 1e-9)
    reached = np.array(data) * np.exp(-slope * np.abs(np.log(points[:, None] / OMEGA)))
    assert np.allclose(np.exp(log), reached.max(axis=1), rtol=1e-12)


def test_beyond_the_band_the_ends_hold():
    weight = IdentifiedSpread(OMEGA, bumpy(1))
    beyond = weight.envelope(np.array([OMEGA[0] / 5, OMEGA[0], OMEGA[-1], OMEGA[-1] * 5]))
    assert beyond[0] == beyond[1] and beyond[2] == beyond[3]


def test_where_the_declared_uncertainty_is_larger_it_is_the_weight():
    declared = NeglectedDynamics(0.1, 80.0, 4.0)
    weight = IdentifiedSpread(OMEGA, np.full(OMEGA.size, 1e-3), declared)
    assert weight.shape.order == 1
    assert np.allclose(weight.magnitude(OMEGA), declared.magnitude(OMEGA), rtol=1e-6)


def test_the_fit_reaches_a_decade_beyond_the_data_or_a_declared_crossover():
    data = np.full(OMEGA.size, 1e-3)
    for crossover_Hz, high_Hz in ((2.0, 600.0), (300.0, 3000.0)):
        grid = IdentifiedSpread(OMEGA, data, NeglectedDynamics(0.1, crossover_Hz, 4.0)).grid
        assert grid[[0, -1]] / (2 * np.pi) == pytest.approx([0.05, high_Hz])


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"data": np.zeros(OMEGA.size)}, "data"),
        ({"data": np.full(OMEGA.size, np.nan)}, "data"),
        ({"data": np.ones(3)}, "data"),
        ({"omega": OMEGA[::-1]}, "omega"),
    ],
)
def test_what_is_refused(changes, field):
    with pytest.raises(InputError, match=field):
        IdentifiedSpread(**{"omega": OMEGA, "data": bumpy(0), **changes})


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 1))])
def test_the_steeper_envelope_is_taken_where_a_low_order_follows_it(seed):
    flat, found = IdentifiedSpread(OMEGA, bumpy(seed)), covering_spread(OMEGA, bumpy(seed))
    assert found.slack_dB <= 1.3 and np.all(found.magnitude(OMEGA) >= found.data * (1 - 1e-9))
    assert found.slope == 1.0 or (found.slope == 2.0 and found.shape.order <= 6)
    assert np.all(found.envelope(OMEGA) <= flat.envelope(OMEGA) * (1 + 1e-12))


def test_a_plain_slope_is_followed_steeply():
    assert covering_spread(OMEGA, 1e-3 * (OMEGA / OMEGA[0])).slope == 2.0
