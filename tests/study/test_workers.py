"""Two processes, or one: the same answers, the same errors, and an end without waiting."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.study.workers import Workers, each


def double(value: int) -> int:
    return 2 * value


def fail() -> None:
    raise ComputationError("no controller found", measured="gamma 7", cause="too much asked", next_step="ask less")


def process(seconds: float = 0.0) -> int:
    time.sleep(seconds)
    return os.getpid()


@pytest.mark.parametrize("count", [1, 2])
def test_answers_and_errors_come_out_of_the_future(count):
    with Workers(count) as workers:
        jobs = [workers.submit(double, k) for k in range(5)]
        failed = workers.submit(fail)
        assert [job.result() for job in jobs] == [0, 2, 4, 6, 8]
        with pytest.raises(ComputationError, match="measured: gamma 7; likely cause: too much asked"):
            failed.result()


def test_one_worker_is_this_process_and_two_are_not():
    with Workers(1) as workers:
        assert workers.submit(process).result() == os.getpid()
    with Workers(2) as workers:
        assert workers.submit(process).result() != os.getpid()


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ComputationError])
def test_who_leaves_early_waits_for_nobody(stop):
    began = time.monotonic()
    with pytest.raises(stop), Workers(2) as workers:
        child = workers.submit(process).result()
        for _ in range(4):
            workers.submit(process, 60.0)
        time.sleep(0.2)
        raise stop("enough")
    assert time.monotonic() - began < 10
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_ctrl_c_is_not_kept_for_later():
    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Workers(1) as workers:
        workers.submit(interrupt)


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
