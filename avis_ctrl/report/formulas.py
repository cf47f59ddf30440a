"""Formulas typeset by Typst: in place for the PDF, as drawings for the HTML report."""

from __future__ import annotations

import re
from collections.abc import Sequence

import typst

from avis_ctrl.report.pieces import Formula

PAGE = "#set page(width: auto, height: auto, margin: 2pt, fill: none)\n#set text(size: 11pt)\n"


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
