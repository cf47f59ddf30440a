"""Contents of the report of `avis gap-axis`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avis_ctrl.gap.axis.result import AxisGap
from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Document, Paragraph, Section, listed, section, table
from avis_ctrl.report.gap import wording
from avis_ctrl.report.gap.summary import named
from avis_ctrl.report.identification.gates import figure_of
from avis_ctrl.report.provenance import document_of


def document(gap: AxisGap, source: str, provenance: Mapping[str, object]) -> Document:
    """The report of the gap of a single-axis model. source : name of the measurement."""
    return document_of(
        f"Gap between a model of one axis and its measurement: {gap.kind}",
        f"Measurement: {source}",
        {"seconds": round(gap.seconds, 2), **provenance},
        (_summary(gap), _model(gap), _remaining(gap)),
        "The same measurement, options and library versions give the same figures.",
    )


def _summary(gap: AxisGap) -> Section:
    (first, *rest), further = gap.sentences, gap.next_experiment
    return section(
        "Summary",
        "finding",
        wording.verdict(f"Verdict: {gap.verdict}. {first}", gap.verdict),
        listed(
            "Error of each model on data that no fit has used, r.m.s., relative to the measured signal. These data "
            "also helped to decide which effects are named. Each row adds an effect to the model of the row above.",
            gap.stages,
            {
                "model": lambda one: wording.titled(one.name),
                "error": lambda one: words.percent(one.nrmse),
                "chi-square / dof": lambda one: words.number(one.chi2_per_dof, 4),
            },
        ),
        figure_of("ladder", "The gap before and after each effect.", gap.pictures[:1], height=0.7),
        named(gap, ""),
        Paragraph(f"What to measure next: {words.sentence(further)}") if further else None,
        Bullets(list(map(words.sentence, rest))),
        alone=True,
    )


def _model(gap: AxisGap) -> Section:
    values = table(
        "Parameters of the updated model without its effects, with one standard deviation.",
        ("parameter", "value"),
        [(name, wording.quantity(p)) for name, p in {**gap.parameters, **gap.ratios}.items()],
    )
    others = listed(
        "Alternatives to the named effects.",
        gap.runners_up,
        {
            "effect": lambda one: wording.titled(one.name),
            "alternative to": lambda one: wording.titled(one.instead_of),
            "probability": lambda one: wording.probability(one.probability),
        },
        "llr",
    )
    return section("The updated model", "model", values, others)


def _remaining(gap: AxisGap) -> Section:
    beyond = " beyond noise" if np.isfinite(gap.stages[-1].chi2_per_dof) else ""  # nan if the noise is unknown
    residual = Paragraph(
        f"The residual on held-out data is {words.percent(gap.stages[-1].nrmse)} of the signal, r.m.s.; "
        f"its power{beyond} is {words.percent(gap.left.share)} of that of the base model."
    )
    where = listed(
        "Where most of the residual lies, as a fraction of its power.",
        gap.remaining,
        {
            "band": lambda one: f"{words.number(one.from_Hz)} to {words.number(one.to_Hz)} Hz",
            "output": lambda one: one.output,
            "fraction": lambda one: words.percent(one.share),
        },
        "llr",
    )
    lines = figure_of("lines", "Residual of the base model and of the updated model.", gap.pictures[1:2])
    return section("What remains", "remaining", residual, where, lines)
