"""Faults that the library has no name for: how they act, where their fit begins, and whose name they take away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.outside_library import unnamed_faults
from avis_ctrl.gap.motion_estimate import mount_rows
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.run import Run
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.search import search
from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.likelihood import Data, first_variances, fit
from avis_ctrl.identification.maximum_likelihood import block_residual, whitener
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.priors import re_identified
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs import load_rig

RIG = load_rig("avis")
BARE = TableModel(ResponseModel.of(RIG, default_parameters(RIG)))
RATE, SAMPLES, NOISE = 1000.0, 8000, 2e-3
LINES = np.arange(4, 320, 5)
OMEGA = 2 * np.pi * LINES * RATE / SAMPLES


def record(name, level):
    """A record of random voltages; deflection and y are of a likely size, random too."""
    rng = np.random.default_rng([5, int(name)])
    volts, slow = level * rng.standard_normal((SAMPLES, 8)), rng.standard_normal((SAMPLES, 18))
    slow = np.apply_along_axis(lambda x: np.convolve(x, np.ones(20) / 5, "same"), 0, slow)
    return RecordMotion(
        name,
        RATE,
        10.0 * int(name),
        (0.0, 60.0),
        volts,
        1e-5 * slow[:, :12],
        *mount_rows(BARE),
        actuators=BARE.actuators,
        sensors=BARE.sensors.names,
        y=0.1 * slow[:, 12:],
    )


MOTION = {name: record(name, level) for name, level in (("00", 0.1), ("01", 0.5), ("02", 0.1), ("03", 0.5))}
MODEL = replace(BARE, motion=MOTION)


def block(truth, name, noise=NOISE):
    rng = np.random.default_rng([3, int(name)])
    U = np.zeros((len(OMEGA), 11, 1), complex)
    U[:, :8, 0] = MOTION[name].spectrum(MOTION[name].volts, OMEGA)
    made = SpectralBlock(name, OMEGA, U, np.zeros((len(OMEGA), 6, 1), complex), transient=False)
    white = (rng.standard_normal((len(OMEGA), 6, 1)) + 1j * rng.standard_normal((len(OMEGA), 6, 1))) / np.sqrt(2)
    Y = truth.answer(made, None, False).Y + noise * white
    return replace(made, Y=Y).with_noise(np.broadcast_to(noise**2 * np.eye(6), (len(OMEGA), 6, 6)).astype(complex))


def test_none_of_them_is_in_the_library():
    assert all(one.outside for one in unnamed_faults().values())
    assert not any(one.outside for one in library().values())
    assert not set(unnamed_faults()) & set(library())


FILTERS = {  # effect, place, values, factor on the channel by s, volts or outputs
    "sensor_late": ("Sz2", (2e-3, 5e-3), lambda s: np.exp(-2e-3 * s) / (1 + 5e-3 * s)),
    "motor_late": ("Az2", (2e-3, 5e-3), lambda s: np.exp(-2e-3 * s) / (1 + 5e-3 * s)),
    "sensor_resonance": (
        "Sz2",
        (0.1, 30.0, 0.02),
        lambda s: 1 + 0.1 * s**2 / (s**2 + 2 * 0.02 * 60 * np.pi * s + (60 * np.pi) ** 2),
    ),
}


@pytest.mark.parametrize("name", FILTERS)
def test_a_fault_of_one_channel_is_a_factor_on_it_alone(name):
    place, values, factor = FILTERS[name]
    found = MODEL.with_effect(active(unnamed_faults()[name], MODEL, place, values)).response(OMEGA)
    expected, f = MODEL.response(OMEGA), factor(1j * OMEGA)[:, None]
    if place in MODEL.actuators:
        expected[:, :, MODEL.actuators.index(place)] *= f
    else:
        expected[:, MODEL.sensors.names.index(place)] *= f
    # Aliases of the motors pass no filter of the sensors.
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


def test_the_ring_down_of_a_sensors_resonance_is_part_of_the_transient():
    """A lightly damped resonance of a sensor still rings from before the record. Its states are estimated, beside those
    of geophones whose corners have tolerances; otherwise other effects would have to explain them."""
    place, (share, frequency_Hz, damping) = "Sz2", (0.1, 30.0, 0.02)
    one = active(unnamed_faults()["sensor_resonance"], MODEL, place, (share, frequency_Hz, damping))
    model = replace(BARE, corners_differ=True).with_effect(one)
    s, w = 1j * OMEGA, 2 * np.pi * frequency_Hz
    started = block(model, "00", noise=1e-9)
    Y = started.Y.copy()
    # Laplace transform of exp(-damping w t) cos(sqrt(1 - damping^2) w t), the ring-down of the resonance.
    Y[:, model.sensors.names.index(place), 0] += (
        0.01 * (s + damping * w) / ((s + damping * w) ** 2 + (1 - damping**2) * w**2)
    )
    started = replace(started, Y=Y, transient=True)
    e, _, _ = block_residual(model, started, whitener(started), derivative=False)
    assert e @ e < 2 * e.size  # the noise is 1e-9; the ring-down is a million times as large


ADDITIONS = {  # place, strength, (volts, outputs) that are added to a record of volts u and outputs y at times t
    "sensor_quadratic": ("Sz1", 0.02, lambda u, y, t: (0, only(1, (y[:, 1] - y[:, 1].mean()) ** 2, 6))),
    "sensor_cubic": ("Sz1", 0.02, lambda u, y, t: (0, only(1, (y[:, 1] - y[:, 1].mean()) ** 3, 6))),
    "drive_crosstalk": ("Ay1/Ax2", 0.3, lambda u, y, t: (only(0, u[:, 2], 8), 0)),
    "drive_quadratic": ("Ay1", 0.3, lambda u, y, t: (only(0, u[:, 0] ** 2, 8), 0)),
    "drive_absolute": ("all drives", 0.3, lambda u, y, t: (u * np.abs(u), 0)),
    "drive_cubic": ("Ay1", 0.3, lambda u, y, t: (only(0, u[:, 0] ** 3, 8), 0)),
    "force_drift": ("all drives", 0.3, lambda u, y, t: (u * ((t - 30.0) / 60.0)[:, None], 0)),
}


def only(k, samples, channels):
    found = np.zeros((len(samples), channels))
    found[:, k] = samples
    return found


@pytest.mark.parametrize("name", ADDITIONS)
def test_a_fault_that_adds_a_signal(name):
    place, strength, law = ADDITIONS[name]
    record = MOTION["01"]
    volts, output = law(record.volts, record.y, record.time_s)
    one = active(unnamed_faults()[name], MODEL, place, (strength,))
    added = one.effect.spectra(record, place, one.by_name, OMEGA)
    for found, samples in ((added.volts, volts), (added.output, output)):
        if found is None:
            assert np.all(samples == 0)
        else:
            lines = np.fft.rfft(strength * samples, axis=0)[LINES] / np.sqrt(SAMPLES)
            np.testing.assert_allclose(found, lines, atol=1e-12)


@pytest.mark.parametrize("name", ["sensor_late", "motor_late"])
def test_what_is_late_begins_with_half_of_it_as_delay_and_as_lag(name):
    effect = unnamed_faults()[name]
    place = effect.places(MODEL)[1]
    truth = MODEL.with_effect(active(effect, MODEL, place, (1e-4, 3e-4)))
    score = Score(MODEL, [block(truth, "00", 1e-4)])
    (seed,) = effect.seeds(score, place)
    assert seed.values == pytest.approx((2e-4, 2e-4), rel=0.1)
    early = Score(truth, [block(MODEL, "00", 1e-4)])
    assert effect.seeds(early, place) == []


def searched(truth, *names):
    """The steps of a search among these effects and all faults that the library has no name for."""
    data = Data((block(truth, "00"), block(truth, "01")), (0.1, 0.5))
    settings = GapSettings()
    base = fit(MODEL, re_identified(RIG), np.zeros(len(MODEL.names)), data, first_variances(data, settings), settings)
    return search(base, data, [*(library()[name] for name in names), *unnamed_faults().values()], Run())


@pytest.mark.slow
def test_crosstalk_is_no_misalignment():
    truth = MODEL.with_effect(active(unnamed_faults()["sensor_crosstalk"], MODEL, "Sz1/Sz3", (0.03,)))
    step = searched(truth, "sensor_misalignment", "sensor_gain")[0]
    one = step.fitted.model.effects[-1]
    assert one.effect.outside
    assert one.effect.described(one.place, one.by_name) == "a fraction of Sz3's signal in Sz1"
    assert one.values[0] == pytest.approx(0.03, abs=4 * np.sqrt(step.fitted.covariance_of(one.names)[0, 0]))


@pytest.mark.slow
def test_a_misalignment_keeps_its_name():
    truth = MODEL.with_effect(active(library()["sensor_misalignment"], MODEL, "Sz1", (1.5, 1.0)))
    assert [one.label for one in searched(truth, "sensor_misalignment", "sensor_gain")] == ["sensor_misalignment@Sz1"]


def test_a_dead_zone_is_no_force_constant():
    truth = MODEL.with_effect(active(unnamed_faults()["dead_zone"], MODEL, "Az2", (0.01,)))
    one = searched(truth, "actuator_gain")[0].fitted.model.effects[-1]
    assert one.effect.described(one.place, one.by_name) == "a dead zone of Az2"


@pytest.mark.slow
def test_a_force_constant_is_no_dead_zone():
    truth = MODEL.with_effect(active(library()["actuator_gain"], MODEL, "Az2", (1.05,)))
    assert [one.label for one in searched(truth, "actuator_gain")] == ["actuator_gain@Az2"]
