"""`find_gap` from end to end on the independent truth, and what it says to input that is wrong."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from truth.cases import best_prediction, draw_case, rig, simulate_case

import avis_ctrl as ac
from avis_ctrl.errors import AvisError, ComputationError, InputError
from avis_ctrl.gap.result import VERDICTS
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.study import gap as gap_study
from avis_ctrl.study.gap import GapOptions, find_gap
from avis_ctrl.study.new_files import NewRig, rig_text
from benchmarks.blind.lines import Answer, Named, parse

ROOT = Path(__file__).parents[2]
UNSTAGED = {"sensor_quantisation", "ground_motion"}  # they change the noise, not what a model explains


def found_in(duration_s=20.0, **case):
    drawn = draw_case(duration_s=duration_s, **case)
    return drawn, find_gap(simulate_case(drawn), rig())


# --- nothing, one, two, something else


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 21])
def test_nothing_is_missing(seed):
    _, found = found_in(seed=seed, kind="none")
    assert found.gap.verdict == "none"
    assert found.gap.effects == ()
    assert [stage.name for stage in found.gap.stages] == ["nominal", "re-identified", "tolerances"]
    assert found.gap.stages[1].chi2_per_dof < 1.21
    assert found.gap.next_experiment is None
    assert found.gap.where == ()


# Campaigns of the blind table of version 0.4.0 in which an earlier engine was wrong: seed, whether the table is off its
# rig file everywhere, effect, its parameter in report and truth, and the largest relative error.
ONCE_WRONG = [
    (93281, False, "attached_oscillator", "mass_kg", "mass_kg", 0.03),  # three close frequencies
    (93183, True, "leveling_loop", "rate_Hz", "rate_Hz", 0.06),  # beside a small structural loss
    (93172, True, "actuator_lag", "corner_Hz", "corner_Hz", 0.01),  # amplifiers with two poles
    (93236, True, "cubic_stiffness", "k3_N_per_m3", "cubic_N_per_m3", 0.05),  # a sensor's gain is wrong, too
]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "clutter", "name", "reported", "hidden", "most"), ONCE_WRONG)
def test_parameters_that_were_once_wrong(seed, clutter, name, reported, hidden, most):
    drawn, found = found_in(60.0, seed=seed, clutter=clutter)
    (true,) = (one.parameters[hidden] for one in drawn.effects if one.name == name)
    (mine,) = (one for one in (*found.gap.effects, *found.gap.traces) if one.name == name)
    assert mine.parameters[reported].value == pytest.approx(true, rel=most)


# One of each family: seed, strength (gross where a small departure is within tolerance), duration, and the truth's
# name of the parameter by the report's.
ONE = {
    "geophone_corner": (2, "gross", 20.0, {"corner_Hz": "corner_Hz"}),
    "mains_hum": (3, "clear", 20.0, {"frequency_Hz": "frequency_Hz", "amplitude_V": "amplitude_V"}),
    "actuator_gain": (5, "gross", 20.0, {"gain": "gain"}),
    "actuator_lag": (6, "clear", 20.0, {"corner_Hz": "corner_Hz"}),
    "actuator_saturation": (7, "clear", 20.0, {"limit_V": "limit_V"}),
    "contact_friction": (9, "clear", 20.0, {}),  # each contact of its own: no one value is the true one
    "cable_stiffness": (13, "clear", 20.0, {}),  # one oblique direction: nine numbers of which the truth tells one
    "mount_relaxation": (12, "clear", 20.0, {"stiffness_ratio": "stiffness_ratio", "corner_Hz": "corner_Hz"}),
    "product_of_inertia": (10, "gross", 20.0, {"Jxy_kgm2": "product_kgm2"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ONE)
def test_one_effect_is_named_at_its_place_with_its_size(name):
    seed, strength, duration_s, known = ONE[name]
    case, found = found_in(duration_s, seed=seed, effect=name, strength=strength)
    true, gap = case.effects[0], found.gap
    assert [(one.name, one.location) for one in gap.effects] == [(true.name, true.location)]
    assert gap.verdict == "explained"
    for reported, truly in known.items():
        estimate, value = gap.effects[0].parameters[reported], true.parameters[truly]
        assert estimate.value == pytest.approx(value, abs=4 * estimate.std + 0.01 * abs(value))
        assert estimate.std > 0
    assert gap.effects[0].probability > 0.9
    before, after = gap.stages[1], gap.stages[-1]
    assert after.name == name
    assert after.chi2_per_dof < 1.44
    # Within 1.2 of the noise floor, or down by a factor of 10.
    assert after.nrmse < 1.2 * gap.noise_nrmse or after.nrmse < 0.1 * before.nrmse
    if name != "mains_hum":
        assert gap.updated.effects[-1].effect.name == name
    require_contract(found.to_json())


@pytest.mark.slow
def test_two_effects_are_both_named():
    case, found = found_in(seed=17, kind="two", strength="gross")
    assert {(one.name, one.location) for one in found.gap.effects} == {(one.name, one.location) for one in case.effects}
    assert found.gap.verdict == "explained"
    require_contract(found.to_json())


@pytest.mark.slow
def test_a_gain_that_drifts_is_named_beside_a_lag():
    """It drifts by 2 % in time, which no effect of the library describes."""
    case, found = found_in(seed=74063, clutter=True, duration_s=60.0)
    assert {one.name for one in case.effects} == {"actuator_lag", "actuator_gain"}
    assert {one.name: one.location for one in found.gap.effects} == {one.name: one.location for one in case.effects}
    gain = next(one.parameters["gain"] for one in found.gap.effects if one.name == "actuator_gain")
    true = next(one.parameters["gain"] for one in case.effects if one.name == "actuator_gain")
    assert gain.value - 1 == pytest.approx(true - 1, rel=0.15)  # it drifts


@pytest.mark.slow
def test_a_gain_is_named_beside_a_flexible_mode():
    """The force of this drive also acts on the mode."""
    case, found = found_in(seed=81027, clutter=True, duration_s=60.0)
    true = {one.name: one.location for one in case.effects}
    assert set(true) == {"actuator_gain", "payload_flexible_mode"}
    named = {one.name: one.location for one in found.gap.effects}
    assert true.items() <= named.items()
    assert named.keys() - true.keys() <= {one.name for one in case.traces}  # of every table of this kind


@pytest.mark.slow
def test_the_readme_quotes_this_search():
    plan = tomllib.loads((ROOT / "designs" / "plans" / "lagging_amplifiers.toml").read_text())
    gap = find_gap(ac.simulate_campaign("avis", plan, seed=1), load_rig("avis"), GapOptions()).gap
    assert " ".join(gap.sentences[0].split()) in " ".join((ROOT / "README.md").read_text().split())


@pytest.mark.slow
def test_records_with_two_clocks_give_no_name():
    """The delay grows by 47 ms in every record; a constant delay of 20 ms explains half of it."""
    case, found = found_in(seed=82036, clutter=True, duration_s=60.0)
    assert [one.name for one in case.effects] == ["clock_rate_error"]
    assert found.gap.verdict == "unexplained" and not found.gap.effects
    assert any("gate sample clock" in one and "faster" in one for one in found.gap.sentences)


@pytest.mark.slow
def test_a_cable_that_tolerances_imitate_is_named():
    """Values of the rig file up to ten tolerances away leave 0.3 % of the response; starting values found there lead to
    a cable of a few newtons per metre at the wrong place, and to the verdict that nothing is missing."""
    text = rig_text(NewRig("granite", 420.0, (1.2, 0.9, 0.25), 4, 3.0, 2.5)).partition("[tolerances]")[0]
    table = rig_from(
        tomllib.loads(text.replace("centre_of_mass_m = [0.0, 0.0, 0.0]", "centre_of_mass_m = [0.01, 0.0, 0.03]"))
    )
    records = [{"excitation": "noise", "level_percent": level, "records": 2} for level in (50.0, 25.0, 10.0)]
    cable = {"k_x_N_per_m": 2000.0, "k_z_N_per_m": 4000.0, "damping_s": 0.01, "x_m": 0.5, "y_m": 0.2, "z_m": 0.1}
    plan = {
        "duration_s": 60.0,
        "band_Hz": [0.5, 100.0],
        "truth": {"perturb_percent": 5.0, "perturb_damping_percent": 20.0},
        "record": [*records, {"excitation": "rest"}],
        "effect": [{"name": "cable_stiffness", "place": "payload/axes", "values": cable}],
    }
    gap = find_gap(ac.simulate_campaign(table, plan, seed=11), table, GapOptions()).gap
    assert gap.verdict == "explained" and [one.name for one in gap.effects] == ["cable_stiffness"]
    for name, value in cable.items():
        found = gap.effects[0].parameters[name]
        assert abs(found.value - value) < 3 * found.std
        assert abs(found.value - value) < 0.1 * abs(value) + (0.01 if name.endswith("_m") else 0.0)


@pytest.mark.slow
def test_a_heavy_sprung_mass_is_no_flexible_mode():
    """Mass and stiffness of the fit without it are off by more than to first order."""
    case = draw_case(7, effect="attached_oscillator", strength="gross", duration_s=20.0)
    mass = 0.02 * rig().parameters()["mass"].value
    heavy = replace(
        case.effects[0],
        parameters={"mass_kg": mass, "frequency_Hz": 9.0, "damping_ratio": 0.03},
        details={
            **case.effects[0].details,
            "point_m": [0.4, -0.3, 0.4],
            "axes": np.eye(3).tolist(),
            "frequencies_Hz": [9.0, 9.0, 14.0],
        },
    )
    found = find_gap(simulate_case(replace(case, effects=(heavy,))), rig()).gap
    (named,) = found.effects
    assert named.name == "attached_oscillator"
    assert named.parameters["mass_kg"].value == pytest.approx(mass, rel=0.02)
    assert found.verdict == "explained"


@pytest.mark.slow
def test_distortion_that_an_effect_predicts_is_no_noise():
    """Friction under noise, no record at rest: a local model of the records takes most of the distortion for noise."""
    case = draw_case(40020, duration_s=60.0)
    campaign = simulate_case(case)
    found = find_gap(campaign, rig()).gap
    assert [one.name for one in found.effects] == [one.name for one in case.effects] == ["contact_friction"]
    power, total = 0.0, 0.0
    for record, best in zip(campaign.records, best_prediction(case), strict=True):
        y = record.load().y
        power, total = power + np.sum((y - best) ** 2, axis=0), total + np.sum(y**2, axis=0)
    noise = float(np.sqrt(np.mean(power / total)))
    assert 0.3 * noise < found.noise_nrmse < 3 * noise
    assert found.effects[0].parameters["force_N"].value == pytest.approx(
        case.effects[0].parameters["coulomb_N"], rel=0.03
    )


@pytest.mark.slow
def test_a_delayed_sensor_is_not_named_as_its_corner_and_gain():
    """A delay of one sensor by 4.2 ms is not in the library; parts of it look like another corner and another gain."""
    case, found = found_in(seed=80002, clutter=False, duration_s=60.0)
    assert [(one.name, one.location) for one in case.effects] == [("sensor_delay", "Sz1")]
    assert found.gap.verdict == "unexplained" and not found.gap.effects
    assert "a low-pass filter or a delay in Sz1 only" in " ".join(found.gap.sentences)


@pytest.mark.slow
def test_a_sensor_that_resonates_is_not_named_as_a_flexible_mode():
    """A faint resonance of one sensor, still ringing at the ends of the records."""
    case, found = found_in(seed=79002, clutter=False, duration_s=60.0)
    assert [(one.name, one.location) for one in case.effects] == [("sensor_spurious_resonance", "Sy1")]
    assert not found.gap.effects and found.gap.verdict in ("none", "unexplained")  # it is 0.2 % of the response
    assert "a resonance of Sy1 alone at 26.6 Hz" in " ".join(found.gap.sentences)


@pytest.mark.slow
def test_what_is_outside_the_library_is_not_named_as_something_else():
    """Drag in proportion to the square of speed: significant, and no effect of the library."""
    case, found = found_in(seed=15, effect="air_drag", strength="gross")
    assert case.kind == "outside"
    assert found.gap.effects == ()
    assert found.gap.verdict == "unexplained"
    assert found.gap.stages[1].chi2_per_dof > 10
    assert found.gap.where
    assert found.gap.next_experiment
    require_contract(found.to_json())


@pytest.mark.parametrize(
    ("name", "stated", "taken"),
    [("avis", None, None), ("avis", 90.0, 90.0), ("halcyonics", None, 300.0), ("halcyonics", 90.0, 90.0)],
)
def test_the_amplifiers_of_a_table_with_accelerometers_lag(monkeypatch, name, stated, taken):
    """As `avis identify` and `avis simulate-campaign` have it; a rig file states no lag."""
    rig, asked = load_rig(name), []

    def stop(campaign, rig, seed, band_Hz, corner, *rest):
        asked.append(corner)
        raise ComputationError("enough")

    monkeypatch.setattr(gap_study, "analyse", stop)
    y, u = tuple(rig.sensor_rows()[0]), rig.equations_of_motion().actuators
    header = RecordHeader("00", rig.sample_rate_Hz, 400, u, y, "noise", 1.0, 0.0, y_unit="V")
    rng = np.random.default_rng(1)
    record = Record(header, rng.standard_normal((400, len(u))), rng.standard_normal((400, len(y))))
    with pytest.raises(ComputationError, match="enough"):
        gap_study.find_gap(Campaign(name, (record,)), rig, GapOptions(gates=False, amplifier_corner_Hz=stated))
    assert asked == [taken]


# --- the contract


def require_contract(told):
    """gap.json by a model of its own, and what the contract says in words."""
    answer = parse(json.dumps(told, allow_nan=False), Answer)
    for one in (*answer.effects, *(Named.model_validate(trace) for trace in told["traces"])):
        assert one.name not in one.indistinguishable_from and one.parameters
        assert all(value.std is not None for value in one.parameters.values())
    stages = [one.stage for one in answer.gap]
    assert stages[:3] == ["nominal", "re-identified", "tolerances"]
    assert sorted(stages[3:]) == sorted(
        one["name"] for one in (*told["effects"], *told["traces"]) if one["name"] not in UNSTAGED
    )
    assert all(one.nrmse > 0 and one.chi2_per_dof > 0 for one in answer.gap) and answer.seconds > 0
    assert sum(one.share for one in answer.where) < 1 + 1e-9
    assert all(0 <= one.from_Hz < one.to_Hz and 0 < one.share <= 1 for one in answer.where)
    if answer.verdict in ("none", "unexplained"):
        assert not answer.effects
    if answer.verdict == "none":
        assert not answer.where


def test_verdicts_are_the_contracts_words(shared):
    text = (shared / "contracts" / "gap.md").read_text(encoding="utf-8")
    assert tuple(re.search(r'"verdict": "([^"]+)"', text)[1].split(" | ")) == VERDICTS


# --- input that is wrong

RIG = load_rig("avis")
NAMES = RIG.equations_of_motion().actuators, RIG.geophones.names


def campaign(
    samples=3000,
    drive=0.3,
    u_names=NAMES[0],
    y_names=NAMES[1],
    records=2,
    rate=1000.0,
    unit="V",
    excitation="noise",
    change=lambda u, y: None,
):
    rng = np.random.default_rng(1)
    made = []
    for k in range(records):
        u, y = drive * rng.standard_normal((samples, len(u_names))), 0.1 * rng.standard_normal((samples, len(y_names)))
        change(u, y)
        made.append(
            Record(
                RecordHeader(f"{k:02d}", rate, samples, u_names, y_names, excitation, drive, 100.0 * k, u_unit=unit),
                u,
                y,
            )
        )
    return Campaign("avis", tuple(made))


def nan(u, y):
    y[7, 2] = np.nan


def dead(u, y):
    y[:, 1] = 0.25


def responses():
    f = np.linspace(1, 50, 20)
    value = np.ones((20, 6, 8), complex)
    return FrequencyResponse(f, value, None, None, *NAMES, dof=10.0, entry_variance=np.ones((20, 6, 8)))


HOSTILE = {
    "without drive": (lambda: campaign(drive=0.0), "drive"),
    "at rest": (lambda: campaign(drive=0.0, excitation="rest"), "drive"),
    "y of another rig": (lambda: campaign(y_names=tuple(f"S{k}" for k in range(6))), "S0"),
    "u of another rig": (lambda: campaign(u_names=tuple(f"A{k}" for k in range(8))), "A0"),
    "two samples": (lambda: campaign(samples=2), "samples"),
    "a hundred samples": (lambda: campaign(samples=100), "samples"),
    "NaN": (lambda: campaign(change=nan), "sample 7 of channel Sx2"),
    "a dead channel": (lambda: campaign(change=dead), "channel"),
    "another rate": (lambda: campaign(rate=500.0), "sample_rate"),
    "newtons": (lambda: campaign(unit="N"), "unit of u = 'N': expected commanded voltages"),
    "frequency responses": (responses, "expected records in time"),
    "no record": (lambda: campaign(records=0), "expected at least one record"),
}


@pytest.mark.parametrize("gates", [True, False], ids=["gates", "no gates"])
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_input_is_one_line(case, gates):
    make, said = HOSTILE[case]
    with pytest.raises(AvisError) as error:
        find_gap(make(), RIG, GapOptions(gates=gates))
    assert isinstance(error.value, InputError), error.value
    assert "\n" not in str(error.value)
    assert said in str(error.value)


@pytest.mark.slow
def test_a_band_without_excitation():
    """There noise agrees with any model. It is refused before anything is computed."""
    case, steps = draw_case(duration_s=6.0, seed=3, kind="none"), []
    with pytest.raises(InputError, match=r"band_Hz .*expected a band in which the records are excited"):
        find_gap(simulate_case(case), rig(), GapOptions(band_Hz=(200.0, 300.0)), steps.append)
    assert not steps


@pytest.mark.parametrize("band", [(60.0, 1.0), (-1.0, 20.0), (3.0, 3.0), (600.0, 700.0), (np.nan, 3.0)])
def test_bands_that_are_none(band):
    with pytest.raises(InputError, match="band_Hz"):
        find_gap(campaign(), RIG, GapOptions(gates=False, band_Hz=band))


@pytest.mark.parametrize("corner", [0.0, -5.0, np.nan, np.inf])
def test_corners_that_are_none(corner):
    with pytest.raises(InputError, match="amplifier_corner_Hz"):
        GapOptions(amplifier_corner_Hz=corner)


def test_a_rig_of_other_channels():
    with pytest.raises(InputError):
        find_gap(replace(campaign(), rig="halcyonics"), load_rig("halcyonics"))
