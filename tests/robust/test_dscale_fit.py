"""D-scale fit: known rational functions, brute-force optimisation, positivity and factorisation off the grid."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scipy.optimize as so
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import find_peaks

from avis_ctrl.lti import StateSpace, append, gain
from avis_ctrl.robust.dscale_fit import fit_magnitude, stable_roots
from avis_ctrl.robust.dscale_matrix import fit_hermitian
from avis_ctrl.robust.dstep import SETTINGS, PointwiseScalings, d_steps, tightened
from avis_ctrl.robust.scalings import MatrixScaling, ScalarScaling, Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar

EIGHT_DECADES = np.logspace(-4, 4, 90)


def rational(rng: np.random.Generator, order: int) -> ScalarScaling:
    """A random d(s) with roots spread over six decades, one pair of zeros lightly damped."""
    zeros, poles = (-(10.0 ** rng.uniform(-3, 3, order)).astype(complex) for _ in range(2))
    if order >= 2:
        zeros[0] = 10 ** rng.uniform(-2, 2) * np.exp(1j * np.deg2rad(100))
        zeros[1] = np.conj(zeros[0])
    return ScalarScaling.from_roots(10 ** rng.uniform(-1, 1), zeros, poles)


def poly_magnitude(d: ScalarScaling, omega: np.ndarray) -> np.ndarray:
    """|d(j omega)| from its roots, factor by factor, without the package's formulas."""
    s = 1j * omega[:, None]
    return np.exp(d.theta[0]) * np.prod(np.abs(s - d.zeros), axis=1) / np.prod(np.abs(s - d.poles), axis=1)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_known_rational_function_is_recovered_at_its_order(rng, order):
    d = rational(rng, order)
    fit = fit_magnitude(EIGHT_DECADES, poly_magnitude(d, EIGHT_DECADES), order, tolerance=1e-4)
    between = np.sqrt(EIGHT_DECADES[1:] * EIGHT_DECADES[:-1])
    ratio = np.abs(StateSpace(*fit.scaling.matrices).frequency_response(between)[:, 0, 0]) / poly_magnitude(d, between)
    assert np.max(np.abs(np.log(ratio))) < 1e-3


@pytest.mark.parametrize("order", [1, 2, 3])
def test_no_better_fit_is_found_by_brute_force(rng, order):
    """Minimax over the parameters by SLSQP from many starts never beats the semidefinite optimum."""
    omega = np.logspace(-2, 2, 40)
    target = np.exp(np.sin(np.log(omega)) + 0.4 * np.cos(2.3 * np.log(omega)))
    weight = rng.uniform(0.3, 1.0, omega.size)
    fit = fit_magnitude(omega, target, order, weight, tolerance=1e-4)

    def misfit(theta):
        return weight * (ScalarScaling(theta).log_magnitude(omega) - np.log(target))

    def refine(theta):
        constraint = {"type": "ineq", "fun": lambda x: np.r_[x[-1] - misfit(x[:-1]), x[-1] + misfit(x[:-1])]}
        start = np.r_[theta, np.max(np.abs(misfit(theta)))]
        found = so.minimize(lambda x: x[-1], start, method="SLSQP", constraints=constraint, options={"maxiter": 100})
        return np.max(np.abs(misfit(found.x[:-1])))

    starts = [fit.scaling.theta, *(rng.normal(0, 1.5, 1 + 2 * order) for _ in range(6))]
    best = min(refine(start) for start in starts)
    assert best >= fit.error_bound - 1e-6
    assert fit.error <= best + 2e-4


def test_optimal_error_alternates_in_sign_as_chebyshev_theory_asks():
    """p/q of degrees (n, n) in one variable has 2 n + 1 degrees of freedom: 2 n + 2 alternations."""
    omega, n = np.logspace(-2, 2, 200), 2
    target = np.exp(np.arctan(np.log(omega)) + 0.1 * np.sin(3 * np.log(omega)))
    fit = fit_magnitude(omega, target, n, tolerance=1e-5)
    error = fit.scaling.log_magnitude(omega) - np.log(target)
    extreme = error[np.abs(error) > 0.97 * fit.error]
    assert np.sum(np.diff(np.sign(extreme)) != 0) + 1 >= 2 * n + 2


def test_higher_order_never_fits_worse():
    target = np.exp(np.tanh(np.log(EIGHT_DECADES)) + 0.3 * np.sin(np.log(EIGHT_DECADES)))
    errors = [fit_magnitude(EIGHT_DECADES, target, n).error for n in range(6)]
    assert all(after <= before + 1e-3 for before, after in pairwise(errors))
    assert errors[5] < errors[0] / 2


def test_constant_fit_is_the_weighted_chebyshev_centre():
    fit = fit_magnitude(np.array([1.0, 2.0, 3.0]), np.exp([0.0, 1.0, 3.0]), 0, np.array([1.0, 1.0, 0.5]))
    # errors c and (3 - c)/2 balance at c = 1
    assert fit.scaling.theta[0] == pytest.approx(1.0)
    assert fit.error == pytest.approx(1.0)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-2.5, 2.5), st.floats(0.3, 2)), min_size=1, max_size=4),
    st.integers(1, 4),
)
def test_every_fit_is_stable_and_minimum_phase(bumps, order):
    """Random smooth magnitudes: roots in the open left half plane, realised response equal to the roots'."""
    x = np.log10(EIGHT_DECADES)
    target = np.exp(sum(height * np.exp(-(((x - centre) / width) ** 2)) for centre, height, width in bumps))
    fit = fit_magnitude(EIGHT_DECADES, target, order)
    system = StateSpace(*fit.scaling.matrices)
    assert np.all(system.poles().real < 0)
    zeros = np.linalg.eigvals(system.A - system.B @ system.C / system.D[0, 0])
    assert np.all(zeros.real < 0)
    dense = np.logspace(-6, 6, 400)
    realised = np.abs(system.frequency_response(dense)[:, 0, 0])
    assert np.max(np.abs(np.log(realised / poly_magnitude(fit.scaling, dense)))) < 1e-5
    assert fit.error == pytest.approx(np.max(np.abs(fit.scaling.log_magnitude(EIGHT_DECADES) - np.log(target))))


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_spectral_factor_of_a_sum_of_squares(half_order, seed):
    """p(y) = s0(y)^2 + y s1(y)^2 is |f(j omega)|^2 of the factor, at frequencies of no grid."""
    rng = np.random.default_rng(seed)
    s0, s1 = rng.normal(size=half_order + 1), rng.normal(size=half_order)
    p = np.polynomial.polynomial.polyadd(np.convolve(s0, s0), np.r_[0.0, np.convolve(s1, s1)])
    roots = stable_roots(p)
    assert np.all(roots.real < 0)
    omega = rng.uniform(0, 5, 50)
    square = p[-1] * np.prod(np.abs(1j * omega[:, None] - roots) ** 2, axis=1)
    assert np.allclose(square, np.polynomial.polynomial.polyval(omega**2, p), rtol=1e-5, atol=1e-6 * p[0])


@pytest.mark.parametrize(("n", "degree"), [(2, 1), (2, 2), (3, 1)])
def test_matrix_scaling_recovers_a_known_one(rng, n, degree):
    """X = D^H D of a known D: recovered to 1 % with stable poles and zeros, between the points too."""
    omega = np.logspace(-2, 3, 40)
    poles = -(10.0 ** rng.uniform(-1, 2, degree))
    A, B = np.kron(np.diag(poles), np.eye(n)), np.kron(np.sqrt(-poles)[:, None], np.eye(n))
    C = 0.8 * rng.standard_normal((n, n * degree)) * np.repeat(np.sqrt(-poles), n)
    truth = StateSpace(A, B, C, np.eye(n) + 0.2 * rng.standard_normal((n, n)))

    def square(system, at):
        F = system.frequency_response(at)
        return np.conj(np.swapaxes(F, 1, 2)) @ F

    fit = fit_hermitian(omega, square(truth, omega), degree, tolerance=2e-3)
    assert fit.error < 5e-3
    D = fit.scaling.system
    assert D.nstates == n * degree
    assert np.all(D.poles().real < 0)
    assert np.all(fit.scaling.inverse().system.poles().real < 0)
    between = np.sqrt(omega[1:] * omega[:-1])
    ratio = np.linalg.eigvals(np.linalg.solve(square(truth, between), square(D, between)))
    assert np.max(np.abs(np.log(np.abs(ratio)))) < 2e-2


def test_one_by_one_matrix_fit_agrees_with_the_scalar_fit():
    omega = np.logspace(-2, 2, 40)
    target = np.exp(np.tanh(np.log(omega)) + 0.2 * np.sin(np.log(omega)))
    scalar = fit_magnitude(omega, target, 2, tolerance=1e-4)
    matrix = fit_hermitian(omega, (target**2)[:, None, None].astype(complex), 2, tolerance=1e-4)
    assert matrix.error == pytest.approx(scalar.error, abs=3e-4)


def test_scaled_plant_is_the_product_of_its_parts(rng):
    """scale(P) against the frequency responses of D, P and D^-1, for scalar, full and repeated blocks."""
    structure = BlockStructure.of([ComplexScalar(2), ComplexFull(1, 2)]).with_performance(2, 1)
    D = MatrixScaling(
        StateSpace(-np.eye(2), np.eye(2), 0.3 * np.eye(2), np.array([[1.0, 0.4], [0.0, 0.7]])), rational(rng, 2)
    )
    scalings = Scalings(structure, (D, rational(rng, 3), ScalarScaling.constant(1.0)))
    P = StateSpace(
        -np.diag(rng.uniform(1, 5, 4)), rng.normal(size=(4, 7)), rng.normal(size=(6, 4)), rng.normal(size=(6, 7))
    )
    omega = np.logspace(-2, 2, 9)
    left, right = scalings.left().frequency_response(omega), scalings.right_inverse().frequency_response(omega)
    zeros, poles = (np.polyval(np.poly(roots), 1j * omega) for roots in (D.factor.zeros, D.factor.poles))
    own = (np.exp(D.factor.theta[0]) * zeros / poles)[:, None, None] * D.system.frequency_response(omega)
    assert D.order == 2 + 2 * 2 and np.allclose(left[:, :2, :2], own)
    assert np.allclose(own @ right[:, :2, :2], np.eye(2))
    assert np.allclose(np.linalg.svd(scalings.response(omega)[0])[1], np.linalg.svd(left)[1])
    F = P.frequency_response(omega)
    expected = F.copy()
    expected[:, :5] = left @ expected[:, :5]
    expected[:, :, :5] = expected[:, :, :5] @ right
    assert np.allclose(scalings.scale(P).frequency_response(omega), expected, atol=1e-9)
    assert scalings.scale(P).nstates == P.nstates + scalings.added_states
    again = Scalings.from_dicts(structure, scalings.as_dicts())
    assert np.allclose(again.scale(P).frequency_response(omega), expected, atol=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_roots_beyond_the_band_move_to_its_edge_and_leave_the_magnitude(order):
    """Zeros fast and poles slow, and the other way round: d is known far inside, where each is a constant or a
    slope."""
    fast, slow = -(10.0 ** np.arange(5.0, 5.0 + order)), -(10.0 ** -np.arange(5.0, 5.0 + order))
    inside = np.geomspace(0.1, 10.0, 7)
    for zeros, poles in ((fast, slow), (slow, fast), (fast, -np.ones(order)), (-np.ones(order), fast)):
        d = ScalarScaling.from_roots(2.0, zeros, poles)
        moved = d.within((1e-4, 1e4))
        sizes = np.abs(np.concatenate([moved.zeros, moved.poles]))
        assert np.all((sizes > 0.999e-4 / 100) & (sizes < 1.001e4 * 100))
        assert np.allclose(poly_magnitude(moved, inside) / poly_magnitude(d, inside), 1.0, rtol=0.1)


def test_slopes_of_the_magnitude_are_its_derivatives(rng):
    d = rational(rng, 5)
    h = 1e-6
    numeric = np.stack(
        [
            (
                ScalarScaling(d.theta + h * e).log_magnitude(EIGHT_DECADES)
                - ScalarScaling(d.theta - h * e).log_magnitude(EIGHT_DECADES)
            )
            / (2 * h)
            for e in np.eye(d.theta.size)
        ],
        axis=1,
    )
    assert np.max(np.abs(d.jacobian(EIGHT_DECADES) - numeric)) < 1e-6


@pytest.fixture
def added(monkeypatch) -> list[np.ndarray]:
    """Frequencies that the check between the grid's points sends back into the grid, one array a round."""
    rounds, extended = [], PointwiseScalings.extended

    def watched(points, omega, M):
        rounds.append(np.sort(omega))
        return extended(points, omega, M)

    monkeypatch.setattr(PointwiseScalings, "extended", watched)
    return rounds


def test_the_four_highest_peaks_between_the_points_become_points(added):
    """All entries of N are alike, so that d = 1 is best everywhere and sigma is the modes' own."""
    omega, zeta = np.array([0.2, 0.7, 2.0, 6.0, 20.0, 70.0]), 0.01
    A = np.kron(np.diag(omega), [[0.0, 1.0], [-1.0, -2 * zeta]])
    B = np.kron(omega[:, None], [[0.0, 0.0], [1.0, 1.0]])
    C = np.kron(2 * zeta * np.array([[1.5, 1.4, 1.3, 1.2, 1.1, 0.5]]), [[1.0, 0.0], [1.0, 0.0]])
    N = StateSpace(A, B, C, np.full((2, 2), 0.1))
    structure = BlockStructure.of([ComplexFull(1, 1)]).with_performance(1, 1)
    coarse, dense = np.geomspace(0.01, 1000, 16), np.geomspace(0.01, 1000, SETTINGS.checked)
    step = next(
        d_steps(PointwiseScalings.of(coarse, N.frequency_response(coarse), structure), N, Scalings.identity(structure))
    )
    sigma = np.linalg.norm(N.frequency_response(dense), ord=2, axis=(1, 2))
    peaks = find_peaks(sigma)[0]
    highest = peaks[np.argsort(sigma[peaks])[-4:]]
    assert np.allclose(added[0], dense[np.sort(highest)])
    assert step.peak == pytest.approx(np.max(sigma))


def test_a_resonance_of_the_scaling_itself_becomes_one_point(added):
    """A constant N and d(s) with a resonance that the grid does not see; its two conjugate roots are one frequency."""
    structure, omega = BlockStructure.of([ComplexFull(1, 1)]).with_performance(1, 1), np.array([1e-3, 1e-2, 1e3, 1e4])
    roots = [3.0 * np.exp(1j * sign * np.arccos(-zeta)) for zeta in (1.0, 0.05) for sign in (1, -1)]
    N, d = gain(np.full((2, 2), 0.5)), ScalarScaling.from_roots(1.0, roots[:2], roots[2:])
    start = Scalings(structure, (d, ScalarScaling.constant(1.0)))
    step = tightened(PointwiseScalings.of(omega, N.frequency_response(omega), structure), N, start, 0.01, 10)
    assert added[0] == pytest.approx([3.0])
    assert step.peak == pytest.approx(1.0)


def test_a_repeated_block_is_fitted_where_its_misfit_costs_most():
    """Two loops of products 1, of which the first needs D = diag(1, d) over two decades and the second d over one.

    At constant scalings the output and input directions of the first lie wholly within its block.
    """

    def loop(ratio):
        """[0 t; 1/t 0] with |t| from `ratio` at low frequency to 1/ratio at high."""
        direct, step = np.array([[0.0, 1 / ratio], [ratio, 0.0]]), ratio - 1 / ratio
        return StateSpace(
            -np.diag([1 / ratio, ratio]),
            np.array([[0.0, 1.0], [1.0, 0.0]]),
            np.diag([step / ratio, -step * ratio]),
            direct,
        )

    pair = append(loop(10.0).renamed(["a", "b"], ["c", "d"]), loop(3.0).renamed(["e", "f"], ["g", "h"]))
    N = StateSpace(pair.A, pair.B, pair.C, pair.D + 0.05)
    structure = BlockStructure.of([ComplexScalar(2), ComplexFull(1, 1)]).with_performance(1, 1)
    omega = np.geomspace(1e-3, 1e3, 40)
    *_, step = d_steps(
        PointwiseScalings.of(omega, N.frequency_response(omega), structure),
        N,
        Scalings.identity(structure),
        allowed_cost=0.05,
    )
    assert step.cost < 0.05 and min(step.scalings.orders[:2]) > 0


def constants(seed, block, away):
    """Two blocks and their constant scalings of least peak, (peak, log d) by Nelder and Mead; refined from `away`."""
    rng = np.random.default_rng(seed)
    structure = BlockStructure.of([block, ComplexFull(1, 1)]).with_performance(1, 1)
    n = structure.n_w
    N = StateSpace(
        -np.diag(10.0 ** rng.uniform(-1, 1, 4)),
        rng.normal(size=(4, n)),
        rng.normal(size=(n, 4)),
        0.1 * rng.normal(size=(n, n)),
    )
    omega = np.geomspace(1e-2, 1e2, 30)
    M = N.frequency_response(omega)

    def peak(log_d):
        d = np.repeat(np.exp([*log_d, 0.0]), [one.rows for one in structure.blocks])
        return np.max(np.linalg.norm(d[:, None] * M / d, ord=2, axis=(1, 2)))

    best = min((so.minimize(peak, rng.normal(size=2), method="Nelder-Mead") for _ in range(3)), key=lambda x: x.fun)
    start = Scalings.identity(structure)
    for k in range(2):
        start = start.replace(k, start.parts[k].with_scalar(ScalarScaling.constant(np.exp(best.x[k] + away))))
    step = tightened(PointwiseScalings.of(omega, M, structure), N, start, np.inf, 0)
    return peak([part.scalar.theta[0] for part in step.scalings.parts[:2]]), best.fun, peak(best.x + away)


@pytest.mark.parametrize("seed", range(4))
def test_constants_are_refined_to_the_best_there_are(seed):
    """From 0.3 off in log d; steps that promise 0.1 % or less are not taken."""
    found, best, start = constants(seed, ComplexFull(1, 1), 0.3)
    assert found < 1.003 * best < 0.99 * start


@pytest.mark.parametrize("seed", range(4))
def test_the_factor_of_a_repeated_block_is_refined_like_a_scalar_scaling(seed):
    """A full block of the same size takes the same d, as long as the matrix beside the factor is the identity."""
    found, best, start = constants(seed, ComplexScalar(2), 1.0)
    assert found == pytest.approx(constants(seed, ComplexFull(2, 2), 1.0)[0], rel=1e-6)
    assert (found - best) < 0.5 * (start - best)


def test_scalings_of_a_group_share_the_states_of_signals_that_depend_on_each_other():
    """Three blocks act by two forces and see two motions: d_k(s) = g_k d(s) adds twice two states an order, not six."""
    rng = np.random.default_rng(3)
    structure = BlockStructure.of([ComplexFull(1, 1)] * 3).with_performance(1, 1)
    B, C = rng.normal(size=(4, 2)) @ rng.normal(size=(2, 3)), rng.normal(size=(3, 2)) @ rng.normal(size=(2, 4))
    P = StateSpace(
        -np.diag([1.0, 2.0, 5.0, 9.0]),
        np.hstack([B, rng.normal(size=(4, 2))]),
        np.vstack([C, rng.normal(size=(2, 4))]),
        np.zeros((5, 5)),
    )
    d = ScalarScaling.from_roots(1.0, [-3.0], [-0.7])
    parts = tuple(ScalarScaling(np.r_[gain_, d.theta[1:]]) for gain_ in (0.3, -1.0, 2.0))
    apart = Scalings(structure, (*parts, ScalarScaling.constant(1.0)))
    grouped = replace(apart, groups=(0, 0, 0, 1))
    omega = np.geomspace(0.01, 100.0, 30)
    assert np.allclose(grouped.scale(P).frequency_response(omega), apart.scale(P).frequency_response(omega), rtol=1e-10)
    assert [one.scale(P).nstates - P.nstates for one in (apart, grouped)] == [6, 4]
    assert Scalings.from_dicts(structure, grouped.as_dicts()).groups == grouped.groups
