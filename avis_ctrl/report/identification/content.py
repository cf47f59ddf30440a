"""Contents of the identification report, independent of the renderer."""

from __future__ import annotations

from avis_ctrl.report.elements import Document
from avis_ctrl.report.identification.comparison import ways
from avis_ctrl.report.identification.gates import gates
from avis_ctrl.report.identification.identifiability import identifiability
from avis_ctrl.report.identification.measurements import measurements
from avis_ctrl.report.identification.responses import responses
from avis_ctrl.report.identification.summary import opening, parameters
from avis_ctrl.report.identification.validation import validation
from avis_ctrl.report.method import method
from avis_ctrl.report.provenance import document_of
from avis_ctrl.report.sections.identified import uncertainty
from avis_ctrl.study.identification import Identification
from avis_ctrl.study.identified_uncertainty import InDesign


def document(found: Identification, in_design: InDesign | None = None) -> Document:
    """The report of an identification. in_design : the uncertainty model for a design, if it was computed."""
    return document_of(
        f"Identification of the rig {found.rig.name}",
        "From measurements to a rig with known uncertainty",
        found.provenance,
        (
            opening(found),
            parameters(found),
            measurements(found),
            gates(found.findings),
            responses(found),
            identifiability(found),
            ways(found),
            validation(found),
            uncertainty(found, in_design),
            method("identification", () if found.campaign_fit.tolerances else ("tolerances",)),
        ),
    )
