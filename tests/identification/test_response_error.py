"""The spread of a measured response: known errors, the confidence that it claims, what records leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import floor_velocity, record

from avis_ctrl.errors import InputError
from avis_ctrl.identification.model_error import measured_response, unexplained
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.response_error import FrfSpread, frf_spread, kept_axes
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs import load_rig

KEEP = ("z", "phi_x")


@pytest.fixture(scope="module")
def model():
    return ResponseModel.of(load_rig("avis"), ["mass"])


def exact(model, value, frequency_Hz, level=1e-12, dof=np.inf) -> FrequencyResponse:
    n, n_y, n_u = value.shape
    noise = np.broadcast_to(level**2 * np.eye(n_y, dtype=complex), (n, n_y, n_y))
    gram = np.broadcast_to(np.eye(n_u, dtype=complex), (n, n_u, n_u))
    return FrequencyResponse(frequency_Hz, value, noise, gram, model.actuators, model.sensors.names, dof=dof)


def noisy(model, frequency_Hz, level, rng, error=None) -> FrequencyResponse:
    """The model's response, an error on its drives, and noise whose size differs by sensor and by drive."""
    G = model.response(2 * np.pi * frequency_Hz)[:, :, : len(model.actuators)]
    if error is not None:
        G = G @ error
    n, n_y, n_u = G.shape
    root = level * (np.eye(n_y) + 0.4 * rng.normal(size=(n_y, n_y)))
    W = np.eye(n_u) + 0.3 * rng.normal(size=(n_u, n_u))
    Z = (rng.normal(size=(n, n_y, n_u)) + 1j * rng.normal(size=(n, n_y, n_u))) / np.sqrt(2)
    C, S = root @ root.T, W @ W.T
    # Covariance of vec(G) is inv(S)^T kron C: columns mixed by inv(W).
    value = G + root @ Z @ np.linalg.inv(W)
    spread = [np.broadcast_to(X.astype(complex), (n, *X.shape)) for X in (C, S)]
    return FrequencyResponse(frequency_Hz, value, spread[0], spread[1], model.actuators, model.sensors.names)


@pytest.mark.parametrize("played", ["axes", "without a drive"])
def test_drives_that_are_not_played_apart_leave_the_spread_of_what_they_do_together(model, played, rng):
    """Of a response that is known along six axes, or of seven drives, alone; whatever it says of the rest is noise."""
    A, _ = kept_axes(model.rig, KEEP, model.actuators, model.sensors.names)
    f = np.geomspace(0.5, 60, 12)
    L = 0.1 * np.array([[0.3, -0.2], [0.1, 0.4]])
    T = model.matrices.T
    # Whatever makes the forces of the kept axes makes L of them, too.
    error = np.eye(8) + np.linalg.pinv(T) @ T @ A @ L @ np.linalg.pinv(T @ A) @ T
    measured = exact(model, model.response(2 * np.pi * f)[:, :, :8] @ error, f)
    if played == "axes":
        span = np.linalg.svd(np.linalg.pinv(T))[0][:, :6]
        junk = rng.normal(size=(12, 6, 8)) @ (np.eye(8) - span @ span.T)
        measured = replace(measured, value=measured.value + junk, gram=np.array([span @ span.T] * 12, complex))
    else:
        measured = replace(
            measured, value=measured.value[:, :, 1:], gram=measured.gram[:, 1:, 1:], inputs=measured.inputs[1:]
        )
    spread = frf_spread(measured, model, KEEP, (0.9,))
    assert np.allclose(spread.measured, np.linalg.norm(L, ord=2), rtol=1e-6) and len(spread.frequency_Hz) == 12


def test_axes_that_no_record_pushes_are_named(model):
    """Vertical drives alone push no x."""
    f, up = np.geomspace(0.5, 60, 4), [1, 3, 5, 7]
    measured = exact(model, model.response(2 * np.pi * f)[:, :, :8], f)
    measured = replace(
        measured,
        value=measured.value[:, :, up],
        gram=measured.gram[:, up][:, :, up],
        inputs=tuple(model.actuators[k] for k in up),
    )
    frf_spread(measured, model, KEEP, (0.9,))
    with pytest.raises(InputError, match=r"'x'\].*excite each of these coordinates"):
        frf_spread(measured, model, ("x", "z"), (0.9,))


@pytest.mark.parametrize("keep", [("z",), ("z", "phi_x"), ("x", "y", "phi_z")])
def test_a_known_error_of_the_axes_forces_is_found_as_it_is(model, keep, rng):
    """Drives coupled by I + A L T give the input-multiplicative error L exactly, at every frequency."""
    A, _ = kept_axes(model.rig, keep, model.actuators, model.sensors.names)
    f, k = np.geomspace(0.5, 60, 30), len(keep)
    L = 0.05 * (rng.normal(size=(30, k, k)) + 1j * rng.normal(size=(30, k, k)))
    coupled = np.eye(8) + A @ L @ np.linalg.pinv(A)
    value = model.response(2 * np.pi * f)[:, :, :8] @ coupled
    found = frf_spread(exact(model, value, f), model, keep)
    assert np.allclose(found.measured, np.linalg.norm(L, 2, axis=(1, 2)), rtol=1e-8)
    assert np.all(found.noise < 1e-4 * found.measured)


def test_the_bound_holds_as_often_as_it_says(model, rng):
    """Over 300 lines with known noise: the noise below its quantiles, and the true error below the bound."""
    f = np.linspace(4.0, 40.0, 300)
    A, _ = kept_axes(model.rig, KEEP, model.actuators, model.sensors.names)
    true = 0.01 * np.array([[1.0, -0.4], [0.3, 0.8j]])
    alone = frf_spread(noisy(model, f, 1e-3, rng), model, KEEP)
    for confidence, quantile in zip(alone.confidences, alone.noise, strict=True):
        share = np.mean(alone.measured <= quantile)
        assert abs(share - confidence) < 4 * np.sqrt(confidence * (1 - confidence) / 300) + 0.005
    error = np.eye(8) + A @ true @ np.linalg.pinv(A)
    found = frf_spread(noisy(model, f, 1e-3, rng, error), model, KEEP)
    assert np.mean(np.linalg.norm(true, 2) <= found.bound(0.95)) >= 0.95


def test_independent_variances_give_the_same_as_covariances(model, rng):
    f = np.geomspace(1, 50, 20)
    full = exact(model, model.response(2 * np.pi * f)[:, :, :8], f, 1e-3)
    entries = replace(full, noise=None, gram=None, entry_variance=full.variance())
    assert np.allclose(frf_spread(full, model).noise, frf_spread(entries, model).noise, rtol=0.1)


def test_a_covariance_from_few_records_gives_a_wider_quantile(model):
    f = np.geomspace(1, 50, 5)
    G = model.response(2 * np.pi * f)[:, :, :8]
    known, few = (frf_spread(exact(model, G, f, 1e-3, dof), model).noise for dof in (np.inf, 4.0))
    assert np.all(few > 1.1 * known)


def test_thinning_keeps_the_largest_bounds(model, rng):
    found = frf_spread(noisy(model, np.linspace(0.5, 60, 500), 1e-4, rng), model)
    thin = found.thinned()
    assert len(thin.frequency_Hz) < 250 and np.all(np.diff(thin.frequency_Hz) > 0)
    assert thin.bound().max() == found.bound().max()
    for f, bound in zip(found.frequency_Hz, found.bound(), strict=True):
        near = np.abs(np.log2(thin.frequency_Hz / f)) <= 1 / 24 + 1e-9
        assert thin.bound()[near].max() >= bound


def test_where_noise_drowns_the_response_100_percent_are_assumed():
    """A spread within noise counts as 1, one that stays above it with the noise off counts so, others as bounded."""
    measured, noise = np.array([0.01, 0.7, 30.0, 9.0, 1.5]), np.array([0.02, 0.6, 40.0, 2.0, 0.5])
    spread = FrfSpread(("z",), np.geomspace(1, 16, 5), measured, noise[None], (0.95,))
    assert spread.drowned().tolist() == [False, False, True, True, False]
    assert spread.usable() == pytest.approx([0.03, 1.3, 1.0, 7.0, 2.0])
    assert np.all(spread.usable() <= spread.bound())


def test_what_is_refused(model):
    f = np.geomspace(1, 50, 5)
    full = exact(model, model.response(2 * np.pi * f)[:, :, :8], f)
    with pytest.raises(InputError, match="confidences"):
        frf_spread(full, model, KEEP, (1.5,))
    with pytest.raises(InputError, match="99 %"):
        frf_spread(full, model).bound(0.999)
    with pytest.raises(InputError, match="unit"):
        frf_spread(replace(full, output_unit="m"), model)
    fewer = FrequencyResponse(f, full.value[:, :5], full.noise[:, :5, :5], full.gram, full.inputs, full.outputs[:5])
    with pytest.raises(InputError, match=r"outputs = \['Sz3'\]"):
        frf_spread(fewer, model)


@pytest.fixture(scope="module")
def campaign():
    """Two records of white voltages on a table of its own, by the matrix exponential."""
    rng, rig = np.random.default_rng(7), load_rig("avis")
    table = rig.with_parameters({"mass": 505.0, "isolator2.k_z": rig.parameters()["isolator2.k_z"].value * 1.03})
    records = []
    for k in range(2):
        u = 0.2 * rng.normal(size=(24_000, 8))
        records.append(record(table, u, np.zeros((24_000, 3)), rng, f"{k:02d}", "noise"))
    return Campaign("avis", tuple(records)), ResponseModel.of(rig, ["mass"]), ResponseModel.of(table, ["mass"])


def test_records_leave_what_the_model_does_not_explain(campaign):
    """The error that is measured is that between the two tables' responses, at the sharp resonances too."""
    measured, model, table = campaign
    response = measured_response(measured, model, (1.0, 40.0))
    found = frf_spread(response, model)
    A, D = kept_axes(model.rig, KEEP, model.actuators, model.sensors.names)
    own, true = (D @ one.response(response.omega)[:, :, :8] @ A for one in (model, table))
    L = np.linalg.norm(np.linalg.solve(own, true - own), ord=2, axis=(1, 2))
    assert np.mean(found.bound(0.95) >= L) > 0.97
    # Where the difference is large, against the noise, it is seen as large.
    clear = 5 * found.noise[2] < L
    assert clear.sum() > 30 and np.median(found.measured[clear] / L[clear]) == pytest.approx(1.0, abs=0.1)


def test_the_true_table_leaves_only_noise(campaign):
    measured, _, table = campaign
    left = unexplained(measured, table).records[0].load()
    assert np.all(np.std(left.y, axis=0) < 1.2 * np.hypot(1e-3, 20 / 2**14 / np.sqrt(12)))


def test_pieces_of_what_is_left_are_those_of_the_whole(campaign):
    measured, model, _ = campaign
    one = unexplained(measured, model).records[0]
    whole = one.load()
    for start, stop in ((0, 5000), (5000, 12_000), (20_000, 24_000), (100, 200)):
        piece = one.load(start, stop)
        assert np.allclose(piece.y, whole.y[start:stop], rtol=0, atol=1e-12)
        assert np.array_equal(piece.u, whole.u[start:stop]) and piece.header.samples == stop - start


def test_floor_motion_that_was_measured_is_explained(rng):
    rig = load_rig("avis")
    floor = floor_velocity(rng, 12_000, 2e-4)
    one = record(rig, np.zeros((12_000, 8)), floor, rng, excitation="floor", floor_known=True)
    left = unexplained(Campaign("avis", (one,)), ResponseModel.of(rig, ["mass"])).records[0].load()
    assert np.all(np.std(left.y, axis=0) < 0.05 * np.std(one.y, axis=0))
