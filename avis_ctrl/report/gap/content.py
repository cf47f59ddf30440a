"""Contents of the gap report, independent of the renderer."""

from __future__ import annotations

from avis_ctrl.report.gap.before_after import before_after
from avis_ctrl.report.gap.candidates import candidates
from avis_ctrl.report.gap.controller import controller
from avis_ctrl.report.gap.dependence import dependence
from avis_ctrl.report.gap.effects import parameters
from avis_ctrl.report.gap.method import method
from avis_ctrl.report.gap.opening import opening
from avis_ctrl.report.gap.places import places
from avis_ctrl.report.gap.remaining import remaining
from avis_ctrl.report.identification.gates import gates
from avis_ctrl.report.pieces import Document, Section, document_of
from avis_ctrl.report.records import records, remarks
from avis_ctrl.report.sections.provenance import provenance_table
from avis_ctrl.study.gap import GapFinding


def measurement(found: GapFinding) -> Section:
    """The records, and their division into fitted and held-out ones."""
    use = {one.name: "held out" if one.held_out else "fitted" for one in found.gap.records}
    return Section(
        "Measurement",
        "measurement",
        (records(found.measured, use, f"Held out: {found.gap.held_out.rstrip('.')}"), *remarks(found.measured)),
    )


def document(found: GapFinding) -> Document:
    """The report of a gap."""
    sections = [make(found) for make in (opening, before_after, places, dependence, parameters, candidates, remaining)]
    sections += [part for part in (controller(found),) if part is not None]
    sections += [measurement(found), gates(found.findings), method(found.gap)]
    told = {"seed": found.gap.seed, "seconds": found.gap.seconds, **found.provenance}
    sections.append(
        provenance_table(
            told, "The same measurement, rig, options, seed, library versions and processor give the same figures."
        )
    )
    return document_of(
        f"Gap between simulation and measurement of the rig {found.gap.baseline.rig.name}",
        "Where they disagree, and which effects the model misses",
        found.provenance,
        sections,
    )
