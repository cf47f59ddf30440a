"""`avis new`: files from a few answers, checked against the formulas of a box on springs."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from avis_ctrl.rigs import load_rig
from avis_ctrl.study.design_file import read_study

RESPONSE = "RESP.XX.NS388..SHZ.GS11D.4_5.380.1740.26_2"


def avis(*arguments: str, answers: str = "\n" * 12, env: dict[str, str] | None = None) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", "import sys; sys.argv[0] = 'avis'\n"
                           "from avis_ctrl.cli import main; main()", *arguments], input=answers, capture_output=True,
                          text=True, check=False, timeout=60, env={**os.environ, "COLUMNS": "120", **(env or {})})


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


def test_a_design_for_this_rig(tmp_path):
    rig, path = tmp_path / "rigs" / "mine.toml", tmp_path / "mine_design.toml"
    rig.parent.mkdir()
    assert avis("new", "rig", str(rig)).returncode == 0
    done = avis("new", "design", str(path), "--rig", str(rig), "--band", "2, 20", "--band-limit", "-9", "--mass", "5",
                "--keep", "x, z")
    assert done.returncode == 0, done.stderr
    design, read = read_study(path)
    assert read.name == "my_table" and design.keep == ["x", "z"]
    assert design.transmissibility.band_Hz == [2.0, 20.0] and design.transmissibility.band_dB == -9.0
    assert design.uncertainty.parameters_percent["mass"] == 5.0
    limit = {one.quantity: one.at_most for one in design.requirement}
    assert limit["worst_case_band_transmissibility_dB"] == -8.0
    lines = path.read_text().splitlines()
    for section in ("[uncertainty.parameters_percent]", "[transmissibility]", "[synthesis]"):
        assert lines[lines.index(section) - 1].startswith("# ")


@pytest.mark.parametrize(("arguments", "said"), [
    (("rig", "OUT", "--mounts", "5"), "mounts = 5: expected 3 or 4"),
    (("rig", "OUT", "--mass", "-3"), "mass_kg = -3.0: expected a finite number, greater than zero"),
    (("rig", "OUT", "--size", "1, 2"), "--size = '1, 2': expected 3 numbers"),
    (("rig", "OUT", "--name", 'a"b'), "expected a name without quotes"),
    (("rig", "OUT", "--geophone", "RESP.absent"), "RESP.absent"),
    (("rig", "OLD"), "this file exists"),
    (("design", "OUT", "--rig", "absent.toml"), "absent.toml"),
    (("design", "OUT", "--keep", "up"), "up"),
    (("design", "OUT", "--band", "10, 1"), "band_Hz")])
def test_wrong_answers_are_one_line_and_write_nothing(tmp_path, arguments, said):
    (tmp_path / "OLD").write_text("kept")
    done = avis("new", *(str(tmp_path / word) if word in ("OUT", "OLD") else word for word in arguments))
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1
    assert (tmp_path / "OLD").read_text() == "kept" and not (tmp_path / "OUT").exists()


def test_the_shell_completes_commands_and_options():
    """What bash asks the program for, as `avis --install-completion` sets it up."""
    for words, expected in (("avis sim", "simulate-campaign"), ("avis new ", "rig"), ("avis design --o", "--out")):
        done = avis(env={"_AVIS_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))})
        assert expected in done.stdout.split(), words
