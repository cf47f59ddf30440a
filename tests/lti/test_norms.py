"""System norms against SLICOT, closed forms and dense grids."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, discretise, gain, hinf_norm, tf
from avis_ctrl.lti.norms import largest_singular_value, norm_is_below


def random_stable(rng, n, n_y, n_u, direct=1.0, margin=None):
    A = rng.standard_normal((n, n))
    shift = rng.uniform(1e-4, 1.0) if margin is None else margin
    A -= (max(np.linalg.eigvals(A).real, default=0.0) + shift) * np.eye(n)
    return StateSpace(
        A, rng.standard_normal((n, n_u)), rng.standard_normal((n_y, n)), direct * rng.standard_normal((n_y, n_u))
    )


@pytest.mark.parametrize("zeta", [0.3, 1e-2, 1e-4, 1e-7])
@pytest.mark.parametrize("w0", [1e-3, 1.0, 1e5])
def test_resonance_in_closed_form(w0, zeta):
    """|w0^2 / (s^2 + 2 zeta w0 s + w0^2)| peaks at 1 / (2 zeta sqrt(1 - zeta^2)), w = w0 sqrt(1 - 2 zeta^2)."""
    peak = hinf_norm(tf([w0**2], [1, 2 * zeta * w0, w0**2]))
    assert peak.gain == pytest.approx(1 / (2 * zeta * np.sqrt(1 - zeta**2)), rel=1e-6)
    assert peak.omega == pytest.approx(w0 * np.sqrt(1 - 2 * zeta**2), rel=1e-3)


@given(st.integers(0, 2**31), st.integers(1, 12), st.sampled_from([0.0, 1.0]))
@settings(max_examples=60, deadline=None)
def test_hinf_norm_agrees_with_slicot(seed, n, direct):
    G = random_stable(np.random.default_rng(seed), n, 2, 3, direct)
    expected, _ = control.linfnorm(G.to_control(), tol=1e-10)
    assert hinf_norm(G).gain == pytest.approx(expected, rel=1.1e-6)


@given(st.integers(0, 2**31), st.integers(1, 12), st.sampled_from([0.0, 1.0]))
@settings(max_examples=40, deadline=None)
def test_a_level_is_compared_as_by_slicot(seed, n, direct):
    G = random_stable(np.random.default_rng(seed), n, 2, 3, direct)
    expected, _ = control.linfnorm(G.to_control(), tol=1e-10)
    assert norm_is_below(G, expected * (1 + 1e-5)) and not norm_is_below(G, expected * (1 - 1e-5))
    assert not norm_is_below(StateSpace(-G.A, G.B, G.C, G.D), 10 * expected)


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_sampled_norm_agrees_with_slicot_and_its_own_frequency(seed):
    G = discretise(random_stable(np.random.default_rng(seed), 4, 2, 2), 0.1, "zoh")
    peak = hinf_norm(G)
    expected, _ = control.linfnorm(G.to_control(), tol=1e-10)
    assert peak.gain == pytest.approx(expected, rel=1.1e-6)
    assert np.linalg.norm(G.frequency_response([peak.omega])[0], 2) == pytest.approx(peak.gain, rel=1e-6)


def test_the_norm_of_a_system_of_python_control():
    peak = hinf_norm(control.tf([1.0], [1.0, 0.2, 1.0]))
    assert peak.gain == pytest.approx(1 / (0.2 * np.sqrt(0.99)), rel=1e-6)


def test_flat_responses():
    """All-pass systems: every frequency is a crossing, and the norm is the gain."""
    zeros = np.array([1.0, 3.0, 3.1, 40.0])
    for k in range(1, 5):
        flat = tf(np.poly(zeros[:k]), np.poly(-zeros[:k]))
        assert hinf_norm(flat).gain == pytest.approx(1.0, rel=1e-6)
        almost = flat @ tf([1, 1.001], [1, 1.0])
        assert hinf_norm(almost).gain == pytest.approx(1.001, rel=1e-6)


def test_many_close_resonances():
    """A dense grid of a chain of lightly damped modes never exceeds the norm and comes near it."""
    rng = np.random.default_rng(3)
    G = tf([1], [1, 1])
    for w0 in np.sort(rng.uniform(5, 50, 20)):
        G = G + tf([w0], [1, 2e-4 * w0, w0**2]).renamed(["u0"], ["y0"])
    peak = hinf_norm(G)
    omega = np.concatenate([np.abs(p.imag) + np.linspace(-3, 3, 2001) * abs(p.real) for p in G.poles() if p.imag > 0])
    on_grid = np.max(np.abs(G.frequency_response(omega)))
    assert on_grid <= peak.gain * (1 + 1e-6)
    assert on_grid == pytest.approx(peak.gain, rel=1e-5)


def test_norms_without_states_or_stability():
    assert hinf_norm(gain([[3.0, 4.0]])).gain == pytest.approx(5.0)
    assert hinf_norm(gain(np.zeros((2, 2)))).gain == 0.0
    assert hinf_norm(tf([1], [1, -1])).gain == np.inf


def test_a_response_beyond_all_numbers_is_said():
    """1e20 / 1e-300 at rest."""
    with np.errstate(all="ignore"), pytest.raises(ComputationError, match="overflows"):
        hinf_norm(StateSpace([[-1e-300]], [[1e10]], [[1e10]], [[0.0]]))


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 3), (2, 5), (7, 4)])
@pytest.mark.parametrize("size", [1.0, 1e-200, 1e200])
def test_largest_singular_value_is_that_of_the_decomposition(rng, shape, size):
    M = size * (rng.standard_normal((20, 3, *shape)) + 1j * rng.standard_normal((20, 3, *shape)))
    M[0] = 0.0
    M[1, :, -1] = M[1, :, 0]
    np.testing.assert_allclose(largest_singular_value(M), np.linalg.svd(M, compute_uv=False)[..., 0], rtol=1e-7)
    np.testing.assert_allclose(
        largest_singular_value(M[2:]), np.linalg.svd(M[2:], compute_uv=False)[..., 0], rtol=1e-13
    )


def test_a_matrix_without_entries_has_no_gain():
    assert np.array_equal(largest_singular_value(np.zeros((4, 3, 0))), np.zeros(4))
