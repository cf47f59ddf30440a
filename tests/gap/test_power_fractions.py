"""Shares of power against records whose parts are drawn by themselves: what is put in must come out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.gap import power_fractions as shares
from avis_ctrl.gap.power_fractions import Lines, Split, attributed, bands, lines_of, power_shares, split
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.prediction_error import PredictionError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import RecordHeader
from avis_ctrl.rigs import load_rig

BAND_HZ, LINES = (2.0, 20.0), 1400


def normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """E|z|^2 = 1."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


@pytest.fixture(scope="module")
def model() -> TableModel:
    rig = load_rig("avis")
    return TableModel(ResponseModel.of(rig, default_parameters(rig)))


def record(
    model: TableModel,
    name: str,
    level: float,
    rng: np.random.Generator,
    *,
    gain: complex = 1.0,
    floor: float = 0.0,
    sensor: float = 0.0,
    distortion: float = 0.0,
    excitation: str = "noise",
    actual: TableModel | None = None,
) -> tuple[PredictionError, RecordHeader, dict[str, np.ndarray]]:
    """A record of known parts: the model's answer times a gain, floor motion at random through the table, noise of the
    sensors, and distortion that is a share of the output's power times the level squared."""
    omega = 2 * np.pi * np.linspace(*BAND_HZ, LINES)
    n_a, n_y = len(model.actuators), len(model.sensors.names)
    U = np.zeros((LINES, len(model.inputs), 1), complex)
    U[:, :n_a, 0] = level * normal(rng, LINES, n_a)
    G = model.response(omega)
    linear = G @ U
    own = linear if actual is None else actual.response(omega) @ U
    shaken = floor * (G[:, :, n_a:] @ normal(rng, LINES, 3, 1))
    hiss = sensor * normal(rng, LINES, n_y, 1)
    bent = np.sqrt(distortion) * level * np.abs(linear) * normal(rng, LINES, n_y, 1)
    Y = gain * own + shaken + hiss + bent
    ground = floor**2 * np.sum(np.abs(G[:, :, n_a:]) ** 2, axis=2)
    C = (ground + sensor**2 + 1e-30)[:, :, None] * np.eye(n_y)
    block = SpectralBlock(name, omega, U, Y).with_noise(C)
    left = Y - linear
    header = RecordHeader(
        name=name,
        sample_rate_Hz=1000.0,
        samples=30000,
        u_names=model.actuators,
        y_names=model.sensors.names,
        u_unit="V",
        y_unit="V",
        excitation=excitation,
        level_V=level,
    )
    parts = {
        "unmeasured": np.sum(ground, axis=0),
        "sensors": LINES * np.full(n_y, sensor**2),
        "nonlinear": np.sum(distortion * level**2 * np.abs(linear[:, :, 0]) ** 2, axis=0),
        "missing": np.sum(np.abs((gain * own - linear)[:, :, 0]) ** 2, axis=0),
    }
    whole = np.sum(np.abs(Y[:, :, 0]) ** 2, axis=0)
    return (
        PredictionError(block, left, left, left, np.empty(0), 2 * left.size, np.full(n_y, 2 * LINES)),
        header,
        {key: value / whole for key, value in parts.items()},
    )


def shares_of(records, model: TableModel, silent: bool, sensor: float | None):
    rms = None if sensor is None else dict.fromkeys(model.sensors.names, sensor)
    return power_shares([e for e, _, _ in records], {h.name: h for _, h, _ in records}, model, silent, rms)


@pytest.mark.parametrize("silent", [True, False])
def test_what_is_put_in_comes_out(model, silent):
    rng = np.random.default_rng(24100)
    made = [
        record(model, f"{k}", level, rng, gain=1.1, floor=2e-5, sensor=1e-3, distortion=0.04 * (level > 0.1))
        for k, level in enumerate((0.05, 0.05, 0.5, 0.5))
    ]
    low, high = shares_of(made, model, silent, 1e-3)
    assert (low.how, low.level_V, high.level_V) == ("silent" if silent else "levels", 0.05, 0.5)
    assert low.records == ("0", "1")
    for found, own in ((low, made[:2]), (high, made[2:])):
        np.testing.assert_allclose(sum(found.shares.values()), 1, atol=1e-9)
        np.testing.assert_allclose(sum(found.whole.values()), 1, atol=1e-9)
        for key in ("missing", "nonlinear", "unmeasured", "sensors"):
            expected = np.mean([parts[key] for _, _, parts in own], axis=0)
            hidden = np.mean([sum(parts.values()) - parts["missing"] for _, _, parts in own], axis=0)
            # Few lines about the resonances hold most of the power: their number sets the scatter.
            weak = 0.1 if key == "missing" else 0.02
            np.testing.assert_allclose(found.whole[key], expected, rtol=0.35, atol=weak * hidden.max())


@pytest.mark.slow
def test_at_one_level_noise_and_distortion_are_not_told_apart(model):
    rng = np.random.default_rng(24101)
    made = [record(model, f"{k}", 0.3, rng, sensor=1e-3, distortion=0.01) for k in range(2)]
    (found,) = shares_of(made, model, False, 1e-3)
    assert found.how == "one level"
    assert np.all(found.whole["nonlinear"] < 1e-12)
    np.testing.assert_allclose(found.whole["unmeasured"], made[0][2]["nonlinear"], rtol=0.35)
    (told,) = shares_of(made, model, True, 1e-3)
    np.testing.assert_allclose(told.whole["nonlinear"], made[0][2]["nonlinear"], rtol=0.35)
    (unknown,) = shares_of(made, model, False, None)
    assert "sensors" not in unknown.whole


def test_a_shifted_resonance_is_linear(model):
    """Another mass: poles elsewhere, and nothing that is not linear."""
    mass = model.base.rig.parameters()["mass"].value
    heavier = replace(model, base=replace(model.base, rig=model.base.rig.with_parameters({"mass": 1.04 * mass})))
    rng = np.random.default_rng(24102)
    made = [record(model, f"{k}", 0.3, rng, sensor=1e-5, actual=heavier) for k in range(3)]
    (found,) = shares_of(made, model, True, 1e-5)
    expected = np.mean([parts["missing"] for _, _, parts in made], axis=0)
    strong = expected > 0.2 * expected.max()
    assert expected.max() > 1e-3
    np.testing.assert_allclose(found.whole["missing"][strong], expected[strong], rtol=0.15)
    assert np.all(found.whole["nonlinear"][strong] < 0.1 * expected[strong])


def test_noise_alone_leaves_nothing_else(model):
    """Unknowns of the regressions cost no power: their leverage is counted."""
    rng = np.random.default_rng(24103)
    made = [record(model, f"{k}", 0.1, rng, sensor=1e-2) for k in range(2)]
    (found,) = shares_of(made, model, True, 1e-2)
    lines = lines_of([e for e, _, _ in made], model)
    one = split(lines, found.bands_Hz)
    np.testing.assert_allclose((one.incoherent * one.lines[:, None]).sum(0) / one.lines.sum(), 1e-4, rtol=0.1)
    np.testing.assert_allclose(
        found.whole["sensors"], np.mean([parts["sensors"] for *_, parts in made], axis=0), rtol=0.15
    )
    assert np.all(found.whole["missing"] < 0.02 * found.whole["sensors"])


def test_lines_without_drive_and_records_at_rest_are_left_out(model):
    rng = np.random.default_rng(24104)
    e, header, _ = record(model, "0", 0.3, rng, sensor=1e-3)
    e.block.U[::2, : len(model.actuators)] = 0
    lines = lines_of([e], model)
    np.testing.assert_allclose(lines.frequency_Hz, e.block.omega[1::2] / (2 * np.pi))
    rest = replace(header, excitation="rest")
    assert power_shares([e], {"0": rest}, model, True, None) == ()


def test_bands_hold_lines_enough_for_the_poorest_level():
    f = np.linspace(1.0, 64.0, 2000)
    few = np.sort(np.random.default_rng(1).uniform(1.0, 64.0, 60))
    groups = [
        Lines(g, *(np.ones((len(g), 1)) for _ in range(3)), np.ones((len(g), 1, 4)), np.ones((len(g), 1)))
        for g in (f, few)
    ]
    edges = bands(groups)
    assert edges[0] == 1.0 and edges[-1] == pytest.approx(64.0) and len(edges) > 3
    assert np.all(np.histogram(few, edges)[0] >= shares.SETTINGS.least_lines * 4)
    assert len(bands([groups[0]])) > len(edges)
    assert len(bands([groups[1].some(np.arange(5))])) < 2


def test_parts_never_exceed_the_whole():
    rng = np.random.default_rng(2)
    powers = [rng.uniform(0, 2, (7, 3)) for _ in range(5)]
    one = Split(powers[0] + 0.1, *powers[1:], np.ones(7), np.full((7, 3), 20.0))
    parts = attributed(one, rng.uniform(0, 2, (7, 3)), np.ones(3))
    np.testing.assert_allclose(sum(parts.values()), 1)
    assert all(np.all(value >= -1e-12) for value in parts.values())
