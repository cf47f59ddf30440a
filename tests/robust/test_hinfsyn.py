"""H-infinity synthesis against closed forms and linear matrix inequalities (printed values: test_hinfsyn_printed)."""

from __future__ import annotations

import re

import control
import numpy as np
import pytest
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, append, connect, discretise, gain, hinf_norm, lft_lower, summing_junction, tf
from avis_ctrl.robust.hinf_bounds import pointwise_bound
from avis_ctrl.robust.hinf_lmi import UNCERTIFIED, certified, lmi_gamma
from avis_ctrl.robust.hinf_plant import Plant, posed_plant
from avis_ctrl.robust.hinf_riccati import gamma_test
from avis_ctrl.robust.hinfsyn import Status, hinf_suboptimal, hinfsyn

DISTURBANCE_PROCESS = ([200], np.polymul([10, 1], np.polymul([0.05, 1], [0.05, 1])))


def random_plant(rng, n, n_w, n_z, ncon, nmeas, direct=1.0):
    D = np.block(
        [
            [direct * rng.standard_normal((n_z, n_w)), rng.standard_normal((n_z, ncon))],
            [rng.standard_normal((nmeas, n_w)), direct * rng.standard_normal((nmeas, ncon))],
        ]
    )
    return StateSpace(
        rng.standard_normal((n, n)), rng.standard_normal((n, n_w + ncon)), rng.standard_normal((n_z + nmeas, n)), D
    )


def check(P, nmeas, ncon, result, backoff=0.01):
    """What every result must satisfy, measured by another route than the synthesis's own."""
    closed = lft_lower(P, result.K)
    assert np.max(la.eigvals(closed.A).real, initial=-1.0) < 0
    omega = np.geomspace(1e-4, 1e5, 2000)
    on_grid = np.max(la.svd(closed.frequency_response(omega), compute_uv=False))
    assert on_grid <= result.gamma * (1 + 1e-6)
    assert result.gamma <= (1 + backoff) * result.gamma_optimal_bounds[1] * (1 + 1e-4)
    assert result.K.inputs == P.outputs[-nmeas:] and result.K.outputs == P.inputs[-ncon:]


def mixed_sensitivity(weight, plant=DISTURBANCE_PROCESS):
    return connect(
        [
            tf(*plant, ["u"], ["g"]),
            summing_junction("e", ["r", "-g"]),
            tf(*weight, ["e"], ["wp_e"]),
            gain([[1.0]], ["u"], ["wu_u"]),
            gain([[1.0]], ["e"], ["y"]),
        ],
        ["r", "u"],
        ["wp_e", "wu_u", "y"],
    )


class TestKnownOptimum:
    @pytest.mark.parametrize("a", [-1.0, 0.0, 0.5, 3.0])
    def test_scalar_plant_in_closed_form(self, a):
        """Doyle, Glover, Khargonekar and Francis (IEEE TAC 34, 1989), theorem 3, for the scalar plant
        x' = a x + w1 + u, z = (x, u), y = x + w2: X = Y = 1/(sqrt(a^2 + 1 - 1/gamma^2) - a), so that
        rho(X Y) = gamma^2 at gamma = a + sqrt(a^2 + 2)."""
        P = StateSpace([[a]], [[1, 0, 1]], [[1], [0], [1]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
        result = hinfsyn(P, 1, 1, tolerance=1e-5)
        assert result.gamma_optimal_bounds[0] <= a + np.sqrt(a * a + 2) <= result.gamma_optimal_bounds[1] * (1 + 1e-9)
        check(P, 1, 1, result)

    @pytest.mark.parametrize("z", [0.5, 2.0])
    def test_weighted_sensitivity_with_a_right_half_plane_zero(self, z):
        """min ||W S|| = |W(z)|: Zames and Francis (IEEE TAC 28, 1983); Skogestad and Postlethwaite eq. 5.30."""
        P = connect(
            [
                tf([-1, z], [1, 4, 3], ["u"], ["g"]),
                summing_junction("e", ["r", "-g"]),
                tf([1, 1], [1, 0.01], ["e"], ["z"]),
                gain([[1.0]], ["e"], ["y"]),
            ],
            ["r", "u"],
            ["z", "y"],
        )
        exact = (z + 1) / (z + 0.01)
        result = hinfsyn(P, 1, 1)
        assert result.status is Status.REGULARISED and "D12" in result.notes[0]
        assert exact <= result.gamma <= 1.03 * exact
        assert pointwise_bound(posed_plant(P, 1, 1)) == pytest.approx(exact, rel=1e-6)
        assert lmi_gamma(P, 1, 1).upper == pytest.approx(exact, rel=2e-3)

    def test_sensitivity_peak_of_an_unstable_plant_with_a_zero(self):
        """min ||S|| = |z + p| / |z - p|: Skogestad and Postlethwaite, section 5.3, combined pole and zero."""
        z, p = 8.0, 1.0
        P = connect(
            [
                tf([1, -z], np.polymul([1, -p], [0.1, 1]), ["u"], ["g"]),
                summing_junction("y", ["r", "-g"]),
                gain([[1.0]], ["y"], ["e"]),
            ],
            ["r", "u"],
            ["e", "y"],
        )
        result = hinfsyn(P, 1, 1)
        assert (z + p) / (z - p) <= result.gamma <= 1.03 * (z + p) / (z - p)

    @pytest.mark.parametrize("poles", [[1.5], [1.0, 4.0]])
    def test_control_effort_to_stabilise(self, poles):
        """min ||K S|| = 1 / (smallest Hankel singular value of the mirrored unstable part):
        Glover (IJC 43, 1986, robust stabilisation), Skogestad and Postlethwaite eq. 5.31. One pole p: 2 p."""
        G = tf([1], np.poly(poles), ["u"], ["g"])
        P = connect([G, summing_junction("y", ["g", "d"]), gain([[1.0]], ["u"], ["z"])], ["d", "u"], ["z", "y"])
        mirrored = tf([1], np.poly(-np.array(poles)))
        Wc = la.solve_continuous_lyapunov(mirrored.A, -mirrored.B @ mirrored.B.T)
        # The antistable part s -> -s; for a second-order plant the sign of the numerator does not matter.
        Wo = la.solve_continuous_lyapunov(mirrored.A.T, -mirrored.C.T @ mirrored.C)
        smallest = np.sqrt(np.min(la.eigvals(Wc @ Wo).real))
        result = hinfsyn(P, 1, 1, tolerance=1e-5)
        assert result.gamma_optimal_bounds[1] == pytest.approx(1 / smallest, rel=2e-5)
        if len(poles) == 1:
            assert 1 / smallest == pytest.approx(2 * poles[0])
        check(P, 1, 1, result)

    def test_model_matching_by_nevanlinna_and_pick(self):
        """min over stable Q of ||T1 - T2 Q||, T2 inner with zeros z_i: the root of the largest eigenvalue of
        inv(A) B, A_ij = 1/(z_i + z_j), B_ij = T1(z_i) T1(z_j)/(z_i + z_j).
        Doyle, Francis and Tannenbaum, Feedback Control Theory (1992), chapters 9 and 10."""
        zeros = np.array([1.0, 3.0])
        T1 = tf([1, 10], [1, 2], ["w"], ["t1"])
        T2 = tf(np.poly(zeros), np.poly(-zeros), ["u"], ["t2"])
        P = connect([T1, T2, summing_junction("z", ["t1", "-t2"]), gain([[1.0]], ["w"], ["y"])], ["w", "u"], ["z", "y"])
        values = (zeros + 10) / (zeros + 2)
        A = 1 / np.add.outer(zeros, zeros)
        exact = np.sqrt(np.max(la.eigvals(np.linalg.solve(A, A * np.outer(values, values))).real))
        result = hinfsyn(P, 1, 1, tolerance=1e-5)
        assert result.gamma_optimal_bounds[1] == pytest.approx(exact, rel=2e-5)
        check(P, 1, 1, result)

    def test_nehari_distance_is_a_hankel_norm(self):
        """Distance of an antistable R from the stable functions = Hankel norm of its mirror image (Nehari 1957;
        Francis, A Course in H-infinity Control Theory, 1987). Posed as T1 = R T2 with T2 inner, its zeros R's poles."""
        p = np.array([1.0, 2.0])
        R_num = [3.0, 5.0]
        P = connect(
            [
                tf(R_num, np.poly(-p), ["w"], ["t1"]),
                tf(np.poly(p), np.poly(-p), ["u"], ["t2"]),
                summing_junction("z", ["t1", "-t2"]),
                gain([[1.0]], ["w"], ["y"]),
            ],
            ["w", "u"],
            ["z", "y"],
        )
        mirror = tf([-R_num[0], R_num[1]], np.poly(-p))
        result = hinfsyn(P, 1, 1, tolerance=1e-5)
        sigma = control.hankel_singular_values(mirror.to_control())
        assert result.gamma_optimal_bounds[1] == pytest.approx(sigma[0], rel=2e-5)

    def test_optimum_of_zero(self):
        """python-control's and Octave's example for SB10AD: both channels have stable inverses, K = -1/(s + 3)
        makes the closed loop vanish."""
        P = StateSpace([[-1]], [[1, 1]], [[1], [1]], [[0, 1], [1, 0]])
        result = hinfsyn(P, 1, 1)
        assert result.gamma < 1e-7 and result.gamma_optimal_bounds[0] == 0 and "zero" in result.limited_by
        s = 0.7j
        assert result.K(s)[0, 0] == pytest.approx(-1 / (s + 3), rel=1e-6)

    def test_static_problem_is_parrott(self, rng):
        """No states: min over K of ||D11 + D12 K D21|| (Parrott 1978), here with zero blocks known by hand."""
        P = gain([[3.0, 0.0, 0.0], [0.0, 5.0, 1.0], [0.0, 1.0, 0.0]])
        result = hinfsyn(P, 1, 1)
        assert result.gamma_optimal_bounds[1] == pytest.approx(3.0, rel=2e-3)


class TestAgainstMatrixInequalities:
    @pytest.mark.parametrize(
        "size",
        [
            (0, 3, 3, 1, 2),
            (1, 2, 2, 1, 1),
            (2, 2, 1, 1, 1),
            (3, 3, 2, 1, 2),
            (4, 4, 5, 2, 2),
            (3, 2, 4, 2, 2),
            (6, 3, 3, 2, 1),
        ],
    )
    def test_same_optimum_for_any_direct_terms(self, rng, size):
        n, n_w, n_z, ncon, nmeas = size
        P = random_plant(rng, n, n_w, n_z, ncon, nmeas)
        result = hinfsyn(P, nmeas, ncon)
        optimum = lmi_gamma(P, nmeas, ncon)
        assert result.gamma_optimal_bounds[0] <= optimum.upper * (1 + 1e-5)
        assert result.gamma_optimal_bounds[1] >= optimum.lower * (1 - 1e-5)
        assert optimum.lower == pytest.approx(optimum.upper, rel=1e-3)
        check(P, nmeas, ncon, result)

    def test_method_lmi_returns_its_own_bounds(self, rng):
        P = random_plant(rng, 3, 2, 2, 1, 1)
        by_lmi, by_riccati = hinfsyn(P, 1, 1, method="lmi"), hinfsyn(P, 1, 1)
        assert by_lmi.gamma_optimal_bounds[1] == pytest.approx(by_riccati.gamma_optimal_bounds[1], rel=1.5e-3)
        check(P, 1, 1, by_lmi)

    def test_no_controller_beats_the_lower_bound(self, rng):
        P = random_plant(rng, 4, 3, 3, 1, 1)
        bound = max(pointwise_bound(posed_plant(P, 1, 1)), hinfsyn(P, 1, 1).gamma_optimal_bounds[0])
        assert bound <= lmi_gamma(P, 1, 1).upper * (1 + 1e-6)

    def test_the_lower_bound_does_not_depend_on_the_units_of_u_and_y(self, rng):
        """A control in units 1e10 times larger acts all the same: its column is small, not zero."""
        D = np.zeros((5, 5))
        D[1:3, 3:] = D[3:, 1:3] = np.eye(2)
        for _ in range(4):
            P = StateSpace(
                rng.standard_normal((4, 4)) - 3 * np.eye(4), rng.standard_normal((4, 5)), rng.standard_normal((5, 4)), D
            )
            other = P.scaled(left=[1, 1, 1, 1, 1e-10], right=[1, 1, 1, 1, 1e-10])
            bound = pointwise_bound(posed_plant(P, 2, 2))
            assert pointwise_bound(posed_plant(other, 2, 2)) == pytest.approx(bound, rel=1e-6)

    @pytest.mark.parametrize("order, corner", [(3, 1e4), (5, 1e3)])
    def test_a_control_that_has_rolled_off_still_counts(self, order, corner):
        """z1 = u1 + w2 / 10, z2 = h w1 + g u2, y = w, with g = 1/(s + 1)^order and h a lag beyond its roll-off.

        u1 = -y2 / 10 and u2 = -(h/g) (s/a + 1)^-order y1 leave z2 = h (1 - (s/a + 1)^-order) w1, small for a large a.
        """
        g, h, a = tf([1], np.poly(-np.ones(order))), tf([corner], [1, corner]), 1e6
        B, C = np.zeros((order + 1, 4)), np.zeros((4, order + 1))
        B[:order, 3], C[1, :order], B[order, 0], C[1, order] = g.B[:, 0], g.C[0], h.B[0, 0], h.C[0, 0]
        P = StateSpace(
            la.block_diag(g.A, h.A), B, C, np.array([[0, 0.1, 1, 0], [0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
        )
        s = 1j * np.geomspace(1e-2, 1e9, 5000)
        reached = np.max(np.abs(corner / (s + corner) * (1 - (s / a + 1) ** -order)))
        assert reached < 0.1
        assert pointwise_bound(posed_plant(P, 2, 2)) <= reached
        assert hinfsyn(P, 2, 2).gamma_optimal_bounds[0] <= reached


class TestSingularProblems:
    def test_both_rank_deficient(self, rng):
        P = random_plant(rng, 3, 2, 2, 1, 1, direct=0.0)
        P = StateSpace(P.A, P.B, P.C, np.zeros((3, 3)))
        result = hinfsyn(P, 1, 1)
        assert result.status is Status.REGULARISED
        assert "D12" in result.notes[0] and "D21" in result.notes[0]
        assert lmi_gamma(P, 1, 1).lower * (1 - 1e-4) <= result.gamma
        assert hinf_norm(lft_lower(P, result.K)).gain == pytest.approx(result.gamma)

    def test_zero_on_the_imaginary_axis(self):
        """An undamped mode that the cost does not see but the input moves."""
        A = la.block_diag([[0.0, 1.0], [-4.0, 0.0]], [[-1.0]])
        P = StateSpace(
            A, [[0, 0, 0], [1, 0, 1], [1, 0, 1]], [[0, 0, 1], [0, 0, 0], [1, 0, 1]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]]
        )
        result = hinfsyn(P, 1, 1)
        assert result.status is Status.REGULARISED and "imaginary axis" in result.notes[0]
        assert result.abscissa < 0
        assert hinf_suboptimal(P, 1, 1, 1.2).gamma < 1.2

    def test_fewer_outputs_than_controls(self, rng):
        P = random_plant(rng, 3, 3, 1, 2, 1)
        result = hinfsyn(P, 1, 2)
        assert result.status is Status.REGULARISED
        assert lmi_gamma(P, 1, 2).lower * (1 - 1e-4) <= result.gamma


class TestRefusals:
    def test_mode_that_no_input_moves_is_named(self):
        stuck = tf([1.0], [1, 0, (2 * np.pi * 2.07) ** 2], ["floor"], ["z1"])
        P = connect(
            [
                stuck,
                tf([1.0], [1, 1], ["force"], ["x"]),
                summing_junction("y", ["x", "z1"]),
                gain([[1.0]], ["force"], ["z2"]),
            ],
            ["floor", "force"],
            ["z1", "z2", "y"],
        )
        with pytest.raises(ComputationError, match=r"mode at 2\.07 Hz is not moved by any of the inputs \['force'\]"):
            hinfsyn(P, 1, 1)

    def test_mode_that_no_measurement_sees_is_named(self):
        unseen = tf([1.0], [1, -0.5], ["force"], ["z1"])
        P = connect(
            [unseen, tf([1.0], [1, 1], ["force"], ["x"]), summing_junction("y", ["x", "n"])],
            ["n", "force"],
            ["z1", "y"],
        )
        with pytest.raises(ComputationError, match=r"not seen by any of the measurements \['y'\]"):
            hinfsyn(P, 1, 1)

    @pytest.mark.parametrize(
        ("nmeas", "ncon", "field"),
        [(0, 1, "nmeas"), (1, 0, "ncon"), (3, 1, "nmeas"), (1, 7, "ncon"), (1.5, 1, "nmeas"), (True, 1, "nmeas")],
    )
    def test_wrong_partition(self, rng, nmeas, ncon, field):
        with pytest.raises(InputError, match=field):
            hinfsyn(random_plant(rng, 2, 2, 2, 1, 1), nmeas, ncon)

    @pytest.mark.parametrize(
        "options",
        [
            {"backoff": -1},
            {"tolerance": 0},
            {"method": "magic"},
            {"gamma_hint": np.nan},
            {"far_poles": "slow"},
            {"sample_rate_Hz": -5.0},
        ],
    )
    def test_wrong_options(self, rng, options):
        with pytest.raises(InputError, match=next(iter(options))):
            hinfsyn(random_plant(rng, 2, 2, 2, 1, 1), 1, 1, **options)

    def test_not_a_plant(self):
        with pytest.raises(InputError, match="P = 'ndarray'"):
            hinfsyn(np.eye(3), 1, 1)

    def test_gamma_out_of_reach_says_which_condition_fails(self):
        P = StateSpace([[1.0]], [[1, 0, 1]], [[1], [0], [1]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
        with pytest.raises(ComputationError, match="rho"):
            hinf_suboptimal(P, 1, 1, 2.0)


class TestUse:
    def test_suboptimal_keeps_its_gamma(self, rng):
        P = random_plant(rng, 5, 3, 3, 2, 2)
        optimum = hinfsyn(P, 2, 2).gamma_optimal_bounds[1]
        result = hinf_suboptimal(P, 2, 2, 1.2 * optimum)
        assert result.gamma < 1.2 * optimum and result.abscissa < 0

    def test_python_control_plant(self, rng):
        P = random_plant(rng, 3, 2, 2, 1, 1)
        assert hinfsyn(P.to_control(), 1, 1).gamma == pytest.approx(hinfsyn(P, 1, 1).gamma, rel=1e-9)

    def test_hint_changes_nothing_but_the_time(self, rng):
        P = random_plant(rng, 4, 3, 3, 1, 1)
        plain = hinfsyn(P, 1, 1)
        for hint in (1e-3, 0.5, 0.999, 1.02, 50.0):
            hinted = hinfsyn(P, 1, 1, gamma_hint=hint * plain.gamma_optimal_bounds[1])
            assert hinted.gamma_optimal_bounds[1] == pytest.approx(plain.gamma_optimal_bounds[1], rel=1.5e-3)

    def test_units_of_states_and_signals_do_not_matter(self, rng):
        P = random_plant(rng, 5, 2, 2, 1, 1)
        scaled = P.similar(np.diag(10.0 ** rng.uniform(-5, 5, 5))).scaled([1, 1, 1e6], [1, 1, 1e-4])
        assert hinfsyn(scaled, 1, 1).gamma_optimal_bounds[1] == pytest.approx(
            hinfsyn(P, 1, 1).gamma_optimal_bounds[1], rel=2e-3
        )

    @pytest.mark.parametrize("w_u", [1.0, 1e-3, 1e-6])
    def test_fourteen_decades_between_the_poles(self, w_u):
        """A nearly integrating weight and a very fast actuator change the optimum by little, and none is called
        singular: the same problem with poles from 1e-3 to 1e5 rad/s and from 1e-7 to 1e7 rad/s."""
        optima = []
        for slow, fast in ((1e-3, 1e5), (1e-7, 1e7)):
            P = connect(
                [
                    tf(*DISTURBANCE_PROCESS, ["force"], ["g"]),
                    tf([fast], [1, fast], ["u"], ["force"]),
                    summing_junction("e", ["r", "-g"]),
                    tf([1 / 1.5, 10], [1, slow], ["e"], ["z1"]),
                    gain([[w_u]], ["u"], ["z2"]),
                    gain([[1.0]], ["e"], ["y"]),
                ],
                ["r", "u"],
                ["z1", "z2", "y"],
            )
            result = hinfsyn(P, 1, 1)
            assert result.status is Status.OPTIMAL
            check(P, 1, 1, result)
            optima.append(result.gamma_optimal_bounds[1])
        assert optima[0] == pytest.approx(optima[1], rel=0.01)

    def test_sampled_plant_gets_a_sampled_controller(self):
        P = mixed_sensitivity(([1 / 1.5, 10.0], [1, 1e-3]))
        sampled = discretise(P, 1e-3, "tustin")
        result = hinfsyn(sampled, 1, 1)
        closed = lft_lower(sampled, result.K)
        assert result.K.dt == sampled.dt and np.max(np.abs(closed.poles())) < 1
        # The bilinear map keeps the H-infinity norm, so the optimum is the continuous one.
        assert result.gamma_optimal_bounds[1] == pytest.approx(hinfsyn(P, 1, 1).gamma_optimal_bounds[1], rel=2e-3)
        on_circle = closed.frequency_response(np.geomspace(1e-3, np.pi / 1e-3, 2000))
        assert np.max(la.svd(on_circle, compute_uv=False)) <= result.gamma * (1 + 1e-6)

    def test_fastest_pole_against_the_sample_rate(self):
        P = mixed_sensitivity(([1 / 1.5, 10.0], [1, 1e-3]))
        result = hinfsyn(P, 1, 1, sample_rate_Hz=10.0)
        assert result.fastest_pole == pytest.approx(np.max(np.abs(result.K.poles())))
        share = float(re.search(r"is (\S+) times half the sample rate: too fast", result.notes[-1])[1])
        assert share == pytest.approx(result.fastest_pole / (2 * np.pi * 10.0 / 2), rel=0.05)
        assert "slow enough" in hinfsyn(P, 1, 1, sample_rate_Hz=20 * result.fastest_pole).notes[-1]

    @pytest.mark.parametrize("a", [-1.0, 1.0, 3.0])
    def test_matrix_inequalities_that_hold_are_confirmed(self, a):
        """The plant below: no gamma under its optimum is called an upper bound, and eigenvalues confirm that one."""
        found, exact = lmi_gamma(StateSpace(*self.self_dual(a)), 1, 1), a + np.sqrt(a * a + 2)
        assert found.lower <= exact * (1 + 1e-9) and exact <= found.upper < exact * (1 + 1e-5)
        assert found.violation <= 0

    @staticmethod
    def self_dual(a):
        return ([[a]], [[1.0, 0.0, 1.0]], [[1.0], [0.0], [1.0]], [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

    @pytest.mark.parametrize("a", [-1.0, 1.0, 3.0])
    def test_only_what_rounding_cannot_undo_is_forbidden(self, a):
        """x' = a x + w1 + u, y = x + w2, z = (x, u): its own dual, so that X = Y = gamma at a + sqrt(a^2 + 2)."""
        plant = Plant.of(StateSpace(*self.self_dual(a)), 1, 1)
        low, high = 0.1, 100.0
        while low < (middle := (low + high) / 2) < high:
            low, high = (low, middle) if gamma_test(plant, middle).feasible else (middle, high)
        assert high == pytest.approx(a + np.sqrt(a * a + 2), rel=1e-14)
        assert gamma_test(plant, low).forbidden == 0.0
        clear = low * (1 - 1e-12)
        assert gamma_test(plant, clear).forbidden == clear

    @pytest.mark.parametrize("hidden", ["unreached", "unseen"])
    def test_hidden_stable_states_do_not_matter(self, rng, hidden):
        """States that no input reaches, or no output sees, with the plant's own lightly damped poles: the brackets
        of the plant with and without them are of one and the same optimum."""
        plain = random_plant(rng, 4, 3, 3, 1, 1)
        A = la.block_diag([[0, 1], [-1, -2e-5]], [[0, 30], [-30, -2e-3]])
        plain = StateSpace(A, plain.B, plain.C, plain.D)
        links = rng.standard_normal((4, 4))
        both = np.block([[A, links], [0 * A, A]]) if hidden == "unreached" else np.block([[A, 0 * A], [links, A]])
        zeros = np.zeros((4, 4))
        B = np.vstack([plain.B, zeros if hidden == "unreached" else rng.standard_normal((4, 4))])
        C = np.hstack([plain.C, zeros if hidden == "unseen" else rng.standard_normal((4, 4))])
        T = la.qr(rng.standard_normal((8, 8)))[0]
        P = StateSpace(both, B, C, plain.D).similar(T)
        found, expected = hinfsyn(P, 1, 1), hinfsyn(plain, 1, 1)
        np.testing.assert_allclose(found.gamma_optimal_bounds, expected.gamma_optimal_bounds, rtol=2e-3)
        assert found.status is expected.status is Status.OPTIMAL and found.K.nstates <= 4
        check(P, 1, 1, found)

    def test_pole_that_comes_from_the_formulas_is_left_out(self):
        """The central controller's fourth pole grows as 1 / backoff (437 rad/s at 1 %, 3900 at 0.1 %; the plant's
        fastest is 20), and the loop of 1 % does not need it: the others are below 40."""
        P = mixed_sensitivity(([1 / 1.5, 10.0], [1, 1e-3]))
        result = hinfsyn(P, 1, 1, far_poles="gain")
        assert hinfsyn(P, 1, 1).fastest_pole > 400
        assert result.K.nstates == 3 and result.fastest_pole < 40 and "replaced by their gain" in result.notes[0]
        check(P, 1, 1, result)
        assert result.fastest_pole == pytest.approx(np.max(np.abs(result.K.poles())), rel=1e-6)
        # A controller whose own poles are no faster than that of the plant is the central one.
        slow = hinfsyn(P, 1, 1, backoff=0.2, far_poles="gain")
        assert slow.K.nstates == 4 and not slow.notes
        check(P, 1, 1, slow, 0.2)

    def test_two_plants_side_by_side_have_the_larger_optimum(self, rng):
        a, b = (random_plant(rng, 2, 2, 2, 1, 1) for _ in range(2))
        both = append(
            a.renamed(["w1", "w2", "u1"], ["z1", "z2", "y1"]), b.renamed(["w3", "w4", "u2"], ["z3", "z4", "y2"])
        )
        both = both.select(["z1", "z2", "z3", "z4", "y1", "y2"], ["w1", "w2", "w3", "w4", "u1", "u2"])
        larger = max(hinfsyn(one, 1, 1).gamma_optimal_bounds[1] for one in (a, b))
        assert hinfsyn(both, 2, 2).gamma_optimal_bounds[1] == pytest.approx(larger, rel=2e-3)


def scalar_plant(sensor=1.0, pole=0.0):
    """x' = pole x + w + u, z = (x, u), y = sensor x + n; the optimum is sqrt(2) for sensor 1 and pole 0."""
    return StateSpace([[pole]], [[1, 0, 1]], [[1], [0], [sensor]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]])


@pytest.mark.parametrize("hint", [1e-6, 0.0014, 0.7, 1e6])
def test_a_wrong_hint_changes_no_optimum(hint):
    low, high = hinfsyn(scalar_plant(), 1, 1, gamma_hint=hint).gamma_optimal_bounds
    assert low <= np.sqrt(2) <= high < 1.002 * np.sqrt(2)


def test_an_optimum_far_above_the_open_loop_gain_is_found():
    """A sensor of gain 1e-6 on an unstable mode: u must be about 2e6 n."""
    result = hinfsyn(scalar_plant(1e-6, 1.0), 1, 1)
    assert result.status is Status.OPTIMAL and 1e6 < result.gamma < 4e6


def test_matrices_of_the_matrix_inequalities_are_their_certificate():
    """[R I; I S] >= 0 for the matrices returned; an optimum that is not certified is reported."""
    optimum = lmi_gamma(scalar_plant(), 1, 1)
    coupling = np.block([[optimum.R, np.eye(1)], [np.eye(1), optimum.S]])
    assert la.eigvalsh(coupling)[0] >= -1e-12 * la.norm(coupling)
    assert (UNCERTIFIED in optimum.status) == (optimum.violation > 0)
    plant = Plant.of(scalar_plant(), 1, 1)
    upper, violation, R, S = certified(plant, np.eye(1), 0.5 * np.eye(1), 100.0)
    assert la.eigvalsh(np.block([[R, np.eye(1)], [np.eye(1), S]]))[0] >= 0
    assert upper == 100.0 and violation <= 0
