"""What effects do to a design: the plant around them, the files that carry them, mu before and after."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import Effect, EffectParameter
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.realisation import Realised, notes_on
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.lti.connect import lft_lower, lft_upper
from avis_ctrl.lti.statespace import gain
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.study.controllers import mu_optimal
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.gap_design import PARAMETERS_PERCENT, LoopFigures, compare_designs, design_effect, figures
from avis_ctrl.study.gap_plant import design_files, plant_of, six_dof_is_stable, wiring_of
from avis_ctrl.study.identification_design import default_design
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.skyhooks import classical_skyhook
from avis_ctrl.uncertainty.blocks import RealScalar

ROOT = Path(__file__).resolve().parents[2]
OMEGA = 2 * np.pi * np.geomspace(0.2, 150.0, 60)
LAG_40_HZ = ("actuator_lag", "actuators", (1 / (2 * np.pi * 40),))


@pytest.fixture(scope="module")
def rig():
    return load_rig("avis")


@pytest.fixture(scope="module")
def baseline(rig):
    return TableModel(ResponseModel.of(rig, ("mass",)))


@pytest.fixture(scope="module")
def design(rig):
    return default_design(rig, "z and phi_x", PARAMETERS_PERCENT)


def with_one(model: TableModel, name: str, place: str, values) -> TableModel:
    return replace(model, effects=(*model.effects, active(library()[name], model, place, values)))


def response(plant) -> np.ndarray:
    return plant.full.P.frequency_response(OMEGA)


def same(a: np.ndarray, b: np.ndarray, share: float = 1e-8) -> bool:
    """Entry by entry, against the largest of each entry over frequency."""
    return bool(np.all(np.abs(a - b).max(axis=0) <= share * np.abs(b).max(axis=0) + 1e-10 * np.abs(b).max()))


def test_default_is_the_design_of_the_repository(rig, design):
    written, _ = read_study(ROOT / "designs" / "avis_z_phix.toml")
    assert written.uncertainty == design.uncertainty and written.transmissibility == design.transmissibility
    assert written.control_effort == design.control_effort and written.loop == design.loop


def test_without_effects_it_is_the_plant_of_the_design(rig, baseline, design):
    plant, asked, table = plant_of(design, baseline)
    assert asked == design and table == rig
    assert same(response(plant), response(build_plant(design, rig)), 0.0)


@pytest.mark.parametrize(
    "name, place, values",
    [
        ("com_offset", "payload", (0.0, 0.0, 0.0)),
        ("sensor_gain", "Sz1", (1.0,)),
        ("mount_relaxation", "isolators z", (0.0, 3.0)),
        ("attached_oscillator", "payload/z", (0.0, 12.0, 0.05, 0.1, 0.1)),
        ("tilt_coupling", "horizontal geophones", (0.0,)),
        ("structural_damping", "isolators/causal", (0.0,)),
        ("leveling_loop", "isolators 1-3 z/plain", (0.0,)),
        (
            "base_compliance",
            "chassis/rocking",
            (1e12, 0.05, 90.0, 90.0, 90.0, 90.0, 90.0, 90.0, 1e3, 1e3, 1e3, 0.0, 0.0),
        ),
    ],
)
def test_effects_without_strength_leave_the_plant(baseline, design, name, place, values):
    plant, _, _ = plant_of(design, with_one(baseline, name, place, values))
    # A chassis that is heavy enough still filters the floor, by design.
    rows = slice(None)
    before = response(plant_of(design, baseline)[0])
    if name == "base_compliance":
        rows = [k for k, n in enumerate(plant.full.P.inputs) if not n.startswith("floor")]
    assert same(response(plant)[:, :, rows], before[:, :, rows], 1e-6)


def test_a_sensor_gain_is_seen_through_the_decoding(baseline, design):
    """Closed form: seen = (I + decoding (g - 1) e_k row_k) seen before, noise apart."""
    plain, _, _ = plant_of(design, baseline)
    plant, _, _ = plant_of(design, with_one(baseline, "sensor_gain", "Sz2", (1.25,)))
    k = plain.sensors.index("Sz2")
    _, rows = baseline.rig.sensor_rows()
    row = rows[k][[2, 3]] / np.array([1.0, baseline.rig.edge_m])
    mixing = np.eye(2) + 0.25 * np.outer(plain.decoding[:, k], row)
    seen, volts = list(plain.full.y), list(plain.full.u)
    before = plain.full.P.select(seen, volts).frequency_response(OMEGA)
    assert np.allclose(plant.full.P.select(seen, volts).frequency_response(OMEGA), mixing @ before, rtol=1e-9)


def test_the_controller_keeps_its_allocation(rig, baseline, design):
    """A motor that pushes harder than the controller knows pushes harder."""
    plain, _, _ = plant_of(design, baseline)
    constant = rig.parameters()["actuator.Az1"].value
    stronger = replace(baseline, base=replace(baseline.base, rig=rig.with_parameters({"actuator.Az1": 2 * constant})))
    plant, _, _ = plant_of(design, stronger, wiring_of(plain, baseline))
    gained, _, _ = plant_of(design, with_one(baseline, "actuator_gain", "Az1", (2.0,)))
    assert same(response(plant), response(gained))
    assert not same(response(plant), response(plain), 1e-2)


def test_the_controller_keeps_its_decoding(rig, design):
    """Of a sensor that is elsewhere, turned and of another sensitivity: seen = decoding g rows of the new table times
    its motion; with an effect (of no strength) the plant is put together in another way, and is the same."""
    base = TableModel(ResponseModel.of(rig.with_channels_apart(), ("place.Sz2.y", "direction.Sz2.x", "sensor.Sz2")))
    other = base.at(base.values * [1, 0, 1.03] + [0.02, 0.05, 0])
    plain, moved_rig = plant_of(design, base)[0], other.effective.rig
    plant, _, _ = plant_of(design, other, wiring_of(plain, base))
    _, rows = moved_rig.sensor_rows()
    gains = np.where(np.array(plain.sensors) == "Sz2", 1.03, 1.0)
    mixing = (plain.decoding * gains) @ rows[:, [2, 3]] / np.array([1.0, rig.edge_m])
    assert np.abs(mixing - np.eye(2)).max() > 0.01
    inputs, outputs = list(plain.full.u), list(plain.full.y)
    before = plain.full.P.select(outputs, inputs).frequency_response(OMEGA)
    assert np.allclose(plant.full.P.select(outputs, inputs).frequency_response(OMEGA), mixing @ before, rtol=1e-9)
    again, _, _ = plant_of(
        design, with_one(other, "mount_relaxation", "isolators z", (0.0, 3.0)), wiring_of(plain, base)
    )
    assert same(response(again), response(plant))


def test_tolerances_bring_no_drive_and_no_copy_more(rig, design):
    """A motor that is tilted within its tolerance is no further drive of yesterday's loop, and round-off of places
    makes no stiffness enter squared."""
    apart = rig.with_channels_apart()
    names = [name for name in apart.parameters() if ".p_" in name or name.startswith(("com_", "direction.A"))]
    base = TableModel(ResponseModel.of(apart, names))
    other = base.at(base.values + 1e-3 * np.random.default_rng(3).standard_normal(len(names)))
    plain = plant_of(design, base)[0]
    plant, _, _ = plant_of(design, other, wiring_of(plain, base))
    assert plant.actuators == plain.actuators
    copies = {block.name: block.rows for block in plant.full.blocks.blocks}
    assert copies.pop("mass") == 2  # its centre is off the middle
    assert set(copies.values()) == {1}


def moved(plant, size: float) -> np.ndarray:
    """Response of one table of the design's set: every real delta at `size`."""
    P, blocks = plant.full.P, plant.full.blocks
    real = np.concatenate([np.full(b.rows, size if isinstance(b, RealScalar) else 0.0) for b in blocks.blocks])
    return lft_upper(P, np.diag(real)).frequency_response(OMEGA)


@pytest.mark.parametrize(
    "name, place, values, seen",
    [
        (*LAG_40_HZ, True),
        ("loop_delay", "loop", (3e-3,), True),
        ("com_offset", "payload", (0.01, 0.03, -0.02), True),
        ("product_of_inertia", "Jxy", (4.0,), False),
        ("contact_friction", "actuators", (6e3, 1e-5, *(0.0,) * 7), True),
        ("actuator_saturation", "actuators", (2.0,), True),
        ("actuator_saturation", "actuators/each", (2.0, 0.1, *(0.0,) * 6), True),
    ],
)
def test_the_files_hold_what_they_say(baseline, design, tmp_path, name, place, values, seen):
    """The plant that `avis design` makes of rig.toml and design.toml is the updated one."""
    model = with_one(baseline, name, place, values)
    files = design_files(design, model)
    assert files.inside == (f"{name}@{place}",) and files.outside == ()
    for file, text in files.texts().items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    plant, updated = build_plant(*read_study(tmp_path / "design.toml")), plant_of(design, model)[0]
    assert same(moved(plant, 0.0), moved(updated, 0.0))
    # In the file the friction is stiffness like any other, so that its range in per cent covers it too.
    assert same(moved(plant, 0.7), moved(updated, 0.7)) or name == "contact_friction"
    # z and phi_x alone do not feel a product of inertia.
    assert same(moved(plant, 0.0), moved(plant_of(design, baseline)[0], 0.0), 1e-3) == (not seen)


def test_gains_in_the_files_are_known_to_the_controller(baseline, design):
    model = with_one(with_one(baseline, "sensor_gain", "Sz1", (1.2,)), "actuator_gain", "Az1", (0.8,))
    found = design_files(design, model)
    old = baseline.rig
    assert found.rig.geophones.sensitivity_Vs_per_m[found.rig.geophones.names.index("Sz1")] == pytest.approx(
        1.2 * old.geophones.sensitivity_Vs_per_m[old.geophones.names.index("Sz1")]
    )
    assert found.rig.parameters()["actuator.Az1"].value == pytest.approx(0.8 * old.parameters()["actuator.Az1"].value)


def test_a_force_constant_of_the_halcyonics_has_its_own_name():
    """It is e2 there, and not actuator.A2."""
    asked, rig = read_study(ROOT / "designs" / "halcyonics_z_phix.toml")
    model = with_one(TableModel(ResponseModel.of(rig, ("mass",))), "actuator_gain", "A2", (0.8,))
    found = design_files(asked, model)
    assert found.inside == ("actuator_gain@A2",)
    assert found.rig.e == pytest.approx([0.8 * e if k == 1 else e for k, e in enumerate(rig.e)])


def test_drift_is_carried_at_the_moment_asked(baseline, design):
    found = design_files(design, with_one(baseline, "stiffness_drift", "isolators", (0.2,)), -0.5)
    old = baseline.rig.parameters()["isolator2.k_z"].value
    assert found.rig.parameters()["isolator2.k_z"].value == pytest.approx(0.9 * old)


def test_files_say_what_they_do_not_hold(baseline, design):
    found = design_files(design, with_one(baseline, "mount_relaxation", "isolators z", (0.4, 3.0)))
    assert found.inside == () and found.outside == ("mount_relaxation@isolators z",)


@pytest.mark.parametrize(
    ("name", "place", "values"),
    [("actuator_lag", "actuators/two", (4e-3, 0.7)), ("actuator_lag", "actuators/each", (4e-3, 0.2, *(0.0,) * 6))],
)
def test_files_hold_one_pole_for_all_amplifiers(baseline, design, name, place, values):
    found = design_files(design, with_one(baseline, name, place, values))
    assert found.inside == () and found.outside == (f"{name}@{place}",)


class SensorLowpass(Effect):
    """A user's own effect without a state space (docs/own_effect.md)."""

    name, title, looks_like = "sensor_lowpass", "one sensor passes a low-pass", "one output lags"

    def parameters(self, model, place):
        return (EffectParameter("time_constant_s", "s", "of the low-pass", 0.0, 0.0, 0.1, 1e-3),)

    def change(self, ops, place, values):
        ops.sense[:, ops.sensor(place)] /= 1 + ops.s * values["time_constant_s"]


def gap_of(baseline, updated, *effects):
    return SimpleNamespace(baseline=baseline, updated=updated, effects=effects, covariance=None)


def test_an_effect_without_a_realisation_is_said_to_be_unchecked(monkeypatch, baseline, design):
    """A low-pass of 2 Hz in one sensor would matter to any loop; the linear plant does not hold it."""
    monkeypatch.setattr(
        "avis_ctrl.study.gap_design.mu_optimal",
        lambda asked, plant, rig: (SimpleNamespace(K=gain(np.zeros((2, 2)))), SimpleNamespace(status="stand-in")),
    )
    same = LoopFigures(True, True, 0.8, 0.79, 3.0, 1.0, 4.0, 2.0, 50.0)
    monkeypatch.setattr("avis_ctrl.study.gap_design.figures", lambda *of: same)
    monkeypatch.setattr(
        "avis_ctrl.study.gap_design.realise",
        lambda model: Realised(gain(np.zeros((1, 1))), OMEGA, 0.0, 0.0, notes_on(model)),
    )
    left_out = (
        active(SensorLowpass(), baseline, "Sz1", (0.08,)),
        active(library()["cubic_stiffness"], baseline, "isolators z", (1e9, 0.0, 0.0, 0.0)),
    )
    updated = replace(baseline, effects=left_out)
    hum = SimpleNamespace(name="mains_hum", location="geophones", label="")
    found = design_effect(gap_of(baseline, updated, hum), design)
    assert set(found.not_checked) == {"sensor_lowpass@Sz1", "cubic_stiffness@isolators z", "mains_hum@geophones"}
    assert "contains none of the named effects" in found.sentences[0]
    assert "the effect does not matter" not in " ".join(found.sentences)
    said = next(one for one in found.sentences if one.startswith("NOT checked"))
    assert all(label in said for label in found.not_checked) and "no realisation" in said
    assert found.to_json()["not_checked"] == found.not_checked


@pytest.mark.slow
def test_two_ways_to_the_same_limit_of_stability(rig, baseline, design):
    """Delay that a skyhook survives: on the design's plant, and on six coordinates through every channel's chain."""
    plain, asked, _ = plant_of(design, baseline)
    K = classical_skyhook(plain, rig, design).K
    assert six_dof_is_stable(asked, baseline, plain, K) and plain.full.closed(K).is_stable()

    def stable(ms: float) -> tuple[bool, bool]:
        model = with_one(baseline, "loop_delay", "loop", (1e-3 * ms,))
        plant, own, _ = plant_of(design, model, wiring_of(plain, baseline))
        return plant.full.closed(K).is_stable(), six_dof_is_stable(own, model, plant, K)

    def limit(way: int) -> float:
        low, high = 0.0, 60.0
        while high - low > 0.2:
            middle = (low + high) / 2
            low, high = (middle, high) if stable(middle)[way] else (low, middle)
        return low

    first, second = limit(0), limit(1)
    assert 0.5 < first < 59 and second == pytest.approx(first, rel=0.15)


def test_an_unstable_loop_has_no_figures(rig, baseline, design):
    plain, asked, _ = plant_of(design, baseline)
    K = -classical_skyhook(plain, rig, design).K.scaled(3.0)
    assert not lft_lower(plain.full.P, K).is_stable()
    found = figures(asked, baseline, plain, K)
    assert not found.stable and not found.stable_in_six and found.mu_upper == np.inf


def test_refusals(baseline, design, tmp_path):
    path = tmp_path / "design.toml"
    path.write_text("title = 1\n", encoding="utf-8")
    with pytest.raises(InputError):
        design_effect(gap_of(baseline, baseline), path)
    by_name = design.model_copy(
        update={"uncertainty": design.uncertainty.model_copy(update={"identified": "uncertainty.json"})}
    )
    with pytest.raises(InputError, match="set by hand"):
        design_effect(gap_of(baseline, baseline), by_name)
    halcyonics = TableModel(ResponseModel.of(load_rig("halcyonics"), ("mass",), unit="m/s"))
    with pytest.raises(InputError, match="give a design file"):
        design_effect(gap_of(halcyonics, halcyonics))


@pytest.mark.slow
def test_an_amplifier_lag_costs_the_controller_and_a_new_one_wins_it_back(baseline):
    found = design_effect(gap_of(baseline, with_one(baseline, *LAG_40_HZ)))
    assert found.before.stable and found.before.mu_upper < 1
    assert found.after.mu_upper > 1.1 * found.before.mu_upper
    assert found.new.mu_upper < 0.95 * found.after.mu_upper
    for one in (found.before, found.after, found.new):
        assert one.mu_lower <= one.mu_upper <= 1.05 * one.mu_lower
        assert one.peak_dB <= one.worst_peak_dB and one.band_dB <= one.worst_band_dB and one.stable_in_six
    assert "mu is no longer below 1" in found.sentences[0]
    assert "amplifier_corner_Hz = 40" in found.files["design.toml"]


@pytest.mark.slow
def test_an_iteration_that_stalls_above_its_target_goes_on(baseline, design):
    """D-K iteration alone stalls at 1.24 on the plant of these files and reaches 0.88 on the model's own."""
    model = with_one(
        with_one(baseline, "contact_friction", "actuators", (1.5e4, 5e-6, *(0.0,) * 7)),
        "stiffness_drift",
        "isolators/linear",
        (-0.037,),
    )
    found = design_files(design, model, -0.5)
    plant = build_plant(found.design, found.rig)
    candidate, made = mu_optimal(found.design, plant, found.rig)
    assert made.status == "target 0.9 reached"
    assert mu_peak(plant.synthesis.closed(candidate.K), plant.synthesis.all_blocks).upper < 0.95


@pytest.mark.slow
def test_an_effect_that_does_nothing_leaves_mu(baseline, design):
    lines = []
    found = compare_designs(
        baseline, with_one(baseline, "mount_relaxation", "isolators z", (0.0, 3.0)), design, lines.append
    )
    assert found.after.mu_upper == pytest.approx(found.before.mu_upper, rel=1e-2)
    assert "mu hardly changes" in found.sentences[0] and len(lines) == 5


@pytest.mark.slow
def test_nothing_named_nothing_compared(baseline, design):
    found = compare_designs(baseline, baseline, design)
    assert found.after is None and found.new is None and "nothing else was computed" in found.sentences[0]
