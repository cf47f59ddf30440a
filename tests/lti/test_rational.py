"""Factored rational functions and their fits against polynomials and known answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from avis_ctrl.errors import InputError
from avis_ctrl.lti import tf
from avis_ctrl.lti.magnitude_fit import covering_fit, magnitude_fit
from avis_ctrl.lti.rational import Rational, cascade

SECTIONS = st.lists(st.tuples(st.floats(0.01, 1e3), st.floats(0.02, 3.0)), min_size=0, max_size=3)


@given(pole_pairs=SECTIONS, zero_pairs=SECTIONS, singles=st.lists(st.floats(0.01, 1e3), min_size=0, max_size=3))
@settings(max_examples=60, deadline=None)
def test_a_cascade_has_the_response_of_its_factors(pole_pairs, zero_pairs, singles):
    zero_pairs = zero_pairs[: len(pole_pairs)]
    function = Rational(2.5, tuple(zero_pairs), tuple(pole_pairs), (), tuple(singles))
    system = function.system("a", "b")
    omega = np.geomspace(1e-3, 1e4, 40)
    assert system.nstates == function.order
    # Far below the peak a state-space sum loses digits of the sum, whatever its realisation.
    np.testing.assert_allclose(
        system.frequency_response(omega)[:, 0, 0],
        function(1j * omega),
        rtol=1e-6,
        atol=1e-12 * np.max(function.magnitude(omega)),
    )


def test_the_inverse_exchanges_zeros_and_poles():
    inverse = Rational(2.0, ((1.0, 0.5),), ((3.0, 0.5),)).inverse()
    assert inverse.gain == 0.5 and inverse.pole_pairs == ((1.0, 0.5),)


def test_a_cascade_equals_the_polynomial_fraction_and_keeps_zeros_at_the_origin():
    omega = np.geomspace(0.01, 1e3, 30)
    by_polynomials = tf(4 * np.poly([0, 0, -3]), np.poly([-1, -2, -5 + 2j, -5 - 2j]).real)
    system = cascade([0, 0, -3], [-1, -2, -5 + 2j, -5 - 2j], 4.0)
    np.testing.assert_allclose(system.frequency_response(omega), by_polynomials.frequency_response(omega), rtol=1e-9)
    negative = cascade([], [-1.0], -2.0)
    assert negative.dcgain()[0, 0] == pytest.approx(-2.0)


@pytest.mark.parametrize("order", [2, 4, 5])
def test_a_fit_finds_the_function_that_made_the_magnitude(order):
    functions = {
        2: Rational(2.0, ((1.0, 0.2),), ((5.0, 0.4),)),
        4: Rational(0.5, ((1.0, 0.1), (30.0, 0.5)), ((4.0, 0.3), (10.0, 0.25))),
        5: Rational(0.5, ((1.0, 0.1), (30.0, 0.5)), ((4.0, 0.3), (10.0, 0.25)), (0.5,), (2.0,)),
    }
    omega = np.geomspace(0.05, 500, 200)
    fit = magnitude_fit(omega, functions[order].magnitude(omega), order)
    assert fit.error_max_dB < 1e-3
    found, true = (np.sort_complex(function.poles()) for function in (fit.function, functions[order]))
    np.testing.assert_allclose(found, true, rtol=1e-3)


def test_errors_of_a_fit_are_what_they_say():
    omega = np.geomspace(0.1, 100, 150)
    magnitude = 1 + 0.5 * np.sin(np.log(omega) * 2)
    for order in (0, 2, 4):
        fit = magnitude_fit(omega, magnitude, order)
        error = 20 * np.log10(fit.function.magnitude(omega) / magnitude)
        assert fit.error_max_dB == pytest.approx(np.max(np.abs(error)))
        assert fit.error_rms_dB == pytest.approx(np.sqrt(np.mean(error**2)))
        assert fit.function.order == order


def test_a_constant_cover_sits_on_the_highest_point():
    omega = np.geomspace(0.1, 10, 30)
    magnitude = omega / (1 + omega)
    fit = covering_fit(omega, magnitude, magnitude, 0)
    assert fit.function.gain == pytest.approx(np.max(magnitude))
    assert fit.error_max_dB == pytest.approx(20 * np.log10(np.max(magnitude) / np.min(magnitude)))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_cover_of_a_half_order_slope_equals_the_chebyshev_bound_found_otherwise(order):
    # Minimax fit of sqrt(omega) in dB: the excess of a one-sided cover is twice that of the two-sided problem, so that
    # lifting the best symmetric fit (p-norm minimised by another solver) cannot do better than the cover by 2 %.
    omega = np.geomspace(0.1, 10, 80)
    fit = covering_fit(omega, np.sqrt(omega), np.sqrt(omega), order)
    ratio = fit.function.magnitude(omega) / np.sqrt(omega)
    assert np.min(ratio) >= 1 - 1e-9

    def spread(x):
        value = (
            sum(np.log(omega**2 + np.exp(2 * z)) - np.log(omega**2 + np.exp(2 * p)) for z, p in x.reshape(-1, 2)) / 2
            - np.log(omega) / 2
        )
        return 20 / np.log(10) * (np.max(value) - np.min(value))

    corners = np.log(np.geomspace(0.05, 20, 2 * order)).reshape(-1, 2)
    other = minimize(spread, corners.ravel(), method="Nelder-Mead", options={"maxiter": 4000, "fatol": 1e-6})
    assert fit.error_max_dB < 1.02 * other.fun


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Rational(0.0), "gain"),
        (lambda: Rational(1.0, pole_pairs=((1.0, -0.1),)), "pole_pairs"),
        (lambda: Rational(1.0, real_poles=(np.nan,)), "real_poles"),
        (lambda: Rational(1.0, real_zeros=(1.0,)), "improper"),
        (lambda: cascade([-1.0], [], 1.0), "improper"),
        (lambda: cascade([], [1j], 1.0), "conjugate"),
        (lambda: Rational(1.0, real_poles=(1.0,)).inverse(), "improper"),
        (lambda: magnitude_fit(np.ones(3), np.ones(3), 1), "omega"),
        (lambda: magnitude_fit(np.arange(1, 4.0), np.array([1.0, -1.0, 1.0]), 1), "magnitude"),
        (lambda: magnitude_fit(np.arange(1, 4.0), np.ones(2), 1), "omega"),
        (lambda: magnitude_fit(np.arange(1, 4.0), np.ones(3), 1, 2), "order"),
        (lambda: covering_fit(np.arange(1, 4.0), 2 * np.ones(3), np.ones(3), 1), "lower"),
    ],
)
def test_wrong_input_is_refused_by_name(make, field):
    with pytest.raises(InputError, match=field):
        make()
