"""Peaks over frequency: printed examples, spikes that no grid meets, exact norms, and the guarantee itself."""

from fractions import Fraction

import cvxpy as cp
import numpy as np
import pytest
import scipy.linalg as la

import avis_ctrl as ac
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import (
    StateSpace,
    append,
    connect,
    discretise,
    gain,
    hinf_norm,
    lft_lower,
    lft_upper,
    summing_junction,
    tf,
)
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.mu import mu
from avis_ctrl.robust.mu_cover import Cover
from avis_ctrl.robust.mu_gain import worst_gain
from avis_ctrl.robust.mu_lmi import residual
from avis_ctrl.robust.mu_peak import mu_peak, stability_bound, worst_case_gain
from avis_ctrl.robust.mu_realise import realise_delta
from avis_ctrl.robust.mu_upper import skewed_upper_bound, upper_bound
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar, RealScalar

C, R, F = ComplexScalar, RealScalar, ComplexFull


def spinning_satellite(a=10.0):
    """Skogestad and Postlethwaite, section 3.7.1 with K = I: T = 1/(s+1) [1 a; -a 1]; N = -T (input uncertainty)."""
    return StateSpace(-np.eye(2), np.eye(2), -np.array([[1, a], [-a, 1]]), np.zeros((2, 2)))


def distillation():
    """Skogestad and Postlethwaite (1996), section 8.11.3, inverse-based controller K = 0.7/s inv(G).

    w_I = (s + 0.2)/(0.5 s + 1), w_P = (s/2 + 0.05)/s; S = s/(s + 0.7) I, so that every entry of N is a scalar
    times a constant matrix and the integrators cancel.
    """
    G0 = np.array([[87.8, -86.4], [108.2, -109.6]])
    T_wI = np.polymul([1, 0.2], [0.7]), np.polymul([0.5, 1], [1, 0.7])
    entries = [
        ((-T_wI[0], T_wI[1]), np.eye(2)),
        ((-np.polymul(T_wI[0], [75, 1]), T_wI[1]), np.linalg.inv(G0)),
        (([0.5, 0.05], np.polymul([1, 0.7], [75, 1])), G0),
        (([0.5, 0.05], [1, 0.7]), np.eye(2)),
    ]
    parts = []
    for k, ((num, den), matrix) in enumerate(entries):
        one = tf(num, den)
        both = append(one.renamed([f"u{k}a"], [f"y{k}a"]), one.renamed([f"u{k}b"], [f"y{k}b"]))
        parts.append(both @ gain(matrix, [f"v{k}a", f"v{k}b"], [f"u{k}a", f"u{k}b"]))
    I, O = np.eye(2), np.zeros((2, 2))
    return append(*parts).scaled(
        left=np.block([[I, I, O, O], [O, O, I, I]]), right=np.block([[I, O], [O, I], [I, O], [O, I]])
    )


def distillation_plant():
    """The same without its controller: inputs w_delta, w, u; outputs z_delta, z, y = -(G (u + w_delta) + w)."""
    G = StateSpace(
        -np.eye(2) / 75,
        np.eye(2),
        np.array([[87.8, -86.4], [108.2, -109.6]]) / 75,
        np.zeros((2, 2)),
        0.0,
        ["a1", "a2"],
        ["g1", "g2"],
    )
    parts = [G]
    for k in "12":
        parts += [
            tf([1.0, 0.2], [0.5, 1.0], [f"u{k}"], [f"z_delta{k}"]),
            tf([0.5, 0.05], [1.0, 1e-6], [f"e{k}"], [f"z{k}"]),
            summing_junction(f"a{k}", [f"u{k}", f"w_delta{k}"]),
            summing_junction(f"e{k}", [f"g{k}", f"w{k}"]),
            summing_junction(f"y{k}", [f"-e{k}"]),
        ]
    return connect(
        parts, ["w_delta1", "w_delta2", "w1", "w2", "u1", "u2"], ["z_delta1", "z_delta2", "z1", "z2", "y1", "y2"]
    )


def flexible(rng, n_w, n_z, modes=6, damping=1e-3):
    """Lightly damped modes, each seen by every channel."""
    omega = np.sort(10 ** rng.uniform(-1, 2, modes))
    A = np.zeros((2 * modes, 2 * modes))
    B, C_ = np.zeros((2 * modes, n_w)), np.zeros((n_z, 2 * modes))
    for k, w in enumerate(omega):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[0, w], [-w, -2 * damping * w]]
        B[2 * k + 1] = rng.standard_normal(n_w) * np.sqrt(w * damping)
        C_[:, 2 * k] = rng.standard_normal(n_z) * np.sqrt(w * damping)
    return StateSpace(A, B, C_, 0.1 * rng.standard_normal((n_z, n_w)))


def singular_at(N, found):
    A = np.eye(N.noutputs) - N(1j * found.omega) @ found.delta
    return np.linalg.svd(A, compute_uv=False)[-1] < 1e-8 * (1 + np.linalg.norm(A, 2))


# -- printed values -----------------------------------------------------------------------------------------


def test_spinning_satellite_real_repeated_is_one_at_one_frequency():
    """Skogestad and Postlethwaite (1996), example 8.10: mu is 1 at one frequency, 0 at all others.

    -T(j omega) has eigenvalues -(1 +- j a)/(1 + j omega), real (equal to -1) at omega = a only.
    """
    N = spinning_satellite()
    found = mu_peak(N, [R(2)])
    assert found.guaranteed
    assert 1.0 <= found.upper < 1.002
    assert found.lower == pytest.approx(1.0, rel=1e-6) and found.omega == pytest.approx(10.0, rel=1e-6)
    assert found.delta == pytest.approx(-np.eye(2), abs=1e-6) and singular_at(N, found)
    grid = N.frequency_response(np.geomspace(0.1, 1e3, 50))
    assert np.max(mu(grid, [R(2)]).upper) < 1e-3


@pytest.mark.parametrize("blocks", [[F(2)], [C(2)], [C(), C()]])
def test_spinning_satellite_complex(blocks):
    """sigma_max(T(0)) = sqrt(1 + a^2), and |eig T(0)| = |1 +- j a| is the same: all three structures coincide."""
    expected = np.sqrt(101)
    found = mu_peak(spinning_satellite(), blocks)
    assert found.guaranteed and found.omega == 0.0
    assert expected * (1 - 1e-4) <= found.upper <= expected * (1 + 1e-3)
    assert found.lower == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("channels, blocks, printed", [(2, [C(), C()], 0.5242), (4, [C(), C(), F(2)], 5.7726)])
def test_distillation_on_the_grid_of_the_book(channels, blocks, printed):
    """Skogestad and Postlethwaite's own Fig8_15.m: 0.5242 (robust stability) and 5.7726 (robust performance), the
    largest upper bounds at 61 points from 1e-3 to 1e3 rad/s."""
    grid = distillation().select(range(channels), range(channels)).frequency_response(np.logspace(-3, 3, 61))
    assert np.max(mu(grid, blocks).upper) == pytest.approx(printed, abs=5e-5)


def test_distillation_robust_stability_and_performance():
    """Between those points the peaks are a little higher; 0.53 and 5.77 from the text of section 8.11.3 alone."""
    N = distillation()
    stability = mu_peak(N.select(slice(2), slice(2)), [C(), C()])
    performance = mu_peak(N, [C(), C(), F(2)])
    assert stability.upper == pytest.approx(0.53, abs=5e-3) and stability.lower == pytest.approx(0.53, abs=5e-3)
    assert performance.guaranteed and performance.upper == pytest.approx(5.77, rel=5e-3)
    assert performance.lower >= (1 - 1e-3) * performance.upper and singular_at(N, performance)


def test_distillation_worst_case_gain():
    """Peak of the skewed mu: 44.92 by muperf in Skogestad and Postlethwaite's Fig8_15.m (off a grid, hence 0.5 %)."""
    N = distillation()
    found = worst_case_gain(N, [C(), C()])
    assert found.guaranteed and found.upper == pytest.approx(44.92, rel=5e-3)
    assert found.lower == pytest.approx(44.92, rel=5e-3)
    # The scaled system has mu 1 exactly at the worst-case gain (definition of the skewed mu).
    skewed = mu_peak(N.scaled(left=[1, 1, 1 / found.upper, 1 / found.upper]), [C(), C(), F(2)])
    assert skewed.upper == pytest.approx(1.0, rel=2e-3)


@pytest.mark.parametrize(
    "num, den, printed",
    [
        ([1.0], [1.0], 1.1798),
        (2 * np.poly([-1000, -0.25, -0.054]) / 1000, np.polymul([1, 1.34, 0.67**2 + 0.56**2], [1, 0.013]), 0.9740),
    ],
)
def test_distillation_under_the_controllers_of_the_book(num, den, printed):
    """H-infinity optimal for D = I (first D-K step) and for Lundstroem's D: peak mu 1.1798 and 0.9740 in Skogestad and
    Postlethwaite's own Sec8_124.m (section 8.12.4; off a grid of 61 points, searches to 0.1 %)."""
    P, d, inverse, one = distillation_plant(), tf(num, den), tf(den, num), tf([1.0], [1.0])
    left = append(*(x.renamed([f"i{k}"], [f"o{k}"]) for k, x in enumerate([d, d, one, one, one, one])))
    right = append(*(x.renamed([f"i{k}"], [f"o{k}"]) for k, x in enumerate([inverse, inverse, one, one, one, one])))
    K = hinfsyn(
        left.renamed(P.outputs, P.outputs) @ P @ right.renamed(P.inputs, P.inputs), 2, 2, backoff=1e-4, tolerance=1e-4
    ).K
    found = mu_peak(lft_lower(P, K), [C(), C(), F(2)])
    assert found.guaranteed and found.lower == pytest.approx(printed, rel=1e-3)
    assert found.upper == pytest.approx(printed, rel=2e-3)


def test_two_carts_with_uncertain_masses_and_spring():
    """MathWorks, Robust Control Toolbox, "Robust Stability and Worst-Case Gain of Uncertain System": m1 = m2 = k = 1
    +- 20 %, C = 100 ((s + 1)/(0.001 s + 1))^3 on the second cart's position: margin at most 2.8864 (lower bounds from
    2.8803 to 2.8834 in different releases), at 575.0339 rad/s, with k = 1.5773 and m1 = m2 = 0.4227."""
    s = 0.2
    # m1 x1'' = u - f - w1, m2 x2'' = f - w2, f = x1 - x2 + w_k; z = s (x1'', x2'', x1 - x2).
    carts = StateSpace(
        [[0, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0, 1], [1, 0, -1, 0]],
        [[0, 0, 0, 0], [-1, 0, -1, 1], [0, 0, 0, 0], [0, -1, 1, 0]],
        [[-s, 0, s, 0], [s, 0, -s, 0], [s, 0, -s, 0], [0, 0, 1, 0]],
        [[-s, 0, -s, s], [0, -s, s, 0], [0, 0, 0, 0], [0, 0, 0, 0]],
        0.0,
        ["w1", "w2", "w_k", "u"],
        ["z1", "z2", "z_k", "x2"],
    )
    controller = tf(-100 * np.poly([-1, -1, -1]), np.poly([-1000, -1000, -1000]) / 1e9, ["x2"], ["u"])
    found = mu_peak(connect([carts, controller], ["w1", "w2", "w_k"], ["z1", "z2", "z_k"]), [R(), R(), R()])
    assert 1 / found.lower == pytest.approx(2.8864, abs=5e-5) and found.omega == pytest.approx(575.0339, abs=5e-5)
    assert 1 + s * np.diag(found.delta).real == pytest.approx([0.4227, 0.4227, 1.5773], abs=5e-5)
    assert found.guaranteed and 2.8834 <= 1 / found.upper <= 1 / found.lower


def test_mass_spring_damper_with_uncertain_damping():
    """MathWorks, "Getting Reliable Estimates of Robustness Margins": m = k = 1, c = 1 +- 100 %: margin 1 at 1 rad/s."""
    N = StateSpace([[0, 1], [-1, -1]], [[0], [-1]], [[0, 1]], [[0]])
    found = mu_peak(N, [R()])
    assert found.guaranteed and found.upper == pytest.approx(1.0, rel=1e-3)
    assert found.lower == pytest.approx(1.0, rel=1e-9) and found.omega == pytest.approx(1.0, rel=1e-6)


# -- exact values -------------------------------------------------------------------------------------------


def test_full_block_is_the_hinf_norm(rng):
    N = flexible(rng, 2, 3)
    found = mu_peak(N, [F(2, 3)])
    norm = hinf_norm(N)
    assert found.guaranteed and norm.gain * (1 - 1e-6) <= found.upper <= norm.gain * (1 + 2e-3)
    assert found.lower == pytest.approx(norm.gain, rel=1e-3) and found.omega == pytest.approx(norm.omega, rel=1e-3)


def test_narrow_resonance_between_grid_points():
    """A mode of damping 1e-7 (half-width 1e-7 of its frequency) beside a broad one."""
    narrow, broad = tf([1e-6, 0], [1, 2e-7 * 3.7, 3.7**2]), tf([1], [1, 1])
    N = append(narrow.renamed(["a"], ["b"]), broad.renamed(["c"], ["d"]))
    found = mu_peak(N, [C(), C()])
    assert found.guaranteed
    assert found.upper == pytest.approx(1e-6 / (2e-7 * 3.7), rel=1e-3) and found.omega == pytest.approx(3.7, rel=1e-6)


@pytest.mark.parametrize("zeta", [1e-4, 1e-5, 1e-6])
def test_the_lower_bound_is_searched_where_the_proof_found_a_resonance(zeta):
    """One complex block: mu is the gain. The mode at 0.06 rad/s is narrower than the spacing of the frequencies."""
    w0 = 0.06
    mode = StateSpace(
        [[-zeta * w0, w0], [-w0, -zeta * w0]], [[0.0], [np.sqrt(zeta * w0)]], [[np.sqrt(zeta * w0), 0.0]], [[-1.0]]
    )
    N = mode + tf([0.014], [1.0, 0.012, 36.0])
    found = mu_peak(N, [C()])
    exact = hinf_norm(N, 1e-9).gain
    assert exact * (1 - 1e-3) <= found.lower <= exact * (1 + 1e-6) and exact <= found.upper * (1 + 1e-6)


def test_a_bound_that_was_given_is_not_called_a_proof():
    found = mu_peak(tf([1], [1, 0.1, 1]), [C()], known_upper=10.02)
    assert found.upper == 10.02 and found.covers.endswith("the bound that was given")


def test_spike_of_a_real_parameter_away_from_every_pole():
    """1 + delta L(s), L = 2/(s+1)^3: the phase is -180 degrees at sqrt(3) alone, |L| = 1/4 there; L(0) = 2."""
    N = -tf([2], [1, 3, 3, 1])
    spike = mu_peak(N, [R()], band=(0.5, 10.0))
    assert spike.guaranteed and spike.upper == pytest.approx(0.25, rel=1e-3)
    assert spike.lower == pytest.approx(0.25, rel=1e-8) and spike.omega == pytest.approx(np.sqrt(3), rel=1e-8)
    assert mu_peak(N, [R()]).lower == pytest.approx(2.0, rel=1e-9)


def test_real_perturbation_puts_a_pole_on_the_axis(rng):
    N = flexible(rng, 3, 3, modes=4, damping=0.05)
    found = mu_peak(N, [R(), R(), R()])
    assert found.guaranteed and 0 < found.lower <= found.upper
    closed = N.A + N.B @ found.delta.real @ np.linalg.solve(np.eye(3) - N.D @ found.delta.real, N.C)
    assert np.min(np.abs(np.linalg.eigvals(closed) - 1j * found.omega)) < 1e-6 * max(found.omega, 1.0)
    for _ in range(200):
        delta = np.diag(rng.uniform(-1, 1, 3)) / found.upper
        perturbed = N.A + N.B @ delta @ np.linalg.solve(np.eye(3) - N.D @ delta, N.C)
        assert np.max(np.linalg.eigvals(perturbed).real) < 0


@pytest.mark.parametrize("dead", ["z", "w"])
def test_blocks_without_a_loop_change_nothing(rng, dead):
    """A lag beside N whose z (or w) is linked to nothing leaves both peaks as they are."""
    N = flexible(rng, 4, 4, modes=3, damping=0.05).scaled(left=0.05)
    lag = tf([3], [1, 2])
    inside = append(N.renamed(list("abcd"), list("pqrs")), lag.renamed(["lag_in"], ["lag_out"]))
    right, left = np.eye(5), np.eye(5)
    # One end of the lag is taken off; the other end of that channel acts on N (or sees it) all the same.
    if dead == "z":
        right[4, 4], right[0, 4] = 0.0, 1.0
    else:
        left[4, 4], left[4, 0] = 0.0, 1.0
    whole = inside.scaled(left=left, right=right).select([0, 4, 1, 2, 3], [0, 4, 1, 2, 3])
    assert whole.nstates == N.nstates + 1
    for function, blocks, small in ((mu_peak, [R(), C(), F(3)], [R(), F(3)]), (worst_case_gain, [R(), C()], [R()])):
        found, expected = function(whole, blocks), function(N, small)
        assert found.guaranteed and found.upper == pytest.approx(expected.upper, rel=1e-3)
        assert found.lower == pytest.approx(expected.lower, rel=1e-3)
        assert found.delta.shape[0] == BlockStructure.of(blocks).n_w
        assert not np.any(found.delta[1]) and not np.any(found.delta[:, 1])


def test_flat_peak_of_a_passive_oscillator():
    """Two masses, dampers and springs in a chain, each uncertain by 30 %: sup mu is 0.3.

    As long as all are positive the energy decays and the chain is stable; at 1/0.3 a stiffness vanishes, or every
    damping does, at any frequency the masses and springs may be given: mu is 0.3 over a whole range, not at a peak.
    """
    m, c, k, share = [1.0, 0.7], [4.0, 6.0], [30.0, 90.0], 0.3
    L = np.array([[1.0, 0.0], [-1.0, 1.0]])
    mass, M_inv = np.diag(m), np.diag(1 / np.array(m))
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-M_inv @ L.T @ np.diag(k) @ L, -M_inv @ L.T @ np.diag(c) @ L]])
    # m x'' + L^T w_c + L^T w_k + w_m + .. = 0 with w = delta z, z_m = 0.3 m x'', z_c = 0.3 c L x', z_k = 0.3 k L x.
    B = np.vstack([np.zeros((2, 6)), -M_inv @ np.hstack([np.eye(2), L.T, L.T])])
    C_ = share * np.vstack(
        [mass @ A[2:], np.hstack([np.zeros((2, 2)), np.diag(c) @ L]), np.hstack([np.diag(k) @ L, np.zeros((2, 2))])]
    )
    D = share * np.vstack([mass @ B[2:], np.zeros((4, 6))])
    found = mu_peak(StateSpace(A, B, C_, D), [R()] * 6, slack=5e-3)
    assert found.guaranteed and found.lower == pytest.approx(share, rel=1e-5)
    assert share <= found.upper <= 1.1 * share


def test_a_proof_that_takes_too_long_is_given_up_and_says_so(rng):
    """Narrow resonances and no room for rounds: the bound is not called proved and the gaps are named."""
    N = flexible(rng, 3, 3, modes=10)
    structure = BlockStructure.of([R(), R(), R()])
    bound = mu(N.frequency_response(np.abs(N.poles())), structure).upper
    done = Cover(
        N,
        structure,
        lambda level: N.scaled(left=1 / level),
        lambda M: upper_bound(M, structure, 1e-4).beta,
        0.5 * float(np.max(bound)),
        5e-4,
    ).run((0.0, np.inf), np.abs(N.poles()), rounds=2)
    assert done.gaps and all(low < high for low, high in done.gaps)
    found = mu_peak(N, structure)
    assert found.guaranteed and found.lower <= found.upper


def test_larger_slack_stays_above(rng):
    N = flexible(rng, 4, 4)
    fine, coarse = (mu_peak(N, [R(), C(), F(2)], slack=slack) for slack in (5e-4, 1e-2))
    assert coarse.guaranteed and fine.lower <= fine.upper <= coarse.upper * (1 + 1e-4)
    assert coarse.upper <= 1.03 * fine.upper
    with pytest.raises(InputError, match="slack"):
        mu_peak(N, [R(), C(), F(2)], slack=0.0)


# -- the guarantee, bands, clocks ---------------------------------------------------------------------------


def test_upper_bound_holds_between_the_points(rng):
    blocks = [R(), C(), C(2), F(2)]
    N = flexible(rng, 6, 6, modes=8)
    found = mu_peak(N, blocks)
    assert found.guaranteed and "from 0 to infinity" in found.covers
    dense = np.concatenate([np.abs(N.poles()) * (1 + d) for d in np.linspace(-5e-3, 5e-3, 41)])
    assert np.max(mu(N.frequency_response(dense), blocks).upper) <= found.upper * (1 + 1e-6)
    assert found.lower >= 0.9 * found.upper and singular_at(N, found)
    assert found.upper_curve.shape == found.lower_curve.shape == found.frequencies.shape
    assert np.all(found.lower_curve <= found.upper_curve * (1 + 1e-6)) and np.max(found.upper_curve) <= found.upper


def test_band():
    N = distillation()
    low = mu_peak(N, [C(), C(), F(2)], band=(0.0, 0.1))
    assert low.guaranteed and low.omega == pytest.approx(0.1)
    assert low.upper == pytest.approx(mu(N(0.1j), [C(), C(), F(2)]).upper, rel=1e-3)
    high = worst_case_gain(N, [C(), C()], band=(100.0, np.inf))
    assert high.guaranteed and high.upper < 0.5 * worst_case_gain(N, [C(), C()]).upper


def test_sampled_system_has_the_mu_of_its_bilinear_image():
    N, blocks = distillation(), [C(), C(), F(2)]
    continuous, sampled = mu_peak(N, blocks), mu_peak(discretise(N, 0.1, "tustin"), blocks)
    assert sampled.upper == pytest.approx(continuous.upper, rel=1e-3)
    assert np.tan(sampled.omega * 0.05) / 0.05 == pytest.approx(continuous.omega, rel=1e-2)
    assert sampled.frequencies[-1] == pytest.approx(np.pi / 0.1)


def test_static_and_zero_systems():
    assert mu_peak(gain([[2, 2], [-1, -1]]), [C(), C()]).upper == pytest.approx(3.0, rel=1e-3)
    nothing = mu_peak(tf([1], [1, 1]).scaled(left=0.0), [C()])
    assert nothing.upper < 1e-8 and nothing.lower == 0 and nothing.delta is None


# -- worst-case gain and simulation -------------------------------------------------------------------------


def test_worst_case_gain_is_what_the_perturbed_system_has(rng):
    blocks = [R(2), C(2), C(), F(2, 1)]
    structure = BlockStructure.of(blocks)
    N = flexible(rng, structure.n_w + 2, structure.n_z + 2, modes=5, damping=0.02)
    robust = mu_peak(N.select(range(structure.n_z), range(structure.n_w)), blocks)
    N = N.scaled(left=np.r_[np.full(structure.n_z, 0.5 / robust.upper), np.ones(2)])
    found = worst_case_gain(N, blocks)
    assert found.guaranteed and hinf_norm(N.select([-2, -1], [-2, -1])).gain < found.lower <= found.upper
    delta = realise_delta(found.delta, found.omega, blocks)
    assert hinf_norm(delta).gain <= 1 + 1e-9
    closed = lft_upper(N, delta)
    assert np.linalg.norm(closed(1j * found.omega), 2) == pytest.approx(found.lower, rel=1e-6)
    assert found.lower * (1 - 1e-6) <= hinf_norm(closed).gain <= found.upper
    for _ in range(100):
        response = lft_upper(N, structure.random(rng, real=True).real).frequency_response(found.frequencies)
        assert np.max(np.linalg.norm(response, 2, axis=(1, 2))) <= found.upper


def test_worst_case_gain_of_an_unstable_family():
    N = distillation().scaled(left=[4, 4, 1, 1])
    found = worst_case_gain(N, [C(), C()])
    assert found.upper == np.inf and found.lower == np.inf and "unstable" in found.covers
    assert np.linalg.norm(found.delta, 2) <= 1
    assert singular_at(N.select(slice(2), slice(2)), found)


def test_no_gain_is_proved_in_a_band_where_another_frequency_is_unstable():
    """A perturbation of norm 1 destabilises a resonance at 10 rad/s; the gain is asked for far below it."""
    N = append(tf([20.0], [1, 0.2, 100], ["w"], ["z"]), tf([1.0], [1, 1], ["d"], ["e"]))
    structure = [C()]
    assert mu_peak(N.select([0], [0]), structure).lower > 1
    found = worst_case_gain(N, structure, band=(0.01, 0.1))
    assert found.upper == np.inf and found.lower == np.inf
    halved = worst_case_gain(N.scaled(left=[0.05, 1.0]), structure, band=(0.01, 0.1))
    assert halved.guaranteed and halved.upper == pytest.approx(abs(1 / (1 + 0.01j)), rel=6e-3)


def test_realised_perturbation_puts_a_pole_on_the_axis(rng):
    blocks = [R(), C(2), F(2, 3)]
    structure = BlockStructure.of(blocks)
    N = flexible(rng, structure.n_w, structure.n_z, modes=4, damping=0.02)
    found = mu_peak(N, blocks)
    delta = realise_delta(found.delta, found.omega, blocks)
    assert delta.is_stable() and hinf_norm(delta).gain == pytest.approx(1 / found.lower, rel=1e-6)
    assert np.max(np.abs(delta(1j * found.omega) - found.delta)) < 1e-6 / found.lower
    doubled = N.scaled(left=np.vstack([np.eye(structure.n_z)] * 2), right=np.hstack([np.eye(structure.n_w)] * 2))
    poles = lft_upper(doubled, delta).poles()
    assert np.min(np.abs(poles - 1j * found.omega)) < 1e-5 * found.omega


@pytest.mark.parametrize("value", [0.3 + 0.4j, -0.3 + 0.4j, 0.3 - 0.4j, -0.3 - 0.4j, 0.5, -0.5])
def test_realised_scalar_is_all_pass(value):
    delta = realise_delta([[value]], 7.0, [C()])
    assert delta(7j)[0, 0] == pytest.approx(value, abs=1e-12)
    assert np.abs(delta.frequency_response(np.geomspace(1e-3, 1e4, 30))) == pytest.approx(0.5, rel=1e-9)


# -- input --------------------------------------------------------------------------------------------------


def test_unstable_system_names_its_pole():
    with pytest.raises(ComputationError, match=r"pole 0\.25"):
        mu_peak(tf([1], [1, -0.25]), [C()])


def test_wrong_input_is_named():
    N = tf([1], [1, 1])
    with pytest.raises(InputError, match="blocks"):
        mu_peak(N, [C(), C()])
    with pytest.raises(InputError, match="band"):
        mu_peak(N, [C()], band=(2.0, 1.0))
    with pytest.raises(InputError, match="performance"):
        worst_case_gain(N, [C()])
    with pytest.raises(InputError, match="structure"):
        realise_delta(np.eye(3), 1.0, [C()])
    with pytest.raises(ComputationError, match="frequency 0"):
        realise_delta([[1j]], 0.0, [C()])
    with pytest.raises(ComputationError, match="rank one"):
        realise_delta(np.eye(2), 1.0, [F(2)])


@pytest.mark.parametrize("band_Hz", [(0.2, 2.0), (2.0, 4.9), (0.9, 1.1)])
def test_a_band_of_a_sampled_system_is_in_its_own_frequencies(band_Hz):
    """Two resonances, 1 and 3 Hz at 10 Hz: the frequency axis is bent by 30 % at 3 Hz. Against a dense grid."""
    modes = [
        tf([0.1 * w], [1.0, 0.02 * w, w * w], [f"u{k}"], [f"y{k}"])
        for k, w in enumerate(2 * np.pi * np.array([1.0, 3.0]))
    ]
    N = discretise(append(*modes), 0.1, "tustin").scaled(left=np.array([[1.0, 0.5], [0.3, 2.0]]))
    low, high = (2 * np.pi * f for f in band_Hz)
    found = mu_peak(N, [F(2)], band=(low, high))
    omega = np.linspace(low, high, 20001)
    sigma = np.linalg.norm(N.frequency_response(omega), ord=2, axis=(1, 2))
    assert found.guaranteed and sigma.max() <= found.upper <= 1.01 * sigma.max()
    assert found.omega == pytest.approx(omega[np.argmax(sigma)], rel=2e-3)
    assert np.all((found.frequencies >= low * (1 - 1e-9)) & (found.frequencies <= high * (1 + 1e-9)))


def test_a_known_robust_stability_changes_no_bound(rng):
    """With and without it, in a band and at all frequencies; a perturbation that destabilises is returned."""
    N = StateSpace(
        -np.eye(6) + 0.3 * rng.standard_normal((6, 6)),
        0.4 * rng.standard_normal((6, 4)),
        0.4 * rng.standard_normal((4, 6)),
        np.zeros((4, 4)),
    )
    blocks, inner = [R(), C()], N.select(range(2), range(2))
    robust = mu_peak(inner, blocks)
    assert robust.upper < 1
    for band in ((0.0, np.inf), (0.5, 3.0)):
        alone, told = (worst_case_gain(N, blocks, band=band, robust=one) for one in (None, robust))
        few = worst_case_gain(N, blocks, band=band, points=3)
        assert alone.guaranteed and told.guaranteed and few.guaranteed
        assert told.upper == pytest.approx(alone.upper, rel=2e-3) and few.upper == pytest.approx(alone.upper, rel=2e-3)
        assert few.frequencies.size < alone.frequencies.size
    large = N.scaled(left=np.r_[np.full(2, 2.0 / robust.lower), np.ones(2)])
    unstable = mu_peak(large.select(range(2), range(2)), blocks)
    found = worst_case_gain(large, blocks, robust=unstable)
    assert found.lower == found.upper == np.inf
    singular = np.eye(2) - large.select(range(2), range(2)).frequency_response(np.array([found.omega]))[0] @ found.delta
    assert np.linalg.norm(found.delta, 2) <= 1 and np.linalg.svd(singular)[1][-1] < 1e-6
    # The quicker proof says as much: where the peak of mu is below 1 and where it is not.
    quick, failing = stability_bound(inner, blocks), stability_bound(large.select(range(2), range(2)), blocks)
    assert quick.guaranteed and robust.lower <= quick.upper < 1
    assert worst_case_gain(N, blocks, robust=quick).upper == pytest.approx(worst_case_gain(N, blocks).upper, rel=2e-3)
    assert failing.lower == pytest.approx(unstable.lower, rel=1e-3) and failing.lower > 1


def test_worst_case_gain_without_uncertainty_is_the_norm():
    found = worst_case_gain(tf([2.0], [1.0, 1.0]), [])
    assert 2.0 <= found.upper <= 2.002 and found.lower == pytest.approx(2.0)


def oscillators(seed):
    """Lightly damped oscillators in series and in parallel, with uncertain mass, stiffness, damping and actuators."""
    rng = np.random.default_rng(seed)
    plant = None
    for n in range(rng.integers(1, 4)):
        k = ac.real(f"k{n}", float(rng.uniform(1, 30)), percent=float(rng.uniform(5, 25)))
        c = float(rng.uniform(0.02, 0.3))
        c = ac.real(f"c{n}", c, percent=30) if rng.random() < 0.5 else c
        m = ac.real(f"m{n}", float(rng.uniform(0.5, 2)), percent=10) if rng.random() < 0.3 else 1.0
        one = ac.ss([[0, 1], [-k / m, -c / m]], [[0], [1 / m]], [[1, 0]])
        if rng.random() < 0.5:
            one = one * (1 + ac.dynamics(f"d{n}", 0.2))
        plant = one if plant is None else plant + one if rng.random() < 0.6 else plant * one
    return plant


def least_skewed_level(M, structure, unit):
    """Smallest gain that the linear matrix inequality of Fan, Tits and Doyle proves for scalar blocks, by Clarabel."""
    M, X, G = np.diag(np.r_[np.ones(len(M) - 1), 1 / unit]) @ M, [], []
    for block in structure.blocks[:-1]:
        X.append(cp.Variable(nonneg=True))
        G.append(cp.Variable() if block.kind == "real" else 0.0)
    level = cp.Variable()
    GM = cp.diag(cp.hstack([*G, 0.0])) @ M
    F = cp.diag(cp.hstack([*X, level])) - M.conj().T @ cp.diag(cp.hstack([*X, 1.0])) @ M - 1j * (GM - GM.H)
    problem = cp.Problem(cp.Minimize(level), [cp.bmat([[cp.real(F), -cp.imag(F)], [cp.imag(F), cp.real(F)]]) >> 0])
    problem.solve(solver="CLARABEL")
    return unit * np.sqrt(level.value)


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize(("seed", "omega"), [(1, 5.13), (8, 5.4), (17, 2.26)])
def test_upper_bound_of_the_worst_case_gain_is_that_of_another_solver(seed, omega):
    """The path of analytic centres that was used before ended at 5 to 140 times this bound."""
    N, structure = oscillators(seed).lft()
    M, whole = N.frequency_response([omega]), structure.with_performance(1, 1)
    ours = skewed_upper_bound(M[:, None], whole, 1e-4).beta[0]
    attained = worst_gain(M, structure).gain[0]
    assert attained <= ours * (1 + 1e-9)
    assert ours == pytest.approx(least_skewed_level(M[0], whole, attained), rel=1e-2)


def test_worst_case_peak_with_an_uncertain_actuator():
    """1.2 times the peak 1 / (c sqrt(k - c^2 / 4)) of the softest oscillator."""
    k = ac.real("k", 3.0, percent=15)
    found = ac.worst_case_gain(ac.ss([[0, 1], [-k, -0.4]], [[0], [1]], [[1, 0]]) * (1 + ac.dynamics("act", 0.2)))
    peak = 1.2 / (0.4 * np.sqrt(2.55 - 0.04))
    assert peak / 1.001 < found.lower <= peak * (1 + 1e-9) and peak <= found.upper < 1.001 * peak


@pytest.mark.parametrize("units", [1e-6, 1.0, 1e6])
def test_the_worst_case_gain_does_not_depend_on_the_units_of_its_output(units):
    """m/(N s) of a table is 1e-6 in size; mm/(N s) is not."""
    rng = np.random.default_rng(3)
    M = rng.standard_normal((6, 1, 7, 7)) + 1j * rng.standard_normal((6, 1, 7, 7))
    M[:, :, :4, :4] *= 0.15
    blocks = BlockStructure.of([RealScalar(2), RealScalar(), ComplexScalar()])
    whole = blocks.with_performance(3, 3)
    scaled = M.copy()
    scaled[:, :, 4:] *= units
    beta, scalings = skewed_upper_bound(scaled, whole)
    np.testing.assert_allclose(beta / units, skewed_upper_bound(M, whole).beta, rtol=1e-4)
    # The scalings prove the bound in the units of the caller.
    level = np.arange(7) >= 4
    least = np.linalg.eigvalsh(residual(scaled, scalings, (beta * (1 + 1e-6)) ** 2, level)[:, 0])[:, 0]
    assert np.all(least > -1e-9 * np.linalg.norm(scalings.X_w, axis=(1, 2)))


def test_the_worst_case_gain_does_not_depend_on_the_units_inside():
    """Between the blocks, a table has metres and newtons: entries of 1e6 and 1e-7 beside each other."""
    rng = np.random.default_rng(4)
    M = rng.standard_normal((3, 1, 6, 6)) + 1j * rng.standard_normal((3, 1, 6, 6))
    M[:, :, :5, :5] *= 0.1
    whole = BlockStructure.of([RealScalar()] * 3 + [ComplexScalar()] * 2).with_performance(1, 1)
    units = np.array([1e7, 1.0, 1e-7, 1e4, 1e-5, 1.0])
    found = skewed_upper_bound(M * units[:, None] / units, whole).beta
    np.testing.assert_allclose(found, skewed_upper_bound(M, whole).beta, rtol=1e-4)


def test_worst_gain_of_a_matrix_that_a_perturbation_makes_singular():
    """1 + delta/(1 - delta): infinite at delta = 1; the other matrix of the stack has 1 + 1/(1 - 0.5) = 3."""
    M = np.array([[[1.0, 1.0], [1.0, 1.0]], [[0.5, 1.0], [1.0, 1.0]]], complex)
    assert np.allclose(worst_gain(M, BlockStructure.of([C()])).gain, [np.inf, 3.0])
    M[1] = np.nan
    with pytest.raises(InputError, match="finite"):
        worst_gain(M, BlockStructure.of([C()]))


def test_worst_case_gain_where_mu_is_exactly_one():
    """1/(s + 1 - delta) has its pole at zero for delta = 1."""
    loop = StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 2)))
    found = worst_case_gain(loop, [R()])
    assert found.upper == found.lower == np.inf


def test_a_hidden_mode_at_the_limit_of_stability_is_an_error():
    """Two masses and a spring, angles as states, the speed fed back: the common angle has a pole at zero, which
    eigenvalue computation moves to about -1e-13."""
    k, c, J = 800.0, 0.05, (0.02, 0.05)
    A = np.array(
        [
            [0, 1, 0, 0],
            [-k / J[0], -c / J[0], k / J[0], c / J[0]],
            [0, 0, 0, 1],
            [k / J[1], c / J[1], -k / J[1], -c / J[1]],
        ]
    )
    A[1, 1] -= 0.8 / J[0]
    for shift in (0.0, 1e-15):
        loop = StateSpace(A - shift * np.eye(4), [[0], [1 / J[0]], [0], [0]], [[0, 1, 0, 0]], [[0.0]])
        with pytest.raises(ComputationError, match=r"need a stable system.*at the limit of stability"):
            mu_peak(loop, [ComplexScalar(1)])


def test_free_motion_of_a_mechanism_is_an_error():
    """Two inertias and a spring. With a damper to ground at the motor the common angle is one integrator that round-off
    moves to about -1e-13; without it, a double integrator that round-off moves to about -1e-15 +- 1e-7 j."""
    k, b, J1, J2 = 120.0, 0.03, 0.02, 0.05
    for ground in (0.05, 0.0):
        A = np.array(
            [
                [0, 0, 1, 0],
                [0, 0, 0, 1],
                [-k / J1, k / J1, -(b + ground) / J1, b / J1],
                [k / J2, -k / J2, b / J2, -b / J2],
            ]
        )
        for sign in (1, -1):  # round-off may fall on either side
            loop = StateSpace(A + sign * 1e-15 * np.eye(4), [[0], [0], [1 / J1], [0]], [[0, 0, 1, 0]], [[0.0]])
            with pytest.raises(ComputationError, match=r"at the limit of stability.*differences of positions"):
                mu_peak(loop, [ComplexScalar(1)])


def test_many_equal_or_slow_poles_are_not_at_the_limit_of_stability():
    lag = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    chain = lag
    for _ in range(9):
        chain = chain @ lag
    slow = StateSpace([[-1e-3, 0.0], [1e3, -1e6]], [[1.0], [0.0]], [[0.0, 1e3]], [[0.0]])
    sampled = StateSpace([[1 - 1e-6, 1.0], [0.0, 1 - 1e-6]], [[0.0], [1.0]], [[1e-13, 0.0]], [[0.0]], dt=1e-3)
    for loop in (chain, slow, sampled):
        assert mu_peak(loop, [ComplexScalar(1)]).guaranteed


def exact_gain(N, omega):
    """|N(j omega)| of a system with one input and one output, in rational arithmetic on its floating-point entries."""
    n, w = N.nstates, Fraction(omega)
    # Real and imaginary part of (j w I - A) x = B.
    A = [[Fraction(float(a)) for a in row] for row in N.A]
    rows = [
        [-A[i][j] for j in range(n)] + [-w * (i == j) for j in range(n)] + [Fraction(float(N.B[i, 0]))]
        for i in range(n)
    ]
    rows += [[w * (i == j) for j in range(n)] + [-A[i][j] for j in range(n)] + [Fraction(0)] for i in range(n)]
    for k in range(2 * n):
        pivot = next(i for i in range(k, 2 * n) if rows[i][k])
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [a / rows[k][k] for a in rows[k]]
        for i in range(2 * n):
            if i != k and rows[i][k]:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    x = [row[-1] for row in rows]
    C = [Fraction(float(c)) for c in N.C[0]]
    real, imag = (sum(c * v for c, v in zip(C, part, strict=True)) for part in (x[:n], x[n:]))
    return float(real**2 + imag**2) ** 0.5


@pytest.mark.parametrize("seed", range(1, 9))
def test_a_narrow_peak_just_above_the_level_is_not_missed(seed):
    """Three modes of 1, 1e3 and 1e5 rad/s, the first with a damping ratio of 1e-4, in random coordinates: its two
    crossings of the level are nearly a double eigenvalue. The gain at its peak is computed exactly."""
    frequency, damping = np.array([1.0, 1e3, 1e5]), np.array([1e-4, 0.1, 0.1])
    draw = np.random.default_rng(seed)
    A = la.block_diag(*([[0, w], [-w, -2 * z * w]] for w, z in zip(frequency, damping, strict=True)))
    B, C = draw.standard_normal((6, 1)), draw.standard_normal((1, 6)) * np.repeat(8 * frequency * damping, 2)
    S = draw.standard_normal((6, 6))
    N = StateSpace(S @ A @ la.inv(S), S @ B, C @ la.inv(S), [[0.0]])
    peak = mu_peak(N, [ComplexFull(1, 1)])
    pole = min(N.poles(), key=lambda p: abs(p - 1j))
    near = pole.imag + abs(pole.real) * np.linspace(-1, 1, 41)
    highest = near[int(np.argmax(np.abs(N.frequency_response(near)[:, 0, 0])))]
    assert not peak.guaranteed or exact_gain(N, highest) <= peak.upper * (1 + 1e-6)
