"""Contents of the gap report, independent of the renderer."""

from __future__ import annotations

from avis_ctrl.report.elements import Document, Section, section
from avis_ctrl.report.gap.before_after import before_after
from avis_ctrl.report.gap.candidates import candidates
from avis_ctrl.report.gap.controller import controller
from avis_ctrl.report.gap.effects import parameters
from avis_ctrl.report.gap.level_and_time import dependence
from avis_ctrl.report.gap.places import places
from avis_ctrl.report.gap.remaining import remaining
from avis_ctrl.report.gap.summary import opening
from avis_ctrl.report.identification.gates import gates
from avis_ctrl.report.method import method
from avis_ctrl.report.provenance import document_of
from avis_ctrl.report.records import records, remarks
from avis_ctrl.study.gap import GapFinding


def measurement(found: GapFinding) -> Section:
    """The records, and their division into fitted and held-out ones."""
    use = {one.name: "held out" if one.held_out else "fitted" for one in found.gap.records}
    table = records(found.measured, use, f"Held out: {found.gap.held_out.rstrip('.')}")
    return section("Measurement", "measurement", table, remarks(found.measured))


def document(found: GapFinding) -> Document:
    """The report of a gap."""
    parts = (opening, before_after, places, dependence, parameters, candidates, remaining)
    sections = [make(found) for make in parts] + ([controller(found.design)] if found.design is not None else [])
    sections += [measurement(found), gates(found.findings), method("gap", held_out=found.gap.held_out.rstrip("."))]
    return document_of(
        f"Gap between simulation and measurement of the rig {found.gap.baseline.rig.name}",
        "Where they disagree, and which effects the model misses",
        {"seed": found.gap.seed, "seconds": found.gap.seconds, **found.provenance},
        sections,
    )
