"""Effects of the user's own: the guide's example as it stands, and files that are wrong."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avis_command import avis
from truth.cases import draw_case, rig, simulate_case

from avis_ctrl.errors import InputError
from avis_ctrl.gap.analysis import analyse
from avis_ctrl.gap.effects import base
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.user_effects import load_effects, try_out
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, Record
from avis_ctrl.measurement.formats.hdf5 import write_campaign
from avis_ctrl.rigs import load_rig
from avis_ctrl.study.gap import GapOptions, find_gap

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "own_effect.md"
BARE = TableModel(ResponseModel.of(load_rig("avis"), ()))
TAU, PLACE = 2e-3, "Sz2"
WIDE = {"COLUMNS": "200"}


@pytest.fixture(autouse=True)
def _library_as_it_was():
    before = library()
    yield
    base.restore(before)


@pytest.fixture
def example(tmp_path):
    """The guide's code block, verbatim."""
    blocks = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 1
    path = tmp_path / "my_effects.py"
    path.write_text(blocks[0], encoding="utf-8")
    return path


def low_passed(campaign: Campaign) -> Campaign:
    """One channel through 1/(1 + s tau), on the lines of its padded record."""
    records = []
    for source in campaign.records:
        record = source.load()
        h, y = record.header, record.y.copy()
        k = h.y_names.index(PLACE)
        f = np.fft.rfftfreq(2 * h.samples, 1 / h.sample_rate_Hz)
        spectrum = np.fft.rfft(y[:, k], 2 * h.samples) / (1 + 2j * np.pi * f * TAU)
        y[:, k] = np.fft.irfft(spectrum)[: h.samples]
        records.append(Record(h, record.u, y, record.floor))
    return replace(campaign, records=tuple(records))


def hidden() -> Campaign:
    return low_passed(simulate_case(draw_case(101, kind="none", duration_s=20.0)))


def test_the_example_loads_and_acts(example):
    own = load_effects(example)
    assert own.names == ("sensor_lowpass",)
    assert own.sha256 == hashlib.sha256(example.read_bytes()).hexdigest()
    try_out(own, BARE)
    effect = library()["sensor_lowpass"]
    assert effect.places(BARE) == BARE.sensors.names
    omega = 2 * np.pi * np.array([1.0, 80.0])
    analogue = TableModel(ResponseModel.of(load_rig("avis"), (), sampled=False))
    ratio = analogue.with_effect(active(effect, BARE, PLACE, [TAU])).response(omega) / analogue.response(omega)
    k = BARE.sensors.names.index(PLACE)
    np.testing.assert_allclose(np.delete(ratio, k, axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(ratio[:, k, 3], 1 / (1 + 1j * omega * TAU), rtol=1e-9)
    again = BARE.with_effect(active(effect, BARE, PLACE)).response(omega)
    np.testing.assert_array_equal(again, BARE.response(omega))
    assert load_effects(example).names == own.names  # a second time in one process


def test_every_attribute_that_the_guide_names_exists():
    ops = BARE.operators(np.array([1.0, 2.0]))
    for name in set(re.findall(r"\bops\.(\w+)", GUIDE.read_text(encoding="utf-8"))):
        assert hasattr(ops, name), name
    for name in set(re.findall(r"^- `(\w+)\(", GUIDE.read_text(encoding="utf-8"), re.MULTILINE)):
        assert hasattr(base.Effect, name) or name == "addition", name  # which `state_space.has_addition` asks for


@pytest.mark.slow
def test_the_example_is_found_and_named(example):
    campaign = hidden()
    without = find_gap(campaign, rig())
    assert "sensor_lowpass" not in [one.name for one in without.gap.effects]
    found = find_gap(campaign, rig(), GapOptions(own_effects=load_effects(example)))
    assert [(one.name, one.location) for one in found.gap.effects] == [("sensor_lowpass", PLACE)]
    corner = found.gap.effects[0].parameters["corner_Hz"]
    true = 1 / (2 * np.pi * TAU)
    assert abs(corner.value - true) < 4 * corner.std + 0.01 * true
    assert found.gap.verdict == "explained"
    assert found.provenance["own_effects_sha256"] == hashlib.sha256(example.read_bytes()).hexdigest()


@pytest.mark.slow
def test_candidates_can_be_given_as_objects(example):
    """In Python a class is enough; nothing has to be registered in a file."""
    own = load_effects(example).names[0]
    gap = analyse(hidden(), rig(), effects=[library()[name] for name in (own, "geophone_corner")])
    assert [(one.name, one.location) for one in gap.effects] == [("sensor_lowpass", PLACE)]


START = "import numpy as np\nfrom avis_ctrl.gap.effects.base import Effect, EffectParameter, register\n"
CLASS = (
    START
    + """
@register
class Own(Effect):
    name, title, looks_like = "own_thing", "something", "something"
    def places(self, model): return ("payload",)
    def parameters(self, model, place): return (EffectParameter("k", "N/m", "a k", 0.0, -1.0, 1.0, 0.1),)
    def change(self, ops, place, values): pass
"""
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("def broken(:\n", "line 1: SyntaxError"),
        ("\n\nimport no_such_module\n", "line 3: ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise SystemExit(0)\n", "line 1: SystemExit: 0"),
        ("x = 1\n", "registers no effect"),
        ("\x00", "expected a Python file that runs"),
        (CLASS.replace("own_thing", "sensor_gain").replace("class Own", "class SensorGain"), "a name that no other"),
        (CLASS.replace("own_thing", ""), "an effect with a name"),
        (START + "@register\nclass Own(Effect):\n    name = 'half'\n    def __init__(self, x): pass\n", "TypeError"),
    ],
    ids=["syntax", "import", "exit", "nothing", "null", "taken", "nameless", "constructor"],
)
def test_files_that_cannot_be_loaded_are_one_line(tmp_path, text, said):
    path = tmp_path / "bad.py"
    path.write_text(text, encoding="utf-8")
    before = library()
    with pytest.raises(InputError) as error:
        load_effects(path)
    assert str(error.value).startswith(str(path))
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert library() == before


@pytest.mark.parametrize("path", ["missing.py", "."])
def test_a_file_that_is_none(tmp_path, path):
    with pytest.raises(InputError, match="expected a Python file"):
        load_effects(tmp_path / path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("own_thing", "own.thing", "name = 'own.thing': expected letters"),
        ('return ("payload",)', "return 1 / 0", "line 7: ZeroDivisionError"),
        ("def places", "def place", "places: expected the method"),
        ("-1.0, 1.0, 0.1", "1.0, -1.0, 0.1", "k = (1.0, -1.0): expected low below high"),
        ("-1.0, 1.0, 0.1", "-1.0, 1.0, 0.0", "k = 0.0: expected a positive size"),
        ("-1.0, 1.0, 0.1", "-1.0, 1.0, 0.1, False", "k: expected a grid of values"),
        ("values): pass", "values): ops.sense[:] = np.nan", "place payload = [0.1]: expected a finite response"),
        ("values): pass", "values): ops.sensor('Sq9')", "line 9: ValueError"),
        (', "something"\n', "\n", "ValueError"),
        ("    def places", "    nonlinear = True\n    def places", "change: expected no such method in an effect"),
    ],
    ids=["name", "places", "method", "range", "size", "grid", "finite", "channel", "words", "both"],
)
def test_effects_that_do_not_work_are_said_before_the_search(tmp_path, old, new, said):
    path = tmp_path / "bad.py"
    text = CLASS.replace(old, new)
    assert text != CLASS
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        try_out(load_effects(path), BARE)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_the_option_refuses_before_anything_is_read(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text("x = 1\n", encoding="utf-8")
    for path in (bad, tmp_path / "missing.py"):
        done = avis("gap", "no_campaign.h5", "--rig", "avis", "--out", tmp_path / "out", "--effects", path, env=WIDE)
        assert done.returncode == 2
        assert done.stderr.startswith(f"avis: {path}: expected ")
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_option_finds_the_example(example, tmp_path):
    write_campaign(tmp_path / "c.h5", hidden())
    done = avis(
        "gap",
        tmp_path / "c.h5",
        "--rig",
        "avis",
        "--out",
        tmp_path / "out",
        "--effects",
        example,
        env=WIDE,
        new_interpreter=True,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "out" / "gap.json").read_text(encoding="utf-8"))
    assert [(one["name"], one["location"]) for one in found["effects"]] == [("sensor_lowpass", PLACE)]
    assert hashlib.sha256(example.read_bytes()).hexdigest() in (tmp_path / "out" / "gap.html").read_text("utf-8")
