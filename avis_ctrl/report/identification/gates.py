"""Results of the gates (automatic data checks): warnings first, passed checks in small figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from avis_ctrl.measurement.gates.finding import SEVERITIES, Finding, Limit, Picture, Series
from avis_ctrl.report.elements import Cell, Fold, Mark, Paragraph, Piece, Section, section, shown, table
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Scale, Style, numbered, values_of
from avis_ctrl.report.settings import SETTINGS

MARKS: dict[str, Cell] = {
    "not tested": "not tested",
    "ok": Mark("ok", True),
    "note": "note",
    "warning": Mark("WARNING", False),
    "stop": Mark("STOP", False),
}
LIMITS = ("#b3261e", "#7a7a7a", "#d55e00", "#222222")


def gates(findings: Sequence[Finding]) -> Section:
    """Table of all findings, and their pictures."""
    if not findings:
        none = "The gates (automatic checks of the data) need records in the time domain; there were none."
        return section("Gates", "gates", Paragraph(none))
    ordered = sorted(findings, key=lambda f: -SEVERITIES.index(f.severity))
    together = _together(ordered)
    rows = [(gate, MARKS[severity], text) for gate, severity, text in together]
    listed = [severity for _, severity, _ in together]
    counts = ", ".join(
        f"{n} {s}{'s' * (n > 1 and s not in ('ok', 'not tested'))}" for s in reversed(MARKS) if (n := listed.count(s))
    )
    pieces: list[Piece] = [
        table(
            f"The gates: automatic checks of the data before any fit, the most serious findings first ({counts}). A "
            "note is for information, a warning means less accurate results, a stop means wrong results. A gate is "
            '"not '
            'tested" if no record could show the fault.',
            ("gate", "severity", "finding"),
            rows,
            "lcl",
        )
    ]
    grave = [f for f in ordered if f.severity in ("warning", "stop")]
    for k, (picture, sentences) in enumerate(_pictures(grave)):
        pieces.append(figure_of(f"gate_{k}", " ".join(sentences), [picture]))
    notes = [p for p, _ in _pictures([f for f in ordered if f.severity == "note"])]
    well = [p for p, _ in _pictures([f for f in ordered if f.severity == "ok"])]
    small = shown(_small("gate_ok", "Gates without findings.", well))
    fold = Fold(f"The {len(well)} figures of gates without findings", small)
    return section("Gates", "gates", pieces, _small("gate_notes", "Gates with a note.", notes), fold)


def warnings(findings: Sequence[Finding]) -> list[str]:
    """Names of the gates that gave a warning, each once."""
    return list(dict.fromkeys(f.gate for f in findings if f.severity in ("warning", "stop")))


def _together(findings: Sequence[Finding]) -> list[tuple[str, str, str]]:
    """(gate, severity or "not tested", text), findings that differ only in their first sentence merged."""
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for f in findings:
        first, _, rest = f.sentence.partition(". ")
        mark = f.severity if f.tested else "not tested"
        grouped.setdefault((f.gate, mark, rest), []).append(first.rstrip("."))
    return [
        (gate, severity, f"{'; '.join(firsts)}. {rest}".rstrip()) for (gate, severity, rest), firsts in grouped.items()
    ]


def _pictures(findings: list[Finding]) -> list[tuple[Picture, list[str]]]:
    """Each picture once, with the sentences that refer to it; pictures without data are omitted."""
    seen: dict[tuple[Any, ...], tuple[Picture, list[str]]] = {}
    for finding in findings:
        p = finding.picture
        if p is None or not any(len(s.x) for s in p.series):
            continue
        key = (p.title, p.y_label, tuple((s.name, s.x.tobytes(), s.y.tobytes()) for s in p.series))
        seen.setdefault(key, (p, []))[1].append(finding.sentence)
    return list(seen.values())


def _small(name: str, caption: str, pictures: list[Picture]) -> list[Piece]:
    # Pictures with a curve per channel are kept apart: their legend would list channels that the others lack.
    many = [p for p in pictures if len(p.series) > 2]
    few = [p for p in pictures if len(p.series) <= 2]
    groups = [of[k : k + SETTINGS.gate_panels] for of in (many, few) for k in range(0, len(of), SETTINGS.gate_panels)]
    found: list[Piece] = []
    for k, group in enumerate(groups):
        part = f" Part {k + 1} of {len(groups)}." if len(groups) > 1 else ""
        dashed = " Dashed lines are limits." if any(p.limits for p in group) else ""
        found.append(figure_of(f"{name}_{k}", caption + part + dashed, group, 2, 0.75))
    return found


def figure_of(name: str, caption: str, pictures: Sequence[Picture], columns: int = 1, height: float = 1.0) -> Figure:
    """Pictures as panels of one figure; a name has the same style in all of them."""
    names = list(dict.fromkeys(s.name for p in pictures for s in p.series))
    limits = list(dict.fromkeys(one.name for p in pictures for one in p.limits))
    letters = SETTINGS.gate_letters * 2 // min(columns, len(pictures))
    return Figure(name, caption, [_panel(p, names, limits, letters) for p in pictures], columns, height)


def _panel(picture: Picture, names: Sequence[str], limits: Sequence[str], letters: int) -> Panel:
    """A picture as panel. names, limits : in the order of their styles. letters : that fit side by side under it."""
    curves = [_curve(one, Style(numbered(names.index(one.name)).colour)) for one in picture.series if len(one.x)]
    if len(picture.series) == 1:  # title and axis label suffice
        curves = [replace(curve, label="") for curve in curves]
    x = Axis(picture.x_label, _scale(picture.x_scale), ticks=_named(picture.x_names, letters))
    panel = Panel(x, Axis(picture.y_label, _scale(picture.y_scale)), curves, (), picture.title)
    colours = [LIMITS[limits.index(one.name) % len(LIMITS)] for one in picture.limits]
    lines = [_line(one, panel, Style(c, "dash", 1.3)) for one, c in zip(picture.limits, colours, strict=True)]
    return _framed(replace(panel, curves=[*curves, *lines]))


def _named(names: Sequence[str], letters: int) -> tuple[tuple[float, str], ...]:
    """Names as tick labels, staggered over enough rows that they do not overlap."""
    rows = 1 + sum(len(name) + 1 for name in names) // letters
    return tuple((float(k), "\n" * (k % rows) + name) for k, name in enumerate(names))


def _scale(text: str) -> Scale:
    return "log" if text == "log" else "linear"


def _curve(series: Series, style: Style) -> Curve:
    x, y = np.asarray(series.x, float), np.asarray(series.y, float)
    if series.style == "bars":
        width = 0.8 * float(np.min(np.diff(np.sort(x)))) if len(x) > 1 else 0.8
        return Curve(x, y, series.name, style, line=False, bars=width)
    points = series.style == "points"
    return Curve(x, y, series.name, style, points=points, line=not points)


def _line(limit: Limit, panel: Panel, style: Style) -> Curve:
    """A limit as a straight line across the data."""
    at, across = np.array([limit.value, limit.value]), np.array(_span(panel, "y" if limit.axis == "x" else "x"))
    x, y = (at, across) if limit.axis == "x" else (across, at)
    return Curve(x, y, limit.name, style)


def _span(panel: Panel, which: Literal["x", "y"]) -> tuple[float, float]:
    values = values_of(panel, which)
    values = values[np.isfinite(values) & ((values > 0) | (getattr(panel, which).scale == "linear"))]
    return (float(values.min()), float(values.max())) if values.size else (0.1, 1.0)


def _framed(panel: Panel) -> Panel:
    """A logarithmic x axis spans the data with a margin; on a linear one a few whole numbers become ticks."""
    numbers = np.unique(values_of(panel, "x"))
    if panel.x.scale == "log":
        low, high = _span(panel, "x")
        return replace(panel, x=replace(panel.x, range=(low / 1.1, high * 1.1)))
    if not panel.x.ticks and 0 < numbers.size <= 16 and np.all(numbers == np.round(numbers)):
        return replace(panel, x=replace(panel.x, ticks=tuple((float(v), f"{v:g}") for v in numbers)))
    return panel
