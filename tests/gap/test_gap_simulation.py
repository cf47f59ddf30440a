"""Records simulated in time against a Runge-Kutta integration that shares nothing with it, and against `predict`."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from table_in_time import SUBSTEPS, Table, mount_map

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.effects.base import Effect, EffectParameter
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.motion_estimate import motion_of
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import ActiveEffect, TableModel, active
from avis_ctrl.identification.predictor import Predictor
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, Portion, Record, RecordHeader
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.nonlinear import payload_acceleration, rig_arrays
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.perturbed_campaign import perturbed_truth

RIG = load_rig("avis")
BARE = TableModel(ResponseModel.of(RIG, ()))
FS = 1000.0
# All contacts alike.
EVEN = (0.0,) * 7


def noise(samples, channels, rms, seed=1):
    """Band-limited, 0.5-60 Hz, from rest."""
    sos = scipy.signal.butter(4, [0.5, 60], "bandpass", fs=FS, output="sos")
    x = scipy.signal.sosfilt(sos, np.random.default_rng(seed).standard_normal((samples, channels)), axis=0)
    return x * rms / x.std()


U = noise(8000, 8, 0.3)


def with_effect(name, place, values, model=BARE):
    return model.with_effect(active(library()[name], model, place, values))


def error(found, true):
    """Largest r.m.s. error of a channel over its r.m.s."""
    return float(np.max(np.sqrt(np.mean((found - true) ** 2, axis=0) / np.mean(true**2, axis=0))))


def test_bare_rig_as_predict():
    """Exact steps in time on the one hand, lines with closed-form aliases on the other."""
    assert error(simulate(BARE, U, None, FS).y, Predictor(BARE.base).read(U)) < 1e-6
    # Between samples of the floor predict draws straight lines, and the lines are band-limited.
    floor = noise(8000, 3, 2e-5, 2)
    assert error(simulate(BARE, 0 * U, floor, FS).y, Predictor(BARE.base).read(0 * U, floor)) < 3e-4


def test_bare_rig_as_runge_kutta():
    found, (y, d) = simulate(BARE, U, None, FS), Table(RIG).run(U, FS)
    assert error(found.y, y) < 1e-6
    assert error(found.deflection, d) < 2e-6


def test_a_floor_with_a_mean_moves_payload_and_chassis_together():
    """Velocity that stays: after the transient nothing is deflected, and geophones read nothing of it."""
    floor = np.zeros((20000, 3))
    floor[:, 2] = 1e-3
    found = simulate(BARE, np.zeros((20000, 8)), floor, FS)
    size = np.max(np.abs(found.deflection), axis=1)
    # The step back at the end rings a little before it, for no line is above half the sample rate.
    early, late = np.max(size[:2000]), np.max(size[-4000:-1000])
    assert early > 2e-5
    assert late < 1e-3 * early
    # A step of the floor, which the lines know up to half the sample rate only.
    along_z = [k for k, name in enumerate(BARE.sensors.names) if name[1] == "z"]
    assert error(found.y[:, along_z], Predictor(BARE.base).read(np.zeros((20000, 8)), floor)[:, along_z]) < 2e-2


def attached(mass, f, zeta, place, axis):
    """A sprung mass with its absolute position as a state."""
    table, w = Table(RIG), 2 * np.pi * f
    k, c = mass * w**2, 2 * zeta * w * mass
    table.attach(
        mount_map(place)[axis], [[0, 1], [-k / mass, -c / mass]], [[0, 0], [k / mass, c / mass]], [-k, -c, k, c]
    )
    return table


def relaxing(ratio, corner_Hz):
    """A Maxwell branch at every vertical mount: spring r k in series with a damper; state of the damper."""
    table, w = Table(RIG), 2 * np.pi * corner_Hz
    for G, one in zip(table.maps, RIG.isolators, strict=True):
        k = ratio * one.stiffness[2]
        table.attach(G[2], [[-w]], [[w, 0]], [-k, 0, k])
    return table


def leveled(rate_Hz):
    """The integral of the deflection pushes back at the first three mounts, each as it is stiff."""
    table = Table(RIG)
    for G, one in zip(table.maps[:3], RIG.isolators, strict=False):
        table.attach(G[2], [[0.0]], [[1.0, 0]], [0, 0, -2 * np.pi * rate_Hz * one.stiffness[2]])
    return table


def lagging(tau):
    table = Table(RIG)
    table.lag_s = tau
    return table


LINEAR = [
    (
        "attached_oscillator",
        "payload/z",
        [20.0, 12.0, 0.03, 0.3, -0.2],
        attached(20.0, 12.0, 0.03, [0.3, -0.2, 0.0], 2),
        {},
    ),
    ("mount_relaxation", "isolators z", [0.8, 2.5], relaxing(0.8, 2.5), {}),
    ("leveling_loop", "isolators 1-3 z/plain", [0.07], leveled(0.07), {}),
    ("actuator_lag", "actuators", [4e-3], lagging(4e-3), {}),
    ("loop_delay", "loop", [2.5e-3], Table(RIG), {"delay_substeps": round(3.5 * SUBSTEPS)}),
]


@pytest.mark.parametrize(("name", "place", "values", "table", "given"), LINEAR, ids=[one[0] for one in LINEAR])
def test_linear_effects_as_runge_kutta(name, place, values, table, given):
    found, (y, d) = simulate(with_effect(name, place, values), U, None, FS), table.run(U, FS, **given)
    assert error(y, Table(RIG).run(U, FS)[0]) > 0.02
    assert error(found.y, y) < 3e-5
    assert error(found.deflection, d) < 3e-5


NONLINEAR = [  # name, place, values, what Runge-Kutta takes, when, least effect on y, largest error
    ("cubic_stiffness", "isolators z", [1e13, 0.0, 0.0, 0.0], {"cubic": 1e13}, {}, 0.2, 1e-4),
    ("cubic_stiffness", "isolators z", [1e14, 0.0, 0.0, 0.0], {"cubic": 1e14}, {}, 0.5, 2e-3),
    ("contact_friction", "actuators", [3e3, 1e-5, *EVEN], {"friction": (3e3, 1e-5)}, {}, 0.1, 1e-4),
    ("contact_friction", "actuators", [3e4, 1e-7, *EVEN], {"friction": (3e4, 1e-7)}, {}, 0.01, 1e-4),
    ("contact_friction", "actuators", [3e4, 1e-3, *EVEN], {"friction": (3e4, 1e-3)}, {}, 0.5, 2e-3),
    ("contact_friction", "actuators", [3e5, 1e-6, *EVEN], {"friction": (3e5, 1e-6)}, {}, 0.5, 2e-2),
    (
        "stiffness_drift",
        "isolators/linear",
        [0.3],
        {"drift": (0.3, -100.0, 150.0)},
        {"start_s": 100.0, "campaign_s": (0.0, 150.0)},
        0.1,
        1e-4,
    ),
]


@pytest.mark.parametrize(
    ("name", "place", "values", "given", "when", "least", "largest"),
    NONLINEAR,
    ids=[f"{one[0]}-{one[2][0]:g}" for one in NONLINEAR],
)
def test_effects_of_amplitude_and_time_as_runge_kutta(name, place, values, given, when, least, largest):
    found = simulate(with_effect(name, place, values), U, None, FS, **when)
    y, d = Table(RIG).run(U, FS, **given)
    assert error(y, Table(RIG).run(U, FS)[0]) > least
    assert error(found.y, y) < largest
    assert error(found.deflection, d) < largest
    assert found.defect < 1e-5


def test_saturation_and_the_drive_limit():
    model = with_effect("actuator_saturation", "actuators", [0.4])
    assert error(simulate(model, U, None, FS).y, Table(RIG).run(np.clip(U, -0.4, 0.4), FS)[0]) < 1e-6
    assert error(Table(RIG).run(np.clip(U, -0.4, 0.4), FS)[0], Table(RIG).run(U, FS)[0]) > 0.02
    limit = RIG.drive_limit_V
    far = 20 * limit * U
    np.testing.assert_array_equal(
        simulate(BARE, far, None, FS).y, simulate(BARE, np.clip(far, -limit, limit), None, FS).y
    )


def test_two_effects_at_once():
    """Cubic mounts and friction, with drives that saturate."""
    model = with_effect("cubic_stiffness", "isolators z", [1e13, 0.0, 0.0, 0.0])
    model = with_effect("contact_friction", "actuators", [3e3, 1e-5, *EVEN], model)
    model = with_effect("actuator_saturation", "actuators", [0.5], model)
    y, _ = Table(RIG).run(np.clip(U, -0.5, 0.5), FS, cubic=1e13, friction=(3e3, 1e-5))
    assert error(simulate(model, U, None, FS).y, y) < 2e-4


@pytest.mark.parametrize(
    ("name", "place", "values"),
    [
        pytest.param(
            "base_compliance",
            "chassis/rocking",
            [5e3, 0.05, 30.0, 30.0, 40.0, 35.0, 35.0, 35.0, 0.8, 0.8, 0.8, 0.0, 0.0],
            marks=pytest.mark.slow,
        ),
        ("payload_flexible_mode", "payload", [60.0, 0.02, *np.linspace(-0.02, 0.02, 12)]),
    ],
)
def test_cubic_mounts_on_a_table_with_more_coordinates(name, place, values):
    """A chassis that recoils a little, a payload that bends a little: the march has their coordinates."""
    cubic = with_effect("cubic_stiffness", "isolators z", [1e13, 0.0, 0.0, 0.0])
    more = simulate(with_effect(name, place, values, cubic), U, None, FS)
    beside = error(simulate(with_effect(name, place, values), U, None, FS).y, simulate(BARE, U, None, FS).y)
    assert 1e-3 < beside < 0.2
    assert error(more.y, simulate(cubic, U, None, FS).y) < 3 * beside
    # With next to no force the march leaves the linear table as it is.
    soft = with_effect(name, place, values, with_effect("cubic_stiffness", "isolators z", [1.0, 0.0, 0.0, 0.0]))
    assert error(simulate(soft, U, None, FS).y, simulate(with_effect(name, place, values), U, None, FS).y) < 1e-9
    assert more.defect < 1e-5


def test_large_rotations_as_the_nonlinear_table():
    """Newton and Euler without linearisation, as this package integrates it, at a level where it shows."""
    arrays, big, x = rig_arrays(RIG.mounted_body()), np.array(U) * 20, np.zeros(12)
    still, h, out = np.zeros(6), 2.5e-4, []

    def slope(state, volts):
        return np.concatenate(
            [state[6:], payload_acceleration(state[:6].copy(), state[6:].copy(), volts, still, still, arrays)]
        )

    big = np.clip(big[:2000], -10, 10)
    for k in range(len(big)):
        out.append(x[:6].copy())
        volts = big[k - 1] if k else np.zeros(8)
        for _ in range(4):
            a = slope(x, volts)
            b = slope(x + h / 2 * a, volts)
            c = slope(x + h / 2 * b, volts)
            d = slope(x + h * c, volts)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
    true = np.array(out) @ np.vstack([mount_map(one.position) for one in RIG.isolators]).T
    model = BARE.with_effect(active(LargeMotion(), BARE, "payload", [1.0, 0.0, 0.0]))
    assert error(simulate(BARE, big, None, FS).deflection, true) > 3e-4
    assert error(simulate(model, big, None, FS).deflection, true) < 3e-5


class Bouncer(Effect):
    """A user's own effect with memory: a force by the largest deflection so far."""

    name = "bouncer"
    title = looks_like = "test"
    nonlinear = True

    def places(self, model):
        return ("isolators",)

    def parameters(self, model, place):
        return (EffectParameter("k", "N/m", "", 0.0, 0.0, 1e6, 1e3),)

    def force(self, record, place, values):
        up = record.vertical
        worn = np.maximum.accumulate(np.abs(record.deflection[:, up]), axis=0)
        return -values["k"] * (worn / 1e-5 * record.deflection[:, up]) @ record.rows[up]


def test_an_effect_with_memory_of_the_users_own():
    """The march solves what a fixed point over the whole record solves, where that converges."""
    effect = Bouncer()
    model = BARE.with_effect(ActiveEffect(effect, "isolators", effect.parameters(BARE, "isolators"), (30.0,)))
    u = U[:1500]
    found = simulate(model, u, None, FS)
    assert found.defect < 1e-5
    assert error(found.y, simulate(BARE, u, None, FS).y) > 1e-4
    # Its force, put into Runge-Kutta's place by the same table without it: d_0 - d must come from that force alone.
    table = Table(RIG)
    A, _, E, _ = table.system()
    up = np.arange(12) % 3 == 2
    worn = np.maximum.accumulate(np.abs(found.deflection[:, up]), axis=0)
    force = -30.0 * (worn / 1e-5 * found.deflection[:, up]) @ table.rows[up]
    answer = scipy.signal.lti(A, E, np.hstack([table.rows, np.zeros((12, len(A) - 6))]), np.zeros((12, 6)))
    _, moved, _ = scipy.signal.lsim(answer, force, np.arange(1500) / FS)
    assert error(found.deflection - simulate(BARE, u, None, FS).deflection, moved) < 1e-4


def test_what_has_no_motion_is_said():
    with pytest.raises(ComputationError, match="cubic_stiffness"):
        simulate(with_effect("cubic_stiffness", "isolators z", [-1e15, 0.0, 0.0, 0.0]), U, None, FS)


@pytest.mark.parametrize(
    ("u", "floor", "rate", "message"),
    [
        (U[:, :3], None, FS, "8"),
        (U, np.zeros((5, 3)), FS, "floor"),
        (np.full((10, 8), np.nan), None, FS, "finite"),
        (U, None, 500.0, "sample_rate_Hz"),
        (U[:1], None, FS, "two samples"),
    ],
)
def test_hostile_arrays(u, floor, rate, message):
    with pytest.raises(InputError, match=message):
        simulate(BARE, u, floor, rate)


def record_of(u, y, name="00", start_s=0.0, floor=None):
    header = RecordHeader(
        name,
        FS,
        len(u),
        BARE.actuators,
        BARE.sensors.names,
        "noise",
        0.3,
        start_s,
        floor_names=() if floor is None else ("vx", "vy", "vz"),
    )
    return Record(header, u, y, floor)


def parts(found, true):
    """Error of the deflection over its r.m.s.: away from the ends, and in the last two seconds."""
    size = np.sqrt(np.mean(true**2, axis=0))
    inner, last = slice(3000, -3000), slice(-2000, None)
    return tuple(float(np.max(np.sqrt(np.mean((found - true)[one] ** 2, axis=0)) / size)) for one in (inner, last))


def test_motion_of_a_table_with_cubic_mounts():
    """The model lacks an effect that changes the deflection by half; y tells it, up to 1.5 %, in the last two
    seconds 6 %."""
    u = noise(20000, 8, 0.3, 4)
    y, true = Table(RIG).run(u, FS, cubic=1e13)
    y = y + 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    campaign = Campaign("avis", (record_of(u, y),))
    without = parts(simulate(BARE, u, None, FS).deflection, true)
    inner, last = parts(motion_of(campaign, BARE)["00"].deflection, true)
    assert without[0] > 0.3
    assert inner < 0.015
    assert last < 0.06


@pytest.mark.parametrize(("measured", "largest"), [(True, 0.005), (False, 0.04)])
def test_motion_of_a_perturbed_nonlinear_table(measured, largest):
    """0.3 V on a table whose parameters are off, floor and noise: 0.5 % where the floor is measured, else 4 %."""
    plan = CampaignPlan.model_validate(
        {
            "duration_s": 30.0,
            "settle_s": 5.0,
            "ambient": {"velocity_rms_m_per_s": 2e-6},
            "truth": {"nonlinear": True},
            "floor_sensor": {"recorded": measured},
            "record": [{"excitation": "noise", "level_V": 0.3}],
        }
    )
    truth = perturbed_truth(RIG, 5.0, 20.0, 3)
    campaign = simulate_campaign(RIG, plan, 1, truth=truth)
    found = motion_of(campaign, BARE)["00"]
    again = simulate_campaign(
        RIG,
        plan.model_copy(update={"floor_sensor": plan.floor_sensor.model_copy(update={"recorded": True})}),
        1,
        truth=truth,
    ).records[0]
    # The truth's own linear model: it differs from the nonlinear one by 1e-5 at this level.
    true = simulate(TableModel(ResponseModel.of(truth, ())), again.u, again.floor, FS).deflection
    assert parts(found.deflection, true)[0] < largest
    nominal = simulate(BARE, again.u, again.floor, FS).deflection
    assert parts(nominal, true)[0] > 0.1


def test_motion_of_portions():
    y, _ = Table(RIG).run(U, FS)
    first, second = record_of(U, y, "00", 10.0), record_of(U, y, "01", 30.0)
    whole = Campaign("avis", (first, second))
    part = Campaign("avis", (Portion(first, 5000, 8000), Portion(Portion(second, 2000, 7000), 1000, 3000)))
    all_of, some = motion_of(whole, BARE), motion_of(part, BARE, whole)
    assert some["00"].campaign_s == (10.0, 38.0)
    for name, begin, stop in (("00", 5000, 8000), ("01", 3000, 5000)):
        one, full = some[name], all_of[name]
        np.testing.assert_array_equal(one.deflection, full.deflection[:stop])
        assert (one.before, one.start_s) == (begin, full.start_s + begin / FS)
        np.testing.assert_allclose(one.time_s, full.time_s[:stop], atol=1e-9)
        omega = 2 * np.pi * np.arange(1, 9) * FS / (stop - begin)
        expected = np.fft.rfft(U[begin:stop], axis=0)[1:9] / np.sqrt(stop - begin)
        np.testing.assert_allclose(one.spectrum(one.volts, omega), expected, atol=1e-12)


def test_where_the_motors_and_mounts_are():
    y, d = Table(RIG).run(U, FS)
    one = motion_of(Campaign("avis", (record_of(U, y),)), BARE)["00"]
    assert [one.rows.shape, one.deflection.shape] == [(12, 6), d.shape]
    np.testing.assert_array_equal(one.driven_rows, Table(RIG).motor_rows)
    np.testing.assert_array_equal(one.vertical, np.arange(12) % 3 == 2)
    np.testing.assert_allclose(one.rows, np.vstack(Table(RIG).maps), atol=1e-12)


@pytest.mark.parametrize("samples", [2, 50, 3000])
@pytest.mark.parametrize("rms", [0.0, 1e-3])
def test_records_at_rest_and_short_ones(samples, rms):
    """Noise of the sensors alone moves no mount by more than they could have felt of it."""
    y = rms * np.random.default_rng(1).standard_normal((samples, 6))
    model = with_effect("contact_friction", "actuators", [3e4, 1e-6, *EVEN])
    model = with_effect("cubic_stiffness", "isolators z", [1e13, 0.0, 0.0, 0.0], model)
    model = model.with_effect(active(LargeMotion(), model, "payload", [1.0, 0.0, 0.0]))
    found = motion_of(Campaign("avis", (record_of(np.zeros((samples, 8)), y),)), model)["00"]
    assert np.max(np.abs(found.deflection)) <= rms * 1e-4
    still = simulate(model, np.zeros((samples, 8)), None, FS)
    assert not np.any(still.y)
    assert not np.any(still.deflection)


def test_a_rig_without_mounts_by_name():
    rig = load_rig("halcyonics")
    model = TableModel(ResponseModel.of(rig, ()))
    rate = rig.sample_rate_Hz
    u = 0.1 * np.random.default_rng(3).standard_normal((2000, len(model.actuators)))
    found = simulate(model, u, None, rate)
    assert found.deflection.shape == (2000, 0)
    # Its second-order terms are those of mounts that are not known: the table stays linear.
    large = model.with_effect(active(LargeMotion(), model, "payload", (1.0, 0.0, 1.0)))
    np.testing.assert_array_equal(simulate(large, u, None, rate).y, found.y)
    header = RecordHeader("00", rate, 2000, model.actuators, model.sensors.names, "noise")
    motion = motion_of(Campaign(rig.name, (Record(header, u, found.y),)), model)["00"]
    assert motion.deflection.shape == (2000, 0)
