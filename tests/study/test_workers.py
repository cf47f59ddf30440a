"""Two processes, or one: the same answers, the same errors, and an end without waiting."""

from __future__ import annotations

import os
import time

import pytest

from avis_ctrl.errors import ComputationError
from avis_ctrl.study.workers import Workers


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
