"""Campaigns with effects that the rig file does not contain, against another simulation of the same physics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from avis_ctrl.cli import app
from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats import read_measurements
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.equipment import Electronics
from avis_ctrl.simulation.perturbed_campaign import perturbed_campaign
from avis_ctrl.study.gap import find_gap
from avis_ctrl.study.hidden_effects import campaign_with_effects
from avis_ctrl.study.plan_file import plan_from_table, plan_toml, read_plan

RIG = load_rig("avis")
QUIET = {
    "duration_s": 8.0,
    "settle_s": 2.0,
    "ambient": {"velocity_rms_m_per_s": 0.0},
    "sensors": {"noise": False, "quantiser": False},
    "record": [{"excitation": "noise", "level_V": 0.2}, {"excitation": "floor", "floor_rms_m_per_s": 1e-4}],
}


def signals(*effects, **changed):
    return [
        one.y
        for one in campaign_with_effects(
            RIG, plan_from_table(QUIET | {"effect": list(effects)} | changed), 4
        ).campaign.records
    ]


def error(found, true):
    return max(float(np.std(a - b) / np.std(b)) for a, b in zip(found, true, strict=True))


def test_a_lag_as_an_effect_is_the_lag_of_the_nonlinear_simulation():
    """One acts in the frequency domain, the other is a state of each amplifier that is stepped in time."""
    tau = 1 / (2 * math.pi * 120)
    as_effect = signals({"name": "actuator_lag", "place": "actuators", "values": {"time_constant_s": tau}})
    in_time, without = signals(amplifier_corner_Hz=120.0), signals()
    assert error(without, in_time) > 0.05
    assert error(as_effect, in_time) < 2e-3


def test_a_gain_multiplies_its_channel_and_no_other():
    found, without = signals({"name": "sensor_gain", "place": "Sz2", "values": {"gain": 1.2}}), signals()
    k = list(RIG.sensor_rows()[0]).index("Sz2")
    for y, plain in zip(found, without, strict=True):
        # The second-order terms of large rotations in the nonlinear simulation are not multiplied.
        assert np.std(y[:, k] - 1.2 * plain[:, k]) < 5e-3 * np.std(plain[:, k])
        assert np.array_equal(np.delete(y, k, 1), np.delete(plain, k, 1))


def test_a_cubic_spring_grows_with_the_cube_of_the_level():
    effect = {"name": "cubic_stiffness", "place": "isolators z", "values": {"k3_N_per_m3": 1e12}}
    sizes = []
    for level in (0.02, 0.04):
        plan = {"record": [{"excitation": "noise", "level_V": level}]}
        sizes.append(np.std(signals(effect, **plan)[0] - signals(**plan)[0]))
    assert sizes[1] / sizes[0] == pytest.approx(8, rel=0.05)


def test_a_plan_with_effects_is_written_as_it_is_read(tmp_path):
    plan = plan_from_table(
        QUIET
        | {
            "effect": [
                {"name": "sensor_gain", "place": "Sz2", "values": {"gain": 1.2}},
                {"name": "loop_delay", "values": {"extra_delay_s": 1e-3}},
            ]
        }
    )
    path = tmp_path / "plan.toml"
    path.write_text(plan_toml(plan), encoding="utf-8")
    assert read_plan(path) == plan
    with pytest.raises(InputError, match="change"):
        perturbed_campaign(RIG, plan)


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        ({"name": "gremlins"}, r"effect\[1\].name.*gremlins.*cubic_stiffness"),
        ({"name": "cable_stifness"}, r"effect\[1\].name.*: did you mean cable_stiffness\? expected one of"),
        ({"name": "sensor_gain", "values": {"gain": 1.2}}, r"effect\[1\].place.*Sz2"),
        ({"name": "sensor_gain", "place": "Sz9", "values": {"gain": 1.2}}, r"effect\[1\].place.*Sz9"),
        ({"name": "loop_delay", "values": {"delay": 1.0}}, r"effect\[1\].values.*extra_delay_s.*0 to 0.2 s"),
        ({"name": "loop_delay", "values": {"extra_delay_s": 1.0}}, r"extra_delay_s.*0 to 0.2 s"),
        ({"name": "loop_delay"}, r"effect\[1\].values.*does nothing.*extra_delay_s"),
        ({"name": "loop_delay", "values": {"extra_delay_s": "long"}}, r"extra_delay_s.*number"),
        ({"nam": "loop_delay"}, "nam"),
    ],
)
def test_wrong_effects_are_one_line(effect, said):
    with pytest.raises(InputError, match=said) as caught:
        signals(effect)
    assert "\n" not in str(caught.value)


OWN = '''
from avis_ctrl.gap.effects.base import Effect, EffectParameter, register


@register
class Sensor(Effect):
    """A gain of one sensor."""

    name, title, looks_like = "half_gain", "a gain", "one output is larger"

    def places(self, model):
        return model.sensors.names

    def parameters(self, model, place):
        return (EffectParameter("gain", "1", "gain", none=1.0, low=0.0, high=2.0, size=0.1),)

    def change(self, ops, place, values):
        ops.sense[:, ops.sensor(place)] *= values["gain"]
'''


def test_the_command_with_an_effect_of_ones_own(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    plan = plan_from_table(QUIET | {"effect": [{"name": "half_gain", "place": "Sy1", "values": {"gain": 0.5}}]})
    (tmp_path / "plan.toml").write_text(plan_toml(plan))
    files = {name: str(tmp_path / name) for name in ("plan.toml", "own.py", "c.h5", "truth.toml")}
    app(
        [
            "simulate-campaign",
            "--rig",
            "avis",
            "--plan",
            files["plan.toml"],
            "--effects",
            files["own.py"],
            "--out",
            files["c.h5"],
            "--truth",
            files["truth.toml"],
            "--seed",
            "4",
        ],
        standalone_mode=False,
    )
    k, (plain, _) = list(RIG.sensor_rows()[0]).index("Sy1"), signals()
    y = read_measurements(files["c.h5"]).records[0].load().y
    assert np.std(y[:, k] - 0.5 * plain[:, k]) < 0.02 * np.std(plain[:, k])
    assert "half_gain, Sy1, gain = 0.5" in (tmp_path / "truth.toml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "parameter", "true"),
    [
        (
            {"name": "actuator_lag", "place": "actuators", "values": {"time_constant_s": 1.3e-3}},
            "time_constant_s",
            1.3e-3,
        ),
        ({"name": "geophone_corner", "place": "Sz2", "values": {"corner_Hz": 4.95}}, "corner_Hz", 4.95),
    ],
)
def test_an_effect_is_named_behind_an_anti_alias_filter(effect, parameter, true):
    rig = RIG.with_electronics(Electronics(anti_alias_order=3, anti_alias_corner_Hz=200.0))
    plan = {
        "duration_s": 30.0,
        "band_Hz": [0.5, 60.0],
        "floor_sensor": {"recorded": False},
        "effect": [effect],
        "truth": {"perturb_percent": 5.0, "perturb_damping_percent": 20.0},
        "record": [{"excitation": "noise", "level_V": level, "records": 2} for level in (0.08, 0.2, 0.4)],
    }
    gap = find_gap(campaign_with_effects(rig, plan_from_table(plan), 4).campaign, rig).gap
    assert [one.name for one in gap.effects] == [effect["name"]] and gap.verdict == "explained"
    found = gap.effects[0].parameters[parameter]
    assert found.value == pytest.approx(true, abs=3 * found.std)
