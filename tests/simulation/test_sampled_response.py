"""The frequency-domain prediction against tones run through the time-domain simulation, another computation."""

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.lti import StateSpace, gain, tf
from avis_ctrl.rigs import COORDINATES
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.simulation.sampled_response import SETTINGS, predict_transmissibility_6dof, sampled_response

PERIOD = 4000
TONES = {"x": [9, 40], "y": [11, 61], "z": [13, 83], "phi_x": [17, 101], "phi_y": [19, 160], "phi_z": [23, 290]}


def tones_response(loop, nonlinear: bool):
    """Response lines of payload velocity and demanded volts over floor velocity, at the tones of each coordinate."""
    t = np.arange(PERIOD) / PERIOD
    rng = np.random.default_rng(7)
    floor = np.zeros((PERIOD, 6))
    for column, lines in enumerate(TONES.values()):
        for line in lines:
            floor[:, column] += 1e-6 * np.cos(2 * np.pi * (line * t + rng.uniform()))
    periods = 10
    silent = replace(loop, sensors=replace(loop.sensors.white(), noise_rms_V=0.0, converter=None), floor={})
    whole = np.vstack([np.tile(floor, (periods, 1)), floor[:1]])
    record = simulate(silent, PERIOD * 1e-3, settle_s=(periods - 1) * PERIOD * 1e-3, floor=whole, nonlinear=nonlinear)
    F, V, U = (np.fft.rfft(series, axis=0) for series in (floor, record.q_dot, record.demanded))
    for column, lines in enumerate(TONES.values()):
        for line in lines:
            yield 2 * np.pi * line / PERIOD * 1e3, column, V[line] / F[line, column], U[line] / F[line, column]


def awkward(loop):
    """Drive and sensor errors of their own in two channels, and another plant."""
    n_u, n_s = loop.n_drives, len(loop.sensors.chains)
    lag = tf([0.0, 1.0], [1 / (2 * np.pi * 60.0), 1.0])
    drives = [None, tf([1.3, 400.0], [1.0, 500.0]), *[None] * (n_u - 2)]
    sensors = [lag, *[None] * (n_s - 1)]
    changes = {"mass": loop.rig.parameters()["mass"].value * 1.1}
    return loop.with_plant("awkward", loop.rig.with_parameters(changes), drives, sensors)


@pytest.mark.parametrize(
    ("name", "delay_s", "corner_Hz"),
    [
        ("avis", 1e-3, None),
        ("avis", 1.5e-3, 300.0),
        ("avis", 0.0, 300.0),
        ("halcyonics_loaded", 1e-3, 300.0),
        ("halcyonics_loaded", 0.5e-3, 200.0),
    ],
)
def test_tones_through_the_nonlinear_loop_come_out_as_predicted(make_loop, name, delay_s, corner_Hz):
    loop = awkward(make_loop(name, 0.7, loop_delay_s=delay_s, amplifier_corner_Hz=corner_Hz))
    # What an endless sum of images adds beyond those that are folded in.
    tolerance = 2e-4 if name == "avis" else 2e-3
    for omega, column, velocity, volts in tones_response(loop, nonlinear=True):
        predicted = sampled_response(loop, np.array([omega]))
        for measured, expected in ((velocity, predicted.velocity_floor[0]), (volts, predicted.volts_floor[0])):
            scale = np.linalg.norm(expected[:, column])
            assert np.linalg.norm(measured - expected[:, column]) < tolerance * scale, (omega, column)


def test_images_of_an_accelerometer_loop_converge(make_loop):
    loop, omega = make_loop("halcyonics_loaded"), 2 * np.pi * np.array([1.0, 10.0, 50.0, 100.0])
    far = sampled_response(loop, omega, 1000).velocity_floor
    errors = [
        np.abs(sampled_response(loop, omega, n).velocity_floor - far).max()
        for n in (SETTINGS.images, 4 * SETTINGS.images)
    ]
    assert errors[0] < 1e-3 * np.abs(far).max() and errors[1] < 0.3 * errors[0]


def test_interpolated_images_are_the_images(make_loop):
    loop = make_loop("halcyonics_loaded")
    omega = 2 * np.pi * np.linspace(0.1, 120.0, 600)
    many, few = sampled_response(loop, omega), sampled_response(loop, omega[::60])
    assert np.abs(many.velocity_floor[::60] - few.velocity_floor).max() < 1e-7 * np.abs(few.velocity_floor).max()


def test_without_control_transmissibility_is_the_continuous_one(passive):
    """The passive table knows no samples but those of the floor's velocity: sinc^2 and its images, far above."""
    loop, omega = passive("avis"), 2 * np.pi * np.geomspace(0.5, 50.0, 30)
    system = loop.rig.equations_of_motion().state_space()
    floors = [f"floor_{name}" for name in COORDINATES]
    continuous = system.select(list(COORDINATES), floors).frequency_response(omega)
    arms = np.array([loop.rig.edge_m if "phi" in name else 1.0 for name in COORDINATES])
    continuous = arms[:, None] * continuous / arms
    predicted = predict_transmissibility_6dof(loop, omega)
    hold = np.sinc(omega * 1e-3 / (2 * np.pi))[:, None, None] ** 2
    assert np.abs(predicted - continuous * hold).max() < 2e-3 * np.abs(continuous).max()


def test_slow_control_is_the_continuous_loop(make_loop):
    """At 100 kHz and without delay, the sampled loop is v = G_w w + G_u K v with G from the equations of motion."""
    loop = make_loop("avis", sample_rate_Hz=1e5, loop_delay_s=0.0, amplifier_corner_Hz=None)
    omega = 2 * np.pi * np.array([0.5, 2.0, 5.0, 20.0])
    eom, arms = loop.rig.equations_of_motion(), np.array([1, 1, 1, 0.375, 0.375, 0.375])
    order = [*loop.axes, *loop.loops]
    place = [COORDINATES.index(name) for name in order]
    for k, w in enumerate(omega):
        s = 1j * w
        chain: StateSpace = loop.sensors.chains[0]
        seen = chain(s)[0, 0] / loop.sensors.gain_V[0]
        control = np.zeros((6, 6), complex)
        control[np.ix_(place[:2], place[:2])] = loop.K(s)
        for name, system in loop.loops.items():
            control[COORDINATES.index(name), COORDINATES.index(name)] = system(s)[0, 0]
        dynamic = s * eom.M + eom.C + eom.K / s - arms[:, None] * control * arms * seen
        expected = arms[:, None] * np.linalg.solve(dynamic, eom.C_floor + eom.K_floor / s) / arms
        predicted = predict_transmissibility_6dof(loop, np.array([w]))[0]
        assert np.abs(predicted - expected).max() < 2e-3 * np.abs(expected).max(), k


def test_white_noise_at_the_converter_makes_the_predicted_motion(make_loop):
    """A floor at rest, 100 times the noise: r.m.s. voltage and velocity from densities and from 60 s of simulation."""
    loop = make_loop("avis", floor={})
    loud = replace(loop, sensors=replace(loop.sensors, noise_rms_V=0.1))
    record = simulate(loud, 60.0)
    frequency = np.arange(1, 4000) * 0.125
    response = sampled_response(loud, 2 * np.pi * frequency)
    assert np.sqrt(response.volts_psd().sum(axis=0) * 0.125) == pytest.approx(record.demanded.std(axis=0), rel=0.05)
    predicted = np.sqrt(response.velocity_psd()[frequency > 2].sum(axis=0) * 0.125)
    lines = np.abs(np.fft.rfft(record.q_dot, axis=0)) ** 2 * 2 / len(record.time) ** 2
    above = np.fft.rfftfreq(len(record.time), 1e-3) > 2
    assert predicted == pytest.approx(np.sqrt(lines[above].sum(axis=0)), rel=0.15)


def test_a_static_controller_needs_no_states(passive):
    loop = replace(passive(), K=gain(-100.0 * np.eye(2)), loops={})
    assert np.all(np.isfinite(predict_transmissibility_6dof(loop, np.array([1.0, 10.0]))))
