"""The extended Kalman filter against textbook filters, complex steps, chi-square statistics and known rigs."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from avis_ctrl.identification.ekf import ParameterFilter, identify_ekf, noise_root
from avis_ctrl.identification.ekf_kernel import Plant, flow, propagate, update
from avis_ctrl.identification.ekf_model import LinearModel, linear_model, source_parameters
from avis_ctrl.identification.ekf_settings import HONEST_SETTINGS, SOURCE_SETTINGS, EkfSettings
from avis_ctrl.identification.identifiability_text import main_members
from benchmarks.rademakers_records import source_campaign

H1 = 1e-3


@pytest.fixture(scope="module")
def wrong(avis):
    """The rig with the source's parameters off by up to 25 %."""
    draw = np.random.default_rng(5)
    return avis.with_parameters(
        {name: avis.parameters()[name].value * (1 + draw.uniform(-0.25, 0.25)) for name in source_parameters(avis)}
    )


@pytest.fixture(scope="module")
def campaign(avis):
    return source_campaign(avis, sets=2, duration_s=10.0, seed=3)


@pytest.fixture(scope="module")
def honest(wrong, campaign):
    return identify_ekf(wrong, campaign, HONEST_SETTINGS)


def two_masses():
    """Two masses in a chain of springs and dampers, all five of them parameters; velocities measured."""
    names = ("m", "c1", "c2", "k1", "k2")
    zero, slopes = np.zeros((2, 2)), np.zeros((3, 2, 2, 5))
    dM, dC, dK = slopes
    dM[0, 0, 0], dC[0, 0, 1], dK[0, 0, 3] = 1.0, 1.0, 1.0
    dC[..., 2] = dK[..., 4] = [[1.0, -1.0], [-1.0, 1.0]]
    values = np.array([10.0, 20.0, 15.0, 4e3, 3e3])
    return LinearModel(
        names, values, np.array([np.diag([0.0, 8.0]), zero, zero]), slopes, np.eye(2), np.hstack([zero, np.eye(2)])
    )


def plant(model, G=None, decay=1.0):
    """For the compiled loop."""
    G = np.zeros((model.n_q, 0)) if G is None else G
    H = np.hstack([model.H, np.zeros((len(model.H), G.shape[1]))])
    return Plant(*map(np.ascontiguousarray, (*model[2:4], model.values, model.T, H, G)), decay, 0.05)


def process_noise(A, Q, h):
    """Integral of e^(A t) G Q G^T e^(A^T t) by Gauss-Legendre quadrature."""
    n = len(Q)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        column = la.expm(A * h * (node + 1) / 2)[:, n:]
        total = total + weight * h / 2 * column @ Q @ column.T
    return total


def exact(model, theta, h):
    """Phi, Gamma of held inputs by the matrix exponential; complex parameters allowed."""
    A, B = model.system(theta)
    n, m = B.shape
    block = la.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * h)
    return block[:n, :n], block[:n, n:]


def textbook(Phi, Gamma, Qd, H, R, x, P, u, y):
    """Kalman filter with full matrices and Joseph's form; states after each measurement."""
    states = []
    for uk, yk in zip(u, y, strict=True):
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + K @ (yk - H @ x)
        IKH = np.eye(len(x)) - K @ H
        P = IKH @ P @ IKH.T + K @ R @ K.T
        states.append(x)
        x, P = Phi @ x + Gamma @ uk, Phi @ P @ Phi.T + Qd
    return np.array(states)


# -- the linear limit ----------------------------------------------------------------------------------------------


def linear_limit(avis, rng, samples=1500):
    model = linear_model(avis, ())
    u, y = rng.normal(size=(samples, 8)), 1e-4 * rng.normal(size=(samples, 6))
    kalman = ParameterFilter(model, SOURCE_SETTINGS, np.full(6, 1e-10), H1)
    kalman.begin(np.zeros(6))
    trace, done = kalman.filter(u, y, 1)
    assert done == samples
    Phi, Gamma = exact(model, np.zeros(0), H1)
    Qd = process_noise(model.system(np.zeros(0))[0], 1e-8 * np.eye(6), H1)
    P0 = np.diag(np.repeat([2.5e-6**2, 1e-16], 6))
    return model, u, y, trace, (Phi, Gamma, Qd, P0)


def test_without_parameters_it_is_the_textbook_kalman_filter(avis, rng):
    model, u, y, trace, (Phi, Gamma, Qd, P0) = linear_limit(avis, rng)
    expected = textbook(Phi, Gamma, Qd, model.H, 1e-10 * np.eye(6), np.zeros(12), P0, u, y)
    size = np.max(np.abs(expected), axis=0)
    assert np.max(np.abs(trace.x - expected) / size) < 1e-8


def test_without_parameters_it_is_filterpys_kalman_filter(avis, rng):
    kalman = pytest.importorskip("filterpy.kalman", reason="filterpy belongs to the benchmarks extra")
    model, u, y, trace, (Phi, Gamma, Qd, P0) = linear_limit(avis, rng, 300)
    other = kalman.KalmanFilter(dim_x=12, dim_z=6, dim_u=8)
    other.x, other.P, other.F, other.B, other.Q = np.zeros(12), P0, Phi, Gamma, Qd
    other.H, other.R = model.H, 1e-10 * np.eye(6)
    seen = []
    for uk, yk in zip(u, y, strict=True):
        other.update(yk)
        seen.append(other.x.copy())
        other.predict(u=uk)
    size = np.max(np.abs(seen), axis=0)
    assert np.max(np.abs(trace.x - seen) / size) < 1e-8


def test_process_noise_of_a_sample(avis):
    """At 20 ms, where the damping and stiffness in it are far above round-off."""
    A = linear_model(avis, ()).system(np.zeros(0))[0]
    Q = np.diag([1e-8, 2e-8, 3e-8, 4e-8, 5e-8, 6e-8])
    for h in (1e-3, 2e-2):
        root = noise_root(A, la.block_diag(np.zeros((6, 6)), Q), h)
        expected = process_noise(A, Q, h)
        scale = np.sqrt(np.diag(expected))
        assert np.allclose(root.T @ root / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-10)
        assert np.array_equal(root, np.triu(root))


# -- Jacobians -----------------------------------------------------------------------------------------------------


def test_the_sampled_jacobian_is_the_complex_step_of_the_matrix_exponential(avis, rng):
    """Fourth order: a step lacks (omega h)^4 / 120 = 8e-9 of itself at 5 Hz, 2e-8 where s makes that 6 Hz."""
    model = linear_model(avis, source_parameters(avis))
    s = 1 + rng.uniform(-0.2, 0.2, 26)
    x0, u = np.repeat([5e-6, 1e-4], 6) * rng.normal(size=12), rng.normal(size=8)
    x, Phi, Psi = flow(plant(model), s, x0, u, H1)

    def true(s):
        Phi, Gamma = exact(model, model.values * s, H1)
        return Phi @ x0 + Gamma @ u

    def polynomial(s):
        A, B = model.system(model.values * s)
        term = (A @ x0 + B @ u) * H1
        total = x0 + term
        for k in (2, 3, 4):
            term = A @ term * H1 / k
            total = total + term
        return total

    scale = np.repeat([1e-3, 1.0], 6)
    for half in (slice(0, 6), slice(6, 12)):
        change = true(s)[half] - x0[half]
        assert np.max(np.abs(x - true(s))[half]) < 2e-8 * np.max(np.abs(change))
    assert np.allclose(
        Phi * scale / scale[:, None], exact(model, model.values * s, H1)[0] * scale / scale[:, None], atol=1e-9
    )
    for j in range(26):
        moved = s.astype(complex)
        moved[j] += 1e-30j
        # To round-off the polynomial's; the exponential's up to h^3, which the displacements see first.
        for of, near in ((polynomial, (1e-12, 1e-12)), (true, (1e-4, 1e-6))):
            column = of(moved).imag / 1e-30
            for half, allowed in zip((slice(0, 6), slice(6, 12)), near, strict=True):
                error = np.abs(Psi[half, j] - column[half])
                assert np.max(error) < allowed * np.max(np.abs(column[half]))


def test_a_disturbance_acts_as_a_held_acceleration(avis, rng):
    """Against the matrix exponential: f accelerates the table by G f during the sample, and decays at its end."""
    model, G = linear_model(avis, ("mass",)), rng.normal(size=(6, 3))
    x0, u = np.concatenate([np.repeat([5e-6, 1e-4], 6), np.full(3, 1e-4)]) * rng.normal(size=15), rng.normal(size=8)
    x, Phi, _ = flow(plant(model, G, 0.9), np.ones(1), x0, u, H1)
    A, B = model.system(model.values)
    entry = np.hstack([B, np.vstack([np.zeros((6, 3)), G])])
    block = la.expm(np.block([[A, entry], [np.zeros((11, 23))]]) * H1)
    expected = block[:12, :12] @ x0[:12] + block[:12, 12:] @ np.concatenate([u, x0[12:]])
    for half in (slice(0, 6), slice(6, 12)):
        moved = np.max(np.abs(expected - x0[:12])[half])
        assert np.max(np.abs(x[:12] - expected)[half]) < 1e-7 * moved
        found = Phi[half, 12:]
        assert np.max(np.abs(found - block[half, 20:])) < 1e-6 * np.max(np.abs(found))
    assert np.array_equal(x[12:], 0.9 * x0[12:]) and np.array_equal(Phi[12:, 12:], 0.9 * np.eye(3))


# -- covariance ----------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(1, 4))
def test_square_root_propagation_and_update_are_those_of_the_covariance(seed, n_p, n_q):
    draw, n_x = np.random.default_rng(seed), 2 * n_q
    n = n_p + n_x
    W, W_Q = np.triu(draw.normal(size=(n, n))), np.triu(draw.normal(size=(n_x, n_x)))
    Phi, Psi = draw.normal(size=(n_x, n_x)), draw.normal(size=(n_x, n_p))
    F = np.block([[np.eye(n_p), np.zeros((n_p, n_x))], [Psi, Phi]])
    P = F @ W.T @ W @ F.T
    P[n_p:, n_p:] += W_Q.T @ W_Q
    propagate(W, Phi, Psi, W_Q)
    assert np.allclose(W.T @ W, P, rtol=1e-10, atol=1e-10 * np.max(np.abs(P)))
    h, r, gain = draw.normal(size=n_x), draw.uniform(0.1, 2.0), np.empty(n)
    row = np.concatenate([np.zeros(n_p), h])
    variance = update(W, h, r, gain)
    K = P @ row / (row @ P @ row + r)
    assert variance == pytest.approx(row @ P @ row + r, rel=1e-9)
    assert np.allclose(gain, K, rtol=1e-8, atol=1e-9)
    IKH = np.eye(n) - np.outer(K, row)
    assert np.allclose(W.T @ W, IKH @ P @ IKH.T + r * np.outer(K, K), atol=1e-9 * np.max(np.abs(P)))
    assert np.array_equal(W, np.triu(W))


@pytest.mark.slow
@pytest.mark.parametrize("R", [1e-8, 4e-16])
def test_the_covariance_stays_definite_over_1e5_samples(avis, wrong, R):
    """Smallest eigenvalue with every state at unit variance, at every 1e4th of 1e5 samples (seen: 3e-4)."""
    from avis_ctrl.identification.prefilter import prefilter, sensor_inverse

    record = source_campaign(avis, sets=1, duration_s=100.0).records[0].load()
    u, y = prefilter(record, sensor_inverse(avis, record.header.y_names, "V"), avis.loop_delay_s)
    kalman = ParameterFilter(linear_model(wrong, source_parameters(avis)), SOURCE_SETTINGS, np.full(6, R), H1)
    kalman.begin(y[0])
    smallest = []
    for k in range(0, 100_000, 10_000):
        _, done = kalman.filter(u[k : k + 10_000], y[k : k + 10_000], 1000)
        assert done == 10_000
        P = kalman.covariance
        size = np.sqrt(np.diag(P))
        smallest.append(np.min(np.linalg.eigvalsh(P / np.outer(size, size))))
    assert np.min(smallest) > 1e-5


# -- consistency ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_errors_are_as_large_as_the_filter_says():
    """NEES and NIS over 60 draws of parameters, states and noise from the filter's own assumptions."""
    model, h, n, runs = two_masses(), 5e-3, 1500, 60
    draw = np.random.default_rng(8)
    Q, R, share = 1e-4, np.full(2, 1e-6), 0.05
    tuning = EkfSettings(q_sigma=1e-3, v_sigma=1e-2, prior_share=share, Q=Q)
    nees_s, nees_x, nis = [], [], []
    for _ in range(runs):
        s = 1 + share * draw.normal(size=5)
        A, _ = model.system(model.values * s)
        Phi, Gamma = exact(model, model.values * s, h)
        root = la.cholesky(process_noise(A, Q * np.eye(2), h), lower=True)
        x, u, y = np.repeat([1e-3, 1e-2], 2) * draw.normal(size=4), 4 * draw.normal(size=(n, 2)), np.empty((n, 2))
        for k in range(n):
            y[k] = model.H @ x + 1e-3 * draw.normal(size=2)
            last, x = x, Phi @ x + Gamma @ u[k] + root @ draw.normal(size=4)
        kalman = ParameterFilter(model, tuning, R, h)
        kalman.begin(np.zeros(2))
        trace, done = kalman.filter(u, y, 100)
        assert done == n
        P, e = kalman.covariance, np.concatenate([kalman.state.s - s, kalman.state.x - last])
        nees_s.append(e[:5] @ np.linalg.solve(P[:5, :5], e[:5]))
        nees_x.append(e[5:] @ np.linalg.solve(P[5:, 5:], e[5:]))
        nis.append(np.sum(trace.innovation**2))
    for values, dof in ((nees_s, 5), (nees_x, 4), (nis, 2 * n)):
        low, high = chi2.ppf((0.0005, 0.9995), dof * runs)
        assert low < np.sum(values) < high, (dof, np.mean(values))
    # The data told something: the test is not of the prior.
    assert np.all(np.sqrt(np.diag(P)[:5]) < [0.3 * share, share, share, 0.3 * share, 0.3 * share])


def test_a_filter_told_a_tenth_of_the_noise_is_seen_through(avis, wrong, campaign):
    """R and Q far too small: the normalised innovation squared leaves its interval."""
    right = identify_ekf(wrong, campaign, EkfSettings(R=None, Q=1e-15, v_sigma=1e-4, reset=False))
    small = identify_ekf(wrong, campaign, EkfSettings(R=1.15e-14, Q=1e-15, v_sigma=1e-4, reset=False))
    assert 0.95 < right.innovations[-1].nis_per_output < 1.05
    assert small.innovations[-1].nis_per_output > 3 and not small.innovations[-1].consistent


# -- the rig -------------------------------------------------------------------------------------------------------


def determined(avis, names):
    """How many combinations M, C and K depend on at all: the rank of the map from parameters to matrices."""
    model = linear_model(avis, names)
    columns = model.slopes.reshape(108, -1)
    return int(np.linalg.matrix_rank(columns / np.linalg.norm(columns, axis=0), tol=1e-9))


def test_the_sources_26_parameters(avis):
    names = source_parameters(avis)
    assert len(names) == 26 and "isolator1.k_x" not in names and "isolator1.c_x" not in names
    assert determined(avis, names) == 20


def test_identification_from_25_percent_off(avis, wrong, honest):
    names = source_parameters(avis)
    true = np.array([avis.parameters()[name].value for name in names])
    result = honest
    z = (result.values - true) / result.sigma
    known = [names.index(name) for name in ("mass", "J1", "J2", "J3", "isolator3.k_z", "isolator4.c_z")]
    assert np.all(np.abs(z[known]) < 4)
    assert np.all(np.abs(result.values / true - 1)[known[:5]] < 1e-3)
    # M, C and K themselves come out, whatever becomes of the parameters.
    model = linear_model(wrong, names)
    for found, right in zip(model.matrices(result.values), model.matrices(true), strict=True):
        assert np.max(np.abs(found - right)) < 2e-3 * np.max(np.abs(right))
    assert result.history.theta.shape == (20, 26) and np.allclose(result.history.boundaries_s, [0, 10, 20])
    assert not np.any(result.guarded)


def test_directions_that_kept_their_prior_are_those_that_move_nothing(wrong, honest):
    result = honest
    ratio, kept = result.undetermined
    assert kept.shape == (26, 6) and len(ratio) == 6
    assert {tuple(sorted(name for name, _ in main_members(result.names, one)[:2])) for one in kept.T} == {
        (f"isolator{i}.{kind}", f"isolator{j}.{kind}")
        for i, j, kind in ((3, 4, "k_x"), (2, 3, "k_y"), (1, 4, "k_y"), (2, 3, "c_y"), (3, 4, "c_x"), (1, 4, "c_y"))
    }
    model = linear_model(wrong, result.names)
    for part, whole in zip(model.slopes, model.matrices(model.values), strict=True):
        assert np.max(np.abs((part * model.values) @ kept)) < 1e-2 * np.max(np.abs(whole))


def test_limits_reached_in_the_warm_up_are_not_counted(wrong, campaign):
    """A limit just below the start holds some parameters at almost every sample of both rounds."""
    record = campaign.records[0]
    result = identify_ekf(wrong, [record], EkfSettings(warm_up=1, lowest=0.999, prior_share=0.3))
    assert record.header.samples / 2 < result.guarded.max() <= record.header.samples


def test_what_was_kept_from_record_to_record_tells_more_than_a_reset(wrong, campaign):
    kept = identify_ekf(wrong, campaign, EkfSettings(reset=False))
    reset = identify_ekf(wrong, campaign, SOURCE_SETTINGS)
    mass = kept.names.index("mass")
    assert kept.sigma[mass] < 0.8 * reset.sigma[mass]


@pytest.mark.slow
def test_bands_hold_with_floor_motion_too(avis, wrong):
    """NEES of the 20 combinations that M, C and K depend on, over three campaigns with a moving floor."""
    names = source_parameters(avis)
    true = np.array([avis.parameters()[name].value for name in names])
    model = linear_model(avis, names)
    columns = (
        np.concatenate(
            [
                (part / np.max(np.abs(whole))).reshape(36, -1)
                for part, whole in zip(model.slopes, model.matrices(true), strict=True)
            ]
        )
        * true
    )
    map_ = np.linalg.svd(columns)[2][:20]
    nees = []
    for seed in (11, 12, 13):
        shaken = source_campaign(avis, sets=1, duration_s=30.0, seed=seed, floor_rms_m_per_s=2e-6)
        result = identify_ekf(wrong, shaken, HONEST_SETTINGS)
        error, P = map_ @ (result.values / true - 1), map_ @ (result.covariance / np.outer(true, true)) @ map_.T
        nees.append(error @ np.linalg.solve(P, error))
        assert 0.97 < result.innovations[0].nis_per_output < 1.03
    low, high = chi2.ppf((0.0005, 0.9995), 60)
    assert low < np.sum(nees) < high, nees


def test_the_guard_keeps_a_damping_positive_and_says_so():
    """A damper a hundredth of what it was thought to be: noise would carry its estimate below zero."""
    model, h, n, draw = two_masses(), 5e-3, 3000, np.random.default_rng(2)
    truth = model.values * [1, 0.01, 1, 1, 1]
    Phi, Gamma = exact(model, truth, h)
    x, u, y = np.zeros(4), draw.normal(size=(n, 2)), np.empty((n, 2))
    for k in range(n):
        y[k], x = model.H @ x + 1e-3 * draw.normal(size=2), Phi @ x + Gamma @ u[k]
    kalman = ParameterFilter(model, EkfSettings(prior_share=0.6, v_sigma=1e-3), np.full(2, 1e-6), h)
    kalman.begin(y[0])
    trace, done = kalman.filter(u, y, 1)
    assert done == n and np.all(trace.s > 0)
    assert kalman.state.guarded[1] > 0 and not np.any(kalman.state.guarded[[0, 3, 4]])
    assert kalman.theta[1] >= 0.05 * model.values[1] * (1 - 1e-12)
