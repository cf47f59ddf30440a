"""Weights: what they promise, on frequencies other than those of their design, and wrong input by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import hinf_norm, tf
from avis_ctrl.uncertainty.weights import Band, ComplianceBound, ControlEffort, NeglectedDynamics, TransmissibilityBound

ISOLATION = TransmissibilityBound(4.0, (Band(1.0, 10.0, -6.0),))
EVERY = [
    ISOLATION,
    ComplianceBound(1e-6, 1e-5, 0.5, 100.0),
    ControlEffort(10.0, 1e-5, 50.0),
    NeglectedDynamics(),
    NeglectedDynamics(order=2),
]


@pytest.mark.parametrize("weight", EVERY, ids=lambda w: type(w).__name__)
def test_every_weight_is_stable_minimum_phase_proper_and_realised_as_it_says(weight):
    system = weight.system("e", "z")
    assert (system.inputs, system.outputs, system.nstates) == (("e",), ("z",), weight.shape.order)
    assert system.is_stable() and np.all(weight.shape.zeros().real < 0)
    omega = 2 * np.pi * np.geomspace(0.01, 1000, 300)
    realised = np.abs(system.frequency_response(omega)[:, 0, 0])
    np.testing.assert_allclose(realised, weight.magnitude(omega), rtol=1e-8)
    np.testing.assert_allclose(weight.bound(omega), 1 / realised if weight.role == "limit" else realised, rtol=1e-8)
    assert weight.meaning and weight.unit is not None
    balance = np.log10(np.linalg.norm(system.B) / np.linalg.norm(system.C))
    assert abs(balance) < 6


def test_transmissibility_is_never_asked_laxer_than_specified_and_seldom_stricter():
    f = np.unique(np.concatenate([np.geomspace(1e-3, 1e4, 30011), [1.0, 10.0]]))
    asked, actual = ISOLATION.asked(2 * np.pi * f), ISOLATION.bound(2 * np.pi * f)
    stricter_dB = 20 * np.log10(asked / actual)
    assert np.min(stricter_dB) >= 0.0
    half = 2**0.5
    transition = ((f > 1 / half) & (f < 1)) | ((f > 10) & (f < 10 * half))
    assert np.max(stricter_dB[~transition]) < 0.5 + 0.01
    assert np.max(stricter_dB) < 10.5 + 0.01
    # The steps themselves: -6 dB at 1 Hz and 10 Hz, +4 dB half an octave outside (within the tolerance).
    assert 20 * np.log10(ISOLATION.bound(2 * np.pi * np.array([1.0, 10.0]))) == pytest.approx([-6, -6], abs=0.51)
    assert 20 * np.log10(ISOLATION.bound(2 * np.pi * np.array([0.7, 14.2]))) == pytest.approx([4, 4], abs=0.51)


def test_a_wider_transition_or_a_larger_tolerance_needs_no_more_states():
    orders = [
        TransmissibilityBound(4.0, (Band(1.0, 10.0, -6.0),), transition, tolerance).shape.order
        for transition, tolerance in ((0.35, 0.5), (0.5, 0.5), (0.7, 0.5), (0.5, 2.0), (1.0, 1.0))
    ]
    assert orders == sorted(orders, reverse=True)


def test_a_plant_within_the_bound_passes_and_one_outside_fails_the_weighted_norm():
    # |W T| <= 1 must follow from |T| <= bound: a constant transmissibility just below the strictest, and above.
    within, outside = 10 ** (-6.6 / 20), 10 ** (-5.9 / 20)
    W = ISOLATION.system()
    assert hinf_norm(W.scaled(within)).gain < 1.0 < hinf_norm(W.scaled(outside)).gain


def test_an_overall_limit_alone_is_a_constant_and_relaxation_frees_the_ends():
    assert TransmissibilityBound(6.0).system().nstates == 0
    free = TransmissibilityBound(4.0, (Band(1.0, 10.0, -6.0),), 0.7, 1.0, relaxed_above_Hz=40.0)
    f = np.geomspace(0.01, 40, 4001)
    assert np.min(free.asked(2 * np.pi * f) / free.bound(2 * np.pi * f)) >= 1.0
    assert np.isinf(free.asked(2 * np.pi * np.array([41.0])))[0]
    assert free.shape.order < TransmissibilityBound(4.0, (Band(1.0, 10.0, -6.0),), 0.7, 1.0).shape.order


def test_a_looser_band_is_opened_without_loosening_its_surroundings():
    weight = TransmissibilityBound(0.0, (Band(2.0, 4.0, 12.0),), 0.5, 1.0)
    f = np.concatenate([np.geomspace(0.02, 1.999, 500), np.geomspace(4.001, 400, 500)])
    assert np.max(weight.bound(2 * np.pi * f)) <= 1.0
    assert 20 * np.log10(weight.bound(2 * np.pi * np.array([2.83])))[0] > 11.0 - 0.1


def test_a_step_too_steep_for_the_order_says_what_to_change():
    with pytest.raises(ComputationError, match="transition"):
        _ = TransmissibilityBound(4.0, (Band(1.0, 10.0, -40.0),), 0.05, 0.1, max_order=2).shape


@given(low=st.floats(0.01, 0.9), crossover=st.floats(1.0, 1e3), high=st.floats(1.1, 20.0), order=st.integers(1, 2))
@settings(max_examples=40, deadline=None)
def test_neglected_dynamics_meet_their_three_numbers(low, crossover, high, order):
    weight = NeglectedDynamics(low, crossover, high, order)
    numbers = weight.magnitude(2 * np.pi * crossover * np.array([1e-9, 1.0, 1e9]))
    np.testing.assert_allclose(numbers, [low, 1.0, high], rtol=1e-6)
    rising = weight.magnitude(2 * np.pi * crossover * np.geomspace(1e-3, 1e3, 50))
    assert np.all(np.diff(rising) > -1e-12 * high)


def test_first_order_neglected_dynamics_equal_the_transfer_function_written_out():
    # tau from |tau s + 0.1| = |tau s/3 + 1| at 80 Hz.
    tau = np.sqrt(0.99 / (8 / 9)) / (2 * np.pi * 80)
    omega = np.geomspace(1, 1e4, 20)
    by_hand = tf([tau, 0.1], [tau / 3, 1]).frequency_response(omega)
    np.testing.assert_allclose(NeglectedDynamics().system().frequency_response(omega), by_hand, rtol=1e-10)


def test_control_effort_and_compliance_limits_at_both_ends():
    effort = ControlEffort(10.0, 1e-5, 50.0, reduction=10.0, order=2)
    np.testing.assert_allclose(effort.bound(np.array([1e-6, 1e9])), [1e6, 1e4], rtol=1e-6)
    assert ControlEffort(10.0, 2.0).bound(np.array([7.0]))[0] == pytest.approx(5.0)
    compliance = ComplianceBound(1e-6, 1e-5, 0.5)
    np.testing.assert_allclose(compliance.bound(np.array([1e-9, 1e9])), [1e-5, 1e-6], rtol=1e-6)
    rolled = ComplianceBound(1e-6, relaxed_above_Hz=100.0)
    assert rolled.bound(2 * np.pi * np.array([1e6]))[0] == pytest.approx(1e-6 * 1e4, rel=1e-6)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Band(10.0, 1.0, -6.0), "high_Hz"),
        (lambda: Band(0.0, 1.0, -6.0), "low_Hz"),
        (lambda: Band(1.0, 10.0, np.nan), "limit_dB"),
        (lambda: TransmissibilityBound("four"), "overall_dB"),
        (lambda: TransmissibilityBound(4.0, (Band(1, 10, -6), Band(5, 20, -3))), "bands"),
        (lambda: TransmissibilityBound(4.0, transition_octaves=0.0), "transition"),
        (lambda: ComplianceBound(-1.0), "limit_m_per_N"),
        (lambda: ComplianceBound(1e-6, 1e-7, 1.0), "static_limit"),
        (lambda: ComplianceBound(1e-6, 1e-5), "corner_Hz"),
        (lambda: ControlEffort(0.0), "limit_V"),
        (lambda: ControlEffort(10.0, np.nan), "disturbance_level"),
        (lambda: ControlEffort(10.0, reduction=0.5), "reduction"),
        (lambda: NeglectedDynamics(1.2), "low"),
        (lambda: NeglectedDynamics(high=0.9), "high"),
        (lambda: NeglectedDynamics(order=3), "order"),
        (lambda: NeglectedDynamics(crossover_Hz=-80.0), "crossover_Hz"),
    ],
)
def test_wrong_weights_are_refused_by_name(make, field):
    with pytest.raises(InputError, match=field):
        make()
