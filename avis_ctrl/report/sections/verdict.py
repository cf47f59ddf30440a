"""Task and results of a design, and a comparison of all controllers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Cell, Mark, Paragraph, Section, listed, section, table, yes_or_no
from avis_ctrl.report.sections.bounds import certificate, stable_for_the_set
from avis_ctrl.report.sections.transmissibility import summary_figure
from avis_ctrl.study.design_result import ControllerResult, DesignResult
from avis_ctrl.study.verdict import all_axes, first_sentence
from avis_ctrl.summary import digits_apart, joined


def verdict(result: DesignResult) -> Section:
    """Summary page: the task, the verdict on each requirement, the certificate, and one figure."""
    low, high = result.design.transmissibility.band_Hz
    judged = listed(
        "Requirements of the design and the results of the mu controller. Values in dB are the largest "
        "singular value from floor to payload, rotations as displacement of the edge; the band is "
        f"{low:g} to {high:g} Hz. The row of the offset is the DC voltage of a drive if every sensor channel "
        "has the largest offset that follows from the rig file, with the worst signs.",
        result.requirements,
        {
            "requirement": lambda r: r.name,
            "verdict": lambda r: Mark("met" if r.met else "NOT MET", r.met),
            "result": lambda r: words.quantity(
                r.value,
                r.unit,
                3 if r.met else digits_apart(r.value, r.limit, 3),
                "upper" if r.comparison == "at most" else "lower",
            ),
            "limit": lambda r: f"{r.comparison} {words.quantity(r.limit, r.unit)}",
        },
        "lcrr",
    )
    achieved = f" {_achieved(result)}" if result.stable else ""
    good = result.stable and all(r.met for r in result.requirements)
    first = Paragraph(
        first_sentence(result) + achieved, "verdict", None if result.stable and not result.requirements else good
    )
    shown = (first, _asked(result), judged, certificate(result), summary_figure(result))
    return section("Summary", "verdict", *shown, alone=True)


def _asked(result: DesignResult) -> Paragraph:
    """The task."""
    design, uncertain = result.design, result.design.uncertainty.parameters_percent
    low, high = design.transmissibility.band_Hz
    spread = joined([f"{name} ± {value:g} %" for name, value in uncertain.items()]) if uncertain else ""
    members = f"every plant of the uncertainty set{' with ' * bool(spread)}{spread}"
    return Paragraph(
        f"Task: one controller for {joined([words.axis(name) for name in result.plant.axes])} of the rig "
        f"{result.rig.name}. It must stabilise {members}. The weight of the synthesis demands a transmissibility "
        f"of at most {design.transmissibility.band_dB:+g} dB from {low:g} to {high:g} Hz, and of at most "
        f"{design.transmissibility.peak_dB:+g} dB at all other frequencies."
        + (
            " The table lists the requirements: those of the design file, and those that every design must meet."
            if result.requirements
            else ""
        )
    )


def _achieved(result: DesignResult) -> str:
    mu = result.controller("mu")
    low, high = result.design.transmissibility.band_Hz
    if mu.stable and mu.stability.lower >= 1:
        return (
            f"With the mu controller, the loop is unstable for a plant of the uncertainty set: mu of the uncertainty "
            f"alone is at least {words.lower(mu.stability.lower)}. So there is no worst-case transmissibility."
        )
    if not np.isfinite(mu.worst_peak.upper):
        return (
            "The mu controller is not proved to be stable for every plant of the uncertainty set, so no worst-case "
            "transmissibility can be stated."
        )
    sure = "" if mu.worst_peak.guaranteed and mu.worst_band.guaranteed else " at the computed frequencies"
    return (
        f"For every plant of the uncertainty set the mu controller keeps the transmissibility at or below "
        f"{words.decibel(mu.worst_peak.upper, 'upper')} at any frequency and "
        f"{words.decibel(mu.worst_band.upper, 'upper')} from {low:g} to {high:g} Hz{sure}; without control the table "
        "amplifies by "
        f"{words.decibel(result.controller('passive').peak_transmissibility)} at its resonance. {all_axes(result)}"
    )


def comparison(result: DesignResult) -> Section:
    """All controllers in one table."""
    low, high = result.design.transmissibility.band_Hz
    start, stop = result.design.floor.band_Hz
    rows: list[tuple[str, Callable[[ControllerResult], Cell]]] = [
        ("order", lambda c: str(c.order)),
        ("gamma, nominal weighted loop", lambda c: words.bound(c.gamma)),
        ("the same by SLICOT's AB13DD", lambda c: "failed" if c.gamma_slicot is None else words.bound(c.gamma_slicot)),
        ("mu, upper bound", lambda c: words.upper(c.mu.upper, 4)),
        ("mu, lower bound", lambda c: words.lower(c.mu.lower, 4)),
        ("mu peaks at", lambda c: words.hertz(c.mu.omega)),
        ("stable, nominal", lambda c: yes_or_no(c.stable)),
        ("stable for the whole set", stable_for_the_set),
        ("peak transmissibility, nominal", lambda c: _settled(c, words.decibel(c.peak_transmissibility))),
        ("peak transmissibility, worst case", lambda c: words.decibel(c.worst_peak.upper, "upper")),
        (f"worst case over {low:g} to {high:g} Hz", lambda c: words.decibel(c.worst_band.upper, "upper")),
        (
            f"payload velocity r.m.s., {start:g} to {stop:g} Hz, worst axis",
            lambda c: _settled(c, _micro(c.site.velocity_rms)),
        ),
        ("of which from sensor noise", lambda c: _settled(c, _micro(c.site.noise_rms))),
        ("vibration criterion met", lambda c: _settled(c, c.site.rating or "none")),
        ("largest voltage r.m.s.", lambda c: _settled(c, _volts(c.site.volts_rms))),
        ("largest voltage, once in 10 min", lambda c: _settled(c, _volts(c.site.volts_peak))),
        ("fastest pole", lambda c: f"{words.number(c.fastest_pole_Hz)} Hz" if c.K is not None else "none"),
    ]
    # The delivered controller first: on a narrow page the last columns are the least read.
    controllers = sorted(result.controllers, key=lambda c: c.name != "mu")
    compared = table(
        "All controllers, evaluated in the same way on the same plants. Worst cases are upper bounds over the "
        'whole uncertainty set; "no bound" means that the controller is not proved to stabilise every plant of '
        f"the set. The floor itself meets {controllers[0].site.floor_rating or 'no criterion'}.",
        ("", *(c.title for c in controllers)),
        [(name, *(value(c) for c in controllers)) for name, value in rows],
    )
    noted = [(r.name, r.note) for r in result.requirements if r.note]
    requirements = table("Notes to the requirements of the summary.", ("requirement", "note"), noted, "ll")
    notes = [*result.notes, *(f"{c.title}: {'; '.join(c.notes)}" for c in controllers if c.notes)]
    notes += [f"The controller {c.title!r} is not in the table: {c.reason}" for c in result.failed]
    said = (Paragraph(note, "note") for note in notes)
    return section("Controllers compared", "comparison", compared, requirements, said)


def _settled(c: ControllerResult, text: str) -> str:
    """Text for a result of the nominal loop; "unstable" if the loop has no such result."""
    return text if c.stable else "unstable"


def _micro(axes: dict[str, float]) -> str:
    return f"{words.number(1e6 * max(axes.values()))} µm/s"


def _volts(channels: dict[str, float]) -> str:
    largest = max(channels.values(), default=0.0)
    return f"{words.number(largest)} V" if largest > 0 else "none"
