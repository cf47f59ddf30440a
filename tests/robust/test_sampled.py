"""Synthesis and analysis in discrete time against SLICOT's discrete routines and responses on the unit circle."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as la
import slycot

sys.path.insert(0, str(Path(__file__).parents[2]))

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, append, connect, discretise, lft_upper, tf
from avis_ctrl.robust.hinfsyn import Status, hinf_suboptimal, hinfsyn
from avis_ctrl.robust.mu_peak import mu_peak, worst_case_gain
from avis_ctrl.robust.mu_realise import realise_delta
from avis_ctrl.robust.musyn import musyn
from avis_ctrl.robust.slycot_adapter import hinf_norm_slicot, mu_upper_slicot
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar, RealScalar
from benchmarks.random_plants import closed, solve
from tests.robust.test_musyn import table

DT = 1e-3


def delayed(samples: int) -> StateSpace:
    return StateSpace(
        np.eye(samples, k=1), np.eye(samples)[:, -1:], np.eye(samples)[:1], np.zeros((1, 1)), DT, ["u"], ["drive"]
    )


def sampled_table(samples: int = 2) -> tuple[StateSpace, list]:
    """The table of test_musyn at 1 kHz behind a hold and a delay of whole samples: a plant posed in discrete time."""
    P, blocks = table()
    held = discretise(P, DT, "zoh").renamed(inputs={"u": "drive"})
    # The effort output is of the drive, too: the delay lies between u and all of the plant.
    names = ["w_k", "w_a", "floor", "w2"]
    return connect({"table": held, "delay": delayed(samples)}, [*names, "u"], list(held.outputs)), blocks


def random_plant(rng, n=6):
    """Poles up to radius 1.1, a negative real one and one at zero; D12 and D21 of full rank, D11 and D22 not zero."""
    A = la.block_diag(
        -0.7,
        0.0,
        *[
            radius * np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
            for radius, a in ((1.1, 0.3), (0.95, 2.8))
        ],
    )
    T = la.qr(rng.standard_normal((n, n)))[0]
    D = 0.2 * rng.standard_normal((5, 5))
    D[1:3, 3:] += np.eye(2)
    D[3:, 1:3] += np.eye(2)
    return StateSpace(T @ A @ T.T, rng.standard_normal((n, 5)), rng.standard_normal((5, n)), D, 0.2)


@pytest.mark.parametrize("seed", range(4))
def test_optimum_is_that_of_sb10dd(seed):
    """SLICOT's discrete two-Riccati solution exists just above the bracket and does not below it."""
    P = random_plant(np.random.default_rng(seed))
    found = hinfsyn(P, 2, 2)
    lower, upper = found.gamma_optimal_bounds
    assert found.status is Status.OPTIMAL and found.K.dt == P.dt

    def sb10dd(gamma):
        A, B, C, D = slycot.sb10dd(6, 5, 5, 2, 2, gamma, P.A, P.B, P.C, P.D)[1:5]
        return StateSpace(A, B, C, D, P.dt)

    assert hinf_norm_slicot(closed(P, sb10dd(1.02 * upper))) < 1.02 * upper
    with pytest.raises(slycot.exceptions.SlycotError):
        sb10dd(0.98 * lower)
    assert hinf_norm_slicot(closed(P, found.K)) == pytest.approx(found.gamma, rel=1e-4)
    given = hinf_suboptimal(P, 2, 2, 1.5 * upper)
    assert hinf_norm_slicot(closed(P, given.K)) <= 1.5 * upper


def test_all_states_driven_and_measured():
    """y = x without noise and two drives: the central controller has its poles at z = -1 itself, others do not.

    z = x is then reached exactly from what was measured one sample ago: the optimum is the gain of the disturbance.
    """
    B1 = np.array([[1.0, 0.4], [0.0, 2.0]])
    P = StateSpace(
        [[0.0, 1.0], [0.0, 0.0]], np.hstack([B1, np.eye(2)]), np.vstack([np.eye(2)] * 2), np.zeros((4, 4)), 0.1
    )
    found = hinfsyn(P, 2, 2)
    assert found.gamma_optimal_bounds[0] <= np.linalg.norm(B1, 2) * (1 + 1e-6)
    assert found.gamma_optimal_bounds[1] == pytest.approx(np.linalg.norm(B1, 2), rel=2e-3)
    assert hinf_norm_slicot(closed(P, found.K)) <= 1.011 * np.linalg.norm(B1, 2)


def test_units_of_u_and_y_do_not_make_the_loop_ill_posed(rng):
    P = random_plant(rng)
    odd = P.scaled(np.r_[np.ones(3), 1e5, 1e-5], np.r_[np.ones(3), 1e-5, 1e5])
    assert hinfsyn(odd, 2, 2).gamma == pytest.approx(hinfsyn(P, 2, 2).gamma, rel=2e-3)


def test_a_plant_with_a_pole_at_half_the_rate_is_refused():
    P = StateSpace([[-1.0]], [[1.0, 0.5, 1.0]], [[1.0], [0.5], [1.0]], np.eye(3)[::-1], 0.1)
    with pytest.raises(ComputationError, match="z = -1"):
        hinfsyn(P, 1, 1)
    with pytest.raises(ComputationError, match="z = -1"):
        musyn(P, [ComplexScalar()], 1, 1)


@pytest.fixture(scope="module")
def synthesis():
    P, blocks = sampled_table()
    return P, musyn(P, blocks, 1, 1)


def test_mu_synthesis_is_certified_on_the_sampled_loop(synthesis):
    """Complex mu by AB13MD on a dense grid of the circle, half the rate included, on a loop formed elsewhere."""
    P, found = synthesis
    own = closed(P, found.K)
    assert found.K.dt == DT and np.max(np.abs(own.poles())) < 1 and found.guaranteed
    square = BlockStructure.of([ComplexScalar(), ComplexScalar(), ComplexFull(2)])
    omega = np.concatenate([[0.0], np.geomspace(1e-1, np.pi / DT, 600), np.abs(np.angle(own.poles())) / DT])
    on_grid = max(mu_upper_slicot(M, square) for M in own.frequency_response(omega))
    assert 0.97 * found.mu_upper_complex <= on_grid <= found.mu_upper_complex * (1 + 1e-6)
    assert found.mu_lower <= found.mu_upper <= found.mu_upper_complex
    assert 0 <= found.omega_peak <= np.pi / DT
    M = own.frequency_response(np.array([found.omega_peak]))[0]
    assert np.linalg.svd(np.eye(4) - M @ found.delta, compute_uv=False)[-1] < 1e-7


def test_delay_costs_and_the_continuous_design_is_the_limit(synthesis):
    """A millisecond's hold and delay can only cost; at this rate, with loops below 100 rad/s, not much."""
    P, blocks = table()
    without = musyn(P, blocks, 1, 1)
    assert without.mu_upper_complex * 0.99 <= synthesis[1].mu_upper_complex <= 1.3 * without.mu_upper_complex


def test_mu_synthesis_goes_on_and_takes_sampled_starts(synthesis):
    P, found = synthesis
    blocks = sampled_table()[1]
    again = musyn(P, blocks, 1, 1, state=found.saved_state)
    assert again.mu_upper == pytest.approx(found.mu_upper, rel=1e-9) and again.K.dt == DT
    started = musyn(P, blocks, 1, 1, starts=[found.K], max_iterations=1, polish=False)
    assert started.mu_upper_complex <= found.mu_upper_complex * 1.005
    with pytest.raises(InputError, match="sampled at"):
        musyn(P, blocks, 1, 1, starts=[StateSpace(found.K.A, found.K.B, found.K.C, found.K.D)])
    continuous = table()[0]
    padded = append(continuous, tf([1], [1, 1, 1])).select(slice(0, 5), slice(0, 5))
    with pytest.raises(InputError, match="another plant"):
        musyn(padded, blocks, 1, 1, state=found.saved_state)


def test_peak_at_half_the_rate_is_covered():
    """A pole near z = -1: the largest mu is at the end of the axis, which the image has at infinity."""
    G = StateSpace([[-0.9, 0.2], [0.0, 0.3]], np.eye(2), [[1.0, 0.2], [0.5, 1.0]], 0.1 * np.ones((2, 2)), 0.05)
    blocks = [ComplexScalar(), ComplexScalar()]
    found = mu_peak(G, blocks)
    end = mu_upper_slicot(G.C @ np.linalg.solve(-np.eye(2) - G.A, G.B) + G.D, blocks)
    assert found.guaranteed and "half the sample rate" in found.covers
    assert found.omega == pytest.approx(np.pi / 0.05, rel=1e-6)
    assert found.lower <= end * (1 + 1e-6) and end <= found.upper <= end * 1.002
    with pytest.raises(InputError, match="below half the sample rate"):
        mu_peak(G, blocks, band=(70.0, 80.0))


@pytest.mark.parametrize("seed", range(3))
def test_sampled_mu_against_ab13md_on_a_fine_grid(seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((5, 5))
    A *= 0.97 / np.max(np.abs(np.linalg.eigvals(A)))
    G = StateSpace(A, rng.standard_normal((5, 4)), rng.standard_normal((4, 5)), rng.standard_normal((4, 4)), 0.1)
    blocks = [ComplexScalar(), ComplexScalar(), ComplexFull(2)]
    found = mu_peak(G, blocks)
    omega = np.concatenate([np.linspace(0, np.pi / 0.1, 1500), np.abs(np.angle(np.linalg.eigvals(A))) / 0.1])
    on_grid = np.array([mu_upper_slicot(M, blocks) for M in G.frequency_response(omega)])
    assert found.guaranteed and on_grid.max() * (1 - 1e-6) <= found.upper <= 1.01 * on_grid.max()
    assert found.omega == pytest.approx(omega[np.argmax(on_grid)], abs=0.05)


def test_worst_case_gain_of_a_sampled_loop_is_what_the_perturbed_loop_has(rng):
    """The perturbation as a stable sampled system in the loop; its norm by AB13DD."""
    A = rng.standard_normal((4, 4))
    A *= 0.8 / np.max(np.abs(np.linalg.eigvals(A)))
    G = StateSpace(A, rng.standard_normal((4, 3)), rng.standard_normal((3, 4)), 0.1 * rng.standard_normal((3, 3)), 0.5)
    blocks = [RealScalar(), ComplexScalar()]
    inner = mu_peak(G.select(slice(0, 2), slice(0, 2)), blocks)
    G = G.scaled(left=np.r_[0.5 / inner.upper, 0.5 / inner.upper, 1.0])
    found = worst_case_gain(G, blocks)
    delta = realise_delta(found.delta, found.omega, blocks, 0.5)
    on_circle = delta.frequency_response(np.linspace(0, np.pi / 0.5, 200))
    assert delta.dt == 0.5 and np.max(np.linalg.norm(on_circle, 2, axis=(1, 2))) <= 1 + 1e-9
    reached = hinf_norm_slicot(lft_upper(G, delta))
    assert found.guaranteed and found.lower * (1 - 1e-6) <= reached <= found.upper * (1 + 1e-6)


@pytest.mark.parametrize("index", range(12))
def test_any_problem_in_discrete_time(index):
    """A dozen problems like those of the benchmark."""
    assert solve(1, index, sampled=True)["wrong"] == []


@pytest.mark.parametrize("index", [85, 103, 113, 119])
def test_direct_terms_between_u_and_y(index):
    """The loop around D22 judged in the units of u and y, and central controllers with poles at z = -1."""
    found = solve(1, index, sampled=True)
    assert found["wrong"] == [] and found["status"] == "OPTIMAL"


def test_a_pole_near_minus_one_does_not_blur_a_light_mode():
    """Poles within 3e-6 of z = -1 and of the circle at once: the perturbation still fits the response there."""
    assert solve(2, 646, sampled=True)["wrong"] == []
