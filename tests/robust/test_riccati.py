"""Riccati equations with an indefinite quadratic term, against scipy, closed forms and their own residual."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.robust.riccati import ON_AXIS, negative_beyond_error, refined, solve_riccati


def residual(A, R, Q, X):
    terms = (A.T @ X, X @ A, X @ R @ X, Q)
    return la.norm(sum(terms)) / max(la.norm(term) for term in terms)


@given(st.integers(0, 2**31), st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_definite_case_agrees_with_scipy(seed, n):
    rng = np.random.default_rng(seed)
    A, B, C = rng.standard_normal((n, n)), rng.standard_normal((n, 2)), rng.standard_normal((n, n))
    ours = solve_riccati(A, -B @ B.T, C.T @ C)
    assert ours.X is not None and ours.semidefinite
    np.testing.assert_allclose(
        ours.X, la.solve_continuous_are(A, B, C.T @ C, np.eye(2)), rtol=1e-6, atol=1e-8 * la.norm(ours.X)
    )


@pytest.mark.parametrize("gamma", [0.6, 1.5, 10.0])
def test_indefinite_scalar_in_closed_form(gamma):
    """2 a x + (1/gamma^2 - 1) x^2 + 1 = 0, stabilising root x = 1 / (sqrt(a^2 + 1 - 1/gamma^2) - a)."""
    a = -2.0
    found = solve_riccati(np.array([[a]]), np.array([[gamma**-2 - 1]]), np.eye(1))
    assert found.X is not None and found.semidefinite
    assert found.X[0, 0] == pytest.approx(1 / (np.sqrt(a * a + 1 - gamma**-2) - a))


def test_negative_solution_is_seen():
    """x^2 / 2 + 2 x + 1 = 0 has roots -2 +- sqrt(2); 1 + x / 2 is stable for the lower one."""
    found = solve_riccati(np.array([[1.0]]), np.array([[0.5]]), np.array([[1.0]]))
    assert found.X is not None and not found.semidefinite
    assert found.X[0, 0] == pytest.approx(-(2 + np.sqrt(2)))


@pytest.mark.parametrize("error", [0.0, 1e-6, -1e-4])
def test_refined_solution_holds_the_exact_one_between_its_bounds(error):
    """The scalar equation above, from a start that is off by a relative error."""
    a, gamma = -2.0, 1.5
    exact = 1 / (np.sqrt(a * a + 1 - 1 / gamma**2) - a)
    X, E = refined(np.array([[a]]), np.array([[gamma**-2 - 1]]), np.eye(1), np.array([[exact * (1 + error)]]))
    assert abs(X[0, 0] - exact) <= max(E[0, 0], 4e-16 * exact)
    # Newton's method is quadratic: what is left is the square of the error, and round-off.
    assert 0 < E[0, 0] < 1e-14 + exact * error**2


def test_the_bounds_hold_what_wrong_entries_do(rng):
    """Scalar: dx = (2 x da + x^2 dr + dq) / (-2 (a + r x)) for the worst signs. Matrices: 200 drawn ones inside."""
    a, r, q, noise = -2.0, 1.5**-2 - 1, 1.0, (3e-6, 2e-6, 1e-6)
    x = 1 / (np.sqrt(a * a - r * q) - a)
    one = [np.full((1, 1), value) for value in (a, r, q, x)]
    for only in range(3):
        size = [value * (k == only) for k, value in enumerate(noise)]
        E = refined(*one, [np.full((1, 1), value) for value in size])[1]
        assert E[0, 0] == pytest.approx((2 * x * size[0] + x**2 * size[1] + size[2]) / (-2 * (a + r * x)), rel=1e-6)
    A, B, C = rng.standard_normal((3, 3)), rng.standard_normal((3, 1)), rng.standard_normal((2, 3))
    data = A, -B @ B.T, C.T @ C
    width = [1e-6 * np.abs(part) for part in data]
    X, E = refined(*data, solve_riccati(*data).X, width)
    for _ in range(200):
        signs = [rng.choice([-1.0, 1.0], (3, 3)) for _ in range(3)]
        signs = [signs[0], *(np.tril(sign) + np.tril(sign, -1).T for sign in signs[1:])]
        moved = solve_riccati(*(part + sign * size for part, sign, size in zip(data, signs, width, strict=True))).X
        assert min(la.eigvalsh(E - (moved - X))[0], la.eigvalsh(E + (moved - X))[0]) > 0


@pytest.mark.parametrize("power", [-30, 30])
def test_the_unit_of_time_does_not_matter(rng, power):
    """All three matrices times a power of two: the same X to the last bits."""
    A, B, C = rng.standard_normal((4, 4)), rng.standard_normal((4, 1)), rng.standard_normal((2, 4))
    data = A, -B @ B.T, C.T @ C
    plain, scaled = solve_riccati(*data), solve_riccati(*(2.0**power * part for part in data))
    assert plain.semidefinite and scaled.semidefinite
    np.testing.assert_allclose(scaled.X, plain.X, rtol=1e-9)


def test_singular_solution_is_not_called_indefinite():
    """X vanishes on stable modes that the cost does not see, however they are mixed with the others: the block
    that is left is the scalar equation above, positive for gamma = 1.5 and negative for R = 1/2."""
    rng = np.random.default_rng(0)
    for r, a, positive in ((1.5**-2 - 1, -2.0, True), (0.5, 1.0, False)):
        for _ in range(10):
            hidden = -np.diag(10.0 ** rng.uniform(-3, 1, 6))
            A = np.block([[np.array([[a]]), np.zeros((1, 6))], [rng.standard_normal((6, 1)), hidden]])
            R, Q = np.zeros((7, 7)), np.zeros((7, 7))
            R[0, 0], Q[0, 0] = r, 1.0
            R[1:, 1:] = -np.eye(6)
            T = rng.standard_normal((7, 7)) * 10.0 ** rng.uniform(-3, 3, 7)
            inverse = la.inv(T)
            found = solve_riccati(inverse @ A @ T, inverse @ R @ inverse.T, T.T @ Q @ T)
            assert found.X is not None and found.semidefinite == positive


def test_round_off_of_eigenvalues_makes_no_solution_indefinite():
    """X_ij = v_i v_j / (a_i + a_j) is positive definite (Cauchy); its computed eigenvalues need not be positive."""
    computed = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        a, v = rng.uniform(1, 3, 6), 10.0 ** rng.uniform(-6, 4, 6)
        X = np.outer(v, v) / (a[:, None] + a)
        H = np.block([[np.diag(-a), np.zeros((6, 6))], [-np.outer(v, v), np.diag(a)]])
        assert not negative_beyond_error(H, np.vstack([np.eye(6), X]))
        against = np.block([[np.diag(-a), np.zeros((6, 6))], [np.outer(v, v), np.diag(a)]])
        assert negative_beyond_error(against, np.vstack([np.eye(6), -X]))
        computed.append(la.eigvalsh(X)[0])
    assert min(computed) < 0


def test_no_solution_when_the_gain_is_below_the_norm():
    """Bounded real lemma for 1/(s^2 + 2 zeta s + 1): a solution exists only for gamma above the peak gain."""
    zeta = 0.01
    A, B, C = np.array([[0.0, 1.0], [-1.0, -2 * zeta]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    norm = 1 / (2 * zeta * np.sqrt(1 - zeta**2))
    below, above = (solve_riccati(A, B @ B.T / (f * norm) ** 2, C.T @ C) for f in (0.9999, 1.0001))
    assert below.X is None and below.reason == ON_AXIS
    assert above.X is not None and above.semidefinite


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_units_of_the_states_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    A, B, C = rng.standard_normal((5, 5)), rng.standard_normal((5, 1)), rng.standard_normal((2, 5))
    d = 10.0 ** rng.uniform(-6, 6, 5)
    A_d, R_d, Q_d = A / d[:, None] * d, -(B @ B.T) / np.outer(d, d), C.T @ C * np.outer(d, d)
    plain, scaled = solve_riccati(A, -B @ B.T, C.T @ C), solve_riccati(A_d, R_d, Q_d)
    assert plain.X is not None and scaled.X is not None
    back = scaled.X / np.outer(d, d)
    np.testing.assert_allclose(back, plain.X, rtol=1e-6, atol=1e-8 * la.norm(plain.X))
    assert residual(A, -B @ B.T, C.T @ C, back) < 1e-9
    assert np.max(la.eigvals(A - B @ B.T @ back).real) < 0
