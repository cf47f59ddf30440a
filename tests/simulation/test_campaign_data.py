"""Simulated campaigns against the exact sampled response, the predicted ambient spectrum and what was planned."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg as la
from scipy import signal, stats

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import gain
from avis_ctrl.measurement.campaign import digest
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.floor_spectrum import shipped_spectrum
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.discrete import digital_controller
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.simulation.spectrum_check import SETTINGS, welch_moments

SILENT = {"ambient": {"velocity_rms_m_per_s": 0.0}, "sensors": {"noise": False, "quantiser": False}, "settle_s": 0.0}


def plan(*records, **changes) -> CampaignPlan:
    return CampaignPlan.model_validate(
        {
            "record": list(records),
            "duration_s": 20.0,
            "band_Hz": [1.0, 50.0],
            "ambient": {"velocity_rms_m_per_s": 2e-6},
            "multisine": {"low_crest": False},
        }
        | changes
    )


def continuous(rig, amplifier_Hz):
    """A, B, C, D from drives to sensor volts, put together by hand from the equations of motion."""
    eom, H = rig.equations_of_motion(), rig.sensor_rows()[1]
    n, n_s, n_u = 6, len(H), eom.T.shape[1]
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-la.solve(eom.M, eom.K), -la.solve(eom.M, eom.C)]])
    B = np.vstack([np.zeros((n, n_u)), la.solve(eom.M, eom.T)])
    if amplifier_Hz:
        w = 2 * np.pi * amplifier_Hz
        A = np.block([[A, B], [np.zeros((n_u, 2 * n)), -w * np.eye(n_u)]])
        B = np.vstack([np.zeros((2 * n, n_u)), w * np.eye(n_u)])
    if rig.geophones is not None:
        g = rig.geophones
        felt = np.hstack([np.zeros((n_s, n)), H, np.zeros((n_s, len(A) - 2 * n))])
        w, k = 2 * np.pi * g.compensated_Hz, g.preamplifier_gain * np.array(g.sensitivity_Vs_per_m)
        chain = signal.tf2ss([1, 0, 0], [1, 2 * g.compensated_damping * w, w * w])
    else:
        a = rig.accelerometers
        felt = H @ A[6:12]
        w, k = 2 * np.pi * a.low_corner_Hz, a.sensitivity_Vs2_per_m * np.ones(n_s)
        chain = signal.tf2ss([1, 0], [1, w])
    a_, b_, c_, d_ = (np.kron(np.eye(n_s), part) for part in chain)
    A = np.block([[A, np.zeros((len(A), len(a_)))], [b_ @ felt, a_]])
    B = np.vstack([B, np.zeros((len(a_), n_u))])
    return A, B, k[:, None] * np.hstack([d_ @ felt, c_]), np.zeros((n_s, n_u))


@pytest.mark.parametrize(("name", "amplifier"), [("avis", None), ("avis", 200.0), ("halcyonics_loaded", 300.0)])
@pytest.mark.parametrize("kind", ["multisine", "noise"])
def test_a_noise_free_record_is_the_exact_response_to_held_delayed_voltages(name, amplifier, kind):
    rig = load_rig(name)
    one = {"excitation": kind, "level_percent": 2.0}
    records = {
        nonlinear: simulate_campaign(
            rig, plan(one, **SILENT, amplifier_corner_Hz=amplifier, truth={"nonlinear": nonlinear})
        ).records[0]
        for nonlinear in (False, True)
    }
    *system, _ = signal.cont2discrete(continuous(rig, amplifier), 1e-3, "zoh")
    u = records[False].u
    delayed = np.vstack([np.zeros((1, u.shape[1])), u[:-1]])  # one sample: loop_delay_s of both rigs
    _, expected, _ = signal.dlsim((*system, 1e-3), delayed)
    size = np.abs(expected).max(axis=0)
    assert np.all(np.abs(records[False].y - expected).max(axis=0) < 1e-9 * size)
    assert np.array_equal(records[True].u, u)
    # The nonlinear table adds what turning by 1e-4 rad does.
    assert np.all(np.abs(records[True].y - expected).max(axis=0) < 1e-3 * size)
    assert not np.array_equal(records[True].y, records[False].y)


@pytest.mark.parametrize("name", ["avis", pytest.param("halcyonics", marks=pytest.mark.slow)])
def test_after_the_transient_periods_repeat_with_the_sampled_frequency_response(name):
    rig = load_rig(name)
    campaign = simulate_campaign(
        rig,
        plan(
            {"excitation": "multisine"},
            **SILENT,
            duration_s=60.0,
            multisine={"scheme": "orthogonal", "low_crest": False},
            truth={"nonlinear": False},
        ),
    )
    assert len(campaign.records) == 8
    system = continuous(rig, None if name == "avis" else 300.0)
    Ad, Bd, Cd, Dd, _ = signal.cont2discrete(system, 1e-3, "zoh")
    decay = np.exp(np.max(la.eigvals(system[0]).real) * 10.0)
    k = np.arange(10, 501)
    z = np.exp(2j * np.pi * k / 10000)
    G = Cd @ la.solve(z[:, None, None] * np.eye(len(Ad)) - Ad, np.broadcast_to(Bd, (k.size, *Bd.shape))) + Dd
    for record in campaign.records[:2]:
        periods = record.y.reshape(6, 10000, -1)
        steps = np.abs(np.diff(periods, axis=0)).max(axis=(1, 2))
        size = np.abs(periods[-1]).max()
        # From rest: the first period differs, and each step to the next falls at least like the slowest pole.
        assert steps[0] > 1e-3 * size
        assert np.all(steps[1:] < 2 * decay * steps[:-1] + 1e-9 * size)
        assert steps[-1] < 1e-4 * size
        U, Y = (np.fft.rfft(one[-10000:], axis=0)[k] for one in (record.u, record.y))
        expected = (G @ U[:, :, None])[..., 0] / z[:, None]
        assert np.abs(Y - expected).max() < 1e-3 * np.abs(expected).max()


def ambient_density(rig, f):
    """(n_s, n_f) one-sided density of y at rest: floor through table and geophones, noise, rounding."""
    eom, H, g = rig.equations_of_motion(), rig.sensor_rows()[1], rig.geophones
    s = 2j * np.pi * f[:, None, None]
    velocity = la.solve(s * s * eom.M + s * eom.C + eom.K, s * eom.C_floor + eom.K_floor)[:, :, :3]
    w = 2 * np.pi * g.compensated_Hz
    chain = 3125.0 * s * s / (s * s + 2 * g.compensated_damping * w * s + w * w)
    floor = shipped_spectrum("kamioka_quiet").scaled_to_rms(2e-6, 0.5, 60.0)
    density = floor.asd(f, "velocity") ** 2 * (f >= floor.low_Hz) * np.sinc(f / 1000.0) ** 4
    white = 1e-3**2 + (20.0 / 2**14) ** 2 / 12
    return np.sum(np.abs(chain * (H @ velocity)) ** 2, axis=2).T * density + 2e-3 * white


def test_the_ambient_level_of_a_rest_record_is_the_predicted_spectrum():
    """Octaves and decades of each channel within chi-square bounds, one false alarm in a thousand such tests."""
    rig = load_rig("avis")
    record = simulate_campaign(rig, plan({"excitation": "rest", "duration_s": 200.0}), 11).records[0]
    assert np.all(record.u == 0)
    segment, edges_Hz = 8000, np.array([0.5, 1, 2, 4, 8, 16, 32, 64, 128])
    _, estimate = signal.welch(record.y, 1000.0, "hann", segment, axis=0)
    edges = (edges_Hz * 8).astype(int)
    lines, segments = edges[-1], 2 * len(record.y) // segment - 1
    fine = np.arange(1, (lines + SETTINGS.lines) * SETTINGS.points_per_line + 1) / 8.0 / SETTINGS.points_per_line
    tail = 1e-3 / (6 * 8) / 2
    for channel, psd in enumerate(np.pad(ambient_density(rig, fine), ((0, 0), (1, 0)))):
        mean, covariance = welch_moments(psd, segments)
        for lo, hi in pairwise(edges):
            variance = sum(
                (1 if d == 0 else 2) * covariance[lo : hi - d, d].sum() for d in range(min(SETTINGS.lines, hi - lo))
            )
            dof = 2 * mean[lo:hi].sum() ** 2 / variance
            ratio = estimate[lo:hi, channel].sum() / mean[lo:hi].sum()
            assert stats.chi2.ppf(tail, dof) / dof < ratio < stats.chi2.isf(tail, dof) / dof, (channel, lo)
            assert dof > 50


@pytest.mark.slow
def test_a_seed_gives_one_campaign_and_its_records_differ():
    rig = load_rig("avis")
    asked = plan(
        {"excitation": "multisine", "records": 2},
        {"excitation": "noise"},
        {"excitation": "rest", "records": 2},
        {"excitation": "floor", "floor_rms_m_per_s": 1e-4},
        floor_sensor={"noise_rms_m_per_s": 1e-8},
    )
    first, again, other = (simulate_campaign(rig, asked, seed) for seed in (1, 1, 2))
    assert digest(first) == digest(again) != digest(other) and first.notes == again.notes
    assert [r.header.excitation for r in first.records] == ["multisine"] * 2 + ["noise"] + ["rest"] * 2 + ["floor"]
    assert [r.header.name for r in first.records] == [f"0{k}" for k in range(6)]
    assert np.allclose([r.header.start_s for r in first.records], 10.0 + 30.0 * np.arange(6))
    floors = np.hstack([r.floor for r in first.records])
    correlation = np.corrcoef(floors.T) - np.eye(18)
    # The quiet mine's floor moves below 1 Hz: some 10 independent samples in 20 s.
    assert np.abs(correlation).max() < 0.9 and np.median(np.abs(correlation)) < 0.3
    assert not np.array_equal(first.records[3].y, first.records[4].y)
    # Zippered: the second record's lines are dealt on by one.
    U = [np.abs(np.fft.rfft(r.u[:10000], axis=0)) > 1.0 for r in first.records[:2]]
    assert np.array_equal(U[0][:, 1:], U[1][:, :-1]) and not np.any(U[0] & U[1])


def test_records_start_after_whole_samples():
    """The drives are silent for a whole number of samples: 7 of the 7.4 that 0.0074 s are."""
    rig = load_rig("avis")
    made = simulate_campaign(rig, plan({"excitation": "noise", "records": 2}, duration_s=1.0, settle_s=0.0074), 1)
    assert [r.header.start_s for r in made.records] == pytest.approx([0.007, 1.014], abs=1e-12)


def test_what_the_converter_reports():
    rig = load_rig("avis")
    lsb = 20.0 / 2**14
    quiet = simulate_campaign(rig, plan({"excitation": "multisine"}, {"excitation": "noise"}), 3)
    for record in quiet.records:
        assert np.array_equal(record.y, np.round(record.y / lsb) * lsb) and np.abs(record.y).max() < 9.9
    assert not any("WARNING" in note for note in quiet.notes)
    largest = quiet.records[0].header.level_V / 0.5
    loud, bare = (
        simulate_campaign(rig, plan({"excitation": "multisine", "level_V": 3 * largest}, sensors={"quantiser": on}), 3)
        for on in (True, False)
    )
    y, volts = loud.records[0].y, bare.records[0].y
    assert y.max() == 10.0 - lsb and y.min() == -10.0
    assert np.array_equal(y, np.clip(np.floor(volts / lsb + 0.5) * lsb, -10.0, 10.0 - lsb))
    (note,) = [note for note in loud.notes if "WARNING" in note]
    count = int(note.split("WARNING: ")[1].split(" samples")[0])
    assert count == np.count_nonzero((volts > 10.0 - lsb / 2) | (volts < -10.0 - lsb / 2)) > 0


def test_levels_are_those_asked_for():
    rig = load_rig("avis")
    campaign = simulate_campaign(
        rig,
        plan(
            {"excitation": "multisine", "level_percent": 10.0},
            {"excitation": "multisine", "level_V": 0.123},
            {"excitation": "rest"},
            {"excitation": "floor", "floor_rms_m_per_s": 3e-4},
        ),
    )
    a, b, rest, floor = campaign.records
    assert np.allclose(np.sqrt(np.mean(b.u**2, axis=0)), 0.123) and b.header.level_V == pytest.approx(0.123)
    assert np.allclose(np.sqrt(np.mean(a.u**2, axis=0)), a.header.level_V)
    assert a.header.period_s == 10.0 and rest.header.period_s is None and rest.header.level_V == 0.0
    shaken = np.sqrt(np.mean(floor.floor**2, axis=0))
    assert np.allclose(shaken, 3e-4, rtol=0.1)  # 2 x 980 degrees of freedom: 2.3 % standard deviation
    power = np.abs(np.fft.rfft(floor.floor, axis=0)) ** 2
    assert np.sum(power[1001:]) < 1e-3 * np.sum(power)
    assert "u 0.123 V r.m.s." in campaign.notes[3] and campaign.notes[3].startswith("Record 01 (multisine)")
    # Both motions of the floor reach the payload; the silent drives do not.
    assert np.all(floor.u == 0) and np.std(floor.y) > 20 * np.std(rest.y)


def test_the_floor_sensor():
    rig = load_rig("avis")
    exact, noisy, absent = (
        simulate_campaign(rig, plan({"excitation": "rest"}, floor_sensor=how)).records[0]
        for how in ({}, {"noise_rms_m_per_s": 1e-6}, {"recorded": False})
    )
    assert absent.floor is None and absent.header.floor_names == ()
    assert exact.header.floor_names == ("vx", "vy", "vz") and np.array_equal(exact.y, absent.y)
    assert np.array_equal(exact.y, noisy.y)
    assert np.allclose(np.std(noisy.floor - exact.floor, axis=0), 1e-6, rtol=0.03)


@pytest.mark.slow
def test_the_shipped_rigs_do_not_clip_by_default():
    for name in ("avis", "halcyonics_loaded"):
        campaign = simulate_campaign(
            load_rig(name),
            plan(
                {"excitation": "multisine"},
                {"excitation": "noise"},
                {"excitation": "floor", "floor_rms_m_per_s": 2e-4},
                multisine={"low_crest": True},
            ),
        )
        assert not any("WARNING" in note for note in campaign.notes)
        for record in campaign.records[:2]:
            assert 2.0 < np.abs(record.y).max() < 10.0 and np.abs(record.u).max() <= 10.0
    assert any("levels chosen for a range of 10 V" in note for note in campaign.notes)


@pytest.mark.parametrize(
    ("name", "records", "changes", "expected"),
    [
        ("avis", [{"excitation": "multisine", "level_V": 9.0}], {}, r"record\[1\].level_V = 9.0: expected at most"),
        ("avis", [{"excitation": "rest"}, {"excitation": "noise", "level_V": 4.0}], {}, r"record\[2\].level_V = 4.0"),
        ("avis", [{"excitation": "multisine", "duration_s": 19.0}], {}, r"record\[1\].duration_s = 19.0.*two periods"),
        (
            "avis",
            [{"excitation": "multisine"}],
            {"band_Hz": [1.0, 500.0]},
            r"record\[1\].band_Hz.*half the sample rate",
        ),
        (
            "avis",
            [{"excitation": "floor", "floor_rms_m_per_s": 1e-5}],
            {"band_Hz": [1.0, 600.0]},
            r"record\[1\].band_Hz",
        ),
        (
            "avis",
            [{"excitation": "floor", "floor_rms_m_per_s": 1e-5}],
            {"band_Hz": [1.01, 1.02]},
            r"record\[1\].band_Hz",
        ),
        ("avis", [{"excitation": "multisine"}], {"multisine": {"period_s": 1.00005}}, "period_s.*whole number"),
        ("avis", [{"excitation": "floor", "floor_rms_m_per_s": 1e-5}], {"duration_s": 1e-4}, r"record\[1\].duration_s"),
        ("avis", [{"excitation": "rest", "records": 200}], {"duration_s": 600.0}, r"record\[1\].duration_s.*in all"),
        ("avis", [{"excitation": "rest"}], {"duration_s": 36000.0}, r"record\[1\].duration_s"),
        ("halcyonics", [{"excitation": "rest"}], {"ambient": {}}, "ambient.velocity_rms_m_per_s: missing"),
    ],
)
def test_plans_that_a_rig_cannot_follow(name, records, changes, expected):
    with pytest.raises(InputError, match=expected) as caught:
        simulate_campaign(load_rig(name), plan(*records, **changes))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="seed"):
        simulate_campaign(load_rig(name), plan(*records), -1)


def test_a_table_that_leaves_its_stops_is_reported():
    with pytest.raises(ComputationError, match="record 00: the table moved beyond its stops"):
        simulate_campaign(load_rig("avis"), plan({"excitation": "floor", "floor_rms_m_per_s": 1.0}))


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_a_drive_adds_to_the_controllers_demand(make_loop, name):
    loop = make_loop(name)
    drive = np.random.default_rng(5).standard_normal((3000, loop.n_drives)) * 0.3
    record = simulate(loop, 3.0, settle_s=0.0, drive=drive)
    C = digital_controller(loop)
    read = record.sensed if loop.sensors.converter is None else loop.sensors.converter.convert(record.sensed)
    _, fed_back, _ = signal.dlsim((C.A, C.B, C.C, C.D, 1e-3), read)
    assert np.abs(fed_back).max() > 0.01 * np.abs(drive).max()
    assert np.allclose(record.demanded, fed_back + drive, rtol=0, atol=1e-9)
    zero = simulate(loop, 3.0, settle_s=0.0, drive=np.zeros((3000, loop.n_drives)))
    assert np.array_equal(zero.sensed, simulate(loop, 3.0, settle_s=0.0).sensed)
    for wrong in (drive[:-1], drive[:, :-1], drive * np.nan):
        with pytest.raises(InputError, match="drive"):
            simulate(loop, 3.0, settle_s=0.0, drive=wrong)


def test_a_loop_without_controller_is_the_passive_table(passive):
    loop = passive("avis")
    free = replace(loop, K=gain(np.zeros((0, 0))), axes=(), loops={})
    one, two = (simulate(which, 5.0, seed=8) for which in (loop, free))
    assert np.array_equal(one.sensed, two.sensed) and not np.any(two.demanded)
