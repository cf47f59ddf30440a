"""The design report: one source of content, an HTML and a PDF renderer."""

from __future__ import annotations

from avis_ctrl.report import html, pdf
from avis_ctrl.report.content import document
from avis_ctrl.study.model import DesignResult


def render_html(result: DesignResult) -> bytes:
    """The report as one self-contained HTML file."""
    return html.render(document(result))


def render_pdf(result: DesignResult) -> bytes:
    """The report as PDF.

    Raises
    ------
    ComputationError : the typesetter refuses.
    """
    return pdf.render(document(result))


__all__ = ["render_html", "render_pdf"]
