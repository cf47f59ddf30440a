"""The maximum likelihood fit against known truths, a general optimiser, and the statistics that it claims."""

from dataclasses import replace

import numpy as np
import pytest
from exact import floor_velocity, multisine, record
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_law

from avis_ctrl.errors import InputError
from avis_ctrl.identification import campaign_fit
from avis_ctrl.identification.maximum_likelihood import SETTINGS, fit, whitened_real
from avis_ctrl.identification.noise import noise_from_residuals, relative_noise
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import SETTINGS as SPECTRA
from avis_ctrl.identification.spectra import record_block, response_block, span
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs.logical_axes import actuator_axes

MOUNTS = [f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "xyz"]
BODY = ["mass", "J1", "J2", "J3"]


def responses(model, noise=0.01, seed=0, lines=200):
    """A block of frequency responses with white relative noise, and its covariance."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * np.geomspace(0.7, 60, lines)
    U = np.zeros((lines, len(model.inputs), len(model.actuators)), complex)
    U[:, : len(model.actuators)] = np.eye(len(model.actuators))
    Y = model.driven(w, U, False).Y
    size = noise * np.sqrt(np.mean(np.abs(Y) ** 2, axis=(1, 2)))
    e = rng.normal(size=Y.shape) + 1j * rng.normal(size=Y.shape)
    n_y = Y.shape[1]
    return SpectralBlock("frf", w, U, Y + size[:, None, None] * e / np.sqrt(2)).with_noise(
        size[:, None, None] ** 2 * np.eye(n_y)
    )


def off(model, seed, spread=0.1):
    rng = np.random.default_rng(seed)
    return model.at(model.values * (1 + spread * rng.uniform(-1, 1, len(model.names))))


def test_exact_data_give_exact_parameters(avis):
    """Without noise, what is determined is found to rounding; what is not stays off and costs nothing."""
    true = ResponseModel.of(avis, [*BODY, *MOUNTS])
    block = responses(true, noise=1e-12)
    found = fit(off(true, 1), [block.with_noise(np.abs(block.noise[:, 0]) * 1e20)])
    _, V = found.information.directions
    relative = V.T @ ((found.values - true.values) / found.information.scale)
    assert found.information.rank == 20 and found.converged
    assert np.max(np.abs(relative[:20])) < 1e-6


def test_the_optimum_is_that_of_a_general_optimiser(avis):
    """scipy's trust region with differences, on a few parameters: same chi-square and the same place."""
    names = ["mass", "J1", "isolator1.k_z", "isolator2.c_z", "sensor.Sz1"]
    true = ResponseModel.of(avis, names)
    block = responses(true, lines=40)
    found = fit(off(true, 2), [block])

    def residual(x):
        e = block.Y - true.at(x * true.values).driven(block.omega, block.U, False).Y
        white = e / np.sqrt(block.noise[:, 0, 0, 0].real)[:, None, None] * np.sqrt(2)
        return np.concatenate([white.real.ravel(), white.imag.ravel()])

    other = least_squares(residual, np.full(len(names), 1.05), x_scale="jac")
    assert found.chi2 == pytest.approx(2 * other.cost, rel=1e-9)
    assert np.allclose(found.values, other.x * true.values, rtol=1e-6)
    J = other.jac / true.values
    assert np.allclose(found.information.matrix, J.T @ J, rtol=1e-3, atol=1e-3 * np.max(J.T @ J))


def test_chi_square_and_errors_are_what_they_claim(avis):
    """Over 16 draws: chi-square within its law, errors normalised by the Cramer-Rao bound standard normal."""
    names = [*BODY, *MOUNTS]
    true = ResponseModel.of(avis, names)
    totals, z, dof = [], [], 0
    for seed in range(16):
        found = fit(off(true, seed, 0.05), [responses(true, seed=seed, lines=30)])
        sigma, V = found.information.directions
        error = V.T @ ((found.values - true.values) / found.information.scale)
        # Directions far from being linear in their parameters would need a larger sample.
        z.append((error / sigma)[:20])
        totals.append(found.chi2)
        dof = found.dof
    assert chi2_law.ppf(1e-4, 16 * dof) < np.sum(totals) < chi2_law.ppf(1 - 1e-4, 16 * dof)
    spread = np.mean(np.square(z))
    assert abs(spread - 1) < 4 * np.sqrt(2 / np.size(z))


def test_estimated_weights_cost_what_the_deviations_say(avis):
    """A covariance of 16 degrees of freedom for 6 outputs on every line: errors 1.27 times those of known weights."""
    true = ResponseModel.of(avis, ["mass", "J1", "isolator1.k_z", "isolator1.c_z"])
    rng = np.random.default_rng(11)

    def circular(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    lines, dof = 30, 16
    mix, w = 1e-3 * circular(6, 6), 2 * np.pi * np.geomspace(0.8, 20, lines)
    U = np.zeros((lines, len(true.inputs), 2), complex)
    U[:, 1, 0] = U[:, 3, 1] = 1
    Y, z = true.driven(w, U, False).Y, []
    mix = mix * np.sqrt(np.mean(np.abs(Y) ** 2)) * 20
    for _ in range(60):
        samples = mix @ circular(lines, 6, dof)
        noise = samples @ np.conj(samples.swapaxes(1, 2)) / dof
        found = fit(true, [SpectralBlock("frf", w, U, Y + mix @ circular(*Y.shape)).with_noise(noise, dof)])
        sigma, V = found.information.directions
        z.append(V.T @ ((found.values - true.values) / found.information.scale) / sigma)
    assert abs(np.mean(np.square(z)) - 1) < 4 * np.sqrt(2 / np.size(z))


def test_a_parameter_at_its_bound_leaves_the_others_at_their_optimum(avis):
    """A mount without damping, which noise makes negative: chi-square as with the damping fixed there."""
    names = ["mass", "J1", "isolator1.k_z", "isolator1.c_z"]
    bare = avis.with_parameters({"isolator1.c_z": 1e-3})
    true, fixed = ResponseModel.of(bare, names), ResponseModel.of(bare, names[:3])
    block = responses(true, noise=0.3, seed=3, lines=60)
    start = ResponseModel.of(avis, names).at([520, 30, 46e3, 160])
    met = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        size = np.sqrt(block.noise[:, 0, :1, :1].real / 2)
        Y = true.driven(block.omega, block.U, False).Y
        Y = Y + size * (rng.normal(size=Y.shape) + 1j * rng.normal(size=Y.shape))
        noisy = SpectralBlock("frf", block.omega, block.U, Y, block.noise)
        found, other = fit(start, [noisy]), fit(fixed.at([520, 30, 46e3]), [noisy])
        if found.held:
            met += 1
            assert found.held == ("isolator1.c_z",) and found.converged
            assert found.chi2 == pytest.approx(other.chi2, abs=0.01)
            assert np.allclose(found.values[:3], other.values, rtol=1e-4)
    assert met >= 2


def test_a_fit_goes_on_from_a_parameter_near_zero(avis):
    """The steps keep the scale of the first start: in steps of half a tiny value the fit would make no progress."""
    names = ["mass", "J1", "isolator1.k_z", "isolator1.c_z"]
    true = ResponseModel.of(avis, names)
    block, start = responses(true, lines=60), true.at([520, 30, 46e3, 160])
    found, other = fit(start.at([520, 30, 46e3, 1e-7]), [block], about=start), fit(start, [block])
    assert found.converged and found.iterations <= 12
    assert found.chi2 == pytest.approx(other.chi2, rel=1e-9)
    assert np.allclose(found.information.matrix, other.information.matrix, rtol=1e-3)
    assert np.allclose(found.information.standard_deviation, other.information.standard_deviation, rtol=1e-3)


def test_a_moment_of_inertia_stops_at_the_sum_of_the_others(avis):
    """Data of an impossible body: the fit ends at the optimum that scipy finds with J3 = J1 + J2."""
    names = ["mass", "J1", "J2", "J3", "isolator1.k_z"]
    true = ResponseModel.of(avis, names)
    true = true.at(true.values * np.array([1.0, 1.0, 1.0, 1.3, 1.0]))  # J3 61 -> 79.3, J1 + J2 = 71.2
    block = responses(true, lines=40)
    start = ResponseModel.of(avis, names)
    found = fit(start, [block])
    value = dict(zip(names, found.values, strict=True))
    assert value["J3"] == pytest.approx(value["J1"] + value["J2"], rel=1e-5) and value["J3"] < value["J1"] + value["J2"]
    assert found.held == ("J3",) and found.converged

    room = value["J1"] + value["J2"] - value["J3"]

    def residual(x):
        e = (
            block.Y
            - true.at(np.array([x[0], x[1], x[2], x[1] + x[2] - room, x[3]])).driven(block.omega, block.U, False).Y
        )
        white = e / np.sqrt(block.noise[:, 0, 0, 0].real)[:, None, None] * np.sqrt(2)
        return np.concatenate([white.real.ravel(), white.imag.ravel()])

    other = least_squares(residual, found.values[[0, 1, 2, 4]] * 1.02, x_scale="jac", xtol=1e-14, ftol=1e-14)
    assert found.chi2 == pytest.approx(2 * other.cost, rel=1e-5)
    assert np.allclose(found.values[[0, 1, 2, 4]], other.x, rtol=1e-4)

    # The rig file of a thin plate: the fit starts at the sum itself, or beside it by round-off.
    mass, J1, J2, _, k_z = start.values
    for aside in (-1e-13, 0.0, 1e-13):
        thin = fit(start.at([mass, J1, J2, J1 + J2 + aside, k_z]), [block])
        assert thin.held == ("J3",) and thin.converged
        assert thin.chi2 == pytest.approx(found.chi2, rel=1e-4)


def test_of_too_many_lines_some_driven_ones_are_fitted(avis, monkeypatch):
    """A multisine of two periods has every other line driven; of 200 of these 100 are drawn, and told."""
    model = ResponseModel.of(avis, ["mass"])
    rng = np.random.default_rng(12)
    u = multisine(rng, 0.3, 5000, 2, (10.0, 29.9))
    one = record(avis, u, np.zeros((len(u), 3)), rng, period_s=5.0)
    campaign = Campaign("avis", (one, replace(one, header=replace(one.header, name="01"))))
    monkeypatch.setattr(campaign_fit, "SETTINGS", campaign_fit.CampaignFitSettings(most_lines=100))
    blocks, said = campaign_fit.campaign_blocks(campaign, model, (10.0, 30.0))
    assert [len(block.omega) for block in blocks] == [50, 50] and "100 of 400 spectral lines" in said[0]
    lines = np.rint(blocks[0].omega * 10 / (2 * np.pi)).astype(int)
    assert np.all(lines % 2 == 0) and np.all(np.diff(lines) > 0)
    monkeypatch.setattr(campaign_fit, "SETTINGS", campaign_fit.CampaignFitSettings(most_lines=1000))
    assert len(campaign_fit.campaign_blocks(campaign, model, (10.0, 30.0))[0][0].omega) == 201


def test_eight_drives_played_along_six_axes_are_fitted_like_any(avis, monkeypatch):
    """Noise is measured, few lines are enough, and the body is found; no response of each drive is asked for."""
    true = ResponseModel.of(avis, BODY).at([510.0, 28.0, 43.0, 62.0])
    rng, axes = np.random.default_rng(15), actuator_axes(avis)
    records = []
    for k in range(3):
        u = multisine(rng, 1.0, 8000, 1, (2.0, 25.0), 6) @ axes.allocation.T
        u *= 0.3 / np.sqrt(np.mean(u**2))
        records.append(record(true.rig, u, floor_velocity(rng, len(u), 1e-6), rng, name=f"{k:02d}"))
    monkeypatch.setattr(campaign_fit, "SETTINGS", campaign_fit.CampaignFitSettings(most_lines=300))
    found = campaign_fit.fit_campaign(
        Campaign("avis", tuple(records)), ResponseModel.of(avis, BODY), (2.0, 25.0), reweights=1
    )
    assert found.measured and any("of 552 spectral lines are fitted" in note for note in found.notes)
    assert 0.6 < found.first.chi2_per_dof < 1.4
    assert np.allclose(found.fit.values, true.values, rtol=1e-3)


@pytest.mark.slow
def test_records_of_a_rig_with_floor_motion(avis):
    """Three records of 60 s, floor unknown: errors as small as claimed, every one of 20 directions."""
    true = off(ResponseModel.of(avis, [*BODY, *MOUNTS]), 5, 0.05)
    rng = np.random.default_rng(6)
    records = []
    for k in range(3):
        u = multisine(rng, 0.3)
        records.append(record(true.rig, u, floor_velocity(rng, len(u)), rng, name=f"{k:02d}"))
    model = ResponseModel.of(avis, true.names)
    blocks = relative_noise([record_block(one, model, (0.5, 60.0)) for one in records])
    for _ in range(3):
        found = fit(model, blocks)
        model, blocks = found.model, noise_from_residuals(found.residuals, blocks, found.model)
    found = fit(model, blocks)
    sigma, V = found.information.directions
    z = (V.T @ ((found.values - true.values) / found.information.scale) / sigma)[:20]
    assert found.information.rank == 20
    assert np.mean(z**2) < 2.2 and np.max(np.abs(z)) < 4.5
    known = found.information.known
    assert np.all(np.abs(found.values - true.values)[known] < 1e-3 * true.values[known])


def test_a_prior_and_data_share_out_by_their_precision(avis):
    """Conjugate normal law: with the rest known, the estimate is the weighted mean and precisions add."""
    true = ResponseModel.of(avis, ["mass"])
    block = responses(true, noise=0.05, lines=20)
    alone = fit(true, [block])
    sigma = float(alone.information.standard_deviation[0])
    prior = (alone.values[0] + sigma, sigma)
    both = fit(true, [block], priors={"mass": prior})
    assert both.values[0] == pytest.approx((alone.values[0] + prior[0]) / 2, abs=0.01 * sigma)
    assert both.information.standard_deviation[0] == pytest.approx(sigma / np.sqrt(2), rel=0.02)


def test_priors_make_everything_determined(avis):
    names = [*BODY, *MOUNTS]
    true = ResponseModel.of(avis, names)
    priors = {name: (value, 0.2 * value) for name, value in zip(names, true.values, strict=True)}
    found = fit(off(true, 3), [responses(true)], priors=priors)
    assert found.information.rank == len(names)
    k = names.index("isolator1.k_x")
    assert 0.05 < found.information.standard_deviation[k] / true.values[k] < 0.2


def test_several_starts_agree(avis):
    true = ResponseModel.of(avis, [*BODY, *MOUNTS])
    found = fit(true, [responses(true, lines=60)], starts=4, spread=0.25)
    assert np.ptp(found.starts) < 1e-3 * min(found.starts)


def test_a_measured_response_weighs_like_its_experiments(avis):
    """FRFs with a Gram matrix, and the same data as records, hold the same information."""
    rng = np.random.default_rng(4)
    model = ResponseModel.of(avis, BODY)
    w = 2 * np.pi * np.geomspace(1, 40, 15)
    W = rng.normal(size=(15, 8, 10)) + 1j * rng.normal(size=(15, 8, 10))
    C = np.eye(6) * 1e-8
    U = np.zeros((15, 11, 10), complex)
    U[:, :8] = W
    Y = model.driven(w, U, False).Y + 1e-5 * rng.normal(size=(15, 6, 10))
    direct = fit(model, [SpectralBlock("records", w, U, Y).with_noise(np.broadcast_to(C, (15, 6, 6)))])
    gram = W @ np.conj(W.swapaxes(1, 2))
    G = Y @ np.conj(W.swapaxes(1, 2)) @ np.linalg.inv(gram)
    measured = FrequencyResponse(
        w / (2 * np.pi), G, np.broadcast_to(C, (15, 6, 6)), gram, model.actuators, model.sensors.names
    )
    through = fit(model, [response_block(measured, model)])
    assert np.allclose(through.values, direct.values, rtol=1e-9)
    assert np.allclose(through.information.matrix, direct.information.matrix, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"priors": {"weight": (1.0, 1.0)}}, "free parameter"),
        ({"priors": {"mass": (1.0, 0.0)}}, "standard deviation"),
        ({"starts": 0}, "start"),
        ({"blocks": []}, "record"),
    ],
)
def test_wrong_calls_are_answered(avis, change, said):
    model = ResponseModel.of(avis, ["mass"])
    arguments = {"model": model, "blocks": [responses(model, lines=5)]} | change
    with pytest.raises(InputError, match=said):
        fit(**arguments)


def test_noise_that_is_singular_is_answered(avis):
    model = ResponseModel.of(avis, ["mass"])
    block = responses(model, lines=5)
    with pytest.raises(InputError, match="positive definite"):
        fit(model, [block.with_noise(np.zeros((5, 6, 6)))])


@pytest.mark.parametrize("apart", [1.0, 1e-2, 1e-5, 1e-9])
def test_span_of_columns_however_close(apart, rng):
    """Against the singular vectors of the columns themselves."""
    columns = rng.normal(size=(400, 7))
    columns[:, 3] = columns[:, 2] + apart * columns[:, 3]
    columns /= np.linalg.norm(columns, axis=0)
    Q, X = span(columns)
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    rank = 6 if apart < SPECTRA.dependent else 7
    assert Q.shape == (400, rank)
    np.testing.assert_allclose(Q.T @ Q, np.eye(rank), atol=1e-13)
    np.testing.assert_allclose(Q @ Q.T, U[:, :rank] @ U[:, :rank].T, atol=1e-15 * s[0] / s[rank - 1] + 1e-14)
    np.testing.assert_allclose(columns @ X, Q, atol=1e-14 * s[0] / s[rank - 1])


@pytest.mark.parametrize("m", [1, 3])
@pytest.mark.parametrize("each", [False, True])
def test_many_are_whitened_as_one(m, each, rng):
    """One line and experiment after the other, more lines than fit in one go, none left over or twice."""
    n, p = 2 * SETTINGS.at_once + 5, 4
    L, dY = (
        rng.normal(size=shape) + 1j * rng.normal(size=shape) for shape in ((n, m if each else 1, 6, 6), (p, n, 6, m))
    )
    white = np.zeros_like(dY)
    for k in range(n):
        for i in range(m):
            white[:, k, :, i] = dY[:, k, :, i] @ L[k, i if each else 0].T
    flat = white.reshape(p, -1)
    np.testing.assert_allclose(whitened_real(L, dY), np.hstack([flat.real, flat.imag]), rtol=1e-12, atol=1e-12)
