"""The documentation: its examples run and give what stands beside them, and the site builds without a warning."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import avis_ctrl as ac

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
SPEC = importlib.util.spec_from_file_location("run_pages", ROOT / "docs" / "run_pages.py")
run_pages = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(run_pages)


def run(text: str, level: str, folder: Path) -> tuple[str, run_pages.Runner]:
    runner = run_pages.Runner("page.md", folder, run_pages.LEVELS.index(level))
    return runner.page(text), runner


def runnable() -> list[Path]:
    return [page for page in PAGES if page.read_text().startswith("---\nrun: true\n")]


def test_the_heads_of_pages_are_closed():
    for page in PAGES:
        text = page.read_text()
        if text.startswith("---"):
            assert re.match(r"---\n(\w+: \w+\n)+---\n", text), page


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")
@pytest.mark.parametrize("page", runnable(), ids=lambda page: page.stem)
@pytest.mark.parametrize("level", ["quick", pytest.param("full", marks=pytest.mark.slow)])
def test_the_examples_of_a_page(page, level):
    text = page.read_text()
    with run_pages.folder_for_page() as folder:
        _, runner = run(text, level, folder)
    assert runner.compared == len(re.findall("# -> ", text))
    python = "".join(match[3] for match in run_pages.FENCE.finditer(text) if match[1] == "python")
    if level == "full" and re.search(r"plt\.|plot[._]\w+\(", python):
        assert any(name.endswith(".svg") for name in runner.files)


@pytest.mark.parametrize(
    "code, shown",
    [
        ("1 + 1  # -> 3", None),
        ("0.5  # -> 0.51", None),
        ("raise ValueError", None),
        ("0.5  # -> 0.5001", ""),
        ("print('seen')", "seen"),
        ("[1, 2]", "[1, 2]"),
        ("import avis_ctrl as ac\nac.real('k', 1, percent=5)", "<table>"),
        ("import avis_ctrl as ac\nax = ac.plot.vc_curves()", "![figure](page-1.svg)"),
    ],
)
def test_results_are_compared_and_shown(tmp_path, code, shown):
    page = f"```python\n{code}\n```\n"
    if shown is None:
        with pytest.raises(run_pages.ExampleError):
            run(page, "quick", tmp_path)
    else:
        assert shown in run(page, "quick", tmp_path)[0]


def test_a_command_is_shown_with_its_output_and_its_reports(tmp_path):
    page = "```console slow\n$ echo said && touch report.html\n```\n"
    assert run(page, "quick", tmp_path)[0] == page.replace(" slow", "")
    shown, runner = run(page, "full", tmp_path)
    assert "```text\nsaid\n```" in shown and list(runner.files) == ["page/report.html"]
    with pytest.raises(run_pages.ExampleError, match="exit code 3"):
        run("```console\n$ exit 3\n```\n", "quick", tmp_path)


def test_every_public_name_is_in_the_reference():
    text = "".join(page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md"))
    paths = re.findall(r"^::: ([\w.]+)", text, re.MULTILINE)
    described = {heading for path in paths for heading in re.findall("^## (.+)", run_pages.reference(path), re.M)}
    assert described >= {name for name in ac.__all__ if name != "__version__"}


def test_the_site_builds_without_a_warning_and_needs_no_network(tmp_path):
    pytest.importorskip("mkdocs", reason="the site needs the extra: pip install 'avis_ctrl[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "AVIS_DOCS": "quick", "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stderr
    for page in tmp_path.rglob("*.html"):
        tags = re.findall(r"<(?:script|img|iframe|link)[^>]*>", page.read_text())
        assert not [tag for tag in tags if re.search(r"(?:src|href)=\"?(?:https?:)?//", tag)], page
    for made in tmp_path.rglob("*.ipynb"):
        cells = json.loads(made.read_text())["cells"]
        assert {cell["cell_type"] for cell in cells} == {"markdown", "code"} and "import avis_ctrl" in str(cells)
    assert len(list(tmp_path.rglob("*.ipynb"))) >= 3
