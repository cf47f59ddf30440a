"""Validation of the identified model on held-out data."""

from __future__ import annotations

import numpy as np

from avis_ctrl.identification.validation import HeldOut
from avis_ctrl.identification.whiteness import Correlation
from avis_ctrl.report import words
from avis_ctrl.report.elements import (
    Bullets,
    Paragraph,
    Piece,
    Section,
    Table,
    listed,
    section,
    shown,
    table,
    yes_or_no,
)
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, bars, log_limits, markers, numbered, places
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.identification import Identification

BEFORE, AFTER, FLOOR = Style("#e69f00"), Style("#0072b2"), Style("#7a7a7a")


def validation(found: Identification) -> Section:
    """Chi-square, errors, whiteness and modes."""
    v = found.validation
    drawn = v.held_out[: SETTINGS.held_out]
    left_out = (
        f"Figures are shown for the first {len(drawn)} of {len(v.held_out)} held-out records and pieces; the table "
        "lists all."
    )
    return section(
        "Validation",
        "validation",
        Paragraph(words.sentence(v.verdict), "verdict", v.passed),
        _records(found),
        [_record(one, v.outputs, k) for k, one in enumerate(drawn)],
        Paragraph(left_out, "note") if len(v.held_out) > len(drawn) else None,
        _measured_modes(found),
        Bullets(tuple(dict.fromkeys(map(words.sentence, (*v.sentences[1:], *v.notes))))),
    )


def _record(one: HeldOut, outputs: tuple[str, ...], number: int) -> tuple[Piece, ...]:
    """Figures and table of a held-out record; the errors of the first one are in the summary."""
    bars_of_errors = errors(one, outputs) if number else None
    return shown(_chi_square(one, outputs), bars_of_errors, _nrms(one, outputs), _whiteness(one))


def _records(found: Identification) -> Table:
    noise = "; ".join(dict.fromkeys(one.noise for one in found.validation.held_out))
    return listed(
        "Chi-square per degree of freedom of the held-out data, with its 95 % interval for a residual that is "
        f'due only to noise and parameter uncertainty. Noise: {noise}. "Local noise" is the same chi-square '
        "with the noise covariance of a local polynomial model, which contains no error of the rig's model.",
        found.validation.held_out,
        {
            "record": lambda one: one.name,
            "lines": lambda one: str(one.lines),
            "chi-square": lambda one: words.number(one.chi2_per_dof, 4),
            "expected": lambda one: "{:.4f} to {:.4f}".format(*one.chi2_interval),
            "start model": lambda one: words.number(one.chi2_start, 4),
            "local noise": lambda one: "none" if np.isnan(one.chi2_local) else words.number(one.chi2_local, 4),
            "consistent": lambda one: yes_or_no(one.consistent),
            "white": lambda one: "not tested" if one.whiteness is None else yes_or_no(one.whiteness.white),
        },
        "lrrrrrcc",
    )


def _chi_square(one: HeldOut, outputs: tuple[str, ...]) -> Figure:
    x, axis = places(outputs, "output")
    low, high = one.output_chi2_interval.T
    curves = (
        markers(x, (low + high) / 2, "95 % interval", FLOOR, error=(high - low) / 2),
        markers(x, one.output_chi2_per_dof, "held-out data", AFTER),
    )
    return Figure(
        f"chi_square_{one.name}",
        f"Chi-square per degree of freedom of each output, record {one.name}, with its interval.",
        [Panel(axis, Axis("chi-square / dof [-]"), curves)],
        height=0.8,
    )


def errors(one: HeldOut, outputs: tuple[str, ...]) -> Figure:
    """Normalised r.m.s. error of each output as bars."""
    x, axis = places(outputs, "output")
    values = [100 * v for v in (one.nrms_start, one.nrms, one.nrms_floor)]
    curves = (
        bars(x - 0.26, values[0], "start model", BEFORE, 0.24),
        bars(x, values[1], "identified model", AFTER, 0.24),
        bars(x + 0.26, values[2], "noise alone", FLOOR, 0.24),
    )
    limits = log_limits(np.concatenate(values), 1 / 3, 2, (0.01, 100.0))
    return Figure(
        f"nrms_{one.name}",
        f"Normalised r.m.s. error of each output in the band, record {one.name}: error "
        "divided by output, with the transient of the record removed. Logarithmic.",
        [Panel(axis, Axis("n.r.m.s. error [%]", "log", limits), curves)],
        height=0.9,
    )


def _nrms(one: HeldOut, outputs: tuple[str, ...]) -> Table:
    columns = {
        "start": one.nrms_start,
        "identified": one.nrms,
        "noise alone": one.nrms_floor,
        "in time, start": one.nrms_time_start,
        "in time, identified": one.nrms_time,
        "in time, no filter": one.nrms_time_whole,
    }
    shown = [
        len(outputs) * ["none"] if values is None else list(map(words.percent, values)) for values in columns.values()
    ]
    note = f" In time: {one.time_note}." if one.time_note else ""
    return table(
        f"Normalised r.m.s. errors of record {one.name}, on the spectral lines of the band and in time.{note}",
        ("output", *columns),
        list(zip(outputs, *shown, strict=True)),
    )


def _whiteness(one: HeldOut) -> Figure | None:
    if one.whiteness is None:
        return None
    return Figure(
        f"whiteness_{one.name}",
        f"Correlations of the residual of each output in record {one.name}; the largest "
        "over the inputs if there are several. With noise alone, at least one of the limits (dashed) is "
        "exceeded in 1 % of all validations.",
        list(map(_correlation, one.whiteness.correlations)),
        height=0.55,
    )


def _correlation(one: Correlation) -> Panel:
    of = [row.partition(" with ")[0] for row in one.rows]
    curves = []
    for k, name in enumerate(dict.fromkeys(of)):
        rows = [value for value, output in zip(one.value, of, strict=True) if output == name]
        curves.append(Curve(one.lags, np.max(rows, axis=0), name, Style(numbered(k).colour, "solid", 1.0)))
    curves.append(Curve(one.lags, one.limit.max(axis=0), "limit", Style("#b3261e", "dash", 1.4)))
    y = Axis("correlation [-]", "linear", (0.0, 1.15 * float(max(one.value.max(), one.limit.max()))))
    return Panel(Axis(f"lag [{one.lag_unit}]"), y, curves, (), f"{one.what[:1].upper()}{one.what[1:]}")


def modes(found: Identification) -> Table:
    """Natural frequencies and damping of the start and of the identified model."""
    return listed(
        "Modes of the start and of the identified model. Shapes are given by the distribution of the kinetic energy.",
        found.validation.modes,
        {
            "shape": lambda row: row.shape,
            "frequency, start [Hz]": lambda row: words.number(row.start_frequency_Hz, 4),
            "identified [Hz]": lambda row: words.number(row.frequency_Hz, 4),
            "damping ratio, start [%]": lambda row: words.number(100 * row.start_damping),
            "identified [%]": lambda row: words.number(100 * row.damping),
        },
    )


def _measured_modes(found: Identification) -> tuple[Table, Table]:
    """Identified and measured modes with standard deviations."""
    frequencies = listed(
        "Natural frequencies of the identified model beside those measured in the held-out data without the rig's "
        "equations, with one standard deviation. The difference is model minus measured, divided by its standard "
        "deviation.",
        found.validation.modes,
        {
            "shape": lambda row: row.shape,
            "identified [Hz]": lambda row: _pair(row.frequency_Hz, row.frequency_std_Hz),
            "measured [Hz]": lambda row: _pair(row.measured_frequency_Hz, row.measured_frequency_std_Hz),
            "difference [σ]": lambda row: _sigma(row.frequency_sigma),
        },
    )
    dampings = listed(
        "Damping ratios in the same way.",
        found.validation.modes,
        {
            "shape": lambda row: row.shape,
            "identified [%]": lambda row: _pair(100 * row.damping, 100 * row.damping_std),
            "measured [%]": lambda row: _pair(100 * row.measured_damping, 100 * row.measured_damping_std),
            "difference [σ]": lambda row: _sigma(row.damping_sigma),
        },
    )
    return frequencies, dampings


def _pair(value: float, sigma: float) -> str:
    if not np.isfinite(value):
        return "none"
    if not (np.isfinite(sigma) and sigma > 0):
        return words.number(value, 4)
    return " ± ".join(words.with_std(value, sigma))


def _sigma(value: float) -> str:
    return f"{value:+.1f}" if np.isfinite(value) else "none"
