"""`avis new`: files from a few answers, checked against the formulas of a box on springs."""

from __future__ import annotations

import functools

import avis_command
import numpy as np
import pytest

from avis_ctrl.rigs import load_rig
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.identification_design import default_band

avis = functools.partial(avis_command.avis, answers="\n" * 12, env={"COLUMNS": "120"})

RESPONSE = "RESP.XX.NS388..SHZ.GS11D.4_5.380.1740.26_2"


@pytest.mark.parametrize(("mounts", "drives"), [(3, 6), (4, 8)])
def test_a_rig_from_mass_size_and_frequencies(tmp_path, mounts, drives):
    path = tmp_path / "mine.toml"
    done = avis("new", "rig", str(path), "--mass", "240", "--vertical", "4", "--mounts", str(mounts))
    assert done.returncode == 0, done.stderr
    assert "Damping ratio" in done.stdout and "assumed" in path.read_text()
    rig = load_rig(path)
    k = [value.value for name, value in rig.parameters().items() if name.endswith(".k_z")]
    assert len(k) == mounts
    # sqrt(k/m) of the whole table is the frequency that was asked for.
    assert np.sqrt(sum(k) / 240) / (2 * np.pi) == pytest.approx(4.0, rel=1e-5)
    eom = rig.equations_of_motion()
    # ... and so is that of its vertical mode, for three mounts, too: it does not tilt.
    assert np.min(np.abs(eom.natural_frequencies().frequencies_Hz - 4.0)) < 1e-3
    assert len(eom.actuators) == drives
    # The drives move all six coordinates.
    assert np.linalg.matrix_rank(eom.T) == 6


def test_a_geophone_from_the_response_library(tmp_path, data):
    path = tmp_path / "mine.toml"
    folder = data / "geophone_responses"
    good = next(one for one in sorted(folder.glob("RESP.*.GS11D.4_5.380.*")))
    assert avis("new", "rig", str(path), "--geophone", str(good)).returncode == 0
    text = path.read_text()
    assert f"from {good.name}" in text and "suspension_Hz = 4.5" in text
    load_rig(path)
    bad = next(one for one in folder.glob("RESP.*NS534*"))
    done = avis("new", "rig", str(tmp_path / "other.toml"), "--geophone", str(bad))
    assert done.returncode == 2 and "contradicts itself: gain is 2.1" in done.stderr
    assert not (tmp_path / "other.toml").exists()


def test_a_rig_with_accelerometers(tmp_path):
    path = tmp_path / "mine.toml"
    assert avis("new", "rig", str(path), "--sensors", "accelerometer").returncode == 0
    rig = load_rig(path)
    assert "10 V/g" in path.read_text()
    assert [9.80665 * one.sensitivity_Vs2_per_m for one in rig.instruments] == pytest.approx([10.0] * 8, rel=1e-3)
    assert np.linalg.matrix_rank(rig.sensor_rows()[1]) == 6


def test_a_design_for_this_rig(tmp_path):
    rig, path = tmp_path / "rigs" / "mine.toml", tmp_path / "mine_design.toml"
    rig.parent.mkdir()
    assert avis("new", "rig", str(rig)).returncode == 0
    done = avis(
        "new",
        "design",
        str(path),
        "--rig",
        str(rig),
        "--band",
        "2, 20",
        "--band-limit",
        "-9",
        "--mass",
        "5",
        "--keep",
        "x, z",
    )
    assert done.returncode == 0, done.stderr
    design, read = read_study(path)
    assert read.name == "my_table" and design.keep == ["x", "z"]
    assert design.transmissibility.band_Hz == [2.0, 20.0] and design.transmissibility.band_dB == -9.0
    assert design.uncertainty.parameters_percent["mass"] == 5.0
    limit = {one.quantity: one.at_most for one in design.requirement}
    assert limit["worst_case_band_transmissibility_dB"] == -9.0
    lines = path.read_text().splitlines()
    for section in ("[uncertainty.parameters_percent]", "[transmissibility]", "[synthesis]"):
        assert lines[lines.index(section) - 1].startswith("# ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("rig", "OUT", "--mounts", "5"), "mounts = 5: expected 3 or 4"),
        (("rig", "OUT", "--mass", "-3"), "--mass = -3.0: expected a finite number, greater than zero"),
        (("rig", "OUT", "--size", "1, 2"), "--size = '1, 2': expected 3 numbers"),
        (("rig", "OUT", "--size", "1500, 1000, 500"), "did you mean [1.5, 1, 0.5] (given in mm)?"),
        (("rig", "OUT", "--mass", "500000"), "avis: --mass = 500000.0: "),
        (("rig", "OUT", "--name", 'a"b'), "expected a name without quotes"),
        (("rig", "OUT", "--geophone", "RESP.absent"), "RESP.absent"),
        (("rig", "OUT", "--sensors", "seismometer"), "--sensors = 'seismometer': expected geophone or accelerometer"),
        (("rig", "OLD"), "this file exists"),
        (("design", "OUT", "--rig", "absent.toml"), "absent.toml"),
        (("design", "OUT", "--keep", "up"), "up"),
        (("design", "OUT", "--band", "10, 1"), "band_Hz"),
    ],
)
def test_wrong_answers_are_one_line_and_write_nothing(tmp_path, arguments, said):
    (tmp_path / "OLD").write_text("kept")
    done = avis("new", *(str(tmp_path / word) if word in ("OUT", "OLD") else word for word in arguments))
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1
    assert (tmp_path / "OLD").read_text() == "kept" and not (tmp_path / "OUT").exists()


def test_a_wrong_answer_is_asked_for_again_at_once(tmp_path):
    path = tmp_path / "mine.toml"
    done = avis("new", "rig", str(path), answers="mine\nheavy\n-240\n240\n1, 2\n1, 0.8, 0.3\n7\n3\n" + "\n" * 8)
    assert done.returncode == 0, done.stderr
    for asked in ("Mass of the payload [kg]", "Length, width, height of the payload [m]", "Number of mounts, 3 or 4"):
        assert done.stdout.count(asked) >= 2
    assert "greater than zero" in done.stdout + done.stderr
    assert load_rig(path).parameters()["mass"].value == 240
    done = avis(
        "new",
        "design",
        str(tmp_path / "design.toml"),
        answers="none.toml\navis\n\nup\nz\n10, 1\n1, 10\n\n9\n-6" + "\n" * 5,
    )
    assert done.returncode == 0, done.stderr
    design, _ = read_study(tmp_path / "design.toml")
    assert design.keep == ["z"] and design.transmissibility.band_dB == -6.0


def test_without_answers_the_options_are_named(tmp_path):
    done = avis("new", "rig", str(tmp_path / "mine.toml"), answers="")
    assert done.returncode == 2 and "give what is missing as options" in done.stderr
    assert not (tmp_path / "mine.toml").exists()


def test_the_help_has_units():
    shown = avis("new", "rig", "--help").stdout + avis("new", "design", "--help").stdout
    assert all(unit in shown for unit in ("[kg]", "[m]", "[Hz]", "[N/V]", "[V]", "[dB]", "[%]"))


def test_values_that_no_table_has_write_nothing(tmp_path):
    done = avis("new", "rig", str(tmp_path / "mine.toml"), "--vertical", "2e5")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and not (tmp_path / "mine.toml").exists()


def test_unusual_values_are_pointed_out(tmp_path):
    done = avis("new", "rig", str(tmp_path / "mine.toml"), "--damping", "2")
    assert done.returncode == 0 and "unusual for a table: damping ratio" in done.stderr


def test_a_fraction_instead_of_a_percentage_is_pointed_out(tmp_path):
    done = avis("new", "design", str(tmp_path / "d.toml"), "--rig", "avis", "--mass", "0.08", "--stiffness", "12")
    assert done.returncode == 0 and "for a fraction of 0.08 give 8" in done.stderr and "stiffness" not in done.stderr


def test_the_shell_completes_commands_and_options():
    """What bash asks the program for, as `avis --install-completion` sets it up."""
    for words, expected in (("avis sim", "simulate-campaign"), ("avis new ", "rig"), ("avis design --o", "--out")):
        done = avis(env={"_AVIS_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))})
        assert expected in done.stdout.split(), words


def test_the_band_is_scaled_with_the_natural_frequencies():
    """Mounts four times as stiff double all natural frequencies."""
    rig = load_rig("avis")
    k = {name: 4 * p.value for name, p in rig.parameters().items() if ".k_" in name}
    assert default_band(rig) == (1.0, 10.0)
    assert default_band(rig.with_parameters(k)) == (2.0, 20.0)
