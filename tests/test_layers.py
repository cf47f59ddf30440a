"""The layers of the package: imports point downward only, and run in no circle."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "avis_ctrl"
LEVEL = {
    "errors": -2,
    "summary": -2,
    "checks": -1,
    "files": -1,
    "uncertain_value": -1,
    "lti": 0,
    "rigs": 1,
    "measurement": 1,
    "identification": 2,
    "uncertainty": 2,
    "robust": 3,
    "classical": 3,
    "simulation": 4,
    "gap": 5,
    "study": 6,
    "report": 7,
    "plot": 7,
    "export": 7,
    "sweep": 8,
    "interface": 9,
    "cli": 10,
}
PROJECT = ("avis_ctrl", "tests", "benchmarks", "designs")
FILES = sorted(PACKAGE.rglob("*.py"))


@cache
def imports(path: Path) -> tuple[tuple[str, bool], ...]:
    """(dotted name, whether it is imported when the module is) of each import."""
    package = [*path.relative_to(PACKAGE.parent).parent.parts]

    def walk(node: ast.AST, at_once: bool) -> Iterator[tuple[str, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from ((alias.name, at_once) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                base = [*package[: len(package) - child.level + 1]] if child.level else []
                module = ".".join([*base, *([child.module] if child.module else [])])
                yield from ((f"{module}.{alias.name}", at_once) for alias in child.names)
            else:
                inside = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
                yield from walk(child, at_once and not inside)

    return tuple(walk(ast.parse(path.read_text(encoding="utf-8")), True))


def layer(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def test_every_module_belongs_to_a_layer():
    assert {layer(path) for path in FILES} - {"__init__"} <= set(LEVEL)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downward(path):
    own = layer(path)
    if own == "__init__":  # the front door: it names its modules as text and loads them late
        assert not [name for name, _ in imports(path) if name.startswith("avis_ctrl.")]
        return
    for name, _ in imports(path):
        parts = name.split(".")
        # `import avis_ctrl` itself is for the version number.
        if parts[0] == PACKAGE.name and len(parts) > 1 and parts[1] != own:
            assert LEVEL[parts[1]] < LEVEL[own], f"{path.name} imports {name}"


def test_the_walk_sees_an_upward_import(tmp_path, monkeypatch):
    """The test of the test: an import inside a function counts too."""
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "avis_ctrl")
    path = tmp_path / "avis_ctrl" / "lti" / "bad.py"
    path.parent.mkdir(parents=True)
    path.write_text("from ..study import runner\ndef f():\n    import avis_ctrl.cli\n    from . import norms\n")
    assert imports(path) == (("avis_ctrl.study.runner", True), ("avis_ctrl.cli", False), ("avis_ctrl.lti.norms", False))


def modules_imported_by(path: Path, known: set[str]) -> set[str]:
    """Modules of the package that a file imports anywhere: under TYPE_CHECKING and inside functions too."""
    found = set()
    for name, _ in imports(path):
        module = name if name in known else name.rpartition(".")[0]
        found |= {module} & known
    return found - {module_name(path)}


def module_name(path: Path) -> str:
    parts = [PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def import_circles() -> list[list[str]]:
    """Groups of modules each of which reaches every other by imports."""
    files = {module_name(path): path for path in PACKAGE.rglob("*.py")}
    after = {name: modules_imported_by(path, set(files)) for name, path in files.items()}

    def reached(start: str) -> set[str]:
        found: set[str] = set()
        waiting = [start]
        while waiting:
            new = after[waiting.pop()] - found
            found |= new
            waiting += new
        return found

    reach = {name: reached(name) for name in after}
    groups = {
        frozenset(other for other in reach[name] if name in reach[other]) for name in after if name in reach[name]
    }
    return sorted(sorted(group) for group in groups)


def test_no_import_circles():
    assert import_circles() == []


@pytest.mark.parametrize(
    "back",
    [
        "from .a import x\n",
        "if TYPE_CHECKING:\n    from avis_ctrl.lti.a import x\n",
        "def f():\n    from avis_ctrl.lti import a\n",
    ],
)
def test_a_circle_is_found_however_it_is_hidden(tmp_path, monkeypatch, back):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "avis_ctrl")
    folder = tmp_path / "avis_ctrl" / "lti"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("from avis_ctrl.lti.b import y\n")
    (folder / "b.py").write_text(back)
    (folder / "c.py").write_text("from avis_ctrl.lti import a\n")
    assert import_circles() == [["avis_ctrl.lti.a", "avis_ctrl.lti.b"]]


def private_imports(path: Path) -> list[str]:
    """Names with a leading underscore that a file takes from a module of the project."""
    return [
        name
        for name, _ in imports(path)
        if name.split(".")[0] in PROJECT
        and any(part.startswith("_") and not part.startswith("__") for part in name.split("."))
    ]


@pytest.mark.parametrize("folder", PROJECT)
def test_private_names_stay_in_their_module(folder):
    """Tests included: what a test needs of a module is part of what the module offers."""
    files = sorted((PACKAGE.parent / folder).rglob("*.py"))
    assert files and {str(path): found for path in files if (found := private_imports(path))} == {}


def test_a_private_import_is_found_even_inside_a_function(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "avis_ctrl")
    path = tmp_path / "tests" / "test_a.py"
    path.parent.mkdir()
    path.write_text(
        "from __future__ import annotations\nfrom os import _exit\nfrom avis_ctrl import __version__\n"
        "def f():\n    from avis_ctrl.lti.norms import _inner\n"
    )
    assert private_imports(path) == ["avis_ctrl.lti.norms._inner"]


def users(library: str, at_once: bool = False) -> list[str]:
    return [
        str(path.relative_to(PACKAGE))
        for path in FILES
        for name, direct in imports(path)
        if name.split(".")[0] == library and (direct or not at_once)
    ]


def test_slycot_is_a_second_opinion_only():
    """One adapter imports it, and only the analysis of a finished design and the doctor use it: no bound does."""
    assert set(users("slycot")) == {"robust/slycot_adapter.py"}
    users_of_adapter = {
        str(path.relative_to(PACKAGE)) for path in FILES for name, _ in imports(path) if "slycot_adapter" in name
    }
    assert users_of_adapter == {"study/analysis.py", "study/doctor.py"}


@pytest.mark.parametrize("library", ["slycot", "control"])
def test_slow_libraries_are_imported_late(library):
    assert users(library, at_once=True) == []


@pytest.mark.parametrize("library", ["matplotlib", "plotly", "typst", "jinja2"])
def test_only_reports_and_plots_draw(library):
    """What computes needs no drawing library."""
    assert {name.split("/")[0] for name in users(library, at_once=True)} <= {"report", "plot"}


@pytest.mark.parametrize("library", ["typer", "rich"])
def test_only_the_command_line_talks(library):
    assert {name.split("/")[0] for name in users(library)} == {"cli"}


def loaded(statement: str) -> set[str]:
    """Top-level modules in memory after a statement, in a fresh interpreter."""
    code = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_linear_systems_load_without_python_control():
    assert loaded("import avis_ctrl.lti").isdisjoint({"control", "slycot", "matplotlib", "cvxpy", "numba"})


@pytest.mark.parametrize("statement", ["import avis_ctrl", "import avis_ctrl.cli", "import avis_ctrl.errors"])
def test_the_front_door_loads_no_arrays(statement):
    assert loaded(statement).isdisjoint({"numpy", "scipy", "control", "pydantic", "matplotlib"})
