"""Dependence of the residual on level and time, and coherence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avis_ctrl.gap.result import Gap, PowerShares, RecordGap
from avis_ctrl.report import words
from avis_ctrl.report.elements import Fold, Paragraph, Piece, Section, Table, headed, section, shown, table
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, hertz, level, log_limits, markers, steps
from avis_ctrl.report.gap.before_after import AFTER, BEFORE, NOISE
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.gap import GapFinding

# Of each part of the power: label and style of its curve, and header of its column.
LOOKS = {
    "model": ("model, linear in measured inputs", Style("#222222", "solid", 1.4), "model"),
    "missing": ("linear, missing from the model", Style("#d55e00", "dash", 1.8), "linear, not in the model"),
    "nonlinear": ("not linear (amplitude, time)", Style("#009e73", "solid", 1.8), "not linear"),
    "unmeasured": ("unmeasured inputs", Style("#0072b2", "dashdot", 1.6), "unmeasured inputs"),
    "sensors": ("sensors' own noise", Style("#7a7a7a", "dot", 1.6), "sensors' noise"),
}
HOW = {
    "silent": "Noise and unmeasured inputs are measured on lines where the drives are silent; any power of the "
    "excited lines beyond this and beyond a linear response is counted as not linear.",
    "levels": "The drives excite every line, so noise cannot be measured by itself. At the lowest level, what "
    "remains after the linear response and the model's own nonlinear terms counts as noise and unmeasured inputs, "
    "which do not grow with the drives; this includes nonlinearity that is not in the model. Whatever is larger at a "
    "higher level counts as not linear.",
    "one level": "With a single level and no lines where the drives are silent, noise cannot be distinguished from "
    'nonlinearity that is not in the model. "Not linear" then contains only the model\'s own nonlinear terms; '
    'everything else that is not linear in the drives counts as "unmeasured inputs".',
}


def dependence(found: GapFinding) -> Section:
    """The residual of each record by level and by time, and the decomposition of the power of the outputs."""
    gap = found.gap
    no_shares = "No fractions of power were computed: the driven records have too few lines for their inputs."
    heading = "Coherence: what noise, nonlinearity and unmeasured inputs account for"
    decomposed = coherence(gap.shares) if gap.shares else Paragraph(no_shares, "note")
    return section("Level, time and coherence", "dependence", by_record(gap), headed(heading, decomposed))


def by_record(gap: Gap) -> Figure:
    """Residual over noise of every record, by level and by time; filled markers for held-out records."""
    panels = (
        _panel(gap, "By level", "level of the drives, r.m.s. [V]", lambda one: one.level_V),
        _panel(gap, "By time", "start of the record, time [s]", lambda one: one.start_s),
    )
    return Figure(
        "gap_records",
        "Residual of each record, relative to the noise. Filled: held-out records; open: fitted. A missing linear "
        "effect gives an error in proportion to the level. An error that is the same at every level is noise or "
        "unmeasured floor motion; one that grows in any other way depends on amplitude. A slope over time at one "
        "level is drift. The values are the root of chi-square per degree of freedom, on lines selected at random "
        "and dense near resonances; it differs from the ratio of error and noise in the table of stages.",
        panels,
        2,
        0.85,
    )


def _panel(gap: Gap, title: str, x: str, of: Callable[[RecordGap], float]) -> Panel:
    sides: list[tuple[str, Style, Callable[[RecordGap], float]]] = [("re-identified", BEFORE, lambda one: one.before)]
    if gap.effects:
        sides.append(("updated", AFTER, lambda one: one.after))
    curves = []
    for label, style, value in sides:
        for held, word in ((False, "fitted"), (True, "held out")):
            some = [one for one in gap.records if one.held_out == held]
            curves.append(
                markers(
                    np.array([of(one) for one in some]),
                    np.array([value(one) for one in some]),
                    f"{label}, {word}",
                    Style(style.colour),
                    hollow=not held,
                )
            )
    low, high = _limits([of(one) for one in gap.records])
    curves.append(level(low, high, 1.0, "noise alone", NOISE))
    values = np.array([1.0, *(v for one in gap.records for v in (one.before, one.after))])
    y = Axis("residual / noise, r.m.s. [-]", "log", log_limits(values, 1 / 1.5, 1.5))
    return Panel(Axis(x, "linear", (low, high)), y, curves, (), title)


def _limits(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - room, high + room


def coherence(shares: tuple[PowerShares, ...]) -> tuple[Piece, ...]:
    """Decomposition of the power at the highest level as figure and table, and at the lowest level in a fold."""
    lowest, top = shares[0], shares[-1]
    low = (figure(lowest, "gap_coherence_lowest"), _whole(lowest)) if len(shares) > 1 else ()
    pieces = (Paragraph(_explained(top)), figure(top, "gap_coherence"), _whole(top))
    return shown(pieces, Fold("The same at the lowest level", low))


def _explained(one: PowerShares) -> str:
    unknown = (
        ""
        if "sensors" in one.shares
        else (" The sensors' own noise is not known by itself and counts as unmeasured inputs.")
    )
    narrow = float(np.min(np.diff(one.bands_Hz)))
    return (
        f"Multiple coherence is the sum of the first two parts, those that are linear. {HOW[one.how]}{unknown} "
        "The linear part is the response of the model with smooth corrections and, if they fit much better, up to two "
        f"shifted poles in each band. A model error narrower than a band (at least {words.number(narrow, 2)} Hz) is "
        "partly counted as not linear."
    )


def figure(one: PowerShares, name: str) -> Figure:
    """One panel per output, with fractions of its power on a logarithmic axis."""
    edges = np.asarray(one.bands_Hz, float)
    drawn = {
        key: np.where(np.isfinite(share) & (share > SETTINGS.least_power), share, np.nan)
        for key, share in one.shares.items()
    }
    positive = np.concatenate([share[np.isfinite(share)] for share in drawn.values()])
    low = float(10 ** np.floor(np.log10(positive.min(initial=0.1))))
    y = Axis("fraction of the power [-]", "log", (low, 2.0))
    panels = []
    for k, output in enumerate(one.outputs):
        looks = [(drawn[key][:, k], look) for key, look in LOOKS.items() if key in drawn]
        curves = [Curve(*steps(edges, share), label, style) for share, (label, style, _) in looks]
        panels.append(Panel(hertz(), y, curves, (), output))
    return Figure(
        name,
        f"What accounts for the power of each output at {words.number(one.level_V)} V r.m.s. "
        f"({one.excitation}, records {', '.join(one.records)}), by frequency; the fractions of a band add up to 1. A "
        "line that ends is below what can be determined.",
        panels,
        2,
        0.72,
    )


def _whole(one: PowerShares) -> Table:
    """Fractions of the power over all bands together."""
    keys = [key for key in LOOKS if key in one.whole]
    rows = [
        (output, *(_part(float(one.whole[key][k]), 5 if key == "model" else 2) for key in keys))
        for k, output in enumerate(one.outputs)
    ]
    return table(
        f"The whole band at {words.number(one.level_V)} V: fractions of each output's power, most of which lies at "
        "the resonances; 0.01 % of the power is 1 % r.m.s. Unmeasured inputs and sensors' noise together are what "
        "other sections call noise. A linear error has the same fraction at every level.",
        ("output", *(LOOKS[key][2] for key in keys)),
        rows,
        "l" + "r" * len(keys),
    )


def _part(fraction: float, digits: int) -> str:
    """A fraction of the power in per cent; it is zero where nothing significant was found."""
    return "none found" if fraction == 0 else words.percent(fraction, digits)
