"""Reports of a design, of an identification and of a gap: one source of content each, an HTML and a PDF renderer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from avis_ctrl.report import html, pdf
from avis_ctrl.report.content import document
from avis_ctrl.study.design_result import DesignResult

if TYPE_CHECKING:
    from collections.abc import Mapping

    from avis_ctrl.gap.axis.result import AxisGap
    from avis_ctrl.report.gap.finding import Found
    from avis_ctrl.study.identification import Identification
    from avis_ctrl.study.identified_uncertainty import InDesign


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


def identification_html(found: Identification, in_design: InDesign | None = None) -> bytes:
    """The report of an identification as one self-contained HTML file."""
    from avis_ctrl.report.identification.content import document as content

    return html.render(content(found, in_design))


def identification_pdf(found: Identification, in_design: InDesign | None = None) -> bytes:
    """The same as PDF.

    Raises
    ------
    ComputationError : the typesetter refuses.
    """
    from avis_ctrl.report.identification.content import document as content

    return pdf.render(content(found, in_design))


def gap_html(found: Found) -> str:
    """The report of a gap as one self-contained HTML file.

    found : `study.gap.GapFinding`.
    """
    from avis_ctrl.report.gap.content import document as content

    return html.render(content(found)).decode()


def gap_pdf(found: Found) -> bytes:
    """The same as PDF.

    Raises
    ------
    ComputationError : the typesetter refuses.
    """
    from avis_ctrl.report.gap.content import document as content

    return pdf.render(content(found))


def axis_gap_reports(gap: AxisGap, source: str, provenance: Mapping[str, object]) -> dict[str, bytes]:
    """gap.html and gap.pdf of one axis, by their names; source : of the measurement.

    Raises
    ------
    ComputationError : the typesetter refuses.
    """
    from avis_ctrl.report.gap.axis import document as content

    found = content(gap, source, provenance)
    return {"gap.html": html.render(found), "gap.pdf": pdf.render(found)}


__all__ = ["axis_gap_reports", "gap_html", "gap_pdf", "identification_html", "identification_pdf", "render_html",
           "render_pdf"]
