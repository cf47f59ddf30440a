"""Copies of repeated parameters removed without changing the LFT."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.uncertainty.lft_reduction import reduce_copies


def closed(M: np.ndarray, sizes: list[int], delta: np.ndarray) -> np.ndarray:
    """F_u(M, diag(delta_k I))."""
    n = sum(sizes)
    Delta = np.diag(np.repeat(delta, sizes))
    return M[n:, n:] + M[n:, :n] @ Delta @ np.linalg.solve(np.eye(n) - M[:n, :n] @ Delta, M[:n, n:])


def assembled(rng: np.random.Generator, sizes: list[int], outputs: int = 3, inputs: int = 2) -> np.ndarray:
    n = sum(sizes)
    M = rng.standard_normal((n + outputs, n + inputs))
    M[:n, :n] *= 0.5 / max(np.linalg.norm(M[:n, :n], 2), 1e-12)
    return M


def with_hidden_copies(
    rng: np.random.Generator, M: np.ndarray, sizes: list[int], extra: list[tuple[int, int]]
) -> tuple[np.ndarray, list[int]]:
    """Adds to each block copies that nothing reaches and copies that nothing sees, then mixes the block's states."""
    n, more = sum(sizes), [a + b for a, b in extra]
    total = n + sum(more)
    big = np.zeros((M.shape[0] + sum(more), M.shape[1] + sum(more)))
    own, unreached, unseen, place = [], [], [], 0
    for size, (a, b) in zip(sizes, extra, strict=True):
        own += range(place, place + size)
        unreached += range(place + size, place + size + a)
        unseen += range(place + size + a, place + size + a + b)
        place += size + a + b
    rows, cols = [*own, *range(total, big.shape[0])], [*own, *range(total, big.shape[1])]
    big[np.ix_(rows, cols)] = M
    # z of an unreached copy reads only its like; z of an unseen one reads everything but its w goes only to its like.
    big[np.ix_(unreached, unreached)] = 0.1 * rng.standard_normal((len(unreached), len(unreached)))
    big[np.ix_(rows, unreached)] = rng.standard_normal((len(rows), len(unreached)))
    big[np.ix_(unseen, [*cols, *unseen])] = 0.1 * rng.standard_normal((len(unseen), len(cols) + len(unseen)))
    grown = [size + m for size, m in zip(sizes, more, strict=True)]
    T = np.eye(total)
    ends = np.cumsum([0, *grown])
    for start, stop in pairwise(ends):
        T[start:stop, start:stop] = np.linalg.qr(rng.standard_normal((stop - start, stop - start)))[0]
    big[:total] = T.T @ big[:total]
    big[:, :total] = big[:, :total] @ T
    return big, grown


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    blocks=st.lists(st.tuples(st.integers(1, 3), st.integers(0, 2), st.integers(0, 2)), min_size=1, max_size=3),
)
def test_hidden_copies_go_and_the_lft_stays(seed, blocks):
    rng = np.random.default_rng(seed)
    sizes = [size for size, _, _ in blocks]
    M = assembled(rng, sizes)
    big, grown = with_hidden_copies(rng, M, sizes, [(a, b) for _, a, b in blocks])
    small, left = reduce_copies(big, grown)
    assert all(n <= size for n, size in zip(left, sizes, strict=True))
    for _ in range(4):
        delta = rng.uniform(-1, 1, len(sizes))
        expected = closed(M, sizes, delta)
        np.testing.assert_allclose(closed(small, left, delta), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_minimal_lft_keeps_its_copies(rng):
    M = assembled(rng, [2, 3])
    small, left = reduce_copies(M, [2, 3])
    assert left == [2, 3]
    np.testing.assert_array_equal(small, M)


def test_the_same_parameter_pulled_out_twice_becomes_one():
    """delta (a b' + 2 a b'), written as two copies in parallel, is one of rank one."""
    a, b = np.array([[1.0], [2.0]]), np.array([[3.0, -1.0]])
    M = np.block([[np.zeros((2, 2)), np.vstack([b, 2 * b])], [np.hstack([a, a]), np.zeros((2, 2))]])
    small, left = reduce_copies(M, [2])
    assert left == [1]
    np.testing.assert_allclose(closed(small, left, np.array([0.7])), 0.7 * 3 * a @ b, rtol=1e-12)


def test_copies_that_only_feed_each_other_go():
    """Two parameters in a ring that nothing outside reaches."""
    M = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 5.0]])
    small, left = reduce_copies(M, [1, 1])
    assert left == [0, 0]
    assert small == pytest.approx(np.array([[5.0]]))


def test_a_parameter_without_effect_disappears():
    small, left = reduce_copies(np.diag([0.0, 1.0]), [1])
    assert left == [0]
    assert small == pytest.approx(np.array([[1.0]]))
