"""Offset, 1/f noise and anti-alias filter of the sensors' electronics: in the rig, the design and the simulation."""

from dataclasses import replace

import control
import numpy as np
import pytest
from scipy import signal

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import sensor_model
from avis_ctrl.lti.norms import hinf_norm
from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.rigs.equipment import Electronics
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.rigs.sensing import sensing
from avis_ctrl.simulation.discrete import gain_at_rest
from avis_ctrl.simulation.loop import flicker, simulate
from avis_ctrl.study.dc_gain import at_rest
from avis_ctrl.study.design_file import design_from_table, read_study, study_of
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.simulation import bare_loop
from avis_ctrl.study.verdict import check_loop

FILTER = Electronics(anti_alias_order=3, anti_alias_corner_Hz=200.0)
OMEGA = 2 * np.pi * np.geomspace(0.1, 2000.0, 40)


def butterworth(order: int, corner_Hz: float) -> np.ndarray:
    b, a = signal.butter(order, 2 * np.pi * corner_Hz, analog=True)
    return signal.freqs(b, a, OMEGA)[1]


@pytest.mark.parametrize("order", [1, 2, 3, 4, 8])
@pytest.mark.parametrize("name", ["avis", "halcyonics", "designs/rigs/granite.toml"])
def test_filter_is_scipys_butterworth_behind_every_sensor(name, order):
    bare = load_rig(name)
    filtered = bare.with_electronics(replace(bare.electronics, anti_alias_order=order, anti_alias_corner_Hz=200.0))
    for one, other in zip(bare.sensors(), filtered.sensors(), strict=True):
        expected = one.chain().frequency_response(OMEGA)[:, 0, 0] * butterworth(order, 200.0)
        assert other.chain().frequency_response(OMEGA)[:, 0, 0] == pytest.approx(expected, rel=1e-9)
        assert other.as_velocity(OMEGA) * other.gain == pytest.approx(
            one.as_velocity(OMEGA) * one.gain * butterworth(order, 200.0), rel=1e-9
        )


@pytest.mark.parametrize(
    "name", ["avis", "halcyonics", *(f"designs/rigs/{one}.toml" for one in ("granite", "twelve_sensors", "skewed"))]
)
def test_controller_sees_the_filter_and_does_not_undo_it(name):
    bare = load_rig(name)
    seen, filtered = (sensing(rig, ["z"], 0.1) for rig in (bare, bare.with_electronics(FILTER)))
    for before, after in ((seen.chain, filtered.chain), (seen.relative_chain, filtered.relative_chain)):
        if before is not None and before.nstates:
            expected = before.frequency_response(OMEGA)[:, 0, 0] * butterworth(3, 200.0)
            assert after.frequency_response(OMEGA)[:, 0, 0] == pytest.approx(expected, rel=1e-9)
    for before, after in zip(seen.conditioning, filtered.conditioning, strict=True):
        assert (before is None) == (after is None)
        if before is not None:
            assert after.frequency_response(OMEGA) == pytest.approx(before.frequency_response(OMEGA), rel=1e-9)


def test_identification_knows_the_filter():
    """Volts over voltages of a simulated table, by the model that `avis identify` fits: scipy's filter is the ratio."""
    bare = load_rig("avis")
    omega = 2 * np.pi * np.geomspace(0.5, 100.0, 20)
    responses = [sensor_model(rig).sense(omega) for rig in (bare, bare.with_electronics(FILTER))]
    b, a = signal.butter(3, 2 * np.pi * 200.0, analog=True)
    assert responses[1] == pytest.approx(responses[0] * signal.freqs(b, a, omega)[1][:, None], rel=1e-9)


def test_default_offset_is_that_of_the_data_sheets():
    """INA128 at a gain of 100: 1.1 mV; two codes of 14 bits over +-10 V: 2.44 mV."""
    assert load_rig("avis").sensors()[0].offset_V == pytest.approx(1.1e-3 + 2 * 20 / 2**14)
    assert load_rig("halcyonics").sensors()[0].offset_V == pytest.approx(1.1e-4)


def test_design_file_replaces_keys_of_the_rig_file(tmp_path):
    design, rig = read_study("designs/avis_z_phix.toml")
    table = design.model_dump(exclude_none=True)
    rig = rig.with_electronics(replace(FILTER, sensor_offset_V=2e-3, converter_offset_V=0.0))
    (tmp_path / "rig.toml").write_text(rig_toml(rig))
    table |= {"rig": "rig.toml", "electronics": {"sensor_offset_V": 5e-3}}
    made, read = study_of(design_from_table(table), tmp_path / "design.toml")
    assert read.electronics == replace(rig.electronics, sensor_offset_V=5e-3)
    # What is written and read again says no more than the file did.
    again = design_from_table(made.model_dump(exclude_none=True))
    assert again.equipped(rig).electronics == read.electronics


@pytest.mark.parametrize(
    "given, field",
    [
        ({"anti_alias_order": 2}, "anti_alias_corner_Hz"),
        ({"anti_alias_corner_Hz": 100.0}, "anti_alias_corner_Hz"),
        ({"anti_alias_order": 9, "anti_alias_corner_Hz": 100.0}, "anti_alias_order"),
        ({"anti_alias_order": 2, "anti_alias_corner_Hz": -1.0}, "anti_alias_corner_Hz"),
        ({"sensor_offset_V": -1.0}, "sensor_offset_V"),
        ({"converter_offset_V": float("nan")}, "converter_offset_V"),
        ({"offset": 1.0}, "offset"),
    ],
)
def test_wrong_electronics_are_named_in_one_line(given, field):
    table = read_study("designs/avis_z_phix.toml")[0].model_dump(exclude_none=True)
    with pytest.raises(InputError, match=field) as caught:
        design_from_table(table | {"electronics": given})
    assert "\n" not in str(caught.value)


def test_flicker_noise_has_the_density_of_its_definition():
    """Each line of the periodogram is 2 T / f times a chi-square of two degrees of freedom over two."""
    period, n, channels = 1e-3, 4096, 500
    noise = flicker(n, period, np.random.default_rng(4), channels)
    frequency, power = signal.periodogram(noise, 1 / period, axis=0, detrend=False)
    ratio = power[1:-1].mean(axis=1) * frequency[1:-1] / (2 * period)
    assert np.max(np.abs(ratio - 1)) < 5 / np.sqrt(channels)
    assert np.mean(ratio) == pytest.approx(1, abs=0.005)


def test_gain_at_rest_is_the_gain_of_python_control():
    rng = np.random.default_rng(0)
    A = 0.9 * np.linalg.qr(rng.normal(size=(4, 4)))[0]
    K = StateSpace(A, rng.normal(size=(4, 2)), rng.normal(size=(3, 4)), rng.normal(size=(3, 2)), 0.01)
    assert gain_at_rest(K) == pytest.approx(control.ss(K.A, K.B, K.C, K.D, 0.01).dcgain())
    assert np.all(np.isinf(gain_at_rest(StateSpace(np.zeros((1, 1)), [[1.0]], [[1.0]], [[0.0]]))))
    # With an integrator in other coordinates the matrix is singular only to within round-off.
    T, slow = rng.normal(size=(5, 5)), np.diag([0.0, -1e-3, -1.0, -1e2, -1e5])
    K = StateSpace(T @ slow @ np.linalg.inv(T), rng.normal(size=(5, 2)), rng.normal(size=(3, 5)), np.zeros((3, 2)))
    assert np.all(np.isinf(gain_at_rest(K)))
    K = replace(K, A=T @ (slow - np.diag([1e-4, 0, 0, 0, 0])) @ np.linalg.inv(T))
    assert np.all(np.isfinite(gain_at_rest(K)))


def test_offset_holds_the_voltages_that_the_gain_at_rest_says(tmp_path):
    """On the nonlinear table, from the first sample on: static feedback of velocity, with delay and converter off."""
    design, rig = read_study("designs/avis_z_phix.toml")
    rig = rig.with_electronics(Electronics(sensor_offset_V=4e-3, converter_offset_V=0.0))
    loop = bare_loop(design, rig, build_plant(design, rig), gain(np.diag([-3e4, -2e4])))
    rest = at_rest(loop)
    quiet = replace(loop.sensors.white(), noise_rms_V=np.zeros(6), converter=None, offset_V=rest.worst_offset_V)
    record = simulate(replace(loop, sensors=quiet, floor={}), 3.0, settle_s=0.0)
    # 4 mV over 3125 V s/m is 1.28 um/s, and the edge of phi_x is at the mounts.
    expected = rest.gain_V_per_V @ rest.worst_offset_V
    assert record.demanded == pytest.approx(np.broadcast_to(expected, record.demanded.shape), rel=1e-5, abs=1e-9)
    assert np.max(np.abs(record.demanded)) == pytest.approx(rest.drive_V[rest.worst], rel=1e-5)
    assert np.max(np.abs(record.q_dot)) < 1e-12
    assert np.max(np.abs(record.q)) > 1e-9


@pytest.mark.parametrize("name", ["avis_z_phix", "halcyonics_z_phix"])
def test_effort_below_its_bound_keeps_the_offset_within_its_part_of_the_drives(name):
    """Whatever the controller's gain at rest: mu below 1 at zero frequency is enough for the gate."""
    design, rig = read_study(f"designs/{name}.toml")
    plant = build_plant(design, rig)
    effort = [z for z in plant.synthesis.z if z.startswith("effort")]
    rng, reached = np.random.default_rng(1), []
    P = plant.synthesis.P
    noise = P(0.0)[np.ix_([P.outputs.index(y) for y in plant.synthesis.y], [P.inputs.index(w) for w in plant.noises])]
    weight = P(0.0)[np.ix_([P.outputs.index(z) for z in effort], [P.inputs.index(u) for u in plant.synthesis.u])]
    for _ in range(30):
        K0 = rng.normal(size=(2, 2))
        K0 /= np.linalg.norm(weight @ K0 @ noise, 2)
        reached.append(at_rest(bare_loop(design, rig, plant, gain(K0))).percent)
    assert max(reached) <= design.control_effort.offset_percent
    assert max(reached) > 0.1 * design.control_effort.offset_percent  # not far too strict


def test_gate_fails_a_design_whose_offset_uses_too_much():
    design, rig = read_study("designs/avis_z_phix.toml")
    plant = build_plant(design, rig)
    check = type("Check", (), {"plants": (), "duration_s": 1.0, "false_alarm": 0.01})()
    rows = [
        check_loop(check, at_rest(bare_loop(design, rig, plant, gain(size * np.eye(2)))), 10.0)[-1]
        for size in (1e5, 5e7)
    ]
    assert [row.met for row in rows] == [True, False]
    assert "mV" in rows[1].note and rows[1].unit == "%"


def test_weight_at_rest_comes_from_the_offset_alone():
    design, rig = read_study("designs/avis_z_phix.toml")
    without = rig.with_electronics(Electronics(sensor_offset_V=0.0, converter_offset_V=0.0))
    with_, plain = (build_plant(design, one).effort_weight("z") for one in (rig, without))
    assert plain.magnitude(OMEGA[:1] * 1e-6)[0] == pytest.approx(1e-6)
    assert with_.magnitude(OMEGA[:1] * 1e-6)[0] > 10e-6
    assert with_.magnitude(2 * np.pi * np.array([1.0])) == pytest.approx(
        plain.magnitude(2 * np.pi * np.array([1.0])), rel=0.2
    )
    assert hinf_norm(with_.system()).gain >= 3e-5
