"""Connection by name and linear fractional transformations, against block algebra."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, connect, gain, lft_lower, lft_upper, summing_junction, tf


def random_system(rng, n, n_y, n_u, inputs=(), outputs=()):
    return StateSpace(
        rng.standard_normal((n, n)),
        rng.standard_normal((n, n_u)),
        rng.standard_normal((n_y, n)),
        0.2 * rng.standard_normal((n_y, n_u)),
        0.0,
        inputs,
        outputs,
    )


def test_feedback_loop_agrees_with_python_control():
    G, K = tf([200], [0.025, 1.0025, 10.1, 1], ["u"], ["g"]), tf([1, 2], [1, 3], ["e"], ["u"])
    loop = connect({"plant": G, "controller": K, "error": summing_junction("e", ["r", "-g"])}, ["r"], ["g", "u", "e"])
    L = K.to_control(), G.to_control()
    expected = control.feedback(control.series(*L), 1)
    for s in (0.1j, 3j, 40j):
        assert loop(s)[0, 0] == pytest.approx(expected(s), rel=1e-9)
        assert loop(s)[2, 0] == pytest.approx(1 / (1 + G(s)[0, 0] * K(s)[0, 0]), rel=1e-9)


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_connect_with_direct_terms_solves_the_signal_equations(seed):
    rng = np.random.default_rng(seed)
    G = random_system(rng, 3, 2, 2, ["a", "w"], ["b", "z"])
    H = random_system(rng, 2, 1, 1, ["b"], ["a"])
    closed = connect([G, H], ["w"], ["z", "a"])
    s = 0.3 + 1.7j
    g, h = G(s), H(s)[0, 0]
    b = g[0, 1] / (1 - g[0, 0] * h)
    np.testing.assert_allclose(closed(s)[:, 0], [g[1, 0] * h * b + g[1, 1], h * b], rtol=1e-7)


@given(st.integers(0, 2**31), st.integers(0, 4), st.integers(0, 3))
@settings(max_examples=40, deadline=None)
def test_lft_formulas(seed, n, n_k):
    rng = np.random.default_rng(seed)
    P, K = random_system(rng, n, 5, 4), random_system(rng, n_k, 1, 2)
    s = 0.4 + 2.2j
    p, k = P(s), K(s)
    lower = p[:3, :3] + p[:3, 3:] @ k @ np.linalg.solve(np.eye(2) - p[3:, 3:] @ k, p[3:, :3])
    np.testing.assert_allclose(lft_lower(P, K)(s), lower, rtol=1e-7, atol=1e-9)
    delta = rng.standard_normal((1, 2)) * 0.3
    upper = p[2:, 1:] + p[2:, :1] @ delta @ np.linalg.solve(np.eye(2) - p[:2, :1] @ delta, p[:2, 1:])
    np.testing.assert_allclose(lft_upper(P, delta)(s), upper, rtol=1e-7, atol=1e-9)


def test_lft_keeps_the_outer_names():
    P = tf([1], [1, 1], ["u"], ["y"])
    plant = connect([P, summing_junction("z", ["y", "w"])], ["w", "u"], ["z", "y"])
    closed = lft_lower(plant, gain([[-1.0]]))
    assert closed.inputs == ("w",) and closed.outputs == ("z",)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: connect([gain([[1.0]], ["a"], ["b"])], [], ["b"]), "'a' is read by part 0 but driven by nothing"),
        (lambda: connect([gain([[1.0]], ["a"], ["b"]), gain([[1.0]], ["a"], ["b"])], ["a"], ["b"]), "driven twice"),
        (lambda: connect([gain([[1.0]], ["a"], ["b"])], ["a"], ["c"]), r"output \['c'\] is driven by nothing"),
        (lambda: connect([gain([[1.0]], ["a"], ["b"])], ["a", "a"], ["b"]), "named twice"),
        (lambda: lft_lower(gain(np.eye(2)), gain(np.eye(3))), "does not fit"),
    ],
)
def test_wrong_wiring_names_the_signal(build, message):
    with pytest.raises(InputError, match=message):
        build()


def test_algebraic_loop_is_refused():
    with pytest.raises(ComputationError, match="not well posed"):
        connect([gain([[1.0]], ["a"], ["b"]), gain([[1.0]], ["b"], ["a"])], [], ["b"])
