"""Second-order terms of large rotations: against the simulator, an independent table, and what a fit finds of them."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from exact import floor_velocity, multisine
from scipy.spatial.transform import Rotation
from truth.cases import run
from truth.table import draw_plant

from avis_ctrl.identification.excited_space import excited_space
from avis_ctrl.identification.large_motion import Turning, turned_force, turned_reading
from avis_ctrl.identification.noise import relative_noise
from avis_ctrl.identification.predictor import Predictor
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.second_order import chosen_turning, terms, without
from avis_ctrl.identification.spectra import record_block
from avis_ctrl.measurement.campaign import Campaign, Portion, Record, RecordHeader
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.nonlinear import rig_arrays
from avis_ctrl.simulation.campaign_data import open_loop
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.study.plan_file import plan_from_table


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.max(np.std(found - expected, axis=0) / np.std(expected, axis=0)))


def within(u: np.ndarray, rig) -> np.ndarray:
    """As large as the drives allow."""
    return 0.99 * rig.drive_limit_V * u / np.max(np.abs(u))


def test_motors_that_turn_push_along_turned_axes():
    """Force phi x f and moment p x (phi x f), to first order in the angles; signs of all coordinates."""
    rig, rng = load_rig("avis"), np.random.default_rng(0)
    arrays = rig_arrays(rig.mounted_body())
    q, u, out = rng.normal(size=6), rng.normal(size=8), np.empty(6)
    turned_force(out, q, u, arrays)
    forces = np.cross(q[3:], np.array(arrays.actuator_force)) * u[:, None]
    moments = np.cross(np.array(arrays.actuator_position), forces)
    assert np.allclose(out, np.concatenate([forces.sum(0), moments.sum(0)]), rtol=1e-12)


def test_sensors_that_turn_read_the_second_order_of_exact_kinematics():
    """Second differences in time of q + R(phi) p along R(phi) d, less the linear reading; 3-2-1 angles."""
    rng = np.random.default_rng(1)
    place, direction = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    offset, rate, bend = 1e-3 * rng.normal(size=(3, 6))
    h = 1e-2

    def motion(t):
        return offset + rate * t + bend * t * t / 2

    def points(t):
        q = motion(t)
        return q[:3] + Rotation.from_euler("ZYX", q[:2:-1]).apply(place)

    acceleration = (points(h) - 2 * points(0.0) + points(-h)) / h**2
    turned = Rotation.from_euler("ZYX", offset[:2:-1]).apply(direction)
    linear = np.sum((bend[:3] + np.cross(bend[3:], place)) * direction, axis=1)
    out = np.empty(5)
    turned_reading(out, offset, rate, bend, place, direction)
    assert np.allclose(out, np.sum(acceleration * turned, axis=1) - linear, rtol=0, atol=2e-2 * np.abs(out).max())
    assert np.abs(out).max() > 1e-7


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_a_prediction_is_what_the_closed_loop_simulation_has_without_a_controller(name):
    """Geophones and accelerometers, floor and drives, ten times the usual level, whole and in pieces."""
    rig, rng = load_rig(name), np.random.default_rng(1)
    plan = plan_from_table({"ambient": {"velocity_rms_m_per_s": 1e-4}, "record": [{"excitation": "rest"}]})
    loop, fs = open_loop(rig, plan), rig.sample_rate_Hz
    loop = replace(loop, sensors=replace(loop.sensors, noise_rms_V=0 * loop.sensors.noise_rms_V))
    n, n_u = round(2 * fs), loop.n_drives
    u = within(multisine(rng, 1.0, 1000, 2, (1.0, 30.0), n_u)[:n], rig)
    floor = np.zeros((n + 1, 6))
    floor[:n, :3] = floor_velocity(rng, n, 1e-4)
    floor[n] = floor[n - 1]
    exact = simulate(loop, n / fs, 1, settle_s=0.0, floor=floor, drive=u).sensed
    model = ResponseModel.of(rig, (), amplifier_corner_Hz=loop.amplifier_corner_Hz)
    assert off(Predictor(model, large_motion=True).read(u, floor[:n, :3]), exact) < 1e-6
    assert off(Predictor(model).read(u, floor[:n, :3]), exact) > 1e-4
    parts, cuts = Predictor(model, large_motion=True), [0, 1, 300, n]
    found = np.vstack([parts.read(u[a:b]) for a, b in itertools.pairwise(cuts)])
    assert np.allclose(found, Predictor(model, large_motion=True).read(u), rtol=0, atol=1e-12)


def test_an_independent_table_turns_its_sensors_with_it():
    """The table of tests/truth, quaternions and geophones on the payload: its sensors turn, its motors do not."""
    rig, rng = load_rig("avis"), np.random.default_rng(2)
    plant = draw_plant(rig, rng, spread=0.0)
    u = within(multisine(rng, 5.0, 3000, 1, (1.0, 20.0)), rig)
    y, _ = run(plant, u, np.zeros((len(u) + 1, 9)), 0, 0.0, rng)
    model = ResponseModel.of(rig, ())

    def error(turning: Turning) -> float:
        return off(Predictor(replace(model, turning=turning), large_motion=True).read(u), y)

    right = error(Turning(0.0, 1.0))
    assert right < 2e-5
    for wrong in (Turning(0.0, 0.0), Turning(1.0, 1.0), Turning(1.0, 0.0)):
        assert error(wrong) > 20 * right
    assert off(Predictor(model).read(u), y) > 50 * right


def records(turning: Turning, level: float, noise_V: float = 1e-4) -> tuple[ResponseModel, Campaign]:
    rig, rng = load_rig("avis"), np.random.default_rng(3)
    model, made = ResponseModel.of(rig, ("mass", "J1")), []
    for k in range(2):
        u = multisine(rng, level, 5000, 1, (1.0, 30.0))
        y = Predictor(replace(model, turning=turning), large_motion=True).read(u)
        h = RecordHeader(f"{k:02d}", 1000.0, len(u), model.actuators, model.sensors.names, "noise", level, 9.0 * k)
        made.append(Record(h, u, y + noise_V * rng.normal(size=y.shape)))
    return model, Campaign("avis", tuple(made))


@pytest.mark.parametrize("turning", [Turning(0.0, 1.0), Turning(1.0, 0.0), Turning(1.0, 1.0), Turning()])
def test_what_turns_is_found_and_taken_off(turning):
    """Though mass and inertia may move along; what is left of the records is linear."""
    model, campaign = records(turning, 3.0)
    blocks = relative_noise([record_block(one, model, (1.0, 30.0)) for one in campaign.records], 1e-4)
    found, added = chosen_turning(campaign, blocks, model)
    assert found == turning
    for block in without(blocks, added):
        plain = next(one for one in blocks if one.name == block.name)
        linear = Predictor(model).read(campaign.named(block.name).load().u)
        lines = np.rint(block.omega * block.samples / (2 * np.pi * 1000)).astype(int)
        Y = (np.fft.rfft(linear - linear.mean(0), axis=0) / np.sqrt(len(linear)))[lines]
        assert np.linalg.norm(block.Y[:, :, 0] - Y) < 0.1 * np.linalg.norm(plain.Y[:, :, 0] - Y)


def test_records_that_do_not_tell_keep_what_the_model_had():
    model, campaign = records(Turning(1.0, 1.0), 0.01, 1e-2)
    blocks = relative_noise([record_block(one, model, (1.0, 30.0)) for one in campaign.records])
    assert chosen_turning(campaign, blocks, model)[0] == Turning()


def test_a_portion_has_the_terms_of_its_place_in_the_record():
    model, campaign = records(Turning(), 3.0)
    record = campaign.records[0].load()
    late = Portion(record, 2000, 5000)
    block = record_block(late.load(), model, (1.0, 30.0))
    found = terms(Campaign("avis", (late,)), [block], model)[0][0, :, :, 0]
    y = Predictor(model, large_motion=True).read(record.u) - Predictor(model).read(record.u)
    lines = np.rint(block.omega * 3000 / (2 * np.pi * 1000)).astype(int)
    expected = np.fft.rfft(y[2000:] - y[2000:].mean(0), axis=0)[lines] / np.sqrt(3000)
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_combinations_of_drives_that_no_record_plays_are_told():
    """Six axes of eight drives leave two combinations; the words name them, and a drive that is silent."""
    rig, rng = load_rig("avis"), np.random.default_rng(4)
    axes = actuator_axes(rig)

    def space(u):
        h = RecordHeader("00", 1000.0, len(u), axes.actuators, ("Sy1",), "noise", 1.0)
        return excited_space(Campaign("avis", (Record(h, u, np.zeros((len(u), 1))),)), (1.0, 100.0))

    found = space(rng.normal(size=(3000, 6)) @ axes.allocation.T)
    assert not found.full and np.allclose(found.unplayed @ axes.allocation, 0, atol=1e-6)
    assert len(found.unplayed) == 2 and "excite 6 of 8" in found.sentence
    drives = rng.normal(size=(3000, 8))
    assert space(drives).full and not space(drives).sentence
    drives[:, 2] = 0
    assert space(drives).full
    assert (
        "no record drives Ax2: its response is not measured, and the rig file's values for it are"
        in space(drives).sentence
    )
    drives[:, 3] = 0
    assert "Ax2, Az2: their response is not measured, and the rig file's values for them are" in space(drives).sentence
    drives[:, 2], drives[:, 3] = drives[:, 0], 2 * drives[:, 1]
    assert "excite 6 of 8" in space(drives).sentence
    # Either way round, and of any size.
    assert re.search(
        r"not excited: (Ay1 - Ax2|-Ay1 \+ Ax2); (-?2 Az1 [-+] Az2|-?Az1 [-+] 0\.5 Az2)\. ", space(drives).sentence
    )
