"""The report as one self-contained HTML file: styles, figures and plotly.js are embedded."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from importlib import resources

import jinja2
import typst
from markupsafe import Markup

from avis_ctrl.report import plotly_backend
from avis_ctrl.report.elements import Document, Formula
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.words import typeset

# Typst settings for a page that fits one formula.
PAGE = "#set page(width: auto, height: auto, margin: 2pt, fill: none)\n#set text(size: 11pt)\n"


def render(document: Document) -> bytes:
    """The document as HTML; the template engine escapes all text."""
    files = resources.files("avis_ctrl.report")
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: typeset(value) if type(value) is str else value,
    )
    template = environment.from_string((files / "report.html.j2").read_text(encoding="utf-8"))
    formulas = [p for section in document.sections for p in section.flat() if isinstance(p, Formula)]
    graphs = {f.name: plotly_backend.graph(f) for f in document.figures() if isinstance(f, Figure)}
    text = template.render(
        document=document,
        kind=lambda piece: type(piece).__name__,
        Markup=Markup,
        style=Markup((files / "report.css").read_text(encoding="utf-8")),
        script=Markup((files / "report.js").read_text(encoding="utf-8")),
        formula=dict(zip(formulas, map(Markup, formula_images(formulas)), strict=True)),
        graphs=Markup(in_script(graphs)),
        library=plotly_backend.library(),
    )
    return text.encode()


def in_script(value: object) -> str:
    """JSON in which no text can close the enclosing script element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def formula_images(formulas: Sequence[Formula]) -> list[str]:
    """Each formula as SVG, all compiled together with one formula per page."""
    if not formulas:
        return []
    pages = "\n#pagebreak()\n".join(f"$ {one.typst} $" for one in formulas)
    made = typst.compile((PAGE + pages).encode(), format="svg", ignore_system_fonts=True)
    images = made if isinstance(made, list) else [made]
    return [_own_names(image.decode(), k) for k, image in enumerate(images)]


def _own_names(svg: str, number: int) -> str:
    """SVG with glyph names that are unique within the HTML page, without the namespace declarations."""
    svg = re.sub(r'\b(id="|href="#)g', rf"\g<1>f{number}g", svg)
    return re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
