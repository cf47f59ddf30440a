"""What the report of `avis gap-axis` says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from avis_ctrl.gap.axis.result import AxisGap
from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.result import NamedEffect, spoken
from avis_ctrl.report.identification.gate_figures import figure_of
from avis_ctrl.report.pieces import Bullets, Document, Paragraph, Piece, Section, table
from avis_ctrl.report.sections.provenance import provenance_table, stamp_of


def document(gap: AxisGap, source: str, provenance: Mapping[str, object]) -> Document:
    """The report of a gap of one axis; source : name of the measurement."""
    told = {"seconds": round(gap.seconds, 2), **provenance}
    return Document(f"Gap between a model of one axis and its measurement: {gap.kind}", f"Measurement: {source}",
                    stamp_of(told), (_finding(gap), _effects(gap), _model(gap), _remaining(gap),
                                     provenance_table(told, "With the same measurement, options and library versions "
                                                            "the same figures come out.")))


def _finding(gap: AxisGap) -> Section:
    first, *rest = gap.sentences
    good, half = gap.verdict in ("none", "explained"), gap.verdict == "partly explained"
    rows = [(one.name, f"{100 * one.nrmse:.3g} %", "-" if one.chi2_per_dof is None else f"{one.chi2_per_dof:.4g}")
            for one in gap.stages]
    return Section("What was found", "finding", (
        Paragraph(f"Verdict: {gap.verdict}. {first}", "verdict", good, half), Bullets(tuple(rest)),
        table("Error of each model on data that no fit has used, r.m.s., relative to the measured signal.",
              ("model", "error", "chi-square per degree of freedom"), rows),
        figure_of("ladder", "The gap before and after each effect.", gap.pictures[:1])))


def _effects(gap: AxisGap) -> Section:
    pieces: list[Piece] = []
    for caption, several in (("Named effects, the largest fraction of the gap first.", gap.effects),
                             ("Traces, below 1 % of the gap each.", gap.traces)):
        if several:
            rows = [(one.name, one.location, _sizes(one), f"{one.probability:.2f}", f"{100 * (one.share or 0):.3g} %",
                     ", ".join(one.indistinguishable_from) or "-") for one in several]
            pieces.append(table(caption, ("effect", "place", "size", "probability", "fraction of the gap", "or"), rows,
                                "lllrrl"))
    if gap.runners_up:
        pieces.append(table("What else was fitted in the place of an effect.",
                            ("effect", "in the place of", "probability"),
                            [(one.name, one.instead_of, f"{one.probability:.2g}") for one in gap.runners_up], "llr"))
    if gap.next_experiment:
        pieces.append(Paragraph(f"What would distinguish them: {gap.next_experiment}."))
    return Section("Effects", "effects", tuple(pieces) or (Paragraph("None is named."),))


def _model(gap: AxisGap) -> Section:
    pieces = [_values("Parameters of the updated model without its effects.", gap.parameters)]
    if gap.ratios:
        pieces.append(_values("Ratios.", gap.ratios))
    return Section("The updated model", "model", tuple(pieces))


def _remaining(gap: AxisGap) -> Section:
    rows = [(f"{one['from_Hz']:.3g} to {one['to_Hz']:.3g} Hz", str(one["output"]), f"{100 * one['share']:.3g} %")
            for one in gap.where]
    return Section("What remains", "remaining", (
        Paragraph(f"The residual on held-out data is {100 * gap.stages[-1].nrmse:.3g} % of the signal, r.m.s.; its "
                  f"power beyond noise is {100 * gap.share_left:.3g} % of that of the base model."),
        table("Where most of it lies.", ("band", "output", "fraction"), rows, "llr"),
        figure_of("lines", "Residual of the base model and of the updated model.", gap.pictures[1:2])))


def _sizes(one: NamedEffect) -> str:
    return ", ".join(f"{spoken(name, p.unit)} {p}" for name, p in one.parameters.items())


def _values(caption: str, values: Mapping[str, Reported]) -> Piece:
    rows: Sequence[tuple[str, str]] = [(name, str(p)) for name, p in values.items()]
    return table(caption, ("parameter", "value"), rows)
