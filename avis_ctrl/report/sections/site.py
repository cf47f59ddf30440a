"""Effects of the site's floor motion, of forces on the payload and of sensor noise."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Section, Table, section, table
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, controller_style, hertz
from avis_ctrl.report.sections.transmissibility import left_out, nominal
from avis_ctrl.rigs.vibration_criteria import CRITERIA
from avis_ctrl.study.design_result import ControllerResult, DesignResult


def site(result: DesignResult) -> Section:
    """The section on the site."""
    floor = result.plant.floor
    text = (
        f"The floor moves independently along each controlled axis, each time with the spectrum {floor.name} "
        f"({floor.source}); sensor noise is added. Nominal plant, linear model."
    )
    shown = (_third_octaves(result), _motion(result), _volts(result), _compliance(result))
    return section("Motion at the site", "site", Paragraph(text), shown)


def _settled(result: DesignResult) -> list[ControllerResult]:
    """The controllers with a stable nominal loop, for which stationary motion exists."""
    return [c for c in result.controllers if c.stable]


def _third_octaves(result: DesignResult) -> Figure:
    first = result.controllers[0].site
    bands = first.third_octave_Hz
    curves = []
    for c in CRITERIA:
        limit, label = 1e6 * c.limit(bands), "VC-A (top) to VC-G" if c.name == "VC-A" else ""
        curves.append(Curve(bands, np.where(np.isfinite(limit), limit, np.nan), label, STYLES["faint"]))
    curves.append(Curve(bands, 1e6 * first.floor_third_octaves, "floor", STYLES["plain"]))
    for one in _settled(result):
        payload = 1e6 * one.site.payload_third_octaves.max(axis=1)
        curves.append(Curve(bands, payload, one.title, controller_style(one.name)))
    ratings = "; ".join(f"{c.title} {c.site.rating or 'none'}" for c in _settled(result))
    return Figure(
        "third_octaves",
        "Velocity in third octaves: the site's floor, and the worst axis of the payload, "
        "compared with the generic vibration criteria. Criterion met: floor "
        f"{first.floor_rating or 'none'}; {ratings}." + left_out(result),
        [Panel(hertz(), Axis("velocity [µm/s r.m.s.]", "log"), curves)],
    )


def _motion(result: DesignResult) -> Table:
    axes, shown = result.plant.axes, _settled(result)
    rows = [(words.axis(a), *(words.number(1e6 * c.site.velocity_rms[a]) for c in shown)) for a in axes]
    rows += [
        (f"{words.axis(a)}, from sensor noise", *(words.number(1e6 * c.site.noise_rms[a]) for c in shown)) for a in axes
    ]
    rows.append(("criterion", *(c.site.rating or "none" for c in shown)))
    low, high = result.design.floor.band_Hz
    return table(
        f"Payload velocity r.m.s. [µm/s] from {low:g} to {high:g} Hz, from floor and sensor noise together "
        "and from the noise alone.",
        ("axis", *(c.title for c in shown)),
        rows,
    )


def _volts(result: DesignResult) -> Table:
    names, controlled = result.plant.actuators, [c for c in _settled(result) if c.K is not None]
    limits = dict(zip(names, result.rig.limits_of(names).tolist(), strict=True))
    both = [(c, c.site.volts_rms, c.site.volts_peak) for c in controlled]
    return table(
        "Voltages at the site by channel, r.m.s. / peak [V]. The peak is the level that a Gaussian signal "
        f"exceeds once in ten minutes; the limit is {words.limits(limits)}.",
        ("controller", *names),
        [(c.title, *(f"{words.number(rms[n])} / {words.number(peak[n])}" for n in rms)) for c, rms, peak in both],
    )


def _compliance(result: DesignResult) -> Figure:
    curves = [nominal(c, 1e6 * c.compliance) for c in _settled(result)]
    return Figure(
        "compliance",
        "Compliance: displacement of the payload relative to the floor per force on the "
        "payload, largest singular value, floor at rest; nominal plant." + left_out(result),
        [Panel(hertz(), Axis("compliance [µm/N]", "log"), curves)],
    )
