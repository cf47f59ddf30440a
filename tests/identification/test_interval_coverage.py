"""Errors of whole identifications against the intervals that they claim: a small seeded part of the benchmark."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta, binom, chi2

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "interval_coverage.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("interval_coverage", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules["interval_coverage"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_intervals_hold_the_truth_and_errors_are_near_the_bound(benchmark):
    """Six campaigns, twenty directions each; limits that a right fit passes with a chance of 0.999."""
    trials = [benchmark.trial(benchmark.Settings(), seed) for seed in range(501, 507)]
    assert all(one.rank == 20 for one in trials)
    z = np.array([one.directions for one in trials])
    bound = np.array([one.bound_directions for one in trials])
    inside = int(np.sum(np.abs(z) <= benchmark.QUANTILE))
    assert inside >= binom(z.size, 0.95).ppf(5e-4)
    low, high = chi2(z.size).ppf([5e-4, 1 - 5e-4]) / z.size
    assert low < np.mean(z**2) < high
    # 1.2 times the bound at most, beyond what the draws scatter.
    assert np.mean(bound**2) < 1.2**2 * high


def test_wilsons_interval_covers(benchmark):
    """Against the exact interval of Clopper and Pearson, which is a little wider."""
    low, high = benchmark.wilson(190, 200)
    assert low == pytest.approx(beta(190, 11).ppf(0.025), abs=0.006)
    assert high == pytest.approx(beta(191, 10).ppf(0.975), abs=0.006)
    assert benchmark.wilson(20, 20)[1] == pytest.approx(1.0)
