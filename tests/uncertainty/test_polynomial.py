"""Polynomials read off by evaluation, against the polynomials they were made from."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError
from avis_ctrl.uncertainty.polynomial import evaluate, polynomial_coefficients


def exponents(n: int) -> list[tuple[int, ...]]:
    """Up to 2 in one parameter and 3 in all."""
    return [a for a in product(range(3), repeat=n) if sum(a) <= 3]


@st.composite
def polynomials(draw) -> dict[tuple[int, ...], np.ndarray]:
    n = draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    chosen = draw(st.lists(st.sampled_from(exponents(n)), unique=True, max_size=6))
    # Every product comes with its parameters alone, as in a rig: nothing is uncertain only where another is.
    terms = {(0,) * n: rng.standard_normal((2, 3))}
    for a in chosen:
        for k in range(n):
            if a[k]:
                terms.setdefault(tuple(int(j == k) for j in range(n)), rng.standard_normal((2, 3)))
        terms[a] = rng.standard_normal((2, 3)) * 10.0 ** rng.uniform(-2, 2)
    return terms


@settings(max_examples=60, deadline=None)
@given(terms=polynomials())
def test_random_polynomials_are_recovered(terms):
    n = len(next(iter(terms)))
    found = polynomial_coefficients(lambda delta: evaluate(terms, delta), n)
    size = np.max([np.abs(N) for N in terms.values()], axis=0)
    for a in {*terms, *found}:
        expected, read = terms.get(a, np.zeros((2, 3))), found.get(a, np.zeros((2, 3)))
        assert np.all(np.abs(expected - read) <= 1e-9 * size), a


def test_a_product_of_three_parameters_is_found():
    found = polynomial_coefficients(lambda d: np.array([[1 + d[0] * (1 + d[1]) * (1 + d[2])]]), 3)
    assert set(found) == {(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 0, 1), (1, 1, 1)}
    assert all(N[0, 0] == pytest.approx(1.0, rel=1e-12) for N in found.values())


def test_entries_of_unlike_units_keep_their_digits():
    """Stiffnesses of 1e6 beside inertias of 1e-3 in one matrix."""
    found = polynomial_coefficients(lambda d: np.array([[1e6 * (1 + 0.1 * d[0]), 1e-3 * (1 + 0.2 * d[1] ** 2)]]), 2)
    np.testing.assert_allclose(found[1, 0], [[1e5, 0.0]], rtol=1e-12)
    np.testing.assert_allclose(found[0, 2], [[0.0, 2e-4]], rtol=1e-10)
    assert set(found) == {(0, 0), (1, 0), (0, 2)}


def test_without_parameters_it_is_a_constant():
    assert set(polynomial_coefficients(lambda d: np.eye(2), 0)) == {()}


def test_a_parameter_that_does_nothing_has_no_term():
    assert set(polynomial_coefficients(lambda d: np.array([[2.0 + d[0]]]), 2)) == {(0, 0), (1, 0)}


@pytest.mark.parametrize(
    "function",
    [
        lambda d: np.array([[np.sin(d[0])]]),
        lambda d: np.array([[1 / (3.0 + d[0])]]),
        lambda d: np.array([[1.0 + d[0] ** 3]]),
        lambda d: np.array([[np.abs(d[0])]]),
        lambda d: np.array([[d[0] ** 2 * d[1] ** 2 + d[0] + d[1]]]),
    ],
    ids=["sine", "division", "cube", "absolute value", "degree four"],
)
def test_what_is_no_such_polynomial_is_refused_with_its_error(function):
    with pytest.raises(ComputationError, match=r"relative error \d") as refused:
        polynomial_coefficients(function, 2)
    assert "division" in str(refused.value)
