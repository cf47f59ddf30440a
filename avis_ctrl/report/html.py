"""The report as one HTML file that needs nothing else: styles, figures and plotly.js are inside."""

from __future__ import annotations

import json
from importlib import resources

import jinja2
from markupsafe import Markup

from avis_ctrl.report import plotly_backend
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.formulas import formula_images
from avis_ctrl.report.pieces import Document, Formula
from avis_ctrl.report.words import typeset


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
