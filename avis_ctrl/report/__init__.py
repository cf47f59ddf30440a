"""Reports of a design, an identification and a gap (model against measurement), as HTML and as PDF.

The contents are assembled by `content.document`, `identification.content.document`, `gap.content.document` and
`gap.axis.document`.
"""

from __future__ import annotations

from avis_ctrl.report import html, pdf
from avis_ctrl.report.elements import Document


def rendered(document: Document) -> tuple[bytes, bytes]:
    """Render a document as one self-contained HTML file and as PDF.

    Raises
    ------
    ComputationError : the PDF cannot be typeset.
    """
    return html.render(document), pdf.render(document)
