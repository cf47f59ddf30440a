"""Tuning of skyhook loops on the AVIS plant: its algebra against closed loops, its search against brute force."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.classical.tuning import Merit, Scenarios, Search, TuningRange, half_turns
from avis_ctrl.lti import lft_lower, lft_upper
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.design_file import read_design
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.skyhooks import SETTINGS, critical_gains

DESIGNS = Path(__file__).resolve().parents[2] / "designs"
OMEGA = 2 * np.pi * np.array(SETTINGS.frequencies_Hz)
BAND_HZ = (1.0, 10.0)


@pytest.fixture(scope="module")
def plant() -> DesignPlant:
    return build_plant(read_design(DESIGNS / "avis_z_phix.toml"), load_rig("avis"))


@pytest.fixture(scope="module")
def scenarios(plant) -> Scenarios:
    return Scenarios.sample(plant.full, plant.floor_velocities, plant.velocities, OMEGA, 4, seed=3)


@pytest.fixture(scope="module")
def critical() -> tuple[float, ...]:
    return critical_gains(load_rig("avis"), ("z", "phi_x"))


def test_critical_gains_give_double_poles_of_each_axis_alone():
    rig = load_rig("avis")
    eom = rig.equations_of_motion()
    for k, name in enumerate(COORDINATES):
        (g,) = critical_gains(rig, [name]) * lever_arms(rig, [name]) ** 2
        poles = np.roots([eom.M[k, k], eom.C[k, k] + g, eom.K[k, k]])
        assert np.allclose(poles, -np.sqrt(eom.K[k, k] / eom.M[k, k]), rtol=1e-6)


def random_skyhook(rng: np.random.Generator, critical: tuple[float, ...], reach: float) -> Skyhook:
    factors = np.exp(rng.uniform(np.log(0.1), np.log(reach), 2))
    return Skyhook(
        ("z", "phi_x_edge"), tuple(factors * critical), float(rng.uniform(0.02, 1.0)), float(rng.uniform(30.0, 400.0))
    )


def diagonal(skyhook: Skyhook, omega: np.ndarray) -> np.ndarray:
    """(n_omega, n_axes) loop gains."""
    K = skyhook.controller().frequency_response(omega)
    return np.einsum("wkk->wk", K)


def test_closed_scenario_is_the_closed_loop_of_the_sampled_plant(plant, scenarios, critical, rng):
    """Real perturbations: close Delta, then K, as state spaces."""
    motion = plant.full.restricted(plant.floor_velocities, plant.velocities)
    for _ in range(3):
        delta = plant.full.blocks.random(rng, real=True)
        skyhook = random_skyhook(rng, critical, 3.0)
        found = scenarios.with_delta(delta).channels().closed(diagonal(skyhook, OMEGA))[-1]
        expected = lft_lower(lft_upper(motion.P, delta.real), skyhook.controller())
        response = expected.frequency_response(OMEGA)
        np.testing.assert_allclose(found, response, rtol=0, atol=1e-8 * np.abs(response).max())


def test_complex_scenarios_close_in_either_order(plant, scenarios, critical, rng):
    """Complex perturbations, one a frequency: close K as a state space first, then Delta by hand."""
    skyhook = random_skyhook(rng, critical, 3.0)
    N = plant.full.restricted(plant.floor_velocities, plant.velocities).closed(skyhook.controller())
    response, n_w, n_z = N.frequency_response(OMEGA), plant.full.blocks.n_w, plant.full.blocks.n_z
    found = scenarios.channels().closed(diagonal(skyhook, OMEGA))
    for k, n in product(range(len(scenarios.deltas)), range(0, OMEGA.size, 7)):
        delta, M = scenarios.deltas[k, n], response[n]
        expected = (
            M[n_z:, n_w:] + M[n_z:, :n_w] @ delta @ np.linalg.inv(np.eye(n_z) - M[:n_z, :n_w] @ delta) @ M[:n_z, n_w:]
        )
        np.testing.assert_allclose(found[k, n], expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_samples_lie_on_the_boundary_of_the_set(plant, scenarios):
    blocks = plant.full.blocks
    assert not np.any(scenarios.deltas[0])
    for sample in scenarios.deltas[1:]:
        values = [blocks.values(delta) for delta in sample]
        for place, block in enumerate(blocks.blocks):
            over_frequency = [value[place] for value in values]
            if block.kind == "real":
                assert set(over_frequency) in ({1.0}, {-1.0})  # a parameter is one number
            else:
                sizes = [np.linalg.norm(np.atleast_2d(value), 2) for value in over_frequency]
                np.testing.assert_allclose(sizes, 1.0, rtol=1e-12)


def test_unstable_poles_of_a_sample_are_those_of_its_closed_loop(plant, scenarios, critical, rng):
    """Phase of the characteristic polynomial against eigenvalues, on the frequencies that the search uses.

    Loops with a pole within 2 % of the axis are left out: they turn between two points of the grid, and their
    resonance is what the limit on the peak refuses.
    """
    verdicts = []
    for _ in range(120):
        delta = plant.full.blocks.random(rng, real=True)
        deltas = np.stack([scenarios.deltas[0], scenarios.with_delta(delta).deltas[scenarios.plants]])
        search = Search(
            replace(scenarios, deltas=deltas, plants=2), ("z", "phi_x_edge"), TuningRange(critical), BAND_HZ
        )
        low, high = np.log([(0.1, 0.1, 0.02, 30.0), (20.0, 20.0, 1.0, 400.0)])
        point = rng.uniform(low, high)
        K = search.search.skyhook(search.axes, point).controller()
        poles = [lft_lower(lft_upper(scenarios.plant.P, d.real), K).poles() for d in (0 * delta, delta)]
        if all(np.min(np.abs(each.real) / np.abs(each)) > 0.02 for each in poles):
            true = max(np.count_nonzero(each.real > 0) for each in poles)
            verdicts.append((search.merit(point, 2.0).unstable, true))
    assert all(found == true for found, true in verdicts)
    assert {true > 0 for _, true in verdicts} == {True, False}
    assert len(verdicts) > 80


def test_half_turns_count_unstable_poles():
    """A polynomial relative to a stable one of the same degree: (s - a)(s - b)/(s + 1)^2 by hand."""
    s = 1j * np.geomspace(1e-4, 1e4, 400)
    for unstable, roots in ((0, (-2, -3)), (1, (2, -3)), (2, (2, 3)), (2, (1 + 4j, 1 - 4j))):
        assert half_turns(((s - roots[0]) * (s - roots[1]) / (s + 1) ** 2)[None]) == -unstable


@pytest.fixture(scope="module")
def tuned(scenarios, critical) -> tuple[Skyhook, float]:
    limit = 10 ** (4 / 20)
    task = Search(scenarios, ("z", "phi_x_edge"), TuningRange(critical), BAND_HZ)
    best = min(
        (task.improved(start, limit) for start in task.best_starts(limit)),
        key=lambda point: task.merit(point, limit).key(),
    )
    return task.search.skyhook(task.axes, best), limit


def measured(scenarios: Scenarios, skyhook: Skyhook) -> tuple[float, float]:
    """Largest singular value over all samples: everywhere, and in the band."""
    sigma = np.linalg.norm(scenarios.channels().closed(diagonal(skyhook, OMEGA)), ord=2, axis=(-2, -1))
    inside = [BAND_HZ[0] <= f <= BAND_HZ[1] for f in SETTINGS.frequencies_Hz]
    return float(sigma.max()), float(sigma[:, inside].max())


def test_tuning_keeps_the_peak_limit_on_its_samples(tuned, scenarios):
    skyhook, limit = tuned
    assert measured(scenarios, skyhook)[0] <= limit * (1 + 1e-9)
    assert scenarios.plant.closed(skyhook.controller()).is_stable()


@pytest.mark.slow
def test_tuning_beats_a_grid(tuned, scenarios, critical):
    skyhook, limit = tuned
    best = np.inf
    for a, b, tilt, roll in product(
        np.geomspace(0.1, 10.0, 7), np.geomspace(0.1, 10.0, 7), (0.02, 0.15, 1.0), (30.0, 110.0, 400.0)
    ):
        one = Skyhook(("z", "phi_x_edge"), (a * critical[0], b * critical[1]), tilt, roll)
        if scenarios.plant.closed(one.controller()).is_stable():
            peak, band = measured(scenarios, one)
            best = min(best, band if peak <= limit else np.inf)
    assert np.isfinite(best)
    assert measured(scenarios, skyhook)[1] < best


def test_tuning_stays_in_its_range(tuned, critical):
    skyhook, _ = tuned
    search = TuningRange(critical)
    assert search.tilt_corner_Hz[0] <= skyhook.tilt_corner_Hz <= search.tilt_corner_Hz[1]
    assert search.roll_off_Hz[0] <= skyhook.roll_off_Hz <= search.roll_off_Hz[1]
    for gain, unit in zip(skyhook.gains, critical, strict=True):
        assert search.gain_factor[0] <= gain / unit <= search.gain_factor[1]


def test_slopes_of_the_search_are_those_of_the_singular_values(scenarios, critical):
    """Against differences of the closed loops' largest singular values, each loop built as a state space."""
    search = Search(scenarios, ("z", "phi_x_edge"), TuningRange(critical), BAND_HZ)
    point, h = search.search.point(0.7, (0.2, 60.0)), 1e-5

    def log_sigma(at):
        K = diagonal(search.search.skyhook(search.axes, at), OMEGA)
        return np.log(np.linalg.norm(scenarios.channels().closed(K), ord=2, axis=(-2, -1)))

    values, slopes, in_band = search._linearised(point, reach=np.inf)
    np.testing.assert_allclose(values, log_sigma(point).ravel(), rtol=1e-9)
    assert np.array_equal(
        in_band.reshape(-1, OMEGA.size)[0], [BAND_HZ[0] <= f <= BAND_HZ[1] for f in SETTINGS.frequencies_Hz]
    )
    for k, e in enumerate(np.eye(point.size)):
        numeric = (log_sigma(point + h * e) - log_sigma(point - h * e)).ravel() / (2 * h)
        np.testing.assert_allclose(slopes[:, k], numeric, atol=1e-4)


def test_tuning_is_no_worse_than_any_start(tuned, scenarios, critical):
    """The classical tunings with customary corners and their neighbours, judged by the order of `Merit`."""
    skyhook, limit = tuned
    search = Search(scenarios, ("z", "phi_x_edge"), TuningRange(critical), BAND_HZ)
    best = Merit(*measured(scenarios, skyhook), limit).key()
    starts = search.starts()
    assert any(np.allclose(start, search.search.point(1.0, (0.1, 100.0))) for start in starts)
    assert all(best <= search.merit(start, limit).key() for start in starts)


def test_merit_puts_the_limit_first():
    order = [
        Merit(1.5, 0.5, 1.6),
        Merit(1.0, 0.7, 1.6),
        Merit(1.7, 0.1, 1.6),
        Merit(9.0, 0.1, 1.6),
        Merit(1.0, 0.1, 1.6, unstable=1.0),
    ]
    assert sorted(order[::-1], key=Merit.key) == order


def test_worst_cases_join_the_samples(plant, scenarios, rng):
    """One of each frequency is kept by frequency, also at frequencies that join later; it is no plant."""
    blocks = plant.full.blocks
    deltas = np.stack([blocks.random(rng) for _ in OMEGA])
    more = scenarios.with_worst(deltas).with_frequencies(OMEGA[3] * np.array([0.999, 1.001]))
    assert more.plants == scenarios.plants == len(more.deltas) - 1
    at = np.flatnonzero(np.isclose(more.omega, OMEGA[3], rtol=2e-3))
    assert at.size == 3
    assert all(np.array_equal(more.deltas[-1, k], deltas[3]) for k in at)
    np.testing.assert_allclose(more.channels().yu[:-1, at[1]], scenarios.channels().yu[:, 3], rtol=1e-9)
