"""Summary page of an identification, and the table of all parameters."""

from __future__ import annotations

import numpy as np

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Section, Table, section, table
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, Style, markers
from avis_ctrl.report.identification.gates import warnings
from avis_ctrl.report.identification.validation import errors, modes
from avis_ctrl.report.sections.tolerances import tolerances
from avis_ctrl.study.identification import Identification
from avis_ctrl.summary import joined

TOGETHER = "only in combination"


def opening(found: Identification) -> Section:
    """Summary page: verdict, measurements, modes, errors, and the next measurement."""
    v = found.validation
    first = [errors(one, v.outputs) for one in v.held_out[:1]]
    advice = [Paragraph(f"The next measurement: {one}") for one in found.advice[:1]]
    return section("Summary", "result", _sentence(found), _measured(found), modes(found), first, advice, alone=True)


def parameters(found: Identification) -> Section:
    """All parameters, changes of the values with tolerances, and what the standard deviations include."""
    fit = found.campaign_fit
    notes = [*([found.caution] if fit.tolerances else []), *fit.notes]
    said = (Paragraph(words.sentence(note), "note") for note in notes)
    return section("Parameters", "parameters", _parameters(found), _changes(found), tolerances(fit.tolerances), said)


def _measured(found: Identification) -> Paragraph:
    low, high = found.campaign_fit.band_Hz
    band = f"{words.number(low)} to {words.number(high)} Hz"
    if not isinstance(found.measured, Campaign):
        return Paragraph(
            f"Measured: frequency responses; the fit uses them from {band}. The error below is that of "
            "lines that no fit has used."
        )
    total = sum(r.header.duration_s for r in found.measured.records)
    how = f" {words.sentence(found.split.how)}" if found.split else ""
    return Paragraph(
        f"Measured: {len(found.measured.records)} records, {words.number(total)} s in total; the fit uses "
        f"the spectral lines from {band}.{how} The error is evaluated on held-out data, which no fit "
        "has used."
    )


def _sentence(found: Identification) -> Paragraph:
    information = found.information
    alone = int(np.count_nonzero(information.known))
    stops = any(f.severity == "stop" for f in found.findings)
    consistent = all(one.consistent and not one.repeats for one in found.validation.held_out)
    count = len(information.names)
    said = [
        words.sentence(found.validation.verdict),
        f"The data determine {information.rank} combinations of the {count} parameters, and {alone} parameters "
        "individually.",
    ]
    if not found.campaign_fit.fit.converged:
        said.append("The fit did not converge.")
    if warned := warnings(found.findings):
        said.append(f"Gates (data checks) with warnings: {joined(warned)}.")
    elif found.findings:
        said.append("No gate (data check) gave a warning.")
    return Paragraph(" ".join(said), "verdict", consistent and not stops and found.campaign_fit.fit.converged)


def _parameters(found: Identification) -> Table:
    information, start = found.information, found.campaign_fit.start.values
    rows = []
    for name, unit, before, value, sigma in zip(
        information.names, information.units, start, information.values, information.standard_deviation, strict=True
    ):
        change = f"{100 * (value / before - 1):+.2f} %" if before else "from zero"
        if np.isfinite(sigma):
            shown, spread = words.with_std(value, sigma)
            share = f"{words.number(100 * sigma / abs(value), 2)} %" if value else ""
        else:
            shown, spread, share = words.number(value, 5), TOGETHER, ""
        rows.append((name, words.number(before, 5), shown, spread, share, change, words.unit(unit)))
    prior = " The standard deviations include the priors." if found.campaign_fit.fit.priors else ""
    return table(
        "Every fitted parameter: starting value and maximum likelihood estimate with one standard deviation "
        "(Cramér-Rao bound). If a parameter is known only in combination with others, its own value is the "
        "one nearest to the start and has no meaning by itself; the section on identifiability lists the "
        "combinations."
        f"{prior}",
        ("parameter", "start", "identified", "± 1 σ", "relative", "change", "unit"),
        rows,
        "lrrrrrl",
    )


def _changes(found: Identification) -> Figure:
    information, start = found.information, found.campaign_fit.start.values
    size = np.where(start == 0, information.scale, np.abs(start))
    change = 100 * (information.values - start) / size
    twice = 200 * information.standard_deviation / size
    known, n = information.known, len(start)
    place = np.arange(n, 0, -1.0)
    alone, together = Style("#0072b2"), Style("#9a9a9a")
    error = {"error": twice[known], "along": "x"}
    curves = [markers(change[known], place[known], "determined individually, ± 2 σ", alone, **error)]
    if not known.all():
        label = f"{TOGETHER}: the nearest to the start"
        curves.append(markers(change[~known], place[~known], label, together))
    curves.append(Curve(np.zeros(2), np.array([0.3, n + 0.7]), "", STYLES["faint"]))
    caption = "Change of each parameter from its starting value; none is determined individually."
    if known.any():
        longest = words.number(float(np.max(twice[known])), 2)
        caption = (
            f"Change of each parameter from its starting value. The longest bar (2 σ) is {longest} % of its starting "
            "value; bars shorter than a marker are hidden by it."
        )
    names = Axis("", "linear", (0.3, n + 0.7), tuple(zip(place.tolist(), information.names, strict=True)))
    panel = Panel(Axis("change from the start [%]"), names, curves)
    return Figure("changes", caption, [panel], height=max(0.5, 0.07 * n))
