"""Design files: whatever is wrong is one line that names file, field, value and what was expected."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.cli import main
from avis_ctrl.errors import InputError
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.study.design_file import Design, design_from_table, read_design, read_study

DESIGNS = Path(__file__).resolve().parents[2] / "designs"
TABLE = tomllib.loads((DESIGNS / "avis_z_phix.toml").read_text(encoding="utf-8"))
ABSENT = object()


def changed(place: str, value: object) -> dict:
    """The shipped AVIS design with one entry set, or removed (ABSENT)."""
    table = copy.deepcopy(TABLE)
    *parents, last = place.split("/")
    inner = table
    for key in parents:
        inner = inner.setdefault(key, {})
    if value is ABSENT:
        del inner[last]
    else:
        inner[last] = value
    return table


def complaint(table: dict) -> str:
    with pytest.raises(InputError) as refused:
        design_from_table(table, "d.toml")
    text = str(refused.value)
    assert "\n" not in text
    assert text.startswith("d.toml: ")
    assert len(text) < 400
    return text


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("titel", "x", ["titel", "did you mean title?"]),
        ("simulation/durations_s", 60.0, ["simulation.durations_s", "did you mean duration_s?"]),
        ("transmisibility", {}, ["transmisibility", "did you mean transmissibility?"]),
        ("synthesis/max_iteration", 3, ["synthesis.max_iteration", "did you mean max_iterations?"]),
        ("uncertainty/actuator_chain", {}, ["uncertainty.actuator_chain", "did you mean actuator_chains?"]),
        ("simulation/qqqq", 1, ["simulation.qqqq", "expected one of duration_s, random_plants, seed"]),
    ],
)
def test_unknown_and_misspelt_keys_are_answered_with_the_nearest(place, value, words):
    text = complaint(changed(place, value))
    for word in words:
        assert word in text


@pytest.mark.parametrize(
    ("place", "value", "expected"),
    [
        ("transmissibility/band_kHz", [0.001, 0.01], "band_Hz"),
        ("simulation/duration_ms", 4e4, "duration_s"),
        ("control_effort/floor_velocity_mm_per_s", 0.01, "floor_velocity_m_per_s"),
        ("loop/amplifier_corner_kHz", 0.3, "amplifier_corner_Hz"),
    ],
)
def test_a_wrong_unit_in_a_key_is_named(place, value, expected):
    text = complaint(changed(place, value))
    assert "unit" in text
    assert f"expected {expected}" in text


@pytest.mark.parametrize(
    ("place", "value", "field"),
    [
        ("control_effort/bandwidth_Hz", -1.0, "control_effort.bandwidth_Hz = -1.0"),
        ("control_effort/bandwidth_Hz", 0.0, "control_effort.bandwidth_Hz = 0.0"),
        ("control_effort/bandwidth_Hz", float("nan"), "control_effort.bandwidth_Hz = nan"),
        ("transmissibility/peak_dB", float("inf"), "transmissibility.peak_dB = inf"),
        ("transmissibility/peak_dB", 1e308, "transmissibility.peak_dB = 1e+308"),
        ("control_effort/bandwidth_Hz", 1e300, "control_effort.bandwidth_Hz = 1e+300"),
        ("transmissibility/band_Hz", [1.0, float("nan")], "transmissibility.band_Hz[2] = nan"),
        ("uncertainty/parameters_percent/mass", -10.0, "uncertainty.parameters_percent.mass = -10.0"),
        ("uncertainty/parameters_percent/mass", 100.0, "uncertainty.parameters_percent.mass = 100.0"),
        ("uncertainty/parameters_percent/mass", 250.0, "uncertainty.parameters_percent.mass = 250.0"),
        ("uncertainty/actuator_chains/low_percent", 150.0, "uncertainty.actuator_chains.low_percent = 150.0"),
        ("uncertainty/actuator_chains/crossover_Hz", 0.08, "uncertainty.actuator_chains.crossover_Hz = 0.08"),
        ("uncertainty/actuator_chains/high_percent", 50.0, "uncertainty.actuator_chains.high_percent = 50.0"),
        ("uncertainty/parameters_absolute", {"com_y": -0.1}, "uncertainty.parameters_absolute.com_y = -0.1"),
        ("simulation/duration_s", 1e9, "simulation.duration_s = 1000000000.0"),
        ("simulation/random_plants", -1, "simulation.random_plants = -1"),
        ("simulation/random_plants", 2.5, "simulation.random_plants = 2.5"),
        ("simulation/seed", -1, "simulation.seed = -1"),
        ("synthesis/max_iterations", 0, "synthesis.max_iterations = 0"),
        ("floor/velocity_rms_m_per_s", 0.0, "floor.velocity_rms_m_per_s = 0.0"),
        ("compliance", {"limit_m_per_N": -1e-6}, "compliance.limit_m_per_N = -1e-06"),
        ("requirement", [{"quantity": "mu_upper", "at_most": float("nan")}], "requirement[1].at_most = nan"),
    ],
)
def test_numbers_outside_their_range_are_named(place, value, field):
    text = complaint(changed(place, value))
    assert field in text
    assert "expected" in text


@pytest.mark.parametrize(
    ("place", "value", "field"),
    [
        ("transmissibility/band_Hz", [10.0, 1.0], "transmissibility.band_Hz = [10.0, 1.0]"),
        ("transmissibility/band_Hz", [5.0, 5.0], "transmissibility.band_Hz = [5.0, 5.0]"),
        ("transmissibility/band_Hz", [1.0], "transmissibility.band_Hz = [1.0]"),
        ("transmissibility/band_Hz", [1.0, 2.0, 3.0], "transmissibility.band_Hz = [1.0, 2.0, 3.0]"),
        ("floor/band_Hz", [60.0, 0.5], "floor.band_Hz = [60.0, 0.5]"),
        ("skyhook/roll_off_Hz", [400.0, 30.0], "skyhook.roll_off_Hz = [400.0, 30.0]"),
        ("skyhook/tilt_corner_Hz", [0.5, 100.0], "skyhook.roll_off_Hz = [5.0, 400.0]"),
        ("transmissibility/band_dB", 5.0, "transmissibility.band_dB = 5.0"),
    ],
)
def test_bands_rise(place, value, field):
    text = complaint(changed(place, value))
    assert field in text
    assert "expected" in text


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("keep", ["z", "phi"], ["keep[2] = 'phi'", "'phi_x'"]),
        ("keep", [], ["keep = []"]),
        ("keep", ["z", "z"], ["keep", "once"]),
        ("keep", "z", ["keep = 'z'", "list"]),
        ("floor/spectrum", "kamioka", ["floor.spectrum = 'kamioka'", "kamioka_quiet"]),
        ("requirement", [{"quantity": "mu_uper", "at_most": 1.0}], ["requirement[1].quantity = 'mu_uper'", "mu_upper"]),
        ("requirement", [{"quantity": "mu_upper"}], ["requirement[1]", "exactly one of at_most and at_least"]),
        ("requirement", [{"quantity": "mu_upper", "at_most": 1.0, "at_least": 0.5}], ["requirement[1]", "exactly one"]),
        ("requirement", {"quantity": "mu_upper", "at_most": 1.0}, ["requirement", "list"]),
        ("control_effort/bandwidth_Hz", "100", ["control_effort.bandwidth_Hz = '100'", "number"]),
        ("control_effort/bandwidth_Hz", True, ["control_effort.bandwidth_Hz = True", "number"]),
        ("title", 3, ["title = 3", "text in quotes"]),
        ("transmissibility", "low", ["transmissibility = 'low'", "section"]),
        ("uncertainty/parameters_percent", [10.0], ["uncertainty.parameters_percent", "section"]),
        ("title", ABSENT, ["title", "missing"]),
        ("transmissibility", ABSENT, ["transmissibility", "section is missing"]),
        ("control_effort/bandwidth_Hz", ABSENT, ["control_effort.bandwidth_Hz", "key is missing"]),
    ],
)
def test_wrong_words_types_and_missing_keys(place, value, words):
    text = complaint(changed(place, value))
    for word in words:
        assert word in text


def written(folder: Path, table: dict) -> Path:
    """A design file with the entries that differ from the shipped one, by replacing lines of its text."""
    path = folder / "d.toml"
    path.write_text(as_toml(table), encoding="utf-8")
    return path


def as_toml(table: dict) -> str:
    lines = [f"{key} = {value_text(value)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def value_text(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {value_text(one)}' for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("rig", "aviss", ["rig = 'aviss'", "avis, halcyonics, halcyonics_loaded"]),
        ("rig", "absent.toml", ["rig = 'absent.toml'", "rig file"]),
        ("rig", "", ["rig = ''"]),
        ("uncertainty/parameters_percent", {"isolater2.k_z": 15.0}, ["isolater2.k_z", "did you mean isolator2.k_z?"]),
        ("uncertainty/parameters_percent", {"stiffness?": 15.0}, ["stiffness?", "it has mass, J1"]),
        (
            "uncertainty/parameters_percent",
            {"isolator*.k_z": 15.0, "isolator1.*": 5.0},
            ["isolator1.k_z is listed twice"],
        ),
        ("uncertainty/parameters_percent", {"com_x": 10.0}, ["com_x", "zero", "absolute"]),
    ],
)
def test_rig_and_parameters_are_checked_with_the_file(place, value, words, tmp_path):
    path = written(tmp_path, changed(place, value))
    read_design(path)  # nothing wrong with the file by itself
    with pytest.raises(InputError) as refused:
        read_study(path)
    for word in (str(path), *words):
        assert word in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_rig_file_beside_the_design(tmp_path):
    shipped = Path(load_rig.__code__.co_filename).parent / "data" / "avis.toml"
    (tmp_path / "mine.toml").write_text(
        shipped.read_text(encoding="utf-8").replace('name = "avis"', 'name = "mine"'), encoding="utf-8"
    )
    design, rig = read_study(written(tmp_path, changed("rig", "mine.toml")))
    assert (design.rig, rig.name) == ("mine.toml", "mine")


def test_negative_stiffness_in_a_rig_file_beside_the_design(tmp_path):
    shipped = Path(load_rig.__code__.co_filename).parent / "data" / "avis.toml"
    text = shipped.read_text(encoding="utf-8")
    start = text.index("stiffness_N_per_m = [") + len("stiffness_N_per_m = [")
    (tmp_path / "mine.toml").write_text(text[:start] + "-" + text[start:], encoding="utf-8")
    with pytest.raises(InputError, match=r"mine\.toml: isolator\[1\]\.stiffness_N_per_m\[1\] = -.*greater than 0"):
        read_study(written(tmp_path, changed("rig", "mine.toml")))


def test_a_rig_file_is_no_design_file_and_the_reverse():
    with pytest.raises(InputError, match=r"avis\.toml: this is a rig file"):
        read_design(DESIGNS.parent / "avis_ctrl/rigs/data/avis.toml")
    with pytest.raises(InputError, match=r"avis_z_phix\.toml: this is a design file"):
        load_rig(DESIGNS / "avis_z_phix.toml")


@pytest.mark.parametrize("kind", ["missing", "folder", "empty", "binary", "not TOML", "deep nesting", "null byte"])
def test_files_that_are_no_design_end_in_one_line_and_code_2(kind, tmp_path, monkeypatch, capsys):
    path, out = tmp_path / "d.toml", tmp_path / "out"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_bytes(
            {
                "empty": b"",
                "binary": bytes(range(256)),
                "not TOML": b"title = \n[[[",
                "deep nesting": b"a = " + b"[" * 50_000,
                "null byte": b"a = \x00",
            }[kind]
        )
    assert command(monkeypatch, "design", str(path), "--out", str(out)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert str(path) in said.err
    assert not out.exists()


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("rig", "aviss"),
        ("uncertainty/parameters_percent", {"mas": 10.0}),
        ("control_effort/bandwidth_Hz", -1.0),
        ("titel", "x"),
    ],
)
def test_wrong_designs_write_nothing(place, value, tmp_path, monkeypatch, capsys):
    path, out = written(tmp_path, changed(place, value)), tmp_path / "out"
    assert command(monkeypatch, "design", str(path), "--out", str(out)) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert said.err.startswith(f"avis: {path}: ")
    assert not out.exists()


def command(monkeypatch, *arguments: str) -> int:
    """The exit code of `avis ARGUMENTS`."""
    monkeypatch.setattr("sys.argv", ["avis", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return int(stopped.value.code)


def test_a_byte_order_mark_is_no_error(tmp_path):
    path = tmp_path / "d.toml"
    path.write_bytes(b"\xef\xbb\xbf" + (DESIGNS / "avis_z_phix.toml").read_bytes())
    assert read_design(path) == read_design(DESIGNS / "avis_z_phix.toml")


@pytest.mark.parametrize("name", sorted(path.name for path in DESIGNS.glob("*.toml")))
def test_shipped_designs_read(name):
    design, rig = read_study(DESIGNS / name)
    assert set(design.keep) == (set(COORDINATES) if "six_axes" in name else {"z", "phi_x"})
    assert design.uncertainty.of(rig)


def test_shipped_avis_design_asks_what_the_task_asks():
    """Mass +-10 %, vertical stiffness +-15 %, damping +-30 %, chains 10 % rising through 100 % at 80 Hz."""
    design, rig = read_study(DESIGNS / "avis_z_phix.toml")
    spread = {p.name: p.spread for p in design.uncertainty.of(rig)}
    assert spread == {
        "mass": pytest.approx(0.10),
        **{f"isolator{k}.k_z": pytest.approx(0.15) for k in (1, 2, 3, 4)},
        **{f"isolator{k}.c_z": pytest.approx(0.30) for k in (1, 2, 3, 4)},
    }
    chains = design.uncertainty.actuator_chains
    assert (chains.low_percent, chains.crossover_Hz) == (10.0, 80.0)
    limits = {r.quantity: (r.at_most, r.at_least) for r in design.requirement}
    assert limits["mu_upper"] == (1.0, None)
    assert limits["mu_gap_percent"] == (5.0, None)
    assert limits["worst_case_peak_transmissibility_dB"] == (4.0, None)
    assert limits["worst_case_band_transmissibility_dB"] == (-6.0, None)
    assert limits["passive_peak_transmissibility_dB"] == (None, 20.0)
    assert limits["advantage_over_skyhook_dB"] == (None, 6.0)
    assert design.transmissibility.band_Hz == [1.0, 10.0]


leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-10, 1000),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(0.1, 100), max_size=3),
)
keys = st.one_of(
    st.sampled_from([*TABLE, *Design.model_fields, "band_Hz", "peak_dB", "mass", "quantity", "band_kHz"]),
    st.text(max_size=8),
)
tables = st.recursive(
    leaves,
    lambda inner: st.one_of(st.dictionaries(keys, inner, max_size=4), st.lists(inner, max_size=3)),
    max_leaves=10,
)
places = st.sampled_from(
    [
        place
        for section, content in TABLE.items()
        for place in [section, *([f"{section}/{key}" for key in content] if isinstance(content, dict) else [])]
    ]
)


@settings(max_examples=150, deadline=None)
@given(place=places, value=tables)
def test_any_change_of_one_entry_is_read_or_refused_in_one_line(place, value):
    read_or_refused(changed(place, value))


@settings(max_examples=100, deadline=None)
@given(table=st.dictionaries(keys, tables, max_size=6))
def test_any_table_is_read_or_refused_in_one_line(table):
    read_or_refused(table)


def read_or_refused(table: dict) -> None:
    try:
        assert isinstance(design_from_table(table, "d.toml"), Design)
    except InputError as refused:
        assert str(refused).startswith("d.toml")
        assert len(str(refused).splitlines()) == 1


@settings(max_examples=60, deadline=None)
@given(content=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(content, tmp_path_factory):
    path = tmp_path_factory.mktemp("fuzz") / "d.toml"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_study(path)
