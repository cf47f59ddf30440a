"""Contents of the report of `avis gap-axis`."""

from __future__ import annotations

from collections.abc import Mapping

from avis_ctrl.gap.axis.result import AxisGap
from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.report import words
from avis_ctrl.report.gap import wording
from avis_ctrl.report.gap.opening import named
from avis_ctrl.report.identification.gates import figure_of
from avis_ctrl.report.pieces import Bullets, Document, Paragraph, Piece, Section, Table, document_of, table
from avis_ctrl.report.sections.provenance import provenance_table


def document(gap: AxisGap, source: str, provenance: Mapping[str, object]) -> Document:
    """The report of the gap of a single-axis model. source : name of the measurement."""
    told = {"seconds": round(gap.seconds, 2), **provenance}
    return document_of(
        f"Gap between a model of one axis and its measurement: {gap.kind}",
        f"Measurement: {source}",
        told,
        (
            _summary(gap),
            _model(gap),
            _remaining(gap),
            provenance_table(told, "The same measurement, options and library versions give the same figures."),
        ),
    )


def _summary(gap: AxisGap) -> Section:
    first, *rest = gap.sentences
    rows = [
        (
            wording.titled(one.name),
            words.percent(one.nrmse),
            "not computed" if one.chi2_per_dof is None else words.number(one.chi2_per_dof, 4),
        )
        for one in gap.stages
    ]
    pieces: list[Piece] = [
        wording.verdict(f"Verdict: {gap.verdict}. {first}", gap.verdict),
        table(
            "Error of each model on data that no fit has used, r.m.s., relative to the measured signal. Each row "
            "adds an effect to the model of the row above.",
            ("model", "error", "chi-square / dof"),
            rows,
        ),
        figure_of("ladder", "The gap before and after each effect.", gap.pictures[:1], height=0.7),
    ]
    if gap.effects or gap.traces:
        pieces.append(named(gap, ""))
    if gap.next_experiment:
        pieces.append(Paragraph(f"What would distinguish them: {wording.said(gap.next_experiment)}"))
    return Section("Summary", "finding", (*pieces, Bullets(tuple(map(wording.said, rest)))), alone=True)


def _model(gap: AxisGap) -> Section:
    pieces: list[Piece] = [
        _values(
            "Parameters of the updated model without its effects, with one standard deviation.",
            {**gap.parameters, **gap.ratios},
        )
    ]
    if gap.runners_up:
        pieces.append(
            table(
                "What else was fitted in the place of an effect.",
                ("effect", "in the place of", "probability"),
                [
                    (wording.titled(one.name), wording.titled(one.instead_of), wording.probability(one.probability))
                    for one in gap.runners_up
                ],
                "llr",
            )
        )
    return Section("The updated model", "model", tuple(pieces))


def _remaining(gap: AxisGap) -> Section:
    rows = [
        (
            f"{words.number(one['from_Hz'])} to {words.number(one['to_Hz'])} Hz",
            str(one["output"]),
            words.percent(one["share"]),
        )
        for one in gap.where
    ]
    return Section(
        "What remains",
        "remaining",
        (
            Paragraph(
                f"The residual on held-out data is {words.percent(gap.stages[-1].nrmse)} of the signal, r.m.s.; "
                f"its power beyond noise is {words.percent(gap.share_left)} of that of the base model."
            ),
            table(
                "Where most of the residual lies, as a fraction of its power.",
                ("band", "output", "fraction"),
                rows,
                "llr",
            ),
            figure_of("lines", "Residual of the base model and of the updated model.", gap.pictures[1:2]),
        ),
    )


def _values(caption: str, values: Mapping[str, Reported]) -> Table:
    return table(caption, ("parameter", "value"), [(name, wording.quantity(p)) for name, p in values.items()])
