"""The new likelihood of the gap engine: priors, path errors, evidence; against dense algebra and by differences."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.model_files import model_from_dict, model_to_dict
from avis_ctrl.gap.probability import odds_against
from avis_ctrl.gap.settings import SETTINGS, GapSettings
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.gap.tolerances import tolerances_behind, within_tolerance
from avis_ctrl.gap.validation import halves, widening
from avis_ctrl.identification.likelihood import Data, first_variances, fit
from avis_ctrl.identification.priors import Priors, re_identified, with_tolerances
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.weights import Variances, estimated, path_contributions, weigh
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


@pytest.mark.parametrize("name", ["place.Ay1.x", "place.Sz3.y", "direction.Az2.x", "direction.Sx2.z", "actuator.Ax4",
                                  "sensor.Sy1", "corner.Sz1", "damping.Sy3", "com_z", "J13", "isolator2.p_x"])
def test_derivatives_by_tolerances_are_those_of_differences(name):
    model = bare((name,))
    omega, U = 2 * np.pi * np.geomspace(0.5, 80, 40), np.random.default_rng(1).standard_normal((40, 11, 2)) + 0j
    value, = model.values
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


def test_path_errors_are_integrated_out_as_a_dense_covariance_would_do():
    """Quadratic form and determinant against a complex covariance written out."""
    settings, model, one = GapSettings(bands_per_octave=1), bare(), block(bare(), 3, 12)
    found = first_variances(Data((one,), (0.2,)), settings)
    path = {group: np.linspace(0.5, 2, 6) * v for group, v in found.path.items()}
    variances = Variances(path, found.distortion)
    weights = weigh([one], [0.2], [path_contributions(model, one)], variances, settings)
    rng = np.random.default_rng(4)
    e = rng.standard_normal((12, 6)) + 1j * rng.standard_normal((12, 6))
    white = np.einsum("kij,kj->ki", weights.L[0], e)
    flat = weights.flatten(np.concatenate([white.real.ravel(), white.imag.ravel()])[None])[0]
    C = np.zeros((72, 72), complex)
    G = path_contributions(model, one)
    band = np.floor(np.log2(one.omega) + 1e-9).astype(int)
    for k in range(12):
        own = found.distortion[0.2, int(band[k])]
        C[6 * k:6 * k + 6, 6 * k:6 * k + 6] += 1e-3 * np.eye(6) + np.diag(own)
        for m in np.flatnonzero(band == band[k]):
            for c in range(6):
                C[6 * k + c, 6 * m + c] += path[0.2, int(band[k])][c] * (G[k, c] @ G[m, c].conj())
    assert flat @ flat == pytest.approx(2 * np.real(e.ravel().conj() @ np.linalg.solve(C, e.ravel())), rel=1e-9)
    assert weights.log_determinant == pytest.approx(2 * np.linalg.slogdet(C)[1], rel=1e-9)


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
    start = replace(first_variances(data, settings), path={k: np.full(6, 1e-6) for k in
                                                          first_variances(data, settings).path})
    found = fit(model, priors, np.zeros(len(truth)), data, start, settings)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.max(np.abs(found.z - truth) / sigma) < 4.5
    assert np.all(sigma <= 1 + 1e-9)


def test_parameters_stay_within_their_bounds():
    priors = Priors(("a", "b"), np.array([0.0, 1.0]), np.array([1.0, 0.1]), np.array([False, True]),
                    np.array([-0.5, 0.0]), np.array([0.5, 2.0]))
    assert_allclose(priors.values(np.array([3.0, 1.0])), [0.5, np.exp(0.1)])


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
    little = Variances({group: 1e-4 * v for group, v in first.path.items()},
                       {group: 1e-9 * s for group, s in first.distortion.items()})
    return fit(model, priors, np.zeros(1), data, little, settings), data, settings


def test_normal_equations_are_those_of_the_flattened_rows():
    found, _, _ = found_at()
    J = np.random.default_rng(3).standard_normal((5, len(found.e)))
    H, g, cost = found.weights.normal_equations(J, found.white.e)
    flat = found.weights.flatten(J)
    assert_allclose(H, flat @ flat.T, rtol=1e-9, atol=1e-9 * np.abs(H).max())
    assert_allclose(g, flat @ found.e, rtol=1e-9, atol=1e-9 * np.abs(g).max())
    assert cost == pytest.approx(found.e @ found.e, rel=1e-9)
    assert sum(found.log_likelihoods.values()) == pytest.approx(-0.5 * (cost + found.weights.log_determinant))


def test_variances_are_the_most_likely_ones():
    """Against a general optimiser on the dense covariance of one sensor in one band."""
    settings, rng = GapSettings(bands_per_octave=1, climbs=2000), np.random.default_rng(5)
    omega, noise = 2 * np.pi * np.linspace(2.6, 5.0, 30), 1e-4
    U = np.zeros((30, 11, 1), complex)
    U[:, :3, 0] = np.exp(2j * np.pi * rng.uniform(size=(30, 3)))
    path = np.zeros((30, 6, 11), complex)
    path[:, :, :3] = rng.standard_normal((30, 6, 3)) + 1j * rng.standard_normal((30, 6, 3))
    circular = rng.standard_normal((2, 30, 6)) / np.sqrt(2)
    errors = 0.05 * (rng.standard_normal((6, 3)) + 1j * rng.standard_normal((6, 3))) / np.sqrt(2)
    e = np.einsum("kcj,cj->kc", path[:, :, :3], errors) + 0.03 * (circular[0] + 1j * circular[1])
    whole = np.broadcast_to(noise * np.eye(6, dtype=complex), (30, 1, 6, 6))
    one = SpectralBlock("01", omega, U, e[:, :, None], whole, transient=False, samples=60000)
    band = int(np.floor(np.log2(omega[0]) + 1e-9))
    assert np.all(np.floor(np.log2(omega) + 1e-9) == band)
    start = Variances({(0.2, band): np.full(6, 1e-2)}, {(0.2, band): np.full(6, 1e-3)})
    found = estimated([e], [one], [0.2], [path], start, settings)
    nu, v0 = settings.error_weight, settings.least_error ** 2

    def cost(x, c):
        v, s = np.exp(x)
        C = (noise + s) * np.eye(30) + v * path[:, c] @ path[:, c].conj().T
        return float(np.real(e[:, c].conj() @ np.linalg.solve(C, e[:, c])) + np.linalg.slogdet(C)[1]
                     + (nu / 2 + 1) * x[0] + nu * v0 / (2 * v))
    for c in range(6):
        best = minimize(cost, np.log([1e-3, 1e-3]), args=(c,), method="Nelder-Mead",
                        options={"xatol": 1e-6, "fatol": 1e-9, "maxiter": 4000})
        assert_allclose(np.log([found.path[0.2, band][c], found.distortion[0.2, band][c]]), best.x, atol=0.02)


@pytest.mark.parametrize("lines", [60, 8])
def test_variances_of_a_table_are_those_of_the_whole_space(lines):
    """Against the same steps with every direction of the residual written out; more and fewer lines than inputs."""
    settings, model, one = GapSettings(bands_per_octave=1), bare(), block(bare(), 6, lines)
    start, G = first_variances(Data((one,), (0.2,)), settings), path_contributions(model, one)
    rng = np.random.default_rng(7)
    e = 0.05 * (rng.standard_normal((lines, 6)) + 1j * rng.standard_normal((lines, 6)))
    found = estimated([e], [one], [0.2], [G], start, settings)
    band = np.floor(np.log2(one.omega) + 1e-9).astype(int)
    nu, v0 = settings.error_weight, settings.least_error ** 2
    for b in np.unique(band):
        at = band == b
        for c in range(6):
            size, U = np.linalg.eigh(G[at, c] @ G[at, c].conj().T)
            size, power = np.maximum(size, 0), np.abs(U.conj().T @ e[at, c]) ** 2
            v, s = (x[c] for x in start.of((0.2, int(b))))
            for _ in range(settings.climbs):
                w = 1e-3 + s + v * size
                v *= np.sqrt((np.sum(size * power / w ** 2) + nu * v0 / (2 * v ** 2))
                             / (np.sum(size / w) + (nu / 2 + 1) / v))
                s *= np.sqrt(np.sum(power / w ** 2) / np.sum(1 / w))
                s = max(s, settings.least_distortion * 1e-3)
            assert_allclose([found.path[0.2, b][c], found.distortion[0.2, b][c]], [v, s], rtol=1e-6)


def test_a_parameter_that_moves_with_the_band_refutes_its_law():
    good, bent = (halves(found, ("sensor.Sz1",), settings) for found, _, settings in (found_at(), found_at(bend=0.3)))
    assert min(one.p_value for one in good) > 1e-3
    assert max(one.change for one in bent) > 0.05 and min(one.p_value for one in bent) < 1e-4
    assert widening(good, SETTINGS) == 1.0
    worst = max(bent, key=lambda one: one.chi2 / one.dof)
    assert widening(bent, SETTINGS) == pytest.approx(np.sqrt(worst.chi2 / worst.dof)) and worst.chi2 / worst.dof > 10
    assert {one.words for one in bent} == {"the lower part of the band", "the upper part of the band"}


def test_odds_by_how_evenly_two_models_differ():
    groups = [(0.2, k) for k in range(20)]
    none = dict.fromkeys(groups, 0.0)
    even = {group: 3.0 + 0.1 * (k % 3) for k, group in enumerate(groups)}
    uneven = {group: 40.0 if k == 0 else -2.0 for k, group in enumerate(groups)}
    assert odds_against(even, none) < 1e-12
    assert odds_against(uneven, none) > 0.4
    assert odds_against(none, uneven) * odds_against(uneven, none) == pytest.approx(1.0)


def test_what_is_beyond_a_tolerance_and_the_tolerance_behind_it():
    model = TableModel(bare())
    priors = with_tolerances(bare(), TOLERANCES)
    for name, place, value, behind in (("sensor_gain", "Sz1", 1.02, ["sensor.Sz1"]),
                                       ("product_of_inertia", "Jxz", 0.5, ["J13"]),
                                       ("geophone_corner", "Sy1", None, ["corner.Sy1", "damping.Sy1"])):
        effect = library()[name]
        none = [p.none for p in effect.parameters(model, place)]
        near = active(effect, model, place, none if value is None else [value])
        assert [priors.names[k] for k in tolerances_behind(near, priors.names)] == behind
        assert within_tolerance(near, TOLERANCES, GapSettings())
        assert not within_tolerance(near.at([v + 0.1 * max(abs(v), 10) for v in none]), TOLERANCES, GapSettings())


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
    first = gap.effects[0]
    corner = first.parameters["corner_Hz"]
    assert first.name == "actuator_lag" and first.probability > 0.9 and gap.verdict == "explained"
    assert corner.value == pytest.approx(case.effects[0].parameters["corner_Hz"], rel=0.01)
    assert {one.name: one.nrmse for one in gap.stages}["re-identified"] > 2 * gap.stages[-1].nrmse
    assert gap.to_json()["remaining"]["share"] < 0.1
