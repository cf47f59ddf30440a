"""Rig files: the shipped numbers, and everything that a user can get wrong in one."""

import copy
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import avis_ctrl.rigs.rig_file as rig_file
from avis_ctrl.errors import InputError
from avis_ctrl.rigs import Halcyonics, IsolatorTable, load_rig

DATA = Path(rig_file.__file__).parent / "data"
SOURCES = {name: (DATA / f"{name}.toml").read_text(encoding="utf-8") for name in ("avis", "halcyonics")}


def written(tmp_path, name, *replacements):
    text = SOURCES[name]
    for old, new in replacements:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["avis", "halcyonics"])
def test_shipped_numbers_are_those_of_the_shared_files(name, shared):
    assert tomllib.loads(SOURCES[name]) == tomllib.loads((shared / "rigs" / f"{name}.toml").read_text())


def test_shipped_rigs():
    assert isinstance(load_rig("avis"), IsolatorTable) and load_rig("avis").geophones.sensitivity_Vs_per_m[0] == 31.25
    assert load_rig("avis").acquisition.adc_bits == 14 and load_rig("avis").ambient.sensor_noise_rms_V == 1e-3
    bare, loaded = load_rig("halcyonics"), load_rig("halcyonics_loaded")
    assert isinstance(bare, Halcyonics) and bare.load is None and loaded.load.mass == 10.0
    assert load_rig("halcyonics", loaded=True) == loaded and loaded.accelerometers.sample_rate_Hz == 1000.0
    assert loaded.drive_limit_V == 10.0 and loaded.loop_delay_s == 0.001 == load_rig("avis").loop_delay_s


def test_a_file_of_ones_own(tmp_path):
    path = written(tmp_path, "avis", ("mass_kg = 500.0", "mass_kg = 450\ninertia_offdiagonal_kgm2 = [1.0, 0.0, -2.0]"))
    rig = load_rig(path)
    assert rig.mass == 450.0 and rig.inertia_matrix()[1, 2] == -2.0


def test_the_chassis_end_of_an_isolator(tmp_path):
    """A longer mount: the same force per stretch, but a tilting chassis moves its foot by another arm."""
    path = written(
        tmp_path,
        "avis",
        ("[20.0e3, 21.0e3, 45.0e3]", "[20.0e3, 21.0e3, 45.0e3]\nchassis_point_m = [-0.475, -0.375, -0.275]"),
    )
    eom, usual = load_rig(path).equations_of_motion(), load_rig("avis").equations_of_motion()
    assert np.array_equal(eom.K, usual.K)
    # Tilted about y by one radian the foot moves by -0.1 m more along x; that stretch pulls with k_x = 20e3 N/m.
    assert np.isclose((eom.K_floor - usual.K_floor)[0, 4], -0.1 * 20e3)


WRONG = [
    ("avis", ("mass_kg", "mas_kg"), "payload.mas_kg", "did you mean mass_kg"),
    ("avis", ("mass_kg = 500.0", "mass_g = 500000.0"), "payload.mass_g", "unit in this key is wrong; expected mass_kg"),
    (
        "avis",
        ("stiffness_N_per_m", "stiffness_N_per_mm"),
        "isolator[1].stiffness_N_per_mm",
        "expected stiffness_N_per_m",
    ),
    ("avis", ("loop_delay_s", "loop_delay_ms"), "acquisition.loop_delay_ms", "expected loop_delay_s"),
    ("avis", ("mass_kg = 500.0", ""), "payload.mass_kg", "missing"),
    ("avis", ("[ambient]", "[ambience]"), "ambience", "did you mean ambient"),
    ("avis", ("[ambient]", "[tolerances]\nplace_m = 1\n[ambient]"), "tolerances.place_m", "1 mm is 0.001"),
    (
        "avis",
        ("20.0e3, 21.0e3, 45.0e3", "20.0e3, -21.0e3, 45.0e3"),
        "isolator[1].stiffness_N_per_m[2] = -21000.0",
        "greater than 0",
    ),
    ("avis", ("20.0e3, 21.0e3, 45.0e3", "20.0e3, 21.0e3"), "isolator[1].stiffness_N_per_m", "at least 3"),
    ("avis", ("90.0, 95.0, 160.0", "nan, 95.0, 160.0"), "isolator[1].damping_Ns_per_m[1] = nan", "finite"),
    ("avis", ("mass_kg = 500.0", "mass_kg = -500.0"), "payload.mass_kg = -500.0", "greater than 0"),
    ("avis", ("mass_kg = 500.0", 'mass_kg = "500 kg"'), "payload.mass_kg = '500 kg'", "expected a number"),
    ("avis", ("mass_kg = 500.0", "mass_kg = true"), "payload.mass_kg = True", "expected a number"),
    ("avis", ("28.5, 42.7, 61.0", "28.5, 42.7, 80.0"), "payload.inertia_kgm2", "none above the sum"),
    (
        "avis",
        ("mass_kg = 500.0", "mass_kg = 500.0\ninertia_offdiagonal_kgm2 = [60.0, 0.0, 0.0]"),
        "payload.inertia_kgm2",
        "principal moments positive",
    ),
    ("avis", ('"Ay3", "Az3", "Ax4", "Az4"]', '"Ay3", "Az3", "Ax4", "Ay1"]'), "actuators.names", "different names"),
    (
        "avis",
        ("isolator = [1, 1, 2, 2, 3, 3, 4, 4]", "isolator = [1, 1, 2, 2, 3, 3, 4, 5]"),
        "actuators.isolator = 5",
        "isolators from 1 to 4",
    ),
    (
        "avis",
        ('axis = ["y", "z", "x", "z", "y", "z", "x", "z"]', 'axis = ["y", "z", "x", "z", "y", "z", "x", "up"]'),
        "actuators.axis[8] = 'up'",
        "'x', 'y' or 'z'",
    ),
    *(
        (
            "avis",
            ("adc_bits = 14", f"adc_bits = {wrong}"),
            f"acquisition.adc_bits = {shown}",
            "expected a whole number of bits from 1 to 32",
        )
        for wrong, shown in (("14.5", "14.5"), ("0", "0"), ("33", "33"), ("true", "True"), ('"14"', "'14'"))
    ),
    ("avis", ("sample_rate_Hz = 1000.0", "sample_rate_Hz = 0.0"), "acquisition.sample_rate_Hz = 0.0", "greater than 0"),
    (
        "avis",
        ('names = ["Sy1", "Sz1", "Sx2", "Sz2", "Sy3", "Sz3"]', 'names = ["Sy1", "Sz1", "Sx2", "Sz2", "Sy3"]'),
        "geophones.isolator",
        "expected as many entries as geophones.names has, which is 5",
    ),
    ("halcyonics", ("k_s_N_per_m", "k_s_N_per_mm"), "suspension.k_s_N_per_mm", "expected k_s_N_per_m"),
    ("halcyonics", ("k_s_N_per_m = 11300.0", "k_s_N_per_m = -11300.0"), "suspension.k_s_N_per_m", "greater than 0"),
    ("halcyonics", ("6.59, 7.85", "7.85"), "actuators.constant_N_per_V", "at least 8"),
    ("halcyonics", ('at = ["A1"', 'at = ["A9"'), "accelerometers.at = 'A9'", "out of"),
    ("halcyonics", ("Ixx_total_kgm2 = 0.455", "Ixx_total_kgm2 = 0.300"), "load.Ixx_total_kgm2", "a body can have"),
    (
        "halcyonics",
        ("d1_Ns_per_m = 275.0", "d7_Ns_per_m = 275.0"),
        "suspension.d7_Ns_per_m",
        "did you mean d1_Ns_per_m",
    ),
]


@pytest.mark.parametrize(("name", "change", "field", "expected"), WRONG, ids=[case[2] for case in WRONG])
def test_wrong_entries_are_answered_in_one_line(tmp_path, name, change, field, expected):
    path = written(tmp_path, name, change)
    with pytest.raises(InputError) as caught:
        load_rig(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and field in message and expected in message and "\n" not in message


def test_a_table_that_nothing_holds_is_refused(tmp_path):
    corners = [
        ("-0.475, -0.375, -0.175", "0, 0, 0"),
        ("0.475, -0.375, -0.175", "0, 0, 0"),
        ("0.475, 0.375, -0.175", "0, 0, 0"),
        ("-0.475, 0.375, -0.175", "0, 0, 0"),
    ]
    with pytest.raises(InputError, match="no spring resists motion mainly along phi_"):
        load_rig(written(tmp_path, "avis", *corners))


def test_files_that_are_no_rigs(tmp_path):
    cases = {
        "absent.toml": (None, "one of"),
        "broken.toml": ("mass = = 3", "TOML"),
        "comma.toml": ("a = 1\nmass = 3,5", "'mass = 3,5'; write a decimal point"),
        "lines.toml": ("# a\u2028b\x85c\nmass = 3,5\ny = 2", "'mass = 3,5'; write a decimal point"),
        "single.toml": ("[isolator]\n[[isolator]]", "is written in double brackets"),
        "empty.toml": ("", "sections"),
        "other.toml": ("[motor]\nx = 1", "sections"),
        "deep.toml": ("x = " + "[" * 5000, "TOML"),
    }
    for name, (text, expected) in cases.items():
        if text is not None:
            (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=expected):
            load_rig(tmp_path / name)
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"')
    with pytest.raises(InputError, match="UTF-8"):
        load_rig(tmp_path / "latin.toml")
    with pytest.raises(InputError, match="rig file or one of"):
        load_rig(tmp_path)


def test_a_load_that_is_not_there(tmp_path):
    text = SOURCES["halcyonics"]
    path = tmp_path / "bare.toml"
    path.write_text(text[: text.index("# The load of Table 2")])
    assert load_rig(path).load is None
    with pytest.raises(InputError, match=r"no \[load\] section"):
        load_rig(path, loaded=True)
    with pytest.raises(InputError, match=r"no \[load\] section"):
        load_rig("avis", loaded=True)


def places(content, path=()):
    """Every entry of a file: path of keys and indices."""
    entries = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in entries:
        yield (*path, key)
        if isinstance(value, (dict, list)):
            yield from places(value, (*path, key))


CONTENT = {name: tomllib.loads(text) for name, text in SOURCES.items()}
PLACES = [(name, place) for name, content in CONTENT.items() for place in places(content)]
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


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(PLACES), hostile, st.booleans(), st.text(max_size=4))
@example(("avis", ("payload", "centre_of_mass_m", 0)), 1621907, False, "")  # m r^2 had left no digits for J
def test_any_entry_replaced_by_anything_gives_a_sound_rig_or_one_line(where, value, rename, key):
    name, place = where
    content = copy.deepcopy(CONTENT[name])
    parent = content
    for part in place[:-1]:
        parent = parent[part]
    if rename and isinstance(parent, dict):
        parent[key] = parent.pop(place[-1])
    else:
        parent[place[-1]] = value
    try:
        rig = rig_file.rig_from(content, loaded=name == "halcyonics" and "load" in content)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 600
        return
    eom = rig.equations_of_motion()
    assert np.linalg.eigvalsh(eom.M)[0] > 0 and math.isfinite(eom.natural_frequencies().frequencies_Hz[-1])
