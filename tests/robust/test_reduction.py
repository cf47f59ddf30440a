"""Reduced and sampled controllers, judged by measured closed loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, balanced_truncation, connect, gain, hinf_norm, lft_lower, summing_junction, tf
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.reduction import (
    reduce_controller,
    replace_fast_by_lags,
    residualise_fast,
    split_stable,
    truncate_slow,
)


@pytest.fixture(scope="module")
def process():
    """S/KS problem of Skogestad and Postlethwaite's disturbance process (example 2.17)."""
    G = tf([200], np.polymul([10, 1], np.polymul([0.05, 1], [0.05, 1])), ["u"], ["g"])
    return connect(
        [
            G,
            summing_junction("e", ["r", "-g"]),
            tf([1 / 1.5, 10], [1, 1e-3], ["e"], ["wp"]),
            gain([[1.0]], ["u"], ["wu"]),
            gain([[1.0]], ["e"], ["y"]),
        ],
        ["r", "u"],
        ["wp", "wu", "y"],
    )


def padded(K, rng):
    """K with fast, nearly invisible modes added: what a D-K iteration leaves behind."""
    extra = StateSpace(
        -np.diag(10.0 ** rng.uniform(1, 3, 4)),
        rng.standard_normal((4, 1)),
        1e-5 * rng.standard_normal((1, 4)),
        [[0.0]],
        0.0,
        K.inputs,
        K.outputs,
    )
    return K + extra


def test_invisible_states_go_and_the_figure_stays(process, rng):
    K = hinfsyn(process, 1, 1).K
    start = padded(K, rng)
    reduced = reduce_controller(process, start)

    def figure(controller):
        return hinf_norm(lft_lower(process, controller)).gain

    assert reduced.nstates <= K.nstates
    assert figure(reduced) <= 1.01 * figure(K)
    stable, unstable = split_stable(start)
    less = balanced_truncation(stable, reduced.nstates - 1 - unstable.nstates) + unstable
    assert figure(less) > 1.01 * figure(K)


def test_own_measure_decides(process):
    K = hinfsyn(process, 1, 1).K
    full = reduce_controller(process, K, measure=lambda candidate: 10.0**-candidate.nstates)
    assert full is K
    least = reduce_controller(process, K, measure=lambda candidate: 1.0)
    assert least.nstates < K.nstates and lft_lower(process, least).is_stable()


@given(st.integers(0, 2**31), st.integers(0, 7))
@settings(max_examples=30, deadline=None)
def test_split_adds_up(seed, n):
    rng = np.random.default_rng(seed)
    K = StateSpace(
        rng.standard_normal((n, n)),
        rng.standard_normal((n, 2)),
        rng.standard_normal((1, n)),
        rng.standard_normal((1, 2)),
    )
    stable, unstable = split_stable(K)
    assert stable.is_stable() and np.all(unstable.poles().real >= 0)
    np.testing.assert_allclose((stable + unstable)(1.3j), K(1.3j), rtol=1e-6, atol=1e-8)


def test_unstable_part_of_the_controller_is_kept():
    """A plant that only an unstable controller stabilises: a zero between two unstable poles breaks the parity
    interlacing condition (Youla, Bongiorno and Lu 1974)."""
    P = connect(
        [
            tf([1, -2], np.polymul([1, -4], [1, 1]), ["u"], ["g"]),
            summing_junction("y", ["r", "-g"]),
            gain([[1.0]], ["y"], ["z1"]),
            gain([[1.0]], ["u"], ["z2"]),
        ],
        ["r", "u"],
        ["z1", "z2", "y"],
    )
    K = hinfsyn(P, 1, 1).K
    assert not K.is_stable()
    reduced = reduce_controller(P, K, growth=0.2)
    assert np.sum(reduced.poles().real > 0) == np.sum(K.poles().real > 0)
    assert lft_lower(P, reduced).is_stable()


def test_refusals(process):
    with pytest.raises(InputError, match="growth"):
        reduce_controller(process, gain([[0.1]]), growth=-1)
    with pytest.raises(InputError, match="does not stabilise"):
        reduce_controller(process, gain([[-100.0]]))


def test_slow_poles_are_left_out_and_nothing_else(rng):
    """Of a sum in hidden coordinates the slow stable part goes; an unstable slow pole stays."""
    kept = StateSpace(np.diag([-1.0, -20.0]), rng.normal(size=(2, 2)), rng.normal(size=(1, 2)), [[0.3, 0.1]])
    growing = StateSpace([[1e-5]], rng.normal(size=(1, 2)), [[1.0]], np.zeros((1, 2)))
    slow = StateSpace(np.diag([-1e-4, -2e-3]), rng.normal(size=(2, 2)), rng.normal(size=(1, 2)), np.zeros((1, 2)))
    whole = kept + growing + slow
    T = rng.normal(size=(5, 5))
    hidden = StateSpace(np.linalg.solve(T, whole.A @ T), np.linalg.solve(T, whole.B), whole.C @ T, whole.D)
    found, expected = truncate_slow(hidden, 0.01), kept + growing
    assert found.nstates == 3
    omega = np.geomspace(1e-3, 100.0, 20)
    assert found.frequency_response(omega) == pytest.approx(expected.frequency_response(omega), rel=1e-6)


def test_lags_keep_the_phase_lead_of_fast_poles():
    """A slow mode and the lead (1 + s/300)^2 with two poles at 1e5 rad/s. Up to a tenth of the corner frequency the
    result differs from K by less than 10 %; if only the gain at zero frequency is kept, by more than 50 %."""
    lead = tf(np.polymul([1 / 300, 1], [1 / 300, 1]), np.polymul([1e-5, 1], [1e-5, 1]), ["y"], ["u"])
    slow = tf([2.0], [1.0, 0.2, 4.0], ["y"], ["u"])
    K, corner = lead + slow, 1000.0
    made = replace_fast_by_lags(K, corner)
    omega = np.geomspace(0.01, corner, 200)
    wanted, found, held = (one.frequency_response(omega)[:, 0, 0] for one in (K, made, residualise_fast(K, corner)))
    assert np.max(np.abs(made.poles())) <= corner * (1 + 1e-3)
    assert made.dcgain() == pytest.approx(K.dcgain(), rel=1e-9)
    assert np.max(np.abs(found / wanted - 1)[omega < corner / 10]) < 0.1
    assert np.max(np.abs(held / wanted - 1)[omega < corner / 10]) > 0.5


def test_lags_of_several_channels_and_a_controller_without_fast_poles(rng):
    slow = StateSpace(np.diag([-1.0, -3.0]), rng.standard_normal((2, 2)), rng.standard_normal((3, 2)), np.zeros((3, 2)))
    assert replace_fast_by_lags(slow, 100.0) is slow
    fast = StateSpace(
        np.diag([-300.0, -900.0]), rng.standard_normal((2, 2)), rng.standard_normal((3, 2)), np.zeros((3, 2))
    )
    made = replace_fast_by_lags(slow + fast, 100.0)
    assert made.nstates == 2 + 3 * 2
    assert made.dcgain() == pytest.approx((slow + fast).dcgain(), rel=1e-12)
    omega = np.geomspace(0.1, 100, 50)
    gain = np.linalg.norm((slow + fast).frequency_response(omega), ord=2, axis=(1, 2))
    error = np.linalg.norm((made - (slow + fast)).frequency_response(omega), ord=2, axis=(1, 2))
    assert np.max(error / gain) < 0.02
    with pytest.raises(InputError, match="continuous"):
        replace_fast_by_lags(StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1), 1.0)


def test_no_candidate_order_returns_the_controller(process):
    K = hinfsyn(process, 1, 1).K
    assert reduce_controller(process, K, measure=lambda candidate: 1.0, orders=range(0)) is K
