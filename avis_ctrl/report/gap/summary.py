"""Summary page: the verdict in one sentence, the numbers behind it, and a table of the named effects."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.axis.result import AxisGap
from avis_ctrl.gap.result import Gap
from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Paragraph, Section, Table, listed, section
from avis_ctrl.report.gap import wording
from avis_ctrl.report.gap.before_after import ladder
from avis_ctrl.report.gap.remaining import next_step
from avis_ctrl.report.identification.gates import warnings
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.gap import GapFinding
from avis_ctrl.summary import joined

CHANCES = (
    " The probability is relative to the candidates fitted in its place, including some faults outside the library; "
    "no value above 99 % is reported. For hum, a converter and floor motion it is a confidence level: one minus the "
    "p-value of "
    "the test that the signal is absent."
)


def opening(found: GapFinding) -> Section:
    """Verdict, the gap in numbers, named effects."""
    gap = found.gap
    first, *more = map(words.sentence, gap.sentences)
    limits = "The section on the residual lists the detection limits of the effects."
    warned = joined(warnings(found.findings))
    gates = f"Checks of the records (gates) with warnings: {warned}; see the section on gates."
    return section(
        "Summary",
        "result",
        wording.verdict(first, gap.verdict),
        Paragraph(wording.claim(gap)),
        Paragraph(in_numbers(gap)),
        ladder(gap),
        named(gap, CHANCES),
        [Paragraph(wording.rivals(one, gap)) for one in gap.effects if one.indistinguishable_from],
        Paragraph(limits) if gap.detectable else None,
        Bullets(more),
        Paragraph(f"What to measure next: {next_step(found)}"),
        Paragraph(gates, "note") if warned else None,
        alone=True,
    )


def in_numbers(gap: Gap) -> str:
    """Error of each stage on held-out data, compared with that of noise alone."""
    told = [f"{words.percent(one.nrmse)} {_stage(one.name)}" for one in gap.stages]
    text = f"Normalised r.m.s. error on held-out data: {joined(told)}"
    if np.isfinite(gap.noise_nrmse):
        text += f"; that of the noise alone is estimated at {words.percent(gap.noise_nrmse)}"
    first = next(one.nrmse for one in gap.stages if one.name == "re-identified")
    last = gap.stages[-1].nrmse
    if gap.effects and first > 0 and last > 0:
        text += f". With the effect{'s' * (len(gap.effects) > 1)} the error is "
        text += f"{words.number(first / last)} times smaller than that of the re-identified model"
        if gap.noise_nrmse > 0:
            text += f", and {words.number(last / gap.noise_nrmse)} times the noise"
    return text + "."


def _stage(name: str) -> str:
    return {
        "nominal": "with the values of the rig file",
        "re-identified": "after re-identification",
        "tolerances": "with all rig values fitted",
    }.get(name, f"with {wording.titled(name)}")


def named(gap: Gap | AxisGap, remark: str) -> Table:
    """The named effects with their sizes, traces (very small effects) last. remark : on their probabilities."""
    return listed(
        "Named effects, with one standard deviation. Fraction of the gap: the increase of the residual power on "
        "held-out "
        "data when only this effect is removed, without a new fit, divided by the residual power beyond noise of the "
        "model without effects. The fractions need not add up to 100 %. (Where structural damping is removed, viscous "
        "damping equal to it at the suspension resonances takes its place.) Effects below 1 % are called "
        f"traces.{remark}",
        [*gap.effects, *gap.traces],
        {
            "effect": lambda one: f"{wording.titled(one.name)}{' (trace)' if one in gap.traces else ''}",
            "place": lambda one: one.location,
            "size": lambda one: wording.quantities(one.parameters, SETTINGS.parameters),
            "fraction of the gap": lambda one: words.percent(np.nan if one.share is None else one.share),
            "probability": lambda one: wording.probability(one.probability),
            "indistinguishable from": lambda one: ", ".join(map(wording.titled, one.indistinguishable_from)) or "none",
        },
        "lllrrl",
    )
