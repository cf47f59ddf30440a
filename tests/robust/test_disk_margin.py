"""Disk margins against python-control, the published example, direct search, and the loops that they speak of."""

from __future__ import annotations

import control
import numpy as np
import pytest

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, append, discretise, tf
from avis_ctrl.robust.disk_margin import disk_margin
from avis_ctrl.uncertainty.uncertain_models import real

# Seiler, Packard and Gahinet 2020, section "Disk margins": alpha 0.46, gains 0.63 to 1.59, phase 26 degrees.
L = control.tf([25], [1, 10, 10, 10])
OMEGA = np.geomspace(1e-4, 1e4, 40001)
# The spinning satellite of Zhou, Doyle and Glover, 1996, section 9.6, with python-control's own controller for it.
SATELLITE = control.ss([[0, 10], [-10, 0]], np.eye(2), [[1, 10], [-10, 1]], np.zeros((2, 2)))
K = control.ss([], [], [], [[1, -2], [0, 1]])


def factor(delta, skew):
    return (1 + (1 - skew) / 2 * delta) / (1 - (1 + skew) / 2 * delta)


def test_the_published_example():
    found = disk_margin(L)
    assert round(found.lower, 2) == 0.46 and found.guaranteed
    assert [round(g, 2) for g in found.gain] == [0.63, 1.59]
    assert round(found.phase_deg) == 26 and found.omega == pytest.approx(1.96, abs=0.02)


@pytest.mark.parametrize("skew", [0.0, 1.0, -1.0, 0.4])
def test_one_channel_against_python_control_and_a_fine_grid(skew):
    found = disk_margin(L, skew=skew)
    alpha, gain_dB, phase = control.disk_margins(L, OMEGA, skew=skew, returnall=False)
    assert found.lower <= alpha * (1 + 1e-6) and found.upper >= alpha * (1 - 1e-4)
    assert found.lower == pytest.approx(alpha, rel=1e-3) and found.phase_deg == pytest.approx(phase, rel=2e-3)
    assert found.gain_dB == pytest.approx(gain_dB, rel=2e-3)
    response = L(1j * OMEGA)
    S, T = 1 / (1 + response), response / (1 + response)
    assert alpha == pytest.approx(1 / np.max(np.abs((1 + skew) / 2 * S - (1 - skew) / 2 * T)), rel=1e-6)


@pytest.mark.parametrize("at", ["outputs", "inputs"])
def test_several_channels_against_python_control(at):
    found = disk_margin(SATELLITE, K, at=at)
    # The least margin is at zero frequency: python-control needs a grid that comes near it.
    loop = SATELLITE * K if at == "outputs" else K * SATELLITE
    alpha, *_ = control.disk_margins(loop, np.geomspace(1e-4, 1e3, 300), returnall=False)
    assert found.lower == pytest.approx(alpha, rel=2e-3) and found.lower <= alpha


def test_both_ends_at_once_are_harder_and_random_factors_below_the_margin_keep_the_loop_stable(rng):
    both = disk_margin(SATELLITE, K, at="both")
    assert both.lower < min(disk_margin(SATELLITE, K, at=at).lower for at in ("outputs", "inputs"))
    A, B, C = (np.asarray(getattr(SATELLITE, name)) for name in "ABC")
    gains = np.asarray(K.D)
    for _ in range(500):
        delta = both.lower * rng.uniform(-1, 1, 4)
        F = factor(delta, 0.0)
        closed = A - B @ np.diag(F[2:]) @ gains @ np.diag(F[:2]) @ C
        assert np.all(np.linalg.eigvals(closed).real < 0)


def test_the_factor_returned_puts_a_pole_on_the_imaginary_axis():
    for skew in (0.0, 0.7):
        found = disk_margin(L, skew=skew)
        f = factor(found.delta[0, 0], skew)
        assert abs(1 + f * L(1j * found.omega)) < 1e-6 and abs(found.delta[0, 0]) == pytest.approx(found.upper)


@pytest.mark.parametrize(
    "plant, controller, pole, words",
    [
        (control.tf([1.0], [1.0, -1.0]), tf([-3.0], [1.0]), "4", "give -K"),
        (control.tf([-3.0], [1.0, 1.0]), None, "2", "give -L"),
        (real("k", 1.0, percent=1) * tf([-3.0], [1.0, 1.0]), None, "2", "give -L"),
    ],
)
def test_a_nominal_loop_that_is_not_stable_is_named_as_such(plant, controller, pole, words):
    with pytest.raises(ComputationError, match="nominal loop is not stable") as error:
        disk_margin(plant, controller)
    assert f"pole {pole}" in str(error.value) and words in str(error.value)


def test_gains_and_phases_inside_the_margin_are_stable():
    found = disk_margin(L)
    for gain in np.linspace(*found.gain, 30):
        assert control.feedback(gain * L, 1).poles().real.max() < 0
    _, phase_margin, _, _ = control.margin(L)
    assert found.phase_deg <= phase_margin


def test_a_sampled_loop_against_its_grid():
    loop = discretise(StateSpace.from_control(control.ss(L)), 0.05)
    found = disk_margin(loop)
    response = loop.frequency_response(np.geomspace(1e-3, np.pi / 0.05, 20001))[:, 0, 0]
    assert found.lower == pytest.approx(1 / np.max(np.abs((1 - response) / (1 + response) / 2)), rel=1e-3)


def test_the_worst_case_over_an_uncertain_gain_is_that_of_the_worst_gain():
    found = disk_margin(real("k", 1.0, percent=20) * tf([25.0], [1.0, 10.0, 10.0, 10.0]))
    least = min(disk_margin(k * L).lower for k in np.linspace(0.8, 1.2, 9))
    assert found.lower == pytest.approx(least, rel=3e-3) and found.lower <= least * 1.001 <= found.upper * 1.003
    assert found.delta is not None and abs(found.delta[0, 0]) <= found.upper * 1.01


def test_a_channel_in_no_loop_does_not_change_the_margin():
    """A factor outside every loop is infinite at delta = 2, and harms nothing else (S + (sigma - 1)/2 I with S = 1)."""
    alone = disk_margin(L)
    zero = StateSpace([], [], [], [[0.0]])
    both = disk_margin(append(tf([25.0], [1.0, 10.0, 10.0, 10.0]), zero))
    assert both.lower == pytest.approx(alone.lower) and both.upper == pytest.approx(alone.upper)
    assert both.delta.shape == (2, 2) and both.delta[1, 1] == 0 and both.delta[0, 0] == pytest.approx(alone.delta[0, 0])
    assert disk_margin(zero).lower == disk_margin(zero).upper == 2.0


def test_a_large_worst_case_margin_is_resolved_as_well_as_a_small_one():
    found = disk_margin(real("k", 1.0, percent=10) * tf([0.3], [1.0, 1.0, 1.0]), skew=-1)
    of_the_largest = disk_margin(tf([0.33], [1.0, 1.0, 1.0]), skew=-1)
    assert found.lower <= of_the_largest.upper and found.lower == pytest.approx(of_the_largest.lower, rel=5e-3)


@pytest.mark.parametrize(
    "call, error, words",
    [
        (lambda: disk_margin(control.tf([1], [1, -1])), ComputationError, "stable"),
        (lambda: disk_margin(np.ones((2, 1)) @ real("k", 1.0, percent=1)), InputError, "square loop"),
        (lambda: disk_margin(L, at="somewhere"), InputError, "outputs, inputs or both"),
        (lambda: disk_margin(L, skew=np.nan), InputError, "finite skew"),
        (lambda: disk_margin(SATELLITE, np.ones((1, 2))), InputError, "feedback of shape"),
        (lambda: disk_margin(control.frd(L, [1.0, 2.0])), InputError, "no(ne| states)"),
        (
            lambda: disk_margin(real("k", 1.0, percent=300) * tf([25.0], [1.0, 10.0, 10.0, 10.0])),
            ComputationError,
            "no margin",
        ),
    ],
)
def test_what_has_no_margin_is_refused_in_one_line(call, error, words):
    with pytest.raises(error, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
