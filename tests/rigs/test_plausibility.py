"""Slips of units in rig files are answered in one line that names the field; tables that exist pass."""

from __future__ import annotations

import copy
import re
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import rig_file
from avis_ctrl.rigs.plausibility import UnusualRig, judge_modes, judged, plausible
from avis_ctrl.rigs.rig_file import load_rig, rig_from
from avis_ctrl.rigs.rigid_body import EquationsOfMotion
from avis_ctrl.study.new_files import NewRig, rig_text

DATA = Path(rig_file.__file__).parent / "data"
CONTENT = {name: tomllib.loads((DATA / f"{name}.toml").read_text(encoding="utf-8")) for name in ("avis", "halcyonics")}


def slipped(content: dict, place: str, factor: float) -> dict:
    """A copy with the numbers at a place such as "isolator.*.position_m" times a factor."""
    made = copy.deepcopy(content)

    def times(value):
        return [times(one) for one in value] if isinstance(value, list) else value * factor

    def go(part, path):
        if path[0] == "*":
            for one in part:
                go(one, path[1:])
        elif len(path) == 1:
            key = path[0] if isinstance(part, dict) else int(path[0])
            part[key] = times(part[key])
        else:
            go(part[path[0]] if isinstance(part, dict) else part[int(path[0])], path[1:])

    go(made, place.split("."))
    return made


def slow_case(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    "rig, place, factor, field, meant",
    [
        ("avis", "payload.mass_kg", 1e3, "payload.mass_kg", "500"),
        (
            "avis",
            "isolator.*.stiffness_N_per_m",
            1e-3,
            "isolator.stiffness_N_per_m",
            "[20000, 21000, 45000] (given in N/mm)",
        ),
        ("avis", "isolator.2.stiffness_N_per_m.2", 1e-3, "isolator[3].stiffness_N_per_m[3]", "42000 (given in N/mm)"),
        ("avis", "isolator.*.damping_Ns_per_m", 1e-3, "isolator.damping_Ns_per_m", "[90, 95, 160] (given in N s/mm)"),
        slow_case("avis", "payload.inertia_kgm2", 1e4, "payload.inertia_kgm2", "[28.5, 42.7, 61] (given in kg cm^2)"),
        ("avis", "isolator.*.position_m", 1e3, "isolator.position_m", "[-0.475, -0.375, -0.175] (given in mm)"),
        slow_case(
            "avis", "isolator.*.position_m", 1e2, "isolator.position_m", "[-0.475, -0.375, -0.175] (given in cm)"
        ),
        ("avis", "actuators.constant_N_per_V", 1e-3, "actuators.constant_N_per_V", "2 (given in kN/V)"),
        (
            "avis",
            "geophones.sensitivity_Vs_per_m",
            1e-3,
            "geophones.sensitivity_Vs_per_m",
            "31.25 (given in V per mm/s)",
        ),
        ("avis", "acquisition.loop_delay_s", 1e3, "acquisition.loop_delay_s", "0.001 (given in ms)"),
        slow_case("avis", "acquisition.sample_rate_Hz", 1e-3, "acquisition.sample_rate_Hz", "1000 (given in kHz)"),
        ("avis", "ambient.sensor_noise_rms_V", 1e3, "ambient.sensor_noise_rms_V", "0.001 (given in mV)"),
        slow_case(
            "avis",
            "ambient.floor_velocity_rms_m_per_s",
            1e6,
            "ambient.floor_velocity_rms_m_per_s",
            "2e-06 (given in um/s)",
        ),
        slow_case("halcyonics", "payload.mass_kg", 1e-3, "payload.mass_kg", "19.3 (given in t)"),
        ("halcyonics", "suspension.k_s_N_per_m", 1e-3, "suspension.k_s_N_per_m", "11300 (given in N/mm)"),
        ("halcyonics", "suspension.d3_Ns_per_m", 1e-3, "suspension.d3_Ns_per_m", "275 (given in N s/mm)"),
        slow_case(
            "halcyonics", "payload.inertia_kgm2", 1e9, "payload.inertia_kgm2", "[0.34, 0.259, 0.5] (given in g mm^2)"
        ),
        ("halcyonics", "accelerometers.drive_limit_V", 1e3, "accelerometers.drive_limit_V", "10 (given in mV)"),
        # A hundred thousand: rather much for um/s^2 and for ug.
        (
            "halcyonics",
            "accelerometers.noise_m_per_s2_rtHz",
            1e10,
            "accelerometers.noise_m_per_s2_rtHz",
            "0.00098067 (given in ng)",
        ),
    ],
)
def test_a_slip_is_named_in_one_line(rig, place, factor, field, meant):
    with pytest.raises(InputError) as refused:
        plausible(slipped(CONTENT[rig], place, factor), rig_from)
    said = str(refused.value)
    assert said.startswith(f"{field} = ") and f"did you mean {meant}" in said and "\n" not in said
    assert refused.value.exit_code == 2


def own_table() -> dict:
    """Three mounts, drives and geophones each at its place; the third geophone elsewhere."""
    content = tomllib.loads(rig_text(NewRig(mounts=3)))
    content["payload"]["centre_of_mass_m"] = [0.01, 0.0, 0.03]
    content["geophone"][2]["position_m"] = [0.40, -0.11, -0.05]
    return content


@pytest.mark.parametrize(
    "places, factor, field, meant",
    [
        (["geophone.2.position_m"], 1e2, "geophone[3].position_m = [40.0, ", "[0.4, -0.11, -0.05] (given in cm)"),
        (
            ["isolator.*.position_m", "drive.*.position_m", "geophone.*.position_m"],
            1e2,
            "isolator.position_m, drive.position_m, geophone.position_m = [-48.0, ",
            "[-0.48, -0.18, -0.2] (given in cm)",
        ),
        slow_case(["drive.*.position_m"], 1e2, "drive.position_m = [-48.0, ", "[-0.48, -0.18, -0.2] (given in cm)"),
        slow_case(
            ["isolator.0.position_m", *(f"{kind}.{k}.position_m" for kind in ("drive", "geophone") for k in (0, 1))],
            1e3,
            "isolator[1].position_m, drive[1].position_m, drive[2].position_m, ... = [-480.0, ",
            "[-0.48, -0.18, -0.2] (given in mm)",
        ),
    ],
)
def test_wrong_positions_are_named(places, factor, field, meant):
    """One, all in the file (not the centre of mass), all of a kind, copies of one."""
    content = own_table()
    for place in places:
        content = slipped(content, place, factor)
    with pytest.raises(InputError) as refused:
        plausible(content, rig_from)
    assert str(refused.value).startswith(field) and f"did you mean {meant}" in str(refused.value)


def isolators(places, stiffness, damping) -> list[dict]:
    return [
        {"position_m": list(map(float, p)), "stiffness_N_per_m": stiffness, "damping_Ns_per_m": damping} for p in places
    ]


def table(mass, inertia, mounts, drives, sensors=4, height=0.0, **also) -> dict:
    """A rig file of the first kind: drives (isolator, axis, N/V, V), geophones on the first mounts."""
    where, axes, constant, limit = drives
    return {
        "name": "own",
        "payload": {"mass_kg": mass, "inertia_kgm2": inertia, "centre_of_mass_m": [0.0, 0.0, height]},
        "isolator": mounts,
        "actuators": {
            "names": [f"A{k}" for k in range(len(where))],
            "isolator": where,
            "axis": axes,
            "constant_N_per_V": [constant] * len(where),
            "limit_V": limit,
        },
        "geophones": {
            "names": [f"S{k}" for k in range(sensors)],
            "isolator": [k % len(mounts) + 1 for k in range(sensors)],
            "axis": ["z"] * sensors,
            "sensitivity_Vs_per_m": [also.get("sensitivity", 100.0)] * sensors,
            "suspension_Hz": also.get("corner", 1.0),
            "suspension_damping": 0.7,
            "compensated_Hz": 0.2,
            "compensated_damping": 0.7,
            "preamplifier_gain": also.get("gain", 50.0),
        },
        "acquisition": {
            "sample_rate_Hz": also.get("rate", 2000.0),
            "adc_bits": 16,
            "adc_range_V": 10.0,
            "loop_delay_s": 5e-4,
        },
    }


def ring(n: int, radius: float, z: float = -0.1) -> list[tuple[float, float, float]]:
    turn = 2 * np.pi * np.arange(n) / n
    return [(radius * np.cos(a), radius * np.sin(a), z) for a in turn]


GRID = [(x, y, -0.4) for x in (-1.2, -0.4, 0.4, 1.2) for y in (-0.7, 0.0, 0.7)]
TABLES = {
    "three legs, 200 kg": table(
        200.0,
        [9.0, 9.0, 15.0],
        isolators(ring(3, 0.45), [9e3, 9e3, 2e4], [60.0, 60.0, 90.0]),
        ([1, 2, 3, 1, 2, 3], ["x", "y", "x", "z", "z", "z"], 5.0, 10.0),
    ),
    "four vertical drives, 80 kg": table(
        80.0, [4.0, 5.0, 8.0], isolators(ring(4, 0.4), [6e3, 6e3, 1e4], [30.0] * 3), ([1, 2, 3, 4], ["z"] * 4, 3.0, 5.0)
    ),
    "hexapod, 30 kg": table(
        30.0,
        [0.6, 0.6, 1.0],
        isolators(ring(6, 0.2), [2e5, 2e5, 4e5], [150.0] * 3),
        ([1, 2, 3, 4, 5, 6], ["x", "y", "z", "x", "y", "z"], 1.0, 10.0),
    ),
    "granite, 3 t": table(
        3000.0,
        [700.0, 1900.0, 2300.0],
        isolators(GRID, [6e4, 6e4, 1e5], [900.0, 900.0, 1.5e3]),
        ([1, 3, 10, 12, 1, 12], ["z", "z", "z", "z", "x", "y"], 20.0, 10.0),
        height=0.2,
    ),
    "granite, 50 t": table(
        5e4,
        [7e4, 1.6e5, 2e5],
        isolators([(3 * x, 3 * y, z) for x, y, z in GRID], [3e5, 3e5, 6e5], [9e3] * 3),
        ([1, 3, 10, 12, 1, 12], ["z", "z", "z", "z", "x", "y"], 50.0, 10.0),
        height=0.3,
    ),
    "breadboard, 2 kg": table(
        2.0,
        [0.02, 0.02, 0.04],
        isolators(ring(4, 0.18, -0.03), [400.0, 400.0, 900.0], [2.0] * 3),
        ([1, 2, 3, 4], ["z"] * 4, 0.5, 5.0),
    ),
    "piezo, 100 Hz": table(
        60.0,
        [2.0, 3.0, 4.5],
        isolators(ring(3, 0.3), [7.9e6] * 3, [1.5e3] * 3),
        ([1, 2, 3], ["z"] * 3, 3.0, 150.0),
        rate=10e3,
    ),
    "negative stiffness, 0.5 Hz": table(
        100.0, [5.0, 5.0, 9.0], isolators(ring(4, 0.35), [250.0] * 3, [15.0] * 3), ([1, 2, 3, 4], ["z"] * 4, 1.0, 5.0)
    ),
}


@pytest.mark.parametrize("content", [*TABLES.values(), *CONTENT.values()], ids=[*TABLES, *CONTENT])
def test_tables_that_exist_pass_without_a_word(content):
    assert plausible(content, rig_from) == ""


def test_the_loaded_table_passes():
    assert plausible(CONTENT["halcyonics"], lambda content: rig_from(content, True)) == ""


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(["avis", "halcyonics", "halcyonics_loaded"]), st.data())
def test_a_parameter_off_by_thirty_per_cent_passes(name, data):
    """Any one parameter, where that leaves a body (an inertia of a plate is on the edge)."""
    rig = load_rig(name)
    parameter = data.draw(st.sampled_from(sorted(rig.parameters())))
    value = rig.parameters()[parameter].value
    try:
        moved = rig.with_parameters({parameter: value * data.draw(st.sampled_from([0.7, 1.3]))})
    except InputError:
        return
    content = CONTENT[name.partition("_")[0]]
    assert not [one.words for one in judged(content, moved) if one.unusual > 0]


def test_what_is_unusual_is_told_and_goes_on(tmp_path):
    path = tmp_path / "rig.toml"
    text = (DATA / "halcyonics.toml").read_text(encoding="utf-8")
    path.write_text(text.replace("k_r_Nm_per_rad = 1590.0", "k_r_Nm_per_rad = 1.59e6"), encoding="utf-8")
    with pytest.warns(UnusualRig, match=r"284 Hz.*k_r_Nm_per_rad: did you mean 1590 \(given in N mm/rad\)"):
        assert load_rig(path).k_r == 1.59e6
    path.write_text(text.replace("sensitivity_Vs2_per_m = 1.0", "sensitivity_Vs2_per_m = 1000.0"), encoding="utf-8")
    with pytest.warns(UnusualRig, match=r"1000 V s\^2/m.*sensitivity_Vs2_per_m: did you mean 0.10197 \(given in mV/g"):
        load_rig(path)


def test_a_file_is_named_and_what_an_identification_wrote_is_not_held_against_it(tmp_path):
    path = tmp_path / "rig.toml"
    text = (DATA / "avis.toml").read_text(encoding="utf-8")
    path.write_text(re.sub(r"mass_kg = \S+", "mass_kg = 120e3", text), encoding="utf-8")
    with pytest.raises(InputError, match=r"rig\.toml: payload\.mass_kg = 120000\.0: .*did you mean 120 \(given in g\)"):
        load_rig(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_rig(path, check=False).mass == 120e3


@pytest.mark.parametrize(
    "pattern, changed, said",
    [
        (r"mass_kg = \S+", "mass_kg = 120e3", "payload.mass_kg = 120000.0: "),
        pytest.param(
            r"sensitivity_Vs_per_m = .*",
            "sensitivity_Vs_per_m = [0.03, 0.03, 0.03, 0.03, 0.03, 0.03]",
            "geophones.sensitivity_Vs_per_m = 0.03: ",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_every_command_that_reads_a_rig_answers_in_one_line(tmp_path, pattern, changed, said):
    path, plan = tmp_path / "rig.toml", tmp_path / "plan.toml"
    path.write_text(re.sub(pattern, changed, (DATA / "avis.toml").read_text(encoding="utf-8")), encoding="utf-8")
    plan.write_text('title = "p"\nduration_s = 8.0\n[[record]]\nexcitation = "noise"\n', encoding="utf-8")
    command = ["simulate-campaign", "--rig", str(path), "--plan", str(plan), "--out", str(tmp_path / "c.h5")]
    done = subprocess.run(
        [sys.executable, "-c", "from avis_ctrl.cli import main; main()", *command],
        text=True,
        capture_output=True,
        check=False,
    )
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 2 and len(lines) == 1 and not (tmp_path / "c.h5").exists(), done.stderr
    assert lines[0].startswith(f"avis: {path}: {said}") and "did you mean" in lines[0]


def test_words_quote_the_rigs_own_numbers():
    """Natural frequencies from the eigenvalues of M and K, and their ratio."""
    rig = load_rig("avis")
    equations = rig.equations_of_motion()
    f = np.sqrt(np.sort(eigh(equations.K, equations.M, eigvals_only=True))) / (2 * np.pi)
    words = next(one.words for one in judged(CONTENT["avis"], rig) if one.kind == "spread")
    assert words == f"natural frequencies {f[0]:.3g} to {f[-1]:.3g} Hz, ratio {f[-1] / f[0]:.3g}"


def test_an_undamped_mode_does_not_hide_the_smallest_damping_of_the_others():
    """Unit mass, modes at 1 to 6 Hz; the first has no damping, the second a damping ratio of 1e-5."""
    f, zeta, compared = np.arange(1.0, 7.0), np.array([0.0, 1e-5, 0.1, 0.1, 0.1, 0.2]), []
    eom = EquationsOfMotion(
        np.eye(6),
        np.diag(4 * np.pi * f * zeta),
        np.diag((2 * np.pi * f) ** 2),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        np.zeros((6, 1)),
        ("A",),
    )
    judge_modes(eom, eom.natural_frequencies(), lambda kind, value, words: compared.append((kind, value)))
    assert [value for kind, value in compared if kind == "damping"] == pytest.approx([1e-5, 0.2])
