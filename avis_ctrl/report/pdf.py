"""The report as PDF, compiled by Typst from a fixed template; the content is passed as data, never as markup."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib
import typst

from avis_ctrl.errors import ComputationError
from avis_ctrl.report import matplotlib_backend
from avis_ctrl.report.elements import (
    Bullets,
    Cell,
    Document,
    Drawing,
    Fold,
    Formula,
    Heading,
    Mark,
    Paragraph,
    Piece,
    Table,
)
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.words import typeset
from avis_ctrl.study.workers import each

# Relative to the text width: a drawing leaves room on its page for the text that it illustrates.
DRAWING_WIDTH = 0.72


def render(document: Document) -> bytes:
    """The document as PDF.

    Raises
    ------
    ComputationError : the typesetter fails; its message is the cause.
    """
    figures = [one for one in document.figures() if isinstance(one, Figure)]
    drawn = dict(zip(map(id, figures), each(matplotlib_backend.svg, figures), strict=True))
    content = {
        "title": document.title,
        "subtitle": document.subtitle,
        "stamp": document.stamp,
        "sections": [
            {"title": s.title, "anchor": s.anchor, "alone": s.alone, "pieces": [_piece(p, drawn) for p in s.pieces]}
            for s in document.sections
        ],
    }
    template = (resources.files("avis_ctrl.report") / "report.typ").read_bytes()
    # Sans-serif text of the drawings uses the font bundled with matplotlib, the same on every machine.
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    fonts = typst.Fonts(include_system_fonts=False, include_embedded_fonts=True, font_paths=[str(folder)])
    try:
        made, complaints = typst.compile_with_warnings(
            template,
            format="pdf",
            font_paths=fonts,
            ignore_system_fonts=True,
            timestamp=0,
            sys_inputs={"document": json.dumps(content, allow_nan=False)},
        )
    except typst.TypstError as error:
        raise ComputationError(
            "the PDF report was not typeset", cause=str(error), next_step="the HTML report has the same content"
        ) from error
    # Page numbers and places of figures are not reliable if the layout did not converge.
    for one in complaints:
        warnings.warn(f"layout of the PDF report: {one.message}", stacklevel=2)
    assert isinstance(made, bytes)  # one PDF for any number of pages
    return made


def _piece(piece: Piece, drawn: Mapping[int, str]) -> dict[str, Any]:
    """A piece as plain data for the template. drawn : SVG of each figure by its id."""
    match piece:
        case Heading(text):
            return {"kind": "heading", "text": typeset(text)}
        case Paragraph(text, kind, good, half):
            return {"kind": kind, "text": typeset(text), "good": good, "half": half}
        case Bullets(items):
            return {"kind": "bullets", "items": [typeset(item) for item in items]}
        case Formula(source, _):
            return {"kind": "formula", "typst": source}
        case Table():
            return {
                "kind": "table",
                "caption": typeset(piece.caption),
                "header": [typeset(h) for h in piece.header],
                "align": [piece.alignment(k) for k in range(len(piece.header))],
                "rows": [[_cell(c) for c in row] for row in piece.rows],
            }
        case Drawing(_, caption, image, alternative):
            return _image(DRAWING_WIDTH, caption, image, alternative)
        case Figure():
            return _image(1.0, piece.caption, drawn[id(piece)], piece.caption)
        case Fold(title, pieces):
            return {"kind": "fold", "title": typeset(title), "pieces": [_piece(p, drawn) for p in pieces]}
    raise TypeError(f"no piece of a report: {type(piece).__name__}")


def _image(width: float, caption: str, svg: str, alternative: str) -> dict[str, Any]:
    return {"kind": "figure", "width": width, "caption": typeset(caption), "svg": svg, "alternative": alternative}


def _cell(cell: Cell) -> dict[str, Any]:
    text, good = (cell.text, cell.good) if isinstance(cell, Mark) else (cell, None)
    return {"text": typeset(text), "good": good}
