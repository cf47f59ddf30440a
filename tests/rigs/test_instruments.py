"""Sensor and actuator chains against their limits, and against noise measured on samples."""

from __future__ import annotations

from math import factorial

import control
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.lti import hinf_norm
from avis_ctrl.rigs.converter import Converter, quantise
from avis_ctrl.rigs.delay_models import pade_delay, zero_order_hold

AVIS_CONVERTER = Converter(14, 10.0, 1000.0)


def response(system, frequency_Hz):
    return system.frequency_response(2 * np.pi * np.atleast_1d(frequency_Hz))[:, 0, 0]


def test_rounding_noise_of_a_random_signal_is_lsb_squared_over_12(rng):
    signal = rng.normal(0.0, 1.0, 200_000)
    error = AVIS_CONVERTER.convert(signal) - signal
    variance = AVIS_CONVERTER.lsb_V**2 / 12
    # Variance of the estimate for a uniform error: (1/80 - 1/144) lsb^4 / n; five standard deviations.
    spread = AVIS_CONVERTER.lsb_V**2 * np.sqrt((1 / 80 - 1 / 144) / signal.size)
    assert abs(np.mean(error**2) - variance) < 5 * spread
    assert AVIS_CONVERTER.noise_rms_V**2 == pytest.approx(variance)


def test_rounding_noise_is_white_with_the_density_stated(rng):
    signal = rng.normal(0.0, 1.0, 2**17)
    error = AVIS_CONVERTER.convert(signal) - signal
    lines = np.abs(np.fft.rfft(error)[1:-1]) ** 2 * 2 / (error.size * 1000.0)
    bands = lines[: lines.size // 16 * 16].reshape(16, -1).mean(axis=1)
    # Each band averages about 4096 exponential lines: 1/64 relative standard deviation, five of them.
    np.testing.assert_allclose(bands, AVIS_CONVERTER.noise_density_V_rtHz**2, rtol=5 / 64)


def test_converter_clips_at_its_end_codes_and_has_one_code_less_above():
    volts = AVIS_CONVERTER.convert(np.array([-50.0, 50.0, 0.0, 3.2]))
    assert volts[0] == -10.0
    assert volts[1] == 10.0 - 20.0 / 2**14
    assert volts[2] == 0.0
    assert AVIS_CONVERTER.clipped(np.array([-10.5, 10.5, 9.0])).tolist() == [True, True, False]


def test_compiled_sample_quantiser_equals_the_array_one(rng):
    compiled = numba.njit(quantise)
    voltage = np.concatenate([rng.uniform(-12, 12, 2000), [np.inf, -np.inf]])
    one_by_one = [compiled(v, AVIS_CONVERTER.lsb_V, *AVIS_CONVERTER.limits_V) for v in voltage]
    np.testing.assert_array_equal(one_by_one, AVIS_CONVERTER.convert(voltage))


@pytest.mark.parametrize("order", [1, 2, 3, 4, 6])
def test_pade_delay_is_all_pass_with_the_phase_of_the_delay(order):
    delay = 1e-3
    system = pade_delay(delay, order)
    frequency = np.geomspace(0.1, 1e4, 50)
    np.testing.assert_allclose(np.abs(response(system, frequency)), 1.0, rtol=1e-10)
    # Leading phase error of the diagonal approximant, (n!)^2 x^(2n+1) / ((2n)! (2n+1)!) (Baker and Graves-Morris,
    # Pade Approximants, section 1.2: error of the [n/n] approximant of the exponential).
    x = 0.25 * order
    error = np.angle(response(system, x / delay / (2 * np.pi))[0] * np.exp(1j * x))
    leading = factorial(order) ** 2 * x ** (2 * order + 1) / (factorial(2 * order) * factorial(2 * order + 1))
    assert error == pytest.approx(leading, rel=0.05)


def test_second_order_pade_of_one_millisecond_is_exact_to_a_hundredth_of_a_degree_at_80_hz():
    phase = np.angle(response(pade_delay(1e-3, 2), 80.0)[0], deg=True)
    assert phase == pytest.approx(-28.8, abs=0.01)


@given(delay=st.floats(1e-6, 10.0), order=st.integers(1, 8))
@settings(max_examples=30, deadline=None)
def test_pade_delay_is_balanced_at_any_delay(delay, order):
    system = pade_delay(delay, order)
    assert control.hankel_singular_values(system.to_control()) == pytest.approx(np.ones(order), rel=1e-6)
    assert hinf_norm(system).gain == pytest.approx(1.0, rel=1e-6)


def test_no_delay_is_a_wire():
    assert pade_delay(0.0).nstates == 0


def test_zero_order_hold_model_follows_the_sinc():
    T, f = 1e-3, np.array([1.0, 30.0, 100.0])
    x = 2j * np.pi * f * T
    np.testing.assert_allclose(response(zero_order_hold(T, 3), f), (1 - np.exp(-x)) / x, rtol=2e-6)
    assert zero_order_hold(T, 2).dcgain()[0, 0] == pytest.approx(1.0, rel=1e-13)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Converter(0, 10.0, 1000.0), "bits"),
        (lambda: Converter(14.5, 10.0, 1000.0), "bits"),
        (lambda: Converter(33, 10.0, 1000.0), "bits = 33: expected a whole number of bits from 1 to 32"),
        (lambda: Converter(14, np.inf, 1000.0), "range_V"),
        (lambda: pade_delay(1e-3, 0), "order"),
        (lambda: pade_delay(1e-3, 40), "order"),
        (lambda: zero_order_hold(0.0), "sample_time"),
    ],
)
def test_wrong_numbers_are_refused_by_name(make, field):
    with pytest.raises(InputError, match=field):
        make()
