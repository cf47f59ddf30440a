"""Measured frequency responses compared with those of the start model and of the identified model."""

from __future__ import annotations

import numpy as np

from avis_ctrl.identification.measured_responses import ResponseOverlay
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Section, section
from avis_ctrl.report.figures import Axis, Band, Curve, Figure, Panel, Style, hertz, log_limits, markers
from avis_ctrl.report.response_panels import MEASURED, SCATTER, Model, difference, drives, magnitude, thin, title, unit
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.identification import Identification
from avis_ctrl.summary import joined

START, MODEL = Style("#e69f00", "dash", 1.6), Style("#0072b2", "solid", 1.6)


def responses(found: Identification) -> Section:
    """Large figures of the strongest input of each output, and small ones of all pairs."""
    seen = found.validation.overlay
    if seen is None:
        why = "No measured frequency response can be shown; the notes of the section on validation state the reason."
        return section("Frequency responses", "responses", Paragraph(why))
    pairs = strongest(seen)
    named = joined([f"{seen.outputs[i]} from {seen.inputs[j]}" for i, j in pairs])
    text = (
        f"Measured: {seen.method}. {words.number(100 * seen.inside)} % of the measured values lie within "
        f"their 95 % confidence region about the identified model; 95 % are expected if they differ from the model "
        f"by noise only and the estimate has no bias. Shown in full: the strongest input of each output, {named}."
    )
    points = (
        "From these records, any response estimated without a model would be smoothed at the resonances. The points "
        "are therefore the identified model's response plus the residual of the records, regressed on the inputs. A "
        "model error that is narrower than a window of lines is not visible here, but in the tests of the section on "
        "validation."
    )
    note = Paragraph(points, "note") if seen.method.startswith("response of the model") else None
    groups = [pairs[k : k + SETTINGS.response_outputs] for k in range(0, len(pairs), SETTINGS.response_outputs)]
    large = [_bode(seen, group, k) for k, group in enumerate(groups)]
    small = (_residual(seen, pairs), _overview(seen))
    return section("Frequency responses", "responses", Paragraph(text), note, large, small)


def strongest(seen: ResponseOverlay) -> list[tuple[int, int]]:
    """Each output with its input of largest gain (mean logarithm); floor inputs only if there are no drives."""
    with np.errstate(divide="ignore"):
        gain = np.mean(np.log(np.abs(seen.model)), axis=0)
    return [(i, max(drives(seen), key=lambda j: gain[i, j])) for i in range(len(seen.outputs))]


def _bode(seen: ResponseOverlay, pairs: list[tuple[int, int]], number: int) -> Figure:
    panels = [panel for i, j in pairs for panel in (magnitude(seen, i, j, _models(seen)), _phase(seen, i, j))]
    return Figure(
        f"response_{number}",
        "Magnitude (left) and phase (right): measured (points) with a band of ± 2 "
        "standard deviations, start model (dashed) and identified model (line). A band narrower than a point "
        "is not visible.",
        panels,
        2,
        0.85,
    )


def _phase(seen: ResponseOverlay, i: int, j: int) -> Panel:
    f, measured, model = seen.frequency_Hz, seen.measured[:, i, j], seen.model[:, i, j]
    base = np.unwrap(np.angle(model))
    # Phases are unwrapped relative to that of the identified model.
    shown, start = (np.rad2deg(base + np.angle(value / model)) for value in (measured, seen.start[:, i, j]))
    s = np.rad2deg(np.minimum(2 * seen.measured_std[:, i, j] / np.maximum(np.abs(measured), 1e-300), np.pi))
    keep = thin(len(f))
    curves = (
        markers(f[keep], shown[keep], "measured", MEASURED),
        Curve(f, np.rad2deg(base), "identified", MODEL),
        Curve(f, start, "start", START),
    )
    band = Band(f, shown - s, shown + s, "measured, ± 2 σ", SCATTER)
    return Panel(hertz(), Axis("phase [°]"), curves, [band], title(seen, i, j))


def _models(seen: ResponseOverlay) -> list[Model]:
    return [("identified", seen.model, MODEL), ("start", seen.start, START)]


def _residual(seen: ResponseOverlay, pairs: list[tuple[int, int]]) -> Figure:
    return Figure(
        "residuals",
        "Residual: magnitude of the complex difference between measured response and model. "
        "With noise alone, 86 % of the points are expected below the dotted line.",
        [difference(seen, i, j, _models(seen)) for i, j in pairs],
        2,
        0.75,
    )


def _overview(seen: ResponseOverlay) -> Figure:
    columns, keep = drives(seen), thin(len(seen.frequency_Hz), SETTINGS.overview_points)
    f, last = seen.frequency_Hz[keep], len(seen.outputs) - 1
    size = np.abs(np.concatenate([seen.model[:, :, columns], seen.start[:, :, columns]]))
    limits = log_limits(size, 0.7, 1.5, quantile=0.02)
    styles = {
        "measured": (seen.measured, Style("#7a7a7a", "solid", 2.6)),
        "identified": (seen.model, Style(MODEL.colour, "solid", 1.0)),
        "start": (seen.start, Style(START.colour, "dash", 1.0)),
    }
    panels = []
    for i, output in enumerate(seen.outputs):
        for j in columns:
            left, foot = j == columns[0], i == last
            curves = tuple(Curve(f, np.abs(G[keep, i, j]), label, style) for label, (G, style) in styles.items())
            x = Axis("[Hz]" if foot else "", "log", silent=not foot)
            y = Axis(output if left else "", "log", limits, silent=not left)
            panels.append(Panel(x, y, curves, (), "" if i else seen.inputs[j]))
    return Figure(
        "overview",
        f"Magnitude of every pair on the same scales [{unit(seen, columns[0])}]: inputs from "
        "left to right, outputs from top to bottom.",
        panels,
        len(columns),
        0.36,
        True,
    )
