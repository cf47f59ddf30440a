"""Reports of a design, of an identification and of a gap: a document each, and two renderers.

`content.document`, `identification.content.document`, `gap.content.document` and `gap.axis.document` say what a report
holds.
"""

from __future__ import annotations

from avis_ctrl.report import html, pdf
from avis_ctrl.report.pieces import Document


def rendered(document: Document) -> tuple[bytes, bytes]:
    """A document as one self-contained HTML file, and as PDF.

    Raises
    ------
    ComputationError : the typesetter refuses.
    """
    return html.render(document), pdf.render(document)
