"""The library as a whole: names, places and ranges of the contract; sensors, drives and amplitude; derivatives."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from assembled_table import Assembly, chain, mount_map
from numpy.testing import assert_allclose

from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.mounts import drifted
from avis_ctrl.gap.motion_estimate import mount_rows
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.search import nearly_best, searched
from avis_ctrl.gap.settings import SETTINGS
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.gap.tolerances import has_tolerance, of_effect, of_values, within_tolerance
from avis_ctrl.identification.maximum_likelihood import block_residual, whitener
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.priors import tolerances_of
from avis_ctrl.identification.response import AMPLIFIERS, ResponseModel
from avis_ctrl.identification.spectra import record_block
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Record, RecordHeader
from avis_ctrl.rigs import load_rig

RIG = load_rig("avis")
BARE = TableModel(ResponseModel.of(RIG, default_parameters(RIG)))
ANALOGUE = TableModel(ResponseModel.of(RIG, (), sampled=False))
F = np.geomspace(0.3, 150.0, 40)
OMEGA = 2 * np.pi * F
SIGNALS = {"mains_hum", "sensor_quantisation", "ground_motion"}  # recognised in the records, not by refits
OWN = {name: one for name, one in library().items() if type(one).__module__.startswith("avis_ctrl.")}
EVERYWHERE = [(name, place) for name, one in OWN.items() for place in one.places(BARE)]


def with_effect(name, place, values, model=BARE):
    return model.with_effect(active(library()[name], model, place, values))


# --- the contract


@pytest.fixture
def contract(shared):
    """Location by name, from the table of the contract."""
    text = (shared / "contracts" / "gap.md").read_text(encoding="utf-8")
    return {match[1]: match[2] for match in re.finditer(r"^\| `(\w+)` \|.*\| (.+) \|$", text, re.MULTILINE)}


def test_names_and_locations_are_those_of_the_contract(contract):
    assert len(contract) == 24
    assert set(OWN) == set(contract) - SIGNALS
    own = {"sensor": set(BARE.sensors.names), "actuator": set(BARE.actuators)}
    for name, effect in OWN.items():
        words = contract[name]
        expected = own.get(words) or set(re.findall(r"`([^`]+)`", words))
        assert {place.partition("/")[0] for place in effect.places(BARE)} == expected, name


@pytest.mark.parametrize(("name", "place"), EVERYWHERE)
def test_parameters_have_units_ranges_and_a_start_within(name, place):
    effect = OWN[name]
    assert effect.title
    assert effect.looks_like
    parameters = effect.parameters(BARE, place)
    assert len({one.name for one in parameters}) == len(parameters)
    for one in parameters:
        assert one.unit
        assert one.description
        assert one.low < one.high
        assert 0 < one.size <= max(abs(one.low), abs(one.high))
        if one.linear:
            assert one.low <= one.none <= one.high
        else:
            assert one.grid
            assert all(one.low <= value <= one.high for value in one.grid)
    for start in effect.starts(BARE, place):
        assert len(start) == len(parameters)


@pytest.mark.parametrize("name", ["halcyonics", pytest.param("halcyonics_loaded", marks=pytest.mark.slow)])
def test_effects_that_a_rig_has_no_place_for_have_none(name):
    """The Halcyonics has no mounts by name and no geophones."""
    rig = load_rig(name)
    model = TableModel(ResponseModel.of(rig, ()))
    for effect in OWN.values():
        for place in effect.places(model):
            for one in effect.parameters(model, place):
                assert np.all(np.isfinite([one.low, one.high, one.size, *one.grid])), effect.name
            assert np.all(np.isfinite(with_effect(effect.name, place, None, model).response(OMEGA[:3])))
    assert not OWN["geophone_corner"].places(model)
    assert not OWN["mount_surge"].places(model)


# --- the model itself


@pytest.mark.parametrize("name", ["avis", "halcyonics", "halcyonics_loaded"])
def test_without_effects_the_table_is_the_response_model(name):
    rig = load_rig(name)
    base = ResponseModel.of(rig, default_parameters(rig))
    rng = np.random.default_rng(1)
    U = rng.standard_normal((len(F), len(base.inputs) + 12, 2)) + 1j * rng.standard_normal((len(F), 1, 2))
    found, true = TableModel(base).driven(OMEGA, U), base.driven(OMEGA, U)
    np.testing.assert_allclose(found.Y, true.Y, rtol=1e-9, atol=1e-12 * np.abs(true.Y).max())
    size = np.abs(true.dY).max(axis=(1, 2, 3), keepdims=True)
    assert np.all(np.abs(found.dY - true.dY) <= 1e-8 * size)


NONE_ELSEWHERE = {"base_compliance", "mount_surge", "actuator_saturation"}  # none at a limit: tested by themselves


@pytest.mark.parametrize(("name", "place"), [pair for pair in EVERYWHERE if pair[0] not in NONE_ELSEWHERE])
def test_without_strength_nothing_changes(name, place):
    model = with_effect(name, place, None, MOVING)
    np.testing.assert_allclose(
        model.answer(BLOCK, derivative=False).Y, MOVING.answer(BLOCK, derivative=False).Y, rtol=1e-10, atol=0
    )


def test_a_surge_of_no_mass_is_none():
    model = with_effect("mount_surge", "isolators z", [1e9, 0.5, 0.1, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(model.response(OMEGA), BARE.response(OMEGA), rtol=1e-6)


def test_unequal_contacts_push_as_each_alone():
    values = values_at("contact_friction", "actuators")
    model = with_effect("contact_friction", "actuators", values, MOVING)
    record, own = MOVING.motion["00"], OWN["contact_friction"]
    equal = dict(zip(("stiffness_N_per_m", "slip_m"), values[:2], strict=True))
    shares = np.array([*values[2:], -sum(values[2:])])
    alone = [
        own.force(replace(record, driven_rows=record.driven_rows[k : k + 1]), "actuators", equal) for k in range(8)
    ]
    np.testing.assert_allclose(
        own.force(record, "actuators", model.effects[-1].by_name),
        sum((1 + s) * one for s, one in zip(shares, alone, strict=True)),
        rtol=1e-12,
        atol=1e-15,
    )


@pytest.mark.parametrize(("name", "place"), EVERYWHERE)
def test_what_is_reported_is_finite_at_every_bound(name, place):
    """A refit may end there, also one that is only told among the runners-up."""
    parameters = OWN[name].parameters(MOVING, place)
    start = np.array(values_at(name, place), float)
    for one in parameters:
        for bound in (one.low, one.high):
            values = {p.name: float(v) for p, v in zip(parameters, start, strict=True)} | {one.name: bound}
            told = OWN[name].reported(MOVING, place, values, np.eye(len(start)) * 1e-6)
            assert told
            assert np.all(np.isfinite([(p.value, p.std) for p in told.values()])), (one.name, bound)
            OWN[name].implausible(values, dict.fromkeys(values, 1e-3))


# --- sensors


def by_ratio(model, sensor):
    """(n,) what an effect makes of one sensor, the same from every input; the other sensors are as they were."""
    ratio = model.response(OMEGA) / ANALOGUE.response(OMEGA)
    k = ANALOGUE.sensors.names.index(sensor)
    np.testing.assert_allclose(np.delete(ratio, k, axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(ratio[:, k], ratio[:, k, :1] * np.ones(ratio.shape[2]), rtol=1e-9)
    return ratio[:, k, 0]


def test_bare_sensors_are_the_chain_times_velocity():
    y = Assembly(RIG).mounts().response(F) * (2j * np.pi * F * chain(RIG, F))[:, None, None]
    np.testing.assert_allclose(ANALOGUE.response(OMEGA), y, rtol=1e-9, atol=1e-12 * np.abs(y).max())


def test_geophone_corner():
    s, g = 2j * np.pi * F, RIG.geophones

    def suspension(f, z):
        return s**2 / (s**2 + 2 * z * 2 * np.pi * f * s + (2 * np.pi * f) ** 2)

    ratio = by_ratio(with_effect("geophone_corner", "Sz2", [5.1, 0.62], ANALOGUE), "Sz2")
    np.testing.assert_allclose(
        ratio, suspension(5.1, 0.62) / suspension(g.suspension_Hz, g.suspension_damping), rtol=1e-9
    )


def test_gains_are_one_real_factor():
    np.testing.assert_allclose(by_ratio(with_effect("sensor_gain", "Sx2", [1.07], ANALOGUE), "Sx2"), 1.07, rtol=1e-12)
    ratio = with_effect("actuator_gain", "Az3", [0.9], ANALOGUE).response(OMEGA) / ANALOGUE.response(OMEGA)
    k = RIG.equations_of_motion().actuators.index("Az3")
    np.testing.assert_allclose(ratio[:, :, k], 0.9, rtol=1e-12)
    np.testing.assert_allclose(np.delete(ratio, k, axis=2), 1, rtol=1e-12)


def test_misaligned_sensor_reads_along_its_tilted_axis():
    table = Assembly(RIG).mounts()
    towards_x, towards_z = np.radians([4.0, -7.0])
    e = np.array([np.tan(towards_x), 1.0, np.tan(towards_z)])
    table.R[0] = e / np.linalg.norm(e) @ mount_map(RIG.isolators[0].position)  # Sy1
    y = table.response(F) * (2j * np.pi * F * chain(RIG, F))[:, None, None]
    found = with_effect("sensor_misalignment", "Sy1", [4.0, -7.0], ANALOGUE)
    assert [one.name for one in found.effects[0].parameters] == ["towards_x_deg", "towards_z_deg"]
    np.testing.assert_allclose(found.response(OMEGA), y, rtol=1e-8, atol=1e-12 * np.abs(y).max())


def test_tilt_reads_g_times_the_tilt_as_acceleration():
    """A body at rest, turned by phi: its x axis points down by sin phi_y, its y axis up by sin phi_x."""
    table, g = Assembly(RIG).mounts(), 9.80665
    q = np.linalg.solve(table.K, table.T)  # static: what remains at low frequency
    f = np.array([1e-3])
    found = (
        with_effect("tilt_coupling", "horizontal geophones", [g], ANALOGUE).response(2 * np.pi * f)
        - ANALOGUE.response(2 * np.pi * f)
    )[0, :, :8]
    s = 2j * np.pi * f[0]
    acceleration = {"x": -g * q[4], "y": g * q[3], "z": 0 * q[3]}
    true = np.array([acceleration[axis] for axis in RIG.geophones.axis]) * chain(RIG, f)[0] / s
    np.testing.assert_allclose(found, true, rtol=1e-4, atol=1e-6 * np.abs(true).max())
    # Az1 tilts the table; what Sy1 makes of that, beside the motion that Sz1 reads, goes as g/w^2.
    tilted = with_effect("tilt_coupling", "horizontal geophones", [g], ANALOGUE)
    omega = 2 * np.pi * np.array([0.02, 0.01])
    plain = ANALOGUE.response(omega)
    share = np.abs((tilted.response(omega) - plain)[:, 0, 1] / plain[:, 1, 1])
    assert share[1] / share[0] == pytest.approx(4, rel=1e-3)


# --- drives


def sampled(rig, f, delay_s, tau=0.0, aliases=2000):
    """(n, 6, 8) by samples of held and delayed volts: the sum over what sampling folds."""
    n = np.arange(-aliases, aliases + 1)
    table, found = Assembly(rig).mounts(), []
    for one in f:
        g = one + 1000.0 * n
        s = 2j * np.pi * g
        y = table.response(g)[:, :, :8] * (s * chain(rig, g))[:, None, None]
        hold = (1 - np.exp(-s / 1000)) / (s / 1000) * np.exp(-s * delay_s) / (1 + s * tau)
        found.append(np.sum(y * hold[:, None, None], axis=0))
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "place", "value", "delay_s", "tau"),
    [
        ("actuator_lag", "actuators", 1.7e-3, 1e-3, 1.7e-3),
        ("loop_delay", "loop", 0.4e-3, 1.4e-3, 0.0),
        ("loop_delay", "loop", 3e-3, 4e-3, 0.0),
    ],
)
def test_lag_and_delay_of_held_volts(name, place, value, delay_s, tau):
    f = np.array([1.0, 12.0, 60.0, 150.0])
    found = with_effect(name, place, [value]).response(2 * np.pi * f)[:, :, :8]
    true = sampled(RIG, f, delay_s, tau)
    assert np.max(np.abs(found - true) / np.abs(true).max(axis=(1, 2), keepdims=True)) < 2e-4
    ratio = found[:2] / BARE.response(2 * np.pi * f[:2])[:, :, :8]
    phase = -np.arctan(2 * np.pi * f[:2] * value) if tau else -2 * np.pi * f[:2] * value
    loudest = np.abs(found[:2]).reshape(2, -1).argmax(1)
    np.testing.assert_allclose(np.angle(ratio.reshape(2, -1)[[0, 1], loudest]), phase, atol=1e-3)


def test_time_constants_of_amplifiers_add_up():
    known = replace(BARE, base=replace(BARE.base, amplifier_corner_Hz=200.0))
    f = np.array([3.0, 30.0])
    slow = with_effect("actuator_lag", "actuators", [2e-3], known)
    ratio = slow.response(2 * np.pi * f) / known.response(2 * np.pi * f)
    total = 2e-3 + 1 / (2 * np.pi * 200)
    np.testing.assert_allclose(ratio[:, 1, 1], (1 + 1j * f / 200) / (1 + 2j * np.pi * f * total), rtol=2e-3)
    one = slow.effects[0]
    told = one.effect.reported(slow, one.place, one.by_name, np.array([[1e-10]]))
    assert told["time_constant_s"].value == pytest.approx(total)
    assert told["corner_Hz"].value == pytest.approx(1 / (2 * np.pi * total))


@pytest.mark.parametrize("delay_s", [0.0, 0.7e-3])
def test_derivative_by_the_time_constant_of_amplifiers_with_an_added_lag(rng, delay_s):
    base = replace(BARE.base, amplifier_corner_Hz=200.0, names=("mass", AMPLIFIERS))
    model = with_effect("actuator_lag", "actuators", [1.2e-3], TableModel(base))
    model = with_effect("loop_delay", "loop", [delay_s], model)
    omega = 2 * np.pi * np.array([3.0, 30.0, 90.0])
    U = rng.normal(size=(3, len(model.inputs), 1)) + 0j
    step = 1e-8
    ends = [model.at(model.values + np.array([0, sign * step, 0, 0])).driven(omega, U, False).Y for sign in (1, -1)]
    slope = (ends[0] - ends[1]) / (2 * step)
    found = model.driven(omega, U).dY
    np.testing.assert_allclose(found[1], slope, atol=1e-5 * np.abs(slope).max())
    np.testing.assert_allclose(found[2], slope, atol=1e-5 * np.abs(slope).max())  # the two time constants add up


def test_an_amplifier_of_two_poles_has_the_delay_of_its_time_constant():
    f = np.array([3.0, 12.0])
    slow = with_effect("actuator_lag", "actuators/two", [2e-3, 0.7])
    ratio = (slow.response(2 * np.pi * f) / BARE.response(2 * np.pi * f))[:, 1, 1]
    s = 2j * np.pi * f
    np.testing.assert_allclose(ratio, 1 / ((1 + 1.4e-3 * s) * (1 + 0.6e-3 * s)), rtol=2e-3)
    assert -np.angle(ratio[0]) / (2 * np.pi * f[0]) == pytest.approx(2e-3, rel=2e-3)


def test_a_lag_is_a_value_with_a_tolerance_only_if_the_model_has_one():
    known = replace(BARE, base=replace(BARE.base, amplifier_corner_Hz=300.0))
    effects, stated = list(library().values()), tolerances_of(RIG)
    assert "actuator_lag" in {one.name for one in of_values(effects, known)}
    assert "actuator_lag" not in {one.name for one in of_values(effects, BARE)}
    expected = 1 / (2 * np.pi * 300.0)
    for corner, within in ((1e9, True), (160.0, True), (140.0, False)):
        difference = 1 / (2 * np.pi * corner) - expected
        lag = active(library()["actuator_lag"], known, "actuators", [difference])
        assert has_tolerance(lag, stated) and within_tolerance(lag, stated, SETTINGS) == within
    assert not has_tolerance(active(library()["actuator_lag"], BARE, "actuators", [1e-3]), stated)


def test_drives_may_differ_where_a_lag_is_expected():
    """The tolerance in seconds is that of the mean; the differences have the same prior as without an expected lag."""
    known = replace(BARE, base=replace(BARE.base, amplifier_corner_Hz=300.0))
    each = [active(library()["actuator_lag"], one, "actuators/each") for one in (known, BARE)]
    stated = tolerances_of(RIG)
    with_lag, without = (of_effect(one, stated).sigma for one in each)
    assert len(with_lag) == len(BARE.actuators) and with_lag[0] < without[0]
    assert np.all(with_lag[1:] == 0.1) and np.all(without[1:] == 0.1)
    differ = each[0].at([0.0, 0.2, *[0.0] * (len(with_lag) - 2)])
    assert not has_tolerance(differ, stated) and not within_tolerance(differ, stated, SETTINGS)


@pytest.mark.parametrize(("best", "near"), [(100.0, ["a", "b"]), (-2.0, ["a"])])
def test_other_laws_of_the_best_are_fitted_even_if_it_gains_nothing(best, near):
    """A law with a value for each drive may come first in the score test and cost more than it gains."""
    fits = {"a": best, "b": 0.9 * best if best > 0 else best - 1, "c": -50.0}
    found = {label: SimpleNamespace(log_evidence=one) for label, one in fits.items()}
    assert nearly_best(found, "a", SimpleNamespace(log_evidence=0.0), SETTINGS) == near


def test_values_beyond_their_tolerance_and_other_effects_have_their_own_places():
    effects, settings = [library()[name] for name in ("sensor_gain", "loop_delay")], replace(SETTINGS, longest=2)

    def may_follow(*names):
        model = BARE
        for name, place in names:
            model = model.with_effect(active(library()[name], model, place))
        return [one.name for one in searched(SimpleNamespace(model=model, labels=model.labels), effects, settings)]

    gains = [("sensor_gain", "Sz1"), ("sensor_gain", "Sz2")]
    others = [("structural_damping", "isolators/causal"), ("mount_relaxation", "isolators z")]
    assert may_follow() == may_follow(gains[0], others[0]) == ["sensor_gain", "loop_delay"]
    assert may_follow(*gains, others[0]) == ["loop_delay"]
    assert may_follow(*others, gains[0]) == ["sensor_gain"]
    assert may_follow(*others, *gains) == []


# --- amplitude and time


def motion(deflection, volts=None, start_s=0.0, campaign_s=(0.0, 10.0)):
    volts = np.zeros((len(deflection), 8)) if volts is None else volts
    return RecordMotion("00", 1000.0, start_s, campaign_s, volts, deflection, *mount_rows(BARE))


def only(column, values):
    found = np.zeros((len(values), 12))
    found[:, column] = values
    return found


def test_cubic_stiffness_by_harmonic_balance():
    """k3 (A sin)^3 = 3/4 k3 A^3 sin - 1/4 k3 A^3 sin of thrice the frequency, at its own mount."""
    A, k3, t = 2e-5, 1e12, np.arange(5000) / 1000
    record = motion(only(5, A * np.sin(2 * np.pi * 2.0 * t)))
    force = OWN["cubic_stiffness"].force(record, "isolators z", {"k3_N_per_m3": k3})
    true = -k3 * A**3 * (0.75 * np.sin(2 * np.pi * 2.0 * t) - 0.25 * np.sin(2 * np.pi * 6.0 * t))
    x, y, _ = RIG.isolators[1].position
    np.testing.assert_allclose(force, true[:, None] * [0, 0, 1, y, -x, 0], atol=1e-12)
    assert not np.any(OWN["cubic_stiffness"].force(motion(only(4, t)), "isolators z", {"k3_N_per_m3": k3}))


def test_a_polynomial_stiffness_by_harmonic_balance():
    """sin^2 = 1/2 - 1/2 cos 2x and sin^5 = 5/8 sin x - 5/16 sin 3x + 1/16 sin 5x."""
    A, k2, k5, x = 2e-5, 3e7, 4e21, 2 * np.pi * 2.0 * np.arange(5000) / 1000
    record = motion(only(5, A * np.sin(x)))
    values = {"k3_N_per_m3": 0.0, "k2_N_per_m2": k2, "k5_N_per_m5": k5}
    force = OWN["cubic_stiffness"].force(record, "isolators z/polynomial", values)
    true = -k2 * A**2 / 2 * (1 - np.cos(2 * x)) - k5 * A**5 / 16 * (10 * np.sin(x) - 5 * np.sin(3 * x) + np.sin(5 * x))
    np.testing.assert_allclose(force[:, 2], true, atol=1e-12)


def friction_on_Ay1(amplitude, slip, stiffness=1e4, f=1.0):
    """Displacement of Ay1's contact over three cycles, and the force along it."""
    d = amplitude * np.sin(2 * np.pi * f * np.arange(3000) / 1000)
    force = OWN["contact_friction"].force(
        motion(only(1, d)), "actuators", {"stiffness_N_per_m": stiffness, "slip_m": slip}
    )
    return d, force[:, 1]


def test_friction_is_a_spring_below_the_slip():
    d, force = friction_on_Ay1(1e-9, 1e-5)
    np.testing.assert_allclose(force, -1e4 * d, atol=3e-4 * 1e4 * 1e-9)


def test_friction_is_coulombs_far_above_the_slip():
    d, force = friction_on_Ay1(1e-3, 1e-6)
    moving = np.abs(d) < 0.9e-3
    moving[:250] = False
    np.testing.assert_allclose(force[moving], -1e-2 * np.sign(np.gradient(d))[moving], rtol=1e-6)
    last = slice(2000, 3000)
    lost = -np.sum(force[last] * np.gradient(d)[last])
    assert lost == pytest.approx(4 * 1e-2 * 1e-3, rel=5e-3)  # 4 F_c A a cycle


def test_friction_never_gives_energy():
    rng = np.random.default_rng(5)
    d = np.cumsum(rng.standard_normal(4000)) * 1e-7
    force = OWN["contact_friction"].force(motion(only(1, d)), "actuators", {"stiffness_N_per_m": 1e4, "slip_m": 3e-7})[
        :, 1
    ]
    step = np.diff(d, prepend=0.0)
    mean = (force + np.concatenate([[0.0], force[:-1]])) / 2
    taken = np.cumsum(-mean * step)
    assert np.min(taken) > -1e-18
    assert taken[-1] > 10 * 1e4 * 3e-7**2


def test_drift_is_a_spring_that_grows_with_time():
    d = np.random.default_rng(2).standard_normal((100, 12)) * 1e-5
    k = np.array([value for one in RIG.isolators for value in one.stiffness])
    G = np.vstack([mount_map(one.position) for one in RIG.isolators])
    force = OWN["stiffness_drift"].force(motion(d, start_s=8.0), "isolators/linear", {"relative_change": 0.2})
    when = (8.0 + np.arange(100) / 1000 - 5.0) / 10.0
    np.testing.assert_allclose(force, -0.2 * when[:, None] * ((d * k) @ G), rtol=1e-12)


def test_a_drift_is_reported_of_the_stiffness_at_the_beginning():
    """From 0.9 to 1.1 of the one half-way: two ninths of what it was."""
    model = with_effect("stiffness_drift", "isolators/linear", [0.2])
    told = OWN["stiffness_drift"].reported(model, "isolators/linear", {"relative_change": 0.2}, np.diag([1e-6]))
    assert told["relative_change"].value == pytest.approx(2 / 9)
    slope = (0.2001 / (1 - 0.2001 / 2) - 0.1999 / (1 - 0.1999 / 2)) / 2e-4
    assert told["relative_change"].std == pytest.approx(1e-3 * slope, rel=1e-6)


def test_a_settling_drift_solves_its_equation():
    """tau p' = (end - p), from -0.5 to 0.5 over the campaign, and the linear one where tau is long."""
    t, tau = np.linspace(0.0, 1.0, 20001), 0.25
    p = drifted(t, tau)
    assert p[0] == pytest.approx(-0.5) and p[-1] == pytest.approx(0.5)
    left = tau * np.gradient(p, t) + p
    np.testing.assert_allclose(left[1:-1], left[1:-1].mean(), atol=1e-6)
    np.testing.assert_allclose(drifted(t, 1e4), drifted(t, 0.0), atol=1e-4)


def test_saturation_clips_the_commanded_volts():
    u = np.random.default_rng(3).standard_normal((50, 8))
    volts = OWN["actuator_saturation"].volts(motion(np.zeros((50, 12)), u), "actuators", {"limit_V": 0.7})
    np.testing.assert_array_equal(volts, np.where(np.abs(u) > 0.7, 0.7 * np.sign(u), u))


def test_spectra_that_are_kept_belong_to_one_motion():
    """A copy of a record with other volts does not get the spectrum of the first."""
    rng = np.random.default_rng(3)
    first = motion(np.zeros((50, 12)), rng.standard_normal((50, 8)))
    omega, values = 2 * np.pi * np.arange(1, 9) * 1000 / 50, {"limit_V": 0.7}
    for record in (first, replace(first, volts=2 * first.volts)):
        added = OWN["actuator_saturation"].spectra(record, "actuators", values, omega).volts
        true = np.clip(record.volts, -0.7, 0.7) - record.volts
        np.testing.assert_allclose(added, np.fft.rfft(true, axis=0)[1:9] / np.sqrt(50), atol=1e-12)


def test_drives_clip_each_at_its_own_limit_about_the_mean():
    u = 2.0 * np.random.default_rng(3).standard_normal((50, 8))
    limits = np.array([0.7, 0.8, 0.6, 0.9, 0.5, 0.75, 0.65, 0.7])
    names = [f"uneven_{one}" for one in BARE.actuators[:-1]]
    values = {"limit_V": limits.mean()} | dict(zip(names, limits / limits.mean() - 1, strict=False))
    volts = OWN["actuator_saturation"].volts(motion(np.zeros((50, 12)), u), "actuators/each", values)
    np.testing.assert_allclose(np.abs(volts), np.minimum(np.abs(u), limits), rtol=1e-12)


# --- derivatives


def _moving():
    """A model with one record of motion in time, and its block."""
    rng = np.random.default_rng(4)
    u = rng.standard_normal((2000, 8))
    d = 1e-5 * np.cumsum(rng.standard_normal((2000, 12)), axis=0) / 40
    header = RecordHeader(
        "00", 1000.0, 2000, BARE.actuators, BARE.sensors.names, "noise", 1.0, floor_names=("vx", "vy", "vz")
    )
    record = Record(header, u, rng.standard_normal((2000, 6)), 1e-5 * rng.standard_normal((2000, 3)))
    block = record_block(record, BARE.base, (0.5, 80.0)).lines(np.arange(0, 159, 7))
    return replace(BARE, motion={"00": motion(d, u)}), block


MOVING, BLOCK = _moving()
UNEVEN = 0.1, -0.2, 0.05, 0.12, -0.1, 0.15, -0.07
VALUES = {
    "geophone_corner": [4.8, 0.5],
    "sensor_gain": [1.05],
    "sensor_misalignment": [2.0, -3.0],
    "tilt_coupling": [9.8],
    "actuator_gain": [0.95],
    "actuator_lag": [2e-3, *UNEVEN],
    "loop_delay": [0.7e-3],
    "actuator_saturation": [1.0, *UNEVEN],
    "mount_relaxation": [0.3, 3.0],
    "structural_damping": [0.06],
    "mount_surge": [30.0, 0.45, 0.02, 0.01, -0.02, 0.03],
    "leveling_loop": [0.04, 0.5, -0.2],
    "cubic_stiffness": [1e13, 0.0, 0.0, 0.0],
    "stiffness_drift": [0.03, 3.0],
    "contact_friction": [3e3, 1e-5, *UNEVEN],
    "base_compliance": [1000.0, 0.05, 9.0, 10.0, 14.0, 20.0, 25.0, 30.0, 0.4, 0.5, 0.6, -0.4, -0.1],
    "com_offset": [0.01, -0.02, 0.03],
    "product_of_inertia": [2.0],
    "payload_flexible_mode": [x for f in (30.0, 42.0, 55.0) for x in (f, 0.02, *np.linspace(-0.02, f / 1000, 12))],
    "attached_oscillator": [2.0, 1.0, -2.0, 12.0, 0.05, 0.3, 0.2, 0.1],
    "cable_stiffness": [500.0, 400.0, 300.0, 1e-3, 0.3, 0.2, 0.1],
}


def values_at(name, place):
    values, parameters = VALUES[name], OWN[name].parameters(MOVING, place)
    if name == "cable_stiffness" and place.endswith("oblique"):
        values = [20.0, -15.0, 10.0, *values[3:]]
    if name == "attached_oscillator" and place.endswith(("axes", "turned")):
        values = [10.0, 12.0, 9.0, 15.0, *values[4:], 0.2, -0.1, 0.3]
    if place == "actuators/two":
        values = [2e-3, 0.7]
    if name == "cubic_stiffness" and place.endswith("polynomial"):
        values = [values[0], 1e8, 1e22, *values[1:]]
    return values[: len(parameters)]


@pytest.mark.parametrize(("name", "place"), [pair for pair in EVERYWHERE if OWN[pair[0]].holds_states])
def test_the_gradient_of_a_fit_knows_what_the_states_inside_start_with(name, place):
    """Where a record's ends are fitted, too: slope of its chi-square by every parameter, against differences."""
    model = with_effect(name, place, values_at(name, place))
    rng = np.random.default_rng(4)
    inner = 1e-4 * rng.standard_normal(model.inner_transients(OMEGA[:1]).shape[2])
    U = rng.standard_normal((len(OMEGA), len(model.inputs), 1)) * np.r_[np.ones(8), np.full(3, 1e-4)][:, None]
    block = SpectralBlock("one", OMEGA, U, np.zeros((len(OMEGA), len(model.sensors.names), 1), complex), transient=True)
    Y = model.at(1.02 * model.values).answer(block, None, False, inner).Y
    Y = Y + 1e-2 * np.abs(Y) * rng.standard_normal(Y.shape)
    power = np.mean(np.abs(Y[..., 0]) ** 2, axis=1)
    block = replace(block, Y=Y).with_noise((power[:, None, None] * np.eye(Y.shape[1])).astype(complex))
    L = whitener(block)

    def chi2(theta):
        e, _, _ = block_residual(model.at(theta), block, L, derivative=False)
        return e @ e

    e, J, _ = block_residual(model, block, L, derivative=True)
    for row in [*range(0, len(BARE.names), 2), *range(len(BARE.names), len(model.values))]:
        h = 1e-4 * max(abs(model.values[row]), 1e-3 * model.scales()[row]) * np.eye(len(model.values))[row]
        slope = (chi2(model.values + h) - chi2(model.values - h)) / (2 * np.abs(h).max())
        found, most = -2 * J[row] @ e, 2 * np.linalg.norm(J[row]) * np.linalg.norm(e)
        assert found == pytest.approx(slope, abs=1e-5 * most), model.names[row]


@pytest.mark.parametrize(
    ("name", "place"),
    [pair for k, pair in enumerate(EVERYWHERE) if k == 0 or EVERYWHERE[k - 1][0] != pair[0] or "/" in pair[1]],
)
def test_derivatives_by_central_differences(name, place):
    """By all parameters of rig and effect: differences of the answer as a whole, of two steps (Richardson)."""
    model = with_effect(name, place, values_at(name, place), MOVING)
    theta, found = model.values, model.answer(BLOCK)
    free = [*range(0, len(BARE.names), 3), *range(len(BARE.names), len(theta))]
    for row in free:
        size = model.scales()[row] if row < len(BARE.names) else max(abs(theta[row]), 1e-3 * model.scales()[row])
        step, slopes = 1e-3 * size, []
        for h in (step, step / 2):
            sides = [
                model.at(theta + sign * h * np.eye(len(theta))[row]).answer(BLOCK, derivative=False).Y
                for sign in (1, -1)
            ]
            slopes.append((sides[0] - sides[1]) / (2 * h))
        true = (4 * slopes[1] - slopes[0]) / 3
        # By the rig analytic; by effects a difference of step 1e-4 of a parameter's size. Clipped volts have kinks: a
        # sample that passes one within a step counts in one of the two differences only.
        volts = np.abs(MOVING.motion["00"].volts)
        passing = np.mean(np.abs(volts - 1.0) < 1e-3) / np.mean(volts > 1.0)
        most = 1e-6 if row < len(BARE.names) else passing if name == "actuator_saturation" else 1e-5
        assert np.linalg.norm(found.dY[row] - true) <= most * np.linalg.norm(true), model.names[row]


@pytest.mark.parametrize(
    ("name", "place"),
    [
        (name, place)
        for name, place in EVERYWHERE
        if name
        in (
            "mount_surge",
            "structural_damping",
            "mount_relaxation",
            "base_compliance",
            "payload_flexible_mode",
            "leveling_loop",
        )
    ],
)
def test_derivatives_by_places_of_mounts_that_effects_have_changed(name, place):
    """With initial values of modes and masses, which the mounts transmit, too; against differences. First-order states
    of an effect start at zero: it defines their force on the payload itself."""
    free = TableModel(ResponseModel.of(RIG, ("isolator2.p_x", "isolator2.p_y", "isolator3.p_z")))
    model = with_effect(name, place, values_at(name, place), free)
    inner = np.random.default_rng(4).standard_normal(model.inner_transients(OMEGA[:1]).shape[2])
    decays = sum(one.shape[2] for one in model.operators(OMEGA).decays)
    inner[len(inner) - decays :] = 0
    theta, found = model.values, model.answer(BLOCK, inner=inner).dY
    for row in range(3):
        h = 1e-4 * np.eye(len(theta))[row]
        sides = [model.at(theta + end).answer(BLOCK, None, False, inner).Y for end in (h, -h)]
        slope = (sides[0] - sides[1]) / 2e-4
        assert_allclose(found[row], slope, atol=1e-5 * np.max(np.abs(slope)))


def test_a_block_without_its_record_is_refused():
    model = with_effect("cubic_stiffness", "isolators z", [1e12, 0.1, -0.2, 0.05], MOVING)
    other = SpectralBlock("07", BLOCK.omega, BLOCK.U, BLOCK.Y)
    with pytest.raises(ValueError, match="block 07: expected the record's motion"):
        model.answer(other)
