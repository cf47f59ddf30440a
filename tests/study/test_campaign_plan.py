"""Campaign plans: files, the default ones, and everything that a user can get wrong in one."""

import copy
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.library import library
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import EffectPlan, RecordPlan
from avis_ctrl.study.plan_file import CampaignPlan, default_plan, plan_from_table, plan_toml, read_plan

TEXT = """
title = "a plan"
duration_s = 30.0
band_Hz = [1.0, 80.0]
[multisine]
scheme = "orthogonal"
lines = "odd_detection"
period_s = 5.0
[ambient]
spectrum = "ligo_livingston"
velocity_rms_m_per_s = 1e-6
[floor_sensor]
noise_rms_m_per_s = 1e-8
[truth]
perturb_percent = 5.0
[[record]]
excitation = "multisine"
level_V = 0.2
records = 2
[[record]]
excitation = "floor"
floor_rms_m_per_s = 1e-4
"""


def written(tmp_path, old="", new=""):
    assert old in TEXT
    path = tmp_path / "plan.toml"
    path.write_text(TEXT.replace(old, new, 1), encoding="utf-8")
    return path


def test_a_plan_is_read(tmp_path):
    plan = read_plan(written(tmp_path))
    assert isinstance(plan, CampaignPlan) and plan.multisine.period_s == 5.0 and plan.record[0].records == 2
    assert plan.truth.perturb_damping_percent == 0.0 and plan.record[1].excitation == "floor"


WRONG = [
    ("duration_s = 30.0", "duration_ms = 30.0", "duration_ms", "unit in this key is wrong; expected duration_s"),
    ("duration_s = 30.0", "duration_s = -1.0", "duration_s = -1.0", "greater than 0"),
    ("level_V = 0.2", "level_V = 0.2\nlevel_percent = 10.0", "record[1].level_percent", "not both"),
    ("level_V = 0.2", "level_V = 0.0", "record[1].level_V = 0.0", "greater than 0"),
    ("floor_rms_m_per_s = 1e-4", "", "record[2].floor_rms_m_per_s", "expected the r.m.s. velocity"),
    ("floor_rms_m_per_s = 1e-4", "floor_rms_m_per_s = 1e-4\nlevel_V = 1.0", "record[2].level_V", "silent"),
    ("level_V = 0.2", "floor_rms_m_per_s = 1.0", "record[1].floor_rms_m_per_s", 'excitation = "floor"'),
    ('"multisine"\nlevel', '"multisin"\nlevel', "record[1].excitation = 'multisin'", "'multisine'"),
    ("[1.0, 80.0]", "[80.0, 1.0]", "band_Hz", "lower limit first"),
    ("[1.0, 80.0]", "[80.0]", "band_Hz", "at least 2"),
    ("ligo_livingston", "ligo", "ambient.spectrum = 'ligo'", "expected one of"),
    ("records = 2", "records = 0", "record[1].records = 0", "a number, 1 or more"),
    ("records = 2", "record = 2", "record[1].record", "did you mean records"),
    ("perturb_percent = 5.0", "perturb_percent = 100.0", "truth.perturb_percent = 100.0", "less than 100"),
    ("orthogonal", "both", "multisine.scheme = 'both'", "zippered"),
    ("duration_s = 30.0", "duration_s = nan", "duration_s = nan", "finite"),
]


@pytest.mark.parametrize(("old", "new", "field", "expected"), WRONG, ids=[str(k) for k in range(len(WRONG))])
def test_wrong_entries_are_answered_in_one_line(tmp_path, old, new, field, expected):
    path = written(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        read_plan(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and field in message and expected in message and "\n" not in message


def test_files_that_are_no_plans(tmp_path):
    for name, content, expected in (
        ("broken.toml", b"x = = 1", "TOML"),
        ("empty.toml", b"", "record: this section is"),
        ("latin.toml", b'title = "\xe9"', "UTF-8"),
        ("deep.toml", b"x=" + b"[" * 5000, "TOML"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=expected):
            read_plan(tmp_path / name)
    for path in (tmp_path / "absent.toml", tmp_path):
        with pytest.raises(InputError):
            read_plan(path)
    (tmp_path / "bom.toml").write_text(TEXT, encoding="utf-8-sig")
    assert read_plan(tmp_path / "bom.toml").title == "a plan"


TABLE = {
    "title": "t",
    "duration_s": 30.0,
    "band_Hz": [1.0, 80.0],
    "multisine": {"period_s": 5.0, "group": 4},
    "ambient": {"velocity_rms_m_per_s": 1e-6},
    "truth": {"perturb_percent": 5.0},
    "record": [{"excitation": "multisine", "level_V": 0.2}],
}
PLACES = [
    ("title",),
    ("duration_s",),
    ("band_Hz",),
    ("band_Hz", 1),
    ("multisine",),
    ("multisine", "period_s"),
    ("multisine", "group"),
    ("ambient", "velocity_rms_m_per_s"),
    ("truth",),
    ("record",),
    ("record", 0),
    ("record", 0, "excitation"),
    ("record", 0, "level_V"),
]
hostile = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.just(10**400),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(PLACES), hostile)
def test_any_entry_replaced_by_anything_is_a_plan_or_one_line(place, value):
    table = copy.deepcopy(TABLE)
    parent = table
    for part in place[:-1]:
        parent = parent[part]
    parent[place[-1]] = value
    try:
        assert isinstance(plan_from_table(table), CampaignPlan)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 600


@pytest.mark.parametrize("name", ["avis", "halcyonics_loaded"])
def test_default_plans(name):
    rig = load_rig(name)
    plan = default_plan(rig, perturbed=True, duration_s=20.0)
    assert plan.truth.perturb_percent == 5.0 and plan.truth.perturb_damping_percent == 20.0
    quick = plan.model_copy(update={"multisine": plan.multisine.model_copy(update={"low_crest": False})})
    kinds = [record.header.excitation for record in simulate_campaign(rig, quick).records]
    assert kinds == ["multisine"] * 4 + ["noise", "rest", "floor"]
    levels = [record.level_percent for record in default_plan(rig, "orthogonal").record]
    assert levels == [12.5, 25.0, 50.0, 50.0, None, None]
    assert default_plan(rig).duration_s == 60.0 and default_plan(rig).truth.perturb_percent == 0.0


def test_plans_are_written_as_they_are_read(tmp_path):
    for plan in (
        read_plan(written(tmp_path)),
        default_plan(load_rig("halcyonics")),
        plan_from_table(TABLE | {"title": 'a "quoted" \\ \x7f \u00b5 line\nand another'}),
    ):
        path = tmp_path / "again.toml"
        path.write_text(plan_toml(plan), encoding="utf-8")
        assert read_plan(path) == plan


def test_the_guide_lists_every_key_of_a_plan_and_no_other():
    guide = (Path(__file__).parents[2] / "docs" / "campaign_plan.md").read_text()
    example = plan_from_table(tomllib.loads(re.search(r"```toml\n(.*?)```", guide, re.S)[1]))
    assert [one.excitation for one in example.record] == ["multisine", "noise", "floor"]
    listed = {
        title or "": set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?) \|", rows, re.M))))
        for title, rows in re.findall(r"^## (?:`\[+(\w+)\]+`)?(.*?)(?=^## |\Z)", guide, re.S | re.M)
        if re.search(r"^\| `", rows, re.M)
    }
    kept = CampaignPlan.model_fields
    sections = {key: field.annotation for key, field in kept.items() if hasattr(field.annotation, "model_fields")}
    expected = {key: set(section.model_fields) for key, section in sections.items()}
    assert listed == {
        **expected,
        "record": set(RecordPlan.model_fields),
        "effect": {*EffectPlan.model_fields, *library()},
        "": set(kept) - set(sections) - {"record", "effect"},
    }
