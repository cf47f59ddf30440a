"""The new likelihood of the gap engine: priors, path errors, evidence; against dense algebra and by differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from avis_ctrl.gap_engine.likelihood import Data, first_variances, fit
from avis_ctrl.gap_engine.settings import GapSettings
from avis_ctrl.gap_engine.tolerances import Priors, re_identified, with_tolerances
from avis_ctrl.gap_engine.weights import Variances, path_contributions, weigh
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import SpectralBlock
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.instruments import Tolerances

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
