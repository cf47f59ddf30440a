"""The examples of docs/python.md run, and give the results that stand beside them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import avis_ctrl as ac

matplotlib.use("Agg")
ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python( slow)?\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def run(code: str, names: dict) -> int:
    """Execute a block statement by statement; compare what follows `# ->`. Returns the number of comparisons."""
    lines, checked = code.splitlines(), 0
    for node in ast.parse(code).body:
        _, arrow, printed = lines[node.end_lineno - 1].partition("# -> ")
        if not arrow:
            exec(compile(ast.Module([node], []), "docs/python.md", "exec"), names)
            continue
        assert isinstance(node, ast.Expr)
        value = eval(compile(ast.Expression(node.value), "docs/python.md", "eval"), names)
        expected = ast.literal_eval(printed)
        if isinstance(expected, float) or (isinstance(expected, tuple) and isinstance(expected[0], float)):
            np.testing.assert_allclose(value, expected, rtol=5e-3, err_msg=lines[node.end_lineno - 1])
        else:
            assert value == expected, lines[node.end_lineno - 1]
        checked += 1
    return checked


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_examples_run_and_give_what_they_say():
    names: dict = {}
    assert sum(run(code, names) for slow, code in BLOCKS if not slow) >= 15
    matplotlib.pyplot.close("all")


@pytest.mark.slow
def test_slow_examples_run(monkeypatch, tmp_path):
    (tmp_path / "designs").symlink_to(ROOT / "designs")
    monkeypatch.chdir(tmp_path)
    names: dict = {"ac": ac}
    for slow, code in BLOCKS:
        if slow:
            run(code, names)
    assert (tmp_path / "reports" / "from_python" / "report.html").is_file()


@pytest.mark.parametrize("name", [name for name in ac.__all__ if name != "__version__"])
def test_every_name_has_an_example(name):
    code = "\n".join(code for _, code in BLOCKS) + "".join(re.findall(r"`[^`\n]*`", PAGE))
    assert re.search(rf"\bac\.{name}\b", code)


def test_a_wrong_result_on_the_page_would_be_noticed():
    with pytest.raises(AssertionError):
        run("1 + 1  # -> 3\n", {})
    with pytest.raises(AssertionError):
        run("0.5  # -> 0.51\n", {})
