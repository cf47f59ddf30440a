"""Simulation in time against the exact discretisation and against the response by frequency."""

from dataclasses import replace

import numpy as np
import pytest
from exact import floor_velocity, multisine, record

from avis_ctrl.errors import InputError
from avis_ctrl.identification.predictor import Predictor, predict
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs import load_rig


def test_against_the_exact_discretisation():
    rng, rig = np.random.default_rng(1), load_rig("avis")
    u = multisine(rng, 0.3, period=4000, periods=2)
    measured = record(rig, u, np.zeros((len(u), 3)), rng, noise_V=0.0, quantised=False)
    assert np.allclose(predict(ResponseModel.of(rig, ()), measured, large_motion=False), measured.y, atol=1e-12)


def test_floor_motion_of_a_record():
    """The other simulator holds the floor's velocity over a sample, this one draws a line: half a sample apart."""
    rng, rig = np.random.default_rng(2), load_rig("avis")
    floor = floor_velocity(rng, 8000, 1e-4)
    measured = record(rig, np.zeros((8000, 8)), floor, rng, floor_known=True, noise_V=0.0, quantised=False)
    found = predict(ResponseModel.of(rig, ()), measured)
    ahead = (found[:-1] + found[1:]) / 2
    assert np.std(ahead[1000:] - measured.y[1001:]) < 0.003 * np.std(measured.y)


@pytest.mark.parametrize("rig", ["avis", "halcyonics_loaded"])
@pytest.mark.parametrize("delay", [0.0, 0.4e-3, 1e-3, 2.3e-3])
@pytest.mark.parametrize("corner", [None, 300.0])
def test_settled_sine_is_the_response(rig, delay, corner):
    """A periodic drive, once settled, against sampled response with hold, delay, amplifier and aliases.

    The aliases of the response leave out damping over mass and frequency: 4e-5 on the lightest case, accelerations of
    the Halcyonics under a force that jumps at the sample.
    """
    model = replace(ResponseModel.of(load_rig(rig), (), amplifier_corner_Hz=corner), delay_s=delay)
    rng, period = np.random.default_rng(3), 2000
    u = multisine(rng, 0.3, period=period, periods=30, band_Hz=(5.0, 40.0))
    last = Predictor(model).read(u)[-period:]
    lines = np.arange(10, 81)
    U, Y = np.fft.rfft(u[-period:], axis=0)[lines], np.fft.rfft(last, axis=0)[lines]
    G = model.response(2 * np.pi * lines * 0.5)[:, :, :8]
    expected = np.einsum("nij,nj->ni", G, U)
    assert np.max(np.abs(Y - expected)) < 5e-5 * np.max(np.abs(expected))


def test_pieces_join():
    rng = np.random.default_rng(4)
    model = replace(ResponseModel.of(load_rig("avis"), ()), delay_s=1.7e-3)
    u = rng.normal(size=(500, 8))
    whole, parts = Predictor(model).read(u), Predictor(model)
    assert np.allclose(np.vstack([parts.read(u[:123]), parts.read(u[123:125]), parts.read(u[125:])]), whole, atol=1e-15)


def test_a_model_without_sample_time_predicts_no_record():
    rng, rig = np.random.default_rng(5), load_rig("avis")
    measured = record(rig, np.zeros((100, 8)), np.zeros((100, 3)), rng)
    with pytest.raises(InputError, match="expected a model with a sample time"):
        predict(ResponseModel.of(rig, (), sampled=False), measured)
