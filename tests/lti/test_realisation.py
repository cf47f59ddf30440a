"""Balancing, reduction and sampling against their theorems."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, balance, balanced_truncation, discretise, gain, hinf_norm, minimal, tf


def random_stable(rng, n, n_y=2, n_u=2):
    A = rng.standard_normal((n, n))
    A -= (np.max(np.linalg.eigvals(A).real) + rng.uniform(0.05, 1.0)) * np.eye(n)
    return StateSpace(A, rng.standard_normal((n, n_u)), rng.standard_normal((n_y, n)), rng.standard_normal((n_y, n_u)))


@given(st.integers(0, 2**31), st.integers(2, 9))
@settings(max_examples=40, deadline=None)
def test_truncation_error_is_within_its_bound(seed, n):
    """||G - G_k|| <= 2 (sigma_k+1 + ... + sigma_n), and at least sigma_k+1 (Enns 1984; Glover 1984)."""
    rng = np.random.default_rng(seed)
    G = random_stable(rng, n)
    sigma = control.hankel_singular_values(G.to_control())
    k = int(rng.integers(0, n))
    reduced = balanced_truncation(G, k)
    assert reduced.nstates <= k and reduced.is_stable()
    error = hinf_norm(G - reduced).gain
    assert error <= 2 * np.sum(sigma[k:]) * (1 + 1e-6) + 1e-9 * sigma[0]
    assert error >= sigma[k] * (1 - 1e-6) - 1e-9 * sigma[0]


def test_gramians_of_an_unstable_system_are_refused():
    with pytest.raises(ComputationError, match="stable systems only"):
        balanced_truncation(tf([1], [1, -1]), 1)


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_balance_is_exact_and_evens_out(seed):
    rng = np.random.default_rng(seed)
    G = random_stable(rng, 5)
    wild = G.similar(np.diag(10.0 ** rng.uniform(-8, 8, 5)))
    tame = balance(wild)
    scale = np.diag(tame.A - wild.A)
    np.testing.assert_allclose(scale, 0.0)
    np.testing.assert_allclose(tame(2j), G(2j), rtol=1e-8)
    assert np.linalg.cond(tame.A) < 1e3 * np.linalg.cond(G.A)


def test_minimal_removes_what_is_hidden(rng):
    G = random_stable(rng, 3)
    hidden = StateSpace(
        np.block(
            [
                [G.A, rng.standard_normal((3, 2)), np.zeros((3, 2))],
                [np.zeros((2, 3)), -np.eye(2), np.zeros((2, 2))],
                [rng.standard_normal((2, 5)), -2 * np.eye(2)],
            ]
        ),
        np.vstack([G.B, np.zeros((2, 2)), rng.standard_normal((2, 2))]),
        np.hstack([G.C, rng.standard_normal((2, 2)), np.zeros((2, 2))]),
        G.D,
    )
    smaller = minimal(hidden)
    assert smaller.nstates == 3
    np.testing.assert_allclose(smaller(0.5j), G(0.5j), rtol=1e-8)


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_sampling_agrees_with_python_control(rng, method):
    G = random_stable(rng, 4)
    ours = discretise(G, 0.05, method)
    theirs = control.sample_system(G.to_control(), 0.05, "zoh" if method == "zoh" else "bilinear")
    z = np.exp(0.3j)
    np.testing.assert_allclose(ours(z), theirs(z), rtol=1e-8)


@pytest.mark.parametrize("method", ["bilinear", "Tustin", "", None])
def test_unknown_ways_of_sampling_are_refused(rng, method):
    for G in (random_stable(rng, 2), gain([[1.0]])):
        with pytest.raises(InputError, match="'zoh' or 'tustin'"):
            discretise(G, 0.1, method)


def test_tustin_keeps_the_norm(rng):
    G = random_stable(rng, 4)
    assert hinf_norm(discretise(G, 0.02)).gain == pytest.approx(hinf_norm(G).gain, rel=2e-6)


def test_wrong_sample_time(rng):
    with pytest.raises(InputError, match="positive"):
        discretise(random_stable(rng, 2), 0.0)
    with pytest.raises(InputError, match="already sampled"):
        discretise(discretise(random_stable(rng, 2), 0.1), 0.1)


def test_the_message_of_an_unstable_system_is_in_its_own_plane():
    for dt, words in ((0.0, "largest real part 2 rad/s"), (0.1, "largest magnitude of a pole 2$")):
        with pytest.raises(ComputationError, match=words):
            balanced_truncation(StateSpace([[2.0]], [[1.0]], [[1.0]], [[0.0]], dt), 0)
