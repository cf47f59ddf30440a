"""Runs the examples on the pages of the site and shows their results below them; a hook of mkdocs, used by the tests.

On a page with `run: true` in its head, Python blocks run in order, in one namespace and one folder. What they print,
their last value and their figures are shown below them. `# -> value` beside an expression states its value, which is
compared. In a console block, lines with `$ ` run in the same folder. Reports that a command writes are linked.
Blocks are marked `slow` (a minute, say) or `gallery` (minutes); AVIS_DOCS says how far to go:

    check    nothing runs: pages, links and anchors only
    quick    without slow blocks
    full     without gallery blocks (the default)
    gallery  everything
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import io
import json
import os
import pydoc
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import avis_ctrl as ac

ROOT = Path(__file__).resolve().parents[1]
LEVELS = ("check", "quick", "full", "gallery")
FENCE = re.compile(r"^```(python|console)((?: \w+)*)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
REFERENCE = re.compile(r"^::: ([\w.]+)(?:: (.*))?$", re.MULTILINE)


class ExampleError(Exception):
    """An example that does not run, or does not give what the page says."""


def level_of(words: str) -> int:
    """The level from which a block runs."""
    return {"slow": 2, "gallery": 3}.get(words.strip(), 1)


class Runner:
    """One page: its namespace, its folder, and the files that it made, by name beside the page."""

    def __init__(self, name: str, folder: Path, level: int) -> None:
        self.name, self.folder, self.level = name, folder, level
        self.names: dict[str, Any] = {}
        self.files: dict[str, bytes] = {}
        self.compared = 0

    def page(self, text: str) -> str:
        """The page with its results."""
        return FENCE.sub(self._block, text)

    def _block(self, match: re.Match[str]) -> str:
        language, words, code = match.groups()
        shown = f"```{language}\n{code}```\n"
        if level_of(words) > self.level:
            return shown
        before = set(self.folder.rglob("*"))
        home = Path.cwd()
        os.chdir(self.folder)
        try:
            made = self._console(code) if language == "console" else self._python(code)
        except ExampleError:
            raise
        except Exception as error:
            raise ExampleError(f"{self.name}: {error!r} in\n{code}") from error
        finally:
            os.chdir(home)
        return "\n".join([shown, *made, *self._reports(before)]) + "\n"

    def _python(self, code: str) -> list[str]:
        import matplotlib

        matplotlib.use("Agg")
        lines, printed, value = code.splitlines(), io.StringIO(), None
        with contextlib.redirect_stdout(printed):
            for node in ast.parse(code).body:
                _, arrow, stated = lines[node.end_lineno - 1].partition("# -> ")
                if not isinstance(node, ast.Expr):
                    exec(compile(ast.Module([node], []), self.name, "exec"), self.names)
                    value = None
                    continue
                value = eval(compile(ast.Expression(node.value), self.name, "eval"), self.names)
                if arrow:
                    self._compare(value, ast.literal_eval(stated), lines[node.end_lineno - 1])
                    value = None
        text = printed.getvalue()
        return [*_text(text), *_value(value), *self._figures()]

    def _compare(self, value: Any, stated: Any, line: str) -> None:
        first = stated[0] if isinstance(stated, tuple) and stated else stated
        same = np.allclose(value, stated, rtol=5e-3) if isinstance(first, float) else value == stated
        if not same:
            raise ExampleError(f"{self.name}: {line.strip()}: found {value!r}")
        self.compared += 1

    def _figures(self) -> list[str]:
        from matplotlib import pyplot as plt

        shown = []
        for number in plt.get_fignums():
            file, svg = f"{Path(self.name).stem}-{len(self.files) + 1}.svg", io.BytesIO()
            plt.figure(number).savefig(svg, format="svg", metadata={"Date": None})
            self.files[file] = svg.getvalue()
            shown.append(f"![figure]({file})\n")
        plt.close("all")
        return shown

    def _console(self, code: str) -> list[str]:
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        printed = []
        for line in code.replace("\\\n", "").splitlines():
            if line.startswith("$ "):
                done = subprocess.run(["bash", "-c", line[2:]], capture_output=True, text=True, check=False,
                                      env={**os.environ, "PATH": path, "COLUMNS": "100"})
                if done.returncode:
                    raise ExampleError(f"{self.name}: {line}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
                printed.append(done.stdout.rstrip())
        return _text("\n".join(part for part in printed if part))

    def _reports(self, before: set[Path]) -> list[str]:
        links = []
        for path in sorted(set(self.folder.rglob("*.html")) - before):
            file = f"{Path(self.name).stem}/{path.relative_to(self.folder)}"
            self.files[file] = path.read_bytes()
            links.append(f"[{path.relative_to(self.folder)}]({file})")
        return [f"Made by this run: {', '.join(links)}\n"] if links else []


def _text(text: str) -> list[str]:
    """Printed text; where it is long, folded."""
    if not text.strip():
        return []
    block = f"```text\n{text.rstrip()}\n```\n"
    fold = text.count("\n") > 24
    return [f'<details markdown="1"><summary>What it prints</summary>\n\n{block}\n</details>\n' if fold else block]


def _value(value: Any) -> list[str]:
    """The last value of a block, as a notebook shows it; axes, files and functions are not shown."""
    if hasattr(value, "_repr_html_"):
        return [f'<div class="result">{value._repr_html_()}</div>\n']
    plain = isinstance(value, (bool, int, float, complex, str, tuple, list, dict, np.ndarray))
    if not plain or (isinstance(value, np.ndarray) and value.dtype.hasobject) or "Path(" in repr(value):
        return []
    return _text(value if isinstance(value, str) else repr(value))


@contextlib.contextmanager
def folder_for_page():
    """A new folder in which `designs` is that of the repository."""
    with tempfile.TemporaryDirectory() as name:
        Path(name, "designs").symlink_to(ROOT / "designs")
        yield Path(name).resolve()


def notebook(text: str) -> str:
    """A page as a Jupyter notebook without results (format 4.5)."""
    cells, place = [], 0

    def add(kind: str, source: str) -> None:
        if source.strip():
            code = {"outputs": [], "execution_count": None} if kind == "code" else {}
            cells.append({"cell_type": kind, "id": f"cell-{len(cells)}", "metadata": {}, "source": source.strip(),
                          **code})
    for match in FENCE.finditer(text):
        add("markdown", text[place:match.start()])
        code = match[3] if match[1] == "python" else re.sub(r"^\$ ", "!", match[3], flags=re.MULTILINE)
        add("code", code)
        place = match.end()
    add("markdown", text[place:])
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return json.dumps({"nbformat": 4, "nbformat_minor": 5, "metadata": {"kernelspec": kernel}, "cells": cells})


def reference(path: str, members: str = "") -> str:
    """Heading, signature and docstring of a public name, and of some of its members, as Markdown."""
    found = pydoc.locate(path)
    if found is None:
        raise ExampleError(f"{path}: no such object")
    name = next((key for key in ac.__all__ if getattr(ac, key) is found), path.rpartition(".")[2])
    parts = [_described(found, name, "##")]
    for member in members.replace(",", " ").split():
        parts.append(_described(inspect.getattr_static(found, member), f"{name}.{member}", "###"))
    return "\n".join(parts)


def _described(one: Any, name: str, heading: str) -> str:
    one = one.fget if isinstance(one, property) else getattr(one, "__func__", one)
    call = ""
    if inspect.isfunction(one) or name == "StateSpace":
        signature = inspect.signature(one)
        plain = [each.replace(annotation=each.empty) for each in signature.parameters.values() if each.name != "self"]
        call = f"```python\n{name}{signature.replace(parameters=plain, return_annotation=signature.empty)}\n```\n"
    return f"{heading} {name}\n\n{call}\n{docstring(inspect.getdoc(one) or '')}\n"


def docstring(text: str) -> str:
    """The house style of docstrings as Markdown: headings, lists of `name : meaning`, examples."""
    text = re.sub(r"^(\w+)\n-+$", r"**\1**\n", text, flags=re.MULTILINE)
    text = re.sub(r"\bdocs/(\w+)\.md", r"[\1](../\1.md)", text)
    # `name : meaning. other : meaning` are two items; a line that is indented goes on with the one above.
    text = re.sub(r"(?<=[.;\w)]) ([a-zA-Z_]\w*(?:, \w+)*) : ", r"\n\1 : ", text) if " : " in text else text
    lines, code = [], False
    for line in text.splitlines():
        if line.startswith(">>>") and not code:
            lines.append("```pycon")
            code = True
        if code and not line.strip():
            lines.append("```")
            code = False
        item = None if code else re.match(r"([a-zA-Z_]\w*(?:, \w+)*) : (.*)", line)
        if item and lines and not lines[-1].startswith("- ") and lines[-1].strip():
            lines.append("")
        lines.append(f"- `{item[1]}`: {item[2]}" if item else line)
    return "\n".join([*lines, *(["```"] if code else [])])


def _with_references(text: str) -> str:
    """The page with the docstrings of the names that it refers to."""
    return REFERENCE.sub(lambda match: reference(match[1], match[2] or ""), text)


def on_page_markdown(text: str, page: Any, config: Any, files: Any) -> str:
    """The hook of mkdocs."""
    from mkdocs.structure.files import File

    level, source = LEVELS.index(os.environ.get("AVIS_DOCS", "full")), page.file.src_uri
    if not page.meta.get("run"):
        return _with_references(text)
    with folder_for_page() as folder:
        runner = Runner(source, folder, level)
        shown = _with_references(runner.page(text))  # last: their signatures are not examples
    made = dict(runner.files)
    if page.meta.get("notebook"):
        name = f"{Path(source).stem}.ipynb"
        made[name] = notebook(text).encode()
        shown = re.sub(r"\n\n", f"\n\nThis page is also a [notebook]({name}).\n\n", shown, count=1)
    for name, content in made.items():
        files.append(File.generated(config, str(Path(source).parent / name), content=content))
    return shown


def math(source: str, language: str, css_class: str, options: Any, md: Any, **more: Any) -> str:
    """A formula block as MathML, which browsers draw without a script."""
    from latex2mathml.converter import convert

    return f'<div class="formula">{convert(source, display="block")}</div>'
