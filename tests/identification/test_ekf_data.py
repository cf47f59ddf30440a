"""Prefilter, simulated campaign, figures, and input that the filter has to refuse."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.ekf import identify_ekf
from avis_ctrl.identification.ekf_model import linear_model, source_parameters
from avis_ctrl.identification.ekf_result import innovation_statistics, kinds
from avis_ctrl.identification.ekf_settings import (
    HONEST_SETTINGS,
    SOURCE_SETTINGS,
    EkfSettings,
    floor_noise,
    measurement_variance,
)
from avis_ctrl.identification.identifiability_text import main_members
from avis_ctrl.identification.prefilter import delayed, prefilter, sensor_inverse
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.equipment import Electronics
from avis_ctrl.rigs.rigid_body import COORDINATES
from benchmarks.rademakers_records import flat_floor, logical_drive, sensor_volts, source_campaign

FEW = ("mass", "isolator3.k_z")


@pytest.fixture(scope="module")
def campaign(avis):
    return source_campaign(avis, sets=2, duration_s=2.0, seed=4)


def record_of(avis, u, y, unit="V", rate=1000.0):
    header = RecordHeader(
        "00", rate, len(u), avis.equations_of_motion().actuators, avis.geophones.names, "noise", y_unit=unit
    )
    return Record(header, u, y)


# -- the simulated campaign ----------------------------------------------------------------------------------------


def test_the_simulation_is_what_an_integrator_of_the_equations_finds(avis, rng):
    """Held volts a sample late, floor velocity in ramps, geophone with its compensated corner in the time domain."""
    n, h = 40, 1e-3
    u, floor = rng.normal(size=(n, 8)), 1e-4 * rng.normal(size=(n + 1, 3))
    eom, (_, rows), g = avis.equations_of_motion(), avis.sensor_rows(), avis.geophones
    w = 2 * np.pi * g.compensated_Hz

    def slope(t, x, k):
        q, v, qf, sprung, moving = x[:6], x[6:12], x[12:15], x[15:21], x[21:27]
        vf = floor[k] + (floor[k + 1] - floor[k]) * (t - k * h) / h
        force = eom.K_floor[:, :3] @ qf + eom.C_floor[:, :3] @ vf - eom.K @ q - eom.C @ v
        a = np.linalg.solve(eom.M, force + (eom.T @ u[k - 1] if k else 0))
        # The compensated geophone: s^2/(s^2 + 2 zeta w s + w^2) of velocity is velocity less a damped spring's.
        back = -2 * g.compensated_damping * w * moving - w**2 * sprung + rows @ v
        return np.concatenate([v, a, vf, moving, back])

    x, volts = np.zeros(27), []
    for k in range(n):
        back = slope(k * h, x, k)[21:27]
        volts.append(back * np.array(g.sensitivity_Vs_per_m) * g.preamplifier_gain)
        x = solve_ivp(slope, (k * h, (k + 1) * h), x, args=(k,), rtol=1e-11, atol=1e-18).y[:, -1]
    found = sensor_volts(avis, u, floor)
    assert np.max(np.abs(found - volts)) < 1e-8 * np.max(np.abs(volts))


def test_drives_and_floor_have_the_variance_asked_for(avis, rng):
    u = logical_drive(avis, 200_000, rng)
    forces = u @ avis.equations_of_motion().T.T
    share = np.corrcoef(forces.T) - np.eye(6)
    assert np.max(np.abs(share)) < 0.02  # each axis by itself
    # x is driven by Ax2 and Ax4 with one volt each: 4 N/V at 0.25 V^2.
    assert np.var(forces[:, COORDINATES.index("x")]) == pytest.approx(16 * 0.25, rel=0.02)
    floor = flat_floor(200_000, 1000.0, 2e-6, rng)
    spectrum = np.abs(np.fft.rfft(floor, axis=0)) ** 2
    f = np.fft.rfftfreq(200_000, 1e-3)
    density = 2e-6**2 / 59.5
    assert 2 * np.mean(spectrum[(f > 1) & (f < 40)]) / (200_000 * 1000) == pytest.approx(density, rel=0.03)
    assert np.allclose(np.std(floor, axis=0), 2e-6, rtol=0.05)


def test_records_are_seeded_and_differ(avis, campaign):
    again = source_campaign(avis, sets=1, duration_s=2.0, seed=4)
    assert np.array_equal(again.records[0].y, campaign.records[0].y)
    assert not np.allclose(campaign.records[0].u, campaign.records[1].u)


# -- prefilter -----------------------------------------------------------------------------------------------------


def velocities(avis, volts_per_motion, u):
    """Exact velocities along the sensors: a rig whose geophones have no corner to speak of."""
    ideal = replace(avis, geophones=replace(avis.geophones, compensated_Hz=1e-9))
    return sensor_volts(ideal, u, np.zeros((len(u) + 1, 3))) / volts_per_motion


def test_the_chain_is_undone_behind_the_high_pass(avis, rng):
    """Against the exact velocity through the same high-pass; left in, the chain would err by a fifth."""
    u = logical_drive(avis, 20_000, rng)
    volts, gain = sensor_volts(avis, u, np.zeros((len(u) + 1, 3))), 3125.0
    motion = velocities(avis, gain, u)
    acting, found = prefilter(record_of(avis, u, volts), sensor_inverse(avis, avis.geophones.names, "V"), 1e-3)
    plain = sensor_inverse(avis, avis.geophones.names, "m/s")
    delayed_u, right = prefilter(record_of(avis, u, motion, "m/s"), plain, 1e-3)
    assert np.std(found - right) < 5e-5 * np.std(right)
    assert np.array_equal(acting, delayed_u)
    left_in = prefilter(record_of(avis, u, volts / gain, "m/s"), plain, 1e-3)[1]
    assert 0.1 < np.std(left_in - right) / np.std(right) < 0.5


def test_the_anti_alias_filter_acts_on_voltages_and_motion_alike(avis):
    """A sine of 20 Hz through force and chain: both come out turned by the filter, and by nothing else."""
    electronics = Electronics(anti_alias_corner_Hz=100.0, anti_alias_order=4)
    filtered = replace(avis, electronics=electronics)
    t, s = np.arange(20_000) / 1000, 2j * np.pi * 20.0
    chain = filtered.sensors()[0].chain().frequency_response(np.array([s.imag]))[0, 0, 0]
    turn = np.prod([pole / (pole - s) for pole in electronics.low_pass()])
    assert abs(turn - 1) > 0.4
    motion, inverse = np.exp(s * t)[:, None], sensor_inverse(filtered, avis.geophones.names, "V")
    for part in (np.real, np.imag):
        record = record_of(avis, part(motion) * np.ones(8), part(chain * motion) * np.ones(6))
        seen_u, seen_y = prefilter(record, inverse, 0.0)
        plain = prefilter(
            record_of(avis, part(turn * motion) * np.ones(8), part(turn * motion) * np.ones(6), "m/s"),
            sensor_inverse(avis, avis.geophones.names, "m/s"),
            0.0,
        )
        for found, right in zip((seen_u, seen_y), plain, strict=True):
            # Tustin's rule shifts 20 Hz by (w h)^2 / 12 = 1.3e-3 of itself.
            assert np.max(np.abs(found - right)[15_000:]) < 3e-3


def test_units_of_y(avis, rng):
    """A sine of 5 Hz as acceleration becomes velocity; displacement stays what it is."""
    t, w = np.arange(20_000) / 1000, 2 * np.pi * 5
    u, late = np.zeros((len(t), 8)), slice(15_000, None)
    out = {}
    for unit, y in (("m/s", np.sin(w * t)), ("m/s^2", w * np.cos(w * t)), ("m", -np.cos(w * t) / w)):
        inverse = sensor_inverse(avis, avis.geophones.names, unit)
        out[unit] = prefilter(record_of(avis, u, y[:, None] * np.ones(6), unit), inverse, 0.0)[1][late, 0]
        assert inverse.motion == ("displacement" if unit == "m" else "velocity")
    # Tustin's integrator lags sin by less than (w h)^2 / 12 = 8e-5 of it.
    assert np.max(np.abs(out["m/s^2"] - out["m/s"])) < 2e-4
    assert np.std(out["m"]) == pytest.approx(np.std(out["m/s"]) / w, rel=1e-4)


def test_delay():
    u = np.arange(5.0)[:, None] + 1
    assert np.array_equal(delayed(u, 2.0)[:, 0], [0, 0, 1, 2, 3])
    assert np.array_equal(delayed(u, 0.0)[:, 0], u[:, 0])
    assert np.allclose(delayed(u, 1.25)[:, 0], [0, 0.75, 1.75, 2.75, 3.75])
    assert np.array_equal(delayed(u, 9.0), np.zeros((5, 1)))


# -- settings and figures ------------------------------------------------------------------------------------------


def test_the_sources_settings():
    s = SOURCE_SETTINGS
    assert (s.q_sigma, s.v_sigma, s.prior_share, s.Q, s.R) == (2.5e-6, 1e-8, 0.25, 1e-8, 1e-8)
    assert (s.highpass_Hz, s.highpass_order, s.reset) == (1.0, 6, True)


def test_honest_noise_is_the_rigs(avis):
    names = avis.geophones.names
    lsb = 20 / 2**14
    assert np.allclose(measurement_variance(HONEST_SETTINGS, avis, names, "V"), (1e-6 + lsb**2 / 12) / 3125**2)
    floor = floor_noise(HONEST_SETTINGS, avis)
    assert floor.density == pytest.approx(4e-12 / (2 * 59.5)) and floor_noise(SOURCE_SETTINGS, avis) is None
    by_f, by_w = floor.acceleration(avis)
    # x by hand: four isolators of 84 kN/m and 375 N s/m in all on 500 kg.
    assert by_w[0, 0] == pytest.approx(375 / 500) and by_f[0, 0] == pytest.approx((84e3 - np.pi * 375) / 500)


def test_white_innovations_are_consistent_and_others_not(rng):
    white = rng.normal(size=(20_000, 6))
    assert innovation_statistics(white).consistent
    assert not innovation_statistics(1.05 * white).consistent
    coloured = (white[1:] + white[:-1]) / np.sqrt(2)
    found = innovation_statistics(coloured)
    assert not found.consistent and np.allclose(found.autocorrelation[0], 0.5, atol=0.03)


@pytest.mark.slow
def test_curves_of_the_sources_figures(avis, campaign):
    names = source_parameters(avis)
    result = identify_ekf(avis, campaign, names=names)
    assert {title: len(index) for title, index in kinds(result).items()} == {
        "Mass and inertia": 4,
        "Damping": 11,
        "Stiffness": 11,
    }
    curves = result.history
    assert curves.theta.shape == curves.lower.shape == (4, 26) == (len(curves.time_s), 26)
    assert np.all(curves.lower < curves.theta) and np.all(curves.theta < curves.upper)
    # At the first sample nothing is known yet: the band is twice 25 % either way.
    assert np.allclose(curves.upper[0, :4] / curves.theta[0, :4], 1.5, rtol=1e-2)


# -- input to refuse -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "names, message",
    [
        (("mas",), "did you mean 'mass'"),
        (("mass", "mass"), "each parameter once"),
        (("com_x",), "positive starting value"),
        (("J12",), "positive starting value"),
        (("isolator2.p_x",), "moves actuators or sensors"),
        (("actuator.Ay1",), "moves actuators or sensors"),
        (("isolator1.p_z",), "positive starting value"),
    ],
)
def test_parameters_that_the_filter_cannot_take(avis, campaign, names, message):
    with pytest.raises(InputError, match=message):
        identify_ekf(avis, campaign, SOURCE_SETTINGS, names)


def test_a_parameter_that_is_not_linear_is_refused(avis):
    """The centre of mass enters the inertia by its square."""
    with pytest.raises(InputError, match="must be linear"):
        linear_model(avis.with_parameters({"com_x": 0.1}), ("com_x",))


def test_parameters_of_another_rig(campaign):
    with pytest.raises(InputError, match="name the parameters"):
        source_parameters(load_rig("halcyonics"))
    with pytest.raises(InputError):
        identify_ekf(load_rig("halcyonics"), campaign, names=("mass",))


@pytest.mark.parametrize(
    "change, message", [({"highpass_Hz": 600.0}, "between 0 and 500"), ({"highpass_order": 2}, "whole number from 3")]
)
def test_settings_that_make_no_sense(avis, campaign, change, message):
    with pytest.raises(InputError, match=message):
        identify_ekf(avis, campaign, EkfSettings(**change), FEW)


@pytest.mark.parametrize(
    "change",
    [
        {"prior_share": 0.0},
        {"q_sigma": -1.0},
        {"v_sigma": float("inf")},
        {"R": -1e-8},
        {"R": float("nan")},
        {"Q": -1.0},
        {"lowest": 1.5},
        {"highpass_Hz": "1"},
        {"history_s": 0.0},
        {"warm_up": -1},
    ],
)
def test_settings_are_checked_by_name(change):
    with pytest.raises(InputError, match=next(iter(change))):
        EkfSettings(**change)


def test_data_that_do_not_fit(avis, campaign):
    record = campaign.records[0]
    with pytest.raises(InputError, match="expected V, m"):
        identify_ekf(avis, [replace(record, header=replace(record.header, y_unit="mm"))], names=FEW)
    with pytest.raises(InputError, match="commanded voltages"):
        identify_ekf(avis, [replace(record, header=replace(record.header, u_unit="N"))], names=FEW)
    with pytest.raises(InputError, match="at least one record"):
        identify_ekf(avis, [], names=FEW)
    with pytest.raises(InputError, match="state R"):
        identify_ekf(avis, [replace(record, header=replace(record.header, y_unit="m/s"))], HONEST_SETTINGS, FEW)
    with pytest.raises(InputError, match="sensors of the rig"):
        identify_ekf(avis, [replace(record, header=replace(record.header, y_names=tuple("abcdef")))], names=FEW)
    with pytest.raises(InputError, match="u names"):
        identify_ekf(avis, [replace(record, header=replace(record.header, u_names=tuple("abcdefgh")))], names=FEW)
    other = replace(record, header=replace(record.header, name="01", sample_rate_Hz=500.0))
    with pytest.raises(InputError, match="sample_rate_Hz"):
        identify_ekf(avis, Campaign("avis", (record, other)), names=FEW)
    with pytest.raises(InputError, match="ambient"):
        source_campaign(replace(avis, ambient=None))
    with pytest.raises(InputError, match="ambient floor motion"):
        floor_noise(HONEST_SETTINGS, replace(avis, ambient=None))
    with pytest.raises(InputError, match="at least one set"):
        source_campaign(avis, sets=0)


def test_a_filter_that_diverges_says_where(avis, campaign):
    """Volts beyond all measure carry a mass below zero when nothing guards it."""
    record = campaign.records[0]
    loud = replace(record, y=record.y * 1e200)
    with pytest.raises(ComputationError, match=r"diverged in record 00; measured: after .* s of 2 s"):
        identify_ekf(avis, [loud], SOURCE_SETTINGS, FEW)


def test_some_channels_are_enough(avis, campaign):
    """Records of four geophones and the vertical motors."""
    record = campaign.records[0]
    header = replace(
        record.header,
        u_names=tuple(record.header.u_names[k] for k in (1, 3, 5, 7)),
        y_names=tuple(record.header.y_names[k] for k in (1, 3, 5)),
    )
    picked = Record(header, record.u[:, [1, 3, 5, 7]], record.y[:, [1, 3, 5]])
    result = identify_ekf(avis, [picked], SOURCE_SETTINGS, FEW)
    assert result.values.shape == (2,) and np.all(np.isfinite(result.sigma))


def test_the_main_members_of_a_direction():
    """Nine tenths of it, the largest first and positive; members that carry a tenth or less are left out."""
    assert main_members(("a", "b", "c"), np.array([1.0, 0.0, 0.0])) == [("a", 1.0)]
    assert main_members(("a", "b", "c"), np.array([0.0, -0.6, 0.8])) == [("c", 0.8), ("b", -0.6)]
    assert main_members(("a", "b", "c"), np.array([-0.3, 0.0, -0.95])) == [("c", 0.95)]
