"""The new likelihood of the gap engine: priors, path errors, evidence; against dense algebra and by differences."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import integrate, stats
from scipy.optimize import lsq_linear, minimize

from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.model_files import model_from_dict, model_to_dict
from avis_ctrl.gap.probability import odds_against, probabilities, probability_of
from avis_ctrl.gap.search import Step, backward_elimination, is_weak, with_effect, with_undetected, without_effect
from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.gap.tolerances import moved, spread, tolerances_behind, within_tolerance
from avis_ctrl.gap.validation import by_information, change_from, halves
from avis_ctrl.identification.clusters import ClusterCovariance, cluster_moves, clusterings
from avis_ctrl.identification.fit_settings import SETTINGS
from avis_ctrl.identification.likelihood import Data, descent, first_variances, fit
from avis_ctrl.identification.maximum_likelihood import (
    as_real,
    block_residual,
    transient_unknowns,
    white_columns,
    whitened,
    whitened_real,
)
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.priors import Priors, beside, identified, re_identified, with_tolerances
from avis_ctrl.identification.response import Driven, ResponseModel
from avis_ctrl.identification.spectra import transient_columns
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.transients import Transients
from avis_ctrl.identification.variances import Variances, bands, estimated
from avis_ctrl.identification.weights import path_contributions, weigh
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.study.gap import find_gap

RIG = load_rig("avis").with_channels_apart()
TOLERANCES = Tolerances()


def bare(names: tuple[str, ...] = ()) -> ResponseModel:
    return ResponseModel.of(RIG, names)


def block(model: ResponseModel, seed: int, lines: int = 60, noise: float = 1e-3) -> SpectralBlock:
    """A record's spectra by a model, with white noise of that variance on each line."""
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * np.sort(rng.uniform(0.7, 50, lines))
    U = np.zeros((lines, 11, 1), complex)
    U[:, :8, 0] = np.exp(2j * np.pi * rng.uniform(size=(lines, 8)))
    error = np.sqrt(noise / 2) * (rng.standard_normal((lines, 6)) + 1j * rng.standard_normal((lines, 6)))
    Y = model.driven(omega, U, False).Y + error[:, :, None]
    whole = np.broadcast_to(noise * np.eye(6, dtype=complex), (lines, 1, 6, 6))
    return SpectralBlock(f"{seed:02d}", omega, U, Y, whole, transient=True, samples=60000)


@pytest.mark.parametrize(
    "name",
    [
        "place.Ay1.x",
        "place.Sz3.y",
        "direction.Az2.x",
        "direction.Sx2.z",
        "actuator.Ax4",
        "sensor.Sy1",
        "corner.Sz1",
        "damping.Sy3",
        "com_z",
        "J13",
        "isolator2.p_x",
    ],
)
def test_derivatives_by_tolerances_are_those_of_differences(name):
    model = bare((name,))
    omega, U = 2 * np.pi * np.geomspace(0.5, 80, 40), np.random.default_rng(1).standard_normal((40, 11, 2)) + 0j
    (value,) = model.values
    step = 1e-5 * max(abs(value), 0.1)
    high, low = (model.at([value + sign * step]).driven(omega, U, False).Y for sign in (1, -1))
    slope = model.driven(omega, U).dY[0]
    assert_allclose(slope, (high - low) / (2 * step), atol=2e-6 * np.max(np.abs(slope)))


def test_channels_apart_are_the_same_table():
    omega = 2 * np.pi * np.geomspace(0.5, 80, 30)
    assert_allclose(bare().response(omega), ResponseModel.of(load_rig("avis"), ()).response(omega), rtol=1e-12)


def test_every_tolerance_of_the_contract_is_free():
    priors = with_tolerances(bare(), TOLERANCES)
    # 8 drives: place 3, direction 2, gain 1; 6 sensors: these, corner, damping; 4 mounts: 3; centre 3; products 3.
    assert len(priors.names) - len(re_identified(RIG).names) == 8 * 6 + 6 * 8 + 4 * 3 + 3 + 3
    z = np.random.default_rng(2).standard_normal(len(priors.names))
    assert_allclose(priors.z(priors.values(z)), z, atol=1e-9)
    by_difference = (priors.values(z + 1e-6) - priors.values(z - 1e-6)) / 2e-6
    assert_allclose(priors.slopes(z), by_difference, rtol=1e-6)


def test_a_step_keeps_sums_of_dampings_and_products_of_gains():
    """Two dampings whose sum the data know, and two gains whose product they know."""
    names = ("isolator1.c_x", "isolator2.c_x", "sensor.Sz1", "actuator.Az1")
    priors = Priors(names, np.array([40.0, 40.0, 28.0, 1.5]), np.array([0.2, 0.2, 0.02, 0.02]), np.ones(4, bool))
    start = np.array([0.5, -1.0, 1.0, 2.0])
    before, slopes = priors.values(start), priors.slopes(start)
    along = np.array([1.0, -slopes[0] / slopes[1], 0.0, 0.0]), np.array([0.0, 0.0, 1.0, -1.0])
    after = priors.values(priors.stepped(start, start + along[0] + 3 * along[1]))
    assert after[0] + after[1] == pytest.approx(before[0] + before[1], rel=1e-12)
    assert after[2] * after[3] == pytest.approx(before[2] * before[3], rel=1e-12)
    assert abs(after[0] - before[0] - slopes[0]) < 1e-9
    # However long a step is, a damping remains positive, and a longer step moves it farther.
    ends = [priors.values(priors.stepped(start, start - x * along[0]))[0] for x in (1.0, 2.4, 2.6, 30.0)]
    assert np.all(np.diff(ends) < 0) and ends[-1] > 0


def test_a_step_to_a_bound_ends_there():
    priors = Priors(("isolator1.c_x",), np.array([40.0]), np.array([0.2]), np.ones(1, bool), 0.0, 44.0)
    assert priors.values(priors.stepped(np.zeros(1), priors.bounds[1])) == 44.0


def with_path_errors(blocks, model, error):
    """Weights of blocks with relative path errors of this size, and the whitening matrices."""
    data, settings = Data(tuple(blocks), tuple(0.2 + 0.2 * k for k in range(len(blocks)))), GapSettings()
    first = first_variances(data, settings)
    variances = Variances(
        {band: np.full_like(v, error**2) for band, v in first.path.items()},
        {group: np.full_like(s, 1e-9) for group, s in first.distortion.items()},
    )
    weights = weigh(data.blocks, data.levels, [path_contributions(model, one) for one in blocks], variances, settings)
    return weights, [L[:, None] for L in weights.L]


def white_rows(model, blocks, whiteners, transients, derivative=True):
    """Whitened residual and Jacobian, with the transients removed."""
    found = [
        model.answer(one, body, derivative, inner)
        for one, (body, inner) in zip(blocks, transients.initial, strict=True)
    ]
    rows = zip(blocks, whiteners, found, strict=True)
    e = np.concatenate([as_real(whitened(L, one.Y - each.Y)[None])[0] for one, L, each in rows])
    transients.remove_from(e[None])
    if not derivative:
        return e, None
    J = np.concatenate([whitened_real(L, each.dY) for L, each in zip(whiteners, found, strict=True)], axis=1)
    transients.remove_from(J)
    return e, J


def test_the_gradient_is_exact_with_path_errors():
    """Of the penalised sum of squares by parameters far from their optimum, against differences: with the transients
    of the model, and with those that follow the parameters."""
    names = ("isolator1.c_z", "isolator2.p_x", "sensor.Sz1", "mass", "J13")
    model = bare(names)
    blocks = [replace(one, Y=one.Y * 1.01) for one in (block(bare(), seed, 40, 1e-5) for seed in (3, 4))]
    weights, whiteners = with_path_errors(blocks, model, 0.01)
    transients, scale = Transients.of(model, blocks, whiteners, weights.paths), 1e-3 * np.abs(model.scales())

    def cost(theta, following):
        moved = model.at(theta)
        own = Transients.of(moved, blocks, whiteners, weights.paths) if following else transients
        e, _ = white_rows(moved, blocks, whiteners, own, derivative=False)
        return weights.normal_equations(np.empty((0, len(e))), e)[2]

    e, J = white_rows(model, blocks, whiteners, transients)
    _, g, _ = weights.normal_equations(J, e)
    for following in (False, True):
        for k, h in enumerate(np.diag(scale)):
            slope = (cost(model.values + h, following) - cost(model.values - h, following)) / (2 * scale[k])
            assert -2 * g[k] == pytest.approx(slope, rel=1e-3, abs=1e-5 * np.linalg.norm(J[k]) * np.linalg.norm(e))
    # Without path errors, residual and Jacobian are those of a fit by noise alone.
    plain = Transients.of(model, blocks[:1], whiteners[:1])
    e, J = white_rows(model, blocks[:1], whiteners[:1], plain)
    e_known, J_known, _ = block_residual(model, blocks[0], whiteners[0], derivative=True)
    assert_allclose(e, e_known, atol=1e-9 * np.linalg.norm(e))
    assert_allclose(J, J_known, atol=1e-9 * np.linalg.norm(J))


def test_transients_are_removed_by_generalised_least_squares():
    """Normal equations and determinant against dense matrices; two records, whose path errors are the same."""
    model = bare(("isolator1.k_z", "mass", "sensor.Sz1"))
    blocks = [replace(one, Y=one.Y * 1.02) for one in (block(bare(), seed, 30, 1e-5) for seed in (3, 4))]
    weights, whiteners = with_path_errors(blocks, model, 0.02)
    transients = Transients.of(model, blocks, whiteners, weights.paths)
    H, g, cost = weights.normal_equations(*reversed(white_rows(model, blocks, whiteners, transients)))
    free = replace(
        transients, bases=tuple(Q[:, :0] for Q in transients.bases), along=(), paths=(), covariance=np.eye(0)
    )
    e, J = white_rows(model, blocks, whiteners, free)
    T = [white_columns(transient_columns(model, one.omega)[0], L) for one, L in zip(blocks, whiteners, strict=True)]
    T = np.block([[T[0], np.zeros_like(T[1])], [np.zeros_like(T[0]), T[1]]])
    W = weights.flatten(weights.flatten(np.eye(len(e))))
    assert_allclose(W, W.T, atol=1e-10)
    left = W - W @ T.T @ np.linalg.solve(T @ W @ T.T, T @ W)
    assert_allclose(H, J @ left @ J.T, rtol=1e-6)
    assert_allclose(g, J @ left @ e, rtol=1e-6, atol=1e-6 * np.linalg.norm(J, axis=1).max())
    assert cost == pytest.approx(e @ left @ e, rel=1e-6)
    A = weights.flatten(T)
    A *= np.sqrt(len(e) / 2) / np.linalg.norm(A, axis=1)[:, None]
    assert transients.price == pytest.approx(0.5 * np.linalg.slogdet(np.eye(len(e)) + A.T @ A)[1], rel=1e-6)


@pytest.mark.parametrize(("noise", "error"), [(1e-5, 0.01), (1e-5, 0.05), (1e-3, 0.05)])
def test_standard_deviations_hold_with_path_errors_and_transients(noise, error):
    """Sum of squares, and error over standard deviation, in 100 draws of path errors and noise of one record. (If the
    transients were estimated with the weights of the noise alone, the errors were up to nine standard deviations.)"""
    model, rng = bare(("isolator1.k_z", "isolator2.k_x", "mass")), np.random.default_rng(5)
    exact = replace(
        block(bare(), 3, 150, noise), Y=model.driven(block(bare(), 3, 150).omega, block(bare(), 3, 150).U).Y
    )
    paths = path_contributions(model, exact)
    weights, whiteners = with_path_errors([exact], model, error)
    own, errors, squares = bands(exact.omega, GapSettings().bands_per_octave), [], []
    for _ in range(100):
        of_band = {band: rng.standard_normal((2, *paths.shape[1:])) for band in np.unique(own)}
        eps = np.array([error * (of_band[band][0] + 1j * of_band[band][1]) / np.sqrt(2) for band in own])
        white = rng.standard_normal((2, 150, 6))
        Y = exact.Y[:, :, 0] + np.sum(paths * eps, axis=2) + np.sqrt(noise / 2) * (white[0] + 1j * white[1])
        drawn = replace(exact, Y=Y[:, :, None])
        transients = Transients.of(model, [drawn], whiteners, weights.paths)
        H, g, cost = weights.normal_equations(*reversed(white_rows(model, [drawn], whiteners, transients)))
        errors.append(np.linalg.solve(H, g) / np.sqrt(np.diag(np.linalg.inv(H))))
        squares.append(cost)
    expected = 2 * 150 * 6 - transient_unknowns(exact, model)
    assert np.mean(squares) == pytest.approx(expected, rel=0.02)
    assert_allclose(np.sqrt(np.mean(np.square(errors), axis=0)), 1, atol=0.25)
    assert 0.9 < np.mean(np.abs(errors) < 1.96) < 0.99


def test_path_errors_are_integrated_out_as_a_dense_covariance_would_do():
    """Quadratic form and determinant against a complex covariance written out; two records at two levels, which share
    the path errors of a band."""
    settings, model, levels = GapSettings(bands_per_octave=1), bare(), (0.2, 0.4)
    blocks = [block(bare(), seed, 12) for seed in (3, 4)]
    found = first_variances(Data(tuple(blocks), levels), settings)
    path = {band: np.linspace(0.5, 2, 6) * v for band, v in found.path.items()}
    G = [path_contributions(model, one) for one in blocks]
    weights = weigh(blocks, levels, G, Variances(path, found.distortion), settings)
    rng = np.random.default_rng(4)
    e = rng.standard_normal((2, 12, 6)) + 1j * rng.standard_normal((2, 12, 6))
    white = [np.einsum("kij,kj->ki", L, part) for L, part in zip(weights.L, e, strict=True)]
    flat = weights.flatten(np.concatenate([x for one in white for x in (one.real.ravel(), one.imag.ravel())])[None])[0]
    C = np.zeros((144, 144), complex)
    lines = [(r, k, int(np.floor(np.log2(blocks[r].omega[k]) + 1e-9))) for r in range(2) for k in range(12)]
    for i, (r, k, band) in enumerate(lines):
        C[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += 1e-3 * np.eye(6) + np.diag(found.distortion[levels[r], band])
        for j, (s, m, other) in enumerate(lines):
            if other == band:
                C[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] += np.diag(
                    path[band] * np.sum(G[r][k] * G[s][m].conj(), axis=1)
                )
    assert flat @ flat == pytest.approx(2 * np.real(e.ravel().conj() @ np.linalg.solve(C, e.ravel())), rel=1e-9)
    assert weights.log_determinant == pytest.approx(2 * np.linalg.slogdet(C)[1], rel=1e-9)
    assert_allclose(np.sort(np.concatenate(list(weights.rows.values()))), np.arange(288))


def test_a_tolerance_is_found_within_its_deviation_and_the_priors_hold_the_rest():
    """A table with two tolerances three of their deviations off, and one stiffness 5 %."""
    settings = GapSettings(rounds=1)
    priors = with_tolerances(bare(), TOLERANCES, settings)
    truth = np.zeros(len(priors.names))
    for name, z in (("sensor.Sz1", 3.0), ("direction.Ay1.z", -3.0), ("isolator1.k_z", 1.0)):
        truth[priors.names.index(name)] = z
    model = bare(priors.names)
    true = model.at(priors.values(truth))
    data = Data(tuple(block(true, seed, 50, 1e-4) for seed in (5, 6)), (0.2, 0.2))
    start = replace(
        first_variances(data, settings), path={k: np.full(6, 1e-6) for k in first_variances(data, settings).path}
    )
    found = fit(model, priors, np.zeros(len(truth)), data, start, settings)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.max(np.abs(found.z - truth) / sigma) < 4.5
    assert np.all(sigma <= 1 + 1e-9)


def test_parameters_stay_within_their_bounds():
    priors = Priors(
        ("a", "b"),
        np.array([0.0, 1.0]),
        np.array([1.0, 0.1]),
        np.array([False, True]),
        np.array([-0.5, 0.0]),
        np.array([0.5, 2.0]),
    )
    assert_allclose(priors.values(np.array([3.0, 1.0])), [0.5, np.exp(0.1)])


def test_at_a_bound_the_other_parameters_find_their_own_optimum():
    """The conditions of Karush, Kuhn and Tucker, where the optimum lies beyond the bound of one of several gains that
    are hardly told apart."""
    settings, known = GapSettings(rounds=0), bare().all_parameters()
    names = ("actuator.Az1", "actuator.Az2", "actuator.Az3", "sensor.Sz1", "sensor.Sz2", "sensor.Sz3")
    mean = np.array([known[name].value for name in names])
    priors = Priors(names, mean, np.full(len(mean), 0.1), np.ones(len(mean), bool), 0.0, 1.01 * mean)
    truth = mean * np.where(np.arange(len(mean)) == 0, 1.2, 0.97)
    data = Data(tuple(block(bare(names).at(truth), seed, 120, 1e-7) for seed in (3, 4)), (0.2, 0.2))
    found = fit(bare(names), priors, np.zeros(len(mean)), data, first_variances(data, settings), settings)
    slope = (found.J @ found.e - found.z) / np.sqrt(np.sum(found.J**2, axis=1) + 1)
    bound = found.z == priors.bounds[1]
    assert bound[0] and not np.all(bound)
    assert np.all(slope[bound] > 1) and np.max(np.abs(slope[~bound])) < 0.05


@pytest.mark.parametrize("bounded", [2, 4])
def test_a_step_within_bounds_is_that_of_bounded_least_squares(bounded, rng):
    """Of a linear model whose parameters are strongly correlated, against SciPy."""
    for _ in range(20):
        root = rng.standard_normal((80, 8)) @ np.diag(np.geomspace(1, 100, 8)) @ rng.standard_normal((8, 8))
        target, low = 10 * rng.standard_normal(80), np.full(8, -np.inf)
        low[:bounded] = 0.0
        names = tuple("abcdefgh")
        priors = Priors(names, np.zeros(8), np.ones(8), np.zeros(8, bool), low, np.full(8, np.inf))

        def expand(z, derivative, near, root=root, target=target):
            e = target - root @ z
            return SimpleNamespace(
                z=z, H=root.T @ root, g=root.T @ e, whole=float(e @ e + z @ z), now=SimpleNamespace(e=e)
            )

        end, _ = descent(expand, np.full(8, 0.1), priors, 12, SETTINGS)
        best = lsq_linear(np.vstack([root, np.eye(8)]), np.r_[target, np.zeros(8)], (low, np.inf), tol=1e-14)
        assert end.whole <= 2 * best.cost * (1 + 1e-8) + 1e-6 and np.all(end.z >= low)


def found_at(seed: int = 7, bend: float = 0.0):
    """A fit of one sensor's gain; bend : by how much it is another one above 8 Hz."""
    settings = GapSettings(rounds=0)
    k_y = bare().sensors.names.index("Sz1")
    priors = Priors(("sensor.Sz1",), bare().sensors.sensitivity[[k_y]], np.array([0.1]), np.ones(1, bool))
    model = bare(priors.names)
    blocks = []
    for k in (seed, seed + 1):
        one = block(model, k, 120, 1e-5)
        factor = np.ones(one.Y.shape)
        factor[one.omega > 2 * np.pi * 8, k_y] += bend
        blocks.append(replace(one, Y=one.Y * factor))
    data = Data(tuple(blocks), (0.2, 0.2))
    first = first_variances(data, settings)
    little = Variances(
        {group: 1e-4 * v for group, v in first.path.items()}, {group: 1e-9 * s for group, s in first.distortion.items()}
    )
    return fit(model, priors, np.zeros(1), data, little, settings), data, settings


def fit_with_places(noise: float, moved: float):
    """A fit of two records that a table with other values gave, by parameters and places of the mounts, which the data
    hardly tell apart; moved : standard deviation of the mounts' places over their tolerance."""
    settings, rng = replace(SETTINGS, rounds=0), np.random.default_rng(2)
    free = default_parameters(RIG)
    priors = identified(bare(free), {}).followed_by(beside(bare(), free, TOLERANCES))
    priors = priors.of([name for name in priors.names if name in free or ".p_" in name or name.startswith("com_")])
    model = bare(priors.names)
    z = moved * np.where([name in free for name in priors.names], 0.3, 1.0) * rng.standard_normal(len(priors.names))
    blocks = tuple(block(model.at(priors.values(z)), seed, noise=noise) for seed in (5, 6))
    data = Data(blocks, (0.5, 0.5))
    first = first_variances(data, settings)
    none = Variances(
        {group: 1e-20 * v for group, v in first.path.items()},
        {group: 1e-20 * s for group, s in first.distortion.items()},
    )
    return fit(model, priors, np.zeros(len(z)), data, none, settings), blocks


def test_a_fit_reaches_the_noise_though_parameters_are_hardly_told_apart():
    """The table is drawn from the priors, or nearer: the penalised sum of squares is then chi-square or less."""
    found, blocks = fit_with_places(1e-4, 1.0)
    dof = len(found.e) - sum(transient_unknowns(one, found.model) for one in blocks)
    assert stats.chi2.sf(found.e @ found.e + found.z @ found.z, dof) > 1e-3


def test_the_covariance_is_one_though_parameters_are_hardly_told_apart():
    found, _ = fit_with_places(1e-9, 0.0)
    assert_array_equal(found.covariance, found.covariance.T)
    root = np.linalg.cholesky(found.covariance)
    assert_allclose(np.linalg.norm(found.J.T @ root, 2), 1, atol=1e-3)


def test_normal_equations_are_those_of_the_flattened_rows():
    found, _, _ = found_at()
    J = np.random.default_rng(3).standard_normal((5, len(found.e)))
    H, g, cost = found.weights.normal_equations(J, found.white.e)
    flat = found.weights.flatten(J)
    assert_allclose(H, flat @ flat.T, rtol=1e-9, atol=1e-9 * np.abs(H).max())
    assert_allclose(g, flat @ found.e, rtol=1e-9, atol=1e-9 * np.abs(g).max())
    assert cost == pytest.approx(found.e @ found.e, rel=1e-9)
    assert sum(found.log_likelihoods.values()) == pytest.approx(-0.5 * (cost + found.weights.log_determinant))


@pytest.mark.parametrize(
    ("path_error", "distortion", "own_part"),
    [
        pytest.param(0.05, (0.03, 0.1), 0.0, id="both"),
        pytest.param(0.02, (0.02, 0.02), 0.0, id="hard to distinguish"),
        pytest.param(0.05, (0.0, 0.1), 0.4, id="one level also responds in another direction"),
    ],
)
def test_variances_are_the_most_likely_ones(path_error, distortion, own_part):
    """Against a general optimiser with many starts on the dense covariance of one sensor in one band; two levels."""
    settings, rng = GapSettings(bands_per_octave=1), np.random.default_rng(5)
    omega, noise, levels = 2 * np.pi * np.linspace(2.6, 5.0, 30), 1e-4, (0.2, 0.4)

    def circular(*shape):
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    errors = path_error * circular(6, 3)
    whole = np.broadcast_to(noise * np.eye(6, dtype=complex), (30, 1, 6, 6))
    path = np.zeros((2, 30, 6, 11), complex)
    path[..., :3] = np.sqrt(2) * circular(2, 30, 6, 3)
    size = np.sqrt(noise + np.square(distortion))[:, None, None]
    e = np.einsum("rkcj,cj->rkc", path[..., :3], errors) + size * circular(2, 30, 6)
    e[0] += own_part * path[0, :, :, 0]
    blocks = [
        SpectralBlock(
            "01", omega, np.zeros((30, 11, 1), complex), one[:, :, None], whole, transient=False, samples=60000
        )
        for one in e
    ]
    band = int(np.floor(np.log2(omega[0]) + 1e-9))
    assert np.all(np.floor(np.log2(omega) + 1e-9) == band)
    start = Variances({band: np.full(6, 1e-2)}, {(level, band): np.full(6, 1e-3) for level in levels})
    found = estimated(list(e), blocks, levels, list(path), start, settings)
    nu, v0, s0 = settings.error_weight, settings.least_error**2, settings.least_distortion * noise

    def cost(x, c):
        v, *s = np.exp(x)
        C = v * np.einsum("rkj,sij->rksi", path[:, :, c], path[:, :, c].conj()).reshape(60, 60)
        C += np.diag(noise + np.repeat(s, 30))
        own = e[:, :, c].ravel()
        return float(
            np.real(own.conj() @ np.linalg.solve(C, own))
            + np.linalg.slogdet(C)[1]
            + nu / 2 * (x.sum() + v0 / v + sum(s0 / one for one in s))
        )

    starts = [np.log([v, *s]) for v in (1e-6, 1e-1) for s in itertools.product((2e-6, 1e-2), repeat=2)]
    for c in range(6):
        best = min((minimize(cost, one, args=(c,), method="BFGS") for one in starts), key=lambda end: end.fun)
        own = np.log([found.path[band][c], *(found.distortion[level, band][c] for level in levels)])
        assert cost(own, c) < best.fun + 1e-3


def test_spread_of_the_values_that_the_data_determine():
    """Values drawn with a third of their tolerances; of those that the data do not determine nothing is known."""
    priors, rng = with_tolerances(bare(), TOLERANCES), np.random.default_rng(2)
    count = len(priors.names)
    known = rng.random(count) < 0.6
    variance = np.where(known, 0.05, 0.9)
    z = np.where(known, 0.3 * rng.standard_normal(count), 0.1 * rng.standard_normal(count))
    theta = len(re_identified(RIG).names)
    z[:theta], variance[:theta] = 3.0, 1e-6
    model = SimpleNamespace(rig=RIG, effects=())
    found = SimpleNamespace(model=model, priors=priors, z=z, covariance=np.diag(variance))
    rows, size = spread(found, GapSettings())
    assert rows == np.flatnonzero(known & (np.arange(count) >= theta)).tolist()
    assert size == pytest.approx(0.3, rel=0.3)
    assert spread(replace_z(found, 5 * z), GapSettings())[1] == 1.0


def replace_z(found, z):
    return SimpleNamespace(**{**vars(found), "z": z})


def test_a_parameter_that_moves_with_the_band_refutes_its_law():
    good, bent = (halves(found, ("sensor.Sz1",), settings) for found, _, settings in (found_at(), found_at(bend=0.3)))
    assert min(one.p_value for one in good) > 1e-3
    assert max(one.change for one in bent) > 0.05 and min(one.p_value for one in bent) < 1e-4
    assert {one.words for one in bent} == {"the lower part of the band", "the upper part of the band"}


def test_a_parameter_that_hardly_acts_in_a_half_may_move_there():
    """a x + b x^5 with an error at small x that bends b alone; by least squares on the half and on the whole."""
    rng, x = np.random.default_rng(3), np.concatenate([np.linspace(0.05, 0.4, 80), np.linspace(0.6, 1.0, 40)])
    columns, std = np.stack([x, x**5]), 1e-4
    bent = 0.02 * np.where(x < 0.5, x**5 - (x[:80] @ x[:80] ** 5) / (x[:80] @ x[:80]) * x, 0.0)
    y = columns.T @ [1.0, 0.5] + 100 * bent + std * rng.standard_normal(len(x))
    wide = Priors(("a", "b"), np.zeros(2), np.full(2, 1e3), np.zeros(2, bool))
    J = columns * 1e3 / std
    P = np.linalg.inv(J @ J.T + np.eye(2))
    z = P @ J @ (y / std)
    found = SimpleNamespace(priors=wide, z=z, covariance=P, J=J, e=y / std - J.T @ z, rows={})
    low = np.arange(80)
    settings = GapSettings(most_of_half=1e12)
    (parameter,) = halves(found, ("a", "b"), settings, [("small", low)])
    (effect,) = halves(found, ("a", "b"), settings, [("small", low)], {"a": 0.0, "b": 0.0})
    whole, half = (np.linalg.lstsq(columns[:, at].T, y[at], rcond=None)[0] for at in (np.arange(len(x)), low))
    change = np.abs(half / whole - 1)
    assert parameter.change == pytest.approx(change.max(), rel=1e-3) and change.max() > 1
    moved = columns[:, low].T @ (half - whole)
    assert effect.change == pytest.approx(np.linalg.norm(moved) / np.linalg.norm(columns[:, low].T @ whole), rel=1e-3)
    assert effect.change < 0.05
    gain = found_at(bend=0.3)[0]  # of a logarithm, which never is zero
    plain, same = (
        halves(gain, ("sensor.Sz1",), GapSettings(), absent=absent) for absent in (None, {"sensor.Sz1": 0.0})
    )
    assert [one.change for one in plain] == [one.change for one in same]


def test_a_gain_moves_relative_to_its_departure():
    """A gain of 1.00 in one half of the data and 1.07 in the other is no gain of 1.035."""
    rng, std = np.random.default_rng(4), 1e-3
    x = rng.standard_normal(400)
    y = np.where(np.arange(400) < 200, 1.0, 1.07) * x + std * rng.standard_normal(400)
    J = x[None] * 1e3 / std
    P = np.linalg.inv(J @ J.T + np.eye(1))
    z = P @ J @ (y - x) / std
    wide = Priors(("gain",), np.ones(1), np.full(1, 1e3), np.zeros(1, bool))
    found = SimpleNamespace(priors=wide, z=z, covariance=P, J=J, e=(y - x) / std - J.T @ z, rows={})
    (half,) = halves(found, ("gain",), GapSettings(), [("first", np.arange(200))], {"gain": 1.0})
    assert half.change == pytest.approx(1.0, abs=0.15)


def test_an_effect_that_describes_another_one_changes_without_it():
    """y = a x1 + b x2 with correlated x1, x2: without b, a takes its place; without an unrelated c, it stays."""
    rng, std = np.random.default_rng(5), 1e-2
    x = rng.standard_normal((3, 400))
    x[1] += 0.8 * x[0]
    x[2] -= np.linalg.lstsq(x[:2].T, x[2], rcond=None)[0] @ x[:2]
    y = np.array([0.05, 1.0, 0.7]) @ x + std * rng.standard_normal(400)
    names = ("a", "b", "c")

    def least_squares(rows):
        wide = Priors(
            tuple(names[k] for k in rows), np.zeros(len(rows)), np.full(len(rows), 1e3), np.zeros(len(rows), bool)
        )
        J = x[rows] * 1e3 / std
        P = np.linalg.inv(J @ J.T + np.eye(len(rows)))
        return SimpleNamespace(priors=wide, z=P @ J @ (y / std), covariance=P, J=J)

    whole, settings = least_squares([0, 1, 2]), GapSettings()
    assert change_from(least_squares([0, 2]), whole, ("a",), settings, {"a": 0.0}) > 0.8
    assert change_from(least_squares([0, 1]), whole, ("a",), settings, {"a": 0.0}) == 0.0


def test_standard_deviations_cover_what_octaves_differ_by():
    """One gain above 8 Hz, another below: known no better than these agree, and no worse."""
    good, bent = found_at()[0], found_at(bend=0.3)[0]
    wide, relative = [], []
    for one in (good, bent):
        std = float(np.sqrt(one.covariance_of(["sensor.Sz1"])[0, 0]))
        assert std == pytest.approx(one.moved(["sensor.Sz1"])[0].std)
        assert std == pytest.approx(float(np.sqrt(one.whole_covariance()[0, 0])))
        relative.append(std / one.priors.mean[0])
        wide.append(std / float(np.sqrt(one.covariance[0, 0]) * one.priors.slopes(one.z)[0]))
    assert 1 <= wide[0] < 3
    assert wide[1] > 10 and 0.03 < relative[1] < 0.3


def test_cluster_variances_are_right_in_the_mean_where_the_model_holds_and_where_clusters_are_alike():
    """A straight line: white residuals give P; errors common to a cluster give the spread of the estimates."""
    rng = np.random.default_rng(8)
    clusters = [np.arange(k, k + n) for k, n in ((0, 10), (10, 30), (40, 40), (80, 40))]
    J = np.stack([np.ones(120), np.linspace(-1, 1, 120)])
    P = np.linalg.inv(J @ J.T + np.eye(2))
    for common in (0.0, 0.5):
        z = rng.standard_normal((4000, 2))
        noise = rng.standard_normal((4000, 120))
        for at in clusters:
            noise[:, at] += common * rng.standard_normal((4000, 1))
        y = z @ J + noise
        found = y @ J.T @ P
        moves = [cluster_moves(P, J, own - x @ J, clusters) for own, x in zip(y[:1000], found, strict=False)]
        variances = np.diag(P @ P) + np.mean([np.sum(one**2, axis=0) for one in moves], axis=0)
        assert_allclose(variances, np.mean((found - z) ** 2, axis=0), rtol=0.1 if not common else 0.25)


def test_a_cluster_does_not_count_where_no_other_knows_anything():
    """Of a resonance in one octave, residuals there say nothing of how octaves differ."""
    J = np.zeros((2, 20))
    J[0, :10], J[1] = np.sqrt(1e7), np.sqrt(0.2)
    P = np.linalg.inv(J @ J.T + np.eye(2))
    moves = cluster_moves(P, J, np.ones(20), [np.arange(10), np.arange(10, 20)], 0.05)
    assert np.abs(moves[0, 0]) < 1e-6 < np.abs(cluster_moves(P, J, np.ones(20), [np.arange(10)])[0, 0])
    assert np.abs(moves[1, 1]) > 0.1


def test_a_covering_covariance_is_no_smaller_in_any_direction():
    rng = np.random.default_rng(2)
    for k in (1, 3, 5):
        X, few = rng.standard_normal((k, k + 2)), rng.standard_normal((k, 2))
        A, B = X @ X.T, few @ few.T
        C = ClusterCovariance(B, 3).covering(A, range(k))
        for one in (A, B):
            assert np.min(np.linalg.eigvalsh(C - one)) > -1e-9 * np.max(C)
        assert_allclose(ClusterCovariance(0.5 * A, 3).covering(A, range(k)), A, rtol=1e-9)
        # Student's t with two degrees of freedom: 4.303 instead of 1.960.
        assert_allclose(
            ClusterCovariance(3 * A, 3).covering(A, range(k)), (1 + 2 * (4.303 / 1.960) ** 2) * A, rtol=1e-3
        )


@pytest.mark.parametrize("clusters", [2, 3, 6])
@pytest.mark.parametrize("scatter", [0.0, 1.0, 3.0, 10.0])
def test_intervals_from_a_few_clusters_contain_the_truth(clusters, scatter):
    """One parameter that differs between levels, by this multiple of the model's standard deviation (mean of all)."""
    rng, draws, n = np.random.default_rng(7), 600, 20
    J = np.full((1, clusters * n), 30 / np.sqrt(clusters * n))
    P = np.linalg.inv(J @ J.T + np.eye(1))
    rows, inside = np.split(np.arange(clusters * n), clusters), 0
    for _ in range(draws):
        own = scatter * np.sqrt(P[0, 0] * clusters) * rng.standard_normal(clusters)
        y = np.repeat(own, n) * J[0] + rng.standard_normal(clusters * n)
        z = P @ (J @ y)
        moves = cluster_moves(P, J, y - z @ J, rows)
        variance = ClusterCovariance(P @ P + moves.T @ moves, clusters).covering(P, [0])[0, 0]
        inside += abs(z[0]) < 1.96 * np.sqrt(variance)
    assert 0.83 < inside / draws < 0.99


def test_clusters_are_octaves_of_bands_and_levels():
    groups = [(level, band) for level in (0.1, 0.2) for band in range(7)]
    octaves, levels = clusterings(groups, 3)
    assert [sorted(len(part) for part in parts) for parts in octaves] == [[2, 6, 6], [2, 6, 6], [4, 4, 6]]
    assert [len(part) for part in levels] == [7, 7]
    assert all(sorted(group for part in parts for group in part) == sorted(groups) for parts in (*octaves, levels))


@pytest.mark.parametrize(
    ("name", "place", "cost"),
    [("mount_relaxation", "isolators z", (0.0, 3.0)), ("attached_oscillator", "payload/axes", (9.0, 24.0))],
)
def test_a_state_at_the_ends_costs_what_it_adds(name, place, cost):
    """Against the determinant of the whole covariance of the data. The relaxations of four mounts decay alike: their
    states are hardly distinguishable from an impulse on the table. Six states of a sprung mass cost 3.6 nats each at
    most, log(720)/2 + log(2)/2."""
    bare_model = replace(TableModel(bare()), corners_differ=True)
    record, prices = block(bare(), 5), []
    L = np.linalg.inv(np.linalg.cholesky(record.noise))
    for model in (bare_model, bare_model.with_effect(active(library()[name], bare_model, place))):
        columns = whitened(L, transient_columns(model, record.omega)[0]).reshape(
            -1, len(transient_columns(model, record.omega)[1])
        )
        A = np.concatenate([columns.real, columns.imag])
        A = A / np.linalg.norm(A, axis=0)
        whole = 0.5 * np.linalg.slogdet(np.eye(len(A)) + len(A) * A @ A.T)[1]
        prices.append(Transients.of(model, [record], [L]).price)
        assert prices[-1] == pytest.approx(whole, rel=1e-6)
    assert cost[0] < prices[1] - prices[0] < cost[1]


@dataclass(frozen=True, eq=False)
class OneParameter:
    """y = a x on each line."""

    x: np.ndarray
    values: np.ndarray
    names: tuple[str, ...] = ("a",)
    units: tuple[str, ...] = ("1",)
    labels: tuple[str, ...] = ()

    def at(self, values):
        return replace(self, values=np.asarray(values, float))

    def answer(self, block, body=None, derivative=True, inner=None):
        return Driven((self.x * self.values[0])[:, None, None], self.x[None, :, None, None])

    def contributions(self, block):
        return np.zeros((len(block.omega), 1, 1), complex)


@dataclass(frozen=True, eq=False)
class Saturating(OneParameter):
    """y = tanh(a) x on each line."""

    def answer(self, block, body=None, derivative=True, inner=None):
        size = np.tanh(self.values[0])
        return Driven((self.x * size)[:, None, None], (self.x * (1 - size**2))[None, :, None, None])


def fit_of_one(model, estimate, size, low, high, settings):
    """A fit without path errors and with a noise variance of 1; the response `estimate` x was measured."""
    lines = len(model.x)
    omega = 2 * np.pi * np.geomspace(1, 50, lines)
    empty = SpectralBlock("a", omega, np.zeros((lines, 0, 1)), estimate * model.x[:, None, None])
    data = Data((empty.with_noise(np.ones((lines, 1, 1), complex)),), (1.0,))
    first = first_variances(data, settings)
    none = Variances(
        {band: np.full_like(v, 1e-12) for band, v in first.path.items()},
        {group: np.full_like(s, 1e-12) for group, s in first.distortion.items()},
    )
    priors = Priors(("a",), np.zeros(1), np.array([size]), np.zeros(1, bool), np.array([low]), np.array([high]))
    return fit(model, priors, np.zeros(1), data, none, settings)


def unit_columns(lines: int = 40) -> np.ndarray:
    """(lines,) complex, for which a coefficient has a standard deviation of 1."""
    rng = np.random.default_rng(6)
    x = rng.standard_normal(lines) + 1j * rng.standard_normal(lines)
    return np.asarray(x / (np.sqrt(2) * np.linalg.norm(x)))


@pytest.mark.parametrize(
    ("estimate", "low", "high"),
    [
        (5.0, -np.inf, np.inf),
        (5.0, 0.0, np.inf),
        (0.5, 0.0, np.inf),
        (0.0, 0.0, np.inf),
        (-3.0, 0.0, np.inf),
        (8.0, 0.0, 5.0),
        (2.0, 0.0, 3.0),
        (-0.2, -0.5, 0.3),
    ],
)
def test_evidence_within_bounds(estimate, low, high):
    """Of one linear parameter with a standard deviation of 1 and a prior of 10, against quadrature."""
    model, settings = OneParameter(unit_columns(), np.zeros(1)), replace(SETTINGS, rounds=0, converged=1e-12)

    def evidence(size, low, high):
        return fit_of_one(model, estimate, size, low, high, settings).log_evidence

    def density(a):
        return np.exp(a * estimate - a * a / 2) * stats.norm.pdf(a / 10) / 10

    volume = stats.norm.cdf(high / 10) - stats.norm.cdf(low / 10)
    ends = max(low, -60), min(high, 60)
    exact = np.log(integrate.quad(density, *ends, points=[np.clip(estimate, *ends)], limit=400)[0] / volume)
    assert evidence(10.0, low, high) - evidence(1e-9, -np.inf, np.inf) == pytest.approx(exact, abs=1e-3)


def test_evidence_of_a_fit_that_ended_early_at_a_bound_does_not_count_a_maximum_that_it_has_not_reached():
    """At the bound, the slope of tanh predicts that a coefficient of 50 can be reached; the largest is 1."""
    model, settings = Saturating(unit_columns(), np.zeros(1)), replace(SETTINGS, rounds=0)
    early, whole = (
        fit_of_one(model, 50.0, 10.0, 0.0, 5.0, replace(settings, iterations=most)).log_evidence for most in (0, 50)
    )
    assert early < whole


def test_priors_are_normalised_inside_their_bounds():
    one = Priors(
        ("a", "b"),
        np.array([1.0, 2.0]),
        np.array([0.5, 1.0]),
        np.zeros(2, bool),
        np.array([0.0, -np.inf]),
        np.array([1.5, np.inf]),
    )
    inside = stats.norm(1.0, 0.5).cdf(1.5) - stats.norm(1.0, 0.5).cdf(0.0)
    assert one.log_inside == pytest.approx(np.log(inside))


@pytest.mark.parametrize(("information", "low"), [([51.0, 49.0], 1), ([1.0, 1.0, 5.0], 2), ([5.0, 1.0, 1.0], 1)])
def test_halves_exist_whatever_the_division_of_the_information(information, low):
    values = np.arange(float(len(information)))
    (_, below), (_, above) = by_information(values, np.array(information), "low", "high")
    assert list(below) == list(range(low)) and list(above) == list(range(low, len(information)))
    assert by_information(np.ones(3), np.ones(3), "low", "high") == []


def test_sensor_1_is_not_sensor_10():
    one = SimpleNamespace(effect=library()["sensor_gain"], place="S1")
    assert tolerances_behind(one, ("sensor.S1", "sensor.S10", "sensor.S1@x")) == [0]
    one = SimpleNamespace(effect=library()["sensor_misalignment"], place="S1")
    assert tolerances_behind(one, ("direction.S1.x", "direction.S1.y", "direction.S10.x")) == [0, 1]


def test_probabilities_of_equally_good_effects_are_equal():
    """Two effects of the library share the probability; one that is not in it has a tenth of their odds."""

    def fitted(label, outside, gain):
        groups = {(0.2, k): gain / 20 for k in range(20)}
        model = SimpleNamespace(effect=lambda _: SimpleNamespace(outside=outside))
        return SimpleNamespace(labels=(label,), model=model, log_likelihoods=groups, log_evidence=gain)

    tried = {"a@x": fitted("a@x", False, 100.0), "b@x": fitted("b@x", False, 100.0), "c@x": fitted("c@x", True, 100.0)}
    step, settings = Step(fitted("", False, 0.0), tried["a@x"], tried, 3), GapSettings()
    own, found = probability_of(step, settings)[0], probabilities(step, settings)
    assert own == pytest.approx(1 / 2.1)
    assert found["a@x"] == own
    assert found["b@x"] == pytest.approx(1 / 2.1)
    assert found["c@x"] == pytest.approx(0.1 / 2.1)
    other = replace(step, fitted=tried["c@x"], label="c@x")
    assert probability_of(other, settings)[0] == pytest.approx(0.1 / 2.1)


def test_odds_by_how_evenly_two_models_differ():
    groups = [(0.2, k) for k in range(20)]
    none = dict.fromkeys(groups, 0.0)
    even = {group: 3.0 + 0.1 * (k % 3) for k, group in enumerate(groups)}
    uneven = {group: 40.0 if k == 0 else -2.0 for k, group in enumerate(groups)}
    assert odds_against(even, none) < 1e-12
    assert odds_against(uneven, none) > 0.4
    assert odds_against(none, uneven) * odds_against(uneven, none) == pytest.approx(1.0)
    certain = dict.fromkeys(groups, 10.0)
    with np.errstate(all="raise"):
        assert odds_against(certain, none) == 0.0
        assert 1e290 < odds_against(none, certain) < np.inf  # below 38 standard deviations


def test_what_is_beyond_a_tolerance_and_the_tolerance_behind_it():
    model = TableModel(bare())
    priors = with_tolerances(bare(), TOLERANCES)
    for name, place, value, behind in (
        ("sensor_gain", "Sz1", 1.02, ["sensor.Sz1"]),
        ("product_of_inertia", "Jxz", 0.5, ["J13"]),
        ("geophone_corner", "Sy1", None, ["corner.Sy1", "damping.Sy1"]),
    ):
        effect = library()[name]
        none = [p.none for p in effect.parameters(model, place)]
        near = active(effect, model, place, none if value is None else [value])
        assert [priors.names[k] for k in tolerances_behind(near, priors.names)] == behind
        assert within_tolerance(near, TOLERANCES, GapSettings())
        assert not within_tolerance(near.at([v + 0.1 * max(abs(v), 10) for v in none]), TOLERANCES, GapSettings())


@pytest.mark.parametrize(
    ("name", "place", "values", "expected"),
    [
        ("com_offset", "payload", [0.004, 0.0, -0.002], {"com_x": (None, 4.0), "com_z": (None, -2.0)}),
        ("sensor_gain", "Sz1", [1.05], {"sensor.Sz1": (1.05, np.log(1.05) / 0.01)}),
        ("product_of_inertia", "Jxz", [0.8], {"J13": (None, 4.0)}),
        (
            "sensor_misalignment",
            "Sz1",
            [2.0, -1.0],
            {"direction.Sz1.x": (None, np.radians(2) / 0.005), "direction.Sz1.y": (None, -np.radians(1) / 0.005)},
        ),
        ("geophone_corner", "Sy1", None, {"corner.Sy1": (None, np.log(1.1) / 0.01), "damping.Sy1": (None, 0.0)}),
    ],
)
def test_values_beyond_their_tolerance_have_moved_as_their_effect_says(name, place, values, expected):
    """The effect has all of the value: its tolerance is held, and released without it."""
    settings = GapSettings(rounds=0, iterations=0)
    one = active(library()[name], TableModel(bare()), place)
    one = one.at([1.1 * one.values[0], one.values[1]] if values is None else values)
    priors = with_tolerances(bare(), TOLERANCES, settings)
    before = fit(
        TableModel(bare(priors.names)),
        priors,
        np.zeros(len(priors.names)),
        data := Data((block(bare(), 5, 30),), (0.2,)),
        first_variances(data, settings),
        settings,
    )
    fitted = with_effect(before, one, data, settings)
    assert fitted is not None
    rest = without_effect(fitted, one.label, data, settings)
    assert rest is not None
    assert_allclose(rest.priors.sigma, priors.sigma, rtol=1e-12)
    found = {row.parameter: row for row in moved(fitted, list(priors.names), TOLERANCES, settings)}
    nominal = dict(zip(priors.names, priors.mean, strict=True))
    for parameter, (factor, tolerances_moved) in expected.items():
        assert found[parameter].moved == pytest.approx(tolerances_moved, abs=1e-9)
        if factor is not None:
            assert found[parameter].value == pytest.approx(factor * nominal[parameter], rel=1e-9)
    assert sum(abs(row.moved) > 1e-9 for row in found.values()) == sum(z != 0 for _, z in expected.values())
    assert len(found) == len(priors.names)


def test_an_effect_that_those_found_later_replace_is_left_out():
    """Relaxation is fitted to what a delay leaves; beside the delay nothing of it remains."""
    settings, free = replace(GapSettings().quick, rounds=1), default_parameters(RIG)
    model = TableModel(bare(free))
    late = model.with_effect(active(library()["loop_delay"], model, "loop", (1e-3,)))
    data = Data(tuple(block(late, seed, noise=1e-6) for seed in (5, 6)), (0.2, 0.5))
    priors = re_identified(RIG, settings)
    now, steps = fit(model, priors, priors.z(model.values), data, first_variances(data, settings), settings), []
    for name, place in (("mount_relaxation", "isolators z"), ("loop_delay", "loop")):
        start = active(library()[name], now.model, place)
        after = with_effect(now, start, data, settings)
        steps.append(Step(now, after, {}, 2))
        now = after
    relaxation, delay = now.labels
    assert is_weak(now, relaxation, settings) and not is_weak(now, delay, settings)
    kept, rest = backward_elimination(steps, now, data, settings)
    assert [step.label for step in kept] == [delay] == list(rest.labels)
    assert rest.model.effects[-1].values[0] == pytest.approx(1e-3, rel=0.02)


def test_the_standard_deviation_of_a_leveling_rate_allows_for_a_loss_too_small_to_be_detected():
    """At 2 Hz, a loss factor of 0.001 acts like a rate lower by 0.002 Hz; the mounts' dampings absorb the rest."""
    settings, free = replace(GapSettings().quick, rounds=2), default_parameters(RIG)
    model = TableModel(bare(free))
    leveled = model.with_effect(active(library()["leveling_loop"], model, "isolators 1-3 z/plain", (0.03,)))
    truth = leveled.with_effect(active(library()["structural_damping"], model, "isolators/complex", (1e-3,)))
    data = Data(tuple(block(truth, seed, noise=3e-5) for seed in (5, 6)), (0.2, 0.2))
    priors = re_identified(RIG, settings)
    now = fit(model, priors, priors.z(model.values), data, first_variances(data, settings), settings)
    now = with_effect(now, active(library()["leveling_loop"], model, "isolators 1-3 z/plain"), data, settings)
    wider = with_undetected(now, list(library().values()), data, settings)
    (rate,) = now.model.effects[0].names
    error = now.model.effects[0].values[0] - 0.03
    plain, allowing = (float(np.sqrt(one.covariance_of([rate])[0, 0])) for one in (now, wider))
    assert_array_equal(wider.z[:-1], now.z)
    assert wider.labels[:-1] == now.labels
    assert error < -3 * plain
    assert abs(error) < 2 * allowing
    with_it = with_undetected(wider, list(library().values()), data, settings)
    assert with_it is wider


def test_a_channel_knows_its_mount_wherever_it_is_listed():
    table = load_rig("avis")
    for one in (*table.all_drives, *table.sensors()):
        assert RIG.mount_of(one.name) == table.mount_of(one.name)
    assert RIG.mount_of("Az1") == ("isolator1.z", 1.0)
    away = RIG.with_parameters({"place.Az1.x": RIG.parameters()["place.Az1.x"].value + 0.2})
    assert away.mount_of("Az1") is None


def test_corners_within_their_tolerance_are_kept_in_a_model_file():
    base = ResponseModel.of(RIG, ("corner.Sz1", "damping.Sy3"))
    model = TableModel(base.at(base.values * [1.03, 0.9]))
    omega = 2 * np.pi * np.geomspace(0.5, 50, 20)
    again, _ = model_from_dict(json.loads(json.dumps(model_to_dict(model))))
    assert_allclose(again.response(omega), model.response(omega), rtol=1e-12)
    assert np.max(np.abs(again.response(omega) / TableModel(base).response(omega) - 1)) > 0.01


@pytest.mark.slow
def test_a_lagging_amplifier_is_named_on_a_table_that_is_off_its_file_in_everything():
    """An independent simulator: tolerances drawn, traces of friction, stiffening and hum always on."""
    from truth.cases import draw_case, simulate_case

    case = draw_case(41, kind="one", effect="actuator_lag", strength="clear", duration_s=30.0, clutter=True)
    rig = replace(load_rig("avis"), tolerances=TOLERANCES)
    gap = find_gap(simulate_case(case), rig).gap
    first, told = gap.effects[0], {one.name: one.parameters for one in gap.effects}
    assert first.name == "actuator_lag" and first.probability > 0.9 and gap.verdict == "explained"
    # This amplifier has two poles. A lag with one, and a delay beside it, must have the same delay at low frequency.
    assert case.effects[0].details["variant"] == "second_order"
    delay = 1 / (2 * np.pi * told["actuator_lag"]["corner_Hz"].value) + told["loop_delay"]["extra_delay_s"].value
    assert delay == pytest.approx(1 / (2 * np.pi * case.effects[0].parameters["corner_Hz"]), rel=0.01)
    assert {one.name: one.nrmse for one in gap.stages}["re-identified"] > 2 * gap.stages[-1].nrmse
    assert gap.to_json()["remaining"]["share"] < 0.1
