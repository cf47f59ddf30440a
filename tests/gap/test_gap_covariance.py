"""Standard deviations of a fit: exact where the model is, wide enough where it is not, none lost to another's scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from test_score import MODEL, OMEGA, block, effect

from avis_ctrl.gap.covariance import between, clustered, directions, sandwich, widest
from avis_ctrl.gap.refit import refit, scattered
from avis_ctrl.identification.information import Information


def projector(J):
    """(N, N) onto what a least-squares fit leaves."""
    Q, _ = np.linalg.qr(J.T)
    return np.eye(J.shape[1]) - Q @ Q.T


@given(st.integers(1, 5), st.integers(2, 9), st.integers(0, 10 ** 6))
@settings(max_examples=40, deadline=None)
def test_without_misfit_the_mean_is_the_inverse_information(parameters, clusters, seed):
    """Over white noise, exactly: it is quadratic in e, so its mean is the sum over a basis of the residuals."""
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((parameters, 40)) * 10.0 ** rng.uniform(-3, 3, (parameters, 1))
    cluster = rng.permutation(np.arange(40) % clusters)
    mean = sum(sandwich(J, e, cluster) for e in projector(J))
    size = np.sqrt(np.outer(*2 * [np.diag(np.linalg.inv(J @ J.T))]))
    alone = min(np.linalg.matrix_rank(J[:, cluster != one]) for one in range(clusters)) < parameters
    if not alone:
        assert np.allclose(mean / size, np.linalg.inv(J @ J.T) / size, atol=1e-6)


def test_one_residual_a_cluster_is_whites_estimate():
    """HC2 of MacKinnon and White (J. Econometrics 29, 1985): e_i^2/(1 - h_i) in the middle."""
    rng = np.random.default_rng(1)
    J = rng.standard_normal((3, 50))
    e = projector(J) @ (rng.standard_normal(50) * rng.uniform(0.1, 3, 50))
    H = np.linalg.inv(J @ J.T)
    h = np.einsum("in,ij,jn->n", J, H, J)
    white = H @ (J * (e ** 2 / (1 - h))) @ J.T @ H
    assert np.allclose(sandwich(J, e, np.arange(50)), white, rtol=1e-9)


def test_intervals_cover_where_neighbours_err_together():
    """A line through data whose misfit is alike over twenty neighbours: the information promises far too much."""
    rng, draws = np.random.default_rng(2), 400
    x = np.linspace(-1, 1, 600)
    J = np.array([np.ones_like(x), x])
    cluster = np.arange(600) // 20
    H = np.linalg.inv(J @ J.T)
    inside = np.zeros((2, 2))
    for _ in range(draws):
        e = rng.standard_normal(600) + 1.5 * rng.standard_normal(30)[cluster]
        theta = H @ J @ e  # of zero
        robust = sandwich(J, e - theta @ J, cluster)
        for k, C in enumerate((H, robust)):
            inside[k] += np.abs(theta) < stats.norm.ppf(0.975) * np.sqrt(np.diag(C))
    promised, found = inside / draws
    assert np.all(promised < 0.6)
    assert np.all((found > 0.90) & (found < 0.98))


def test_records_that_ask_for_other_values_count_by_their_spread():
    """A slope that differs by 0.5 r.m.s. between eight records, one of them ten times as loud; and none that does."""
    rng, draws = np.random.default_rng(6), 200
    record = np.repeat(np.arange(8), 100)
    x = rng.standard_normal(800) * np.where(record == 0, 10.0, 1.0)
    found = []
    for spread in (0.5, 0.0):
        for _ in range(draws):
            y = x * (1 + spread * rng.standard_normal(8))[record] + 0.3 * rng.standard_normal(800)
            J = x[None] / 0.3
            theta = float(x @ y / (x @ x))
            found.append(between(J, (y - theta * x) / 0.3, record)[0])
    assert np.mean(found[:draws]) == pytest.approx(0.25, rel=0.25)
    assert np.mean(np.array(found[draws:]) > 0) < 0.04  # of one in a hundred


def test_what_records_tell_together_only_is_no_difference_between_them():
    """A trend over eight records, each with an offset in common: within one the two are all but the same."""
    rng = np.random.default_rng(8)
    record = np.repeat(np.arange(8), 100)
    within = np.tile(np.linspace(-1, 1, 100), 8)
    J = np.array([np.ones(800), record + 1e-3 * within])
    offset, slope = rng.standard_normal((2, 8))
    e = projector(J) @ (rng.standard_normal(800) + offset[record] + slope[record] * within)
    found = between(J, e, record)
    assert found[1] == 0.0
    assert between(J[:1], e, record)[0] > 0.1  # the offset alone is told by each


@given(st.integers(0, 10 ** 6))
@settings(max_examples=30, deadline=None)
def test_the_widest_has_every_largest_variance(seed):
    rng = np.random.default_rng(seed)
    A, B = (X @ X.T for X in rng.standard_normal((2, 4, 6)))
    A[3] = A[:, 3] = 0.0  # held by the first
    C = widest([A, B])
    assert np.allclose(np.diag(C), np.maximum(np.diag(A), np.diag(B)))
    assert np.linalg.eigvalsh(C)[0] > -1e-9 * np.trace(C)
    assert np.allclose(widest([B, 0.5 * B]), B)


def test_a_direction_known_to_a_tenth_stands_beside_one_known_to_a_millionth():
    """Eigenvalues twelve decades apart by their parameters' sizes alone; the third parameter has no information."""
    R = np.diag([1e14, 10.0, 0.0])
    R[0, 1] = R[1, 0] = 0.5 * np.sqrt(1e15)
    B = directions(R)
    assert B.shape == (3, 2)
    assert np.allclose((B @ B.T)[:2, :2], np.linalg.inv(R[:2, :2]), rtol=1e-9)
    assert np.allclose((B @ B.T)[2], 0)


# --- of a table

RELAXATION = ("mount_relaxation", "isolators z", (0.05, 5.0))


def fitted_to_noise(seed, transient=False):
    truth = MODEL.with_effect(effect(*RELAXATION))
    rng = np.random.default_rng(seed)
    blocks = [block(truth, rng, transient, name=name) for name in ("00", "01")]
    return refit(truth, blocks, blocks), blocks, truth.values


def test_errors_of_a_fit_are_as_large_as_it_says():
    """Strength and corner of a branch are known to per cents only, beside masses known to a part in ten thousand."""
    deviations = []
    for seed in range(12):
        found, _, truth = fitted_to_noise(seed)
        std = np.sqrt(np.diag(found.covariance))[-2:]
        deviations.append((found.model.values - truth)[-2:] / std)
    power = np.sum(np.square(deviations), axis=0)
    low, high = stats.chi2(12).ppf([1e-3, 1 - 1e-3])
    assert np.all((power > low) & (power < high)), power


@pytest.mark.parametrize("transient", [False, True], ids=["periodic", "with ends"])
def test_an_exact_model_scatters_as_noise_does(transient):
    found, blocks, _ = fitted_to_noise(3, transient)
    robust = scattered(found, blocks)
    ratio = np.sqrt(np.diag(robust.covariance) / np.diag(found.covariance))
    assert np.all(ratio >= 1 - 1e-9)
    assert np.median(ratio) < 1.35
    assert np.linalg.eigvalsh(robust.covariance / np.outer(*2 * [np.sqrt(np.diag(robust.covariance) + 1e-300)]))[
        0] > -1e-9


def test_what_a_wrong_law_leaves_widens_the_intervals():
    """A lag that no parameter stands for: the fit leaves a hundred times the noise, and says less of the table."""
    truth = MODEL.with_effect(effect("actuator_lag", "actuators", [5e-3]))
    blocks = [block(truth, np.random.default_rng(5), name=name) for name in ("00", "01")]
    found = refit(MODEL, blocks, blocks)
    robust = scattered(found, blocks)
    assert found.fit.chi2_per_dof > 20
    known = np.diag(found.covariance) > 0
    assert np.median(np.sqrt(np.diag(robust.covariance) / np.diag(found.covariance))[known]) > 3


def test_information_of_other_units_is_the_same_covariance():
    """Parameters in thousandths of their size: C does not know of it."""
    found, blocks, _ = fitted_to_noise(4)
    old = found.fit.information
    new = Information(old.names, old.values, old.units, old.matrix, old.scale * np.geomspace(1e-3, 1e3, len(old.scale)))
    a, b = clustered(found.model, blocks, old), clustered(found.model, blocks, new)
    assert np.allclose(np.diag(a)[-2:], np.diag(b)[-2:], rtol=1e-6)
    assert len(OMEGA) == len(blocks[0].omega)
