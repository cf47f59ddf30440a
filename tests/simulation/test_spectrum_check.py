"""The statistical comparison accepts the truth at its nominal rate and rejects wrong models."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats

from avis_ctrl.errors import InputError
from avis_ctrl.simulation.design_check import check_designs
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.simulation.spectrum_check import SETTINGS, check_spectrum_agreement, welch_moments

ALL = ("x", "y", "z", "phi_x", "phi_y", "phi_z")


def test_white_noise_moments_are_the_textbook_ones():
    """Overlap correlation of Hann windows at 50 % is 16.7 % (Harris, Proc. IEEE 66 (1978), table 1), and its square
    enters the variance (Welch 1967); lines 1 and 2 apart have (2/3)^2 and (1/6)^2, the window being 1/2 - cos/2.
    """
    mean, covariance = welch_moments(np.ones(60 * SETTINGS.points_per_line), 11)
    inner = slice(SETTINGS.lines, len(mean) - SETTINGS.lines)
    assert mean[inner] == pytest.approx(1.0, rel=1e-4)
    assert covariance[inner, 0] == pytest.approx((1 + 2 * 10 / 11 / 36) / 11, rel=1e-4)
    _, single = welch_moments(np.ones(60 * SETTINGS.points_per_line), 1)
    assert single[inner, 1] == pytest.approx(4 / 9, rel=1e-4)
    assert single[inner, 2] == pytest.approx(1 / 36, rel=1e-4)
    assert np.all(single[inner, 3:] < 1e-6)


def test_moments_of_a_narrow_resonance_agree_with_many_trials(rng):
    """A resonance half a line wide: leakage, and segments that remember each other."""
    segment, count, trials = 400, 6, 1500
    radius, angle = np.exp(-np.pi * 0.5 / segment), 2 * np.pi * 30.3 / segment
    a = [1.0, -2 * radius * np.cos(angle), radius**2]
    samples = segment * (count + 1) // 2
    x = signal.lfilter([1.0], a, rng.standard_normal((trials, samples + 4000)), axis=1)[:, 4000:]
    band = slice(28, 34)
    power = signal.welch(x, 1.0, "hann", segment, segment // 2, detrend=False)[1][:, band].sum(axis=1)
    f = np.arange(45 * SETTINGS.points_per_line + 1) / SETTINGS.points_per_line / segment
    psd = 2 * np.abs(signal.freqz([1.0], a, 2 * np.pi * f)[1]) ** 2
    mean, covariance = welch_moments(psd, count)
    variance = sum((1 if d == 0 else 2) * covariance[28 : 34 - d, d].sum() for d in range(6))
    assert power.mean() == pytest.approx(mean[band].sum(), rel=4 * power.std() / power.mean() / np.sqrt(trials))
    assert power.var() == pytest.approx(variance, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_truth_is_accepted_at_the_nominal_rate(make_loop, name):
    """Probability of each band's ratio under the prediction: uniform over seeds, axes and bands; few false alarms."""
    loop, seeds, alarms, levels = make_loop(name), 20, 0, []
    for seed in range(seeds):
        record = simulate(loop, 40.0, seed, nonlinear=False)
        found = check_spectrum_agreement(record, (1.6, 80.0), axes=ALL, false_alarm=0.1)
        levels.append(stats.chi2.cdf(found.ratio * found.dof, found.dof))
        alarms += not found.agrees
    assert stats.kstest(np.ravel(levels), "uniform").pvalue > 1e-3
    assert alarms <= stats.binom.ppf(0.999, seeds, 0.1)
    inside = np.mean((np.ravel(levels) > 0.05) & (np.ravel(levels) < 0.95))
    assert inside == pytest.approx(0.9, abs=0.03)


def judged_by(record, wrong):
    return check_spectrum_agreement(replace(record, loop=wrong))


def test_wrong_models_are_rejected(make_loop):
    """20 % of stiffness, the delay left out of a fast loop, one sensor's noise tripled."""
    loop = make_loop("avis")
    record = simulate(loop, 60.0)
    assert check_spectrum_agreement(record).agrees
    soft = {f"isolator{i}.k_z": 0.8 * loop.rig.parameters()[f"isolator{i}.k_z"].value for i in range(1, 5)}
    assert not judged_by(record, loop.with_plant("soft", loop.rig.with_parameters(soft))).agrees
    assert not judged_by(record, replace(loop, sensors=replace(loop.sensors, noise_rms_V=3e-3))).agrees
    for name in ("avis", "halcyonics_loaded"):
        fast = make_loop(name, 1.5)
        swift = simulate(fast, 60.0)
        assert check_spectrum_agreement(swift).agrees
        assert not judged_by(swift, replace(fast, loop_delay_s=0.0)).agrees


def test_short_records_and_empty_bands_are_refused(make_loop):
    record = simulate(make_loop(), 10.0)
    with pytest.raises(InputError, match="segment_s"):
        check_spectrum_agreement(record)
    with pytest.raises(InputError, match="third octave"):
        check_spectrum_agreement(record, (0.5, 80.0), segment_s=1.0)
    with pytest.raises(InputError, match="half the sample rate"):
        check_spectrum_agreement(record, (2.0, 500.0), segment_s=4.0)


def test_campaign_judges_each_plant_and_says_so_in_json(make_loop):
    loop = make_loop("avis")
    heavy = loop.with_plant("heavy", loop.rig.with_parameters({"mass": 550.0}))
    runaway = replace(make_loop("avis", -20.0), name="runaway", limit_V=1e6)
    cycling = replace(make_loop("avis", -3.0), name="held by its limits")
    weak = replace(loop, name="weak drives", limit_V=0.01)
    check = check_designs([loop, heavy, runaway, weak, cycling], 40.0)
    nominal, mass, unstable, clipped, cycle = check.plants
    assert [plant.name for plant in check.plants[1:]] == ["heavy", "runaway", "weak drives", "held by its limits"]
    assert nominal.passed and mass.passed and not check.passed
    assert not unstable.stable and unstable.diverged and unstable.spectrum is None and not unstable.passed
    assert clipped.stable and not clipped.within_limits and clipped.clipped_dac > 0 and not clipped.passed
    assert not cycle.diverged and not cycle.stable and not cycle.passed
    assert nominal.spectrum.false_alarm == pytest.approx(0.01 / 5)
    told = json.loads(json.dumps(check.as_dict(), allow_nan=False))
    assert [plant["passed"] for plant in told["plants"]] == [True, True, False, False, False]
    assert told["plants"][0]["peak_V"] == pytest.approx(np.abs(check.first.demanded).max())
