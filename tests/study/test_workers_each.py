"""Questions answered by forked processes: the same answers in the same order, and the same errors."""

from __future__ import annotations

import os

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.study.workers import each


def test_answers_are_those_of_a_loop_in_their_order():
    A = np.random.default_rng(1).standard_normal((6, 6))
    expected = [np.linalg.matrix_power(A, k) for k in range(7)]
    # A function that no pickle could carry, as refits are.
    found = each(lambda k: np.linalg.matrix_power(A, k), range(7))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    assert each(lambda k: k, []) == [] and each(lambda k: k + 1, [1]) == [2]


def test_an_error_is_the_one_of_the_function_and_nothing_is_left_over():
    def fails(k):
        if k == 3:
            raise InputError("expected another", field="k", value=k)
        return os.getpid()
    with pytest.raises(InputError, match="k = 3: expected another"):
        each(fails, range(5))
    if len(os.sched_getaffinity(0)) > 1:
        assert os.getpid() not in each(fails, range(3))
