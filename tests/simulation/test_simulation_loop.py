"""The simulation against other integrators, conservation laws and what its parts are asked to do exactly."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as la
from nonlinear_rig import NonlinearRig
from scipy.integrate import solve_ivp

from avis_ctrl.errors import InputError
from avis_ctrl.lti import discretise, gain
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.instability_cause import find_cause
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.simulation.sampled_loop import SampledLoop, SensorBank

SKEW = {"com_x": 0.05, "com_y": -0.03, "com_z": 0.12, "J12": 3.0, "J13": -2.0, "J23": 4.0}
START = np.array([1.0, -2.0, 3.0, 1.5, -1.0, 2.0, 10.0, 20.0, -15.0, 5.0, -8.0, 12.0])


def at_rest(samples: int) -> np.ndarray:
    return np.zeros((samples + 1, 6))


def plain_bank(rig, converter=None, noise=0.0) -> SensorBank:
    """Sensors that show velocity as it is, one volt per m/s."""
    n = len(rig.sensor_rows()[0])
    return SensorBank(("velocity",) * n, (gain(1.0),) * n, np.ones(n), np.full(n, noise), (None,) * n, converter)


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_micrometre_motion_is_the_matrix_exponential(passive, name):
    loop = passive(name)
    start = START * 1e-6
    record = simulate(loop, 2.0, settle_s=0.0, floor=at_rest(2000), initial=start)
    # The momentum form of the equations of motion: p = M q' with the floor at rest.
    eom = loop.rig.equations_of_motion()
    system = eom.state_space()
    momentum = np.concatenate([start[:6], eom.M @ start[6:]])
    for k in (1, 500, 1999):
        state = la.expm(system.A * record.time[k]) @ momentum
        moved = np.concatenate([record.q[k], record.q_dot[k]])
        assert np.linalg.norm(moved - system.C @ state) < 2e-5 * np.linalg.norm(start)


def test_moving_floor_agrees_with_an_adaptive_integrator(passive):
    """2 Hz and 7 Hz floor motion: what is left is the straight line between samples of its velocity."""
    loop, samples = passive("avis"), 1500
    rates = np.array([2.0, 7.0, 3.0, 2.5, 4.0, 5.0]) * 2 * np.pi
    size = np.array([3.0, 1.0, 2.0, 1.0, 2.0, 1.5]) * 1e-6

    def floor_dot(t):
        return size * np.sin(rates * np.asarray(t)[..., None])

    record = simulate(loop, samples * 1e-3, settle_s=0.0, floor=floor_dot(np.arange(samples + 1) * 1e-3))
    rig = NonlinearRig(loop.rig.mounted_body())

    def slope(t, x):
        floor = size / rates * (1 - np.cos(rates * t))
        return rig.derivative(x, None, floor, floor_dot(t))

    truth = solve_ivp(slope, (0.0, record.time[-1]), np.zeros(12), "DOP853", record.time, rtol=1e-9, atol=1e-14).y[6:].T
    error = np.abs(record.q_dot - truth).max(axis=0) / np.abs(truth).max(axis=0)
    # (omega T)^2 / 12 of the fastest: 1.6e-4.
    assert np.all(error < 2e-4)


def test_large_motion_converges_with_the_second_order(passive):
    """Half a step, a quarter of the error, against DOP853; with one step a millisecond already small."""
    loop = passive("avis").with_plant("skewed", load_rig("avis").with_parameters(SKEW))
    start = START * np.array([2e-3] * 3 + [5e-2] * 3 + [2e-3] * 3 + [5e-3] * 3)
    records = [
        simulate(loop, 0.8, settle_s=0.0, floor=at_rest(800), initial=start, extra_substeps=m) for m in (1, 2, 4)
    ]
    rig = NonlinearRig(loop.plant.mounted_body())
    truth = solve_ivp(
        lambda t, x: rig.derivative(x), (0, 0.8), start, "DOP853", records[0].time, rtol=1e-11, atol=1e-13
    )
    assert not any(record.diverged for record in records)
    errors = [np.abs(record.q - truth.y[:6].T).max() for record in records]
    linear = simulate(loop, 0.8, settle_s=0.0, floor=at_rest(800), initial=start, nonlinear=False)
    assert np.abs(linear.q - truth.y[:6].T).max() > 100 * errors[0]
    assert errors[0] < 2e-4 * np.abs(truth.y[:6]).max()
    assert 3.5 < errors[0] / errors[1] < 4.5 and 3.5 < errors[1] / errors[2] < 4.5


def test_energy_is_kept_without_damping_and_lost_with_it(passive):
    undamped = load_rig("avis").with_parameters({f"isolator{i}.c_{a}": 0.0 for i in range(1, 5) for a in "xyz"})
    start = START * 1e-3
    for plant, kept in ((undamped, True), (load_rig("avis"), False)):
        record = simulate(passive().with_plant("plant", plant), 10.0, settle_s=0.0, floor=at_rest(10000), initial=start)
        rig = NonlinearRig(plant.mounted_body())
        energy = np.array(
            [rig.energy(np.concatenate(row)) for row in zip(record.q[::20], record.q_dot[::20], strict=True)]
        )
        if kept:
            assert np.abs(energy / energy[0] - 1).max() < 1e-4
        else:
            assert np.all(np.diff(energy) < 0) and energy[-1] < 0.2 * energy[0]


@pytest.mark.parametrize("periods", [0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.2])
def test_delay_is_exactly_what_is_asked(periods):
    """From rest, noise makes the first voltage; the table starts to move when the delay has passed, as Newton says."""
    rig = load_rig("avis")
    loop = SampledLoop(
        rig, gain(-100.0 * np.eye(2)), ("z", "phi_x"), {}, plain_bank(rig, noise=1e-3), {}, loop_delay_s=periods * 1e-3
    )
    record = simulate(loop, 0.01, settle_s=0.0, seed=3)
    arrived = int(np.floor(periods))
    assert np.all(record.q_dot[: arrived + 1] == 0.0)
    eom = rig.equations_of_motion()
    pushed = la.solve(eom.M, eom.T @ record.demanded[0]) * (arrived + 1 - periods) * 1e-3
    assert np.linalg.norm(record.q_dot[arrived + 1] - pushed) < 0.02 * np.linalg.norm(pushed)
    held = int(np.ceil(periods))
    assert np.array_equal(record.volts[held:], record.demanded[: len(record.demanded) - held])


def test_a_delay_that_no_division_places_is_refused(make_loop):
    with pytest.raises(InputError, match="loop_delay_s"):
        make_loop(loop_delay_s=1.0137e-3)


def test_converter_rounds_and_clips_and_drives_clip():
    rig = load_rig("avis")
    converter = Converter(6, 2e-3, 1000.0)
    # Sensors that show nothing of the motion, but half their range of noise, often beyond the range.
    bank = replace(plain_bank(rig, converter, 1e-3), chains=(gain(0.0),) * 6)
    loop = SampledLoop(
        rig, gain([[200.0, 30.0], [-20.0, 400.0]]), ("z", "phi_x"), {}, bank, {}, limit_V=0.0503, loop_delay_s=1e-3
    )
    record = simulate(loop, 2.0, settle_s=0.0)
    codes = converter.convert(record.sensed)
    rows, columns = rig.sensor_rows()[1], rig.equations_of_motion().T
    force = np.linalg.pinv(rows)[[2, 3]] @ codes.T * np.array([[1.0], [rig.edge_m]])
    force = np.array([[200.0, 30.0], [-20.0, 400.0]]) @ force * np.array([[1.0], [rig.edge_m]])
    expected = (np.linalg.pinv(columns)[:, [2, 3]] @ force).T
    assert np.allclose(record.demanded, expected, rtol=0, atol=1e-12)
    assert np.array_equal(record.volts[1:], np.clip(record.demanded, -0.0503, 0.0503)[:-1])
    assert record.clipped_dac == np.count_nonzero(np.abs(expected) > 0.0503) > 0
    assert record.clipped_adc == np.count_nonzero(converter.clipped(record.sensed)) > 0


def test_an_unstable_loop_is_reported_as_diverged_without_a_nan(make_loop):
    loop = make_loop(factor=-20.0, limit_V=1e6)
    record = simulate(loop, 60.0)
    assert record.diverged and spectral_radius(loop) > 1
    assert 0 < len(record.time) < 60000
    for series in (record.q, record.q_dot, record.volts, record.demanded, record.sensed):
        assert len(series) == len(record.time) and np.all(np.isfinite(series))


def test_a_seed_gives_one_record(make_loop):
    first, again, other = (simulate(make_loop(), 2.0, seed=seed) for seed in (5, 5, 6))
    assert np.array_equal(first.q_dot, again.q_dot) and np.array_equal(first.sensed, again.sensed)
    assert not np.array_equal(first.q_dot, other.q_dot)


@pytest.mark.parametrize(("name", "delay_s"), [("avis", 1e-3), ("avis", 1.5e-3), ("halcyonics_loaded", 2.25e-3)])
def test_spectral_radius_is_the_growth_of_an_unstable_loop(make_loop, name, delay_s):
    loop = make_loop(name, 40.0, loop_delay_s=delay_s, limit_V=1e30, floor={})
    silent = replace(loop, sensors=replace(loop.sensors.white(), noise_rms_V=0.0, converter=None))
    record = simulate(silent, 20.0, settle_s=0.0, floor=at_rest(20000), initial=START * 1e-250, nonlinear=False)
    assert record.diverged
    # In the end the fastest pair is alone: v[k+1] = a v[k] - b v[k-1] throughout, roots of modulus sqrt(b).
    v = record.q_dot[-20:]
    (a, b), *_ = np.linalg.lstsq(np.column_stack([v[1:-1].ravel(), -v[:-2].ravel()]), v[2:].ravel(), rcond=None)
    assert spectral_radius(loop) == pytest.approx(np.sqrt(b), rel=1e-6) and np.sqrt(b) > 1.02
    said = re.search(r"at (\S+) Hz,.* grows with a time constant of (\S+) s", find_cause(loop).words())
    frequency_Hz = np.arccos(a / (2 * np.sqrt(b))) / (2 * np.pi) * loop.sample_rate_Hz
    assert float(said[1]) == pytest.approx(frequency_Hz, rel=0.01)
    assert float(said[2]) == pytest.approx(2 / np.log(b) / loop.sample_rate_Hz, rel=0.01)


def test_nonlinear_and_linear_tables_agree_in_closed_loop_at_micrometres(make_loop):
    for name in ("avis", "halcyonics_loaded"):
        true, linear = (simulate(make_loop(name), 5.0, nonlinear=nonlinear) for nonlinear in (True, False))
        assert np.all(np.abs(true.q_dot - linear.q_dot).max(axis=0) < 1e-5 * np.abs(linear.q_dot).max(axis=0))


def test_a_controller_that_is_already_sampled_is_taken_as_it_is(make_loop):
    loop = make_loop()
    given = replace(loop, K=discretise(loop.K, 1e-3))
    assert np.array_equal(simulate(loop, 1.0).volts, simulate(given, 1.0).volts)
    with pytest.raises(InputError, match="dt"):
        simulate(replace(loop, K=discretise(loop.K, 2e-3)), 1.0)


def test_wrong_sizes_and_names_are_named(make_loop):
    rig = load_rig("avis")
    with pytest.raises(InputError, match="axes, loops"):
        SampledLoop(rig, gain(np.eye(2)), ("z", "phi_x"), {"z": gain(1.0)}, plain_bank(rig), {})
    with pytest.raises(InputError, match="amplifier_corner_Hz"):
        make_loop("halcyonics", amplifier_corner_Hz=None)
    with pytest.raises(InputError, match="floor"):
        simulate(make_loop(), 1.0, floor=np.zeros((5, 6)))


def test_neglected_dynamics_of_a_drive_act_on_that_drive_alone(passive):
    """A drive error of 1.5 at all frequencies is a force constant 1.5 times as large."""
    loop = passive()
    half_more = [gain(1.5) if k == 3 else None for k in range(loop.n_drives)]
    rig = load_rig("avis")
    stronger = rig.with_parameters({"actuator.Az2": 1.5 * rig.parameters()["actuator.Az2"].value})
    active = replace(loop, K=gain(-900.0 * np.eye(2)))
    by_error = simulate(active.with_plant("error", drive_errors=half_more), 3.0, nonlinear=False)
    by_constant = simulate(active.with_plant("constant", stronger), 3.0, nonlinear=False)
    assert np.abs(by_error.q_dot - by_constant.q_dot).max() < 1e-9 * np.abs(by_constant.q_dot).max()
    nominal = simulate(active, 3.0, nonlinear=False)
    assert np.abs(by_error.q_dot - nominal.q_dot).max() > 1e-3 * np.abs(nominal.q_dot).max()
