"""mu of matrices: printed values, cases provable by hand, an independent LMI, SLICOT, and the laws of mu."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.robust.mu import mu
from avis_ctrl.robust.mu_lower import is_singular
from avis_ctrl.robust.mu_upper import skewed_upper_bound, upper_bound
from avis_ctrl.robust.slycot_adapter import mu_upper_slicot
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar, RealScalar
from benchmarks.mu_by_bisection import mu_upper_by_bisection

C, R, F = ComplexScalar, RealScalar, ComplexFull
MIXED = {
    "three full": [F(2), F(2, 3), F(3, 1)],
    "complex": [C(), C(), C(), C()],
    "repeated": [C(3), F(2)],
    "real and full": [R(), R(), F(2)],
    "real repeated": [R(2), C(), F(2, 1)],
    "all real": [R(), R(2), R()],
}


def random_matrix(rng, blocks, count=None):
    structure = BlockStructure.of(blocks)
    shape = (structure.n_z, structure.n_w) if count is None else (count, structure.n_z, structure.n_w)
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def assert_bounds_proved(M, blocks, found):
    """What MuBounds promises, recomputed here from its own fields."""
    structure = BlockStructure.of(blocks)
    X_z, X_w = found.D @ found.D, found.D_w @ found.D_w
    GM = found.G @ M
    F_ = found.upper**2 * X_w - M.conj().T @ X_z @ M - 1j * (GM - GM.conj().T)
    assert np.linalg.eigvalsh(F_)[0] > -1e-7 * np.linalg.norm(found.upper**2 * X_w + M.conj().T @ X_z @ M, 2)
    # The scalings commute with every Delta of the structure.
    delta = structure.random(np.random.default_rng(0))
    assert np.allclose(X_w @ delta, delta @ X_z, atol=1e-9 * np.linalg.norm(X_w))
    if found.delta is not None:
        assert structure.contains(found.delta)
        norms = [np.linalg.norm(found.delta[w, z], 2) for _, w, z in structure.slices()]
        assert max(norms) == pytest.approx(1 / found.lower, rel=1e-9)
        A = np.eye(structure.n_z) - M @ found.delta
        assert np.linalg.svd(A, compute_uv=False)[-1] < 1e-8 * (1 + np.linalg.norm(M @ found.delta, 2))


# -- printed values -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("blocks, printed", [([F(2)], 3.162), ([C(), C()], 3.000)])
def test_skogestad_postlethwaite_example_8_5(blocks, printed):
    """Multivariable Feedback Control (1996), example 8.5: M = [2 2; -1 -1].

    Both are exact to the printed digits by hand: sqrt(10), the norm of a matrix of rank one, and 2 + 1, its diagonal.
    """
    found = mu([[2, 2], [-1, -1]], blocks)
    assert found.upper == pytest.approx(printed, abs=5e-4)
    assert found.lower == pytest.approx(printed, abs=5e-4)


def test_slicot_ab13md_printed_example():
    """SLICOT library, AB13MD program results: bound 0.4174753408D+02 (two real scalars, a full block, two complex)."""
    half = np.array(
        [
            [-1 + 6j, 2 - 3j, 3 + 8j, 3 + 8j, -5 - 9j, -6 + 2j],
            [4 + 2j, -2 + 5j, -6 - 7j, -4 + 11j, 8 - 7j, 12 - 1j],
            [5 - 4j, -4 - 8j, 1 - 3j, -6 + 14j, 2 - 5j, 4 + 16j],
        ]
    )
    M, blocks = np.vstack([half, half]), [R(), R(), F(2), C(), C()]
    found = mu(M, blocks)
    assert found.upper == pytest.approx(41.74753408, rel=2e-6)
    assert_bounds_proved(M, blocks, found)


def four_block_counterexample():
    gamma, beta = 3 + np.sqrt(3), np.sqrt(3) - 1
    a, b, c = np.sqrt(2 / gamma), 1 / np.sqrt(gamma), 1 / np.sqrt(gamma)
    d, f = -np.sqrt(beta / gamma), (1 + 1j) * np.sqrt(1 / (gamma * beta))
    U = np.array([[a, 0], [b, b], [c, 1j * c], [d, f]])
    V = np.array([[0, a], [b, -b], [c, -1j * c], [-1j * f, -d]])
    return U @ V.conj().T


def test_four_scalars_upper_bound_one_and_mu_0_87():
    """Packard and Doyle (Automatica 29, 1993), the case of four blocks where the bound is not mu.

    As printed in the Xmath Robust Control Module manual (National Instruments 370760B-01, p. 109):
    upper bound 1, mu about 0.87, their power iteration 0.864.
    """
    M = four_block_counterexample()
    found = mu(M, [C()] * 4)
    assert found.upper == pytest.approx(1.0, abs=1e-6)
    assert 0.864 <= found.lower < 0.875
    assert_bounds_proved(M, [C()] * 4, found)


def test_one_scalar_skogestad_postlethwaite_8_74_8_75():
    """Eqs. (8.74), (8.75): mu = |M| for a complex delta; for a real one |M| if M is real, else 0."""
    assert mu([[1 + 2j]], [C()]).upper == pytest.approx(np.sqrt(5), rel=1e-6)
    real = mu([[-5.34]], [R()])
    assert (real.upper, real.lower) == (pytest.approx(5.34, rel=1e-6), pytest.approx(5.34, rel=1e-9))
    nothing = mu([[6.78j]], [R()])
    assert nothing.upper == pytest.approx(0.0, abs=1e-6) and nothing.lower == 0.0 and nothing.delta is None


# -- provable by hand ---------------------------------------------------------------------------------------


def test_rank_one_is_the_sum_of_magnitudes(rng):
    """M = a b^H with scalars: mu = sum |a_i b_i| (the phases of Delta align every term of b^H Delta a)."""
    a, b = random_matrix(rng, [C()] * 5, 2)[:, 0]
    found = mu(np.outer(a, b.conj()), [C()] * 5)
    assert found.upper == pytest.approx(np.sum(np.abs(a * b)), rel=1e-6)
    assert found.lower == pytest.approx(np.sum(np.abs(a * b)), rel=1e-6)


def test_rank_one_with_real_scalars_is_a_convex_problem_in_one_variable(rng):
    """M = a b^H, all real: 1 = sum c_i delta_i, c = conj(b) a; by duality 1/k = min over t of sum |Re c + t Im c|."""
    a, b = random_matrix(rng, [R()] * 4, 2)[:, 0]
    c = b.conj() * a
    exact = min(np.sum(np.abs(c.real - (ck.real / ck.imag) * c.imag)) for ck in c)
    found = mu(np.outer(a, b.conj()), [R()] * 4)
    assert found.lower == pytest.approx(exact, rel=1e-6)
    assert found.upper == pytest.approx(exact, rel=1e-4)


def test_repeated_complex_scalar_is_the_spectral_radius(rng):
    M = random_matrix(rng, [C(4)])
    found = mu(M, [C(4)])
    radius = np.max(np.abs(np.linalg.eigvals(M)))
    assert found.upper == pytest.approx(radius, rel=1e-5) and found.lower == pytest.approx(radius, rel=1e-9)


def test_repeated_real_scalar_is_the_largest_real_eigenvalue():
    M = np.diag([1.0, -2.5, 0.3]).astype(complex)
    M = np.block([[M, np.zeros((3, 2))], [np.zeros((2, 3)), np.array([[0, 7], [-7, 0]])]])
    T = np.random.default_rng(4).standard_normal((5, 5))
    found = mu(T @ M @ np.linalg.inv(T), [R(5)])
    assert found.lower == pytest.approx(2.5, rel=1e-8)
    assert found.upper == pytest.approx(2.5, rel=1e-4)


def test_full_block_is_the_largest_singular_value(rng):
    M = random_matrix(rng, [F(4, 3)])
    assert mu(M, [F(4, 3)]).lower == pytest.approx(np.linalg.norm(M, 2), rel=1e-9)


@pytest.mark.parametrize(
    "M, blocks, expected",
    [
        (np.zeros((3, 3)), [C(), R(), C()], 0.0),
        ([[0, 1], [0, 0]], [C(), C()], 0.0),
        ([[1, 1e3], [0, 0.5]], [C(), C()], 1.0),
        ([[1, 1e8], [1e-8, 1]], [C(), C()], 2.0),
        (1e-120 * np.ones((2, 2)), [C(), C()], 2e-120),
        (1e120 * np.ones((2, 2)), [C(), C()], 2e120),
        ([[0, 2, 0], [3, 0, 0], [0, 0, 0]], [C(), C(), C()], np.sqrt(6)),
    ],
)
def test_degenerate_matrices(M, blocks, expected):
    found = mu(M, blocks)
    assert found.upper == pytest.approx(expected, rel=2e-5, abs=1e-8 * np.linalg.norm(M))
    assert found.lower <= found.upper * (1 + 1e-12)
    assert (found.delta is None) == (found.lower == 0)


# -- other algorithms ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MIXED)
def test_upper_bound_agrees_with_lmi_bisection(name, rng):
    M = random_matrix(rng, MIXED[name])
    assert mu(M, MIXED[name]).upper == pytest.approx(mu_upper_by_bisection(M, MIXED[name]), rel=1e-3)


@pytest.mark.parametrize("blocks", [[C()] * 6, [R(), R(), C(), F(3)], [F(2), F(2), C()]])
def test_upper_bound_agrees_with_slicot(blocks, rng):
    M = random_matrix(rng, blocks, 5)
    assert mu(M, blocks).upper == pytest.approx([mu_upper_slicot(m, blocks) for m in M], rel=1e-5)


@pytest.mark.parametrize("blocks", [[C(), C(), C()], [F(2), F(3), F(1)], [F(2), F(2, 3), F(3, 1)], [C(), F(3)]])
def test_up_to_three_full_blocks_bounds_meet(blocks, rng):
    """Packard and Doyle (1993): mu equals its upper bound for up to three full complex blocks."""
    found = mu(random_matrix(rng, blocks, 200), blocks)
    assert np.all(found.lower >= (1 - 1e-3) * found.upper)


@pytest.mark.parametrize("name", MIXED)
def test_both_bounds_are_proved(name, rng):
    for M in random_matrix(rng, MIXED[name], 5):
        assert_bounds_proved(M, MIXED[name], mu(M, MIXED[name]))


def test_real_scalars_against_exhaustive_search(rng):
    """Two real scalars: det(I - M Delta) = 0 is two real equations, solved here by hand for every pair."""
    stack = random_matrix(rng, [R(), R()], 40)
    found = mu(stack, [R(), R()])
    met = 0
    for M, lower, upper in zip(stack, found.lower, found.upper, strict=True):
        # 1 - m11 x - m22 y + det x y = 0: eliminate y = (1 - m11 x)/(m22 - det x) and ask that it is real.
        m11, m22, det = M[0, 0], M[1, 1], np.linalg.det(M)
        numerator = np.polymul([-m11, 1], np.conj([-det, m22]))
        roots = np.roots(numerator.imag)
        x = roots[np.abs(roots.imag) < 1e-9].real
        y = ((1 - m11 * x) / (m22 - det * x)).real
        exact = 1 / np.min(np.maximum(np.abs(x), np.abs(y)), initial=np.inf)
        assert lower <= exact * (1 + 1e-7) and exact <= upper * (1 + 1e-6) + 1e-9
        met += exact > 0 and lower > 0.999 * exact
    assert met >= 12


def test_batch_equals_one_by_one(rng):
    blocks = MIXED["real and full"]
    M = random_matrix(rng, blocks, 4)
    assert mu(M, blocks).upper == pytest.approx([mu(m, blocks).upper for m in M], rel=1e-5)


# -- laws ---------------------------------------------------------------------------------------------------


def cases():
    return st.tuples(st.sampled_from(sorted(MIXED)), st.integers(0, 10_000))


def drawn(case):
    name, seed = case
    rng = np.random.default_rng(seed)
    return MIXED[name], random_matrix(rng, MIXED[name]), rng


@settings(max_examples=20, deadline=None)
@given(cases())
def test_between_structured_spectral_radius_and_largest_singular_value(case):
    blocks, M, rng = drawn(case)
    structure = BlockStructure.of(blocks)
    found = mu(M, blocks)
    assert found.lower <= found.upper * (1 + 1e-9) <= np.linalg.norm(M, 2) * (1 + 1e-6)
    if not any(block.kind == "real" for block in blocks):
        trial = np.max(np.abs(np.linalg.eigvals(M @ structure.random(rng))))
        assert trial <= found.upper * (1 + 1e-6)


@settings(max_examples=15, deadline=None)
@given(cases(), st.floats(0.01, 100), st.booleans())
def test_homogeneous(case, factor, negative):
    blocks, M, _ = drawn(case)
    factor = -factor if negative else factor
    assert mu(factor * M, blocks).upper == pytest.approx(abs(factor) * mu(M, blocks).upper, rel=1e-4, abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(cases())
def test_invariant_under_commuting_scalings(case):
    """Over 26 decades: mu does not depend on the units of the signals."""
    blocks, M, rng = drawn(case)
    structure = BlockStructure.of(blocks)
    d = np.exp(rng.uniform(-30, 30, len(structure.blocks)))
    d_z, d_w = np.repeat(d, [b.cols for b in blocks]), np.repeat(d, [b.rows for b in blocks])
    scaled = M * d_z[:, None] / d_w
    assert mu(scaled, blocks).upper == pytest.approx(mu(M, blocks).upper, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(("n", "most"), [(6, 0.101), (42, 1.1)])
@pytest.mark.parametrize("feedback", [0.0, 1e-16, 1e-150])
def test_a_chain_of_blocks_with_round_off_behind_it(n, most, feedback):
    """Couplings of one, forwards only: mu is that of the diagonal. The range of the scalings is limited, so that a long
    chain has a loose upper bound, but one below the norm."""
    M = np.diag(np.ones(n - 1), 1) + 0.1 * np.eye(n)
    M[1, 0] = feedback
    found = mu(M, [ComplexScalar()] * n)
    assert found.lower == pytest.approx(0.1, rel=1e-2)
    assert 0.1 <= found.upper < most


def test_stages_in_series_have_the_product_of_their_gains_as_worst_case():
    """Three gains of 0.3, each followed by a perturbation, without feedback; round-off must not spoil the bound."""
    M = np.array([[0, 0, 0, 1.0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]) * np.array([[0.3], [0.3], [0.3], [1.0]])
    M[0, 2] = 1e-17
    bound = skewed_upper_bound(M[None, None] + 0j, BlockStructure.of([ComplexScalar()] * 3 + [ComplexFull(1, 1)]))
    assert bound.beta[0] == pytest.approx(0.3**3, rel=1e-2)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_invariant_under_unitary_matrices_of_the_structure(seed):
    rng = np.random.default_rng(seed)
    blocks = [F(2), C(), C(2)]
    M = random_matrix(rng, blocks)
    Q = np.linalg.qr(random_matrix(rng, [F(2)]))[0]
    phase = np.exp(2j * np.pi * rng.uniform(size=2))
    U = np.block([[Q, np.zeros((2, 3))], [np.zeros((3, 2)), np.diag([phase[0], phase[1], phase[1]])]])
    value = mu(M, blocks).upper
    assert mu(M @ U, blocks).upper == pytest.approx(value, rel=1e-4)
    assert mu(U @ M, blocks).upper == pytest.approx(value, rel=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_order_of_blocks_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    M = random_matrix(rng, [R(), C(), F(2)])
    order = [2, 3, 0, 1]
    assert mu(M[np.ix_(order, order)], [F(2), R(), C()]).upper == pytest.approx(mu(M, [R(), C(), F(2)]).upper, rel=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_larger_sets_of_perturbations_have_larger_mu(seed):
    rng = np.random.default_rng(seed)
    M = random_matrix(rng, [C()] * 4)
    chain = [[R(4)], [C(4)], [C(2), C(2)], [C(), C(), C(2)], [C()] * 4, [F(2), C(), C()], [F(2), F(2)], [F(4)]]
    values = [mu(M, blocks).upper for blocks in chain]
    assert np.all(np.diff(values) > -1e-5 * values[-1])
    assert mu(M[:3, :3], [C()] * 3).upper <= values[4] * (1 + 1e-5)


def test_round_off_makes_no_matrix_singular():
    """I - M Delta with entries of 1e12 and a smallest singular value of 5e-7, below the round-off of M Delta."""
    structure, delta = BlockStructure.of([F(2)]), np.eye(2, dtype=complex)[None]
    differences = np.array([[[1e12, 1.0], [0.0, 5e-7]], [[1.0, 1.0], [0.0, 0.0]]])
    found = [bool(is_singular(np.eye(2) - one[None], delta, structure)[0]) for one in differences]
    assert found == [False, True]


@pytest.mark.parametrize("block", [R, C])
@pytest.mark.parametrize("n", [3, 4, 5])
def test_no_perturbation_makes_a_nilpotent_matrix_singular(n, block):
    """det(I - d J) = 1 for every d, although the smallest singular value falls as |d|^(1 - n)."""
    J = np.diag(np.ones(n - 1), 1)
    Q = np.linalg.qr(np.random.default_rng(n).standard_normal((n, n)))[0]
    for M in (J, Q @ J @ Q.T):
        assert mu(M, [block(n)]).lower == 0
    d = 10.0 ** (10 / (n - 1))
    assert not is_singular(J[None], d * np.eye(n, dtype=complex)[None], BlockStructure.of([block(n)]))[0]


# -- input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "M, blocks",
    [(np.eye(3), [C(), C()]), (np.eye(2)[0], [C(), C()]), ([[np.nan, 1], [1, 1]], [C(), C()]), (np.eye(2), ["full"])],
)
def test_wrong_input_is_named(M, blocks):
    with pytest.raises(InputError):
        mu(M, blocks)


@pytest.mark.parametrize("n", [4, 8, 16])
def test_complex_scalars_against_slicot(n):
    """AB13MD's upper bound to 1e-6, proved by D itself; the perturbation of the lower one is singular and has its norm.

    Half of the entries of the second matrices span six decades, or are zero.
    """
    rng = np.random.default_rng(n)
    M = rng.standard_normal((12, n, n)) + 1j * rng.standard_normal((12, n, n))
    M[6:] *= 10.0 ** rng.uniform(-3, 3, M[6:].shape) * (rng.uniform(size=M[6:].shape) < 0.7)
    found = mu(M, [ComplexScalar()] * n)
    for k in range(12):
        assert found.upper[k] <= mu_upper_slicot(M[k], [ComplexScalar()] * n) * (1 + 1e-6)
        scaled = found.D[k] @ M[k] @ np.linalg.inv(found.D_w[k])
        assert np.linalg.norm(scaled, 2) == pytest.approx(found.upper[k], rel=1e-9)
        assert np.allclose(found.D[k], np.diag(np.diag(found.D[k])))
        delta = found.delta[k]
        assert np.array_equal(delta, np.diag(np.diag(delta)))
        assert np.linalg.norm(delta, 2) == pytest.approx(1 / found.lower[k], rel=1e-9)
        assert np.min(np.abs(np.linalg.eigvals(M[k] @ delta) - 1)) < 1e-6
    assert np.median(found.lower / found.upper) > 0.98 and np.min(found.lower / found.upper) > 0.9


def test_shared_scalings_of_full_blocks_hold_for_every_matrix():
    """Blocks that are not square, three matrices with one D: the bound is their largest norm; no random D is better."""
    rng = np.random.default_rng(3)
    structure = BlockStructure.of([ComplexFull(2, 3), ComplexScalar(), ComplexFull(3, 1)])
    M = rng.standard_normal((1, 3, structure.n_z, structure.n_w)) + 1j * rng.standard_normal((1, 3, 5, 6))
    found = upper_bound(M, structure)

    def peak(d):
        d_z, d_w = np.repeat(d, [3, 1, 1]), np.repeat(d, [2, 1, 3])
        return np.max(np.linalg.norm(M[0] * d_z[:, None] / d_w, 2, axis=(1, 2)))

    d = np.sqrt(np.diag(found.scalings.X_w[0]).real[[0, 2, 3]])
    assert peak(d) == pytest.approx(found.beta[0], rel=1e-9)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(50):
            assert peak(d * np.exp(size * rng.standard_normal(3))) >= found.beta[0] * (1 - 1e-6)
