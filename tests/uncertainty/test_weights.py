"""Weights: what they promise, on frequencies other than those of their design."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import hinf_norm, tf
from avis_ctrl.uncertainty.weights import ComplianceBound, ControlEffort, NeglectedDynamics, TransmissibilityBound

ISOLATION = TransmissibilityBound(4.0, (1.0, 10.0), -6.0, 0.5, 0.5)
CHAIN = NeglectedDynamics(0.1, 80.0, 3.0)
EVERY = [ISOLATION, ControlEffort(10.0, 1e-5, 50.0, 10.0, 3.0, 0.003), CHAIN]


@pytest.mark.parametrize("weight", EVERY, ids=lambda w: type(w).__name__)
def test_every_weight_is_stable_minimum_phase_proper_and_realised_as_it_says(weight):
    system = weight.system("e", "z")
    assert (system.inputs, system.outputs, system.nstates) == (("e",), ("z",), weight.shape.order)
    assert system.is_stable() and np.all(weight.shape.zeros().real < 0)
    omega = 2 * np.pi * np.geomspace(0.01, 1000, 300)
    realised = np.abs(system.frequency_response(omega)[:, 0, 0])
    np.testing.assert_allclose(realised, weight.magnitude(omega), rtol=1e-8)
    np.testing.assert_allclose(weight.limit(omega), 1 / realised, rtol=1e-8)
    assert weight.meaning
    balance = np.log10(np.linalg.norm(system.B) / np.linalg.norm(system.C))
    assert abs(balance) < 6


def test_transmissibility_is_never_asked_laxer_than_specified_and_seldom_stricter():
    f = np.unique(np.concatenate([np.geomspace(1e-3, 1e4, 30011), [1.0, 10.0]]))
    asked, actual = ISOLATION.asked(2 * np.pi * f), ISOLATION.limit(2 * np.pi * f)
    stricter_dB = 20 * np.log10(asked / actual)
    assert np.min(stricter_dB) >= 0.0
    half = 2**0.5
    transition = ((f > 1 / half) & (f < 1)) | ((f > 10) & (f < 10 * half))
    assert np.max(stricter_dB[~transition]) < 0.5 + 0.01
    assert np.max(stricter_dB) < 10.5 + 0.01
    # The steps themselves: -6 dB at 1 Hz and 10 Hz, +4 dB half an octave outside (within the tolerance).
    assert 20 * np.log10(ISOLATION.limit(2 * np.pi * np.array([1.0, 10.0]))) == pytest.approx([-6, -6], abs=0.51)
    assert 20 * np.log10(ISOLATION.limit(2 * np.pi * np.array([0.7, 14.2]))) == pytest.approx([4, 4], abs=0.51)


@pytest.mark.slow
def test_a_wider_transition_or_a_larger_tolerance_needs_no_more_states():
    orders = [
        TransmissibilityBound(4.0, (1.0, 10.0), -6.0, transition, tolerance).shape.order
        for transition, tolerance in ((0.35, 0.5), (0.5, 0.5), (0.7, 0.5), (0.5, 2.0), (1.0, 1.0))
    ]
    assert orders == sorted(orders, reverse=True)


def test_a_plant_within_the_bound_passes_and_one_outside_fails_the_weighted_norm():
    # |W T| <= 1 must follow from |T| <= bound: a constant transmissibility just below the strictest, and above.
    within, outside = 10 ** (-6.6 / 20), 10 ** (-5.9 / 20)
    W = ISOLATION.system()
    assert hinf_norm(W.scaled(within)).gain < 1.0 < hinf_norm(W.scaled(outside)).gain


def test_a_looser_band_is_opened_without_loosening_its_surroundings():
    weight = TransmissibilityBound(0.0, (2.0, 4.0), 12.0, 0.5, 1.0)
    f = np.concatenate([np.geomspace(0.02, 1.999, 500), np.geomspace(4.001, 400, 500)])
    assert np.max(weight.limit(2 * np.pi * f)) <= 1.0
    assert 20 * np.log10(weight.limit(2 * np.pi * np.array([2.83])))[0] > 11.0 - 0.1


def test_a_step_too_steep_for_the_order_says_what_to_change():
    with pytest.raises(ComputationError, match="transition"):
        _ = TransmissibilityBound(4.0, (1.0, 10.0), -40.0, 0.05, 0.1, max_order=2).shape


@given(low=st.floats(0.01, 0.9), crossover=st.floats(1.0, 1e3), high=st.floats(1.1, 20.0))
@settings(max_examples=40, deadline=None)
def test_neglected_dynamics_meet_their_three_numbers(low, crossover, high):
    weight = NeglectedDynamics(low, crossover, high)
    numbers = weight.magnitude(2 * np.pi * crossover * np.array([1e-9, 1.0, 1e9]))
    np.testing.assert_allclose(numbers, [low, 1.0, high], rtol=1e-6)
    rising = weight.magnitude(2 * np.pi * crossover * np.geomspace(1e-3, 1e3, 50))
    assert np.all(np.diff(rising) > -1e-12 * high)


def test_neglected_dynamics_equal_the_transfer_function_written_out():
    # tau from |tau s + 0.1| = |tau s/3 + 1| at 80 Hz.
    tau = np.sqrt(0.99 / (8 / 9)) / (2 * np.pi * 80)
    omega = np.geomspace(1, 1e4, 20)
    by_hand = tf([tau, 0.1], [tau / 3, 1]).frequency_response(omega)
    np.testing.assert_allclose(CHAIN.system().frequency_response(omega), by_hand, rtol=1e-10)


def test_control_effort_and_compliance_limits_at_both_ends():
    effort = ControlEffort(10.0, 1e-5, 50.0, 10.0, 0.0, 0.003)
    np.testing.assert_allclose(effort.limit(np.array([1e-6, 1e9])), [1e6, 1e5], rtol=1e-6)
    compliance = ComplianceBound(1e-6)
    assert compliance.system().nstates == 0
    np.testing.assert_allclose(compliance.limit(np.array([1e-9, 1e9])), 1e-6, rtol=1e-12)
