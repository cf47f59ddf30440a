"""Levels of floor and sensor noise against what went in, with misfit, clipping and noise that is no floor motion."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from signal_campaigns import LSB, draw, hum, rig

from avis_ctrl.errors import InputError
from avis_ctrl.gap.signals.hum import find_hum
from avis_ctrl.gap.signals.noise_level import NoiseLevels, noise_levels
from avis_ctrl.gap.signals.noise_lines import quiet_lines
from avis_ctrl.gap.signals.record_residual import record_residuals
from avis_ctrl.identification.response import ResponseModel

KINDS = ("rest", "multisine", "noise")


@cache
def model() -> ResponseModel:
    return ResponseModel.of(rig(), ())


def floor_response(omega: np.ndarray) -> np.ndarray:
    return model().response(omega)[:, :, 8:]


def levels(campaign, predicted, **given) -> NoiseLevels:
    return noise_levels(record_residuals(campaign, predicted), floor_response, rig(), **given)


def drawn(seed: int, kind: str, **given):
    return draw(seed, kind, levels=(0.0,) * 4 if kind == "rest" else (0.1, 0.1, 0.3, 0.3), samples=40_000, **given)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_ambient_is_ambient(kind, slope):
    found = levels(*drawn(1, kind, slope=slope))
    assert found.ground_motion is None and found.raised == ()
    assert found.floor is not None
    # 20 s to 160 s of a floor that is mostly below 1 Hz scatter by some ten per cent.
    assert abs(found.floor.rms["mean"].value - 2e-6) < max(4 * found.floor.rms["mean"].std, 0.15 * 2e-6)
    for one in found.sensors.values():
        assert abs(one.value - np.hypot(1e-3, LSB / np.sqrt(12))) < 4.5 * one.std
        assert one.std < 0.01 * one.value


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_three_times_ambient_is_ground_motion_whatever_its_shape(kind, slope):
    found = levels(*drawn(2, kind, slope=slope, floor_rms=6e-6))
    assert found.ground_motion is not None and found.raised == ()
    assert found.ground_motion.confidence > 0.999
    value = found.ground_motion.parameters["velocity_rms"]
    assert abs(value.value - 6e-6) < max(4 * value.std, 0.15 * 6e-6)


@pytest.mark.parametrize("kind", ["multisine", "noise"])
@pytest.mark.parametrize("wrong", ["gain", "delay", "corner"])
def test_what_the_model_lacks_is_no_ground_motion(kind, wrong):
    campaign, predicted = drawn(3, kind)
    exact = levels(campaign, predicted)
    change = {
        "gain": lambda y: 1.2 * y,
        "delay": lambda y: np.roll(y, 2, 0),
        "corner": lambda y: y + 0.2 * np.cumsum(y - y.mean(0), 0) * 2e-3 * np.pi * 5,
    }[wrong]
    found = levels(campaign, {name: change(y) for name, y in predicted.items()})
    assert found.ground_motion is None and found.raised == ()
    assert found.floor is not None and exact.floor is not None
    assert abs(found.floor.rms["mean"].value - exact.floor.rms["mean"].value) < 0.3 * exact.floor.rms["mean"].value


@pytest.mark.parametrize("kind", KINDS)
def test_noise_of_one_sensor_is_raised_and_is_no_effect_of_the_floor(kind):
    found = levels(*drawn(4, kind, noise_V=np.array([1, 1, 1, 1, 1, 2.0]) * 1e-3))
    assert found.raised == ("Sz3",) and found.ground_motion is None
    value = found.sensors["Sz3"]
    assert abs(value.value - np.hypot(2e-3, LSB / np.sqrt(12))) < 4.5 * value.std


@pytest.mark.parametrize("size", [3e-5, 1e-4, 1e-3])
def test_drift_of_the_sensors_is_no_ground_motion(size):
    """A random walk of every channel: low frequency like the floor, but outside the range of its response too."""
    campaign, predicted = drawn(5, "rest")
    rng = np.random.default_rng(5)
    found = levels(campaign, {name: y - size * np.cumsum(rng.normal(size=y.shape), 0) for name, y in predicted.items()})
    assert found.ground_motion is None
    # The largest hides the floor altogether.
    assert (found.floor is None) == (size > 1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_lines_in_the_sensors_are_no_ground_motion(kind):
    """5 mV at 50.01 Hz and at 29 Hz in every channel, with the hum found and without."""
    both = {(j, k): 5e-3 for j in range(6) for k in (1,)}
    campaign, predicted = drawn(9, kind, added=lambda n, rng: hum(n, 50.01, both, rng) + hum(n, 29.0, both, rng))
    left = record_residuals(campaign, predicted)
    found = find_hum(left)
    assert found is not None
    for given in (None, found):
        assert noise_levels(left, floor_response, rig(), given).ground_motion is None


def test_a_coarse_converter_is_not_noise_of_the_sensor():
    def adc(y):
        z = LSB * np.floor(y / LSB + 0.5)
        z[:, 0] = 8 * LSB * np.floor(y[:, 0] / (8 * LSB) + 0.5)
        return z

    campaign, predicted = drawn(6, "noise", adc=adc)
    assert levels(campaign, predicted).raised == ("Sy1",)
    assert levels(campaign, predicted, steps_V={"Sy1": 8 * LSB}).raised == ()


def test_a_floor_that_was_measured_is_not_estimated():
    found = levels(*drawn(7, "noise", floor_rms=6e-6, floor_known=True))
    assert found.floor is None and found.ground_motion is None and found.raised == ()


@pytest.mark.parametrize("kind", ["multisine", "noise"])
def test_quiet_lines_are_unbiased(kind):
    """White noise of unit variance beside a response that the prediction lacks altogether."""
    campaign, predicted = drawn(8, kind)
    rng = np.random.default_rng(8)
    left = record_residuals(campaign, predicted)
    only = [replace(one, e=rng.normal(size=one.e.shape)) for one in left]
    for band, narrow in (((1.0, 30.0), True), ((100.0, 400.0), False)):
        for one in quiet_lines(only, band, narrow):
            mean, lines = one.power.mean(), one.power.size
            assert abs(mean - 1) < 6 / np.sqrt(lines), (narrow, mean)


def test_what_cannot_be_judged_is_refused():
    campaign, predicted = drawn(1, "rest")
    with pytest.raises(InputError, match="ambient"):
        noise_levels(record_residuals(campaign, predicted), floor_response, replace(rig(), ambient=None))
