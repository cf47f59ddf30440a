"""The names of `import avis_ctrl as ac`: documented, seen by type checkers, loaded late."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

import avis_ctrl as ac

STUB = Path(ac.__file__).with_suffix(".pyi")
NAMES = [name for name in ac.__all__ if name != "__version__"]


def stub_names() -> set[str]:
    body = ast.parse(STUB.read_text(encoding="utf-8")).body
    return {alias.asname for node in body if isinstance(node, ast.ImportFrom) for alias in node.names if alias.asname}


def test_the_stub_has_every_name():
    assert stub_names() == set(NAMES)


def test_the_stub_says_where_each_name_comes_from():
    for node in ast.parse(STUB.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module != "avis_ctrl":
            for alias in node.names:
                if alias.asname != "gap":  # the package itself, which can be called
                    assert getattr(importlib.import_module(node.module), alias.name) is getattr(ac, alias.asname)


def test_dir_lists_the_names_and_nothing_else():
    assert dir(ac) == sorted(ac.__all__)


@pytest.mark.parametrize("name", NAMES)
def test_each_name_is_documented(name):
    first_words = {line.split()[0] for line in (ac.__doc__ or "").splitlines() if line}
    assert name in first_words, "in the docstring of the package"
    assert (getattr(ac, name).__doc__ or "").strip()


def test_gap_is_a_package_that_can_be_called():
    from avis_ctrl.gap.result import Gap

    assert Gap.__module__ == "avis_ctrl.gap.result" and callable(ac.gap)
    with pytest.raises(ac.InputError, match="expected a campaign"):
        ac.gap(3.0, "avis")


def test_an_unknown_name_is_refused():
    with pytest.raises(AttributeError, match="no attribute 'desing'"):
        _ = ac.desing


@pytest.mark.parametrize(
    ("name", "here"), [("wcgain", "worst_case_gain"), ("mixsyn", "mixed_sensitivity"), ("bode", "plot.bode")]
)
def test_names_of_other_tools_are_translated(name, here):
    with pytest.raises(AttributeError, match=f"here its name is {here}"):
        getattr(ac, name)
    assert here.partition(".")[0] in dir(ac)
