"""The gap before and after adding effects: residual over noise, frequency responses, and the stages."""

from __future__ import annotations

import textwrap

import numpy as np

from avis_ctrl.gap.result import Gap, HeatMap
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Piece, Section, Table, section, table
from avis_ctrl.report.figures import (
    STYLES,
    Axis,
    Curve,
    Figure,
    Panel,
    Style,
    bars,
    hertz,
    level,
    log_limits,
    places,
    steps,
)
from avis_ctrl.report.gap import wording
from avis_ctrl.report.response_panels import difference, drives, magnitude
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.gap import GapFinding
from avis_ctrl.study.gap_overlay import BESIDE, GapOverlay, gap_overlay
from avis_ctrl.summary import joined

BEFORE, AFTER, NOISE = Style("#d55e00", "dash", 1.8), Style("#0072b2", "solid", 2.0), Style("#7a7a7a", "dot", 1.6)


def before_after(found: GapFinding) -> Section:
    """Errors on held-out data as figures and numbers, and measured responses compared with both models."""
    gap = found.gap
    seen = gap_overlay(found.measured, gap.baseline, gap.updated)
    hum = any(one.name == "mains_hum" for one in (*gap.effects, *gap.traces))
    return section(
        "The gap before and after" if gap.effects else "The gap",
        "before_after",
        spectrum(gap.heat, bool(gap.effects)) if gap.heat is not None else None,
        _stages(gap),
        Paragraph(seen, "note") if isinstance(seen, str) else responses(seen, bool(gap.effects), hum),
    )


def spectrum(heat: HeatMap, named: bool) -> Figure:
    """Residual power over noise power by frequency: mean of all channels, and worst channel."""
    edges, panels = heat.bands_Hz, []
    sides = [("re-identified", heat.before, BEFORE)] + ([("updated", heat.after, AFTER)] if named else [])
    for title, reduce in (("Mean", np.ma.mean), ("Worst output and record", np.ma.max)):
        curves = []
        for label, values, style in sides:
            reduced = np.ma.filled(reduce(np.ma.masked_invalid(values), axis=1), np.nan)
            curves.append(Curve(*steps(edges, reduced), label, style))
        curves.append(level(edges[0], edges[-1], 1.0, "noise alone", NOISE))
        panels.append(Panel(hertz(), Axis("residual / noise power [-]", "log"), curves, (), title))
    return Figure(
        "gap_spectrum",
        "The gap on held-out data: power of the residual relative to that of the measured noise, by frequency band. "
        f"For a complete model the mean is 1, and the largest of the {heat.before.shape[1]} values, one per output "
        "and record, a little more. Where it is far below 1, the noise is overestimated.",
        panels,
        2,
        0.95,
    )


def ladder(gap: Gap) -> Figure:
    """Error of each stage as a bar, and the error due to noise alone as a line."""
    values = np.array([100 * one.nrmse for one in gap.stages])
    letters = min(SETTINGS.stage_letters, SETTINGS.page_letters // len(gap.stages))
    place, axis = places(
        [textwrap.fill(rung(one.name, k), letters, break_long_words=False) for k, one in enumerate(gap.stages)]
    )
    noise = 100 * gap.noise_nrmse
    low, high = log_limits(np.append(values, noise), 1 / 1.5, 1.6, (0.1, 100.0))
    limits = float(10 ** np.floor(np.log10(low))), high
    errors = bars(place, np.where(values > 0, values, np.nan), "error of the model", Style("#8fbbdc"), 0.6)
    lines = [level(-0.5, len(values) - 0.5, noise, "noise alone", STYLES["limit"])] if noise > 0 else []
    return Figure(
        "ladder",
        "Normalised r.m.s. error of each stage on held-out data, and that of the noise alone. Logarithmic scale.",
        [Panel(axis, Axis("n.r.m.s. error [%]", "log", limits), [errors, *lines])],
        height=0.7,
    )


def rung(name: str, k: int) -> str:
    """Name of a stage under its bar; an added effect has a plus."""
    return name if name in ("nominal", "re-identified") or k == 0 else f"+ {wording.titled(name)}"


def _stages(gap: Gap) -> Table:
    noise = gap.noise_nrmse
    over = [one.nrmse / noise if noise > 0 else np.nan for one in gap.stages]
    rows = [
        (rung(one.name, k), words.percent(one.nrmse), words.number(over[k]), words.number(one.chi2_per_dof, 4))
        for k, one in enumerate(gap.stages)
    ]
    if np.isfinite(noise):
        rows.append(("noise alone", words.percent(noise), "1", "1"))
    return table(
        "All models but the nominal one are fitted to the same records; the figures are those of held-out data: "
        f"{gap.held_out}. n.r.m.s. error: r.m.s. of the residual over that of the measured outputs, in which the "
        "resonances of the suspension dominate. Chi-square: each line is divided by its noise, so that a weak "
        "resonance at high frequency counts as well.",
        ("stage", "n.r.m.s. error", "error / noise", "chi-square / dof"),
        rows,
    )


def responses(seen: GapOverlay, named: bool, hum: bool = False) -> list[Piece]:
    """Description and figure of the input-output pairs that disagree most. hum : whether the records contain hum."""
    pairs, who = worst_pairs(seen), "updated" if named else "re-identified"
    text = (
        f"The figure shows the {len(pairs)} paths with the largest error of the re-identified model, in standard "
        "deviations of the measured response; each path has a different output. Points: frequency responses from "
        f"records {', '.join(seen.records)}, some of which were fitted; {seen.method}."
    )
    if seen.method.startswith(BESIDE):
        text += (
            " These records are too few to separate the drives without a model. The points are therefore the linear "
            f"part of the {who} model plus its residual, regressed on the inputs in windows of spectral lines. An "
            "error narrower than a window is visible only in the figure of the gap by frequency."
        )
    if seen.simulated:
        have = "has" if len(seen.simulated) == 1 else "have"
        text += (
            f" {joined(list(map(wording.titled, seen.simulated))).capitalize()} {have} no frequency response. The "
            f"response of the {who} model is therefore estimated in the same way from a simulation of these records."
        )
    if hum:
        text += " Peaks at multiples of the mains frequency are hum, which these records still contain."
    if seen.left_out:
        names = joined(list(map(wording.titled, seen.left_out)))
        text += (
            f" The response of the updated model is drawn without {names}, because effects that depend on amplitude "
            "or time have no frequency response."
        )
    points = (
        f"the {who} model's response plus its residual, regressed on the inputs (points)"
        if seen.method.startswith(BESIDE)
        else "measured (points)"
    )
    models = [("re-identified", seen.baseline, BEFORE)] + ([("updated", seen.updated, AFTER)] if named else [])
    panels = [draw(seen, i, j, models) for i, j in pairs for draw in (magnitude, difference)]
    figure = Figure(
        "gap_responses",
        f"Left: magnitude, {points} with a band of two standard deviations to "
        "each side. Right: magnitude of the complex difference between measured and model; with noise "
        "alone 86 % of the values lie below the dotted line.",
        panels,
        2,
        0.68,
    )
    return [Paragraph(text), figure]


def worst_pairs(seen: GapOverlay) -> list[tuple[int, int]]:
    """The worst outputs, each with its worst input, by mean squared error of the re-identified model over variance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.abs(seen.measured - seen.baseline) ** 2 / seen.measured_std**2
    size = np.mean(np.where(np.isfinite(far), far, 0.0), axis=0)
    best = [(i, max(drives(seen), key=lambda j: size[i, j])) for i in range(len(seen.outputs))]
    return sorted(best, key=lambda pair: -size[pair])[: SETTINGS.worst_outputs]
