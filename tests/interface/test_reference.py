"""The examples in the docstrings of the public names run, and give what stands below them."""

from __future__ import annotations

import doctest

import control
import numpy as np
import pytest
from test_names import NAMES

import avis_ctrl as ac
from avis_ctrl import plot
from avis_ctrl.interface import workflow
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem

SLOW = {"identify", "gap", "design"}
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in NAMES])
def test_the_examples_of_each_name(name, tmp_path, monkeypatch, request):
    (tmp_path / "designs").symlink_to(request.config.rootpath / "designs")
    monkeypatch.chdir(tmp_path)
    subject = workflow.gap if name == "gap" else getattr(ac, name)
    globs = {"ac": ac, "np": np, "control": control}
    (test,) = doctest.DocTestFinder(recurse=False).find(subject, name, module=False, globs=globs)
    assert test.examples and f"ac.{name}" in test.docstring, "an example of the name"
    result = doctest.DocTestRunner(optionflags=FLAGS).run(test)
    assert not result.failed


@pytest.mark.parametrize("subject", [UncertainSystem, *(getattr(plot, name) for name in plot.__all__)])
def test_the_examples_of_uncertain_systems_and_plots(subject):
    globs = {"ac": ac, "np": np}
    (test,) = doctest.DocTestFinder(recurse=False).find(subject, subject.__name__, module=False, globs=globs)
    assert test.examples
    assert not doctest.DocTestRunner(optionflags=FLAGS).run(test).failed
