"""What reports contain: pieces of a document, elements and graphs of its page, text of its PDF."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from html.parser import HTMLParser

import pytest

from avis_ctrl.report import html, pdf
from avis_ctrl.report.elements import Document, Mark, Paragraph, Section, Table
from avis_ctrl.report.figures import Figure

HOSTILE = '</script><script>alert(1)</script> <b>x</b> #panic("y") $ *z* {{ 7*7 }} \\ & "'


@dataclass(frozen=True)
class Written:
    """A report and both its files."""

    document: Document
    html: bytes
    pdf: bytes


def written(document: Document) -> Written:
    return Written(document, html.render(document), pdf.render(document))


class Reader(HTMLParser):
    """Elements with their attributes, and the text outside scripts and styles."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.scripts, self._inside = "", [], ""
        self.feed(page.decode())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside != "style":
            self.text += data

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.elements)

    def graphs(self) -> dict:
        return next(
            json.loads(script)
            for (tag, attrs), script in zip([e for e in self.elements if e[0] == "script"], self.scripts, strict=True)
            if attrs.get("id") == "graphs"
        )


def pdf_text(pdf: bytes, tmp_path) -> str:
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext is not installed")
    path = tmp_path / "report.pdf"
    path.write_bytes(pdf)
    return subprocess.run(["pdftotext", "-layout", path, "-"], capture_output=True, text=True, check=True).stdout


def part(document: Document, anchor: str) -> Section:
    return next(s for s in document.sections if s.anchor == anchor)


def tables(part: Section) -> list[Table]:
    return [p for p in part.flat() if isinstance(p, Table)]


def figures(part: Section) -> dict[str, Figure]:
    return {p.name: p for p in part.flat() if isinstance(p, Figure)}


def prose(part: Section) -> str:
    return " ".join(p.text for p in part.flat() if isinstance(p, Paragraph))


def cells(document: Document) -> list[str]:
    every = [c for s in document.sections for t in tables(s) for row in t.rows for c in row]
    return [c.text if isinstance(c, Mark) else c for c in every]
