"""Named linear systems: shapes, algebra, evaluation, exchange with python-control."""

from __future__ import annotations

import pickle

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, append, gain, tf
from avis_ctrl.uncertainty.uncertain_models import matrix, real

coefficients = st.lists(st.floats(0.1, 50), min_size=1, max_size=5)


def random_system(rng, n, n_y, n_u, names=("", "")):
    A = rng.standard_normal((n, n))
    A -= (max(np.linalg.eigvals(A).real, default=0.0) + rng.uniform(0.05, 1.0)) * np.eye(n)
    return StateSpace(
        A,
        rng.standard_normal((n, n_u)),
        rng.standard_normal((n_y, n)),
        rng.standard_normal((n_y, n_u)),
        0.0,
        [f"{names[0]}u{k}" for k in range(n_u)],
        [f"{names[1]}y{k}" for k in range(n_y)],
    )


@given(coefficients, coefficients, st.floats(1e-3, 1e3))
@settings(max_examples=60, deadline=None)
def test_tf_evaluates_as_the_ratio_of_its_polynomials(num, den, w):
    if len(num) > len(den):
        with pytest.raises(InputError, match="improper"):
            tf(num, den)
        return
    expected = np.polyval(num, 1j * w) / np.polyval(den, 1j * w)
    assert tf(num, den)(1j * w)[0, 0] == pytest.approx(expected, rel=1e-8)
    assert tf(num, den).frequency_response([w])[0, 0, 0] == pytest.approx(expected, rel=1e-8)


def test_tf_of_several_channels_is_that_of_python_control(rng):
    den = [[1.0, 3.0, 2.0], [1.0, 0.2], [4.0]]
    columns = [0, 1, 0]  # denominators by input: two columns share theirs
    nums = [[rng.standard_normal(rng.integers(1, len(den[k]) + 1)) for k in columns] for _ in range(2)]
    dens = [[den[k] for k in columns] for _ in range(2)]
    G = tf(nums, dens, ["a", "b", "c"], ["x", "y"])
    assert G.nstates == 2 + 1 + 2 and G.inputs == ("a", "b", "c")
    other = control.tf(nums, dens)
    for s in (0.3j, 5.0j, 1.0 + 2.0j):
        np.testing.assert_allclose(G(s), other(s), rtol=1e-10)
    dens[1][0] = [1.0, 7.0, 1.0]  # an entry with a denominator of its own
    assert tf(nums, dens).nstates == 7
    np.testing.assert_allclose(tf(nums, dens)(2j), control.tf(nums, dens)(2j), rtol=1e-10)
    np.testing.assert_allclose(tf([[[1.0], [2.0, 1.0]]], [1.0, 3.0])(2j), [[1 / (3 + 2j), (4j + 1) / (3 + 2j)]])


@pytest.mark.parametrize(
    "num, den, message",
    [
        ([[1.0, 2.0]], [1.0, 1.0], "expected (real )?coefficients"),
        ([[[1.0], [1.0]], [[1.0]]], [1.0, 1.0], "tables of 2 rows"),
        ([[[1.0]], [[1.0, 0.0]]], [[[1.0]], [[1.0]]], "improper"),
        ([], [1.0], "expected (real )?coefficients"),
        ([[[1.0]]], [[[0.0]]], "denominator is zero"),
        ("ab", [1.0], "expected (real )?coefficients"),
    ],
)
def test_tables_that_are_no_transfer_function(num, den, message):
    with pytest.raises(InputError, match=message):
        tf(num, den)


@given(st.integers(0, 2**31), st.integers(0, 5))
@settings(max_examples=30, deadline=None)
def test_algebra_is_that_of_the_transfer_matrices(seed, n):
    rng = np.random.default_rng(seed)
    G, H = random_system(rng, n, 2, 3), random_system(rng, 3, 3, 2)
    E = random_system(rng, 2, 2, 3)
    L, R = rng.standard_normal((4, 2)), rng.standard_normal((3, 1))
    for s in (0.3j, 7.0 + 1j):
        np.testing.assert_allclose((G @ H)(s), G(s) @ H(s), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose((G * H)(s), G(s) @ H(s), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose((G - E)(s), G(s) - E(s), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(G.scaled(L, R)(s), L @ G(s) @ R, rtol=1e-9, atol=1e-9)
        T = rng.standard_normal((n, n)) + 3 * np.eye(n)
        np.testing.assert_allclose(G.similar(T)(s), G(s), rtol=1e-7, atol=1e-8)


def test_frequency_response_agrees_with_python_control(rng):
    G = random_system(rng, 6, 2, 3)
    omega = np.geomspace(1e-2, 1e2, 50)
    expected = np.moveaxis(control.frequency_response(G.to_control(), omega).frdata, 2, 0)
    np.testing.assert_allclose(G.frequency_response(omega), expected, rtol=1e-9)
    np.testing.assert_allclose(G.frequency_response([np.inf])[0], G.D)


def test_exchange_with_python_control_keeps_names(rng):
    G = random_system(rng, 3, 2, 1)
    back = StateSpace.from_control(G.to_control())
    assert (back.inputs, back.outputs) == (G.inputs, G.outputs)
    np.testing.assert_array_equal(back.A, G.A)


def test_select_by_name_and_position(rng):
    G = random_system(rng, 3, 3, 3)
    part = G.select(["y2", "y0"], "u1")
    np.testing.assert_allclose(part(1j), G(1j)[[2, 0]][:, [1]])
    assert part.outputs == ("y2", "y0") and part.inputs == ("u1",)
    with pytest.raises(InputError, match="no output named 'absent'"):
        G.select("absent")


def test_pickle(rng):
    G = random_system(rng, 3, 2, 1)
    back = pickle.loads(pickle.dumps(G))
    np.testing.assert_array_equal(back.A, G.A)
    assert back.inputs == G.inputs


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        (([[np.nan]], [[1]], [[1]], [[0]]), "matrix A"),
        (([[1]], [[1, 2]], [[1]], [[0]]), "shapes do not fit"),
        (([[1, 2]], [[1]], [[1]], [[0]]), "shapes do not fit"),
    ],
)
def test_wrong_matrices(matrices, message):
    with pytest.raises(InputError, match=message):
        StateSpace(*matrices)


def test_wrong_names_and_clocks():
    with pytest.raises(InputError, match="must differ"):
        gain(np.eye(2), ["a", "a"], ["b", "c"])
    with pytest.raises(InputError, match="dt"):
        StateSpace([[1]], [[1]], [[1]], [[0]], -1.0)
    sampled = StateSpace([[0.5]], [[1]], [[1]], [[0]], 0.1, ["a"], ["b"])
    with pytest.raises(InputError, match="different sample times"):
        append(sampled, StateSpace([[-0.5]], [[1]], [[1]], [[0]], 0.0, ["c"], ["d"]))
    assert append(sampled, gain([[2.0]], ["c"], ["d"])).dt == 0.1


def test_slow_states_are_not_lost_beside_fast_ones(rng):
    """A = -G R G with R well conditioned and G over nine decades: the response at rest is C inv(G) inv(R) inv(G) B."""
    n = 8
    G = np.diag(np.geomspace(1e-4, 1e5, n))
    R = np.eye(n) + 0.2 * rng.uniform(-1, 1, (n, n))
    B, C = G @ rng.standard_normal((n, 2)), rng.standard_normal((2, n)) @ G
    exact = C @ np.linalg.inv(G) @ np.linalg.solve(R, np.linalg.solve(G, B))
    omega = np.concatenate([[0.0], np.geomspace(1e-14, 1e12, 60)])
    response = StateSpace(-G @ R @ G, B, C, np.zeros((2, 2))).frequency_response(omega)
    np.testing.assert_allclose(response[:3].real, np.broadcast_to(exact, (3, 2, 2)), rtol=1e-6, atol=1e-6)


def test_arithmetic_with_numbers_matrices_and_python_control():
    rng = np.random.default_rng(6)
    made = [
        control.StateSpace(
            np.diag([-1.0, -3.0]),
            rng.standard_normal((2, 2)),
            rng.standard_normal((2, 2)),
            0.1 * rng.standard_normal((2, 2)),
        )
        for _ in range(2)
    ]
    P, K = (StateSpace.from_control(one) for one in made)
    M, s = rng.standard_normal((2, 2)), 0.7j
    for found, true in (
        (P @ made[1], made[0] * made[1]),
        (P + made[1], made[0] + made[1]),
        (M @ P, M @ made[0](s)),
        (P @ M, made[0](s) @ M),
        (2 * P, 2 * made[0](s)),
        (P / 4, made[0](s) / 4),
        (M - P, M - made[0](s)),
        (P.feedback(made[1]), made[0].feedback(made[1])),
        (P.feedback(K, 1), made[0].feedback(made[1], 1)),
        (P.feedback(M), made[0].feedback(M)),
    ):
        np.testing.assert_allclose(found(s), true(s) if callable(true) else true, rtol=1e-9)
    one = tf([1.0], [1.0, 1.0])
    assert (1 - one)(0)[0, 0] == pytest.approx(0.0) and one.feedback().dcgain()[0, 0] == pytest.approx(0.5)
    with pytest.raises(TypeError):
        P @ "K"
    for wrong, words in (((np.ones((1, 2)),), "expected 2 inputs"), (("K",), "expected 2 inputs")):
        with pytest.raises(InputError, match=words):
            P.feedback(*wrong)
    with pytest.raises(InputError, match="not well posed"):
        gain([[1.0]]).feedback(-1.0)


def test_names_may_come_from_a_generator():
    G = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=(name for name in ["u"]), states=iter(["x"]))
    assert G.inputs == ("u",) and G.states == ("x",)


def test_a_wrong_number_of_state_names_is_refused():
    with pytest.raises(InputError, match="expected 1 state names, got 2"):
        StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]], states=("a", "b"))


def test_gain_at_a_pole_is_infinite_as_in_python_control():
    G = tf([1.0], [1.0, 0.0])
    assert G.dcgain() == control.dcgain(G.to_control()) == np.inf and np.isinf(G(0.0))
    other = append(tf([1.0], [1.0, 0.0]), tf([1.0], [1.0, 1.0]))
    np.testing.assert_array_equal(other.dcgain(), [[np.inf, 0], [0, 1]])
    np.testing.assert_array_equal(other.frequency_response(np.arange(6.0))[0], [[np.inf, 0], [0, 1]])
    # One input drives both, the second output sees the stable mode only: 2/(s + 1), 2 at rest.
    shared = StateSpace([[0.0, 0.0], [0.0, -1.0]], [[1.0], [2.0]], [[1.0, 1.0], [0.0, 1.0]], np.zeros((2, 1)))
    np.testing.assert_allclose(shared.dcgain(), [[np.inf], [2.0]])


def test_a_string_is_one_name_and_a_number_closes_each_channel(rng):
    G = StateSpace(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), 0.0, ("a", "b"), ("c", "d"))
    np.testing.assert_allclose(G.feedback(3.0).A, -4 * np.eye(2))
    assert G["d", "b"].inputs == ("b",) and G[0, :].D.shape == (1, 2)
    one = tf([1.0], [1.0, -0.5], "force", "x", dt=0.1)
    assert (one.inputs, one.outputs, one.dt) == (("force",), ("x",), 0.1) and one.is_stable()


def test_an_unspecified_sample_time_is_refused():
    with pytest.raises(InputError, match="expected a sample time in seconds"):
        StateSpace.from_control(control.tf([1.0], [1.0, -0.5], True))


def test_inverse_and_powers_are_those_of_the_transfer_matrix(rng):
    L = tf([2.0, 1.0], [1.0, 3.0, 2.0])
    S = 1 / (1 + L)
    for one, other in ((S, 1 / (1 + L(2j))), (L / (1 + L), L(2j) / (1 + L(2j))), (L**3, L(2j) ** 3), (L**0, 1.0)):
        np.testing.assert_allclose(one(2j), np.broadcast_to(other, (1, 1)), rtol=1e-12)
    np.testing.assert_allclose((S / control.tf([1.0], [1.0]))(2j), S(2j))
    G = StateSpace(-np.eye(2), np.eye(2), rng.standard_normal((2, 2)), np.eye(2), 0.1, ("a", "b"), ("c", "d"))
    np.testing.assert_allclose((G**-1)(0.5j), np.linalg.inv(G(0.5j)))
    assert (G**-1).inputs == ("c", "d") and (G**-1).dt == 0.1
    assert (S.inputs, S.outputs) == (L.inputs, L.outputs)  # default names, as with uncertain systems
    assert ((1 + L * real("k", 1.0, percent=20)).inverse().inputs) == L.inputs
    with pytest.raises(InputError, match="strictly proper"):
        _ = 1 / L
    with pytest.raises(InputError, match="division by zero"):
        _ = L / 0
    with pytest.raises(InputError, match="whole number"):
        _ = L**0.5


@pytest.mark.parametrize("uncertain", [False, True])
def test_whether_a_matrix_can_be_inverted_does_not_depend_on_units(rng, uncertain):
    X, left, right = rng.standard_normal((3, 3)), 10.0 ** np.array([-9, 0, 8]), 10.0 ** np.array([7, -8, 0])
    D = left[:, None] * X * right
    made = matrix(D * real("k", 1.0, percent=20)).inverse().nominal if uncertain else gain(D).inverse().D
    np.testing.assert_allclose(made, np.linalg.inv(X) / left / right[:, None], rtol=1e-9)
    rank_two = left[:, None] * np.outer([1, 2, 3], [1, 2, 3]) * right + np.diag(left * right * [0, 0, 1])
    with pytest.raises((InputError, ComputationError), match="inverted"):
        (matrix(rank_two * real("k", 1.0, percent=20)) if uncertain else gain(rank_two)).inverse()


@pytest.mark.parametrize(
    ("pole", "dt", "said"),
    [(1.0, 0.0, "1 state, 1 unstable pole, continuous"), (0.0, 0.0, "1 state, continuous"), (1.1, 0.1, "unstable")],
)
def test_an_unstable_system_says_so(pole, dt, said):
    """An integrator is not called unstable: most controllers with integral action would be."""
    assert said in repr(StateSpace([[pole]], [[1.0]], [[1.0]], [[0.0]], dt))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: StateSpace(np.array([[-1 + 2j]]), [[1]], [[1]], [[0]]), "matrix A: expected real numbers"),
        (lambda: StateSpace([[1, 2], [3]], [[1]], [[1]], [[0]]), "matrix A: .* rows of equal length"),
        (lambda: StateSpace([[-1]], [[1]], [[1]], [[0]], dt=None), "dt must be 0"),
        (lambda: tf(np.array([1 + 1j]), [1, 1]), "numerator: expected real coefficients"),
        (lambda: tf([1.0], [1.0, np.nan]), "denominator: expected finite"),
    ],
)
def test_numbers_that_are_not_real_and_finite_are_refused_in_one_line(call, words):
    with pytest.raises(InputError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
