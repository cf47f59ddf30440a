"""The report as one HTML file that needs nothing else: styles, figures and plotly.js are inside."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from importlib import resources

import jinja2
import typst
from markupsafe import Markup

from avis_ctrl.report import plotly_backend
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.pieces import Document, Formula
from avis_ctrl.report.words import typeset

# A formula, set by Typst as a drawing of its own.
PAGE = "#set page(width: auto, height: auto, margin: 2pt, fill: none)\n#set text(size: 11pt)\n"


def render(document: Document) -> bytes:
    """The document as HTML; everything that is text is escaped by the template engine."""
    files = resources.files("avis_ctrl.report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True,
                                     undefined=jinja2.StrictUndefined,
                                     finalize=lambda value: typeset(value) if type(value) is str else value)
    template = environment.from_string((files / "report.html.j2").read_text(encoding="utf-8"))
    formulas = [p for section in document.sections for p in section.flat() if isinstance(p, Formula)]
    graphs = {f.name: plotly_backend.graph(f) for f in document.figures() if isinstance(f, Figure)}
    text = template.render(
        document=document, kind=lambda piece: type(piece).__name__, Markup=Markup,
        style=Markup((files / "report.css").read_text(encoding="utf-8")),
        script=Markup((files / "report.js").read_text(encoding="utf-8")),
        formula=dict(zip(formulas, map(Markup, formula_images(formulas)), strict=True)),
        graphs=Markup(in_script(graphs)), library=plotly_backend.library())
    return text.encode()


def in_script(value: object) -> str:
    """JSON that no text inside can end the script element of."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def formula_images(formulas: Sequence[Formula]) -> list[str]:
    """Each formula as SVG, one page each of one compilation."""
    if not formulas:
        return []
    pages = "\n#pagebreak()\n".join(f"$ {one.typst} $" for one in formulas)
    made = typst.compile((PAGE + pages).encode(), format="svg", ignore_system_fonts=True)
    images = made if isinstance(made, list) else [made]
    return [_own_names(image.decode(), k) for k, image in enumerate(images)]


def _own_names(svg: str, number: int) -> str:
    """Glyph names made different between the drawings of one page; the outer namespace declarations are needless."""
    svg = re.sub(r'\b(id="|href="#)g', rf"\g<1>f{number}g", svg)
    return re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
