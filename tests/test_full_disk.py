"""Every command on a disk that refuses: one line, exit code 3, nothing half-written."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_cli import ONE_THREAD

import avis_ctrl
from avis_ctrl.files import HDF5
from avis_ctrl.measurement.formats import write_campaign
from avis_ctrl.measurement.formats.hdf5_writing import SETTINGS, PatientFile
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.study.plan_file import plan_from_table

# A file may not grow beyond this many bytes (Python ignores the signal, so that the write ends with EFBIG).
LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)
from avis_ctrl.cli import main
main()
"""
PLAN = """
title = "short"
duration_s = 5.0
settle_s = 1.0
[[record]]
excitation = "noise"
level_V = 0.05
"""
PACKAGE = Path(avis_ctrl.__file__).parent


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> dict[str, str]:
    """A plan, a campaign of it (which also leaves the compiled simulator on the disk), and an identified folder."""
    folder = tmp_path_factory.mktemp("given")
    (folder / "plan.toml").write_text(PLAN)
    plan = plan_from_table({"duration_s": 5.0, "settle_s": 1.0, "record": [{"excitation": "noise", "level_V": 0.05}]})
    write_campaign(folder / "campaign.h5", simulate_campaign(load_rig("avis"), plan))
    (folder / "result.json").write_text('{"format": "avis-identification"}')
    (folder / "rig.toml").write_text(rig_toml(load_rig("avis")))
    return {"PLAN": str(folder / "plan.toml"), "CAMPAIGN": str(folder / "campaign.h5"), "FOUND": str(folder)}


@pytest.mark.parametrize(
    ("arguments", "out", "at_byte"),
    [
        (("simulate-campaign", "--rig", "avis", "--plan", "PLAN", "--out"), "c.h5", 200_000),
        (("convert", "CAMPAIGN"), "c.h5", 1000),
        pytest.param(("convert", "CAMPAIGN"), "c.h5", 200_000, marks=pytest.mark.slow),
        (("predict", "FOUND", "CAMPAIGN", "--out"), "p.h5", 200_000),
        pytest.param(
            ("excite", "--rig", "avis", "--rms", "0.1", "--kind", "noise", "--out"),
            "s.h5",
            1000,
            marks=pytest.mark.slow,
        ),
        (("excite", "--rig", "avis", "--rms", "0.1", "--kind", "noise", "--out"), "s.csv", 200_000),
        (("excite", "--rig", "avis", "--rms", "0.1", "--kind", "noise", "--out"), "s.mat", 1000),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else str(value),
)
def test_a_file_that_the_system_refuses(arguments, out, at_byte, given, tmp_path):
    path = tmp_path / out
    old = (HDF5 if out.endswith(".h5") else b"") + b"old"  # only a file of the same kind may be overwritten
    path.write_bytes(old)
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(at_byte), *(given.get(one, one) for one in arguments), str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        env=ONE_THREAD,
        check=False,
    )
    assert done.returncode == 3, done.stderr
    assert done.stderr.startswith("avis: ") and done.stderr.count("\n") == 1
    assert f"{path} was not written" in done.stderr and "File too large" in done.stderr
    assert path.read_bytes() == old and os.listdir(tmp_path) == [out]


def test_what_cannot_be_printed_is_one_line(given, tmp_path):
    with open("/dev/full", "w", encoding="utf-8") as full:
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from avis_ctrl.cli import main; main()",
                "convert",
                given["CAMPAIGN"],
                str(tmp_path / "c.h5"),
            ],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            env=ONE_THREAD,
            check=False,
        )
    assert done.returncode == 3
    assert done.stderr.startswith("avis: ") and done.stderr.count("\n") == 1
    assert "No space left" in done.stderr


def _writes(path: Path) -> list[str]:
    """Calls that open a file to write it."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            modes = {
                one.value
                for one in (*node.args, *(k.value for k in node.keywords))
                if isinstance(one, ast.Constant) and isinstance(one.value, str)
            }
            if name in ("write_text", "write_bytes", "mkstemp", "NamedTemporaryFile") or (
                name in ("open", "File", "fdopen") and modes & {"w", "a", "x", "wb", "ab", "xb", "w+b", "r+"}
            ):
                found.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    return found


def test_files_are_written_in_one_place():
    """Identify, gap, design and gap-axis compute for long before they write; they write by the same few lines."""
    found = {where.split(":")[0] for path in PACKAGE.rglob("*.py") for where in _writes(path)}
    assert found == {"files.py", os.path.join("measurement", "formats", "hdf5_writing.py")}


def test_small_pieces_are_read_again_after_the_disk_refused_and_large_ones_are_not():
    """HDF5 can read its structure back; data that no longer fit on the disk are not kept in memory."""
    with open("/dev/full", "wb") as full:
        file = PatientFile(full.fileno())
        file.write(b"structure")
        assert isinstance(file.refused, OSError)
        file.write(bytes(SETTINGS.metadata_bytes + 1))
        assert set(file.kept) == {0} and bytes(file.kept[0]) == b"structure"
        assert file.tell() == file.end == 9 + SETTINGS.metadata_bytes + 1
