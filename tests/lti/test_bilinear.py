"""The bilinear map against its definition at points of the unit circle, and what it refuses."""

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, discretise, gain, hinf_norm, lft_lower, tf
from avis_ctrl.lti.bilinear import continuous_image, image_frequency, sampled_frequency, sampled_image


def sampled(rng, n=5, dt=1e-3):
    """Random poles within radius 0.95, some negative, some at zero."""
    A = rng.standard_normal((n, n))
    A *= 0.95 / np.max(np.abs(np.linalg.eigvals(A)))
    return StateSpace(A, rng.standard_normal((n, 2)), rng.standard_normal((3, n)), rng.standard_normal((3, 2)), dt)


@pytest.mark.parametrize("dt", [1e-4, 1.0, 30.0])
def test_image_has_the_response_of_the_circle_at_the_warped_frequency(rng, dt):
    """Both responses by elimination, from their definitions; half the sample rate is the direct term of the image."""
    G = sampled(rng, dt=dt)
    image = continuous_image(G)
    assert image.dt == 0.0 and image.is_stable() and image.inputs == G.inputs
    for turn in (0.0, 0.01, 0.7, 2.5, 3.1):
        z = np.exp(1j * turn)
        s = 2 / dt * (z - 1) / (z + 1)
        on_circle = G.C @ np.linalg.solve(z * np.eye(5) - G.A, G.B) + G.D
        on_axis = image.C @ np.linalg.solve(s * np.eye(5) - image.A, image.B) + image.D
        assert np.allclose(on_circle, on_axis, rtol=1e-9)
        assert image_frequency(turn / dt, dt) == pytest.approx(s.imag, rel=1e-9, abs=1e-12)
        assert sampled_frequency(s.imag, dt) == pytest.approx(turn / dt, rel=1e-9, abs=1e-12)
    assert np.allclose(image.D, G.C @ np.linalg.solve(-np.eye(5) - G.A, G.B) + G.D)
    assert image_frequency(np.pi / dt, dt) == np.inf and sampled_frequency(np.inf, dt) == pytest.approx(np.pi / dt)


def test_there_and_back_is_the_same_system(rng):
    G = sampled(rng)
    again = sampled_image(continuous_image(G), G.dt)
    omega = np.linspace(0, np.pi / G.dt, 7)
    assert again.dt == G.dt and np.allclose(again.frequency_response(omega), G.frequency_response(omega), rtol=1e-9)
    assert continuous_image(tf([1], [1, 1])).dt == 0.0
    assert sampled_image(gain([[2.0]]), 0.1).dt == 0.1


def test_tustin_is_the_same_map(rng):
    G = continuous_image(sampled(rng, dt=0.1))
    omega = np.array([0.1, 3.0, 30.0])
    a, b = discretise(G, 0.1, "tustin"), sampled_image(G, 0.1)
    assert np.allclose(a.frequency_response(omega), b.frequency_response(omega), rtol=1e-10)


def test_poles_that_go_to_infinity_are_refused():
    """A derivative by the bilinear rule, 2/dt (z - 1)/(z + 1), and a pole at the point that becomes z = infinity."""
    derivative = StateSpace([[-1.0]], [[1.0]], [[-40.0]], [[20.0]], 0.1)
    with pytest.raises(ComputationError, match="pole at z = -1, half the sample rate"):
        continuous_image(derivative)
    with pytest.raises(ComputationError, match=r"pole at s = 2/dt = 20 rad/s has no sampled image"):
        sampled_image(tf([1.0], [1.0, -20.0]), 0.1)


def test_units_of_the_states_do_not_make_a_pole_at_minus_one():
    G = StateSpace([[0.5, 0.3], [0.1, -0.9]], [[1.0], [1.0]], [[1.0, 1.0]], [[0.0]], 0.1)
    odd = G.similar(np.array([[1e8, 1e-7], [0.0, 1e-8]]))
    assert hinf_norm(odd).gain == pytest.approx(hinf_norm(G).gain, rel=1e-6)


def test_different_clocks_do_not_connect(rng):
    P, K = sampled(rng, dt=0.1), StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.2)
    for other in (K, tf([1], [1, 1])):
        with pytest.raises(InputError, match="different sample times"):
            lft_lower(P, other)
