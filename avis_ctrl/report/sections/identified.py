"""Uncertainty of a design from an identification: parameter directions, and spread of the measured response."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Piece, Section, Table, headed, section, table
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, hertz, markers
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.study.identification import Identification
from avis_ctrl.study.identified_uncertainty import SETTINGS as COMPARED
from avis_ctrl.study.identified_uncertainty import InDesign
from avis_ctrl.study.uncertainty_file import UncertaintyFile
from avis_ctrl.summary import count_of, joined


def identified(result: DesignResult) -> tuple[Piece, ...]:
    """Directions, remaining uncertainty, and spread with its weight; empty if the design uses no identification."""
    found, content, rig = result.plant.identified, result.design.uncertainty.identification, result.plant.rig
    if found is None or content is None:
        return ()
    shown = (_origin(content, found), directions(found, rig.nominal, rig.units), spread(found))
    return headed("Uncertainty from the identification", shown)


def _origin(content: UncertaintyFile, found: InDesign) -> Paragraph:
    d = found.found
    source = content.provenance.get("measurement")
    determined, kept = len(content.direction), len(found.directions)
    text = (
        f"The identification{f' ({source})' if source else ''} determined {determined} combinations of "
        f"{len(content.parameter)} parameters; {content.undetermined} other combinations have no influence on the "
        "measurements and keep their starting values. "
    )
    if kept:
        text += (
            f"{kept} of the determined combinations are bounded directions of the uncertainty set, each with a range "
            "of ± "
            f"{words.number(d.box)} standard deviations. The remaining combinations together change the response "
            f"by at most {_percent(d.rest)} and the transmissibility by at most {_percent(d.rest_floor)}. "
        )
    else:
        text += (
            f"Within {words.number(d.ball)} standard deviations, all of them together change the response by at "
            f"most {_percent(d.rest)} and the transmissibility by at most {_percent(d.rest_floor)}, so they need "
            "no separate uncertainty block. "
        )
    text += (
        "The remaining combinations are added to the bound on the error of the response. This bound acts at the "
        "actuators, so it does not cover their influence on the response to floor motion. If the errors are normally "
        "distributed, "
        "directions and remaining combinations contain the true parameters with a probability of "
        f"{words.number(100 * d.coverage)} %, and the error of the response is within its bound with a probability "
        f"of {words.number(100 * found.confidence)} % at each frequency."
    )
    return Paragraph(text)


def _percent(share: np.ndarray) -> str:
    return f"{words.number(100 * float(np.max(share, initial=0.0)), 2)} %"


def uncertainty(found: Identification, made: InDesign | None) -> Section:
    """Section of the report of an identification; None if the uncertainty of a design was not computed."""
    title, anchor = "Uncertainty for design", "uncertainty"
    if made is None:
        missing = (
            "The uncertainty model for a controller design was not computed with this report; the covariance is in "
            "result.json."
        )
        return section(title, anchor, Paragraph(missing))
    kept = joined([words.axis(name) for name in made.spread.keep])
    count = len(made.directions)
    bounded = (
        f"the joint covariance of the parameters is represented by {count_of(count, 'bounded direction')}"
        if count
        else "the parameters are known so precisely that no direction of their covariance needs a bound of its own"
    )
    text = (
        f"For a design of {kept}, {bounded}. The spread of the measured response about the model is represented by "
        "one filter. The directions and the remaining parameter uncertainty contain the true parameters with a "
        f"probability of {words.number(100 * made.found.coverage)} %; the bound of the spread is valid with a "
        f"probability of {words.number(100 * made.confidence)} % at each spectral line. Outside the measured band, "
        "or if the design file states a larger uncertainty of the drives, the filter is increased accordingly."
    )
    rest = (
        f"The remaining parameter uncertainty changes the response by at most {_percent(made.found.rest)}; the filter "
        "covers it."
    )
    rig = found.rig.parameters()
    nominal, units = {name: p.value for name, p in rig.items()}, {name: p.unit for name, p in rig.items()}
    return section(title, anchor, Paragraph(text), directions(made, nominal, units), Paragraph(rest), spread(made))


def directions(found: InDesign, nominal: Mapping[str, float], units: Mapping[str, str]) -> Table:
    """The bounded directions with the parameters that they change most."""
    rows = []
    for direction, effect in zip(found.directions, found.found.effect, strict=True):
        sizes = sorted(direction.changes, key=lambda one: -abs(one[1] / (nominal.get(one[0]) or 1.0)))
        shown = [
            f"{name} {100 * change / abs(nominal[name]):+.2g} %"
            if nominal.get(name)
            else f"{name} {change:+.2g} {words.unit(units.get(name, ''))}"
            for name, change in sizes[: SETTINGS.parameters]
        ]
        left = len(sizes) - SETTINGS.parameters
        more = f" and {left} parameters by less" if left > 0 else ""
        rows.append((direction.name, f"{words.number(100 * float(effect), 2)} %", ", ".join(shown) + more))
    return table(
        "Directions of correlated parameters: each is one real number between −1 and 1 that changes all of "
        f"them together; 1 corresponds to {words.number(found.found.box)} standard deviations. The effect is "
        "the largest relative change of the response at 1.",
        ("direction", "effect", "change at +1"),
        rows,
        "lrl",
    )


def spread(found: InDesign) -> Figure:
    """The measured spread of the response, its bound, and the filter that covers it."""
    s, weight = found.spread, found.weight
    low, high = COMPARED.band_Hz
    f = np.geomspace(min(low, s.frequency_Hz[0]), max(high, s.frequency_Hz[-1]), 400)
    omega = 2 * np.pi * f
    noise, covering = 100 * (s.bound(found.confidence) - s.measured), 100 * weight.shape.magnitude(omega)
    curves = (
        markers(s.frequency_Hz, 100 * s.measured, "measured minus model, with noise", Style("#0072b2")),
        Curve(s.frequency_Hz, noise, "noise of the measurement", Style("#7a7a7a", "dot", 1.4)),
        Curve(weight.omega / (2 * np.pi), 100 * weight.data, "bound to be covered", Style("#d55e00", "dash", 1.5)),
        Curve(f, 100 * weight.envelope(omega), "envelope", Style("#e69f00", "dashdot", 1.3)),
        Curve(f, covering, f"filter of order {weight.shape.order}", Style("#222222", "solid", 2.0)),
    )
    return Figure(
        "spread",
        "Relative difference between the measured response and the identified model in the kept "
        f"coordinates, largest singular value: {weight.meaning}. {found.assumption}".rstrip(),
        [Panel(hertz(), Axis("relative difference [%]", "log"), curves)],
        height=1.1,
    )
