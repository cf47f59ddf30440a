"""The wheel: built, installed where nothing of the sources is in reach, and used."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    # From a copy: a build leaves files beside the sources, and takes in those of the last one.
    source, folder = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT / "avis_ctrl", source / "avis_ctrl", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, source],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    [made] = folder.glob("avis_ctrl-*.whl")
    return made


@pytest.mark.slow
def test_every_file_of_the_package_is_in_the_wheel(wheel: Path) -> None:
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("avis_ctrl/")}
    there = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "avis_ctrl").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert inside == there


@pytest.mark.slow
def test_the_commands_work_from_the_wheel_alone(wheel: Path, tmp_path: Path) -> None:
    """In an environment with the dependencies and without the sources; what is drawn and read comes from the wheel."""
    place = tmp_path / "env"
    venv.create(place, with_pip=False)
    site = next(place.glob("lib/python*/site-packages"))
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--no-deps",
            "--no-index",
            "--prefix",
            place,
            "--ignore-installed",
            wheel,
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*arguments: str) -> str:
        made = subprocess.run(
            [place / "bin" / "python", "-I", *arguments],
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path,
            env=clean,
        )
        assert made.returncode == 0, made.stderr
        return made.stdout

    assert Path(run("-c", "import avis_ctrl; print(avis_ctrl.__file__)").strip()).is_relative_to(place)
    script = place / "bin" / "avis"
    assert script.is_file()
    assert "does not work" not in run(str(script), "doctor")
    run(str(script), "excite", "--rig", "avis", "--out", "signals.h5")
    assert (tmp_path / "signals.h5").stat().st_size > 1000
    code = (
        "from avis_ctrl.report import html, pdf\nfrom avis_ctrl.report.elements import Document, Paragraph, Section\n"
        "page = Document('t', 's', 'x', (Section('a', 'a', (Paragraph('text'),)),))\n"
        "print(len(html.render(page)), len(pdf.render(page)))"
    )
    assert all(int(size) > 1000 for size in run("-c", code).split())
