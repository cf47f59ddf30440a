"""Models of avis gap in files: round trips, hostile content; the folder, and predictions of other campaigns from it."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from avis_ctrl.cli.identify import predict as predict_command
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.mounts import campaign_clock
from avis_ctrl.gap.model_files import model_from_dict, model_to_dict, read_model
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.result import Gap, NamedEffect, Reported, Stage, Where
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.predictor import Predictor
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.formats.hdf5 import write_campaign
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.rig_file import load_rig as read_rig
from avis_ctrl.study.file_names import GAP_FILES
from avis_ctrl.study.gap import GapFinding, GapOptions, find_gap, predict
from avis_ctrl.study.gap_axis import write_axis_gap, write_axis_predictions
from avis_ctrl.study.gap_files import read_gap, rig_with_effects, write_gap, write_gap_predictions

RIG = load_rig("avis")
FREE = ("mass", "J1", "isolator1.k_z", "isolator2.c_x", "actuator.Az1", "sensor.Sz2")
OMEGA = 2 * np.pi * np.geomspace(0.3, 90, 40)


def base_model(rig=RIG):
    model = TableModel(ResponseModel.of(rig, FREE))
    return model.at(model.values * np.linspace(0.971234567890123, 1.03, len(FREE)))


BASE = base_model()


def some_values(effect, place, model=BASE):
    """Away from none and from the bounds."""
    rng, found = np.random.default_rng(5), []
    for one in effect.parameters(model, place):
        start = one.grid[len(one.grid) // 2] if one.grid else one.none
        value = start + one.size * rng.uniform(0.05, 0.3)
        found.append(float(np.clip(value, one.low, one.high)))
    return found


EVERYWHERE = [(name, place) for name, effect in library().items() for place in effect.places(BASE)]


@pytest.mark.parametrize(("name", "place"), EVERYWHERE, ids=["@".join(one) for one in EVERYWHERE])
def test_every_effect_comes_back(name, place):
    effect = library()[name]
    model = BASE.with_effect(active(effect, BASE, place, some_values(effect, place)))
    written = json.loads(json.dumps(model_to_dict(model), allow_nan=False))
    again, _ = model_from_dict(written)
    assert model_to_dict(again) == written
    assert again.names == model.names
    np.testing.assert_array_equal(again.values, model.values)
    np.testing.assert_array_equal(again.response(OMEGA), model.response(OMEGA))


def test_several_effects_clock_and_drives():
    base = replace(BASE.base, amplifier_corner_Hz=173.25, delay_s=1.23456789e-3)
    model = TableModel(base)
    for effect, place in (
        (LargeMotion(), "payload"),
        (library()["com_offset"], "payload"),
        (library()["geophone_corner"], "Sy3"),
    ):
        model = model.with_effect(active(effect, model, place, some_values(effect, place)))
    record = RecordMotion(
        "00",
        1e3,
        12.5,
        (12.5, 390.25),
        *(np.zeros((4, 8)), np.zeros((4, 12)), np.zeros((12, 6)), np.zeros(12), np.zeros(12, bool), np.zeros(8, int)),
    )
    model = replace(model, motion={"00": record})
    written = json.loads(json.dumps(model_to_dict(model)))
    again, _ = model_from_dict(written)
    assert campaign_clock(model) == (12.5, 390.25)
    assert written["campaign_s"] == [12.5, 390.25]
    assert [one.label for one in again.effects] == [one.label for one in model.effects]
    assert (again.delay_s, again.amplifier_corner_Hz) == (1.23456789e-3, 173.25)
    np.testing.assert_array_equal(again.response(OMEGA), model.response(OMEGA))


def test_an_inertia_that_no_body_has_comes_back():
    """What the data gave is kept, though no rig file may hold it."""
    model = TableModel(ResponseModel.of(RIG.with_parameters({"J3": 500.0}), ()))
    written = model_to_dict(model)
    assert written["rig_values"]["J3"] == 500.0
    assert model_from_dict(written)[0].rig == model.rig


def test_halcyonics_comes_back():
    model = TableModel(ResponseModel.of(load_rig("halcyonics_loaded"), ("mass",)))
    model = model.with_effect(active(library()["actuator_gain"], model, model.actuators[0], [1.07]))
    again, _ = model_from_dict(json.loads(json.dumps(model_to_dict(model))))
    np.testing.assert_allclose(again.response(OMEGA), model.response(OMEGA), rtol=1e-12)


def test_a_halcyonics_file_takes_a_gain_and_a_delay_of_the_drives():
    rig = load_rig("halcyonics")
    model = TableModel(ResponseModel.of(rig, ("mass",)))
    for name, place, value in (("actuator_gain", "A2", 1.07), ("loop_delay", "all channels", 0.3e-3)):
        model = model.with_effect(active(library()[name], model, place, [value]))
    updated, left = rig_with_effects(model)
    assert left == []
    assert updated.e[1] == pytest.approx(1.07 * rig.e[1]) and updated.e[0] == rig.e[0]
    assert updated.loop_delay_s == pytest.approx(rig.loop_delay_s + 0.3e-3)


def changed(**changes):
    return {**model_to_dict(BASE), **changes}


HOSTILE = [
    ([], "format"),
    ({}, "format"),
    (changed(format="avis-gap"), "format"),
    (changed(version=2), "version"),
    ({key: value for key, value in changed().items() if key != "rig"}, "rig"),
    (changed(extra=1), "extra"),
    (changed(rig="name = "), "rig"),
    (changed(rig='name = "x"'), "rig"),
    (changed(rig=changed()["rig"].replace("mass_kg", "mass_g")), "mass_g"),
    (changed(rig_values={"weight": 3.0}), "weight"),
    (changed(rig_values={"mass": -3.0}), "mass"),
    (changed(rig_values={"mass": float("nan")}), "rig_values"),
    (changed(sensors=["Sz9"] * 6), "sensors"),
    (changed(sensors=[]), "sensors"),
    (changed(sensitivity=[1.0]), "sensitivity"),
    (changed(sensitivity=["a"] * 6), "sensitivity"),
    (changed(sensitivity=[-1.0] * 6), "sensitivity"),
    (changed(actuators=["Ax9"]), "u names"),
    (changed(free=["weight"]), "parameters"),
    (changed(unit="furlong"), "unit"),
    (changed(delay_s=-1.0), "delay_s"),
    (changed(period_s="fast"), "period_s"),
    (changed(campaign_s=[2.0, 1.0]), "campaign_s"),
    (changed(campaign_s=[1.0]), "campaign_s"),
    (changed(effects=[{"name": "ghost", "place": "attic", "values": {}}]), "effects\\[1\\].name"),
    (changed(effects=[{"name": "sensor_gain", "place": "attic", "values": {"gain": 1.1}}]), "effects\\[1\\].place"),
    (changed(effects=[{"name": "sensor_gain", "place": "Sz2", "values": {"loss": 1.1}}]), "effects\\[1\\].values"),
    (changed(effects=[{"name": "sensor_gain", "place": "Sz2"}]), "effects\\[1\\].values"),
    (changed(effects=[{"name": "sensor_gain", "place": "Sz2", "values": {"gain": True}}]), "gain"),
    (
        changed(
            effects=[
                {
                    "name": "mount_relaxation",
                    "place": "isolators z",
                    "values": {"stiffness_ratio": 1.0, "corner_Hz": 0.0},
                }
            ]
        ),
        "finite response",
    ),
    (changed(effects="all"), "effects"),
    (changed(loaded=True), "load"),
]


@pytest.mark.parametrize(("content", "message"), HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_models(content, message, tmp_path):
    path = tmp_path / "updated.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        read_model(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"null"])
def test_what_is_no_json(content, tmp_path):
    path = tmp_path / "updated.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"updated\.json"):
        read_model(path)
    with pytest.raises(InputError, match=r"gone\.json"):
        read_model(tmp_path / "gone.json")


def updated_model():
    model = BASE
    for name, place, values in (
        ("sensor_gain", "Sz1", [0.8]),
        ("cubic_stiffness", "isolators z", [3e12, 0.1, 0.0, -0.1]),
        ("actuator_gain", "Ax2", [1.2]),
        ("com_offset", "payload", [0.01, 0.0, -0.02]),
    ):
        model = model.with_effect(active(library()[name], model, place, values))
    return model


def gap_of(updated=None, effects=()):
    updated = updated or updated_model()
    return Gap(
        "explained",
        tuple(effects),
        (Stage("nominal", 0.3, 900.0), Stage("re-identified", 0.1, float("inf"))),
        (Where(2.0, 6.0, "Az1", "Sz2", 0.8),),
        (),
        0.01,
        None,
        BASE,
        updated,
        (),
        None,
        ("found",),
        "record 05 held out",
        1,
        2.5,
        np.diag(np.arange(1.0, 1 + len(updated.names))),
    )


def named(name, location, **parameters):
    reported = {key: Reported(value, 0.01, "V") for key, value in parameters.items()}
    return NamedEffect(name, location, name, reported, 0.99)


def test_the_folder(tmp_path):
    written = write_gap(tmp_path, gap_of(), b"<html></html>", b"%PDF-1.7")
    assert {one.name for one in written} == set(GAP_FILES) == {one.name for one in tmp_path.iterdir()}
    assert written[-1].name == "gap.json"
    found = read_gap(tmp_path)
    assert found["verdict"] == "explained"
    assert [one["chi2_per_dof"] for one in found["gap"]] == [900, None]
    for name, model in (("baseline", BASE), ("updated", updated_model())):
        np.testing.assert_array_equal(read_model(tmp_path / f"{name}.json")[0].response(OMEGA), model.response(OMEGA))
    rig = read_rig(tmp_path / "baseline.toml")
    assert rig.mass == BASE.rig.mass
    assert rig.geophones.sensitivity_Vs_per_m[3] == pytest.approx(BASE.base.sensors.sensitivity[3] / 100)
    # The rig file of the updated model holds gains and centre of mass, and says that it lacks the cubic stiffness.
    rig, text = read_rig(tmp_path / "updated.toml"), (tmp_path / "updated.toml").read_text()
    linear = TableModel(ResponseModel.of(rig, ()))
    np.testing.assert_allclose(linear.response(OMEGA), updated_model().response(OMEGA), rtol=1e-9, atol=1e-12)
    assert "cubic_stiffness" in text
    assert "3e+12" in text
    assert "sensor_gain" not in text
    assert "mass +- 1 kg" in text


def test_gap_json_says_where_it_comes_from(tmp_path):
    made_by = {"seed": 3, "measurement_sha256": "ab"}
    found = GapFinding(gap_of(), campaign_of(1.0, samples=10), (), made_by, None, "no controller")
    write_gap(tmp_path, found.gap, content=found.to_json())
    told = read_gap(tmp_path)
    assert told["provenance"] == made_by
    assert (told["noise_nrmse"], told["sentences"], told["design"], told["design_note"]) == (
        0.01,
        ["found"],
        None,
        "no controller",
    )


def find_gap_quickly(monkeypatch, options):
    """find_gap with a given result of the search."""
    monkeypatch.setattr("avis_ctrl.study.gap.analyse", lambda *arguments: gap_of())
    return find_gap(campaign_of(1.0), RIG, replace(options, gates=False))


def test_a_design_that_cannot_be_read_costs_no_result(tmp_path, monkeypatch):
    path = tmp_path / "design.toml"
    found = find_gap_quickly(monkeypatch, GapOptions(design=True, design_file=path))
    assert found.design is None and "no such file" in found.design_note
    assert "design_sha256" not in found.provenance


def test_the_hash_is_that_of_the_design_file_as_it_was_read(tmp_path, monkeypatch):
    path = tmp_path / "design.toml"
    path.write_text("as read")

    def synthesis(gap, design, progress):
        design.write_text("edited during the synthesis")

    monkeypatch.setattr("avis_ctrl.study.gap.design_effect", synthesis)
    found = find_gap_quickly(monkeypatch, GapOptions(design=True, design_file=path))
    assert found.provenance["design_sha256"] == hashlib.sha256(b"as read").hexdigest()


def test_without_reports_and_again(tmp_path):
    write_gap(tmp_path, gap_of(), b"<html></html>", b"%PDF-1.7")
    write_gap(tmp_path, gap_of())
    assert {one.name for one in tmp_path.iterdir()} == set(GAP_FILES) - {"gap.html", "gap.pdf"}


def test_a_run_without_a_design_removes_that_of_an_earlier_run(tmp_path):
    """Only what avis gap wrote: files of the user in that folder remain."""
    (tmp_path / "design").mkdir()
    (tmp_path / "design" / "design.toml").write_text("my own")
    write_gap(tmp_path, gap_of())
    assert (tmp_path / "design" / "design.toml").read_text() == "my own"
    written = write_gap(
        tmp_path,
        gap_of(),
        content=gap_of().to_json() | {"design": {"before": {}}},
        design={"rig.toml": "a", "design.toml": "b"},
    )
    assert written[-1].name == "gap.json" and (tmp_path / "design" / "design.toml").read_text() == "b"
    (tmp_path / "design" / "notes.txt").write_text("my own")
    write_gap(tmp_path, gap_of())
    assert [path.name for path in (tmp_path / "design").iterdir()] == ["notes.txt"]


def test_a_response_removes_the_model_of_an_earlier_drive(tmp_path):
    """A seismometer has no model that predicts records; that of another kind in the same folder would be used."""

    def written(model):
        found = SimpleNamespace(model=model, seconds=1.0, to_json=lambda: {"format": "avis-gap-axis"})
        return write_axis_gap(tmp_path, found, "record.csv", {}, lambda *given: (b"<html></html>", b"%PDF-1.7"))

    assert written({"kind": "drive", "reading": {}})[-1] == "axis_model.json"
    assert written({"kind": "seismometer"}) == ["gap.json", "gap.html", "gap.pdf"]
    with pytest.raises(InputError, match="expected the model of a drive or an oscillator"):
        write_axis_predictions(tmp_path, [], tmp_path / "p.h5")


def test_a_disk_that_refuses_leaves_the_old_result_whole(tmp_path, monkeypatch):
    """No file of the new result stands beside those of the old one."""
    write_gap(tmp_path, gap_of())
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def full(path, content):
        raise ComputationError(f"{path} was not written", cause="no space left")

    monkeypatch.setattr("avis_ctrl.files.write_whole", full)
    with pytest.raises(ComputationError, match="no space left"):
        write_gap(tmp_path, gap_of())
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def campaign_of(level, names=None, floor=False, samples=3000, unit="V"):
    rng, base = np.random.default_rng(2), BASE.base
    names = names or base.sensors.names
    records = []
    for k in range(2):
        u = level * rng.standard_normal((samples, 8))
        w = 1e-6 * rng.standard_normal((samples, 3)) if floor else None
        header = RecordHeader(
            f"{k:02d}",
            1e3,
            samples,
            base.actuators,
            names,
            "noise",
            level,
            10.0 * k,
            y_unit=unit,
            floor_names=("vx", "vy", "vz") if floor else (),
        )
        records.append(Record(header, u, np.zeros((samples, len(names))), w))
    return Campaign("avis", tuple(records))


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "gap"
    path.mkdir()
    write_gap(
        path,
        gap_of(
            None,
            [named("sensor_quantisation", "Sz2", clip_high_V=0.5, clip_low_V=-0.25), named("mains_hum", "geophones")],
        ),
    )
    return path


def test_predictions(folder, tmp_path):
    """In the campaign's channels and order, of either model, within what the converters can show."""
    order = ("Sz2", "Sy1", "Sz1")
    campaign, out = campaign_of(0.5, order, floor=True), tmp_path / "pred.h5"
    write_gap_predictions(folder, campaign, out)
    rows = [BASE.sensors.names.index(name) for name in order]
    with h5py.File(out) as file:
        assert "mains_hum" in file.attrs["not_predicted"]
        assert "floor" not in file.attrs["not_predicted"]
        for record in campaign.records:
            group = file[f"records/{record.header.name}"]
            assert [one.decode() for one in group["y_updated"].attrs["names"]] == list(order)
            assert group["y_updated"].attrs["unit"] == "V"
            exact = Predictor(BASE.base).read(record.u, record.floor)[:, rows]
            np.testing.assert_allclose(group["y_baseline"], exact, atol=2e-4 * np.abs(exact).max())
            updated = simulate(updated_model(), record.u, record.floor, 1e3).y[:, rows]
            assert np.max(updated[:, 0]) > 0.5
            updated[:, 0] = np.clip(updated[:, 0], -0.25, 0.5)
            np.testing.assert_allclose(group["y_updated"], updated, atol=1e-9)
            assert np.max(np.abs(group["y_updated"][:, 2] - group["y_baseline"][:, 2])) > 0.01


def test_predictions_from_python_are_those_of_the_file(tmp_path):
    """A converter that clips is a trace here; `avis predict` and `study.gap.predict` both know of it."""
    gap = replace(gap_of(), traces=(named("sensor_quantisation", "Sz2", clip_high_V=0.5),))
    path, out, campaign = tmp_path / "gap", tmp_path / "pred.h5", campaign_of(0.5, ("Sz2", "Sy1"), floor=True)
    path.mkdir()
    write_gap(path, gap)
    write_gap_predictions(path, campaign, out)
    found = predict(GapFinding(gap, campaign, (), {}), campaign)
    with h5py.File(out) as file:
        for record, pair in zip(campaign.records, found, strict=True):
            for name, y in zip(("y_baseline", "y_updated"), pair, strict=True):
                np.testing.assert_allclose(y, file[f"records/{record.header.name}/{name}"], atol=1e-9)
    assert max(y[:, 0].max() for _, y in found) <= 0.5 < max(y[:, 0].max() for y, _ in found)


def test_a_drift_goes_on_as_in_the_campaign_in_which_it_was_found(tmp_path):
    """A record at 30 s of another, shorter campaign: early in a drift over 400 s, not at its end."""
    effect = library()["stiffness_drift"]
    found = RecordMotion(
        "00",
        1e3,
        0.0,
        (0.0, 400.0),
        *(np.zeros((4, 8)), np.zeros((4, 12)), np.zeros((12, 6)), np.ones(12), np.zeros(12, bool), np.zeros(8, int)),
    )
    model = replace(BASE.with_effect(active(effect, BASE, "isolators/linear", [0.3])), motion={"00": found})
    other, path, out = campaign_of(0.5), tmp_path / "gap", tmp_path / "pred.h5"
    record = other.records[0]
    other = replace(other, records=(replace(record, header=replace(record.header, start_s=30.0)),))
    gap = replace(gap_of(), updated=model)
    path.mkdir()
    write_gap(path, gap)
    write_gap_predictions(path, other, out)
    ((_, y),) = predict(GapFinding(gap, other, (), {}), other)
    expected = simulate(model, record.u, record.floor, 1e3, start_s=30.0, campaign_s=(0.0, 400.0)).y
    np.testing.assert_allclose(y, expected, atol=1e-9)
    with h5py.File(out) as file:
        np.testing.assert_allclose(file["records/00/y_updated"], y, atol=1e-9)


def test_predictions_at_the_limits(folder, tmp_path):
    """Drives beyond their limit clip, and so does the converter of the rig file."""
    campaign, out = campaign_of(12.0), tmp_path / "pred.h5"
    write_gap_predictions(folder, campaign, out)
    record = campaign.records[0]
    exact = np.clip(Predictor(BASE.base).read(np.clip(record.u, -10, 10)), -10, 10 - 20 / 2**14)
    with h5py.File(out) as file:
        found = file["records/00/y_baseline"][:]
        assert "floor of records 00, 01" in file.attrs["not_predicted"]
    assert np.max(np.abs(exact)) == 10
    # White drives: near half the sample rate the closed form of aliases, for the mass alone, is what differs.
    np.testing.assert_allclose(found, exact, atol=1e-4 * 10)


def test_the_command(folder, tmp_path):
    path, out = tmp_path / "campaign.h5", tmp_path / "pred.h5"
    write_campaign(path, campaign_of(0.1))
    predict_command(folder, path, out)
    with h5py.File(out) as file:
        assert set(file["records/01"]) == {"y_baseline", "y_updated"}


@pytest.mark.parametrize(
    ("campaign", "message"),
    [
        (campaign_of(0.1, unit="m/s"), "unit of y"),
        (campaign_of(0.1, ("Sz2", "S9")), "S9"),
        (
            Campaign(
                "avis",
                tuple(
                    replace(one, header=replace(one.header, sample_rate_Hz=500.0)) for one in campaign_of(0.1).records
                ),
            ),
            "record 00: sample_rate_Hz",
        ),
    ],
)
def test_campaigns_that_do_not_fit(folder, campaign, message, tmp_path):
    with pytest.raises(InputError, match=message):
        write_gap_predictions(folder, campaign, tmp_path / "pred.h5")
    assert not (tmp_path / "pred.h5").exists()


def break_file(name, text):
    def act(folder: Path):
        (folder / name).write_text(text, encoding="utf-8")

    return act


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (break_file("gap.json", "{"), r"gap\.json"),
        (break_file("gap.json", "[1]"), r"gap\.json: format"),
        (break_file("gap.json", '{"format": "avis-gap", "effects": 3}'), r"gap\.json: effects"),
        (lambda folder: (folder / "updated.json").unlink(), r"updated\.json"),
        (break_file("baseline.json", "{}"), r"baseline\.json: format"),
        (shutil.rmtree, r"gap\.json"),
    ],
)
def test_folders_that_are_broken(folder, damage, message, tmp_path):
    damage(folder)
    with pytest.raises(InputError, match=message):
        write_gap_predictions(folder, campaign_of(0.1), tmp_path / "pred.h5")
