"""Contents of the design report, independent of the renderer."""

from __future__ import annotations

from collections.abc import Callable

from avis_ctrl.report.elements import Document, Section
from avis_ctrl.report.method import method
from avis_ctrl.report.provenance import document_of
from avis_ctrl.report.sections.bounds import bounds
from avis_ctrl.report.sections.controllers import controllers
from avis_ctrl.report.sections.plant import generalized_plant
from avis_ctrl.report.sections.rig import rig
from avis_ctrl.report.sections.simulation import simulation
from avis_ctrl.report.sections.site import site
from avis_ctrl.report.sections.synthesis import synthesis
from avis_ctrl.report.sections.transmissibility import transmissibility
from avis_ctrl.report.sections.verdict import comparison, verdict
from avis_ctrl.report.words import axis
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.summary import joined

SECTIONS: tuple[Callable[[DesignResult], Section], ...] = (
    verdict,
    comparison,
    transmissibility,
    rig,
    generalized_plant,
    bounds,
    synthesis,
    controllers,
    site,
    simulation,
    lambda result: method("design", edge_m=f"{result.rig.edge_m:.3g}"),
)


def document(result: DesignResult) -> Document:
    """The report of a design."""
    kept = joined([axis(name) for name in result.plant.axes])
    return document_of(
        result.design.title,
        f"Design report: {kept} of the rig {result.rig.name}",
        result.provenance,
        (make(result) for make in SECTIONS),
        "The same inputs, seed, library versions and processor give the same figures; otherwise round-off may change "
        "the course of the D-K iteration.",
    )
